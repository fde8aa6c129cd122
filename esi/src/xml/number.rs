//! Number and byte literals of ETG.2000: `#x1a00`, `0x1A00`, `#x0x1a00`, `6656`, `-5`; `0A1b`.

/// Parses a number. `i128` holds every signed and unsigned value of an ESI.
pub(super) fn number(text: &str) -> Option<i128> {
    // Most literals have no surrounding white space.
    let text = match text.as_bytes() {
        [first, .., last] if first.is_ascii_graphic() && last.is_ascii_graphic() => text,
        _ => text.trim(),
    };
    let (negative, digits) = match text.strip_prefix('-') {
        Some(rest) => (true, rest.trim_start()),
        None => (false, text.strip_prefix('+').unwrap_or(text)),
    };
    let (digits, radix) = match digits.as_bytes() {
        // Some tools add a second prefix.
        [b'#', b'x' | b'X', b'0', b'x' | b'X', digits @ ..] => (digits, 16),
        [b'#' | b'0', b'x' | b'X', digits @ ..] => (digits, 16),
        digits => (digits, 10),
    };
    if digits.is_empty() || digits.len() > 30 {
        return None;
    }
    // Digits are parsed in pieces that fit a machine word; most literals need one piece.
    let (first, more) = digits.split_at(digits.len().min(15));
    let mut magnitude = i128::from(word(first, radix)?);
    for step in more.chunks(15) {
        let scale = step.iter().fold(1, |scale, _| scale * i128::from(radix));
        magnitude = magnitude * scale + i128::from(word(step, radix)?);
    }
    Some(if negative { -magnitude } else { magnitude })
}

/// Parses at most 15 digits.
fn word(digits: &[u8], radix: u8) -> Option<u64> {
    let mut value = 0;
    for digit in digits {
        let digit = HEX[usize::from(*digit)];
        if digit >= radix {
            return None;
        }
        value = value * u64::from(radix) + u64::from(digit);
    }
    Some(value)
}

pub(super) fn boolean(text: &str) -> Option<bool> {
    match text.trim() {
        t if t.eq_ignore_ascii_case("true") => Some(true),
        t if t.eq_ignore_ascii_case("false") => Some(false),
        t => number(t).map(|n| n != 0),
    }
}

/// Parses hexadecimal bytes in file order; white space between them is allowed.
pub(super) fn hex_bytes(text: &str) -> Option<Vec<u8>> {
    let mut bytes = vec![0; text.len() / 2];
    // Most byte strings consist of digit pairs without white space.
    let (pairs, rest) = hex_start(text.as_bytes(), &mut bytes);
    bytes.truncate(pairs);
    let mut high = None;
    // The text after ASCII pairs starts at a character boundary.
    let rest = &text[text.len() - rest.len()..];
    for character in rest.chars().filter(|c| !c.is_whitespace()) {
        let digit = hex_digit(u8::try_from(character).ok()?)?;
        match high.take() {
            None => high = Some(digit << 4),
            Some(high) => bytes.push(high | digit),
        }
    }
    high.is_none().then_some(bytes)
}

/// Parses digit pairs from the start until `bytes` is full. Returns their count and the remaining
/// text.
pub(super) fn hex_start<'a>(mut rest: &'a [u8], bytes: &mut [u8]) -> (usize, &'a [u8]) {
    let mut pairs = 0;
    for byte in bytes {
        let Some(([high, low], behind)) = rest.split_first_chunk() else {
            break;
        };
        let (Some(high), Some(low)) = (hex_digit(*high), hex_digit(*low)) else {
            break;
        };
        *byte = high << 4 | low;
        pairs += 1;
        rest = behind;
    }
    (pairs, rest)
}

fn hex_digit(letter: u8) -> Option<u8> {
    let value = HEX[usize::from(letter)];
    (value < 16).then_some(value)
}

/// Values of 16 and more: not a digit.
const HEX: [u8; 256] = {
    let mut table = [0xff; 256];
    let mut value = 0;
    while value < 16 {
        let digits = (b"0123456789abcdef", b"0123456789ABCDEF");
        table[digits.0[value as usize] as usize] = value;
        table[digits.1[value as usize] as usize] = value;
        value += 1;
    }
    table
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn number_parses_every_form_of_literal() {
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
    fn hex_bytes_parses_pairs_and_white_space() {
        assert_eq!(hex_bytes(" 0A1b \n ff"), Some(vec![0x0a, 0x1b, 0xff]));
        assert_eq!(hex_bytes(""), Some(vec![]));
        assert_eq!(hex_bytes("0"), None);
        assert_eq!(hex_bytes("0g"), None);
    }

    #[test]
    fn boolean_parses_numbers_and_words() {
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
