//! Slots, and the modules that go there.

use super::{Dictionary, InitCmd, Pdo, Position};

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
