//! Values as text: numbers, strings and bytes, by type. Printed values can be parsed again without
//! loss.
//!
//! A value whose length or bits do not fit its type is printed as raw bytes in brackets, `[01 02]`.
//! This form is accepted for every type.
//!
//! ```
//! use ecaxis_ecat::data_type::DataType;
//!
//! let velocity = DataType::named("DINT", 0).expect("a base type");
//! let bytes = velocity.read("-2").expect("a number of 32 bits");
//! assert_eq!(bytes, [0xfe, 0xff, 0xff, 0xff]);
//! assert_eq!(velocity.show(&bytes), "-2");
//! assert!(velocity.read("0x1_0000_0000").is_err());
//! ```

use alloc::borrow::ToOwned;
use alloc::format;
use alloc::string::{String, ToString};
use alloc::vec::Vec;

use crate::data_type::{DataType, Kind};

/// An error in a value's text.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ValueError {
    /// A number outside the range of the type.
    #[error("{value} does not fit; the object takes {least} to {most}")]
    Range {
        /// The number as written.
        value: String,
        /// The smallest number of the type.
        least: i128,
        /// The largest number of the type.
        most: i128,
    },
    /// Text of another kind than the type.
    #[error("the object takes {wanted}, not {found}")]
    Misfit {
        /// What the type takes.
        wanted: String,
        /// The text that was found.
        found: String,
    },
    /// A quoted text without its end, or with an unknown escape.
    #[error(
        "`{0}` is not finished: a text in quotes ends with one, and \\ comes before \", \\, xNN or uNNNN"
    )]
    Escape(String),
}

impl DataType {
    /// Formats the value.
    #[must_use]
    pub fn show(self, bytes: &[u8]) -> String {
        let shown = match self.kind {
            Kind::Unsigned => self.integer(bytes).map(|n| match self.bits {
                1 => (n != 0).to_string(),
                _ => n.to_string(),
            }),
            Kind::Signed => self.integer(bytes).map(|n| n.to_string()),
            Kind::Real if Some(bytes.len()) == self.width() => real(bytes),
            Kind::Real => None,
            Kind::Text => Some(text(bytes)),
            Kind::Unicode => unicode(bytes),
            Kind::Bytes if bytes.is_empty() => None,
            Kind::Bytes => Some(hex(bytes)),
        };
        shown.unwrap_or_else(|| format!("[{}]", hex(bytes)))
    }

    /// Returns the sign-extended number; `None` if the bytes are not a number of this type.
    #[must_use]
    pub fn integer(self, bytes: &[u8]) -> Option<i128> {
        if !matches!(self.kind, Kind::Unsigned | Kind::Signed)
            || Some(bytes.len()) != self.width()
            || bytes.len() > 8
        {
            return None;
        }
        let mut raw = [0; 16];
        for (to, from) in raw.iter_mut().zip(bytes) {
            *to = *from;
        }
        let number = i128::from_le_bytes(raw);
        if number >> self.bits != 0 {
            return None;
        }
        let negative = self.kind == Kind::Signed && number >> self.bits.saturating_sub(1) != 0;
        Some(if negative {
            number - (1 << self.bits)
        } else {
            number
        })
    }

    /// Parses a value.
    ///
    /// # Errors
    /// [`ValueError`] with a message for the user.
    pub fn read(self, written: &str) -> Result<Vec<u8>, ValueError> {
        let trimmed = written.trim();
        if let Some(raw) = bracketed(trimmed) {
            return Ok(raw);
        }
        match self.kind {
            Kind::Unsigned | Kind::Signed => self.read_integer(trimmed),
            Kind::Real => self.read_real(trimmed),
            Kind::Text if trimmed.starts_with('"') => unquote(trimmed),
            Kind::Text => Ok(written.as_bytes().to_vec()),
            Kind::Unicode if trimmed.starts_with('"') => unquote_unicode(trimmed),
            Kind::Unicode => Ok(little_endian(written.encode_utf16())),
            Kind::Bytes if trimmed.starts_with('"') => unquote(trimmed),
            Kind::Bytes => pairs(trimmed).ok_or_else(|| self.type_mismatch(trimmed)),
        }
    }

