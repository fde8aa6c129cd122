//! TOML syntax errors in words that name the correction.

use super::problem::{Problems, Span};

/// Boolean words of other formats.
const BOOLEANS: [(&str, &str); 8] = [
    ("no", "false"),
    ("off", "false"),
    ("False", "false"),
    ("FALSE", "false"),
    ("yes", "true"),
    ("on", "true"),
    ("True", "true"),
    ("TRUE", "true"),
];

/// Reports an error of the TOML parser.
pub(crate) fn report(text: &str, error: &toml::de::Error, p: &mut Problems<'_>) {
    let span = error.span().unwrap_or(0..0);
    if error.message().starts_with("missing escaped value") {
        let hint = "write paths with `/`, or in single quotes: `'esi\\x.xml'`";
        p.add_hint(
            span,
            "in double quotes, `\\` begins an escape such as `\\n`",
            hint,
        );
        return;
    }
    match bare_word(text, &span) {
        Some((word, at)) => {
            let boolean = BOOLEANS.iter().find(|(known, _)| *known == word);
            let hint = match boolean {
                Some((_, value)) => format!("write `{value}`"),
                None => format!("a text stands in quotes: `\"{word}\"`"),
            };
            p.add_hint(at, format!("`{word}` is not a value"), hint);
        }
        None => p.add(span, error.message()),
    }
}

/// Returns the unquoted word that stands as a value where the parser failed.
fn bare_word<'t>(text: &'t str, span: &Span) -> Option<(&'t str, Span)> {
    let line_start = text.get(..span.start)?.rfind('\n').map_or(0, |at| at + 1);
    let line = text.get(line_start..)?.lines().next()?;
    // Starts after the last character that a value can follow.
    let within = line.get(..span.start - line_start)?;
    let begin = within.rfind(['=', '[', ',']).map(|at| at + 1);
    let begin = begin.or_else(|| line.strip_prefix('=').map(|_| 1))?;
    let rest = line.get(begin..)?;
    let word = rest.trim_start();
    let at = line_start + begin + (rest.len() - word.len());
    let end = word.find(|c: char| !(c.is_alphanumeric() || c == '_' || c == '-'));
    let word = word.get(..end.unwrap_or(word.len()))?;
    let is_word = word.starts_with(char::is_alphabetic);
    let known = ["true", "false", "inf", "nan"];
    (is_word && !known.contains(&word)).then(|| (word, at..at + word.len()))
}
