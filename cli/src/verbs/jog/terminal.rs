//! The terminal in raw mode on the alternate screen. It is restored on every exit.
//!
//! `Terminal` restores it when dropped. The panic hook restores it before printing, and [`restore`]
//! serves exits without unwinding. Rows are written as a whole; unchanged rows are not sent again.

use std::io::{self, IsTerminal, Write};
use std::sync::{Mutex, Once, PoisonError};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::termios::{OptionalActions, Termios, tcgetattr, tcgetwinsize, tcsetattr};

/// Alternate screen; hide cursor; report focus changes; bracket pasted text.
const ENTER: &[u8] = b"\x1b[?1049h\x1b[?25l\x1b[?1004h\x1b[?2004h\x1b[2J";
const LEAVE: &[u8] = b"\x1b[?2004l\x1b[?1004l\x1b[?25h\x1b[?1049l";

/// The settings to restore, until they are restored.
static TAKEN: Mutex<Option<Termios>> = Mutex::new(None);

/// Why a terminal cannot be used.
#[derive(Debug, thiserror::Error)]
pub(super) enum NoTerminal {
    #[error("standard input or output is not a terminal")]
    None,
    #[error("this terminal (TERM=dumb) cannot be drawn on")]
    Dumb,
    #[error("the terminal cannot be set up: {0}")]
    Failed(#[from] io::Error),
}

#[derive(Debug)]
pub(super) struct Terminal {
    /// The rows currently shown.
    rows: Vec<String>,
    size: (usize, usize),
}

impl Terminal {
    pub fn take() -> Result<Self, NoTerminal> {
        if !(io::stdin().is_terminal() && io::stdout().is_terminal()) {
            return Err(NoTerminal::None);
        }
        if std::env::var_os("TERM").is_none_or(|term| term == "dumb") {
            return Err(NoTerminal::Dumb);
        }
        let before = tcgetattr(io::stdin()).map_err(io::Error::from)?;
        let mut raw = before.clone();
        raw.make_raw();
        *TAKEN.lock().unwrap_or_else(PoisonError::into_inner) = Some(before);
        restore_on_panic();
        // From here on, dropping it restores the settings.
        let terminal = Self {
            rows: Vec::new(),
            size: (0, 0),
        };
        tcsetattr(io::stdin(), OptionalActions::Flush, &raw).map_err(io::Error::from)?;
        let mut out = io::stdout().lock();
        out.write_all(ENTER)?;
        out.flush()?;
        drop(out);
        Ok(terminal)
    }

    /// Columns and rows; 80 × 24 if unknown.
    pub fn size(&self) -> (usize, usize) {
        match tcgetwinsize(io::stdout()) {
            Ok(size) if size.ws_col > 0 && size.ws_row > 0 => {
                (usize::from(size.ws_col), usize::from(size.ws_row))
            }
            _ => (80, 24),
        }
    }

    /// Shows rows with their escape sequences. No row is wider than the terminal.
    pub fn show(&mut self, rows: Vec<String>) -> io::Result<()> {
        let size = self.size();
        let mut bytes = Vec::new();
        if size != self.size {
            (self.size, self.rows) = (size, Vec::new());
            bytes.extend_from_slice(b"\x1b[2J");
        }
        for (index, row) in rows.iter().take(size.1).enumerate() {
            if self.rows.get(index) != Some(row) {
                bytes.extend_from_slice(format!("\x1b[{};1H{row}\x1b[K", index + 1).as_bytes());
            }
        }
        if rows.len() < self.rows.len() {
            bytes.extend_from_slice(format!("\x1b[{};1H\x1b[J", rows.len() + 1).as_bytes());
        }
        self.rows = rows;
        if bytes.is_empty() {
            return Ok(());
        }
        let mut out = io::stdout().lock();
        out.write_all(&bytes)?;
        out.flush()
    }

    /// Returns the bytes typed within the time, or nothing after a time-out.
    ///
    /// # Errors
    /// Fails if the terminal is gone.
    pub fn read(&mut self, milliseconds: u32) -> io::Result<Vec<u8>> {
        let stdin = io::stdin();
        let time = Timespec {
            tv_sec: 0,
            tv_nsec: i64::from(milliseconds.min(999)) * 1_000_000,
        };
        let mut fds = [PollFd::new(&stdin, PollFlags::IN)];
        match poll(&mut fds, Some(&time)) {
            Ok(0) | Err(rustix::io::Errno::INTR) => return Ok(Vec::new()),
            Ok(_) => {}
            Err(error) => return Err(error.into()),
        }
        let mut bytes = vec![0; 4096];
        match rustix::io::read(&stdin, &mut bytes) {
            Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(n) => {
                bytes.truncate(n);
                Ok(bytes)
            }
            Err(rustix::io::Errno::INTR | rustix::io::Errno::AGAIN) => Ok(Vec::new()),
            Err(error) => Err(error.into()),
        }
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        restore();
    }
}

/// True if the terminal settings are not restored yet.
pub(super) fn ours() -> bool {
    let taken = TAKEN.lock().unwrap_or_else(PoisonError::into_inner);
    taken.is_some()
}

/// Restores the terminal if it was set up. Only the first call has an effect.
pub(super) fn restore() {
    let mut taken = TAKEN.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(before) = taken.take() {
        // A closed terminal needs no restoring.
        let _ = rustix::io::write(io::stdout(), LEAVE);
        let _ = tcsetattr(io::stdin(), OptionalActions::Flush, &before);
    }
}

fn restore_on_panic() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let report = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            restore();
            report(panic);
        }));
    });
}
