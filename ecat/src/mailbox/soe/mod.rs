//! SoE messages (ETG.1000.6 clause 5.7): the servo drive profile of IEC 61800-7-204 (Sercos) in a
//! mailbox. Both sides send the same messages.
//!
//! - `idn`: identification numbers ([`Idn`]) and their names
//! - `attribute`: the attribute of a parameter, its data state, lists
//! - `value`: values as text
//! - `error`: error codes
//!
//! ```
//! use ecaxis_ecat::mailbox::Encode;
//! use ecaxis_ecat::mailbox::soe::{Element, Idn, Message, Operation, Telegram};
//!
//! let read = Telegram::read_request(1, Element::Value, Idn::standard(51));
//! let mut bytes = Vec::new();
//! read.emit(2, 32, &mut bytes);
//! // 4 bytes follow, type SoE, counter 2; then operation 1 of drive 1, the value, S-0-0051.
//! assert_eq!(bytes[..6], [4, 0, 0, 0, 0, 0x25]);
//! assert_eq!(bytes[6..10], [0x21, 0x40, 51, 0]);
//! assert_eq!(Message::parse(&bytes), Ok(Message::Telegram(read)));
//! ```

use alloc::vec::Vec;

use super::{DecodeError, Encode, HEADER, Mailbox, TYPE_ERROR, TYPE_SOE};

mod attribute;
mod error;
mod idn;
#[cfg(test)]
mod tests;
mod value;

pub use attribute::{Attribute, CommandState, DataLength, DataState, Display, List};
pub use error::{CLASS_1_DIAGNOSTICS, ERROR_CODES, class_1_texts, soe_error_text};
pub use idn::{IDN_NAMES, Idn, IdnError};
pub use value::{ValueError, format_value, parse_value};

/// Operation and drive, elements, IDN or the number of fragments that follow.
const SOE_HEADER: usize = 4;
const INCOMPLETE: u8 = 0x08;
const ERROR: u8 = 0x10;
/// The drives of a device are numbered from 0 to 7.
pub const MAX_DRIVES: u8 = 8;

/// Returns the data bytes that fit into a mailbox of this size.
#[must_use]
pub fn room(mailbox: u16) -> usize {
    usize::from(mailbox).saturating_sub(HEADER + SOE_HEADER)
}

/// The operation of a telegram.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Operation {
    /// Requests elements of an IDN.
    ReadRequest,
    /// The elements, or a part of them.
    ReadResponse,
    /// Writes elements of an IDN, or a part of them.
    WriteRequest,
    /// The elements were written.
    WriteResponse,
    /// A drive reports without a request, for example the end of a procedure command.
    Notification,
    /// A drive reports a failure.
    Emergency,
    /// 0 and 7 have no meaning.
    Unknown(u8),
}

impl Operation {
    const fn from_bits(bits: u8) -> Self {
        match bits & 7 {
            1 => Self::ReadRequest,
            2 => Self::ReadResponse,
            3 => Self::WriteRequest,
            4 => Self::WriteResponse,
            5 => Self::Notification,
            6 => Self::Emergency,
            other => Self::Unknown(other),
        }
    }

    /// Returns the three bits of the operation.
    #[must_use]
    pub const fn bits(self) -> u8 {
        match self {
            Self::ReadRequest => 1,
            Self::ReadResponse => 2,
            Self::WriteRequest => 3,
            Self::WriteResponse => 4,
            Self::Notification => 5,
            Self::Emergency => 6,
            Self::Unknown(other) => other & 7,
        }
    }

    /// Returns the name of the operation.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::ReadRequest => "read request",
            Self::ReadResponse => "read response",
            Self::WriteRequest => "write request",
            Self::WriteResponse => "write response",
            Self::Notification => "notification",
            Self::Emergency => "emergency",
            Self::Unknown(_) => "unknown operation",
        }
    }
}

/// An element of an IDN. Its bit selects it in a telegram.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Element {
    /// The data state of a parameter or of a procedure command.
    DataState = 0x01,
    /// The name, a list of characters.
    Name = 0x02,
    /// The attribute.
    Attribute = 0x04,
    /// The unit, a list of characters.
    Unit = 0x08,
    /// The smallest value.
    Minimum = 0x10,
    /// The largest value.
    Maximum = 0x20,
    /// The operation data.
    Value = 0x40,
    /// The default value.
    Default = 0x80,
}

