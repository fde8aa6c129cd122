//! The terminal while it is ours: raw, on the other screen, and given back on every way out.
//!
//! `Terminal` gives it back when it is dropped, a panic anywhere gives it back before it is told, and [`restore`] does
//! for those who leave without unwinding. No library does the drawing: rows are written whole, and what the
//! terminal shows already is not sent again.

use std::io::{self, IsTerminal, Write};
use std::sync::{Mutex, Once, PoisonError};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::termios::{OptionalActions, Termios, tcgetattr, tcgetwinsize, tcsetattr};

/// The other screen; no cursor; tell when the focus comes and goes; mark what is pasted.
const ENTER: &[u8] = b"\x1b[?1049h\x1b[?25l\x1b[?1004h\x1b[?2004h\x1b[2J";
const LEAVE: &[u8] = b"\x1b[?2004l\x1b[?1004l\x1b[?25h\x1b[?1049l";

/// What to give back, as long as it has not been.
static TAKEN: Mutex<Option<Termios>> = Mutex::new(None);

/// Why there is no terminal to draw on.
#[derive(Debug, thiserror::Error)]
pub(super) enum NoTerminal {
    #[error("standard input or output is no terminal")]
    None,
    #[error("this terminal (TERM=dumb) cannot be drawn on")]
    Dumb,
    #[error("the terminal cannot be set up: {0}")]
    Failed(#[from] io::Error),
}

#[derive(Debug)]
pub(super) struct Terminal {
    /// As it is shown.
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
        // From here on dropping it gives back what was taken.
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

    /// Columns and rows; 80 × 24 where it does not say.
    pub fn size(&self) -> (usize, usize) {
        match tcgetwinsize(io::stdout()) {
            Ok(size) if size.ws_col > 0 && size.ws_row > 0 => {
                (usize::from(size.ws_col), usize::from(size.ws_row))
            }
            _ => (80, 24),
        }
    }

    /// Shows rows with their escape sequences, no wider than the terminal.
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

    /// What has been typed within the time. Nothing: time is over.
    ///
    /// # Errors
    /// The terminal is gone.
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

/// Whether the terminal is still ours.
pub(super) fn ours() -> bool {
    let taken = TAKEN.lock().unwrap_or_else(PoisonError::into_inner);
    taken.is_some()
}

/// Gives the terminal back, if it was taken. Whoever calls it first does it.
pub(crate) fn restore() {
    let mut taken = TAKEN.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(before) = taken.take() {
        // A terminal that is gone needs nothing back.
        let _ = rustix::io::write(io::stdout(), LEAVE);
        let _ = tcsetattr(io::stdin(), OptionalActions::Flush, &before);
    }
}

fn restore_on_panic() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let tell = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            restore();
            tell(panic);
        }));
    });
}
