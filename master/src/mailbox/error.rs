//! CoE and SoE errors, with the full address of the object.

use std::fmt;
use std::time::Duration;

use ecaxis_ecat::mailbox::soe::{CommandState, soe_error_text};
use ecaxis_ecat::mailbox::{abort_text, mailbox_error_text};

use super::{DatagramError, IdnElement, InfoRequest, MAX_OBJECT};
use ecaxis_ecat::object::NamedObject;

/// An error of a CoE service. `station` is the SubDevice's configured address. The transfer has
/// ended in every case, and the next one starts clean.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CoeError<S> {
    pub station: u16,
    pub asked: S,
    pub cause: CoeCause,
}

/// An SDO error.
pub type SdoError = CoeError<Subject>;
/// An SDO Information error.
pub type InfoError = CoeError<InfoRequest>;

/// Why a CoE service failed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CoeCause {
    /// The SubDevice aborted, with a CiA 301 or vendor-specific code.
    #[error("was refused with {:#010x}: {}", .0, abort_text(*.0))]
    Abort(u32),
    /// The drive answered with an SoE error code.
    #[error("was refused with {:#06x}: {}", .0, soe_error_text(*.0))]
    Soe(u16),
    /// A procedure command did not end as executed.
    #[error("ended as: {0}")]
    Command(CommandState),
    /// No answer in time. Meanwhile `set_aside` messages arrived that belong to something else.
    #[error("{phase} within {after:?}{}", StrayReplies(*set_aside))]
    Timeout {
        phase: Phase,
        after: Duration,
        set_aside: u64,
    },
    /// The SubDevice's mailbox rejected the request itself. Most such devices have no SDO
    /// Information.
    #[error("the mailbox refused the request with {:#06x}: {}", .0, mailbox_error_text(*.0))]
    Refused(u16),
    #[error("the answer makes no sense: {0}")]
    Malformed(String),
    #[error("has {0} bytes, more than the {MAX_OBJECT} that are supported")]
    TooLarge(usize),
    /// Frames come back, but this SubDevice processed none of them.
    #[error("the device does not answer: it is off, or has lost its address")]
    Gone,
    #[error("mailboxes of {out_len} bytes out and {in_len} bytes in cannot carry its protocols")]
    Mailbox { out_len: u16, in_len: u16 },
    /// No frames come back.
    #[error("{}", LostDatagram(.0))]
    Wire(#[source] DatagramError),
}

impl<S: fmt::Display> fmt::Display for CoeError<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "station {:#06x}: {}",
            self.station,
            self.without_station()
        )
    }
}

impl<S: fmt::Debug + fmt::Display> std::error::Error for CoeError<S> {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        Some(&self.cause)
    }
}

impl<S: fmt::Display> CoeError<S> {
    /// Returns the text without the station, for a reader who knows the device.
    pub fn without_station(&self) -> impl fmt::Display {
        let colon = match self.cause {
            CoeCause::Abort(_)
            | CoeCause::Soe(_)
            | CoeCause::Command(_)
            | CoeCause::TooLarge(_) => "",
            _ => ":",
        };
        format!("{}{colon} {}", self.asked, self.cause)
    }
}

impl<S> CoeError<S> {
    /// Returns the device's abort code, if there is one.
    pub fn abort_code(&self) -> Option<u32> {
        match self.cause {
            CoeCause::Abort(code) => Some(code),
            _ => None,
        }
    }

    /// Returns the drive's SoE error code, if there is one.
    pub fn soe_code(&self) -> Option<u16> {
        match self.cause {
            CoeCause::Soe(code) => Some(code),
            _ => None,
        }
    }

    /// True if the device did not answer in time.
    pub fn is_timeout(&self) -> bool {
        matches!(self.cause, CoeCause::Timeout { .. })
    }

    /// True if the answer was received and is unusable.
    pub fn is_malformed(&self) -> bool {
        matches!(self.cause, CoeCause::Malformed(_))
    }

    /// True if the device itself refused; it may still answer other requests.
    pub fn is_refusal(&self) -> bool {
        matches!(
            self.cause,
            CoeCause::Abort(_) | CoeCause::Soe(_) | CoeCause::Refused(_)
        )
    }
}

/// The purpose of a mailbox access that failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Subject {
    Object(NamedObject),
    /// An element of an IDN (SoE).
    Idn(IdnElement),
    /// Reading and discarding the messages in the mailbox.
    Emptying,
    /// A message of another program.
    Telegram,
}

impl fmt::Display for Subject {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Object(at) => at.fmt(f),
            Self::Idn(at) => at.fmt(f),
            Self::Emptying => f.write_str("emptying its mailbox"),
            Self::Telegram => f.write_str("a message of the mailbox gateway"),
        }
    }
}

/// A lost datagram, displayed without its address, which could be mistaken for an object's.
pub(super) struct LostDatagram<'a>(pub(super) &'a DatagramError);

impl fmt::Display for LostDatagram<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            DatagramError::Timeout { .. } => f.write_str("no frame came back"),
            DatagramError::Other(why) => f.write_str(why),
        }
    }
}

/// The phase in which a timeout occurred.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Phase {
    /// The mailbox stayed full: the SubDevice did not fetch the previous message.
    Request,
    /// The SubDevice did not fetch the Ethernet frame (EoE) before the request.
    Fragment,
    /// The SubDevice fetched the request but did not answer it.
    Answer,
    /// An answer was lost, and the SubDevice did not repeat it.
    Repeat,
    /// The transfer continued, but too slowly.
    Transfer,
    /// The drive did not execute a procedure command (SoE).
    Command,
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Request => "the mailbox was not free",
            Self::Fragment => "the device did not take an Ethernet frame (EoE)",
            Self::Answer => "no answer came",
            Self::Repeat => "a lost answer was not repeated",
            Self::Transfer => "the transfer was not complete",
            Self::Command => "the procedure command was not executed",
        })
    }
}

struct StrayReplies(u64);

impl fmt::Display for StrayReplies {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            0 => Ok(()),
            1 => f.write_str(" (1 answer to something else was set aside)"),
            n => write!(f, " ({n} answers to something else were set aside)"),
        }
    }
}
