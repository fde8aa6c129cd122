//! Data types of objects: converts the names of ESI files and the codes of SDO Information.
//!
//! ```
//! use ecaxis_ecat::data_type::{DataType, Kind};
//!
//! let position = DataType::named("DINT", 0).expect("a base type");
//! assert_eq!((position.kind, position.bits), (Kind::Signed, 32));
//! assert_eq!(DataType::coded(0x0004, 32), position);
//! assert_eq!(position.show(&[0xfe, 0xff, 0xff, 0xff]), "-2");
//! ```

use core::fmt;

/// The interpretation of a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Kind {
    /// An unsigned integer, little-endian.
    Unsigned,
    /// A signed integer, little-endian, two's complement.
    Signed,
    /// IEEE 754 with 32 or 64 bits.
    Real,
    /// VISIBLE_STRING: one byte per character.
    Text,
    /// UNICODE_STRING: 16 bits per character, little-endian.
    Unicode,
    /// OCTET_STRING, arrays and unknown types.
    Bytes,
}

/// The type of one value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct DataType {
    /// How the bytes are read.
    pub kind: Kind,
    /// The length in bits, for strings and bytes the maximum; 0 if unknown.
    pub bits: u32,
}

/// Base types with their codes (ETG.1020, "Base Data Types"). The first of several names is the one
/// shown.
const BASE: [(&str, u16, Kind, u32); 52] = [
    ("BOOL", 0x0001, Kind::Unsigned, 1),
    ("USINT", 0x0005, Kind::Unsigned, 8),
    ("UINT", 0x0006, Kind::Unsigned, 16),
    ("UINT24", 0x0016, Kind::Unsigned, 24),
    ("UDINT", 0x0007, Kind::Unsigned, 32),
    ("UINT40", 0x0018, Kind::Unsigned, 40),
    ("UINT48", 0x0019, Kind::Unsigned, 48),
    ("UINT56", 0x001a, Kind::Unsigned, 56),
    ("ULINT", 0x001b, Kind::Unsigned, 64),
    ("SINT", 0x0002, Kind::Signed, 8),
    ("INT", 0x0003, Kind::Signed, 16),
    ("INT24", 0x0010, Kind::Signed, 24),
    ("DINT", 0x0004, Kind::Signed, 32),
    ("INT40", 0x0012, Kind::Signed, 40),
    ("INT48", 0x0013, Kind::Signed, 48),
    ("INT56", 0x0014, Kind::Signed, 56),
    ("LINT", 0x0015, Kind::Signed, 64),
    ("REAL", 0x0008, Kind::Real, 32),
    ("LREAL", 0x0011, Kind::Real, 64),
    ("STRING", 0x0009, Kind::Text, 0),
    ("UNICODE_STRING", 0x000b, Kind::Unicode, 0),
    ("OCTET_STRING", 0x000a, Kind::Bytes, 0),
    // Aliases, the names of CiA 301, and the short names of machine files.
    ("BIT", 0x0001, Kind::Unsigned, 1),
    ("BYTE", 0x001e, Kind::Unsigned, 8),
    ("WORD", 0x001f, Kind::Unsigned, 16),
    ("DWORD", 0x0020, Kind::Unsigned, 32),
    ("LWORD", 0, Kind::Unsigned, 64),
    ("BITARR8", 0x002d, Kind::Unsigned, 8),
    ("BITARR16", 0x002e, Kind::Unsigned, 16),
    ("BITARR32", 0x002f, Kind::Unsigned, 32),
    ("VISIBLE_STRING", 0x0009, Kind::Text, 0),
    ("ARRAY", 0, Kind::Bytes, 0),
    ("UNSIGNED8", 0, Kind::Unsigned, 8),
    ("UNSIGNED16", 0, Kind::Unsigned, 16),
    ("UNSIGNED32", 0, Kind::Unsigned, 32),
    ("UNSIGNED64", 0, Kind::Unsigned, 64),
    ("INTEGER8", 0, Kind::Signed, 8),
    ("INTEGER16", 0, Kind::Signed, 16),
    ("INTEGER32", 0, Kind::Signed, 32),
    ("INTEGER64", 0, Kind::Signed, 64),
    ("U8", 0, Kind::Unsigned, 8),
    ("U16", 0, Kind::Unsigned, 16),
    ("U32", 0, Kind::Unsigned, 32),
    ("U64", 0, Kind::Unsigned, 64),
    ("I8", 0, Kind::Signed, 8),
    ("I16", 0, Kind::Signed, 16),
    ("I32", 0, Kind::Signed, 32),
    ("I64", 0, Kind::Signed, 64),
    ("F32", 0, Kind::Real, 32),
    ("F64", 0, Kind::Real, 64),
    ("TEXT", 0, Kind::Text, 0),
    ("BYTES", 0, Kind::Bytes, 0),
];

