//! Elements with a structure (IEC 61800-7-204): the attribute, the data state, and lists.

use core::fmt;

/// The attribute of an IDN.
///
/// Bits 0 to 15: conversion factor. 16 to 18: length. 19: procedure command. 20 to 22: type and
/// display. 24 to 27: decimal places. 28 to 30: write-protected in CP2 (PreOp), CP3 (SafeOp) and CP4
/// (Op).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Attribute(pub u32);

/// The length of a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum DataLength {
    /// A value of 2, 4 or 8 bytes.
    Fixed(usize),
    /// A list whose elements have 1, 2, 4 or 8 bytes.
    List(usize),
    /// Code 0 is reserved.
    Reserved,
}

/// The type of a value and its display.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Display {
    /// Binary.
    Binary,
    /// Unsigned decimal.
    Unsigned,
    /// Signed decimal.
    Signed,
    /// Hexadecimal.
    Hexadecimal,
    /// Text.
    Text,
    /// IDNs.
    Idn,
    /// IEEE 754.
    Float,
    /// Sercos time: seconds since 1970 and their fraction.
    Time,
}

impl Attribute {
    /// Returns the attribute of a value.
    #[must_use]
    pub const fn new(length: DataLength, display: Display) -> Self {
        let code = match length {
            DataLength::Reserved => 0,
            DataLength::Fixed(2) => 1,
            DataLength::Fixed(4) => 2,
            DataLength::Fixed(_) => 3,
            DataLength::List(1) => 4,
            DataLength::List(2) => 5,
            DataLength::List(4) => 6,
            DataLength::List(_) => 7,
        };
        Self(1 | code << 16 | (display as u32) << 20)
    }

    /// Returns the conversion factor, a numerator for the display of unsigned values.
    #[must_use]
    pub const fn factor(self) -> u16 {
        (self.0 & 0xffff) as u16
    }

    /// Returns the length of the value.
    #[must_use]
    pub const fn length(self) -> DataLength {
        match self.0 >> 16 & 7 {
            1 => DataLength::Fixed(2),
            2 => DataLength::Fixed(4),
            3 => DataLength::Fixed(8),
            4 => DataLength::List(1),
            5 => DataLength::List(2),
            6 => DataLength::List(4),
            7 => DataLength::List(8),
            _ => DataLength::Reserved,
        }
    }

    /// True for a procedure command, false for a parameter.
    #[must_use]
    pub const fn is_command(self) -> bool {
        self.0 & 1 << 19 != 0
    }

    /// Returns the type and display.
    #[must_use]
    pub const fn display(self) -> Display {
        match self.0 >> 20 & 7 {
            0 => Display::Binary,
            1 => Display::Unsigned,
            2 => Display::Signed,
            3 => Display::Hexadecimal,
            4 => Display::Text,
            5 => Display::Idn,
            6 => Display::Float,
            _ => Display::Time,
        }
    }

    /// Returns the number of decimal places, 0 to 15.
    #[must_use]
    pub const fn decimals(self) -> u8 {
        (self.0 >> 24 & 15) as u8
    }

    /// True if the value cannot be written in PreOp, SafeOp and Op.
    #[must_use]
    pub const fn write_protection(self) -> [bool; 3] {
        [
            self.0 & 1 << 28 != 0,
            self.0 & 1 << 29 != 0,
            self.0 & 1 << 30 != 0,
        ]
    }
}

