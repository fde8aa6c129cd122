//! The connection to the socket: requests, answers, file descriptors, events, the lease. Threads
//! share it; one thread of its own reads.

use std::collections::BTreeMap;
use std::io::{IoSliceMut, Write};
use std::mem::MaybeUninit;
use std::net::Shutdown;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use rustix::io::Errno;
use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, recvmsg};
use serde_json::{Map, Value, json};

use crate::{Error, Result};

/// The time for the answer to a question.
const ANSWER: Duration = Duration::from_secs(10);
/// The longest message of a server.
const MAX_MESSAGE: usize = 16 << 20;
/// The outcomes that are kept.
const OUTCOMES: usize = 256;
/// The file descriptors of an answer.
const DESCRIPTORS: usize = 2;
/// The number of the requests that renew the lease.
const RENEWAL: u64 = 0;

/// The number of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Request(u64);

#[derive(Debug)]
struct Lease {
    duration: Duration,
    renewed: Instant,
}

/// A request whose answer is awaited or kept.
#[derive(Debug)]
struct Pending {
    step: Box<str>,
    device: Box<str>,
    answer: Option<Result<Value>>,
}

#[derive(Debug, Default)]
struct State {
    last: u64,
    pending: BTreeMap<u64, Pending>,
    descriptors: Vec<OwnedFd>,
    lease: Option<Lease>,
    /// Why the lease has ended.
    lease_ended: Option<Error>,
    lost: Option<Error>,
}

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug)]
pub(crate) struct Connection {
    /// Not locked while the state is: the reader must go on while a line is written.
    stream: Mutex<UnixStream>,
    shared: Arc<Shared>,
    /// One answer with file descriptors is awaited at a time.
    descriptors: Mutex<()>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Connection {
    /// Connects. The events of subscriptions go to `events`, which ends with the connection.
    pub fn open(path: &Path, events: Option<SyncSender<Value>>) -> Result<Self> {
        let shared = Arc::new(Shared {
            state: Mutex::new(State {
                last: RENEWAL,
                ..State::default()
            }),
            changed: Condvar::new(),
        });
        let for_reader = Arc::clone(&shared);
        let opened = UnixStream::connect(path).and_then(|stream| {
            stream.set_write_timeout(Some(ANSWER))?;
            let reader = stream.try_clone()?;
            let name = thread::Builder::new().name("ecaxis".to_owned());
            name.spawn(move || {
                let lost = for_reader.read(&reader, events.as_ref());
                lock(&for_reader.state).lost.get_or_insert(lost);
                for_reader.changed.notify_all();
            })?;
            Ok(stream)
        });
        let stream = opened.map_err(|error| {
            Error::lost(format!("cannot connect to {}: {error}", path.display()))
                .help("start `ecaxis serve` with this socket")
                .at("attach", "")
        })?;
        Ok(Self {
            stream: Mutex::new(stream),
            shared,
            descriptors: Mutex::new(()),
        })
    }

    /// Asks and returns the answer. `device` names axis or device in errors.
    pub fn ask(&self, op: &str, device: &str, keys: Value) -> Result<Value> {
        self.ask_within(op, device, keys, ANSWER)
    }

    pub fn ask_within(
        &self,
        op: &str,
        device: &str,
        keys: Value,
        timeout: Duration,
    ) -> Result<Value> {
        let number = self.send(op, device, false, keys)?;
        let answer = self.wait_for(number, timeout);
        lock(&self.shared.state).pending.remove(&number);
        answer.unwrap_or_else(|| {
            let cause = format!("the server has not answered within {timeout:?}");
            Err(Error::new("timeout", cause).at(op, device))
        })
    }

    /// Asks and returns the file descriptors that come with the answer.
    pub fn ask_descriptors(&self, op: &str) -> Result<Vec<OwnedFd>> {
        let _alone = lock(&self.descriptors);
        lock(&self.shared.state).descriptors.clear();
        self.ask(op, "", json!({}))?;
        Ok(std::mem::take(&mut lock(&self.shared.state).descriptors))
    }

    /// Sends a command. Its outcome comes later.
    pub fn command(&self, op: &str, device: &str, keys: Value) -> Result<Request> {
        self.send(op, device, true, keys).map(Request)
    }

    /// Returns the outcome of a command; `None` before it is known.
    pub fn outcome(&self, request: Request) -> Option<Result<()>> {
        lock(&self.shared.state).outcome(request.0)
    }

    pub fn wait(&self, request: Request, timeout: Duration) -> Result<()> {
        let late = || {
            let error = Error::new("timeout", format!("no outcome within {timeout:?}"));
            let state = lock(&self.shared.state);
            let pending = state.pending.get(&request.0);
            Err(pending.map_or(error.clone(), |p| error.at(&p.step, &p.device)))
        };
        match self.wait_for(request.0, timeout) {
            Some(answer) => answer.map(drop),
            None => late(),
        }
    }

    /// Waits and keeps the lease.
    pub fn sleep(&self, time: Duration) -> Result<()> {
        let end = Instant::now() + time;
        loop {
            self.keep()?;
            let rest = end.saturating_duration_since(Instant::now());
            if rest.is_zero() {
                return Ok(());
            }
            self.shared.wait(lock(&self.shared.state), rest);
        }
    }

    /// Renews the lease if it is time. Fails once it has ended.
    pub fn keep(&self) -> Result<()> {
        let at = |error: Error| error.at("keep the lease", "");
        self.renew().map_err(at)?;
        let state = lock(&self.shared.state);
        let error = state.lost.as_ref().or(state.lease_ended.as_ref());
        error.map_or(Ok(()), |error| Err(at(error.clone())))
    }

    /// The client owns the motion for this duration after each message; `None`: no longer.
    pub fn set_lease(&self, duration: Option<Duration>) {
        let mut state = lock(&self.shared.state);
        state.lease_ended = None;
        let renewed = Instant::now();
        state.lease = duration.map(|duration| Lease { duration, renewed });
    }

    /// Waits for the answer to a request and keeps the lease meanwhile; `None`: none came in time.
    fn wait_for(&self, number: u64, timeout: Duration) -> Option<Result<Value>> {
        let begin = Instant::now();
        loop {
            let state = lock(&self.shared.state);
            if let Some(answer) = state.answer(number) {
                return Some(answer);
            }
            let rest = timeout.saturating_sub(begin.elapsed());
            if rest.is_zero() {
                return None;
            }
            self.shared.wait(state, rest);
            if let Err(error) = self.renew() {
                return Some(Err(error));
            }
        }
    }

    fn renew(&self) -> Result<()> {
        let now = Instant::now();
        match &mut lock(&self.shared.state).lease {
            Some(lease) if now - lease.renewed > lease.duration / 3 => lease.renewed = now,
            _ => return Ok(()),
        }
        self.write(RENEWAL, "renew", false, json!({}))
    }

    /// Sends a request. Returns its number, under which its answer will be.
    fn send(&self, op: &str, device: &str, wait: bool, keys: Value) -> Result<u64> {
        let number = lock(&self.shared.state)
            .begin(op, device)
            .map_err(|error| error.at(op, device))?;
        self.write(number, op, wait, keys).map_err(|error| {
            lock(&self.shared.state).pending.remove(&number);
            error.at(op, device)
        })?;
        Ok(number)
    }

    fn write(&self, id: u64, op: &str, wait: bool, keys: Value) -> Result<()> {
        let mut object = Map::new();
        if let Value::Object(keys) = keys {
            object.extend(keys);
        }
        object.insert("id".to_owned(), json!(id));
        object.insert("op".to_owned(), json!(op));
        if wait {
            object.insert("wait".to_owned(), json!(true));
        }
        let line = format!("{}\n", Value::Object(object));
        let written = lock(&self.stream).write_all(line.as_bytes());
        written.map_err(|error| {
            let mut state = lock(&self.shared.state);
            let lost = || Error::lost(error.to_string());
            state.lost.get_or_insert_with(lost).clone()
        })
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        // The reader ends, and with it the connection.
        let _ = lock(&self.stream).shutdown(Shutdown::Both);
    }
}

impl State {
    /// Returns the number of a new request.
    fn begin(&mut self, op: &str, device: &str) -> Result<u64> {
        if let Some(lost) = &self.lost {
            return Err(lost.clone());
        }
        let undecided = self.pending.values().filter(|p| p.answer.is_none());
        if undecided.count() >= OUTCOMES {
            let error = Error::new("busy", "too many requests have no outcome yet");
            return Err(error.help("wait for earlier ones"));
        }
        while self.pending.len() >= OUTCOMES {
            let oldest = self.pending.iter().find(|(_, p)| p.answer.is_some());
            let Some((&oldest, _)) = oldest else { break };
            self.pending.remove(&oldest);
        }
        self.last += 1;
        let pending = Pending {
            step: op.into(),
            device: device.into(),
            answer: None,
        };
        self.pending.insert(self.last, pending);
        Ok(self.last)
    }