    fn read_integer(self, text: &str) -> Result<Vec<u8>, ValueError> {
        let width = self.width().unwrap_or(8);
        if text.starts_with('"') {
            let bytes = unquote(text)?;
            return match bytes.len() == width {
                true => Ok(bytes),
                false => Err(self.type_mismatch(text)),
            };
        }
        let (least, most) = match self.kind {
            Kind::Signed => (
                -(1_i128 << (self.bits - 1)),
                (1_i128 << (self.bits - 1)) - 1,
            ),
            _ => (0, (1_i128 << self.bits) - 1),
        };
        let number = match (digits(text), text) {
            // Hexadecimal and binary numbers are bit patterns, signed or not.
            (Some(pattern), _) if pattern >> self.bits == 0 => pattern,
            (Some(pattern), _) => {
                return Err(ValueError::Range {
                    value: format!("{pattern:#x}"),
                    least,
                    most,
                });
            }
            (None, "true") if self.bits == 1 => 1,
            (None, "false") if self.bits == 1 => 0,
            (None, _) => {
                let number: i128 = text.parse().map_err(|_| self.type_mismatch(text))?;
                if !(least..=most).contains(&number) {
                    return Err(ValueError::Range {
                        value: number.to_string(),
                        least,
                        most,
                    });
                }
                number & ((1 << self.bits) - 1)
            }
        };
        Ok(number.to_le_bytes().into_iter().take(width).collect())
    }

    fn read_real(self, text: &str) -> Result<Vec<u8>, ValueError> {
        let misfit = || self.type_mismatch(text);
        let pattern = digits(text).map(u64::try_from);
        Ok(match (self.bits, pattern) {
            (32, Some(Ok(pattern))) => {
                let pattern = u32::try_from(pattern).map_err(|_| misfit())?;
                pattern.to_le_bytes().to_vec()
            }
            (32, None) => real_of::<f32>(text)
                .ok_or_else(misfit)?
                .to_le_bytes()
                .to_vec(),
            (_, Some(Ok(pattern))) => pattern.to_le_bytes().to_vec(),
            (_, None) => real_of::<f64>(text)
                .ok_or_else(misfit)?
                .to_le_bytes()
                .to_vec(),
            (_, Some(Err(_))) => return Err(misfit()),
        })
    }

    fn type_mismatch(self, found: &str) -> ValueError {
        let wanted = match self.kind {
            Kind::Unsigned if self.bits == 1 => "true or false".to_owned(),
            Kind::Unsigned | Kind::Signed => format!("an integer of {} bits", self.bits),
            Kind::Real => "a number".to_owned(),
            Kind::Text | Kind::Unicode => "a text".to_owned(),
            Kind::Bytes => "bytes, such as `01 a2`".to_owned(),
        };
        let number = found.parse::<f64>().is_ok();
        ValueError::Misfit {
            wanted,
            found: match number {
                true => found.to_owned(),
                false => format!("`{found}`"),
            },
        }
    }
}

/// Parses numbers that are not decimal.
fn digits(text: &str) -> Option<i128> {
    let (radix, digits) = [(16, "0x"), (16, "0X"), (16, "#x"), (2, "0b"), (8, "0o")]
        .iter()
        .find_map(|(radix, prefix)| Some((*radix, text.strip_prefix(prefix)?)))?;
    let plain = !digits.is_empty() && digits.chars().all(|c| c.is_digit(radix));
    plain.then(|| i128::from_str_radix(digits, radix).ok())?
}

/// Parses a float. NaN is accepted only if it is written as such.
fn real_of<T: core::str::FromStr>(text: &str) -> Option<T> {
    let known = matches!(text, "nan" | "inf" | "-inf" | "+inf");
    let plain = text
        .chars()
        .all(|c| c.is_ascii_digit() || matches!(c, '+' | '-' | '.' | 'e' | 'E'));
    (known || plain).then(|| text.parse().ok())?
}

/// Formats a float. Non-standard NaNs are formatted as bit patterns.
fn real(bytes: &[u8]) -> Option<String> {
    let shown = |text: String| text.replace("NaN", "nan");
    if let Ok(raw) = <[u8; 4]>::try_from(bytes) {
        let (value, bits) = (f32::from_le_bytes(raw), u32::from_le_bytes(raw));
        let odd = value.is_nan() && bits != 0x7fc0_0000;
        return Some(if odd {
            format!("{bits:#x}")
        } else {
            shown(format!("{value:?}"))
        });
    }
    let raw = <[u8; 8]>::try_from(bytes).ok()?;
    let (value, bits) = (f64::from_le_bytes(raw), u64::from_le_bytes(raw));
    let odd = value.is_nan() && bits != 0x7ff8_0000_0000_0000;
    Some(if odd {
        format!("{bits:#x}")
    } else {
        shown(format!("{value:?}"))
    })
}