/// BIT1 to BIT16.
const BITS: u16 = 0x002f;

impl DataType {
    /// Bytes of unknown length.
    pub const BYTES: Self = Self {
        kind: Kind::Bytes,
        bits: 0,
    };

    /// Returns the type by its ETG.2000 name or short name such as `u16`. `bits` is the item's
    /// length, 0 if unknown. `None` if neither determines the type.
    #[must_use]
    pub fn named(name: &str, bits: u32) -> Option<Self> {
        let (stem, rest) = split(name);
        if let Some((.., kind, own)) = base(stem) {
            let reported = match kind {
                Kind::Text | Kind::Unicode | Kind::Bytes => length(rest).map(|n| match kind {
                    Kind::Unicode => n.saturating_mul(16),
                    _ => n.saturating_mul(8),
                }),
                _ => None,
            };
            return Some(Self {
                kind: *kind,
                bits: match own {
                    0 if bits > 0 => bits,
                    0 => reported.unwrap_or(0),
                    own => *own,
                },
            });
        }
        match bit_field(stem) {
            Some(n) => Some(Self {
                kind: Kind::Unsigned,
                bits: n,
            }),
            _ if bits > 0 => Some(Self::unknown(bits)),
            _ => None,
        }
    }

    /// Returns the type by its SDO Information code.
    #[must_use]
    pub fn coded(code: u16, bits: u32) -> Self {
        if (BITS + 1..=BITS + 16).contains(&code) {
            return Self {
                kind: Kind::Unsigned,
                bits: u32::from(code - BITS),
            };
        }
        match BASE
            .iter()
            .find(|(_, known, ..)| *known == code && code != 0)
        {
            // If code and length contradict each other, the length is right: the device sends that
            // many bytes.
            Some((.., kind, own)) if *own == 0 || *own == bits => Self { kind: *kind, bits },
            _ => Self::unknown(bits),
        }
    }

    /// Treats an unknown type as a number if its length allows it.
    fn unknown(bits: u32) -> Self {
        let kind = match bits {
            1..=64 => Kind::Unsigned,
            _ => Kind::Bytes,
        };
        Self { kind, bits }
    }

    /// Returns the length of a number in bytes; `None` if the length varies.
    #[must_use]
    pub fn width(self) -> Option<usize> {
        match self.kind {
            Kind::Unsigned | Kind::Signed | Kind::Real => {
                usize::try_from(self.bits.div_ceil(8)).ok()
            }
            Kind::Text | Kind::Unicode | Kind::Bytes => None,
        }
    }
}

/// Returns the code of a base type in SDO Information and in the EEPROM, or 0 for other names.
#[must_use]
pub fn code(name: &str) -> u16 {
    let (stem, _) = split(name);
    match (base(stem), bit_field(stem)) {
        (Some((_, code, ..)), _) => *code,
        (None, Some(bits @ 1..=16)) => BITS + bits as u16,
        _ => 0,
    }
}

fn base(stem: &str) -> Option<&'static (&'static str, u16, Kind, u32)> {
    BASE.iter()
        .find(|(known, ..)| known.eq_ignore_ascii_case(stem))
}

