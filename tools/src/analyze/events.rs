//! The events of a recording in order.

use std::fmt;

use ecaxis_axis::State;
use ecaxis_axis::cia402::describe;

use super::mailbox::{FileTransfer, Transfer, TransferDirection, TransferOutcome};
use super::soe::IdnTransfer;
use super::values::value;
use ecaxis_ecat::al_status_code::al_status_text;
use ecaxis_master::acyclic::AlState;
use ecaxis_master::mailbox::{Emergency, abort_text, mailbox_error_text, object_name};

/// The maximum number of stored events; further ones are counted.
pub const EVENTS: usize = 50_000;

/// The source of an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum EventScope {
    Bus,
    /// An index into the list of devices.
    Device(usize),
}

#[derive(Debug, Clone)]
pub struct Event {
    /// The time in ns since 1970.
    pub at: u64,
    pub of: EventScope,
    pub what: EventKind,
}

#[derive(Debug, Clone)]
pub enum EventKind {
    /// The number of devices that answer a broadcast read.
    Answering(u16),
    /// A station address was assigned.
    Station(u16),
    Requested {
        state: AlState,
        acknowledge: bool,
    },
    State {
        state: AlState,
        error: bool,
        code: Option<u16>,
    },
    /// The AL status of all devices, combined, has the error bit.
    ErrorBit,
    /// The AL status code of an earlier error event.
    Code(u16),
    Transfer(Box<Transfer>),
    Emergency(Emergency),
    File(Box<FileTransfer>),
    Idn(Box<IdnTransfer>),
    ObjectList(usize),
    NoInformation(u32),
    Refused(u16),
    Axis {
        axis: u8,
        state: State,
    },
    AxisError {
        axis: u8,
        code: u16,
    },
}

impl EventKind {
    /// True if the event appears in the summary, not only in the full list.
    pub fn matters(&self) -> bool {
        match self {
            Self::Transfer(transfer) => transfer.is_trouble(),
            Self::Idn(transfer) => transfer.is_trouble(),
            Self::Station(_) | Self::Code(_) => false,
            _ => true,
        }
    }

    /// True if the event is a problem.
    pub fn is_trouble(&self) -> bool {
        match self {
            Self::State { error, .. } => *error,
            Self::Transfer(transfer) => transfer.is_trouble(),
            Self::Emergency(emergency) => emergency.is_failure(),
            Self::File(file) => file.error.is_some(),
            Self::Idn(transfer) => transfer.is_trouble(),
            Self::Refused(_) | Self::ErrorBit => true,
            Self::Axis { state, .. } => {
                matches!(state, State::Fault | State::FaultReactionActive)
            }
            Self::AxisError { code, .. } => *code != 0,
            _ => false,
        }
    }
}

/// Formats object, transfer and outcome.
impl fmt::Display for Transfer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let way = match self.way {
            TransferDirection::Read => "read",
            TransferDirection::Write => "write",
        };
        write!(f, "{way} 0x{:04x}", self.index)?;
        if self.complete {
            write!(f, " whole")?;
        } else {
            write!(f, ":{:02x}", self.sub)?;
        }
        if let Some(name) = object_name(self.index, self.sub) {
            write!(f, " ({name})")?;
        }
        match self.ended {
            TransferOutcome::Done => write!(f, " = {}", value(self)),
            TransferOutcome::Aborted { code, by_device } => {
                let who = if by_device { "" } else { " by the MainDevice" };
                write!(f, ": aborted{who} with 0x{code:08x}, {}", abort_text(code))
            }
            TransferOutcome::Refused(code) => {
                write!(
                    f,
                    ": refused with {code:#06x}, {}",
                    mailbox_error_text(code)
                )
            }
            TransferOutcome::Unanswered => write!(f, ": no answer"),
        }
    }
}

impl fmt::Display for FileTransfer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let way = match self.way {
            TransferDirection::Read => "read",
            TransferDirection::Write => "write",
        };
        write!(f, "{way} file `{}`, {} bytes", self.name, self.len)?;
        match &self.error {
            Some((code, text)) => write!(f, ": failed with {code:#010x} {text}"),
            None => Ok(()),
        }
    }
}

impl fmt::Display for EventKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Answering(1) => write!(f, "1 device answers"),
            Self::Answering(count) => write!(f, "{count} devices answer"),
            Self::Station(station) => write!(f, "gets station address 0x{station:04x}"),
            Self::Requested { state, acknowledge } => {
                let and = if *acknowledge {
                    ", errors acknowledged"
                } else {
                    ""
                };
                write!(f, "asked for {state}{and}")
            }
            Self::State { state, error, code } => {
                write!(f, "{state}")?;
                match (error, code) {
                    (true, Some(0)) => write!(f, " with an error that has no code"),
                    (true, Some(code)) => {
                        write!(f, " with error {code:#06x}, {}", al_status_text(*code))
                    }
                    (true, None) => write!(f, " with an error"),
                    _ => Ok(()),
                }
            }
            Self::ErrorBit => write!(f, "a device reports an error"),
            Self::Code(code) => write!(f, "AL status code {code:#06x}, {}", al_status_text(*code)),
            Self::Transfer(transfer) => transfer.fmt(f),
            Self::Emergency(emergency) => emergency.fmt(f),
            Self::File(file) => file.fmt(f),
            Self::Idn(transfer) => transfer.fmt(f),
            Self::ObjectList(1) => write!(f, "lists 1 object"),
            Self::ObjectList(count) => write!(f, "lists {count} objects"),
            Self::NoInformation(code) => {
                write!(
                    f,
                    "no object information: 0x{code:08x}, {}",
                    abort_text(*code)
                )
            }
            Self::Refused(code) => {
                write!(
                    f,
                    "mailbox error {code:#06x}, {}",
                    mailbox_error_text(*code)
                )
            }
            Self::Axis { state, .. } => write!(f, "{state}"),
            Self::AxisError { code: 0, .. } => write!(f, "error code 0x0000, no error"),
            Self::AxisError { code, .. } => {
                write!(f, "error code {code:#06x}, {}", describe(*code).text)
            }
        }
    }
}
