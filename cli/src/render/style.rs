//! Colours. They are off if the output is not a terminal, if TERM is `dumb`, or if NO_COLOR is set.
//!
//! Text is written with escape sequences; `anstream` strips them if colours are off. No information
//! is given by colour alone.

use std::io::{self, IsTerminal, Write};

use anstream::{AutoStream, ColorChoice};
use anstyle::{AnsiColor, Style};

const ERROR: Style = AnsiColor::Red.on_default().bold();
const WARNING: Style = AnsiColor::Yellow.on_default().bold();
const HELP: Style = AnsiColor::Cyan.on_default().bold();

const GOOD: Style = AnsiColor::Green.on_default();
const BUSY: Style = AnsiColor::Yellow.on_default();
const BAD: Style = AnsiColor::Red.on_default();

/// The begins of findings in a result and their styles.
const FINDINGS: [(&str, Style); 6] = [
    ("error:", ERROR),
    ("bad:", ERROR),
    ("warning:", WARNING),
    ("note:", HELP),
    ("help:", HELP),
    ("= help:", HELP),
];

/// States in a result and their styles; a state before those that it contains.
const STATES: [(&str, Style); 10] = [
    ("Operation enabled", GOOD),
    ("Fault reaction active", BAD),
    ("Quick stop active", BUSY),
    ("Fault", BAD),
    ("SafeOp + error", BAD),
    ("PreOp + error", BAD),
    ("Init + error", BAD),
    ("SafeOp", BUSY),
    ("Op", GOOD),
    ("no problems", GOOD),
];

/// The prefixes of message lines and their styles.
const STARTS: [(&str, Style); 4] = [
    ("error:", ERROR),
    ("warning:", WARNING),
    ("  = help:", HELP),
    ("note:", HELP),
];

pub(crate) fn stderr() -> impl Write {
    anstream::stderr().lock()
}

/// True if stderr is coloured.
pub(crate) fn on_stderr() -> bool {
    AutoStream::choice(&io::stderr()) != ColorChoice::Never
}

/// True if stdout is coloured.
pub(crate) fn on_stdout() -> bool {
    AutoStream::choice(&io::stdout()) != ColorChoice::Never
}

/// True if lines on stderr can be overwritten.
pub(crate) fn rewrites() -> bool {
    io::stderr().is_terminal() && std::env::var_os("TERM").is_none_or(|term| term != "dumb")
}

/// Colours findings and states in a result for a terminal.
pub(crate) fn decorated(text: &str) -> String {
    let mut out = String::with_capacity(text.len() * 2);
    for line in text.split_inclusive('\n') {
        let body = line.trim_start_matches(' ');
        let (indent, _) = line.split_at(line.len() - body.len());
        out += indent;
        let finding = FINDINGS.iter().find(|(begin, _)| body.starts_with(begin));
        let rest = match finding {
            Some((begin, style)) => {
                out += &format!("{style}{begin}{style:#}");
                body.strip_prefix(begin).unwrap_or_default()
            }
            None => body,
        };
        states(rest, &mut out);
    }
    out
}

/// Colours the states of a line, where they are words of their own.
fn states(line: &str, out: &mut String) {
    let mut rest = line;
    let mut inside = false;
    while let Some(next) = rest.chars().next() {
        let found = STATES.iter().find(|(state, _)| {
            let behind = rest.strip_prefix(state).map(|behind| behind.chars().next());
            !inside && behind.is_some_and(|c| c.is_none_or(|c| !is_word(c)))
        });
        let taken = match found {
            Some((state, style)) => {
                *out += &format!("{style}{state}{style:#}");
                inside = true;
                state.len()
            }
            None => {
                out.push(next);
                inside = is_word(next);
                next.len_utf8()
            }
        };
        rest = rest.get(taken..).unwrap_or_default();
    }
}

fn is_word(c: char) -> bool {
    c.is_alphanumeric() || matches!(c, '_' | '`' | '"' | '\'')
}

/// Writes a message and colours the prefixes of its lines.
pub(crate) fn complaint(out: &mut impl Write, text: &str) -> io::Result<()> {
    let mut lines = String::new();
    for line in text.split('\n') {
        let start = STARTS.iter().find(|(start, _)| line.starts_with(start));
        match start {
            Some((start, style)) => {
                let rest = line.strip_prefix(start).unwrap_or_default();
                lines += &format!("{style}{start}{style:#}{rest}\n");
            }
            None => {
                lines += line;
                lines += "\n";
            }
        }
    }
    // One write: lines of stdout would come between the parts of several.
    out.write_all(lines.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written(text: &str, choice: ColorChoice) -> String {
        let mut out = AutoStream::new(Vec::new(), choice);
        complaint(&mut out, text).unwrap();
        String::from_utf8(out.into_inner()).unwrap()
    }

    #[test]
    fn decorated_colours_states_and_findings_only() {
        let plain = "  x  Op    Fault\n  warning: the Option of `Op` is not Op\n";
        let text = decorated(plain);
        assert_eq!(text.matches("\u{1b}[0m").count(), 4, "{text:?}");
        assert!(
            text.contains("\u{1b}[32mOp\u{1b}[0m    \u{1b}[31mFault\u{1b}[0m\n"),
            "{text:?}"
        );
        let bare = anstream::adapter::strip_str(&text).to_string();
        assert_eq!(bare, plain);
    }

    #[test]
    fn complaint_colours_only_prefixes() {
        let text = "error: no `x`\n  --> m.toml:3\n  = help: write `y`\nthe error: not here";
        let coloured = written(text, ColorChoice::AlwaysAnsi);
        assert_eq!(coloured.matches("\u{1b}[0m").count(), 2, "{coloured:?}");
        assert!(
            coloured.starts_with("\u{1b}[1m\u{1b}[31merror:\u{1b}[0m no `x`\n  --> m.toml:3\n"),
            "{coloured:?}"
        );
        assert_eq!(written(text, ColorChoice::Never), format!("{text}\n"));
    }
}
