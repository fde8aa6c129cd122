//! Text for people.

use std::io::{self, IsTerminal, Write};

use ecaxis_tools::document::{Document, Table};
use serde::Serialize;

use crate::failure::{FAILED, Failure, INTERRUPTED};

pub(crate) mod fault_report;
pub(crate) mod live;
pub(crate) mod output;
pub(crate) mod pdo_table;
pub(crate) mod progress;
pub(crate) mod report;
pub(crate) mod selection;
pub(crate) mod style;

/// Prints a result on stdout.
pub(crate) fn result(text: &str) -> Result<(), Failure> {
    let mut out = io::stdout().lock();
    written(out.write_all(text.as_bytes()).and_then(|()| out.flush()))
}

/// Prints prose on stdout. On a terminal, long lines are wrapped.
pub(crate) fn page(text: &str) -> Result<(), Failure> {
    shown(&output::wrapped(text, output::stdout_width()))
}

/// The width of pages with long lines, in columns.
const PAGE: usize = 80;

/// Prints a document. On a terminal, it is wrapped.
pub(crate) fn print(document: &Document) -> Result<(), Failure> {
    shown(&document.text(output::stdout_width()))
}

/// Prints a table alone, without indent.
pub(crate) fn print_table(table: &Table) -> Result<(), Failure> {
    shown(&table.text(0, output::stdout_width()))
}

/// Prints a document with long lines, wrapped to 80 columns or a wider terminal.
pub(crate) fn print_page(document: &Document) -> Result<(), Failure> {
    let width = output::stdout_width().unwrap_or(PAGE).max(PAGE);
    shown(&document.text(Some(width)))
}

/// Prints text with colours for states and findings, on a terminal.
pub(crate) fn shown(text: &str) -> Result<(), Failure> {
    let text = ecaxis_ecat::text::printable(text);
    match style::on_stdout() {
        true => result(&style::decorated(&text)),
        false => result(&text),
    }
}

/// Prints a result as JSON, its keys in order.
pub(crate) fn print_json(value: &impl Serialize) -> Result<(), Failure> {
    let failed = |e| Failure::new(FAILED, format!("cannot write the result: {e}"));
    let json = serde_json::to_string_pretty(value).map_err(failed)?;
    result(&(json + "\n"))
}

/// Maps a write result. A closed pipe (`| head`) is not a failure.
fn written(done: io::Result<()>) -> Result<(), Failure> {
    match done {
        Err(e) if e.kind() != io::ErrorKind::BrokenPipe => Err(Failure::new(
            FAILED,
            format!("cannot write the result: {e}"),
        )),
        _ => Ok(()),
    }
}

/// Splits a remark of a machine file into its lead, `note: ` or `warning: `, and its text.
pub(crate) fn note_of(remark: &str) -> (&'static str, &str) {
    match remark.strip_prefix("warning: ") {
        Some(text) => ("warning: ", text),
        None => ("note: ", remark),
    }
}

/// Prints a line on stderr, unless only errors are wanted.
pub(crate) fn note(text: &str) {
    if output::is_quiet() && !text.starts_with("error:") {
        output::log_message(text);
        return;
    }
    print_always(text);
}

/// Prints a line of a failure on stderr.
pub(crate) fn print_always(text: &str) {
    output::log_message(text);
    let text = ecaxis_ecat::text::printable(text);
    let text = output::wrapped(&text, output::stderr_width());
    let _ = output::print_line(|mut err| style::complaint(&mut err, &text));
}

/// Prints a failure with its hints on stderr.
pub(crate) fn show_failure(failure: &Failure) {
    let prefix = if failure.code == INTERRUPTED || failure.message.starts_with("error: ") {
        ""
    } else {
        "error: "
    };
    print_always(&format!("{prefix}{}", failure.message));
    for hint in &failure.hints {
        print_always(&format!("  = help: {hint}"));
    }
    if let Some(after) = &failure.after {
        print_always(after);
    }
}

pub(crate) fn stderr_is_terminal() -> bool {
    io::stderr().is_terminal()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn output_ignores_only_a_closed_pipe() {
        assert_eq!(written(Ok(())), Ok(()));
        let gone = io::Error::from(io::ErrorKind::BrokenPipe);
        assert_eq!(written(Err(gone)), Ok(()));
        let full = written(Err(io::Error::from(io::ErrorKind::StorageFull))).unwrap_err();
        assert_eq!(full.code, FAILED);
        assert!(full.message.contains("cannot write the result"));
    }
}
