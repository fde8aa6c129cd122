//! The connection to the socket: requests, answers, file descriptors, the lease.

use std::collections::BTreeMap;
use std::io::{IoSliceMut, Write};
use std::mem::MaybeUninit;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::Path;
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

#[derive(Debug)]
struct Pending {
    step: String,
    device: String,
    outcome: Option<Result<()>>,
}

#[derive(Debug)]
pub(crate) struct Connection {
    stream: UnixStream,
    input: Vec<u8>,
    descriptors: Vec<OwnedFd>,
    last: u64,
    /// The question that is being answered, and its answer.
    question: Option<(u64, Option<Value>)>,
    pending: BTreeMap<Request, Pending>,
    lease: Option<Lease>,
    /// Why the lease has ended.
    lease_ended: Option<Error>,
    lost: Option<Error>,
}

impl Connection {
    pub fn open(path: &Path) -> Result<Self> {
        let stream = UnixStream::connect(path)
            .and_then(|stream| {
                stream.set_write_timeout(Some(ANSWER))?;
                Ok(stream)
            })
            .map_err(|error| {
                Error::lost(format!("cannot connect to {}: {error}", path.display()))
                    .help("start `ecaxis serve` with this socket")
                    .at("attach", "")
            })?;
        Ok(Self {
            stream,
            input: Vec::new(),
            descriptors: Vec::new(),
            last: RENEWAL,
            question: None,
            pending: BTreeMap::new(),
            lease: None,
            lease_ended: None,
            lost: None,
        })
    }

    /// Asks and returns the answer. `device` names axis or device in errors.
    pub fn ask(&mut self, op: &str, device: &str, keys: Value) -> Result<Value> {
        self.ask_within(op, device, keys, ANSWER)
    }

    pub fn ask_within(
        &mut self,
        op: &str,
        device: &str,
        keys: Value,
        timeout: Duration,
    ) -> Result<Value> {
        let at = |error: Error| error.at(op, device);
        let begin = Instant::now();
        self.descriptors.clear();
        self.last += 1;
        self.question = Some((self.last, None));
        self.send(self.last, op, false, keys).map_err(at)?;
        loop {
            if let Some((_, Some(answer))) = self.question.take_if(|(_, a)| a.is_some()) {
                return match answer["ok"] == json!(true) {
                    true => Ok(answer),
                    false => Err(at(Error::of_answer(&answer["error"]))),
                };
            }
            let rest = timeout.saturating_sub(begin.elapsed());
            if rest.is_zero() {
                self.question = None;
                let cause = format!("the server has not answered within {timeout:?}");
                return Err(at(Error::new("timeout", cause)));
            }
            self.renew().map_err(at)?;
            self.receive(rest).map_err(at)?;
        }
    }

    /// Sends a command. Its outcome comes later.
    pub fn command(&mut self, op: &str, device: &str, keys: Value) -> Result<Request> {
        let undecided = self.pending.values().filter(|p| p.outcome.is_none());
        if undecided.count() >= OUTCOMES {
            let error = Error::new("busy", "too many requests have no outcome yet");
            return Err(error.help("wait for earlier ones").at(op, device));
        }
        while self.pending.len() >= OUTCOMES {
            let oldest = self.pending.iter().find(|(_, p)| p.outcome.is_some());
            let Some(oldest) = oldest.map(|(request, _)| *request) else {
                break;
            };
            self.pending.remove(&oldest);
        }
        self.last += 1;
        let request = Request(self.last);
        self.send(request.0, op, true, keys)
            .map_err(|error| error.at(op, device))?;
        let pending = Pending {
            step: op.to_owned(),
            device: device.to_owned(),
            outcome: None,
        };
        self.pending.insert(request, pending);
        Ok(request)
    }

    /// Returns the outcome of a command; `None` before it is known.
    pub fn outcome(&mut self, request: Request) -> Option<Result<()>> {
        if let Err(error) = self.receive(Duration::ZERO) {
            return Some(Err(error.at("wait", "")));
        }
        let unknown = || {
            let cause = "this request is not known, or its outcome is too old";
            Some(Err(Error::new("bad_request", cause).at("wait", "")))
        };
        self.pending
            .get(&request)
            .map_or_else(unknown, |pending| pending.outcome.clone())
    }

    pub fn wait(&mut self, request: Request, timeout: Duration) -> Result<()> {
        let begin = Instant::now();
        loop {
            if let Some(outcome) = self.outcome(request) {
                return outcome;
            }
            let rest = timeout.saturating_sub(begin.elapsed());
            if rest.is_zero() {
                let error = Error::new("timeout", format!("no outcome within {timeout:?}"));
                let pending = self.pending.get(&request);
                return Err(pending.map_or(error.clone(), |p| error.at(&p.step, &p.device)));
            }
            self.renew()?;
            self.receive(rest)?;
        }
    }

    /// Waits and keeps the lease.
    pub fn sleep(&mut self, time: Duration) -> Result<()> {
        let begin = Instant::now();
        loop {
            let rest = time.saturating_sub(begin.elapsed());
            if rest.is_zero() {
                return Ok(());
            }
            self.keep()?;
            self.receive(rest).map_err(|error| error.at("sleep", ""))?;
        }
    }

