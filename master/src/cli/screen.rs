//! The terminal: what stands on stderr at one moment, and how wide lines may be.
//!
//! At most one line passes, written over by the next of its kind; every line that stays goes through here, from whatever thread, and clears that
//! one first. Where there is no terminal nothing is broken and nothing cleared.

use std::io::{self, IsTerminal, Write};
use std::sync::{Mutex, PoisonError};

use indicatif::ProgressBar;

use super::style;

/// The line that passes.
enum Passing {
    Nothing,
    Text,
    Bar(ProgressBar),
}

static PASSING: Mutex<Passing> = Mutex::new(Passing::Nothing);

/// Back to the beginning of the line, and nothing on it.
const CLEAR: &str = "\r\x1b[K";

/// Writes lines that stay.
pub(super) fn stay<T>(write: impl FnOnce(&mut dyn Write) -> T) -> T {
    let mut passing = PASSING.lock().unwrap_or_else(PoisonError::into_inner);
    match &*passing {
        Passing::Bar(bar) => bar.suspend(|| write(&mut style::stderr())),
        Passing::Text => {
            let mut err = style::stderr();
            let _ = err.write_all(CLEAR.as_bytes());
            *passing = Passing::Nothing;
            write(&mut err)
        }
        Passing::Nothing => write(&mut style::stderr()),
    }
}

/// A line that the next one takes the place of, where somebody watches. An empty one is none.
pub(super) fn pass(text: &str) {
    if !style::rewrites() {
        return;
    }
    let mut passing = PASSING.lock().unwrap_or_else(PoisonError::into_inner);
    if matches!(*passing, Passing::Bar(_)) {
        return;
    }
    let shown: String = match stderr_width() {
        // A line that goes round at the end of the terminal cannot be written over.
        Some(width) => text.chars().take(width.saturating_sub(1)).collect(),
        None => text.to_owned(),
    };
    let mut err = style::stderr();
    let _ = write!(err, "{CLEAR}{shown}");
    let _ = err.flush();
    *passing = if text.is_empty() {
        Passing::Nothing
    } else {
        Passing::Text
    };
}

/// A bar that lines which stay are written above, until [`take_down`].
pub(super) fn put_up(bar: &ProgressBar) {
    let mut passing = PASSING.lock().unwrap_or_else(PoisonError::into_inner);
    *passing = Passing::Bar(bar.clone());
}

pub(super) fn take_down() {
    let mut passing = PASSING.lock().unwrap_or_else(PoisonError::into_inner);
    if let Passing::Bar(bar) = &*passing {
        bar.finish_and_clear();
    }
    *passing = Passing::Nothing;
}

/// Log lines are lines that stay. A terminal or reader that is gone is no error: the subscriber would report it on stderr, and
/// panic there.
pub(super) struct Log;

impl Write for Log {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        let _ = stay(|err| err.write_all(buf));
        Ok(buf.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// `None`: stderr is no terminal.
pub(super) fn stderr_width() -> Option<usize> {
    let err = io::stderr();
    err.is_terminal().then(|| columns(&err)).flatten()
}

/// `None`: the result goes to a file or another program.
pub(super) fn stdout_width() -> Option<usize> {
    columns(io::stdout())
}

fn columns(terminal: impl std::os::fd::AsFd) -> Option<usize> {
    let size = rustix::termios::tcgetwinsize(terminal).ok()?;
    Some(usize::from(size.ws_col)).filter(|columns| *columns > 0)
}

/// Lines of prose within a width. What follows a line's beginning is indented: by two more than the line, or behind its `= help: `. Lines of a
/// source file and what points at them stay as they are, and so does a word that is longer than a line.
pub(super) fn wrapped(text: &str, width: Option<usize>) -> String {
    let Some(width) = width else {
        return text.to_owned();
    };
    let mut out = String::with_capacity(text.len());
    for (n, line) in text.split('\n').enumerate() {
        if n > 0 {
            out.push('\n');
        }
        wrap(line, width, &mut out);
    }
    out
}

fn wrap(line: &str, width: usize, out: &mut String) {
    let body = line.trim_start_matches(' ');
    if line.chars().count() <= width || points(body) {
        out.push_str(line);
        return;
    }
    let lead = line.len() - body.len();
    const HELP: &str = "= help: ";
    let hang = if body.starts_with(HELP) {
        HELP.len()
    } else {
        2
    };
    let hang = (lead + hang).min(width / 2);
    out.extend(std::iter::repeat_n(' ', lead));
    let mut used = lead;
    let mut fresh = true;
    for word in body.split_inclusive(' ') {
        let bare = word.trim_end_matches(' ').chars().count();
        if !fresh && used + bare > width {
            out.truncate(out.trim_end_matches(' ').len());
            out.push('\n');
            out.extend(std::iter::repeat_n(' ', hang));
            used = hang;
        }
        out.push_str(word);
        used += word.chars().count();
        fresh = false;
    }
}

/// `3 | text`, `  | ^^^` and ` --> file:3`.
fn points(body: &str) -> bool {
    let rest = body.trim_start_matches(|c: char| c.is_ascii_digit());
    rest.starts_with(" |") || body.starts_with('|') || body.starts_with("-->")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prose_is_broken_between_words() {
        for (text, width, expected) in [
            ("short", 20, "short"),
            (
                "error: one two three four five",
                16,
                "error: one two\n  three four\n  five",
            ),
            (
                "  = help: one two three four",
                22,
                "  = help: one two\n          three four",
            ),
            (
                "  a line that is indented",
                14,
                "  a line that\n    is\n    indented",
            ),
            (
                "a aVeryLongWordIndeed b",
                10,
                "a\n  aVeryLongWordIndeed\n  b",
            ),
            (
                "12 | a line of a file | that goes on",
                10,
                "12 | a line of a file | that goes on",
            ),
            ("   | ^^^^^^^^^^^^^^^^", 10, "   | ^^^^^^^^^^^^^^^^"),
            (
                "  --> a/long/path.toml:3:4",
                10,
                "  --> a/long/path.toml:3:4",
            ),
            ("two words\nand two more", 11, "two words\nand two\n  more"),
            ("", 1, ""),
        ] {
            assert_eq!(wrapped(text, Some(width)), expected, "{text}");
            assert_eq!(wrapped(text, None), text);
        }
    }

    #[test]
    fn nothing_is_lost_at_any_width() {
        let text = "error: the first, the second   and über all others\n  = help: look at `x`";
        let letters = |text: &str| {
            text.split_whitespace()
                .map(str::to_owned)
                .collect::<Vec<_>>()
        };
        for width in 0..90 {
            let shown = wrapped(text, Some(width));
            assert_eq!(letters(&shown), letters(text), "{width}");
            let widest = shown.lines().map(|line| line.chars().count()).max();
            assert!(width < 20 || widest <= Some(width), "{width}: {shown}");
        }
    }
}
