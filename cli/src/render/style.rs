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

/// Writes a message and colours the prefixes of its lines.
pub(crate) fn complaint(out: &mut impl Write, text: &str) -> io::Result<()> {
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
