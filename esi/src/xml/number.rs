//! Number and byte literals of ETG.2000: `#x1a00`, `0x1A00`, `6656`, `-5`; `0A1b`.

/// Wide enough for every value that an ESI can hold, unsigned or signed.
pub(super) fn number(text: &str) -> Option<i128> {
    let text = text.trim();
    let (negative, digits) = match text.strip_prefix('-') {
        Some(rest) => (true, rest.trim_start()),
        None => (false, text.strip_prefix('+').unwrap_or(text)),
    };
    let (digits, radix) = match digits.as_bytes() {
        [b'#' | b'0', b'x' | b'X', ..] => (&digits[2..], 16),
        _ => (digits, 10),
    };
    if digits.is_empty() || digits.len() > 30 {
        return None;
    }
    let mut magnitude = 0_i128;
    // In steps that a machine word holds.
    for step in digits.as_bytes().chunks(15) {
        let (mut value, mut scale) = (0_u64, 1_u64);
        for digit in step {
            let digit = char::from(*digit).to_digit(radix)?;
            value = value * u64::from(radix) + u64::from(digit);
            scale *= u64::from(radix);
        }
        magnitude = magnitude * i128::from(scale) + i128::from(value);
    }
    Some(if negative { -magnitude } else { magnitude })
}

pub(super) fn boolean(text: &str) -> Option<bool> {
    match text.trim() {
        t if t.eq_ignore_ascii_case("true") => Some(true),
        t if t.eq_ignore_ascii_case("false") => Some(false),
        t => number(t).map(|n| n != 0),
    }
}

/// Hexadecimal bytes in file order, white space between them allowed.
pub(super) fn hex_bytes(text: &str) -> Option<Vec<u8>> {
    let mut bytes = Vec::with_capacity(text.len() / 2);
    let mut high = None;
    for character in text.chars().filter(|c| !c.is_whitespace()) {
        let digit = u8::try_from(character.to_digit(16)?).ok()?;
        match high.take() {
            None => high = Some(digit << 4),
            Some(high) => bytes.push(high | digit),
        }
    }
    high.is_none().then_some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn literals() {
        for (text, value) in [
            ("#x1A00", Some(0x1a00)),
            ("#X1a00", Some(0x1a00)),
            (" 0x1A00\n", Some(0x1a00)),
            ("6656", Some(6656)),
            ("007", Some(7)),
            ("-5", Some(-5)),
            ("+5", Some(5)),
            ("-#x10", Some(-16)),
            ("#xFFFFFFFFFFFFFFFF", Some(i128::from(u64::MAX))),
            ("", None),
            ("#x", None),
            ("--5", None),
            ("#x+5", None),
            ("12 34", None),
            ("1A00", None),
            ("99999999999999999999999999999999999999999999", None),
        ] {
            assert_eq!(number(text), value, "{text:?}");
        }
    }

    #[test]
    fn bytes() {
        assert_eq!(hex_bytes(" 0A1b \n ff"), Some(vec![0x0a, 0x1b, 0xff]));
        assert_eq!(hex_bytes(""), Some(vec![]));
        assert_eq!(hex_bytes("0"), None);
        assert_eq!(hex_bytes("0g"), None);
    }

    #[test]
    fn booleans() {
        for (text, value) in [
            ("1", Some(true)),
            ("0", Some(false)),
            ("TRUE", Some(true)),
            ("x", None),
        ] {
            assert_eq!(boolean(text), value, "{text:?}");
        }
    }
}