    /// Renews the lease if it is time. Fails once it has ended.
    pub fn keep(&mut self) -> Result<()> {
        let at = |error: Error| error.at("keep the lease", "");
        self.renew().map_err(at)?;
        self.receive(Duration::ZERO).map_err(at)?;
        self.lease_ended.clone().map_or(Ok(()), |e| Err(at(e)))
    }

    /// The client owns the motion for this duration after each message; `None`: no longer.
    pub fn set_lease(&mut self, duration: Option<Duration>) {
        self.lease_ended = None;
        let renewed = Instant::now();
        self.lease = duration.map(|duration| Lease { duration, renewed });
    }

    /// Returns the file descriptors that came with the last answer.
    pub fn take_descriptors(&mut self) -> Vec<OwnedFd> {
        std::mem::take(&mut self.descriptors)
    }

    fn renew(&mut self) -> Result<()> {
        let now = Instant::now();
        match &mut self.lease {
            Some(lease) if now - lease.renewed > lease.duration / 3 => lease.renewed = now,
            _ => return Ok(()),
        }
        self.send(RENEWAL, "renew", false, json!({}))
    }

    fn send(&mut self, id: u64, op: &str, wait: bool, keys: Value) -> Result<()> {
        if let Some(lost) = &self.lost {
            return Err(lost.clone());
        }
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
        self.stream
            .write_all(line.as_bytes())
            .map_err(|error| self.lose(Error::lost(error.to_string())))
    }

    fn lose(&mut self, error: Error) -> Error {
        self.lost.get_or_insert(error).clone()
    }

    /// Receives what comes within `timeout`, and at most until the lease is to be renewed.
    fn receive(&mut self, timeout: Duration) -> Result<()> {
        if let Some(lost) = &self.lost {
            return Err(lost.clone());
        }
        let most = self.lease.as_ref().map(|lease| lease.duration / 10);
        let timeout = timeout.min(most.unwrap_or(ANSWER));
        // Zero would mean: no limit.
        let (wait, flags) = match timeout.is_zero() {
            true => (None, RecvFlags::DONTWAIT),
            false => (Some(timeout), RecvFlags::empty()),
        };
        self.stream
            .set_read_timeout(wait)
            .map_err(|error| self.lose(Error::lost(error.to_string())))?;
        let mut buffer = vec![0; 64 << 10];
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(2))];
        let mut control = RecvAncillaryBuffer::new(&mut space);
        let received = recvmsg(
            &self.stream,
            &mut [IoSliceMut::new(&mut buffer)],
            &mut control,
            flags | RecvFlags::CMSG_CLOEXEC,
        );
        let count = match received {
            Err(Errno::AGAIN | Errno::INTR) => return Ok(()),
            Err(error) => return Err(self.lose(Error::lost(error.to_string()))),
            Ok(message) => message.bytes,
        };
        for message in control.drain() {
            if let RecvAncillaryMessage::ScmRights(descriptors) = message {
                let room = 2_usize.saturating_sub(self.descriptors.len());
                self.descriptors.extend(descriptors.take(room));
            }
        }
        if count == 0 {
            return Err(self.lose(Error::lost("the server has closed the connection")));
        }
        let searched = self.input.len();
        self.input.extend_from_slice(&buffer[..count]);
        if !self.input[searched..].contains(&b'\n') {
            let long = self.input.len() > MAX_MESSAGE;
            let error = || Error::protocol("a message of the server is too long");
            return if long {
                Err(self.lose(error()))
            } else {
                Ok(())
            };
        }
        let input = std::mem::take(&mut self.input);
        for line in input.split_inclusive(|byte| *byte == b'\n') {
            if !line.ends_with(b"\n") {
                self.input = line.to_vec();
                break;
            }
            match serde_json::from_slice(line) {
                Ok(message @ Value::Object(_)) => self.take(message),
                _ => {
                    let cause = "a message of the server is not a JSON object";
                    return Err(self.lose(Error::protocol(cause)));
                }
            }
        }
        Ok(())
    }

    /// Takes one message: an answer, or an event, which nothing here needs.
    fn take(&mut self, message: Value) {
        let Some(ok) = message.get("ok") else {
            return;
        };
        // A line that the server cannot read has an answer without a number.
        let id = message.get("id").map_or(Some(self.last), Value::as_u64);
        let Some(id) = id else { return };
        let error = || Error::of_answer(&message["error"]);
        if id == RENEWAL {
            if *ok != json!(true) && self.lease.take().is_some() {
                self.lease_ended = Some(error());
            }
            return;
        }
        match &mut self.question {
            Some((number, answer)) if *number == id => {
                *answer = Some(message);
            }
            _ => {
                if let Some(pending) = self.pending.get_mut(&Request(id)) {
                    let outcome = match *ok == json!(true) {
                        true => Ok(()),
                        false => Err(error().at(&pending.step, &pending.device)),
                    };
                    pending.outcome.get_or_insert(outcome);
                }
            }
        }
    }
}
