//! Figures, times and options as text.

use std::fmt::Display;

use ecaxis_master::config::duration::show as duration;

/// Formats a time with three digits and a unit.
#[must_use]
pub fn time(nanos: u64) -> String {
    let digits = |value: f64| match value {
        v if v >= 99.95 => 0,
        v if v >= 9.995 => 1,
        _ => 2,
    };
    let (value, unit) = match nanos {
        0..1_000 => return duration(nanos),
        1_000..1_000_000 => (nanos as f64 / 1e3, "µs"),
        1_000_000..1_000_000_000 => (nanos as f64 / 1e6, "ms"),
        _ => (nanos as f64 / 1e9, "s"),
    };
    format!("{value:.*} {unit}", digits(value))
}

/// Formats an absent value as `-`.
#[must_use]
pub fn or_dash<T: Display>(value: Option<T>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| value.to_string())
}

/// Formats an identity number, such as a vendor or revision.
#[must_use]
pub fn hex32(number: u32) -> String {
    format!("0x{number:08x}")
}

/// Formats an index or a register.
#[must_use]
pub fn hex16(number: u16) -> String {
    format!("0x{number:04x}")
}

/// Formats bytes in hexadecimal with `gap` between them.
#[must_use]
pub fn hex_bytes<'a>(bytes: impl IntoIterator<Item = &'a u8>, gap: &str) -> String {
    let bytes: Vec<String> = bytes.into_iter().map(|b| format!("{b:02x}")).collect();
    bytes.join(gap)
}

/// Joins the names whose condition is true.
#[must_use]
pub fn names_of<'a>(all: &[(bool, &'a str)], gap: &str) -> String {
    let names = all.iter().filter(|(on, _)| *on).map(|(_, name)| *name);
    names.collect::<Vec<&'a str>>().join(gap)
}

/// Formats a repetition: `once`, `2 times`.
#[must_use]
pub fn times(count: u32) -> String {
    match count {
        1 => "once".to_owned(),
        n => format!("{n} times"),
    }
}

/// Formats a UTC time as `2026-11-22 07:12:03`.
#[must_use]
pub fn utc(seconds: u64) -> String {
    let [year, month, day, hour, minute, second] = civil(seconds);
    format!("{year:04}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02}")
}

/// Returns year, month, day, hour, minute and second of Unix time (Gregorian calendar).
#[must_use]
pub fn civil(seconds: u64) -> [u64; 6] {
    let (days, rest) = (seconds / 86_400, seconds % 86_400);
    // Years begin in March here; 719 468 days lie between the start of year 0 and 1970.
    let days = days + 719_468;
    let (era, of_era) = (days / 146_097, days % 146_097);
    let year = (of_era - of_era / 1_460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year + year / 4 - year / 100);
    let month = (5 * of_year + 2) / 153;
    let day = of_year - (153 * month + 2) / 5 + 1;
    let month = if month < 10 { month + 3 } else { month - 9 };
    let year = year + era * 400 + u64::from(month <= 2);
    [year, month, day, rest / 3600, rest / 60 % 60, rest % 60]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates() {
        for (seconds, text) in [
            (0, "1970-01-01 00:00:00"),
            (951_782_399, "2000-02-28 23:59:59"),
            (951_782_400, "2000-02-29 00:00:00"),
            (1_709_251_199, "2024-02-29 23:59:59"),
            (1_735_689_599, "2024-12-31 23:59:59"),
            (4_107_542_400, "2100-03-01 00:00:00"),
        ] {
            assert_eq!(utc(seconds), text);
        }
    }
}
