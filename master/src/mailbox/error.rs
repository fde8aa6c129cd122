//! Why a transfer failed, with the whole address.

use std::fmt;
use std::time::Duration;

use super::abort::{abort_text, mailbox_error_text};
use super::objects::ObjectAddress;
use super::{MAX_OBJECT, WireError};

/// `station` is the SubDevice's configured address. The transfer is over in every case; the next one starts clean.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SdoError {
    /// The SubDevice refused, with a CiA 301 or manufacturer's code.
    #[error("station {station:#06x}: {} was refused with {code:#010x}: {}", object(index, sub), abort_text(*code))]
    Abort {
        station: u16,
        index: u16,
        sub: u8,
        code: u32,
    },
    /// `set_aside` messages that answer something else arrived meanwhile.
    #[error("station {station:#06x}: {}: {phase} within {after:?}{}", object(index, sub), Aside(*set_aside))]
    Timeout {
        station: u16,
        index: u16,
        sub: u8,
        phase: Phase,
        after: Duration,
        set_aside: u64,
    },
    /// The SubDevice's mailbox refused the request itself.
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
    /// Frames come back, but this SubDevice touched none of them.
    #[error(
        "station {station:#06x}: {asked}: the device does not answer: it is off, or has lost its address"
    )]
    Gone { station: u16, asked: About },
    #[error(
        "station {station:#06x}: {asked}: mailboxes of {out_len} bytes out and {in_len} bytes in cannot carry CoE"
    )]
    Mailbox {
        station: u16,
        asked: About,
        out_len: u16,
        in_len: u16,
    },
    /// Frames do not come back.
    #[error("station {station:#06x}: {asked}: {}", Lost(source))]
    Wire {
        station: u16,
        asked: About,
        source: WireError,
    },
}

/// What a mailbox was used for when nothing could be had of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum About {
    Object(ObjectAddress),
    /// What lay in it was fetched, whatever it was.
    Emptying,
}

impl fmt::Display for About {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Object(at) => at.fmt(f),
            Self::Emptying => f.write_str("emptying its mailbox"),
        }
    }
}

/// Without the address of a datagram, which could be taken for an object's.
pub(super) struct Lost<'a>(pub(super) &'a WireError);

impl fmt::Display for Lost<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            WireError::Timeout { .. } => f.write_str("no frame came back"),
            WireError::Other(why) => f.write_str(why),
        }
    }
}

impl SdoError {
    /// The device's abort code, where it gave one.
    pub fn abort_code(&self) -> Option<u32> {
        match self {
            Self::Abort { code, .. } => Some(*code),
            _ => None,
        }
    }
}

/// What did not happen in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Phase {
    /// The mailbox stayed full: the SubDevice did not take the previous message.
    Request,
    /// The request was taken, and not answered.
    Answer,
    /// An answer was lost, and the SubDevice did not repeat it.
    Repeat,
    /// Everything went on, but too slowly.
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

fn object(index: &u16, sub: &u8) -> ObjectAddress {
    ObjectAddress {
        index: *index,
        sub: *sub,
    }
}

struct Aside(u64);

impl fmt::Display for Aside {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            0 => Ok(()),
            1 => f.write_str(" (1 answer to something else was set aside)"),
            n => write!(f, " ({n} answers to something else were set aside)"),
        }
    }
}
