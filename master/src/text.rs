//! Formatting of numbers.

/// Returns a count with its noun: `1 frame`, `2 frames`.
#[must_use]
pub fn pluralize(count: usize, noun: &str) -> String {
    match count {
        1 => format!("1 {noun}"),
        _ => format!("{count} {noun}s"),
    }
}

/// Returns the first names of a list, and how many follow.
#[must_use]
pub(crate) fn few(names: &[String]) -> String {
    const FEW: usize = 3;
    let first = names.iter().take(FEW).map(String::as_str);
    let text = first.collect::<Vec<_>>().join(", ");
    match names.len().saturating_sub(FEW) {
        0 => text,
        more => format!("{text} and {more} more"),
    }
}

/// Rounds to six decimals, without digits that come from computing.
#[must_use]
pub fn rounded(x: f64) -> f64 {
    let rounded = (x * 1e6).round() / 1e6;
    if rounded.is_finite() { rounded } else { x }
}

/// Returns 0.0 for a number that would print as `-0.000` with this number of decimals.
#[must_use]
pub fn positive_zero(x: f64, decimals: i32) -> f64 {
    if x.abs() < 0.5 * 10_f64.powi(-decimals) {
        0.0
    } else {
        x
    }
}

/// Returns the message of a panic.
pub(crate) fn panic_text(panic: &(dyn std::any::Any + Send)) -> String {
    panic
        .downcast_ref::<String>()
        .cloned()
        .or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_owned()))
        .unwrap_or_else(|| "unknown cause".to_owned())
}
