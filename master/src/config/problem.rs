//! Mistakes in a machine file with their place: one [`Problem`] per mistake, with line, caret and a
//! suggestion. All are collected before the report.

use std::collections::BTreeMap;
use std::fmt;
use std::ops::Range;
use std::path::{Path, PathBuf};

use crate::file::unreadable;
use crate::signature::{PolicyError, SignatureError, SignaturePolicy, VerifiedFiles};
use crate::text::nearest;

/// The reason why a machine file is rejected.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error("{}", unreadable(path, source))]
    Io {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("{} is not text: {source}", path.display())]
    NotText {
        path: PathBuf,
        source: std::str::Utf8Error,
    },
    #[error(transparent)]
    Policy(#[from] PolicyError),
    #[error(transparent)]
    Signature(#[from] SignatureError),
    /// All mistakes in the file, in line order.
    #[error("{}", all(.0))]
    Problems(Vec<Problem>),
}

fn all(problems: &[Problem]) -> String {
    let texts: Vec<String> = problems.iter().map(Problem::to_string).collect();
    texts.join("\n\n")
}

/// One mistake in the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    pub path: PathBuf,
    /// The line, from 1.
    pub line: u32,
    /// The column in characters, from 1.
    pub column: u32,
    /// The number of marked characters, at least 1.
    pub width: u32,
    pub message: String,
    pub hint: Option<String>,
    pub source_line: String,
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            path, line, column, ..
        } = self;
        let number = line.to_string();
        let margin = " ".repeat(number.len());
        // Tabs before the caret stay tabs, independent of their width on the terminal.
        let before: String = self
            .source_line
            .chars()
            .take(column.saturating_sub(1) as usize)
            .map(|c| if c == '\t' { '\t' } else { ' ' })
            .collect();
        let carets = "^".repeat(self.width.max(1) as usize);
        writeln!(f, "error: {}", self.message)?;
        writeln!(f, "{margin}--> {}:{line}:{column}", path.display())?;
        writeln!(f, "{margin} |")?;
        writeln!(f, "{number} | {}", self.source_line)?;
        write!(f, "{margin} | {before}{carets}")?;
        if let Some(hint) = &self.hint {
            let mut lines = hint.lines();
            write!(f, "\n{margin} = help: {}", lines.next().unwrap_or_default())?;
            for line in lines {
                write!(f, "\n{margin}         {line}")?;
            }
        }
        Ok(())
    }
}

/// A byte range of the machine file.
pub(crate) type Span = Range<usize>;

/// The file's text and the problems found so far.
#[derive(Debug)]
pub(crate) struct Problems<'s> {
    path: &'s Path,
    text: &'s str,
    /// The byte offsets of the lines.
    lines: Vec<usize>,
    /// The problems by their first byte.
    found: BTreeMap<usize, Vec<Problem>>,
    /// The files that were read for the machine file.
    pub files: VerifiedFiles<'s>,
}

impl<'s> Problems<'s> {
    pub fn new(path: &'s Path, text: &'s str, policy: &'s SignaturePolicy) -> Self {
        Self {
            path,
            text,
            lines: std::iter::once(0)
                .chain(text.match_indices('\n').map(|(at, _)| at + 1))
                .collect(),
            found: BTreeMap::new(),
            files: VerifiedFiles::new(policy),
        }
    }

    pub fn add(&mut self, span: Span, message: impl Into<String>) {
        self.push(span, message.into(), None);
    }

    pub fn add_hint(&mut self, span: Span, message: impl Into<String>, hint: impl Into<String>) {
        self.push(span, message.into(), Some(hint.into()));
    }

    fn push(&mut self, span: Span, message: String, hint: Option<String>) {
        let start = floor(self.text, span.start);
        let end = floor(self.text, span.end).max(start);
        let line = self.line_at(start);
        let line_start = self.lines[line - 1];
        let rest = &self.text[line_start..];
        let source_line = rest.lines().next().unwrap_or_default();
        let column = self.text[line_start..start].chars().count() + 1;
        // A span over several lines (a table, a long list) is underlined on its first line.
        let line_end = (line_start + source_line.len()).max(start);
        let width = self.text[start..end.min(line_end)].chars().count().max(1);
        let problem = Problem {
            path: self.path.to_owned(),
            line: small(line),
            column: small(column),
            width: small(width),
            message,
            hint,
            source_line: source_line.to_owned(),
        };
        let here = self.found.entry(start).or_default();
        if !here.contains(&problem) {
            here.push(problem);
        }
    }

