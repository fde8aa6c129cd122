//! Mailbox messages (ETG.1000.4 clause 5.6): header, error codes, and the protocols in them.
//!
//! Parsing borrows and never panics. It accepts unknown services; only an inconsistent message is
//! a [`DecodeError`].
//!
//! ```
//! use ecaxis_ecat::mailbox::{self, coe};
//!
//! let request = coe::Request::Upload { index: 0x1018, sub: 1, complete: false };
//! let mut bytes = Vec::new();
//! mailbox::Encode::emit(&request, 1, 128, &mut bytes);
//! assert_eq!(bytes.len(), 128);
//! assert_eq!(coe::Request::parse(&bytes), Ok(Some(request)));
//! ```

use alloc::vec::Vec;

pub mod abort_code;
pub mod coe;
mod coe_answer;
pub mod eoe;
mod error_text;
pub mod foe;
pub mod gateway;
pub mod soe;

pub use abort_code::abort_text;
pub use error_text::mailbox_error_text;

/// The length in bytes of the mailbox header (ETG.1000.4 Table 29): length, address, channel and
/// priority, type and counter.
pub const HEADER: usize = 6;
/// The shortest mailbox that holds an expedited transfer and a segment.
pub const MIN_LENGTH: u16 = 16;

/// The type of a mailbox error reply.
pub const TYPE_ERROR: u8 = 0;
/// The type of an AoE message.
pub const TYPE_AOE: u8 = 1;
/// The type of an EoE message.
pub const TYPE_EOE: u8 = 2;
/// The type of a CoE message.
pub const TYPE_COE: u8 = 3;
/// The type of an FoE message.
pub const TYPE_FOE: u8 = 4;
/// The type of a SoE message.
pub const TYPE_SOE: u8 = 5;
/// The type of a VoE message.
pub const TYPE_VOE: u8 = 15;

/// The code of a mailbox error reply: the protocol is not supported.
pub const ERROR_UNSUPPORTED_PROTOCOL: u16 = 2;
/// The code of a mailbox error reply: the service is not supported.
pub const ERROR_SERVICE: u16 = 4;
/// The code of a mailbox error reply: no memory for the message.
pub const ERROR_MEMORY: u16 = 7;
/// The code of a mailbox error reply: the lengths contradict each other.
pub const ERROR_SIZE: u16 = 8;

/// A message that can be written to a mailbox.
pub trait Encode {
    /// Writes the message to `out` and pads it to `mailbox` bytes. A SyncManager releases a mailbox
    /// when its last byte is written. `counter` is 1 to 7; 0 means that no repetition is detected.
    fn emit(&self, counter: u8, mailbox: u16, out: &mut Vec<u8>);
}

/// How a message is inconsistent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// The length field exceeds the mailbox.
    #[error("its length field says {length}, the mailbox holds {room}")]
    Oversized {
        /// The length field.
        length: usize,
        /// The bytes behind the header.
        room: usize,
    },
    /// The message ends before its fields do.
    #[error("{what} of {length} bytes is too short")]
    Short {
        /// The kind of message.
        what: &'static str,
        /// Its length.
        length: usize,
    },
    /// An EtherCAT header of another type than that of a mailbox telegram.
    #[error("EtherCAT type {0} is not a mailbox telegram")]
    FrameType(u16),
    /// An FoE opcode that does not exist.
    #[error("unexpected FoE opcode {0} from a SubDevice")]
    Opcode(u8),
    /// An SDO command specifier that does not exist.
    #[error("invalid SDO command specifier {0:#04x}")]
    Command(u8),
}

/// One mailbox with its header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mailbox<'a> {
    /// The protocol: [`TYPE_COE`] and others.
    pub protocol: u8,
    /// The counter: 1 to 7, or 0.
    pub counter: u8,
    /// The message without the header and without padding.
    pub body: &'a [u8],
}

impl<'a> Mailbox<'a> {
    /// Splits a mailbox into header and message.
    ///
    /// # Errors
    /// [`DecodeError`] if the header or the announced message is not complete.
    pub fn parse(mailbox: &'a [u8]) -> Result<Self, DecodeError> {
        let [len_low, len_high, _, _, _, kind, body @ ..] = mailbox else {
            return Err(DecodeError::Short {
                what: "a mailbox",
                length: mailbox.len(),
            });
        };
        let length = usize::from(u16::from_le_bytes([*len_low, *len_high]));
        let Some(body) = body.get(..length) else {
            return Err(DecodeError::Oversized {
                length,
                room: body.len(),
            });
        };
        Ok(Self {
            protocol: kind & 0x0f,
            counter: kind >> 4 & 7,
            body,
        })
    }

    /// Returns the code of a mailbox error reply (ETG.1000.4 Table 30).
    ///
    /// # Errors
    /// [`DecodeError`] if the message has no code.
    pub fn error_code(&self) -> Result<u16, DecodeError> {
        match self.body {
            [_, _, low, high, ..] => Ok(u16::from_le_bytes([*low, *high])),
            body => Err(DecodeError::Short {
                what: "a mailbox error",
                length: body.len(),
            }),
        }
    }
}

/// Returns the body of a mailbox error reply.
#[must_use]
pub fn error_body(code: u16) -> Vec<u8> {
    // The first word is the type of the reply, always 1.
    [1_u16.to_le_bytes(), code.to_le_bytes()].concat()
}

/// Writes header, message and padding.
fn emit(
    protocol: u8,
    counter: u8,
    mailbox: u16,
    out: &mut Vec<u8>,
    body: impl FnOnce(&mut Vec<u8>),
) {
    out.clear();
    out.extend_from_slice(&[0, 0, 0, 0, 0, protocol | counter << 4]);
    body(out);
    let length = u16::try_from(out.len() - HEADER).unwrap_or(u16::MAX);
    for (to, from) in out.iter_mut().zip(length.to_le_bytes()) {
        *to = from;
    }
    out.resize(usize::from(mailbox), 0);
}

#[cfg(test)]
mod tests;
