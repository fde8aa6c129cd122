//! Why a file did not get through.

use std::fmt;
use std::time::Duration;

use super::super::abort::mailbox_error_text;
use super::super::error::Lost;
use super::super::{Phase, WireError};

/// `station` is the SubDevice's configured address, `file` the name that it was asked for. The transfer is over in every
/// case; the next one starts clean.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FoeError {
    /// The SubDevice said ERROR.
    #[error("station {station:#06x}: file `{file}`: was refused{} with {code:#06x}: {}{}", At(*packet), foe_error_text(*code), Words(text))]
    Refused {
        station: u16,
        file: String,
        /// How far it was; 0: at the request itself.
        packet: u32,
        code: u32,
        /// The SubDevice's own words.
        text: String,
    },
    #[error("station {station:#06x}: file `{file}`: {phase} within {after:?}{}", At(*packet))]
    Timeout {
        station: u16,
        file: String,
        packet: u32,
        phase: Phase,
        after: Duration,
    },
    /// It says BUSY and nothing else.
    #[error("station {station:#06x}: file `{file}`: is busy for more than {after:?}{}, with {done} of {entire} done", At(*packet))]
    Busy {
        station: u16,
        file: String,
        packet: u32,
        after: Duration,
        done: u16,
        entire: u16,
    },
    /// The SubDevice's mailbox refused the message itself.
    #[error("station {station:#06x}: file `{file}`: the mailbox refused the message with {code:#06x}: {}", mailbox_error_text(*code))]
    Mailbox {
        station: u16,
        file: String,
        code: u16,
    },
    #[error(
        "station {station:#06x}: file `{file}`: packet {found} came where packet {expected} is due"
    )]
    Packet {
        station: u16,
        file: String,
        expected: u32,
        found: u32,
    },
    #[error("station {station:#06x}: file `{file}`: the answer{} makes no sense: {what}", At(*packet))]
    Malformed {
        station: u16,
        file: String,
        packet: u32,
        what: String,
    },
    /// Of a file that is read.
    #[error("station {station:#06x}: file `{file}` has more than {most} bytes")]
    TooLarge {
        station: u16,
        file: String,
        most: usize,
    },
    /// It would be empty or cut, or ends early.
    #[error(
        "station {station:#06x}: `{file}` is no name for a file here: 1 to {room} bytes without a zero byte"
    )]
    Name {
        station: u16,
        file: String,
        room: usize,
    },
    /// Frames come back, but this SubDevice touched none of them.
    #[error("station {station:#06x}: file `{file}`: the device does not answer{}: it is off, or has lost its address", At(*packet))]
    Gone {
        station: u16,
        file: String,
        packet: u32,
    },
    #[error(
        "station {station:#06x}: file `{file}`: mailboxes of {out_len} bytes out and {in_len} bytes in cannot carry files"
    )]
    Layout {
        station: u16,
        file: String,
        out_len: u16,
        in_len: u16,
    },
    /// Frames do not come back.
    #[error("station {station:#06x}: file `{file}`: {}{}", Lost(source), At(*packet))]
    Wire {
        station: u16,
        file: String,
        packet: u32,
        source: WireError,
    },
}

impl FoeError {
    /// The SubDevice's error code, where it gave one.
    pub fn code(&self) -> Option<u32> {
        match self {
            Self::Refused { code, .. } => Some(*code),
            _ => None,
        }
    }
}

/// What an FoE error code means (ETG.1000.6 Table 92, ETG.1020 for 0x800C and above).
pub fn foe_error_text(code: u32) -> &'static str {
    match code {
        0x8000 => "not defined",
        0x8001 => "not found",
        0x8002 => "access denied",
        0x8003 => "disk full",
        0x8004 => "illegal",
        0x8005 => "packet number wrong",
        0x8006 => "already exists",
        0x8007 => "no user",
        0x8008 => "bootstrap only",
        0x8009 => "not in Bootstrap",
        0x800a => "no rights, or a wrong password",
        0x800b => "program error",
        0x800c => "wrong checksum",
        0x800d => "the firmware does not fit the hardware",
        0x800f => "no file",
        0x8010 => "the file has no header, or a wrong one",
        0x8011 => "the flash memory cannot be written",
        0x8012 => "the file does not fit the device",
        _ => "a code of the manufacturer",
    }
}

struct At(u32);

impl fmt::Display for At {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            0 => f.write_str(" at the request"),
            n => write!(f, " at packet {n}"),
        }
    }
}

struct Words<'a>(&'a str);

impl fmt::Display for Words<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            "" => Ok(()),
            text => write!(f, "; it says \"{text}\""),
        }
    }
}
