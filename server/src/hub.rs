//! The state that the machine and its clients share.
//!
//! Clients put commands into a queue. The machine takes them about every millisecond, and finishes
//! each with an outcome. Nothing here runs in the cycle.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::pin::Pin;
use std::sync::atomic::Ordering;
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use ecaxis_axis::setpoint::StreamConfig;
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, IndexVec};
use ecaxis_master::clock::{self, Nanos};
use ecaxis_master::config::{Machine, OutputRef, Signal};
use ecaxis_master::link::redundant::RingStatus;
use ecaxis_master::mailbox::Mailboxes;
use ecaxis_master::post_mortem::FaultReport;
use ecaxis_master::report::{DevicePlace, Error};
use ecaxis_master::ros2::topics::Topics;
use ecaxis_master::rt::channel::Snapshot;
use ecaxis_master::samples::Samples;
use ecaxis_master::supervise::operator::{AxisActivity, ProgramRequest, ProgramStatus, Request};
use ecaxis_master::sys::shared_memory::SharedMemory;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};
use tokio::sync::{broadcast, oneshot, watch};

use crate::error::{ErrorCode, OpError};
use crate::external::{AreaCounters, StreamPoint};
use crate::lease::{Claim, ClientId, Lease, Owner};
use crate::sampler::Sampler;
use crate::serve::new_token;

pub use line_shafts::stream_text;
pub use work::{Outcome, QueuedWork, Transfer, Work};
use work::{PendingCommand, abandon, finish, stop_all};

mod line_shafts;
mod published;
mod work;

/// The number of events that the server keeps.
const EVENTS: usize = 1000;
/// The number of fault reports that the server keeps.
const FAULT_REPORTS: usize = 20;
/// The number of commands that may wait for the machine.
const QUEUE: usize = 4096;

/// The state of the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum BusState {
    /// In Init, as a client has asked for.
    Down,
    Starting,
    Op,
    Stopping,
    /// An error has ended the run. The server tries again.
    Failed,
}

impl BusState {
    /// Returns the name in the protocol.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Down => "down",
            Self::Starting => "starting",
            Self::Op => "op",
            Self::Stopping => "stopping",
            Self::Failed => "failed",
        }
    }
}

/// The bus, and why it is not in Op.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BusStatus {
    pub state: BusState,
    pub error: Option<String>,
    pub help: Option<String>,
    /// The time until the next attempt.
    pub retry_s: Option<f64>,
    pub up_since_ns: Option<Nanos>,
}

/// An event.
#[derive(Debug, Clone, PartialEq)]
pub struct Event {
    pub number: u64,
    /// The JSON object.
    pub body: Map<String, Value>,
}

/// The machine at one moment.
#[derive(Debug)]
pub struct Latest {
    pub snapshot: Snapshot,
    pub hands: IndexVec<AxisIndex, AxisActivity>,
    pub program: ProgramStatus,
}

/// The step of the program that runs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Default)]
pub struct RunningStep {
    pub step: Option<String>,
    pub run: u32,
}

/// Turns an error of the master into a message and advice.
pub type Describe = dyn Fn(&Error) -> (String, Option<String>) + Send + Sync;

/// Settings of the server.
#[derive(Debug, Clone)]
pub struct HubOptions {
    /// HTTP clients may command.
    pub control: bool,
    /// The bus runs in virtual time, which clients advance.
    pub virtual_time: bool,
    /// Receives the entries of the change log.
    pub changes: Option<SyncSender<Map<String, Value>>>,
}

#[derive(Debug)]
struct Inner {
    lease: Lease,
    queue: VecDeque<QueuedWork>,
    tickets: u64,
    clients: ClientId,
    pending: HashMap<u64, PendingCommand>,
    wanted_up: bool,
    /// A client has asked for the bus while the server waits for its next attempt.
    retry_now: bool,
    shutdown: bool,
    latest: Option<Arc<Latest>>,
    /// The places of the devices; empty until the bus is up.
    places: IndexVec<DeviceIndex, DevicePlace>,
    ring: Option<&'static RingStatus>,
    mailboxes: Option<Mailboxes>,
    step: RunningStep,
    outputs: Vec<Option<f64>>,
    events: VecDeque<Arc<Event>>,
    fault_reports: VecDeque<Arc<Value>>,
    next_event: u64,
    counts: Counts,
    /// The time to which virtual time may advance.
    advance_to: Nanos,
    /// The present virtual time.
    now: Nanos,
}

/// What the server has counted since its start, for the metrics.
pub type Counts = BTreeMap<(Count, String), u64>;