/// Splits `STRING(12)` and `ARRAY [0..9] OF BYTE` after the name.
fn split(name: &str) -> (&str, &str) {
    let name = name.trim();
    name.split_at(name.find(['(', '[', ' ']).unwrap_or(name.len()))
}

/// Returns the length of `BIT12`.
fn bit_field(stem: &str) -> Option<u32> {
    let (bit, number) = stem.split_at_checked(3)?;
    let bits = number.parse().ok()?;
    (bit.eq_ignore_ascii_case("BIT") && (1..=64).contains(&bits)).then_some(bits)
}

/// Parses the number in `(12)`.
fn length(text: &str) -> Option<u32> {
    text.strip_prefix('(')?
        .split(')')
        .next()?
        .trim()
        .parse()
        .ok()
}

impl fmt::Display for DataType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kind, bits } = *self;
        let base = BASE
            .iter()
            .find(|(_, _, k, own)| *k == kind && (*own == bits || *own == 0));
        match (base, kind) {
            (Some((name, ..)), Kind::Text | Kind::Bytes) if bits > 0 => {
                write!(f, "{name}({})", bits.div_ceil(8))
            }
            (Some((name, ..)), Kind::Unicode) if bits > 0 => {
                write!(f, "{name}({})", bits.div_ceil(16))
            }
            (Some((name, ..)), _) => f.write_str(name),
            (None, _) => write!(f, "BIT{bits}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn named(name: &str, bits: u32) -> DataType {
        DataType::named(name, bits).expect("a type")
    }

    #[test]
    fn every_base_type_by_name_and_code() {
        for (name, code, kind, own) in BASE {
            let bits = if own == 0 { 80 } else { own };
            assert_eq!(named(name, bits), DataType { kind, bits }, "{name}");
            assert_eq!(named(&name.to_lowercase(), bits), named(name, bits));
            if code != 0 {
                assert_eq!(DataType::coded(code, bits), named(name, bits), "{name}");
                assert_eq!(super::code(name), code, "{name}");
            }
        }
        for bits in 1..=16 {
            assert_eq!(
                DataType::coded(0x2f + bits, u32::from(bits)).bits,
                u32::from(bits)
            );
        }
    }

    #[test]
    fn codes_of_names_outside_the_table() {
        // ETG.1020, "Base Data Types": BIT1 is 0x0030, BIT16 is 0x003f.
        for (name, expected) in [
            ("BIT1", 0x0030),
            ("BIT8", 0x0037),
            ("BIT16", 0x003f),
            ("BIT17", 0),
            ("STRING(12)", 0x0009),
            ("int48", 0x0013),
            ("ARRAY [0..9] OF BYTE", 0),
            ("DT1234", 0),
            ("", 0),
            ("µm", 0),
        ] {
            assert_eq!(code(name), expected, "{name}");
        }
    }

    #[test]
    fn data_types_round_trip_through_names() {
        for text in [
            "BOOL",
            "BIT2",
            "BIT11",
            "USINT",
            "UINT24",
            "ULINT",
            "SINT",
            "INT48",
            "LINT",
            "REAL",
            "LREAL",
            "STRING",
            "STRING(12)",
            "UNICODE_STRING(4)",
            "OCTET_STRING(64)",
        ] {
            assert_eq!(named(text, 0).to_string(), text);
        }
        assert_eq!(
            named("ARRAY [0..9] OF BYTE", 80).to_string(),
            "OCTET_STRING(10)"
        );
        assert_eq!(named("VISIBLE_STRING(3)", 0).to_string(), "STRING(3)");
    }

    #[test]
    fn unknown_types_are_numbers_if_possible() {
        assert_eq!(named("DT1234", 12).to_string(), "BIT12");
        assert_eq!(named("DT1234", 32).to_string(), "UDINT");
        assert_eq!(named("DT1234", 96).kind, Kind::Bytes);
        assert_eq!(DataType::named("DT1234", 0), None);
        assert_eq!(DataType::coded(0x0800, 8).to_string(), "USINT");
        // A DINT with 16 bits.
        assert_eq!(DataType::coded(0x0004, 16).to_string(), "UINT");
    }
}