/// The length, kind, decimal places and write protection: `4 bytes, signed, 3 decimals, read-only`.
impl fmt::Display for Attribute {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.length() {
            DataLength::Fixed(n) => write!(f, "{n} bytes")?,
            DataLength::List(1) => f.write_str("list of bytes")?,
            DataLength::List(n) => write!(f, "list of {n} bytes each")?,
            DataLength::Reserved => f.write_str("reserved length")?,
        }
        f.write_str(match self.display() {
            Display::Binary => ", binary",
            Display::Unsigned => ", unsigned",
            Display::Signed => ", signed",
            Display::Hexadecimal => ", hexadecimal",
            Display::Text => ", text",
            Display::Idn => ", IDN",
            Display::Float => ", float",
            Display::Time => ", time",
        })?;
        if self.is_command() {
            f.write_str(", procedure command")?;
        }
        if self.decimals() > 0 {
            write!(f, ", {} decimals", self.decimals())?;
        }
        f.write_str(match self.write_protection() {
            [false, false, false] => "",
            [true, true, true] => ", read-only",
            [false, true, true] => ", writable in PreOp",
            [false, false, true] => ", writable in PreOp and SafeOp",
            [false, true, false] => ", read-only in SafeOp",
            [true, true, false] => ", writable in Op",
            [true, false, false] => ", read-only in PreOp",
            [true, false, true] => ", writable in SafeOp",
        })
    }
}

/// The data state of an IDN.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct DataState(pub u16);

/// The state of a procedure command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum CommandState {
    /// Not set.
    Cleared,
    /// Set and enabled, not yet executed.
    Running,
    /// Set, not enabled.
    Interrupted,
    /// Executed correctly.
    Executed,
    /// An error ended it.
    Failed,
}

impl DataState {
    /// Bit 0: the procedure command is set.
    pub const SET: u16 = 1;
    /// Bit 1: its execution is enabled.
    pub const ENABLED: u16 = 1 << 1;
    /// Bit 2: it is not yet executed.
    pub const RUNNING: u16 = 1 << 2;
    /// Bit 3: it cannot be executed.
    pub const FAILED: u16 = 1 << 3;
    /// Bit 8: the value is invalid.
    pub const INVALID: u16 = 1 << 8;

    /// Returns the state of a procedure command.
    #[must_use]
    pub const fn command(self) -> CommandState {
        match self.0 & 15 {
            bits if bits & Self::FAILED != 0 => CommandState::Failed,
            bits if bits & Self::SET == 0 => CommandState::Cleared,
            bits if bits & Self::ENABLED == 0 => CommandState::Interrupted,
            bits if bits & Self::RUNNING != 0 => CommandState::Running,
            _ => CommandState::Executed,
        }
    }

    /// True if the value is valid.
    #[must_use]
    pub const fn is_valid(self) -> bool {
        self.0 & Self::INVALID == 0
    }
}

impl fmt::Display for CommandState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Cleared => "not set",
            Self::Running => "running",
            Self::Interrupted => "interrupted",
            Self::Executed => "executed",
            Self::Failed => "error",
        })
    }
}

/// A list element: two lengths in bytes, then the data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct List<'a> {
    /// The largest length in bytes.
    pub max: u16,
    /// The elements.
    pub data: &'a [u8],
}

impl<'a> List<'a> {
    /// The bytes of both lengths.
    pub const HEADER: usize = 4;

    /// Parses a list. Bytes behind the current length are dropped. `None` if it is incomplete.
    #[must_use]
    pub fn parse(bytes: &'a [u8]) -> Option<Self> {
        Self::split(bytes).map(|(list, _)| list)
    }

    /// Splits a list from the bytes that follow it.
    #[must_use]
    pub fn split(bytes: &'a [u8]) -> Option<(Self, &'a [u8])> {
        let (&[low, high, max_low, max_high], rest) = bytes.split_first_chunk()?;
        let (data, rest) = rest.split_at_checked(u16::from_le_bytes([low, high]).into())?;
        let max = u16::from_le_bytes([max_low, max_high]);
        Some((Self { max, data }, rest))
    }

    /// Returns both lengths, before the data.
    #[must_use]
    pub fn header(&self) -> [u8; 4] {
        let length = u16::try_from(self.data.len()).unwrap_or(u16::MAX);
        let ([a, b], [c, d]) = (length.to_le_bytes(), self.max.to_le_bytes());
        [a, b, c, d]
    }
}
