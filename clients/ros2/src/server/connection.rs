//! Requests, answers and events over the socket.

use std::collections::HashMap;
use std::fmt;
use std::io::{IoSliceMut, Write};
use std::mem::MaybeUninit;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, ReturnFlags, recvmsg};
use serde_json::{Value, json};

/// The longest line of the server.
const MAX_LINE: usize = 16 << 20;

/// Why a request failed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServerError {
    pub code: String,
    pub message: String,
    pub help: Option<String>,
}

impl ServerError {
    fn new(code: &str, message: impl Into<String>) -> Self {
        Self {
            code: code.to_owned(),
            message: message.into(),
            help: None,
        }
    }
}

impl fmt::Display for ServerError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)?;
        match &self.help {
            Some(help) => write!(f, "; help: {help}"),
            None => Ok(()),
        }
    }
}

#[derive(Debug, Default)]
struct Waiting {
    lost: bool,
    answers: HashMap<u64, Sender<Value>>,
    descriptors: Vec<OwnedFd>,
}

/// A connection, shared by threads.
#[derive(Debug)]
pub struct Connection {
    stream: Mutex<UnixStream>,
    waiting: Arc<Mutex<Waiting>>,
    numbers: AtomicU64,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Connection {
    /// Connects, and returns the events besides. They end with the connection.
    ///
    /// # Errors
    /// Fails if no server listens.
    pub fn open(path: &Path) -> std::io::Result<(Self, Receiver<Value>)> {
        let stream = UnixStream::connect(path)?;
        let reader = stream.try_clone()?;
        let waiting = Arc::new(Mutex::new(Waiting::default()));
        let (events_in, events) = channel();
        let shared = Arc::clone(&waiting);
        thread::Builder::new()
            .name("socket".to_owned())
            .spawn(move || {
                read(&reader, &shared, &events_in);
                let mut waiting = lock(&shared);
                waiting.lost = true;
                waiting.answers.clear();
            })?;
        let connection = Self {
            stream: Mutex::new(stream),
            waiting,
            numbers: AtomicU64::new(1),
        };
        Ok((connection, events))
    }

    /// Sends a request and returns its answer.
    ///
    /// # Errors
    /// Fails if the server refuses it, or does not answer in time.
    pub fn request(&self, mut request: Value, timeout: Duration) -> Result<Value, ServerError> {
        let number = self.numbers.fetch_add(1, Ordering::Relaxed);
        request["id"] = json!(number);
        let lost = || ServerError::new("lost", "the connection to the server is lost");
        let (sender, answer) = channel();
        {
            let mut waiting = lock(&self.waiting);
            if waiting.lost {
                return Err(lost());
            }
            waiting.answers.insert(number, sender);
        }
        let sent = lock(&self.stream).write_all(format!("{request}\n").as_bytes());
        let answer = match sent {
            Ok(()) => answer.recv_timeout(timeout),
            Err(_) => return Err(lost()),
        };
        lock(&self.waiting).answers.remove(&number);
        let answer = answer.map_err(|error| match error {
            std::sync::mpsc::RecvTimeoutError::Timeout => ServerError::new(
                "timeout",
                format!("no answer within {} s", timeout.as_secs()),
            ),
            std::sync::mpsc::RecvTimeoutError::Disconnected => lost(),
        })?;
        if answer["ok"].as_bool() == Some(true) {
            return Ok(answer);
        }
        let error = &answer["error"];
        let text = |key: &str| error[key].as_str().map(str::to_owned);
        Err(ServerError {
            code: text("code").unwrap_or_default(),
            message: text("message").unwrap_or_else(|| answer.to_string()),
            help: text("help"),
        })
    }

    /// Returns the two descriptors of the answer to `area`.
    #[must_use]
    pub fn area(&self) -> Option<[OwnedFd; 2]> {
        std::mem::take(&mut lock(&self.waiting).descriptors)
            .try_into()
            .ok()
    }

    /// Closes the connection.
    pub fn close(&self) {
        let _ = lock(&self.stream).shutdown(std::net::Shutdown::Both);
    }
}

fn read(stream: &UnixStream, waiting: &Mutex<Waiting>, events: &Sender<Value>) {
    let mut line = Vec::new();
    let mut bytes = vec![0; 1 << 16];
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(4))];
    loop {
        let mut control = RecvAncillaryBuffer::new(&mut space);
        let into = &mut [IoSliceMut::new(&mut bytes)];
        let received = recvmsg(stream, into, &mut control, RecvFlags::CMSG_CLOEXEC);
        let count = match received {
            Ok(received) if received.bytes > 0 && !received.flags.contains(ReturnFlags::CTRUNC) => {
                received.bytes
            }
            Err(rustix::io::Errno::INTR) => continue,
            _ => return,
        };
        for message in control.drain() {
            if let RecvAncillaryMessage::ScmRights(descriptors) = message {
                lock(waiting).descriptors.extend(descriptors);
            }
        }
        for part in bytes[..count].split_inclusive(|byte| *byte == b'\n') {
            line.extend_from_slice(part);
            if line.len() > MAX_LINE {
                return;
            }
            if line.last() != Some(&b'\n') {
                continue;
            }
            let Ok(value) = serde_json::from_slice::<Value>(&line) else {
                return;
            };
            line.clear();
            if value.get("ok").is_none() {
                let _ = events.send(value);
            } else if let Some(number) = value["id"].as_u64()
                && let Some(answer) = lock(waiting).answers.remove(&number)
            {
                let _ = answer.send(value);
            }
        }
    }
}