    /// Returns the answer to a request; `None` before it has come.
    fn answer(&self, number: u64) -> Option<Result<Value>> {
        let Some(pending) = self.pending.get(&number) else {
            let cause = "this request is not known, or its outcome is too old";
            return Some(Err(Error::new("bad_request", cause).at("wait", "")));
        };
        let lost = || {
            let lost = self.lost.clone()?;
            Some(Err(lost.at(&pending.step, &pending.device)))
        };
        pending.answer.clone().or_else(lost)
    }

    fn outcome(&self, number: u64) -> Option<Result<()>> {
        self.answer(number).map(|answer| answer.map(drop))
    }

    /// Takes an answer.
    fn take(&mut self, message: Value) {
        // A line that the server cannot read has an answer without a number.
        let id = message.get("id").map_or(Some(self.last), Value::as_u64);
        let good = message["ok"] == json!(true);
        let error = || Error::of_answer(&message["error"]);
        if id == Some(RENEWAL) && !good && self.lease.take().is_some() {
            self.lease_ended = Some(error());
        }
        if let Some(pending) = id.and_then(|id| self.pending.get_mut(&id)) {
            let answer = match good {
                true => Ok(message),
                false => Err(error().at(&pending.step, &pending.device)),
            };
            pending.answer.get_or_insert(answer);
        }
    }
}

impl Shared {
    /// Waits until something has come, at most until the lease is to be renewed.
    fn wait(&self, state: MutexGuard<'_, State>, timeout: Duration) {
        let most = state.lease.as_ref().map(|lease| lease.duration / 10);
        let timeout = timeout.min(most.unwrap_or(ANSWER));
        drop(self.changed.wait_timeout(state, timeout));
    }