fn hex(bytes: &[u8]) -> String {
    let pairs: Vec<String> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    pairs.join(" ")
}

/// True if the text needs no quotes: nothing is lost or ambiguous without them.
fn is_unambiguous_text(text: &str) -> bool {
    !text.is_empty()
        && text.trim() == text
        && !text.starts_with(['"', '['])
        && !text.chars().any(char::is_control)
}

fn text(bytes: &[u8]) -> String {
    if let Ok(text) = core::str::from_utf8(bytes)
        && is_unambiguous_text(text)
    {
        return text.to_owned();
    }
    let mut out = String::from("\"");
    for chunk in bytes.utf8_chunks() {
        for c in chunk.valid().chars() {
            match c {
                '"' | '\\' => out.extend(['\\', c]),
                _ if c.is_control() => {
                    let mut room = [0; 4];
                    let bytes = c.encode_utf8(&mut room).bytes();
                    out.extend(bytes.map(|byte| format!("\\x{byte:02x}")));
                }
                _ => out.push(c),
            }
        }
        let odd = chunk.invalid().iter();
        out.extend(odd.map(|byte| format!("\\x{byte:02x}")));
    }
    out + "\""
}

fn unicode(bytes: &[u8]) -> Option<String> {
    let (units, []) = bytes.as_chunks::<2>() else {
        return None;
    };
    let units = units.iter().map(|unit| u16::from_le_bytes(*unit));
    let decoded: Vec<_> = char::decode_utf16(units).collect();
    let plain: Result<String, _> = decoded.iter().cloned().collect();
    if let Ok(text) = plain
        && is_unambiguous_text(&text)
    {
        return Some(text);
    }
    let mut out = String::from("\"");
    for unit in decoded {
        match unit {
            Ok(c @ ('"' | '\\')) => out.extend(['\\', c]),
            Ok(c) if c.is_control() => out += &format!("\\u{:04x}", u32::from(c)),
            Ok(c) => out.push(c),
            Err(odd) => out += &format!("\\u{:04x}", odd.unpaired_surrogate()),
        }
    }
    Some(out + "\"")
}

fn little_endian(units: impl Iterator<Item = u16>) -> Vec<u8> {
    units.flat_map(u16::to_le_bytes).collect()
}

/// Parses `[01 02]`, also with 0x and commas.
fn bracketed(text: &str) -> Option<Vec<u8>> {
    let inside = text.strip_prefix('[')?.strip_suffix(']')?;
    let parts = inside.split([' ', ',']).filter(|part| !part.is_empty());
    parts.map(byte).collect()
}

fn byte(part: &str) -> Option<u8> {
    let digits = part.strip_prefix("0x").unwrap_or(part);
    let plain = (1..=2).contains(&digits.len()) && digits.chars().all(|c| c.is_ascii_hexdigit());
    plain.then(|| u8::from_str_radix(digits, 16).ok())?
}

/// Parses `01 02`, `01,02` or `0102`.
fn pairs(text: &str) -> Option<Vec<u8>> {
    if text.contains([' ', ',']) || text.starts_with("0x") && text.len() <= 4 {
        return bracketed(&format!("[{text}]"));
    }
    let digits = text.strip_prefix("0x").unwrap_or(text).as_bytes();
    let (chunks, []) = digits.as_chunks::<2>() else {
        return None;
    };
    let each = chunks
        .iter()
        .map(|pair| byte(core::str::from_utf8(pair).ok()?));
    let bytes: Vec<u8> = each.collect::<Option<_>>()?;
    (!bytes.is_empty()).then_some(bytes)
}

/// Parts of a quoted string: literal text, or characters by number.
enum StringPart {
    Char(char),
    Byte(u8),
    Unit(u16),
}