/// What is counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Count {
    /// Events, by kind.
    Event,
    /// CoE emergencies, by device.
    Emergency,
    /// Faults of a drive, by axis.
    Fault,
    /// Trips, by axis.
    Trip,
    /// Stops, by group.
    Stop,
}

/// The state that all threads of the server share.
pub struct Hub {
    pub machine: Arc<Machine>,
    /// The outputs that clients may set.
    pub outputs: Vec<(OutputRef, Signal)>,
    pub samples: Samples,
    pub sampler: Sampler,
    /// The topics for viewers.
    pub topics: Arc<Topics>,
    pub options: HubOptions,
    pub area: Arc<AreaCounters>,
    setpoints: line_shafts::Setpoints,
    inner: Mutex<Inner>,
    /// The queue, the time or the wanted state has changed.
    work: Condvar,
    events: broadcast::Sender<Arc<Event>>,
    bus: watch::Sender<BusStatus>,
    time: watch::Sender<Nanos>,
}

/// Returns the time in ns since 1970 at which the clock of the samples was 0. Virtual time begins
/// in 1970.
fn epoch(virtual_time: bool) -> Nanos {
    if virtual_time {
        return 0;
    }
    let unix = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    let unix = unix.map_or(0, |unix| u64::try_from(unix.as_nanos()).unwrap_or(u64::MAX));
    unix.saturating_sub(clock::now())
}

impl Hub {
    #[must_use]
    pub fn new(
        machine: Machine,
        outputs: Vec<(OutputRef, Signal)>,
        samples: Samples,
        options: HubOptions,
    ) -> Self {
        let down = BusStatus {
            state: BusState::Down,
            error: None,
            help: None,
            retry_s: None,
            up_since_ns: None,
        };
        Self {
            sampler: Sampler::new(samples.layout().signals.len(), machine.bus.cycle_ns),
            setpoints: line_shafts::Setpoints::new(&machine),
            topics: Arc::new(Topics::new(&machine, epoch(options.virtual_time))),
            machine: Arc::new(machine),
            inner: Mutex::new(Inner {
                lease: Lease::default(),
                queue: VecDeque::new(),
                tickets: 0,
                clients: 1,
                pending: HashMap::new(),
                wanted_up: true,
                retry_now: false,
                shutdown: false,
                latest: None,
                places: IndexVec::default(),
                ring: None,
                mailboxes: None,
                step: RunningStep::default(),
                outputs: vec![None; outputs.len()],
                events: VecDeque::new(),
                fault_reports: VecDeque::new(),
                next_event: 1,
                counts: Counts::new(),
                advance_to: 0,
                now: 0,
            }),
            outputs,
            samples,
            options,
            area: Arc::default(),
            work: Condvar::new(),
            events: broadcast::channel(EVENTS).0,
            bus: watch::channel(down).0,
            time: watch::channel(0).0,
        }
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Like [`Hub::lock`]. A lease whose time is over has ended: what a client may do depends on no
    /// thread that looks at the lease in time.
    fn lock_lease(&self) -> MutexGuard<'_, Inner> {
        let mut inner = self.lock();
        if let Some(owner) = inner.lease.expire(Instant::now()) {
            self.end_lease(&mut inner, &owner, None, "expired");
        }
        inner
    }

    // Clients.

    /// Returns the number of a new client.
    pub fn new_client(&self) -> ClientId {
        let mut inner = self.lock();
        inner.clients += 1;
        inner.clients
    }

    /// Ends whatever a client owned.
    pub fn disconnect(&self, client: ClientId) {
        self.setpoints.disconnect(client);
        let claim = Claim {
            client: Some(client),
            secret: None,
        };
        let mut inner = self.lock_lease();
        if let Some(owner) = inner.lease.release(&claim) {
            self.end_lease(&mut inner, &owner, None, "disconnected");
        }
    }

    /// Renews the lease if the sender holds it.
    pub fn renew(&self, claim: &Claim) {
        self.lock_lease().lease.renew(claim, Instant::now());
    }

