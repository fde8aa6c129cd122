//! FMMUs, SyncManagers, sync units and DC operation modes.

use super::{Direction, Position};

/// One `Fmmu` element. Its index in `Device::fmmus` is its number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Fmmu {
    /// The data that it maps.
    pub usage: FmmuUse,
    /// The SyncManager of this FMMU, if the file has one.
    pub sm: Option<u8>,
    /// The number of its sync unit.
    pub su: Option<u8>,
    /// Enabled in Op only.
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

/// The data that an FMMU maps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FmmuUse {
    /// Outputs.
    Outputs,
    /// Inputs.
    Inputs,
    /// The status of the input mailbox.
    MBoxState,
    /// Empty or unknown text.
    Other,
}

/// The data of a SyncManager.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SmUse {
    /// Mailbox from MainDevice to device.
    MBoxOut,
    /// Mailbox from device to MainDevice.
    MBoxIn,
    /// Outputs.
    Outputs,
    /// Inputs.
    Inputs,
    /// Nothing in the file says what it carries.
    Other,
}

impl SmUse {
    /// Returns the usage that mode and direction of a control byte (register 0x0804) mean.
    fn of_control_byte(control: u8) -> Self {
        match control & 0x0f {
            0x00 => Self::Inputs,
            0x04 => Self::Outputs,
            0x02 => Self::MBoxIn,
            0x06 => Self::MBoxOut,
            _ => Self::Other,
        }
    }
}

impl From<Direction> for SmUse {
    fn from(direction: Direction) -> Self {
        match direction {
            Direction::Rx => Self::Outputs,
            Direction::Tx => Self::Inputs,
        }
    }
}

impl SyncManager {
    /// Returns what the SyncManager carries. `directions` are those of the PDOs that name it.
    ///
    /// A mailbox is what its text says. The PDOs decide the direction of process data, because the
    /// layout follows them, unless text and `ControlByte` agree on the other direction. Without
    /// PDOs the text decides, and without a known text the `ControlByte` of an enabled SyncManager.
    pub(super) fn resolved(&self, mut directions: impl Iterator<Item = Direction>) -> SmUse {
        if matches!(self.usage, SmUse::MBoxOut | SmUse::MBoxIn) {
            return self.usage;
        }
        let first = directions.next();
        let one = first.filter(|first| directions.all(|other| other == *first));
        let by_control = SmUse::of_control_byte(self.control_byte);
        match (one.map(SmUse::from), self.usage) {
            (Some(_), text) if text == by_control && text != SmUse::Other => text,
            (Some(by_pdos), _) => by_pdos,
            (None, SmUse::Other) if self.enable => by_control,
            (None, text) => text,
        }
    }
}

/// One `Sm` element. Its index in `Device::sync_managers` is its number.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SyncManager {
    /// The position of the element.
    pub position: Position,
    /// The usage. PDOs, text and `ControlByte` decide it together (`Device::resolve_sync_managers`).
    pub usage: SmUse,
    /// `StartAddress`: the physical start address.
    pub start_address: u16,
    /// The size in bytes; 0 if the file has none.
    pub default_size: u16,
    /// The smallest size in bytes.
    pub min_size: Option<u16>,
    /// The largest size in bytes.
    pub max_size: Option<u16>,
    /// `ControlByte`, register 0x0804 of the SyncManager.
    pub control_byte: u8,
    /// `Enable`: the SyncManager is used by default.
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
    /// The position of the element.
    pub position: Position,
    /// `Name`.
    pub name: String,
    /// `Desc`.
    pub description: String,
    /// Low byte → 0x0980, high byte → 0x0981.
    pub assign_activate: u16,
    /// Times of SYNC0.
    pub sync0: SyncTime,
    /// Times of SYNC1.
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
    /// The absolute shift in ns.
    pub shift_ns: i64,
    /// The shift as a factor of the bus cycle, like `factor`.
    pub shift_factor: i32,
    /// `Input="1"`: the shift is relative to the input event.
    pub shift_input: bool,
}

/// `Su`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SyncUnit {
    /// `Name`.
    pub name: String,
    /// `SeparateSu`.
    pub separate: bool,
    /// `SeparateFrame`.
    pub separate_frame: bool,
    /// `DependOnInputState`.
    pub depends_on_input_state: bool,
    /// `FrameRepeatSupport`.
    pub frame_repeat: bool,
}
