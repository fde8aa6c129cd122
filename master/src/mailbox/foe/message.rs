//! The bytes of FoE messages (ETG.1000.6 §5.8). Parsing borrows; an invalid message from a
//! SubDevice is a [`DecodeError`].

use super::super::coe::{self, DecodeError, MAILBOX_HEADER};
use super::super::transport::Encode;

const TYPE_FOE: u8 = 4;
/// Opcode, a reserved byte, and four bytes whose meaning depends on the opcode.
pub(super) const FOE_HEADER: usize = 6;

const READ: u8 = 1;
const WRITE: u8 = 2;
const DATA: u8 = 3;
const ACK: u8 = 4;
const ERROR: u8 = 5;
const BUSY: u8 = 6;

/// Returns the bytes of a file, or of its name, that fit into a mailbox of this size.
#[must_use]
pub fn room(mailbox: u16) -> usize {
    usize::from(mailbox).saturating_sub(MAILBOX_HEADER + FOE_HEADER)
}

/// A message from this client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Request<'a> {
    Read {
        password: u32,
        name: &'a str,
    },
    Write {
        password: u32,
        name: &'a str,
    },
    /// Packets count from 1.
    Data {
        packet: u32,
        data: &'a [u8],
    },
    Ack {
        packet: u32,
    },
    Error {
        code: u32,
    },
}

impl Encode for Request<'_> {
    fn emit(&self, counter: u8, mailbox: u16, out: &mut Vec<u8>) {
        let (opcode, number, data) = match *self {
            Self::Read { password, name } => (READ, password, name.as_bytes()),
            Self::Write { password, name } => (WRITE, password, name.as_bytes()),
            Self::Data { packet, data } => (DATA, packet, data),
            Self::Ack { packet } => (ACK, packet, &[][..]),
            Self::Error { code } => (ERROR, code, &[][..]),
        };
        let length = u16::try_from(FOE_HEADER + data.len()).unwrap_or(u16::MAX);
        out.clear();
        out.extend_from_slice(&length.to_le_bytes());
        out.extend_from_slice(&[0, 0, 0, TYPE_FOE | counter << 4, opcode, 0]);
        out.extend_from_slice(&number.to_le_bytes());
        out.extend_from_slice(data);
        out.resize(usize::from(mailbox), 0);
    }
}

/// A message from a SubDevice.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Message<'a> {
    Data {
        packet: u32,
        data: &'a [u8],
    },
    Ack {
        packet: u32,
    },
    /// With the SubDevice's own text, if there is one.
    Error {
        code: u32,
        text: &'a [u8],
    },
    /// `done` of `entire` is completed.
    Busy {
        done: u16,
        entire: u16,
    },
    /// The SubDevice's mailbox rejected a message, with this code.
    Refused(u16),
    /// Another protocol.
    Other,
}

/// Parses one whole mailbox.
pub(super) fn parse(mailbox: &[u8]) -> Result<Message<'_>, DecodeError> {
    let body = match coe::open(mailbox)? {
        (TYPE_FOE, body) => body,
        (coe::TYPE_ERROR, body) => return coe::refused(body).map(Message::Refused),
        _ => return Ok(Message::Other),
    };
    let Some((&[opcode, _, a, b, c, d], data)) = body.split_first_chunk() else {
        return Err(DecodeError::Short {
            what: "an FoE message",
            length: body.len(),
        });
    };
    let number = u32::from_le_bytes([a, b, c, d]);
    match opcode {
        DATA => Ok(Message::Data {
            packet: number,
            data,
        }),
        ACK => Ok(Message::Ack { packet: number }),
        ERROR => Ok(Message::Error {
            code: number,
            text: data,
        }),
        BUSY => Ok(Message::Busy {
            done: u16::from_le_bytes([a, b]),
            entire: u16::from_le_bytes([c, d]),
        }),
        // A SubDevice that requests files, or an invalid opcode.
        _ => Err(DecodeError::Opcode(opcode)),
    }
}