    /// Reads until the connection ends. Returns why.
    fn read(&self, stream: &UnixStream, events: Option<&SyncSender<Value>>) -> Error {
        let mut line = Vec::new();
        let mut buffer = vec![0; 64 << 10];
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(DESCRIPTORS))];
        loop {
            let mut control = RecvAncillaryBuffer::new(&mut space);
            let into = &mut [IoSliceMut::new(&mut buffer)];
            let count = match recvmsg(stream, into, &mut control, RecvFlags::CMSG_CLOEXEC) {
                Err(Errno::INTR) => continue,
                Err(error) => return Error::lost(error.to_string()),
                Ok(message) if message.bytes == 0 => {
                    return Error::lost("the server has closed the connection");
                }
                Ok(message) => message.bytes,
            };
            for message in control.drain() {
                if let RecvAncillaryMessage::ScmRights(descriptors) = message {
                    let kept = &mut lock(&self.state).descriptors;
                    let room = DESCRIPTORS.saturating_sub(kept.len());
                    kept.extend(descriptors.take(room));
                }
            }
            for part in buffer[..count].split_inclusive(|byte| *byte == b'\n') {
                line.extend_from_slice(part);
                if line.len() > MAX_MESSAGE {
                    return Error::protocol("a message of the server is too long");
                }
                if !line.ends_with(b"\n") {
                    continue;
                }
                match serde_json::from_slice(&line) {
                    Ok(message @ Value::Object(_)) if message.get("ok").is_some() => {
                        lock(&self.state).take(message);
                        self.changed.notify_all();
                    }
                    Ok(message @ Value::Object(_)) => {
                        // Events that are not taken wait in the socket, then in the server.
                        let _ = events.map(|events| events.send(message));
                    }
                    _ => {
                        let cause = "a message of the server is not a JSON object";
                        return Error::protocol(cause);
                    }
                }
                line.clear();
            }
        }
    }
}
