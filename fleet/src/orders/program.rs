//! Runs `ecaxis` and the command that restarts the server.

use std::io::{ErrorKind, Read};
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use crate::error::{Error, Result};

/// The output that is kept of a program, in bytes.
const MAX_OUTPUT: usize = 4 << 20;
/// The time for the output of a program that has ended.
const LAST_OUTPUT: Duration = Duration::from_secs(1);
const POLL: Duration = Duration::from_millis(50);
/// The time for the end after SIGINT.
const END: Duration = Duration::from_secs(10);

/// What a program printed.
#[derive(Debug)]
pub struct Output {
    pub ok: bool,
    pub stdout: String,
    pub stderr: String,
}

impl Output {
    /// Returns the error of `ecaxis`: its first lines.
    #[must_use]
    pub fn reason(&self) -> String {
        let text = match self.stderr.find("error:") {
            Some(at) => self.stderr[at..].trim_start_matches("error:"),
            None if self.stderr.trim().is_empty() => &self.stdout,
            None => &self.stderr,
        };
        let lines: Vec<&str> = text.trim().lines().take(6).collect();
        let text = lines.join("\n");
        match text.char_indices().nth(1000) {
            Some((at, _)) => text[..at].to_owned(),
            None => text,
        }
    }
}

/// Runs a command line until its end. `tick` is called again and again.
///
/// # Errors
/// Fails if the program cannot start, or with the first error of `tick`, once the program has ended.
/// Fails if the program is not done in time. It then gets SIGINT.
pub fn run(
    words: &[String],
    timeout: Duration,
    tick: &mut dyn FnMut() -> Result<()>,
) -> Result<Output> {
    let [program, arguments @ ..] = words else {
        return Err(Error::new("the command is empty"));
    };
    let failed = |error: std::io::Error| Error::new(format!("{program}: {error}"));
    let mut child = Command::new(program)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(failed)?;
    let stdout = child.stdout.take().map(reader);
    let stderr = child.stderr.take().map(reader);
    let begin = Instant::now();
    let mut interrupted = false;
    let mut ticked = Ok(());
    let status = loop {
        if let Some(status) = child.try_wait().map_err(failed)? {
            break status;
        }
        if begin.elapsed() > timeout + END {
            child.kill().map_err(failed)?;
        } else if begin.elapsed() > timeout && !interrupted {
            interrupted = true;
            let pid = i32::try_from(child.id()).ok().and_then(Pid::from_raw);
            pid.map(|pid| kill_process(pid, Signal::INT));
        }
        // Half a firmware is worse than a firmware that another client sees.
        if ticked.is_ok() {
            ticked = tick();
        }
        thread::sleep(POLL);
    };
    if interrupted {
        return Err(Error::new(format!(
            "{program} was not done after {timeout:?}"
        )));
    }
    ticked?;
    Ok(Output {
        ok: status.success(),
        stdout: stdout.map(Reader::text).unwrap_or_default(),
        stderr: stderr.map(Reader::text).unwrap_or_default(),
    })
}

/// What a program has printed so far.
struct Reader {
    kept: Arc<Mutex<Vec<u8>>>,
    thread: thread::JoinHandle<()>,
}

impl Reader {
    /// Returns the output once the pipe is closed. A program in the background may keep it open.
    fn text(self) -> String {
        let end = Instant::now() + LAST_OUTPUT;
        while !self.thread.is_finished() && Instant::now() < end {
            thread::sleep(POLL / 5);
        }
        let kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        String::from_utf8_lossy(&kept).into_owned()
    }
}

fn reader(mut pipe: impl Read + Send + 'static) -> Reader {
    let kept = Arc::<Mutex<Vec<u8>>>::default();
    let fills = Arc::clone(&kept);
    let thread = thread::spawn(move || {
        let mut bytes = [0; 4096];
        // The program must not wait for a full pipe: what is too much is read, and lost.
        loop {
            let length = match pipe.read(&mut bytes) {
                Ok(length @ 1..) => length,
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Ok(_) | Err(_) => return,
            };
            let mut kept = fills.lock().unwrap_or_else(PoisonError::into_inner);
            let rest = MAX_OUTPUT.saturating_sub(kept.len());
            kept.extend(bytes.iter().take(length.min(rest)));
        }
    });
    Reader { kept, thread }
}