    /// Gives the lease to a client. Returns its secret, and the client's number as its owner.
    ///
    /// # Errors
    /// Fails if another client holds it and `force` is not set.
    pub fn take(
        &self,
        claim: &Claim,
        name: String,
        ttl: Duration,
        force: bool,
    ) -> Result<(String, ClientId), OpError> {
        let client = claim.client.unwrap_or_else(|| self.new_client());
        let owner = Owner { client, name };
        let secret = new_token().map_err(|error| {
            let message = format!("the system gives no random numbers: {error}");
            OpError::new(ErrorCode::Failed, message)
        })?;
        let ttl = (!self.options.virtual_time).then_some(ttl);
        let mut inner = self.lock_lease();
        let now = Instant::now();
        let before = inner.lease.holder(now).map(|(holder, _)| holder.clone());
        let (secret, previous) = inner
            .lease
            .take(claim, owner.clone(), secret, ttl, force, now)?;
        let holder = inner.lease.holder(now).map(|(holder, _)| holder.clone());
        let owner = holder.unwrap_or(owner);
        match previous {
            Some(previous) => self.end_lease(&mut inner, &previous, Some(&owner), "taken over"),
            // Without a previous owner, or by the owner itself.
            None => self.report_lease(&mut inner, before.as_ref(), Some(&owner), "taken"),
        }
        Ok((secret, owner.client))
    }

    /// Ends the lease of the sender.
    ///
    /// # Errors
    /// Fails if the sender does not hold it.
    pub fn release(&self, claim: &Claim) -> Result<(), OpError> {
        let mut inner = self.lock_lease();
        inner.lease.check(claim, Instant::now())?;
        if let Some(owner) = inner.lease.release(claim) {
            self.end_lease(&mut inner, &owner, None, "released");
        }
        Ok(())
    }

    /// Ends the lease of a silent owner.
    pub fn expire_lease(&self) {
        drop(self.lock_lease());
    }

    /// Stops everything that the owner moved, before any command of the next owner.
    fn end_lease(&self, inner: &mut Inner, owner: &Owner, next: Option<&Owner>, why: &str) {
        let message = format!("`{}` no longer owns the motion: {why}", owner.name);
        let error = OpError::new(ErrorCode::Replaced, message);
        stop_all(inner, &error);
        let owned = inner.pending.iter().filter(|(_, pending)| pending.owned);
        let owned: Vec<u64> = owned.map(|(ticket, _)| *ticket).collect();
        for ticket in owned {
            abandon(inner, ticket, &error);
        }
        self.area.leases_ended.fetch_add(1, Ordering::Release);
        self.report_lease(inner, Some(owner), next, why);
        self.work.notify_all();
    }

    fn report_lease(
        &self,
        inner: &mut Inner,
        previous: Option<&Owner>,
        owner: Option<&Owner>,
        why: &str,
    ) {
        tracing::info!(?previous, ?owner, why, "lease");
        let body = json!({"event": "lease", "owner": owner, "previous": previous, "why": why});
        self.push_event(inner, body);
    }

    /// Checks that the sender holds the lease.
    ///
    /// # Errors
    /// Says who holds it.
    pub fn check_owner(&self, claim: &Claim) -> Result<(), OpError> {
        Ok(self.lock_lease().lease.check(claim, Instant::now())?)
    }

    // Commands.

    /// Puts the parts of one command into the queue. Returns its number, and the receiver of its
    /// outcome. Virtual time advances while a client waits (`waits`).
    ///
    /// # Errors
    /// Fails if the bus is not in Op or the queue is full.
    pub fn submit(
        &self,
        owner: Option<&Claim>,
        parts: Vec<Work>,
        waits: bool,
    ) -> Result<(u64, oneshot::Receiver<Outcome>), OpError> {
        let mut inner = self.lock_lease();
        // Again, under the lock: the lease may have ended since.
        if let Some(owner) = owner {
            inner.lease.check(owner, Instant::now())?;
        }
        if self.bus_state() != BusState::Op {
            let bus = self.bus.borrow();
            let state = bus.state.name();
            let error = bus
                .error
                .as_ref()
                .map_or_else(String::new, |e| format!(": {e}"));
            let message = format!("the bus is not in Op, but {state}{error}");
            return Err(OpError::new(ErrorCode::NotUp, message)
                .help("wait for it with `await`, or bring it up with `bus`"));
        }
        let capacity = match parts.iter().all(Work::stops) {
            true => 2 * QUEUE,
            false => QUEUE,
        };
        if inner.queue.len() + parts.len() > capacity {
            let error = OpError::new(ErrorCode::Busy, "too many commands wait");
            return Err(error.help("wait for the outcome of earlier commands"));
        }
        inner.tickets += 1;
        let ticket = inner.tickets;
        let (reply, outcome) = oneshot::channel();
        let pending = PendingCommand {
            left: parts.len(),
            failure: None,
            reply: Some(reply),
            waits,
            owned: owner.is_some(),
        };
        inner.pending.insert(ticket, pending);
        let parts = parts.into_iter().map(|work| QueuedWork { ticket, work });
        inner.queue.extend(parts);
        self.work.notify_all();
        Ok((ticket, outcome))
    }

