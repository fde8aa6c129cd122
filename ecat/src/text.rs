//! Texts of files, devices and clients: names that may contain anything.

use alloc::borrow::Cow;
use alloc::string::String;

/// Returns true for a character that a reader does not see and that acts on what shows it: control
/// characters, which a terminal obeys, and those that change the direction of writing (Unicode
/// bidirectional controls), which let a name look like another one.
#[must_use]
pub fn is_hidden(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{061c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// Replaces hidden characters except line breaks and tabs.
#[must_use]
pub fn printable(text: &str) -> Cow<'_, str> {
    let acts = |c: char| is_hidden(c) && !matches!(c, '\n' | '\t');
    match text.contains(acts) {
        true => Cow::Owned(text.replace(acts, "\u{fffd}")),
        false => Cow::Borrowed(text),
    }
}

/// Returns a text as a cell of a CSV file (RFC 4180) that no spreadsheet takes for a formula.
#[must_use]
pub fn csv_cell(text: &str) -> String {
    let formula = text.starts_with(['=', '+', '-', '@', '\t', '\r']);
    let mark = if formula { "'" } else { "" };
    let text = printable(text).replace('"', "\"\"");
    alloc::format!("\"{mark}{text}\"")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hidden_characters_do_not_act() {
        for (text, expected) in [
            ("two\nlines\tand \u{fc}", "two\nlines\tand \u{fc}"),
            ("<\u{1b}]0;t\u{7}>", "<\u{fffd}]0;t\u{fffd}>"),
            ("\u{9b}31mred\r", "\u{fffd}31mred\u{fffd}"),
            ("evil\u{202e}lmx.", "evil\u{fffd}lmx."),
            ("\u{2067}a\u{2069}", "\u{fffd}a\u{fffd}"),
        ] {
            assert_eq!(printable(text), expected);
        }
    }

    #[test]
    fn cells_are_no_formulas() {
        for (text, expected) in [
            ("x.position [mm]", "\"x.position [mm]\""),
            ("=HYPERLINK(1)", "\"'=HYPERLINK(1)\""),
            ("@a \"b\"", "\"'@a \"\"b\"\"\""),
            ("-\u{1b}", "\"'-\u{fffd}\""),
        ] {
            assert_eq!(csv_cell(text), expected);
        }
    }
}
