//! Control and status word, the first two bytes of the process data (manual HMSI-168-81 §6.2.1,
//! §6.2.2).
//!
//! Byte 0 holds a toggle bit, a command of three bits and its extension of four. Byte 1 names a
//! node in the control word and the lowest node in error in the status word.

use super::nmt::{NmtCommand, NmtState};

/// The command in the status word while the primary network is not in Op.
pub(super) const NO_OPERATION: u8 = 7;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ControlWord {
    pub(super) toggle: bool,
    pub(super) command: Command,
    pub(super) target: Target,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Command {
    SetState(NmtCommand),
    NodeState,
    GeneralStatus,
    NoOperation,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Target {
    /// The gateway itself.
    Module,
    Node(u8),
    /// The complete secondary network.
    Network,
}

/// Returns the toggle bit of either word's first byte.
pub(super) fn toggle(byte: u8) -> bool {
    byte & 0x80 != 0
}

impl ControlWord {
    /// Decodes a control word. Returns `None` if the command, its extension or the node is
    /// reserved.
    pub(super) fn decode([byte, node]: [u8; 2]) -> Option<Self> {
        let command = match (byte >> 4 & 7, byte & 0x0f) {
            (0, extension) => Command::SetState(match extension {
                0 => NmtCommand::EnterPreOperational,
                1 => NmtCommand::Start,
                2 => NmtCommand::ResetNode,
                3 => NmtCommand::ResetCommunication,
                4 => NmtCommand::Stop,
                _ => return None,
            }),
            (1, _) => Command::NodeState,
            (2, _) => Command::GeneralStatus,
            (NO_OPERATION, _) => Command::NoOperation,
            _ => return None,
        };
        let target = match node {
            0 => Target::Module,
            1..=127 => Target::Node(node),
            128 => Target::Network,
            _ => return None,
        };
        Some(Self {
            toggle: toggle(byte),
            command,
            target,
        })
    }
}

/// The extension in the response to "Get Node state".
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReportedState {
    PreOperational = 0,
    Operational = 1,
    ResetNode = 2,
    ResetCommunication = 3,
    Stopped = 4,
    Unknown = 5,
    Missing = 6,
    Error = 0x0f,
}

impl ReportedState {
    /// Converts a value read from object 0x1F82.
    pub(super) fn from_request_nmt(value: u8) -> Self {
        match value {
            0 => Self::Unknown,
            1 => Self::Missing,
            6 => Self::ResetNode,
            7 => Self::ResetCommunication,
            code => match NmtState::from_code(code) {
                Some(NmtState::PreOperational) => Self::PreOperational,
                Some(NmtState::Operational) => Self::Operational,
                Some(NmtState::Stopped) => Self::Stopped,
                _ => Self::Error,
            },
        }
    }
}

/// Extension bits of "Get COPM general status".
pub(super) mod general {
    pub(in super::super) const ERROR_PASSIVE: u8 = 1 << 1;
    pub(in super::super) const ERROR_CONTROL: u8 = 1 << 2;
    pub(in super::super) const SYNC: u8 = 1 << 3;
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The table of supported commands, row by row, with both toggle values.
    #[test]
    fn commands() {
        for toggled in [0, 0x80] {
            let decode = |byte: u8| ControlWord::decode([byte | toggled, 0]).map(|w| w.command);
            for (byte, command) in [
                (
                    0x00,
                    Some(Command::SetState(NmtCommand::EnterPreOperational)),
                ),
                (0x01, Some(Command::SetState(NmtCommand::Start))),
                (0x02, Some(Command::SetState(NmtCommand::ResetNode))),
                (
                    0x03,
                    Some(Command::SetState(NmtCommand::ResetCommunication)),
                ),
                (0x04, Some(Command::SetState(NmtCommand::Stop))),
                (0x10, Some(Command::NodeState)),
                (0x20, Some(Command::GeneralStatus)),
                (0x70, Some(Command::NoOperation)),
            ] {
                assert_eq!(decode(byte), command, "{byte:02x}");
            }
            for reserved in (0x05..=0x0f).chain(0x30..=0x6f) {
                assert_eq!(decode(reserved), None, "{reserved:02x}");
            }
            assert_eq!(
                ControlWord::decode([toggled, 0]).map(|w| w.toggle),
                Some(toggled != 0)
            );
        }
    }

    #[test]
    fn node_ids() {
        for node in 0..=u8::MAX {
            let target = ControlWord::decode([0x01, node]).map(|w| w.target);
            let expected = match node {
                0 => Some(Target::Module),
                128 => Some(Target::Network),
                1..=127 => Some(Target::Node(node)),
                _ => None,
            };
            assert_eq!(target, expected, "{node}");
        }
    }

    /// The read values of 0x1F82 against the table of responses.
    #[test]
    fn node_states() {
        for (read, reported) in [
            (0, ReportedState::Unknown),
            (1, ReportedState::Missing),
            (4, ReportedState::Stopped),
            (5, ReportedState::Operational),
            (6, ReportedState::ResetNode),
            (7, ReportedState::ResetCommunication),
            (127, ReportedState::PreOperational),
            (2, ReportedState::Error),
            (200, ReportedState::Error),
        ] {
            assert_eq!(ReportedState::from_request_nmt(read), reported, "{read}");
        }
        let codes = [
            ReportedState::PreOperational,
            ReportedState::Operational,
            ReportedState::ResetNode,
            ReportedState::ResetCommunication,
            ReportedState::Stopped,
            ReportedState::Unknown,
            ReportedState::Missing,
            ReportedState::Error,
        ]
        .map(|state| state as u8);
        assert_eq!(codes, [0, 1, 2, 3, 4, 5, 6, 15]);
    }
}
