//! Data types: their codes in SDO Information and their permitted values.

use super::Abort;

/// The code of a record of unknown layout.
pub(crate) const RECORD: u16 = 0x002a;

/// The interpretation of the bits of a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    Unsigned,
    Signed,
    Real,
    LongReal,
    /// Text of variable length. It ends at the first zero byte; a shorter download is padded.
    Text,
    Octets,
}

/// Returns the index of a base type (ETG.1020, table "Base Data Types"), or 0 for an unknown name.
pub(crate) fn code(name: &str) -> u16 {
    let name = name.trim();
    match name {
        "BOOL" | "BIT" => 0x0001,
        "SINT" => 0x0002,
        "INT" => 0x0003,
        "DINT" => 0x0004,
        "USINT" => 0x0005,
        "UINT" => 0x0006,
        "UDINT" => 0x0007,
        "REAL" => 0x0008,
        "TIME_OF_DAY" => 0x000c,
        "TIME_DIFFERENCE" => 0x000d,
        "INT24" => 0x0010,
        "LREAL" => 0x0011,
        "INT40" => 0x0012,
        "INT48" => 0x0013,
        "INT56" => 0x0014,
        "LINT" => 0x0015,
        "UINT24" => 0x0016,
        "UINT40" => 0x0018,
        "UINT48" => 0x0019,
        "UINT56" => 0x001a,
        "ULINT" => 0x001b,
        "GUID" => 0x001d,
        "BYTE" => 0x001e,
        "WORD" => 0x001f,
        "DWORD" => 0x0020,
        "BITARR8" => 0x002d,
        "BITARR16" => 0x002e,
        "BITARR32" => 0x002f,
        _ if name.starts_with("STRING") || name.starts_with("VISIBLE_STRING") => 0x0009,
        _ if name.starts_with("OCTET_STRING") => 0x000a,
        _ if name.starts_with("UNICODE_STRING") => 0x000b,
        _ if name.starts_with("ARRAY") => array(name),
        _ => match name.strip_prefix("BIT").and_then(|bits| bits.parse().ok()) {
            Some(bits @ 1..=16) => 0x002f + bits,
            _ => 0,
        },
    }
}

/// Returns the code of `ARRAY [0..n] OF …` without subindices: the string type of its element.
fn array(name: &str) -> u16 {
    match name.rsplit(' ').next() {
        Some("BYTE" | "USINT") => 0x000a,
        Some("UINT" | "WORD") => 0x000b,
        Some("INT") => 0x0260,
        Some("SINT") => 0x0261,
        Some("DINT") => 0x0262,
        Some("UDINT") => 0x0263,
        _ => 0,
    }
}

/// Returns the unsigned type of this length, for objects that no file describes.
pub(crate) fn unsigned(bit_len: u32) -> u16 {
    match bit_len {
        1 => 0x0001,
        2..=7 | 9..=15 => 0x002f + bit_len as u16,
        8 => 0x0005,
        16 => 0x0006,
        24 => 0x0016,
        32 => 0x0007,
        40 => 0x0018,
        48 => 0x0019,
        56 => 0x001a,
        64 => 0x001b,
        _ => 0x000a,
    }
}

pub(crate) fn kind(code: u16, bit_len: u32) -> Kind {
    match code {
        0x0009 => Kind::Text,
        0x000a | 0x000b | 0x0260..=0x0263 => Kind::Octets,
        0x0008 if bit_len == 32 => Kind::Real,
        0x0011 if bit_len == 64 => Kind::LongReal,
        0x0002..=0x0004 | 0x0010 | 0x0012..=0x0015 => Kind::Signed,
        _ if bit_len > 64 => Kind::Octets,
        _ => Kind::Unsigned,
    }
}

/// Checks that a value of the right length lies in its range (ETG.1000.6 table 41, 0x06090030 to
/// 0x06090032). A range with `max` not above `min` is ignored: files fill both with zeros.
pub(crate) fn check(
    kind: Kind,
    bit_len: u32,
    value: &[u8],
    min: Option<&[u8]>,
    max: Option<&[u8]>,
) -> Result<(), Abort> {
    match kind {
        Kind::Text | Kind::Octets => Ok(()),
        Kind::Real | Kind::LongReal => {
            let value = real(value);
            if value.is_nan() {
                return Err(Abort::VALUE);
            }
            within(value, min.map(real), max.map(real))
        }
        Kind::Unsigned | Kind::Signed => {
            let unused = value.len() as u32 * 8 - bit_len.min(value.len() as u32 * 8);
            if unused > 0 && value.last().is_some_and(|last| last >> (8 - unused) != 0) {
                return Err(Abort::VALUE);
            }
            let number = |bytes: &[u8]| integer(bytes, bit_len, kind == Kind::Signed);
            within(number(value), min.map(number), max.map(number))
        }
    }
}

