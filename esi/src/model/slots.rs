//! Slots and their modules.

use super::{Device, Dictionary, InitCmd, Object, Pdo, Position, SlotDependence};

/// `Slots`: the places for modules of a modular device.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Slots {
    /// The position of the element.
    pub position: Position,
    /// `MaxSlotCount`.
    pub max_count: Option<u32>,
    /// The index steps from slot to slot.
    pub increments: Increments,
    /// The MainDevice must write the configured module identities to 0xF030.
    pub download_module_ident_list: bool,
    /// `Slot` in file order.
    pub slots: Vec<Slot>,
    /// `ModulePdoGroup`, sorted by the number that modules refer to.
    pub pdo_groups: Vec<ModulePdoGroup>,
}

impl Slots {
    /// The number of subindices of 0xF030.
    pub const MAX_PLACES: usize = 254;

    /// Returns the number of places: slots and their instances, without the limits of 0xF030 and
    /// of `MaxSlotCount`.
    #[must_use]
    pub fn declared_places(&self) -> u64 {
        let counts = self.slots.iter().map(|slot| u64::from(slot.instances()));
        counts.fold(0, u64::saturating_add)
    }

    /// Returns the slot of each place, with the number of the instance.
    pub fn places(&self) -> impl Iterator<Item = (&Slot, u32)> {
        let most = self
            .max_count
            .and_then(|count| usize::try_from(count).ok())
            .filter(|count| *count > 0)
            .map_or(Self::MAX_PLACES, |count| count.min(Self::MAX_PLACES));
        let each = self.slots.iter();
        each.flat_map(|slot| (0..slot.instances()).map(move |instance| (slot, instance)))
            .take(most)
    }
}

/// The index steps of a module from one slot or slot group to the next.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct Increments {
    /// PDO indices, from slot to slot.
    pub pdo: u16,
    /// Object indices, from slot to slot.
    pub index: u16,
    /// PDO indices, from group to group.
    pub group_pdo: u16,
    /// Object indices, from group to group.
    pub group_index: u16,
}

/// Modules of one group share a PDO. Padding aligns the data of each module.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ModulePdoGroup {
    /// `Name`.
    pub name: String,
    /// The alignment of module data in bytes.
    pub alignment: u32,
    /// The RxPDO of the group.
    pub rx_pdo: Option<u16>,
    /// The TxPDO of the group.
    pub tx_pdo: Option<u16>,
}

/// One `Slot`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Slot {
    /// The position of the element.
    pub position: Position,
    /// `Name`.
    pub name: String,
    /// `SlotGroup`.
    pub group: Option<u32>,
    /// The smallest number of modules.
    pub min_instances: u32,
    /// The largest number of modules.
    pub max_instances: u32,
    /// The slot's own value instead of [`Slots::increments`].
    pub pdo_increment: Option<u16>,
    /// Same as `pdo_increment`, for objects.
    pub index_increment: Option<u16>,
    /// (module identity, true for the default)
    pub module_idents: Vec<(u32, bool)>,
    /// `ModuleClass`: the slot accepts each module of these classes.
    pub module_classes: Vec<String>,
}

impl Slot {
    /// Returns the number of places of the slot.
    #[must_use]
    pub fn instances(&self) -> u32 {
        self.max_instances.max(self.min_instances).max(1)
    }
}

/// One `Module` of an ESI file.
#[derive(Debug, Clone, Default)]
pub struct Module {
    /// The position of the element.
    pub position: Position,
    /// Element path, as in [`super::Warning`].
    pub path: String,
    /// The name of the module's file if it differs from the file of the devices.
    pub file: Option<String>,
    /// `ModuleIdent`: the identity in 0xF030 and 0xF050.
    pub ident: u32,
    /// `ModuleClass`.
    pub class: Option<String>,
    /// The number of the [`ModulePdoGroup`].
    pub pdo_group: Option<u32>,
    /// Text of `Type`.
    pub type_name: String,
    /// `Name`.
    pub name: String,
    /// Same as [`Device::profile`](super::Device::profile).
    pub profile: Option<u32>,
    /// `RxPdo`: PDOs with outputs.
    pub rx_pdos: Vec<Pdo>,
    /// `TxPdo`: PDOs with inputs.
    pub tx_pdos: Vec<Pdo>,
    /// `InitCmd` in file order.
    pub init_cmds: Vec<InitCmd>,
    /// `DcOpModeName`: the OpMode of the device that the module requires.
    pub dc_mode: Option<String>,
    /// The objects of the module.
    pub dictionary: Dictionary,
}

