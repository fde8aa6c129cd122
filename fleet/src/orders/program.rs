//! Runs `ecaxis` and the command that restarts the server.

use std::io::Read;
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use crate::error::{Error, Result};

/// The output that is kept of a program, in bytes.
const MAX_OUTPUT: u64 = 4 << 20;
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
    let text = |reader: Option<thread::JoinHandle<String>>| {
        reader
            .and_then(|reader| reader.join().ok())
            .unwrap_or_default()
    };
    Ok(Output {
        ok: status.success(),
        stdout: text(stdout),
        stderr: text(stderr),
    })
}

fn reader(mut pipe: impl Read + Send + 'static) -> thread::JoinHandle<String> {
    thread::spawn(move || {
        let mut kept = Vec::new();
        let _ = pipe.by_ref().take(MAX_OUTPUT).read_to_end(&mut kept);
        // The program must not wait for a full pipe.
        let _ = std::io::copy(&mut pipe, &mut std::io::sink());
        String::from_utf8_lossy(&kept).into_owned()
    })
}