fn within<T: PartialOrd>(value: T, min: Option<T>, max: Option<T>) -> Result<(), Abort> {
    if let (Some(min), Some(max)) = (&min, &max)
        && min >= max
    {
        return Ok(());
    }
    if max.is_some_and(|max| value > max) {
        return Err(Abort::VALUE_TOO_HIGH);
    }
    if min.is_some_and(|min| value < min) {
        return Err(Abort::VALUE_TOO_LOW);
    }
    Ok(())
}

fn real(bytes: &[u8]) -> f64 {
    match (<[u8; 4]>::try_from(bytes), <[u8; 8]>::try_from(bytes)) {
        (Ok(raw), _) => f64::from(f32::from_le_bytes(raw)),
        (_, Ok(raw)) => f64::from_le_bytes(raw),
        _ => 0.0,
    }
}

fn integer(bytes: &[u8], bit_len: u32, signed: bool) -> i128 {
    let mut raw = [0; 16];
    for (to, from) in raw.iter_mut().zip(bytes) {
        *to = *from;
    }
    let value = i128::from_le_bytes(raw);
    let unused = 128 - bit_len.clamp(1, 64);
    let high = value << unused;
    if signed {
        high >> unused
    } else {
        high.cast_unsigned().wrapping_shr(unused).cast_signed()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_have_the_codes_of_the_standard() {
        for (name, expected) in [
            ("BOOL", 0x01),
            ("DINT", 0x04),
            ("UDINT", 0x07),
            ("LREAL", 0x11),
            ("ULINT", 0x1b),
            ("BIT1", 0x30),
            ("BIT8", 0x37),
            ("STRING(12)", 0x09),
            ("ARRAY [0..499] OF BYTE", 0x0a),
            ("ARRAY [0..3] OF UDINT", 0x263),
            ("DT1018", 0),
            ("BIT", 1),
            ("BIT99", 0),
        ] {
            assert_eq!(code(name), expected, "{name}");
        }
    }

    #[test]
    fn ranges_hold_for_every_kind_of_number() {
        let check = |name: &str, bits, value: &[u8], min: &[u8], max: &[u8]| {
            check(kind(code(name), bits), bits, value, Some(min), Some(max))
        };
        let (low, high) = (Err(Abort::VALUE_TOO_LOW), Err(Abort::VALUE_TOO_HIGH));
        let f = |v: f32| v.to_le_bytes();
        let d = |v: f64| v.to_le_bytes();
        let u = |v: u64| v.to_le_bytes();
        assert_eq!(check("SINT", 8, &[0x80], &[0x81], &[0x7f]), low);
        assert_eq!(check("SINT", 8, &[0xff], &[0x81], &[0x7f]), Ok(()));
        assert_eq!(check("USINT", 8, &[0xff], &[1], &[0xfe]), high);
        assert_eq!(check("ULINT", 64, &u(u64::MAX), &u(1), &u(1 << 63)), high);
        assert_eq!(check("ULINT", 64, &u(1 << 63), &u(1), &u(1 << 63)), Ok(()));
        assert_eq!(check("REAL", 32, &f(1.5), &f(-1.5), &f(1.5)), Ok(()));
        assert_eq!(check("REAL", 32, &f(1.6), &f(-1.5), &f(1.5)), high);
        assert_eq!(check("REAL", 32, &f(-1.6), &f(-1.5), &f(1.5)), low);
        let nan = check("REAL", 32, &f(f32::NAN), &f(-1.5), &f(1.5));
        assert_eq!(nan, Err(Abort::VALUE));
        assert_eq!(check("LREAL", 64, &d(1e300), &d(-1.0), &d(1.0)), high);
        assert_eq!(check("BOOL", 1, &[2], &[0], &[1]), Err(Abort::VALUE));
        assert_eq!(check("BIT3", 3, &[7], &[0], &[6]), high);
        assert_eq!(check("INT", 16, &[9, 9], &[0, 0], &[0, 0]), Ok(()));
    }
}
