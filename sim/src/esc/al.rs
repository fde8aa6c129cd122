//! The EtherCAT state machine (ETG.1000.6 §6.4) as a pure function. The device checks the
//! requirements of a transition on SyncManagers and clocks.

use std::fmt;

/// A state of the EtherCAT state machine; the values are those of AL control and AL status.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum AlState {
    /// Init: no mailbox, no process data.
    #[default]
    Init = 1,
    /// Pre-Operational: mailbox only.
    PreOp = 2,
    /// Bootstrap: mailbox for firmware only.
    Boot = 3,
    /// Safe-Operational: inputs are valid, outputs are not applied.
    SafeOp = 4,
    /// Operational.
    Op = 8,
}

impl AlState {
    /// Converts the state bits 0–3 of AL control or AL status; `None` for other values.
    #[must_use]
    pub fn from_code(code: u8) -> Option<Self> {
        Some(match code {
            1 => Self::Init,
            2 => Self::PreOp,
            3 => Self::Boot,
            4 => Self::SafeOp,
            8 => Self::Op,
            _ => return None,
        })
    }

    /// Returns the value in AL control and AL status.
    #[must_use]
    pub fn code(self) -> u8 {
        self as u8
    }
}

impl fmt::Display for AlState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Init => "Init",
            Self::PreOp => "PreOp",
            Self::Boot => "Bootstrap",
            Self::SafeOp => "SafeOp",
            Self::Op => "Op",
        })
    }
}

/// The AL status codes of the simulator (0x0134).
pub mod code {
    pub const INVALID_STATE_CHANGE: u16 = 0x0011;
    pub const UNKNOWN_STATE: u16 = 0x0012;
    pub const BOOT_NOT_SUPPORTED: u16 = 0x0013;
    pub const NO_VALID_FIRMWARE: u16 = 0x0014;
    pub const INVALID_MAILBOX_BOOT: u16 = 0x0015;
    pub const INVALID_MAILBOX_PREOP: u16 = 0x0016;
    pub const NO_VALID_OUTPUTS: u16 = 0x0019;
    pub const SYNC_ERROR: u16 = 0x001a;
    pub const SM_WATCHDOG: u16 = 0x001b;
    pub const INVALID_OUTPUTS: u16 = 0x001d;
    pub const INVALID_INPUTS: u16 = 0x001e;
    pub const FATAL_SYNC_ERROR: u16 = 0x002c;
    pub const NO_SYNC_ERROR: u16 = 0x002d;
    pub const INVALID_DC_SYNC: u16 = 0x0030;
    pub const INVALID_SYNC_CYCLE: u16 = 0x0035;
    pub const MODULES_DIFFER: u16 = 0x0070;
}

/// Bit 4 of AL control (acknowledge) and AL status (error).
pub const ERROR: u16 = 0x10;
/// Bit 5: explicit device identification.
pub const DEVICE_ID: u16 = 0x20;

/// The effect of a write to AL control.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Request {
    /// An error is pending and not acknowledged.
    Ignored,
    /// The device already is in the requested state. An error is cleared.
    Stay,
    Change(AlState),
    Refused(u16),
}

/// Evaluates AL control in the current state. An error must be acknowledged, except for a request
/// of Init in a higher state: as in Beckhoff's Slave Stack Code, a request of the same state does not
/// end an error.
#[must_use]
pub fn judge(current: AlState, error: bool, control: u16) -> Request {
    use AlState::{Boot, Init, Op, PreOp, SafeOp};
    let wanted = AlState::from_code((control & 0x0f) as u8);
    let to_init = wanted == Some(Init) && current != Init;
    if error && control & ERROR == 0 && !to_init {
        return Request::Ignored;
    }
    let Some(wanted) = wanted else {
        return Request::Refused(code::UNKNOWN_STATE);
    };
    match (current, wanted) {
        (from, to) if from == to => Request::Stay,
        (_, Init)
        | (Init, PreOp | Boot)
        | (PreOp, SafeOp)
        | (SafeOp, PreOp | Op)
        | (Op, PreOp | SafeOp) => Request::Change(wanted),
        _ => Request::Refused(code::INVALID_STATE_CHANGE),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use AlState::{Boot, Init, Op, PreOp, SafeOp};

    #[test]
    fn al_control_follows_the_transition_table() {
        let bad = Request::Refused(code::INVALID_STATE_CHANGE);
        let go = Request::Change;
        let columns = [Init, PreOp, Boot, SafeOp, Op];
        let rows = [
            (Init, [Request::Stay, go(PreOp), go(Boot), bad, bad]),
            (PreOp, [go(Init), Request::Stay, bad, go(SafeOp), bad]),
            (Boot, [go(Init), bad, Request::Stay, bad, bad]),
            (SafeOp, [go(Init), go(PreOp), bad, Request::Stay, go(Op)]),
            (Op, [go(Init), go(PreOp), bad, go(SafeOp), Request::Stay]),
        ];
        for (from, row) in rows {
            for (to, expected) in columns.into_iter().zip(row) {
                let control = u16::from(to.code());
                assert_eq!(judge(from, false, control), expected, "{from} to {to}");
                let unacknowledged = if to == Init && from != Init {
                    expected
                } else {
                    Request::Ignored
                };
                assert_eq!(judge(from, true, control), unacknowledged);
                assert_eq!(judge(from, true, control | ERROR), expected);
            }
        }
    }

    #[test]
    fn al_control_rejects_unknown_state_codes() {
        for control in [0, 5, 6, 7, 9, 15] {
            assert_eq!(
                judge(Init, false, control),
                Request::Refused(code::UNKNOWN_STATE)
            );
        }
    }
}
