//! Slots, and the modules that go there.

use super::{Dictionary, InitCmd, Pdo, Position, SlotDependence};

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Slots {
    pub position: Position,
    pub max_count: Option<u32>,
    pub increments: Increments,
    /// 0xF030 must be written with the configured module identities.
    pub download_module_ident_list: bool,
    pub slots: Vec<Slot>,
    /// `ModulePdoGroup`, by its number, which modules name.
    pub pdo_groups: Vec<ModulePdoGroup>,
}

/// By how much indices of a module count on from one slot, or slot group, to the next.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct Increments {
    pub pdo: u16,
    pub index: u16,
    pub group_pdo: u16,
    pub group_index: u16,
}

/// Modules of one group share a PDO whose length is padded.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ModulePdoGroup {
    pub name: String,
    /// Bytes; modules' data start at a multiple of it.
    pub alignment: u32,
    pub rx_pdo: Option<u16>,
    pub tx_pdo: Option<u16>,
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Slot {
    pub position: Position,
    pub name: String,
    /// `SlotGroup`.
    pub group: Option<u32>,
    pub min_instances: u32,
    pub max_instances: u32,
    /// Where the slot has its own instead of [`Slots::increments`].
    pub pdo_increment: Option<u16>,
    pub index_increment: Option<u16>,
    /// (module identity, is the default)
    pub module_idents: Vec<(u32, bool)>,
    /// `ModuleClass`: every module of one of these classes fits.
    pub module_classes: Vec<String>,
}

#[derive(Debug, Clone, Default)]
pub struct Module {
    pub position: Position,
    pub ident: u32,
    pub class: Option<String>,
    /// Number of the [`ModulePdoGroup`].
    pub pdo_group: Option<u32>,
    pub type_name: String,
    pub name: String,
    /// As [`Device::profile`].
    pub profile: Option<u32>,
    pub rx_pdos: Vec<Pdo>,
    pub tx_pdos: Vec<Pdo>,
    pub init_cmds: Vec<InitCmd>,
    /// `DcOpModeName`: which OpMode of the device the module wants.
    pub dc_mode: Option<String>,
    pub dictionary: Dictionary,
}

impl Module {
    /// The module as it is at a place: indices that depend on the slot count on. Places are counted from 0 over all
    /// slots and their instances.
    #[must_use]
    pub fn at(&self, slots: &Slots, slot: &Slot, place: usize) -> Self {
        let place = u16::try_from(place).unwrap_or(u16::MAX);
        let group = slot.group.and_then(|group| u16::try_from(group).ok());
        let group = group.unwrap_or(0);
        let increments = &slots.increments;
        let shifted = |index: u16, on: SlotDependence, step: u16, group_step: u16| {
            let by_slot = if on.slot { place.wrapping_mul(step) } else { 0 };
            let by_group = if on.group {
                group.wrapping_mul(group_step)
            } else {
                0
            };
            index.wrapping_add(by_slot).wrapping_add(by_group)
        };
        let pdo_step = slot.pdo_increment.unwrap_or(increments.pdo);
        let pdo_index = |index, on| shifted(index, on, pdo_step, increments.group_pdo);
        let step = slot.index_increment.unwrap_or(increments.index);
        let object_index = |index, on| shifted(index, on, step, increments.group_index);
        let mut module = self.clone();
        for pdo in module.rx_pdos.iter_mut().chain(&mut module.tx_pdos) {
            pdo.index = pdo_index(pdo.index, pdo.depends_on);
            for excluded in &mut pdo.exclude {
                excluded.index = pdo_index(excluded.index, excluded.depends_on);
            }
            for entry in pdo.entries.iter_mut().filter(|entry| !entry.is_gap()) {
                entry.index = object_index(entry.index, entry.depends_on);
            }
        }
        for command in &mut module.init_cmds {
            command.index = object_index(command.index, command.depends_on);
        }
        for object in &mut module.dictionary.objects {
            object.index = object_index(object.index, object.depends_on);
        }
        module
    }
}
