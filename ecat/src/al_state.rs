//! AL states: the low byte of AL control (0x0120) and AL status (0x0130) (ETG.1000.6).
//!
//! ```
//! use ecaxis_ecat::al_state::AlState;
//!
//! assert_eq!(AlState::from_status(0x14), AlState::SafeOp);
//! assert!(AlState::has_error(0x14));
//! ```

use core::fmt;

/// AL status: the state change failed. AL control: acknowledges it.
pub const ERROR: u8 = 0x10;

/// A state of the EtherCAT state machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AlState {
    /// No mailbox, no process data.
    Init,
    /// Mailbox only.
    PreOp,
    /// Firmware updates over FoE.
    Bootstrap,
    /// Valid inputs, outputs in a safe state.
    SafeOp,
    /// Valid inputs and outputs.
    Op,
    /// A value that no state has.
    Unknown(u8),
}

impl AlState {
    /// True if AL status shows an error.
    #[must_use]
    pub const fn has_error(status: u8) -> bool {
        status & ERROR != 0
    }

    /// Decodes the low nibble of AL status.
    #[must_use]
    pub const fn from_status(status: u8) -> Self {
        match status & 0x0f {
            1 => Self::Init,
            2 => Self::PreOp,
            3 => Self::Bootstrap,
            4 => Self::SafeOp,
            8 => Self::Op,
            other => Self::Unknown(other),
        }
    }

    /// Returns the value in AL control and AL status.
    #[must_use]
    pub const fn code(self) -> u8 {
        match self {
            Self::Init => 1,
            Self::PreOp => 2,
            Self::Bootstrap => 3,
            Self::SafeOp => 4,
            Self::Op => 8,
            Self::Unknown(code) => code,
        }
    }
}

impl fmt::Display for AlState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Init => "Init",
            Self::PreOp => "PreOp",
            Self::Bootstrap => "Bootstrap",
            Self::SafeOp => "SafeOp",
            Self::Op => "Op",
            Self::Unknown(code) => return write!(f, "state 0x{code:x}"),
        })
    }
}
