//! Objects of the object dictionary: addresses and names.
//!
//! ```
//! use ecaxis_ecat::object::{NamedObject, address};
//!
//! assert_eq!(address(0x60c2, 1).to_string(), "0x60c2:01");
//! let object = NamedObject { index: 0x6041, sub: 0 };
//! assert_eq!(object.to_string(), "0x6041:00 (Statusword)");
//! ```

use core::fmt;

use crate::object_names::name;

/// Index and subindex of an object, shown as `0x60c2:01`. Both are hexadecimal: `0x1600:10` is the
/// sixteenth entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Address {
    /// The index.
    pub index: u16,
    /// The subindex.
    pub sub: u8,
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "0x{:04x}:{:02x}", self.index, self.sub)
    }
}

/// Returns the address of an object.
#[must_use]
pub fn address(index: u16, sub: u8) -> Address {
    Address { index, sub }
}

impl Address {
    /// Parses the text after the colon: one or two hexadecimal digits, with or without `0x`.
    #[must_use]
    pub fn sub_of(text: &str) -> Option<u8> {
        let text = text.trim();
        let digits = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X"));
        let digits = digits.unwrap_or(text);
        let whole =
            (1..=2).contains(&digits.len()) && digits.chars().all(|c| c.is_ascii_hexdigit());
        whole.then(|| u8::from_str_radix(digits, 16).ok()).flatten()
    }
}

/// index:subindex; displayed with its name if it is known here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct NamedObject {
    /// The index.
    pub index: u16,
    /// The subindex.
    pub sub: u8,
}

impl NamedObject {
    /// Returns the address without the name.
    #[must_use]
    pub fn number(self) -> Address {
        address(self.index, self.sub)
    }
}

impl fmt::Display for NamedObject {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.number())?;
        match object_name(self.index, self.sub) {
            Some(name) => write!(f, " ({name})"),
            None => Ok(()),
        }
    }
}

/// Returns the name of a known object: of the communication area, of CiA 402 and of modular
/// devices.
#[must_use]
pub fn object_name(index: u16, sub: u8) -> Option<&'static str> {
    name(index, sub)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn address_text_round_trips_for_every_subindex() {
        for sub in 0..=u8::MAX {
            let shown = address(0x1600, sub).to_string();
            let (index, behind) = shown.split_once(':').unwrap();
            assert_eq!(index, "0x1600");
            assert_eq!(behind.len(), 2);
            assert_eq!(Address::sub_of(behind), Some(sub), "{shown}");
            assert_eq!(Address::sub_of(&format!("0x{behind}")), Some(sub));
        }
        assert_eq!(Address::sub_of("a"), Some(10));
        assert_eq!(Address::sub_of("10"), Some(16));
        for wrong in ["", "0x", "100", "001", "+1", "-1", "g", "1 0", "0x0x1"] {
            assert_eq!(Address::sub_of(wrong), None, "{wrong}");
        }
    }
}
