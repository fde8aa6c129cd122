//! SDO errors, with the full address of the object.

use std::fmt;
use std::time::Duration;

use ecaxis_ecat::mailbox::{abort_text, mailbox_error_text};

use super::{DatagramError, MAX_OBJECT};
use ecaxis_ecat::object::NamedObject;

/// An SDO error. `station` is the SubDevice's configured address. The transfer has ended in every
/// case, and the next one starts clean.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SdoError {
    /// The SubDevice aborted, with a CiA 301 or vendor-specific code.
    #[error("station {station:#06x}: {} was refused with {code:#010x}: {}", object(index, sub), abort_text(*code))]
    Abort {
        station: u16,
        index: u16,
        sub: u8,
        code: u32,
    },
    /// No answer in time. Meanwhile `set_aside` messages arrived that belong to something else.
    #[error("station {station:#06x}: {}: {phase} within {after:?}{}", object(index, sub), StrayReplies(*set_aside))]
    Timeout {
        station: u16,
        index: u16,
        sub: u8,
        phase: Phase,
        after: Duration,
        set_aside: u64,
    },
    /// The SubDevice's mailbox rejected the request itself.
    #[error("station {station:#06x}: {}: the mailbox refused the request with {code:#06x}: {}", object(index, sub), mailbox_error_text(*code))]
    Refused {
        station: u16,
        index: u16,
        sub: u8,
        code: u16,
    },
    #[error(
        "station {station:#06x}: {}: the answer makes no sense: {what}",
        object(index, sub)
    )]
    Malformed {
        station: u16,
        index: u16,
        sub: u8,
        what: String,
    },
    #[error(
        "station {station:#06x}: {} has {size} bytes, more than the {MAX_OBJECT} that are supported",
        object(index, sub)
    )]
    TooLarge {
        station: u16,
        index: u16,
        sub: u8,
        size: usize,
    },
    /// Frames come back, but this SubDevice processed none of them.
    #[error(
        "station {station:#06x}: {asked}: the device does not answer: it is off, or has lost its address"
    )]
    Gone { station: u16, asked: Subject },
    #[error(
        "station {station:#06x}: {asked}: mailboxes of {out_len} bytes out and {in_len} bytes in cannot carry CoE"
    )]
    Mailbox {
        station: u16,
        asked: Subject,
        out_len: u16,
        in_len: u16,
    },
    /// No frames come back.
    #[error("station {station:#06x}: {asked}: {}", LostDatagram(source))]
    Wire {
        station: u16,
        asked: Subject,
        source: DatagramError,
    },
}

/// The purpose of a mailbox access that failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Subject {
    Object(NamedObject),
    /// Reading and discarding the messages in the mailbox.
    Emptying,
}

impl fmt::Display for Subject {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Object(at) => at.fmt(f),
            Self::Emptying => f.write_str("emptying its mailbox"),
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

impl SdoError {
    /// Returns the device's abort code, if there is one.
    pub fn abort_code(&self) -> Option<u32> {
        match self {
            Self::Abort { code, .. } => Some(*code),
            _ => None,
        }
    }
}

/// The phase in which a timeout occurred.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Phase {
    /// The mailbox stayed full: the SubDevice did not fetch the previous message.
    Request,
    /// The SubDevice fetched the request but did not answer it.
    Answer,
    /// An answer was lost, and the SubDevice did not repeat it.
    Repeat,
    /// The transfer continued, but too slowly.
    Transfer,
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Request => "the mailbox was not free",
            Self::Answer => "no answer came",
            Self::Repeat => "a lost answer was not repeated",
            Self::Transfer => "the transfer was not complete",
        })
    }
}

fn object(index: &u16, sub: &u8) -> NamedObject {
    NamedObject {
        index: *index,
        sub: *sub,
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
