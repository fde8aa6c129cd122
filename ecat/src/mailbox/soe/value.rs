//! Values of IDNs as text, by their attributes.

use alloc::format;
use alloc::string::{String, ToString};
use alloc::vec::Vec;

use super::{Attribute, DataLength, Display, Idn, List};

/// Why a text is not a value of an IDN.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ValueError {
    /// The text is not a number of this kind.
    #[error("`{text}` is not {expected}")]
    Kind {
        /// The text.
        text: String,
        /// What is expected.
        expected: &'static str,
    },
    /// The number does not fit.
    #[error("`{text}` does not fit into {bytes} bytes")]
    Range {
        /// The text.
        text: String,
        /// The length of a value.
        bytes: usize,
    },
    /// A list is longer than 65535 bytes.
    #[error("{0} bytes are more than a list holds (65535)")]
    TooLong(usize),
    /// The attribute has a reserved length.
    #[error("the drive reports no length of the value")]
    Length,
}

/// Returns a value as text; lists with `, ` between their elements. Bytes that contradict the
/// attribute are shown in hexadecimal.
#[must_use]
pub fn format_value(attribute: Attribute, bytes: &[u8]) -> String {
    let (data, width) = match attribute.length() {
        DataLength::Fixed(width) if bytes.len() == width => (bytes, width),
        DataLength::List(width) => match List::parse(bytes) {
            Some(list) if list.data.len() % width == 0 => (list.data, width),
            _ => return hex(bytes),
        },
        _ => return hex(bytes),
    };
    if attribute.display() == Display::Text {
        return text(data);
    }
    let all: Vec<String> = data
        .chunks_exact(width)
        .map(|one| format_one(attribute, one))
        .collect();
    all.join(", ")
}

fn hex(bytes: &[u8]) -> String {
    let all: Vec<String> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    format!("[{}]", all.join(" "))
}

/// Returns text without control characters. The standard demands ASCII; others appear as U+FFFD.
fn text(bytes: &[u8]) -> String {
    let text = String::from_utf8_lossy(bytes);
    let shown = text.chars().filter(|c| !c.is_control());
    shown.collect::<String>().trim_end().to_string()
}

fn number(bytes: &[u8]) -> u64 {
    let bytes = bytes.iter().rev();
    bytes.fold(0, |value, byte| value << 8 | u64::from(*byte))
}

fn signed(bytes: &[u8]) -> i64 {
    let unused = 64 - 8 * u32::try_from(bytes.len().clamp(1, 8)).unwrap_or(8);
    (number(bytes) << unused).cast_signed() >> unused
}

fn format_one(attribute: Attribute, bytes: &[u8]) -> String {
    match attribute.display() {
        Display::Binary => {
            let bits = bytes.len() * 8;
            format!("0b{:0bits$b}", number(bytes))
        }
        Display::Unsigned => decimal(number(bytes).into(), attribute.decimals()),
        Display::Signed => decimal(signed(bytes).into(), attribute.decimals()),
        Display::Idn if bytes.len() == 2 => Idn(number(bytes) as u16).to_string(),
        Display::Float => match *bytes {
            [a, b, c, d] => f32::from_le_bytes([a, b, c, d]).to_string(),
            [..] if bytes.len() == 8 => f64::from_bits(number(bytes)).to_string(),
            _ => hex(bytes),
        },
        Display::Time if bytes.len() == 8 => {
            let value = number(bytes);
            format!("{}.{:09} s", value >> 32, value & 0xffff_ffff)
        }
        _ => format!("0x{:0width$x}", number(bytes), width = bytes.len() * 2),
    }
}

fn decimal(value: i128, decimals: u8) -> String {
    if decimals == 0 {
        return value.to_string();
    }
    let power = 10_i128.pow(u32::from(decimals.min(15)));
    let sign = if value < 0 { "-" } else { "" };
    let (whole, part) = (value.abs() / power, value.abs() % power);
    format!(
        "{sign}{whole}.{part:0width$}",
        width = usize::from(decimals)
    )
}

/// Returns the bytes of a value. Elements of a list are separated by `,`; lists get their lengths.
///
/// # Errors
/// [`ValueError`] if the text does not fit the attribute.
pub fn parse_value(attribute: Attribute, text: &str) -> Result<Vec<u8>, ValueError> {
    match attribute.length() {
        DataLength::Reserved => Err(ValueError::Length),
        DataLength::Fixed(width) => parse_one(attribute, text.trim(), width),
        DataLength::List(width) => {
            let mut data = Vec::new();
            if attribute.display() == Display::Text {
                data.extend_from_slice(text.as_bytes());
            } else {
                let parts = text.split([',', ' ']).filter(|part| !part.is_empty());
                for part in parts {
                    data.extend(parse_one(attribute, part, width)?);
                }
            }
            let length = u16::try_from(data.len()).map_err(|_| ValueError::TooLong(data.len()))?;
            let list = List {
                max: length,
                data: &data,
            };
            Ok([&list.header()[..], &data].concat())
        }
    }
}

fn parse_one(attribute: Attribute, text: &str, width: usize) -> Result<Vec<u8>, ValueError> {
    let kind = |expected| ValueError::Kind {
        text: text.to_string(),
        expected,
    };
    if attribute.display() == Display::Idn
        && let Ok(idn) = text.parse::<Idn>()
    {
        return fit(idn.0.into(), text, width);
    }
    if attribute.display() == Display::Float {
        let value: f64 = text.parse().map_err(|_| kind("a number"))?;
        return Ok(match width {
            8 => value.to_le_bytes().to_vec(),
            _ => (value as f32).to_le_bytes().to_vec(),
        });
    }
    let (digits, negative) = match text.strip_prefix('-') {
        Some(rest) => (rest, true),
        None => (text, false),
    };
    let lower = digits.to_ascii_lowercase();
    let radix = |digits: &str, radix| i128::from_str_radix(digits, radix).ok();
    let value = match (lower.strip_prefix("0x"), lower.strip_prefix("0b")) {
        (Some(hex), _) => radix(hex, 16),
        (_, Some(binary)) => radix(&binary.replace('_', ""), 2),
        _ => scaled(digits, attribute.decimals()),
    };
    let expected = match attribute.display() {
        Display::Idn => "an IDN (S-0-0047)",
        _ => "a number",
    };
    let value = value.ok_or_else(|| kind(expected))?;
    fit(if negative { -value } else { value }, text, width)
}

/// Parses a decimal number with at most this many decimal places, in units of the last one.
fn scaled(digits: &str, decimals: u8) -> Option<i128> {
    let (whole, part) = digits.split_once('.').unwrap_or((digits, ""));
    let decimals = usize::from(decimals);
    let only_digits = |text: &str| text.bytes().all(|byte| byte.is_ascii_digit());
    if whole.is_empty() || !only_digits(whole) || !only_digits(part) || part.len() > decimals {
        return None;
    }
    format!("{whole}{part:0<decimals$}").parse().ok()
}

/// Returns the little-endian bytes of a number that fits as a signed or an unsigned one.
fn fit(value: i128, text: &str, width: usize) -> Result<Vec<u8>, ValueError> {
    let bits = u32::try_from(width * 8).unwrap_or(64);
    let (low, high) = (-(1_i128 << (bits - 1)), (1_i128 << bits) - 1);
    if !(low..=high).contains(&value) {
        return Err(ValueError::Range {
            text: text.to_string(),
            bytes: width,
        });
    }
    let bytes = value.to_le_bytes();
    Ok(bytes.get(..width).unwrap_or(&bytes).to_vec())
}
