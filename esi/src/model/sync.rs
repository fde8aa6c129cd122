//! FMMUs, SyncManagers, sync units and DC operation modes.

use super::Position;

/// One `Fmmu` element. Its index in `Device::fmmus` is its number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Fmmu {
    pub usage: FmmuUse,
    /// The SyncManager of this FMMU, if the file has one.
    pub sm: Option<u8>,
    /// The number of its sync unit.
    pub su: Option<u8>,
    pub op_only: bool,
}

impl From<FmmuUse> for Fmmu {
    fn from(usage: FmmuUse) -> Self {
        Self {
            usage,
            sm: None,
            su: None,
            op_only: false,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FmmuUse {
    Outputs,
    Inputs,
    MBoxState,
    /// Empty or unknown text.
    Other,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SmUse {
    MBoxOut,
    MBoxIn,
    Outputs,
    Inputs,
    /// Empty or unknown text.
    Other,
}

/// One `Sm` element. Its index in `Device::sync_managers` is its number.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SyncManager {
    pub position: Position,
    pub usage: SmUse,
    pub start_address: u16,
    /// The size in bytes; 0 if the file has none.
    pub default_size: u16,
    pub min_size: Option<u16>,
    pub max_size: Option<u16>,
    pub control_byte: u8,
    pub enable: bool,
    /// Not a SyncManager of the controller: process data at a register, accessible through an FMMU
    /// only.
    pub virtual_: bool,
    /// Enabled in Op only.
    pub op_only: bool,
    /// `Watchdog`: overrides control byte bit 6.
    pub watchdog: Option<bool>,
}

/// `Dc/OpMode`. Times in ns.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct DcMode {
    pub position: Position,
    pub name: String,
    pub description: String,
    /// Low byte → 0x0980, high byte → 0x0981.
    pub assign_activate: u16,
    pub sync0: SyncTime,
    pub sync1: SyncTime,
    /// PDOs that the mode assigns: (SyncManager, PDOs in order). Empty if the mode keeps the
    /// assignment.
    pub sync_managers: Vec<(u8, Vec<u16>)>,
    /// (PDO, samples per cycle), only for PDOs that the mode assigns.
    pub oversampling: Vec<(u16, u16)>,
}

/// Cycle and shift of one SYNC signal as in the file. `Factor` relates the signal to the bus cycle.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SyncTime {
    /// The absolute cycle in ns; 0: derived from the factor.
    pub cycle_ns: i64,
    /// > 0: bus cycle × factor; < 0: bus cycle ÷ |factor|; 0: none.
    pub factor: i32,
    pub shift_ns: i64,
    pub shift_factor: i32,
    /// `Input="1"`: the shift is relative to the input event.
    pub shift_input: bool,
}

/// `Su`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SyncUnit {
    pub name: String,
    pub separate: bool,
    pub separate_frame: bool,
    pub depends_on_input_state: bool,
    pub frame_repeat: bool,
}