impl Element {
    /// All elements in the order in which a telegram carries them.
    pub const ALL: [Self; 8] = [
        Self::DataState,
        Self::Name,
        Self::Attribute,
        Self::Unit,
        Self::Minimum,
        Self::Maximum,
        Self::Value,
        Self::Default,
    ];

    /// Returns the bit of the element.
    #[must_use]
    pub const fn bit(self) -> u8 {
        self as u8
    }

    /// Returns the name of the element.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::DataState => "data state",
            Self::Name => "name",
            Self::Attribute => "attribute",
            Self::Unit => "unit",
            Self::Minimum => "minimum",
            Self::Maximum => "maximum",
            Self::Value => "value",
            Self::Default => "default",
        }
    }

    /// Returns the element if exactly its bit is set.
    #[must_use]
    pub fn from_bits(bits: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|element| element.bit() == bits)
    }
}

/// One SoE telegram.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Telegram<'a> {
    /// The operation.
    pub operation: Operation,
    /// True if fragments follow.
    pub incomplete: bool,
    /// True if the data are an error code.
    pub error: bool,
    /// The drive of the device, 0 to 7.
    pub drive: u8,
    /// The bits of the elements.
    pub elements: u8,
    /// The IDN, or the number of fragments that follow in an incomplete telegram.
    pub idn_or_left: u16,
    /// The elements in the order of their bits, or a part of them.
    pub data: &'a [u8],
}

impl<'a> Telegram<'a> {
    /// Returns the request for an element.
    #[must_use]
    pub const fn read_request(drive: u8, element: Element, idn: Idn) -> Self {
        Self {
            operation: Operation::ReadRequest,
            incomplete: false,
            error: false,
            drive,
            elements: element.bit(),
            idn_or_left: idn.0,
            data: &[],
        }
    }

    /// Returns the IDN; `None` in a fragment that others follow.
    #[must_use]
    pub const fn idn(&self) -> Option<Idn> {
        if self.incomplete {
            None
        } else {
            Some(Idn(self.idn_or_left))
        }
    }

    /// Returns the number of fragments that follow.
    #[must_use]
    pub const fn left(&self) -> u16 {
        if self.incomplete { self.idn_or_left } else { 0 }
    }

    /// Returns the error code. It is the last word; some devices send element data before it.
    #[must_use]
    pub fn error_code(&self) -> Option<u16> {
        let code = self.data.last_chunk().filter(|_| self.error)?;
        Some(u16::from_le_bytes(*code))
    }

    /// Parses the message behind the mailbox header.
    fn from_body(body: &'a [u8]) -> Result<Self, DecodeError> {
        let Some((&[first, elements, low, high], data)) = body.split_first_chunk() else {
            return Err(DecodeError::Short {
                what: "an SoE message",
                length: body.len(),
            });
        };
        let telegram = Self {
            operation: Operation::from_bits(first),
            incomplete: first & INCOMPLETE != 0,
            error: first & ERROR != 0,
            drive: first >> 5,
            elements,
            idn_or_left: u16::from_le_bytes([low, high]),
            data,
        };
        if telegram.error && data.len() < 2 {
            return Err(DecodeError::Short {
                what: "an SoE error",
                length: body.len(),
            });
        }
        Ok(telegram)
    }
}

impl Encode for Telegram<'_> {
    fn emit(&self, counter: u8, mailbox: u16, out: &mut Vec<u8>) {
        super::emit(TYPE_SOE, counter, mailbox, out, |out| {
            let flag = |set: bool, bit: u8| if set { bit } else { 0 };
            out.push(
                self.operation.bits()
                    | flag(self.incomplete, INCOMPLETE)
                    | flag(self.error, ERROR)
                    | self.drive << 5,
            );
            out.push(self.elements);
            out.extend_from_slice(&self.idn_or_left.to_le_bytes());
            out.extend_from_slice(self.data);
        });
    }
}

/// A message in the mailbox of a device with SoE.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Message<'a> {
    /// An SoE telegram.
    Telegram(Telegram<'a>),
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
        match mailbox.protocol {
            TYPE_SOE => Telegram::from_body(mailbox.body).map(Message::Telegram),
            TYPE_ERROR => mailbox.error_code().map(Message::Refused),
            _ => Ok(Message::Other),
        }
    }
}
