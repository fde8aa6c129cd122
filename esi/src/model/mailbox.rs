//! Mailbox protocols and the start-up commands that belong to them.

use super::{Position, SlotDependence};

#[derive(Debug, Clone, Default)]
pub struct Mailbox {
    pub data_link_layer: bool,
    pub coe: Option<Coe>,
    pub foe: bool,
    pub eoe: bool,
    pub soe: bool,
    pub aoe: bool,
    pub voe: bool,
}

#[derive(Debug, Clone, Default)]
pub struct Coe {
    pub sdo_info: bool,
    /// PDO assignment (0x1C12/0x1C13) may be written.
    pub pdo_assign: bool,
    /// PDO contents (0x16xx/0x1Axx) may be written.
    pub pdo_config: bool,
    pub pdo_upload: bool,
    pub complete_access: bool,
    pub segmented_sdo: bool,
    pub diag_history: bool,
    pub init_cmds: Vec<InitCmd>,
}

/// `InitCmd`: an SDO download that the device's maker wants sent at a transition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InitCmd {
    pub position: Position,
    /// `IP`, `PS`, `SO` …; one command may name several.
    pub transitions: Vec<String>,
    pub index: u16,
    pub depends_on: SlotDependence,
    pub sub: u8,
    pub complete_access: bool,
    /// The user may not change it.
    pub fixed: bool,
    /// A device's command that a module's own for the same object replaces.
    pub overwritten_by_module: bool,
    pub data: Vec<u8>,
    /// `AdaptAutomatically`: the data follow the configuration; what is written here is that of the maker's default.
    pub adapts: bool,
    pub comment: String,
}
