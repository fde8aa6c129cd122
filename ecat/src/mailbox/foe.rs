//! FoE messages (ETG.1000.6 clause 5.8). Both sides send the same messages.
//!
//! ```
//! use ecaxis_ecat::mailbox::Encode;
//! use ecaxis_ecat::mailbox::foe::Message;
//!
//! let read = Message::Read { password: 0, name: b"firmware.bin" };
//! let mut bytes = Vec::new();
//! read.emit(2, 64, &mut bytes);
//! assert_eq!(Message::parse(&bytes), Ok(read));
//! ```

use alloc::vec::Vec;

use super::{DecodeError, Encode, HEADER, Mailbox, TYPE_ERROR, TYPE_FOE};

/// Opcode, a reserved byte, and four bytes whose meaning depends on the opcode.
const FOE_HEADER: usize = 6;

const READ: u8 = 1;
const WRITE: u8 = 2;
const DATA: u8 = 3;
const ACK: u8 = 4;
const ERROR: u8 = 5;
const BUSY: u8 = 6;

/// Returns the bytes of a file, or of its name, that fit into a mailbox of this size.
#[must_use]
pub fn room(mailbox: u16) -> usize {
    usize::from(mailbox).saturating_sub(HEADER + FOE_HEADER)
}

/// One FoE message, or another message in an FoE device's mailbox.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Message<'a> {
    /// Requests a file.
    Read {
        /// 0 without a password.
        password: u32,
        /// The file name.
        name: &'a [u8],
    },
    /// Announces a file.
    Write {
        /// 0 without a password.
        password: u32,
        /// The file name.
        name: &'a [u8],
    },
    /// A part of the file. Packets count from 1.
    Data {
        /// The packet number.
        packet: u32,
        /// The part.
        data: &'a [u8],
    },
    /// Acknowledges a packet; 0 acknowledges a write request.
    Ack {
        /// The packet number.
        packet: u32,
    },
    /// The transfer failed.
    Error {
        /// The error code (ETG.1000.6 Table 93).
        code: u32,
        /// The sender's own text, or nothing.
        text: &'a [u8],
    },
    /// The packet must be sent again later; `done` of `entire` is completed.
    Busy {
        /// The completed part.
        done: u16,
        /// The whole.
        entire: u16,
    },
    /// The SubDevice's mailbox rejected a message, with this code.
    Refused(u16),
    /// Another protocol.
    Other,
}

impl<'a> Message<'a> {
    /// Parses one whole mailbox.
    ///
    /// # Errors
    /// [`DecodeError`] if the message is inconsistent.
    pub fn parse(mailbox: &'a [u8]) -> Result<Self, DecodeError> {
        let mailbox = Mailbox::parse(mailbox)?;
        let body = match mailbox.protocol {
            TYPE_FOE => mailbox.body,
            TYPE_ERROR => return mailbox.error_code().map(Message::Refused),
            _ => return Ok(Message::Other),
        };
        let Some((&[opcode, _, a, b, c, d], data)) = body.split_first_chunk() else {
            return Err(DecodeError::Short {
                what: "an FoE message",
                length: body.len(),
            });
        };
        let number = u32::from_le_bytes([a, b, c, d]);
        Ok(match opcode {
            READ => Self::Read {
                password: number,
                name: data,
            },
            WRITE => Self::Write {
                password: number,
                name: data,
            },
            DATA => Self::Data {
                packet: number,
                data,
            },
            ACK => Self::Ack { packet: number },
            ERROR => Self::Error {
                code: number,
                text: data,
            },
            BUSY => Self::Busy {
                done: u16::from_le_bytes([a, b]),
                entire: u16::from_le_bytes([c, d]),
            },
            _ => return Err(DecodeError::Opcode(opcode)),
        })
    }
}

/// [`Message::Refused`] and [`Message::Other`] are not FoE and write an empty mailbox.
impl Encode for Message<'_> {
    fn emit(&self, counter: u8, mailbox: u16, out: &mut Vec<u8>) {
        let (opcode, number, data) = match *self {
            Self::Read { password, name } => (READ, password, name),
            Self::Write { password, name } => (WRITE, password, name),
            Self::Data { packet, data } => (DATA, packet, data),
            Self::Ack { packet } => (ACK, packet, &[][..]),
            Self::Error { code, text } => (ERROR, code, text),
            Self::Busy { done, entire } => {
                (BUSY, u32::from(entire) << 16 | u32::from(done), &[][..])
            }
            Self::Refused(_) | Self::Other => {
                out.clear();
                return out.resize(usize::from(mailbox), 0);
            }
        };
        super::emit(TYPE_FOE, counter, mailbox, out, |out| {
            out.extend_from_slice(&[opcode, 0]);
            out.extend_from_slice(&number.to_le_bytes());
            out.extend_from_slice(data);
        });
    }
}