    /// Stops everything at once, before all commands that wait.
    pub fn stop_everything(&self, emergency: bool) {
        let mut inner = self.lock();
        let error = OpError::new(ErrorCode::Replaced, "all axes were stopped");
        stop_all(&mut inner, &error);
        if emergency && !inner.queue.iter().any(|queued| queued.work.is_emergency()) {
            inner.queue.push_back(QueuedWork {
                ticket: 0,
                work: Work::Request(Request::EmergencyStop),
            });
        }
        self.work.notify_all();
    }

    /// Finishes one part of a command.
    pub fn finish(&self, ticket: u64, outcome: Outcome) {
        finish(&mut self.lock(), ticket, outcome);
    }

    /// Takes up to `count` pieces of work, in order. Takes at most `room` of those that do not stop,
    /// and one set of points: the cycle checks each point.
    pub fn take_work(&self, count: usize, room: usize) -> Vec<QueuedWork> {
        let mut inner = self.lock();
        let (mut left, mut points) = (room, false);
        let taken = inner.queue.iter().take(count).take_while(|queued| {
            if queued.work.stops() {
                return true;
            }
            let more = left > 0 && !points;
            left = left.saturating_sub(1);
            points |= matches!(queued.work, Work::Push { .. });
            more
        });
        let taken = taken.count();
        inner.queue.drain(..taken).collect()
    }

    /// Ends all commands: the bus has left Op.
    pub fn fail_all(&self, why: &str) {
        let mut inner = self.lock();
        inner.queue.clear();
        let all: Vec<u64> = inner.pending.keys().copied().collect();
        let error = OpError::new(ErrorCode::NotUp, format!("the bus left Op: {why}"));
        for ticket in all {
            abandon(&mut inner, ticket, &error);
        }
        inner.latest = None;
        inner.places = IndexVec::default();
        inner.ring = None;
        inner.mailboxes = None;
        inner.step = RunningStep::default();
        // The next run has a virtual time of its own.
        inner.advance_to = 0;
        inner.now = 0;
        // A new run begins with these.
        inner.outputs.fill(None);
    }

    // The bus.

    #[must_use]
    pub fn bus_state(&self) -> BusState {
        self.bus.borrow().state
    }

    #[must_use]
    pub fn bus(&self) -> watch::Receiver<BusStatus> {
        self.bus.subscribe()
    }

    /// Sets the state of the bus and reports it.
    pub fn set_bus(&self, status: BusStatus) {
        let mut body = json!(status);
        if let Some(body) = body.as_object_mut() {
            body.insert("event".to_owned(), json!("bus"));
            body.remove("up_since_ns");
        }
        // A client that sees the state also finds its event.
        let mut inner = self.lock();
        self.push_event(&mut inner, body);
        self.bus.send_replace(status);
        drop(inner);
        self.work.notify_all();
    }

    /// Sets whether the bus is to be up.
    pub fn want(&self, up: bool) {
        let mut inner = self.lock();
        inner.wanted_up = up;
        inner.retry_now |= up;
        self.work.notify_all();
    }

    /// Ends the server.
    pub fn shut_down(&self) {
        self.lock().shutdown = true;
        self.work.notify_all();
    }

    #[must_use]
    pub fn is_shut_down(&self) -> bool {
        self.lock().shutdown
    }

    /// Returns true if the bus is to be up.
    #[must_use]
    pub fn is_wanted(&self) -> bool {
        let inner = self.lock();
        inner.wanted_up && !inner.shutdown
    }

    /// Blocks until the bus is to be up. Returns false if the server ends.
    pub fn await_wanted(&self) -> bool {
        let mut inner = self.lock();
        while !inner.wanted_up && !inner.shutdown {
            inner = self
                .work
                .wait(inner)
                .unwrap_or_else(PoisonError::into_inner);
        }
        !inner.shutdown
    }

    /// Blocks until the time is over, or a client wants the bus up at once, or down.
    pub fn await_retry(&self, time: Duration) {
        let end = Instant::now() + time;
        let mut inner = self.lock();
        inner.retry_now = false;
        while inner.wanted_up && !inner.shutdown && !inner.retry_now {
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            let waited = self.work.wait_timeout(inner, left);
            inner = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

fn count(inner: &mut Inner, what: Count, name: &str) {
    *inner.counts.entry((what, name.to_owned())).or_default() += 1;
}

impl std::fmt::Debug for Hub {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Hub")
            .field("machine", &self.machine.path)
            .field("options", &self.options)
            .finish_non_exhaustive()
    }
}