    pub fn line(&self, span: &Span) -> u32 {
        small(self.line_at(floor(self.text, span.start)))
    }

    /// Returns the line of a byte, from 1.
    fn line_at(&self, byte: usize) -> usize {
        self.lines.partition_point(|start| *start <= byte)
    }

    /// Returns the text of a span.
    pub fn text(&self, span: &Span) -> &'s str {
        let start = floor(self.text, span.start);
        &self.text[start..floor(self.text, span.end).max(start)]
    }

    pub fn count(&self) -> usize {
        self.found.values().map(Vec::len).sum()
    }

    pub fn is_empty(&self) -> bool {
        self.found.is_empty()
    }

    /// Returns all problems in file order.
    pub fn into_error(self) -> ConfigError {
        ConfigError::Problems(self.found.into_values().flatten().collect())
    }
}

fn small(n: usize) -> u32 {
    u32::try_from(n).unwrap_or(u32::MAX)
}

/// Returns the last character boundary at or before `at`.
fn floor(text: &str, at: usize) -> usize {
    let mut at = at.min(text.len());
    while !text.is_char_boundary(at) {
        at -= 1;
    }
    at
}

/// Returns ``did you mean `x`?`` or the list of choices.
pub(crate) fn suggestion<'k>(
    word: &str,
    known: impl IntoIterator<Item = &'k str> + Clone,
    what: &str,
) -> String {
    match nearest(word, known.clone()) {
        Some(k) => format!("did you mean `{k}`?"),
        None => format!("{what}: {}", list(known)),
    }
}

/// Returns a list such as `` `a`, `b`, `c` ``.
pub(crate) fn list<'k>(words: impl IntoIterator<Item = &'k str>) -> String {
    let quoted: Vec<String> = words.into_iter().map(|k| format!("`{k}`")).collect();
    quoted.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nearest_finds_the_probable_name() {
        assert_eq!(nearest("cycel", ["nic", "cycle"]), Some("cycle"));
        assert_eq!(nearest("nick", ["nic", "cycle"]), Some("nic"));
        assert_eq!(nearest("mms", ["ns", "ms", "s"]), Some("ms"));
        assert_eq!(nearest("frobnicate", ["nic", "cycle"]), None);
        let moves = ["move", "move_by", "line", "line_by"];
        assert_eq!(nearest("move_to", moves), Some("move"));
        assert_eq!(nearest("move_bi", moves), Some("move_by"));
    }

    #[test]
    fn problem_puts_the_caret_under_the_marked_text() {
        let text = "a = 1\n\tβeta = \"zwölf\" # c\nc = 2";
        let policy = SignaturePolicy::default();
        let mut problems = Problems::new(Path::new("m.toml"), text, &policy);
        let at = text.find("\"zw").unwrap();
        problems.add_hint(
            at..at + "\"zwölf\"".len(),
            "not a number",
            "write 12\nor 13",
        );
        let ConfigError::Problems(found) = problems.into_error() else {
            panic!()
        };
        assert_eq!((found[0].line, found[0].column, found[0].width), (2, 9, 7));
        let expected = "error: not a number\n --> m.toml:2:9\n  |\n2 | \tβeta = \"zwölf\" # c\n  | \t       ^^^^^^^\n  = help: write 12\n          or 13";
        assert_eq!(found[0].to_string(), expected);
    }

    #[test]
    fn problem_accepts_a_span_past_the_end() {
        for text in ["", "x", "ä", "x\n"] {
            let policy = SignaturePolicy::default();
            let mut problems = Problems::new(Path::new("m.toml"), text, &policy);
            for start in 0..4 {
                problems.add(start..9, "m");
            }
            let ConfigError::Problems(found) = problems.into_error() else {
                panic!()
            };
            assert!(found.iter().all(|p| p.to_string().contains('^')));
        }
    }
}
