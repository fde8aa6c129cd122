//! File transfer errors.

use std::fmt;
use std::time::Duration;

use ecaxis_ecat::mailbox::mailbox_error_text;

use super::super::error::LostDatagram;
use super::super::{DatagramError, Phase};

/// A file transfer error. `station` is the SubDevice's configured address, `file` the requested
/// name. The transfer has ended in every case, and the next one starts clean.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("station {station:#06x}: {}", self.without_station())]
pub struct FoeError {
    pub station: u16,
    pub file: String,
    #[source]
    pub cause: FoeCause,
}

/// Why a file transfer failed. `packet` is the packet at which it failed; 0 is the request itself.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FoeCause {
    /// The SubDevice sent ERROR.
    #[error("was refused{} with {code:#06x}: {}{}", Context(*packet), foe_error_text(*code), DeviceText(text))]
    Refused {
        packet: u32,
        code: u32,
        /// The SubDevice's own text.
        text: String,
    },
    #[error("{phase} within {after:?}{}", Context(*packet))]
    Timeout {
        packet: u32,
        phase: Phase,
        after: Duration,
    },
    /// The SubDevice answers BUSY for too long.
    #[error("is busy for more than {after:?}{}, with {done} of {entire} done", Context(*packet))]
    Busy {
        packet: u32,
        after: Duration,
        done: u16,
        entire: u16,
    },
    /// The SubDevice's mailbox rejected the message itself.
    #[error("the mailbox refused the message with {:#06x}: {}", .0, mailbox_error_text(*.0))]
    Mailbox(u16),
    #[error("packet {found} came where packet {expected} is due")]
    Packet { expected: u32, found: u32 },
    #[error("the answer{} makes no sense: {what}", Context(*packet))]
    Malformed { packet: u32, what: String },
    /// The file to read is too long.
    #[error("has more than {most} bytes")]
    TooLarge { most: usize },
    /// The name would be empty or truncated, or contains a zero byte.
    #[error("is not a valid file name: 1 to {room} bytes without a zero byte")]
    Name { room: usize },
    /// Frames come back, but this SubDevice processed none of them.
    #[error("the device does not answer{}: it is off, or has lost its address", Context(*packet))]
    Gone { packet: u32 },
    #[error("mailboxes of {out_len} bytes out and {in_len} bytes in cannot carry files")]
    Layout { out_len: u16, in_len: u16 },
    /// No frames come back.
    #[error("{}{}", LostDatagram(source), Context(*packet))]
    Wire { packet: u32, source: DatagramError },
}

impl FoeError {
    /// Returns the SubDevice's error code, if there is one.
    pub fn code(&self) -> Option<u32> {
        match self.cause {
            FoeCause::Refused { code, .. } => Some(code),
            _ => None,
        }
    }

    /// Returns the text without the station, for a reader who knows the device.
    pub fn without_station(&self) -> impl fmt::Display {
        let Self { file, cause, .. } = self;
        match cause {
            FoeCause::Name { .. } => format!("`{file}` {cause}"),
            FoeCause::TooLarge { .. } => format!("file `{file}` {cause}"),
            _ => format!("file `{file}`: {cause}"),
        }
    }
}

/// Returns the text of an FoE error code (ETG.1000.6 Table 92, ETG.1020 for 0x800C and above).
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

struct Context(u32);

impl fmt::Display for Context {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            0 => f.write_str(" at the request"),
            n => write!(f, " at packet {n}"),
        }
    }
}

struct DeviceText<'a>(&'a str);

impl fmt::Display for DeviceText<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            "" => Ok(()),
            text => write!(f, "; it says \"{text}\""),
        }
    }
}
