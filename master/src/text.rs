//! Formatting of numbers and names, and similar names.

use strsim::osa_distance;

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

/// Quotes a text for TOML.
#[must_use]
pub fn quoted(text: &str) -> String {
    toml::Value::String(text.to_owned()).to_string()
}

/// Returns the entry of `known` that `word` probably stands for.
#[must_use]
pub fn nearest<'k>(word: &str, known: impl IntoIterator<Item = &'k str>) -> Option<&'k str> {
    // Longer words are not names, and the comparison takes time.
    let word: String = word.chars().take(64).collect::<String>().to_lowercase();
    let known: Vec<&str> = known.into_iter().collect();
    // By edit distance alone, `move_to` is nearer to `move_by`, which means something else.
    let stem = |k: &&&str| {
        word.strip_prefix(**k)
            .is_some_and(|rest| rest.starts_with('_'))
    };
    let stem = known.iter().find(stem).copied();
    let near = known
        .into_iter()
        .map(|k| (osa_distance(&word, &k.to_lowercase()), k))
        .filter(|(d, k)| match k.chars().count().max(word.chars().count()) {
            // All one-letter names are one edit apart.
            0..=2 => *d == 0,
            longer => *d <= (longer / 3).max(1),
        })
        .min_by_key(|(d, _)| *d);
    match (near, stem) {
        (Some((2.., _)) | None, Some(stem)) => Some(stem),
        (near, _) => near.map(|(_, k)| k),
    }
}

/// Returns a fraction in percent, without digits that come from rounding.
pub(crate) fn percent(fraction: f64) -> f64 {
    rounded(fraction * 100.0)
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
