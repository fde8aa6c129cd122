//! The program as a child process.

use std::ffi::OsStr;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use crate::root;

/// A timeout much longer than any operation.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Returns the path of `ecaxis`, which cargo builds two folders above the tests.
pub fn ecaxis() -> PathBuf {
    let test = std::env::current_exe().expect("Linux");
    let folder = test.parent().and_then(Path::parent).expect("a folder");
    folder.join("ecaxis")
}

/// Returns the command for `ecaxis`, in the root of the workspace.
pub fn command() -> Command {
    let mut command = Command::new(ecaxis());
    command.current_dir(root()).stdin(Stdio::null());
    command
}

/// The result of a command.
#[derive(Debug)]
pub struct Ran {
    pub code: i32,
    pub out: String,
    pub err: String,
}

impl Ran {
    /// Runs a command until it exits.
    #[track_caller]
    pub fn new(command: &mut Command) -> Self {
        let output = command.output().expect("the binary runs");
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("UTF-8");
        Self {
            code: output.status.code().expect("an exit code"),
            out: text(output.stdout),
            err: text(output.stderr),
        }
    }

    /// Checks the exit code.
    #[track_caller]
    pub fn exits(self, code: i32) -> Self {
        assert_eq!(self.code, code, "{}{}", self.out, self.err);
        self
    }

    /// Checks the exit code of a rejected command and the parts of its message.
    #[track_caller]
    pub fn fails(&self, code: i32, parts: &[&str]) {
        assert_eq!(self.code, code, "{}{}", self.out, self.err);
        crate::assert_contains(&self.err, parts);
    }

    #[track_caller]
    pub fn json(&self) -> Value {
        let json = serde_json::from_str(&self.out);
        json.unwrap_or_else(|e| panic!("{e}: {}{}", self.out, self.err))
    }
}

/// Runs `ecaxis` in the root of the workspace, with a temporary cache.
#[track_caller]
pub fn run<S: AsRef<OsStr>>(arguments: impl IntoIterator<Item = S>) -> Ran {
    let cache = tempfile::tempdir().expect("a folder");
    let mut command = command();
    command.env("XDG_CACHE_HOME", cache.path());
    Ran::new(command.args(arguments))
}

/// A running program whose messages are read. Dropping this value ends the program.
pub struct ProgramOutput {
    child: Child,
    lines: Receiver<String>,
    heard: String,
}

impl ProgramOutput {
    pub fn start(command: &mut Command) -> Self {
        let mut child = command.stderr(Stdio::piped()).spawn().expect("it starts");
        let messages = BufReader::new(child.stderr.take().expect("piped"));
        let (to, lines) = channel();
        std::thread::spawn(move || {
            for line in messages.lines() {
                let Ok(line) = line else { return };
                if to.send(line).is_err() {
                    return;
                }
            }
        });
        Self {
            child,
            lines,
            heard: String::new(),
        }
    }

    /// Returns the process ID.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Returns the messages so far.
    pub fn heard(&self) -> &str {
        &self.heard
    }

    /// Waits until a message contains this text.
    #[track_caller]
    pub fn says(&mut self, text: &str) {
        let began = Instant::now();
        loop {
            let left = TIMEOUT.saturating_sub(began.elapsed());
            match self.lines.recv_timeout(left) {
                Ok(line) => {
                    self.heard += &line;
                    self.heard.push('\n');
                    if line.contains(text) {
                        return;
                    }
                }
                Err(RecvTimeoutError::Timeout) => panic!("never `{text}`:\n{}", self.heard),
                Err(RecvTimeoutError::Disconnected) => {
                    panic!("ended without `{text}`:\n{}", self.heard)
                }
            }
        }
    }

    /// Sends SIGINT, like Ctrl-C.
    pub fn interrupt(&self) {
        self.signal(Signal::INT);
    }

    pub fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).expect("it runs");
    }

    /// True while the program runs.
    pub fn runs(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// Waits for the exit and returns the output with all messages.
    pub fn end(mut self) -> Output {
        let stdout = self.child.stdout.take();
        let stdout = stdout.map(std::io::read_to_string).transpose();
        let status = self.child.wait().expect("it ends");
        let rest = self.lines.iter().map(|line| line + "\n");
        self.heard.extend(rest);
        Output {
            status,
            stdout: stdout.expect("text").unwrap_or_default().into_bytes(),
            stderr: std::mem::take(&mut self.heard).into_bytes(),
        }
    }
}

impl Drop for ProgramOutput {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
