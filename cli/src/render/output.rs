//! The terminal: the transient status line and the width of lines.
//!
//! At most one status line is shown on stderr. All permanent lines are written through this module,
//! which clears the status line first. Without a terminal, no line is wrapped or cleared.

use std::fs::File;
use std::io::{self, IsTerminal, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::SystemTime;

use indicatif::ProgressBar;
use tracing_subscriber::EnvFilter;

use crate::render::style;
use ecaxis_tools::document::format::utc;

/// The status line currently shown.
enum StatusLine {
    Nothing,
    Text,
    Bar(ProgressBar),
}

static PASSING: Mutex<StatusLine> = Mutex::new(StatusLine::Nothing);

/// Returns to column 0 and clears the line.
const CLEAR: &str = "\r\x1b[K";

/// Writes permanent lines.
pub(crate) fn print_line<T>(write: impl FnOnce(&mut dyn Write) -> T) -> T {
    let mut passing = PASSING.lock().unwrap_or_else(PoisonError::into_inner);
    match &*passing {
        StatusLine::Bar(bar) => bar.suspend(|| write(&mut style::stderr())),
        StatusLine::Text => {
            let mut err = style::stderr();
            let _ = err.write_all(CLEAR.as_bytes());
            *passing = StatusLine::Nothing;
            write(&mut err)
        }
        StatusLine::Nothing => write(&mut style::stderr()),
    }
}

/// Replaces the status line, on a terminal only. Empty text clears it.
pub(crate) fn set_status_line(text: &str) {
    if !style::rewrites() || is_quiet() {
        return;
    }
    let mut passing = PASSING.lock().unwrap_or_else(PoisonError::into_inner);
    if matches!(*passing, StatusLine::Bar(_)) {
        return;
    }
    let shown: String = match stderr_width() {
        // A line that wraps at the edge of the terminal cannot be overwritten.
        Some(width) => text.chars().take(width.saturating_sub(1)).collect(),
        None => text.to_owned(),
    };
    let mut err = style::stderr();
    let _ = write!(err, "{CLEAR}{shown}");
    let _ = err.flush();
    *passing = if text.is_empty() {
        StatusLine::Nothing
    } else {
        StatusLine::Text
    };
}

/// Sets a progress bar as the status line, until [`detach_bar`].
pub(crate) fn attach_bar(bar: &ProgressBar) {
    let mut passing = PASSING.lock().unwrap_or_else(PoisonError::into_inner);
    *passing = StatusLine::Bar(bar.clone());
}

pub(crate) fn detach_bar() {
    let mut passing = PASSING.lock().unwrap_or_else(PoisonError::into_inner);
    if let StatusLine::Bar(bar) = &*passing {
        bar.finish_and_clear();
    }
    *passing = StatusLine::Nothing;
}

/// A writer for log lines, which are permanent. It ignores write errors, because the subscriber
/// would report them on stderr and panic.
struct Log;

impl Write for Log {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        let _ = print_line(|err| err.write_all(buf));
        Ok(buf.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Logs events to stderr. RUST_LOG overrides `level`.
pub(crate) fn start_logging(level: &str) {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(|| Log)
        .with_ansi(style::on_stderr())
        .with_timer(tracing_subscriber::fmt::time::uptime())
        .init();
}

/// True if only errors and the result are printed.
static QUIET: AtomicBool = AtomicBool::new(false);

pub(crate) fn set_quiet(quiet: bool) {
    QUIET.store(quiet, Ordering::Relaxed);
}

pub(crate) fn is_quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}

/// The file for log lines and messages.
static LOG_FILE: OnceLock<Mutex<File>> = OnceLock::new();

/// A writer to the log file. It ignores write errors, as [`Log`] does.
struct FileLog;

impl Write for FileLog {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        if let Some(file) = LOG_FILE.get() {
            let mut file = file.lock().unwrap_or_else(PoisonError::into_inner);
            let _ = file.write_all(buf);
        }
        Ok(buf.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// The time of a line in the log file: UTC with milliseconds.
struct Utc;

impl Utc {
    fn now() -> String {
        let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        let since = since.unwrap_or_default();
        format!("{}.{:03}Z", utc(since.as_secs()), since.subsec_millis())
    }
}

impl tracing_subscriber::fmt::time::FormatTime for Utc {
    fn format_time(
        &self,
        out: &mut tracing_subscriber::fmt::format::Writer<'_>,
    ) -> std::fmt::Result {
        out.write_str(&Self::now())
    }
}

/// Logs events and messages to a file, at its end. RUST_LOG overrides `level`.
pub(crate) fn start_log_file(path: &Path, level: &str) -> io::Result<()> {
    let file = File::options().create(true).append(true).open(path)?;
    if LOG_FILE.set(Mutex::new(file)).is_err() {
        return Ok(());
    }
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(|| FileLog)
        .with_ansi(false)
        .with_timer(Utc)
        .init();
    Ok(())
}

/// Adds a message to the log file, if there is one.
pub(crate) fn log_message(text: &str) {
    if LOG_FILE.get().is_some() {
        let _ = FileLog.write_all(format!("{}  NOTE {text}\n", Utc::now()).as_bytes());
    }
}

/// The width of stderr, or `None` if it is not a terminal.
pub(crate) fn stderr_width() -> Option<usize> {
    let err = io::stderr();
    err.is_terminal().then(|| columns(&err)).flatten()
}

/// Columns and rows of stderr, or `None` if it is not a terminal.
pub(crate) fn stderr_size() -> Option<[usize; 2]> {
    let size = rustix::termios::tcgetwinsize(io::stderr()).ok()?;
    let size = [size.ws_col, size.ws_row].map(usize::from);
    (!size.contains(&0)).then_some(size)
}

/// The width of stdout, or `None` if it is not a terminal.
pub(crate) fn stdout_width() -> Option<usize> {
    columns(io::stdout())
}

fn columns(terminal: impl std::os::fd::AsFd) -> Option<usize> {
    let size = rustix::termios::tcgetwinsize(terminal).ok()?;
    Some(usize::from(size.ws_col)).filter(|columns| *columns > 0)
}

/// Wraps prose to `width`. Continuation lines are indented by two, or to the text after `= help: `.
/// Source excerpts and words longer than a line stay unchanged.
pub(crate) fn wrapped(text: &str, width: Option<usize>) -> String {
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

/// True for `3 | text`, `  | ^^^` and ` --> file:3`.
fn points(body: &str) -> bool {
    let rest = body.trim_start_matches(|c: char| c.is_ascii_digit());
    rest.starts_with(" |") || body.starts_with('|') || body.starts_with("-->")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrapped_breaks_prose_between_words() {
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
    fn wrapped_keeps_all_words_at_any_width() {
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
