//! One client: carries out its requests.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use ecaxis_axis::setpoint::{Interpolation, Knot, MotionLimits, StreamConfig};
use ecaxis_axis::{MAX_RATE, Mode};
use ecaxis_ecat::data_type::{DataType, Kind};
use ecaxis_ecat::index::{AxisIndex, GroupIndex};
use ecaxis_ecat::text::is_hidden;
use ecaxis_esi::address;
use ecaxis_master::clock;
use ecaxis_master::mailbox::worker::MailboxError;
use ecaxis_master::supervise::operator::{NodeCommand, ProgramRequest, Request as MachineRequest};
use ecaxis_master::sys::shared_memory::SharedMemory;
use serde_json::{Map, Value, json};
use tokio::sync::Semaphore;

use crate::command::{
    ALL, Access, BusAction, Index, InterpolationName, NodeAction, Op, Point, ProgramAction, Request,
};
use crate::diagnostics::diagnostics_as_json;
use crate::error::{ErrorCode, OpError};
use crate::external::{STREAM_POINTS, StreamPoint, command_area};
use crate::hub::{BusState, Hub, Outcome, Transfer, Work};
use crate::lease::{Claim, ClientId};
use crate::state;

mod coe;
mod parts;

/// The requests of one client that may wait for an outcome at once.
const WAITING: usize = 256;
/// The age in ns of a state from which no client may jog.
const OLD_NS: u64 = 500_000_000;
/// The messages of one jog follow each other within this time.
const JOG_PAUSE_NS: u64 = 1_000_000_000;
/// The torque offset (CiA 402).
const TORQUE_OFFSET: u16 = 0x60b2;
/// The longest name of a client.
const NAME_LENGTH: usize = 64;
/// The longest text of a note, in characters.
const NOTE_LENGTH: usize = 2000;

/// The answer to a request.
#[derive(Debug)]
pub struct Answer {
    pub body: Map<String, Value>,
    /// The status over HTTP.
    pub status: u16,
    /// Memory that the answer passes on: the samples, and these commands.
    pub area: Option<Arc<SharedMemory>>,
}

/// A connection, or all HTTP requests with one token.
#[derive(Debug)]
pub struct Client {
    pub hub: Arc<Hub>,
    pub id: ClientId,
    name: Mutex<String>,
    /// Why the client may not command.
    refusal: Mutex<Option<OpError>>,
    /// The client may not even read.
    blind: AtomicBool,
    waiting: Semaphore,
    /// Several programs are this client (HTTP): each names its lease, and answers of commands come
    /// with the outcome by default.
    shared: bool,
    /// The client can receive file descriptors.
    takes_memory: bool,
    /// Process and user at the other end.
    peer: Value,
    /// The time of the last jog.
    jogged: AtomicU64,
    gone: AtomicBool,
}

/// An entry of the change log, which is written when this value is dropped: also for a request
/// whose client is gone before the outcome.
struct Change {
    changes: SyncSender<Map<String, Value>>,
    entry: Map<String, Value>,
    outcome: String,
}

impl Change {
    fn end(mut self, result: &Result<Map<String, Value>, OpError>) {
        self.outcome = match result {
            Ok(_) => "ok".to_owned(),
            Err(error) => error.message.clone(),
        };
    }
}

impl Drop for Change {
    fn drop(&mut self) {
        let mut entry = std::mem::take(&mut self.entry);
        entry.insert("outcome".to_owned(), json!(self.outcome));
        if self.changes.try_send(entry).is_err() {
            tracing::warn!("the change log is too slow: an entry is lost");
        }
    }
}

impl Client {
    /// Creates a client. `refusal` says why it may not command; `shared`: several programs are this
    /// client.
    #[must_use]
    pub fn new(hub: Arc<Hub>, name: &str, refusal: Option<OpError>, shared: bool) -> Self {
        let id = hub.new_client();
        Self {
            id,
            name: Mutex::new(format!("{name} {id}")),
            refusal: Mutex::new(refusal),
            blind: AtomicBool::new(false),
            waiting: Semaphore::new(WAITING),
            shared,
            takes_memory: false,
            peer: Value::Null,
            jogged: AtomicU64::new(0),
            gone: AtomicBool::new(false),
            hub,
        }
    }

    /// The client can receive file descriptors.
    #[must_use]
    pub fn with_memory(mut self) -> Self {
        self.takes_memory = true;
        self
    }

    /// Names process and user at the other end.
    #[must_use]
    pub fn with_peer(mut self, peer: Value) -> Self {
        self.peer = peer;
        self
    }