fn pieces(text: &str) -> Result<Vec<StringPart>, ValueError> {
    let broken = || ValueError::Escape(text.to_owned());
    let inside = text.strip_prefix('"').ok_or_else(broken)?;
    let mut chars = inside.chars();
    let mut out = Vec::new();
    let number = |chars: &mut core::str::Chars<'_>, digits: usize| {
        let (number, rest) = chars.as_str().split_at_checked(digits)?;
        *chars = rest.chars();
        let plain = number.chars().all(|c| c.is_ascii_hexdigit());
        plain.then(|| u16::from_str_radix(number, 16).ok())?
    };
    loop {
        out.push(match chars.next().ok_or_else(broken)? {
            '"' if chars.as_str().is_empty() => return Ok(out),
            '"' => return Err(broken()),
            '\\' => match chars.next().ok_or_else(broken)? {
                c @ ('"' | '\\') => StringPart::Char(c),
                'n' => StringPart::Char('\n'),
                'r' => StringPart::Char('\r'),
                't' => StringPart::Char('\t'),
                '0' => StringPart::Char('\0'),
                'x' => {
                    let byte = number(&mut chars, 2).and_then(|n| u8::try_from(n).ok());
                    StringPart::Byte(byte.ok_or_else(broken)?)
                }
                'u' => StringPart::Unit(number(&mut chars, 4).ok_or_else(broken)?),
                _ => return Err(broken()),
            },
            c => StringPart::Char(c),
        });
    }
}

fn unquote(text: &str) -> Result<Vec<u8>, ValueError> {
    let mut out = Vec::new();
    for piece in pieces(text)? {
        match piece {
            StringPart::Char(c) => out.extend(c.encode_utf8(&mut [0; 4]).bytes()),
            StringPart::Byte(byte) => out.push(byte),
            StringPart::Unit(unit) => {
                let c = char::from_u32(u32::from(unit));
                let c = c.ok_or_else(|| ValueError::Escape(text.to_owned()))?;
                out.extend(c.encode_utf8(&mut [0; 4]).bytes());
            }
        }
    }
    Ok(out)
}

