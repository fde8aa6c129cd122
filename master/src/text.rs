//! Formatting of counts with nouns.

/// Returns a count with its noun: `1 frame`, `2 frames`.
#[must_use]
pub fn pluralize(count: usize, noun: &str) -> String {
    match count {
        1 => format!("1 {noun}"),
        _ => format!("{count} {noun}s"),
    }
}
