//! Number and byte literals of ETG.2000: `#x1a00`, `0x1A00`, `6656`, `-5`; `0A1b`.

/// Wide enough for every value that an ESI can hold, unsigned or signed.
pub(super) fn number(text: &str) -> Option<i128> {
    let text = text.trim();
    let (negative, digits) = match text.strip_prefix('-') {
        Some(rest) => (true, rest.trim_start()),
        None => (false, text.strip_prefix('+').unwrap_or(text)),
    };
    let hex = ["#x", "#X", "0x", "0X"]
        .iter()
        .find_map(|prefix| digits.strip_prefix(prefix));
    let (digits, radix) = hex.map_or((digits, 10), |rest| (rest, 16));
    // from_str_radix would take a second sign.
    if digits.is_empty() || digits.len() > 30 || !digits.chars().all(|c| c.is_digit(radix)) {
        return None;
    }
    let magnitude = i128::from_str_radix(digits, radix).ok()?;
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
    let digits: Option<Vec<u8>> = text
        .chars()
        .filter(|c| !c.is_whitespace())
        .map(|c| c.to_digit(16).and_then(|d| u8::try_from(d).ok()))
        .collect();
    let digits = digits?;
    if digits.len() % 2 != 0 {
        return None;
    }
    Some(
        digits
            .chunks_exact(2)
            .map(|pair| pair[0] << 4 | pair[1])
            .collect(),
    )
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