fn unquote_unicode(text: &str) -> Result<Vec<u8>, ValueError> {
    let mut units = Vec::new();
    for piece in pieces(text)? {
        match piece {
            StringPart::Char(c) => units.extend(c.encode_utf16(&mut [0; 2]).iter().copied()),
            StringPart::Byte(byte) => units.push(u16::from(byte)),
            StringPart::Unit(unit) => units.push(unit),
        }
    }
    Ok(little_endian(units.into_iter()))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn ty(name: &str) -> DataType {
        DataType::named(name, 0).expect("a type")
    }

    #[test]
    fn show_formats_values_by_type() {
        for (name, bytes, shown) in [
            ("BOOL", &[1][..], "true"),
            ("BOOL", &[2], "[02]"),
            ("USINT", &[200], "200"),
            ("SINT", &[0xfd], "-3"),
            ("UINT", &[0x50, 2], "592"),
            ("UINT", &[0x50, 2, 0, 0], "[50 02 00 00]"),
            ("BIT3", &[5], "5"),
            ("BIT3", &[9], "[09]"),
            ("INT24", &[0xfe, 0xff, 0xff], "-2"),
            ("ULINT", &[0xff; 8], "18446744073709551615"),
            ("LINT", &[0xff; 8], "-1"),
            ("REAL", &[0, 0, 0xc0, 0x3f], "1.5"),
            ("REAL", &[1, 0, 0xc0, 0x7f], "0x7fc00001"),
            ("LREAL", &[0, 0, 0, 0, 0, 0, 0xf0, 0xff], "-inf"),
            ("STRING", b"EPOS4", "EPOS4"),
            ("STRING", b"EPOS4\0\0", r#""EPOS4\x00\x00""#),
            ("STRING", b"", r#""""#),
            ("STRING", b"\xb5m", r#""\xb5m""#),
            ("STRING", b"[1]", r#""[1]""#),
            ("UNICODE_STRING", &[0xb5, 0, b'm', 0], "µm"),
            ("UNICODE_STRING", &[0, 0xd8], r#""\ud800""#),
            ("UNICODE_STRING", &[1], "[01]"),
            ("OCTET_STRING", &[1, 0xa2], "01 a2"),
            ("OCTET_STRING", &[], "[]"),
        ] {
            assert_eq!(ty(name).show(bytes), shown, "{name}");
            assert_eq!(ty(name).read(shown).as_deref(), Ok(bytes), "{name} {shown}");
        }
    }

    #[test]
    fn read_accepts_common_notations() {
        for (name, written, bytes) in [
            ("UINT", "0x0250", &[0x50, 2][..]),
            ("UINT", " 592 ", &[0x50, 2]),
            ("INT", "0xFFFF", &[0xff, 0xff]),
            ("USINT", "0b101", &[5]),
            ("UDINT", "\"save\"", b"save"),
            ("UDINT", "[1, 0x2, 3, 4]", &[1, 2, 3, 4]),
            ("BOOL", "1", &[1]),
            ("BOOL", "false", &[0]),
            ("REAL", "1", &[0, 0, 0x80, 0x3f]),
            ("REAL", "-1.5e0", &[0, 0, 0xc0, 0xbf]),
            ("STRING", "two words", b"two words"),
            ("OCTET_STRING", "01a2", &[1, 0xa2]),
            ("OCTET_STRING", "0x01 0xa2", &[1, 0xa2]),
            ("OCTET_STRING", "0xa2", &[0xa2]),
            ("OCTET_STRING", "\"ab\"", b"ab"),
        ] {
            assert_eq!(
                ty(name).read(written).as_deref(),
                Ok(bytes),
                "{name} {written}"
            );
        }
    }

    #[test]
    fn read_rejects_values_that_do_not_fit() {
        for (name, written, reported) in [
            (
                "USINT",
                "256",
                "256 does not fit; the object takes 0 to 255",
            ),
            ("USINT", "-1", "-1 does not fit; the object takes 0 to 255"),
            (
                "SINT",
                "128",
                "128 does not fit; the object takes -128 to 127",
            ),
            (
                "SINT",
                "0x100",
                "0x100 does not fit; the object takes -128 to 127",
            ),
            (
                "UINT",
                "1.5",
                "the object takes an integer of 16 bits, not 1.5",
            ),
            ("UINT", "", "the object takes an integer of 16 bits, not ``"),
            (
                "UDINT",
                "\"sav\"",
                "the object takes an integer of 32 bits, not `\"sav\"`",
            ),
            ("BOOL", "yes", "the object takes true or false, not `yes`"),
            (
                "REAL",
                "infinity",
                "the object takes a number, not infinity",
            ),
            (
                "OCTET_STRING",
                "0102a",
                "the object takes bytes, such as `01 a2`, not `0102a`",
            ),
        ] {
            let error = ty(name).read(written).unwrap_err();
            assert_eq!(error.to_string(), reported, "{name} {written}");
        }
        for broken in [
            "\"a",
            "\"a\\\"",
            "\"\\x4\"",
            "\"a\"b\"",
            "\"\\q\"",
            "\"\\u12é\"",
        ] {
            let error = ty("STRING").read(broken).unwrap_err();
            assert_eq!(error, ValueError::Escape(broken.to_owned()));
        }
    }

    fn any_type() -> impl Strategy<Value = DataType> {
        let kinds = [Kind::Text, Kind::Unicode, Kind::Bytes];
        prop_oneof![
            (1_u32..=64).prop_map(|bits| DataType {
                kind: Kind::Unsigned,
                bits
            }),
            (1_u32..=8).prop_map(|n| DataType {
                kind: Kind::Signed,
                bits: 8 * n
            }),
            prop::sample::select(vec![32, 64]).prop_map(|bits| DataType {
                kind: Kind::Real,
                bits
            }),
            prop::sample::select(kinds.to_vec()).prop_map(|kind| DataType { kind, bits: 0 }),
        ]
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 4000, failure_persistence: None, ..ProptestConfig::default() })]

        /// Bytes of the type's length, or of any length.
        #[test]
        fn read_accepts_shown_values(
            ty in any_type(),
            mut bytes in prop::collection::vec(any::<u8>(), 0..12),
            own: bool,
        ) {
            if let (true, Some(width)) = (own, ty.width()) {
                bytes.resize(width, 0x5a);
            }
            prop_assert_eq!(ty.read(&ty.show(&bytes)), Ok(bytes));
        }

        #[test]
        fn read_accepts_shown_texts(text in "\\PC{0,12}|[\"\\\\\\[ x0-9\n]{0,8}", unicode: bool) {
            let (ty, bytes) = match unicode {
                true => (ty("UNICODE_STRING"), little_endian(text.encode_utf16())),
                false => (ty("STRING"), text.into_bytes()),
            };
            prop_assert_eq!(ty.read(&ty.show(&bytes)), Ok(bytes));
        }

        #[test]
        fn read_never_panics(ty in any_type(), written in "\\PC{0,16}") {
            let _ = ty.read(&written);
        }
    }
}