impl Module {
    /// Returns the module as plugged at `place` of a device: slot-dependent indices are shifted, and
    /// each PDO of the default assignment names its SyncManager. Places count from 0 over all slots
    /// and their instances.
    #[must_use]
    pub fn at(&self, device: &Device, slots: &Slots, slot: &Slot, place: usize) -> Self {
        let place = SlotPosition::new(slots, slot, place);
        let mut module = self.without_objects_at(device, &place);
        let objects = place.objects(self).map(|(index, object)| Object {
            index,
            ..object.clone()
        });
        module.dictionary.objects = objects.collect();
        module
    }

    /// Returns the approximate memory use in bytes.
    pub(crate) fn size(&self) -> usize {
        let pdos = self.rx_pdos.iter().chain(&self.tx_pdos).map(Pdo::size);
        let commands = self.init_cmds.iter().map(|cmd| {
            let transitions = cmd
                .transitions
                .len()
                .saturating_mul(size_of::<String>() + 8);
            size_of::<InitCmd>() + cmd.data.len() + cmd.comment.len() + transitions
        });
        let objects = self.dictionary.objects.iter().map(Object::size);
        let names = self.name.len() + self.type_name.len();
        pdos.chain(commands)
            .chain(objects)
            .fold(size_of::<Self>() + names, usize::saturating_add)
    }

    /// Same as [`Self::at`] without the dictionary, which [`SlotPosition::objects`] provides.
    /// Dictionaries are long, and a device may have many places.
    pub(crate) fn without_objects_at(&self, device: &Device, place: &SlotPosition) -> Self {
        // ETG.2000: without `Sm`, a PDO is not assigned by default, unless it is mandatory. A module
        // that names no SyncManager at all would have no process data.
        let mut all = self.rx_pdos.iter().chain(&self.tx_pdos);
        let names_none = all.all(|pdo| pdo.sm.is_none());
        let mut module = Self {
            rx_pdos: self.rx_pdos.clone(),
            tx_pdos: self.tx_pdos.clone(),
            init_cmds: self.init_cmds.clone(),
            path: self.path.clone(),
            file: self.file.clone(),
            class: self.class.clone(),
            type_name: self.type_name.clone(),
            name: self.name.clone(),
            dc_mode: self.dc_mode.clone(),
            dictionary: Dictionary::default(),
            ..*self
        };
        for pdo in module.rx_pdos.iter_mut().chain(&mut module.tx_pdos) {
            if pdo.sm.is_none() && (pdo.mandatory || names_none) {
                pdo.sm = device.primary_sm(pdo.direction);
            }
            pdo.index = place.pdo_index(pdo.index, pdo.depends_on);
            for excluded in &mut pdo.exclude {
                excluded.index = place.pdo_index(excluded.index, excluded.depends_on);
            }
            for entry in pdo.entries.iter_mut().filter(|entry| !entry.is_gap()) {
                entry.index = place.object_index(entry.index, entry.depends_on);
            }
        }
        for command in &mut module.init_cmds {
            command.index = place.object_index(command.index, command.depends_on);
        }
        module
    }
}

/// The place of a module, which determines its indices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct SlotPosition {
    number: u16,
    group: u16,
    steps: Increments,
}

impl SlotPosition {
    pub fn new(slots: &Slots, slot: &Slot, number: usize) -> Self {
        let group = slot.group.and_then(|group| u16::try_from(group).ok());
        Self {
            number: u16::try_from(number).unwrap_or(u16::MAX),
            group: group.unwrap_or(0),
            steps: Increments {
                pdo: slot.pdo_increment.unwrap_or(slots.increments.pdo),
                index: slot.index_increment.unwrap_or(slots.increments.index),
                ..slots.increments
            },
        }
    }

    /// Returns a module's objects with their indices at this place.
    pub fn objects<'m>(&self, module: &'m Module) -> impl Iterator<Item = (u16, &'m Object)> {
        let place = *self;
        let objects = module.dictionary.objects.iter();
        objects.map(move |object| {
            let index = place.object_index(object.index, object.depends_on);
            (index, object)
        })
    }

    fn pdo_index(&self, index: u16, on: SlotDependence) -> u16 {
        self.shifted(index, on, self.steps.pdo, self.steps.group_pdo)
    }

    pub fn object_index(&self, index: u16, on: SlotDependence) -> u16 {
        self.shifted(index, on, self.steps.index, self.steps.group_index)
    }

    fn shifted(&self, index: u16, on: SlotDependence, step: u16, group_step: u16) -> u16 {
        let counted = |on, number: u16, step| if on { number.wrapping_mul(step) } else { 0 };
        index
            .wrapping_add(counted(on.slot, self.number, step))
            .wrapping_add(counted(on.group, self.group, group_step))
    }
}
