//! Colours, decided in one place: none where the output is no terminal, where TERM is dumb, or where NO_COLOR is set.
//!
//! Text is written with escape sequences, and `anstream` takes them out where they are not wanted. Nothing is said by
//! a colour alone.

use std::io::{self, IsTerminal, Write};

use anstream::{AutoStream, ColorChoice};
use anstyle::{AnsiColor, Style};

const ERROR: Style = AnsiColor::Red.on_default().bold();
const WARNING: Style = AnsiColor::Yellow.on_default().bold();
const HELP: Style = AnsiColor::Cyan.on_default().bold();

/// How the lines of a complaint begin.
const STARTS: [(&str, Style); 4] = [
    ("error:", ERROR),
    ("warning:", WARNING),
    ("  = help:", HELP),
    ("note:", HELP),
];

pub(super) fn stderr() -> impl Write {
    anstream::stderr().lock()
}

/// Whether what goes to stderr is coloured.
pub(super) fn on_stderr() -> bool {
    AutoStream::choice(&io::stderr()) != ColorChoice::Never
}

/// Likewise on stdout.
pub(super) fn on_stdout() -> bool {
    AutoStream::choice(&io::stdout()) != ColorChoice::Never
}

/// Whether lines on stderr can be written over.
pub(super) fn rewrites() -> bool {
    io::stderr().is_terminal() && std::env::var_os("TERM").is_none_or(|term| term != "dumb")
}

/// Lines whose beginning says what they are.
pub(super) fn complaint(out: &mut impl Write, text: &str) -> io::Result<()> {
    for line in text.split('\n') {
        let start = STARTS.iter().find(|(start, _)| line.starts_with(start));
        match start {
            Some((start, style)) => {
                let rest = line.strip_prefix(start).unwrap_or_default();
                writeln!(out, "{style}{start}{style:#}{rest}")?;
            }
            None => writeln!(out, "{line}")?,
        }
    }
    Ok(())
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
    fn beginnings_are_coloured_and_nothing_else() {
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
