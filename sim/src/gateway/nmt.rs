//! Network management: states and services (CiA 301 §7.2.8, §7.3.2).

/// The state of a CANopen device. The numbers are those of heartbeats and of object 0x1F82.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub enum NmtState {
    /// Initialisation; also the boot-up message.
    #[default]
    Initialising = 0,
    /// Stopped: NMT and error control only.
    Stopped = 4,
    /// Operational: PDOs too.
    Operational = 5,
    /// Pre-operational: SDOs, no PDOs.
    PreOperational = 127,
}

impl NmtState {
    /// Converts the value of a heartbeat without its toggle bit; `None` for other values.
    #[must_use]
    pub fn from_code(code: u8) -> Option<Self> {
        Some(match code {
            0 => Self::Initialising,
            4 => Self::Stopped,
            5 => Self::Operational,
            127 => Self::PreOperational,
            _ => return None,
        })
    }

    /// Returns the value in a heartbeat.
    #[must_use]
    pub fn code(self) -> u8 {
        self as u8
    }
}

/// Module control services; the numbers are the command specifiers on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum NmtCommand {
    Start = 1,
    Stop = 2,
    EnterPreOperational = 0x80,
    ResetNode = 0x81,
    ResetCommunication = 0x82,
}

impl NmtCommand {
    #[must_use]
    pub(crate) fn from_specifier(specifier: u8) -> Option<Self> {
        Some(match specifier {
            1 => Self::Start,
            2 => Self::Stop,
            0x80 => Self::EnterPreOperational,
            0x81 => Self::ResetNode,
            0x82 => Self::ResetCommunication,
            _ => return None,
        })
    }

    #[must_use]
    pub fn specifier(self) -> u8 {
        self as u8
    }

    /// Returns the target state. Resets lead to initialisation.
    #[must_use]
    pub(crate) fn leads_to(self) -> NmtState {
        match self {
            Self::Start => NmtState::Operational,
            Self::Stop => NmtState::Stopped,
            Self::EnterPreOperational => NmtState::PreOperational,
            Self::ResetNode | Self::ResetCommunication => NmtState::Initialising,
        }
    }
}
