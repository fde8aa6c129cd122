//! Pairs of virtual interfaces, and programs at their ends.

#![allow(dead_code, reason = "every test binary uses a part")]
#![allow(clippy::print_stdout, reason = "a skipped test says why")]

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Output, Stdio};
use std::sync::Mutex;
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use ecaxis_tools::bench::veth::VethPair;
use rustix::process::{Pid, Signal, kill_process};

#[path = "retry_on_stall.rs"]
mod retry_on_stall;

pub use retry_on_stall::retry_if_host_stalled;

/// A timeout much longer than any operation.
const PATIENCE: Duration = Duration::from_secs(60);

/// Concurrent tests would compete for processors.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

/// Runs a test over a pair of interfaces, exclusively, with retries after stalls.
pub fn over_a_pair(test: impl Fn(VethPair)) {
    let _alone = ONE_AT_A_TIME.lock();
    retry_if_host_stalled(|| {
        if let Some(pair) = pair() {
            test(pair);
        }
    });
}

/// Prints the reason and returns `None` if interfaces cannot be created.
fn pair() -> Option<VethPair> {
    match VethPair::new() {
        Ok(pair) => Some(pair),
        Err(error) => {
            let root = rustix::process::geteuid().is_root();
            let on_ci = std::env::var_os("CI").is_some();
            assert!(!(root && on_ci), "no pair of interfaces on CI: {error}");
            println!("skipped: a veth pair needs root: {error}");
            None
        }
    }
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

    /// Waits until a message contains this text.
    #[track_caller]
    pub fn says(&mut self, text: &str) {
        let began = Instant::now();
        loop {
            let left = PATIENCE.saturating_sub(began.elapsed());
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
