//! Mailbox protocols and their start-up commands.

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
    /// The PDO assignment (0x1C12/0x1C13) is writable.
    pub pdo_assign: bool,
    /// The PDO contents (0x16xx/0x1Axx) are writable.
    pub pdo_config: bool,
    pub pdo_upload: bool,
    pub complete_access: bool,
    pub segmented_sdo: bool,
    pub diag_history: bool,
    pub init_cmds: Vec<InitCmd>,
}

/// `InitCmd`: an SDO download that the vendor requires at a state transition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InitCmd {
    pub position: Position,
    /// `IP`, `PS`, `SO`, …; one command may have several.
    pub transitions: Vec<String>,
    pub index: u16,
    pub depends_on: SlotDependence,
    pub sub: u8,
    pub complete_access: bool,
    /// The user may not change this command.
    pub fixed: bool,
    /// A module's command for the same object replaces this command of the device.
    pub overwritten_by_module: bool,
    pub data: Vec<u8>,
    /// `AdaptAutomatically`: the data follow the configuration. The data in the file belong to the
    /// vendor's default.
    pub adapts: bool,
    pub comment: String,
}