    /// The client may not read either, for the reason why it may not command.
    pub fn set_blind(&self, blind: bool) {
        self.blind.store(blind, Ordering::Relaxed);
    }

    /// Fails if the client may not read.
    ///
    /// # Errors
    /// Says why.
    pub fn check_read(&self) -> Result<(), OpError> {
        match self
            .refusal()
            .filter(|_| self.blind.load(Ordering::Relaxed))
        {
            Some(refusal) => Err(refusal),
            None => Ok(()),
        }
    }

    /// Allows or forbids commands.
    pub fn set_refusal(&self, refusal: Option<OpError>) {
        *self.refusal.lock().unwrap_or_else(PoisonError::into_inner) = refusal;
    }

    #[must_use]
    pub fn refusal(&self) -> Option<OpError> {
        let refusal = self.refusal.lock();
        refusal.unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn name(&self) -> String {
        let name = self.name.lock();
        name.unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn rename(&self, name: &str) {
        let name: String = name
            .chars()
            .filter(|c| !is_hidden(*c))
            .take(NAME_LENGTH)
            .collect();
        if !name.trim().is_empty() {
            *self.name.lock().unwrap_or_else(PoisonError::into_inner) = name;
        }
    }

    /// Carries out a request. Ends when its answer is known.
    pub async fn answer(&self, request: Request) -> Answer {
        let claim = Claim {
            client: (!self.shared).then_some(self.id),
            secret: request.lease,
        };
        let mut area = None;
        let result = match request.op {
            Err(error) => Err(error),
            Ok(op) => {
                // Who only reads does not move anything: its program may have lost the machine.
                if op.access() != Access::Read {
                    self.hub.renew(&claim);
                }
                let change = self.change(&op);
                let result = self.carry_out(op, &claim, request.wait, &mut area).await;
                if let Some(change) = change {
                    change.end(&result);
                }
                result
            }
        };
        let (mut body, status) = match result {
            Ok(mut body) => {
                body.insert("ok".to_owned(), Value::Bool(true));
                (body, 200)
            }
            Err(error) => (error.answer(), error.code.status()),
        };
        if let Some(id) = request.id {
            body.insert("id".to_owned(), id);
        }
        Answer { body, status, area }
    }

    /// Begins the entry of the change log for an operation that belongs there. Clients that may not
    /// command have no entries: they could fill the log.
    fn change(&self, op: &Op) -> Option<Change> {
        let changes = self.hub.options.changes.clone()?;
        if !op.is_change()
            || self.refusal().is_some()
            || matches!(op, Op::Jog { .. }) && !self.begins_jog()
        {
            return None;
        }
        let mut entry = Map::new();
        entry.insert("machine".to_owned(), json!(self.hub.machine.path));
        let sha256 = self.hub.machine.sha256.to_string();
        entry.insert("sha256".to_owned(), json!(sha256));
        let client = json!({"id": self.id, "name": self.name(), "peer": self.peer});
        entry.insert("client".to_owned(), client);
        let mut command = json!(op);
        if let Op::Note { text } = op {
            // A longer one is refused, and shall not fill the log.
            command["text"] = json!(text.chars().take(NOTE_LENGTH).collect::<String>());
        }
        entry.insert("command".to_owned(), command);
        let outcome = "the client was gone before the outcome".to_owned();
        Some(Change {
            changes,
            entry,
            outcome,
        })
    }

    /// True if a jog begins: the messages of one follow each other within [`JOG_PAUSE_NS`].
    fn begins_jog(&self) -> bool {
        let now = clock::now();
        let before = self.jogged.swap(now, Ordering::Relaxed);
        before == 0 || now.saturating_sub(before) > JOG_PAUSE_NS
    }

    async fn carry_out(
        &self,
        op: Op,
        claim: &Claim,
        wait: Option<bool>,
        area: &mut Option<Arc<SharedMemory>>,
    ) -> Result<Map<String, Value>, OpError> {
        let access = op.access();
        self.check_read()?;
        if access != Access::Read
            && let Some(refusal) = self.refusal()
        {
            return Err(refusal);
        }
        if access == Access::Lease {
            self.hub.check_owner(claim)?;
        }
        let hub = &self.hub;
        match op {
            Op::Hello { name } => {
                if let Some(name) = name {
                    self.rename(&name);
                }
                Ok(object(json!({
                    "server": "ecaxis", "version": env!("CARGO_PKG_VERSION"), "protocol": 1,
                    "client": self.id, "name": self.name(), "control": self.refusal().is_none(),
                    "virtual": hub.options.virtual_time,
                })))
            }
            Op::Machine {} => Ok(object(state::machine(hub))),
            Op::State {} => Ok(object(state::state(hub))),
            Op::Events { after } => {
                let events = hub.events_after(after);
                let events: Vec<_> = events.iter().map(|event| &event.body).collect();
                Ok(object(json!({"events": events})))
            }
            Op::FaultReports {} => {
                let reports = hub.fault_reports();
                // No command waits for the copy.
                let copy = move || reports.iter().map(|report| Value::clone(report)).collect();
                let copied = tokio::task::spawn_blocking(copy).await;
                let copied = copied.map_err(|error| {
                    OpError::new(ErrorCode::Failed, format!("no fault reports: {error}"))
                })?;
                let mut answer = Map::new();
                answer.insert("reports".to_owned(), Value::Array(copied));
                Ok(answer)
            }
            Op::Diagnostics {} => Ok(object(json!({"diagnostics": diagnostics_as_json(hub)}))),
            Op::Await { bus, timeout_ms } => self.await_bus(bus, timeout_ms).await,
            Op::SdoRead {
                device,
                index,
                sub,
                complete,
            } => self.sdo_read(&device, &index, sub, complete).await,
            Op::SdoWrite {
                device,
                index,
                sub,
                data,
                value,
                complete,
            } => {
                let bytes = self.sdo_bytes(&device, &index, sub, data, value)?;
                self.sdo_write(claim, &device, &index, sub, complete, &bytes)
                    .await
            }
            // The entry of the change log is all that this operation does.
            Op::Note { text } if text.chars().count() > NOTE_LENGTH => {
                let message = format!("`text` has more than {NOTE_LENGTH} characters");
                Err(OpError::new(ErrorCode::BadRequest, message))
            }
            Op::Note { .. } => Ok(Map::new()),
            Op::Take {
                name,
                ttl_ms,
                force,
            } => {
                if let Some(name) = name {
                    self.rename(&name);
                }
                let default = hub.machine.server.lease_ns / 1_000_000;
                let ttl = ttl_ms.unwrap_or(default);
                if !(100..=60_000).contains(&ttl) {
                    let message = format!("`ttl_ms` is {ttl}: it must be 100 to 60000");
                    return Err(OpError::new(ErrorCode::BadRequest, message));
                }
                let lasts = Duration::from_millis(ttl);
                let (secret, client) = hub.take(claim, self.name(), lasts, force)?;
                Ok(object(
                    json!({"client": client, "ttl_ms": ttl, "lease": secret}),
                ))
            }
            Op::Renew {} => {
                hub.check_owner(claim)?;
                Ok(Map::new())
            }
            Op::Release {} => {
                hub.release(claim)?;
                Ok(Map::new())
            }
            Op::Stop {} => {
                hub.stop_everything(false);
                Ok(Map::new())
            }
            Op::EmergencyStop {} => {
                hub.stop_everything(true);
                Ok(Map::new())
            }
            Op::Bus { action } => {
                hub.want(action == BusAction::Up);
                Ok(Map::new())
            }
            Op::Advance { cycles, seconds } => self.advance(cycles, seconds).await,
            Op::Area {} if !self.takes_memory => {
                let message = "memory is passed over the socket only";
                Err(OpError::new(ErrorCode::BadRequest, message)
                    .help("connect to the Unix socket of the server"))
            }
            Op::Area {} => {
                let memory = command_area(hub.machine.axes.len()).map_err(|error| {
                    let message = format!("the system gives no memory: {error}");
                    OpError::new(ErrorCode::Failed, message)
                })?;
                let memory = Arc::new(memory);
                let parts = vec![Work::Attach(Arc::clone(&memory))];
                let keys = self.submit(Some(claim), parts, true).await?;
                *area = Some(memory);
                Ok(keys)
            }
            // The requests of all HTTP clients with a token are one client, which never leaves.
            Op::LineShaft { .. } if self.shared => {
                let message = "a line shaft needs a connection that stays";
                Err(OpError::new(ErrorCode::BadRequest, message)
                    .help("use the WebSocket or the Unix socket"))
            }
            Op::LineShaft {
                name,
                stream,
                points,
            } => {
                let accepted = hub.feed_line_shaft(self.id, &name, &stream, &points)?;
                Ok(object(json!({"accepted": accepted})))
            }
            Op::Token { .. } | Op::Subscribe { .. } | Op::Unsubscribe { .. } => {
                let message = "this connection has no subscriptions";
                Err(OpError::new(ErrorCode::BadRequest, message)
                    .help("use the WebSocket or the Unix socket"))
            }
            op => {
                let streams = matches!(
                    op,
                    Op::StreamOpen { .. } | Op::StreamPush { .. } | Op::StreamClose { .. }
                );
                let parts = self.parts(op)?;
                let owner = (access == Access::Lease).then_some(claim);
                let waits = streams || wait.unwrap_or(self.shared);
                self.submit(owner, parts, waits).await
            }
        }
    }

    /// Hands a command to the machine, and waits for its outcome if `wait` is set.
    async fn submit(
        &self,
        owner: Option<&Claim>,
        parts: Vec<Work>,
        wait: bool,
    ) -> Result<Map<String, Value>, OpError> {
        let busy = || {
            OpError::new(ErrorCode::Busy, "too many requests of this client wait")
                .help("wait for the outcome of earlier ones")
        };
        let _place = self.waiting.try_acquire().map_err(|_| busy())?;
        if parts.is_empty() {
            return Ok(Map::new());
        }
        let (request, outcome) = self.hub.submit(owner, parts, wait)?;
        let mut answer = Map::new();
        if wait {
            let outcome = outcome.await;
            let closed = || OpError::new(ErrorCode::NotUp, "the server has ended");
            answer = outcome
                .unwrap_or_else(|_| Err(closed()))
                .map_err(|error| error.with("request", request))?;
        }
        answer.insert("request".to_owned(), json!(request));
        Ok(answer)
    }

    async fn await_bus(
        &self,
        state: BusState,
        timeout_ms: u64,
    ) -> Result<Map<String, Value>, OpError> {
        let mut bus = self.hub.bus();
        let _place = self
            .waiting
            .try_acquire()
            .map_err(|_| OpError::new(ErrorCode::Busy, "too many requests of this client wait"))?;
        let reached = bus.wait_for(|bus| bus.state == state);
        let timeout = Duration::from_millis(timeout_ms.min(86_400_000));
        let reached = tokio::time::timeout(timeout, reached).await;
        if matches!(reached, Ok(Ok(_))) {
            return Ok(Map::new());
        }
        let bus = self.hub.bus().borrow().clone();
        let why = bus
            .error
            .map_or_else(String::new, |error| format!(": {error}"));
        let now = bus.state.name();
        let error = OpError::new(ErrorCode::Timeout, format!("the bus is {now}{why}"));
        Err(match bus.help {
            Some(help) => error.help(help),
            None => error,
        })
    }

    async fn advance(
        &self,
        cycles: Option<u64>,
        seconds: Option<f64>,
    ) -> Result<Map<String, Value>, OpError> {
        let hub = &self.hub;
        if !hub.options.virtual_time {
            let message = "time is real: it advances by itself";
            return Err(OpError::new(ErrorCode::BadRequest, message)
                .help("start the server with --sim --virtual"));
        }
        let most = 3600.0 * 24.0;
        let nanos = match (cycles, seconds) {
            (Some(cycles), None) => cycles.saturating_mul(hub.machine.bus.cycle_ns),
            // Checked above 0 and below a day.
            (None, Some(seconds)) if seconds >= 0.0 && seconds <= most => (seconds * 1e9) as u64,
            _ => {
                let message = "`advance` needs either `cycles` or `seconds`, at most a day";
                return Err(OpError::new(ErrorCode::BadRequest, message));
            }
        };
        let mut time = hub.virtual_time();
        let mut bus = hub.bus();
        let end = hub.advance(nanos);
        tokio::select! {
            _ = time.wait_for(|now| *now >= end) => {}
            _ = bus.wait_for(|bus| bus.state != BusState::Op) => {}
        }
        let now = *hub.virtual_time().borrow();
        if now < end {
            let bus = hub.bus().borrow().clone();
            let why = bus
                .error
                .unwrap_or_else(|| "the bus is not in Op".to_owned());
            return Err(OpError::new(ErrorCode::NotUp, why));
        }
        Ok(object(json!({"time_ns": now})))
    }

    /// Ends whatever the client owned. Called once, also when the connection breaks.
    pub fn leave(&self) {
        if !self.gone.swap(true, Ordering::Relaxed) {
            self.hub.disconnect(self.id);
        }
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        self.leave();
    }
}

fn object(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_without_an_outcome_has_an_entry() {
        let (changes, entries) = std::sync::mpsc::sync_channel(2);
        let change = || Change {
            changes: changes.clone(),
            entry: Map::new(),
            outcome: "gone".to_owned(),
        };
        // The future of the request was dropped.
        drop(change());
        change().end(&Ok(Map::new()));
        let outcomes: Vec<_> = entries
            .try_iter()
            .map(|entry| entry["outcome"].clone())
            .collect();
        assert_eq!(outcomes, ["gone", "ok"]);
    }
}
