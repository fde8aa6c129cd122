//! Durations in text form (`250us`, `1.5 s`), as whole nanoseconds.

use std::ops::Range;

use super::problem::suggestion;

const UNITS: [(&str, u64); 7] = [
    ("ns", 1),
    ("us", 1_000),
    ("µs", 1_000),
    ("ms", 1_000_000),
    ("s", 1_000_000_000),
    ("min", 60_000_000_000),
    ("h", 3_600_000_000_000),
];

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}; {hint}")]
pub struct DurationError {
    pub message: String,
    pub hint: String,
    /// The byte range of the error in the text.
    pub at: Range<usize>,
}

/// Reads a duration: a decimal number and a unit.
///
/// # Errors
/// Returns the invalid part of the text.
pub fn parse(text: &str) -> Result<u64, DurationError> {
    let example = "a number and a unit, such as \"1ms\" or \"250us\"";
    let all = 0..text.len();
    let error = |at: Range<usize>, message: String, hint: &str| {
        let hint = hint.to_owned();
        Err(DurationError { message, hint, at })
    };
    let digits = text
        .find(|c: char| !(c.is_ascii_digit() || c == '.' || c == '_'))
        .unwrap_or(text.len());
    let (number, rest) = text.split_at(digits);
    let unit = rest.trim();
    if number.is_empty() {
        return error(all, format!("\"{text}\" is not a duration"), example);
    }
    if unit.is_empty() {
        return error(all, format!("\"{text}\" has no unit"), example);
    }
    let Some((_, scale)) = UNITS.iter().find(|(name, _)| *name == unit) else {
        let hint = suggestion(unit, UNITS.iter().map(|(name, _)| *name), "units");
        let at = text.len() - rest.trim_start().len()..text.trim_end().len();
        return error(at, format!("unknown unit of time `{unit}`"), &hint);
    };
    nanoseconds(number, *scale).map_or_else(
        || {
            let message = format!("\"{text}\" is not a whole number of nanoseconds, or too long");
            error(0..digits, message, example)
        },
        Ok,
    )
}

/// Reads digits with at most one point.
fn nanoseconds(number: &str, scale: u64) -> Option<u64> {
    let number = number.replace('_', "");
    let (whole, fraction) = number.split_once('.').unwrap_or((&number, ""));
    let fraction = fraction.trim_end_matches('0');
    let ten = 10_u128.checked_pow(u32::try_from(fraction.len()).ok()?)?;
    let digits: u128 = format!("{whole}{fraction}").parse().ok()?;
    let ns = digits.checked_mul(scale.into())?;
    let is_whole = !whole.is_empty() && ns % ten == 0;
    is_whole.then(|| u64::try_from(ns / ten).ok())?
}

/// Returns the shortest exact text of a duration.
#[must_use]
pub fn show(ns: u64) -> String {
    for (unit, scale) in [("s", 1_000_000_000_u64), ("ms", 1_000_000), ("µs", 1_000)] {
        if ns >= scale {
            let fraction = format!("{:09}", ns % scale * (1_000_000_000 / scale));
            let fraction = fraction.trim_end_matches('0');
            let point = if fraction.is_empty() { "" } else { "." };
            return format!("{}{point}{fraction} {unit}", ns / scale);
        }
    }
    format!("{ns} ns")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parse_accepts_numbers_with_units() {
        for (text, ns) in [
            ("1ms", 1_000_000),
            ("250us", 250_000),
            ("62.5 µs", 62_500),
            ("1.5s", 1_500_000_000),
            ("2min", 120_000_000_000),
            ("1h", 3_600_000_000_000),
            ("100_000ns", 100_000),
            ("0s", 0),
            ("1.000s", 1_000_000_000),
        ] {
            assert_eq!(parse(text), Ok(ns), "{text}");
        }
    }

    #[test]
    fn parse_rejects_invalid_durations() {
        for (text, message, at) in [
            ("1mms", "unknown unit of time `mms`", 1..4),
            ("10 sec", "unknown unit of time `sec`", 3..6),
            ("", "\"\" is not a duration", 0..0),
            ("fast", "\"fast\" is not a duration", 0..4),
            ("-1ms", "\"-1ms\" is not a duration", 0..4),
            ("500", "\"500\" has no unit", 0..3),
            (
                "1.5ns",
                "\"1.5ns\" is not a whole number of nanoseconds, or too long",
                0..3,
            ),
            (
                "1.2.3s",
                "\"1.2.3s\" is not a whole number of nanoseconds, or too long",
                0..5,
            ),
            (
                ".5s",
                "\".5s\" is not a whole number of nanoseconds, or too long",
                0..2,
            ),
            (
                "99999999999h",
                "\"99999999999h\" is not a whole number of nanoseconds, or too long",
                0..11,
            ),
        ] {
            let e = parse(text).unwrap_err();
            assert_eq!((e.message.as_str(), e.at), (message, at), "{text}");
        }
        assert_eq!(parse("1mms").unwrap_err().hint, "did you mean `ms`?");
    }

    #[test]
    fn show_uses_the_shortest_exact_unit() {
        for (ns, text) in [
            (0, "0 ns"),
            (999, "999 ns"),
            (62_500, "62.5 µs"),
            (1_000_000, "1 ms"),
            (1_500_000_000, "1.5 s"),
            (3_600_000_000_000, "3600 s"),
        ] {
            assert_eq!(show(ns), text);
        }
    }
}
