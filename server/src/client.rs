//! One client: carries out its requests.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use ecaxis_axis::Mode;
use ecaxis_axis::setpoint::{Interpolation, Knot, MotionLimits, StreamConfig};
use ecaxis_ecat::data_type::{DataType, Kind};
use ecaxis_ecat::index::AxisIndex;
use ecaxis_esi::address;
use ecaxis_master::mailbox::worker::MailboxError;
use ecaxis_master::supervise::operator::{ProgramRequest, Request as MachineRequest};
use ecaxis_master::sys::shared_memory::SharedMemory;
use serde_json::{Map, Value, json};
use tokio::sync::Semaphore;

use crate::command::{
    ALL, Access, BusAction, Index, InterpolationName, Op, Point, ProgramAction, Request,
};
use crate::error::{ErrorCode, OpError};
use crate::external::{STREAM_POINTS, StreamPoint, command_area};
use crate::hub::{BusState, Hub, Outcome, Transfer, Work};
use crate::lease::ClientId;
use crate::state;

/// The requests of one client that may wait for an outcome at once.
const WAITING: usize = 256;
/// The age in ns of a state from which no client may jog.
const OLD_NS: u64 = 500_000_000;
/// The torque offset (CiA 402).
const TORQUE_OFFSET: u16 = 0x60b2;
/// The longest name of a client.
const NAME_LENGTH: usize = 64;

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
    /// Answers of commands come with the outcome by default.
    waits: bool,
    /// The client can receive file descriptors.
    takes_memory: bool,
    gone: AtomicBool,
}

impl Client {
    /// Creates a client. `refusal` says why it may not command; `waits`: its commands wait for the
    /// outcome by default.
    #[must_use]
    pub fn new(hub: Arc<Hub>, name: &str, refusal: Option<OpError>, waits: bool) -> Self {
        let id = hub.new_client();
        Self {
            id,
            name: Mutex::new(format!("{name} {id}")),
            refusal: Mutex::new(refusal),
            blind: AtomicBool::new(false),
            waiting: Semaphore::new(WAITING),
            waits,
            takes_memory: false,
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
            .filter(|c| !c.is_control())
            .take(NAME_LENGTH)
            .collect();
        if !name.trim().is_empty() {
            *self.name.lock().unwrap_or_else(PoisonError::into_inner) = name;
        }
    }

    /// Carries out a request. Ends when its answer is known.
    pub async fn answer(&self, request: Request) -> Answer {
        self.hub.renew(self.id);
        let mut area = None;
        let result = match request.op {
            Err(error) => Err(error),
            Ok(op) => self.carry_out(op, request.wait, &mut area).await,
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

    async fn carry_out(
        &self,
        op: Op,
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
            self.hub.check_owner(self.id)?;
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
            Op::FaultReports {} => Ok(object(json!({"reports": hub.fault_reports()}))),
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
                self.sdo_write(&device, &index, sub, complete, &bytes).await
            }
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
                hub.take(self.id, self.name(), Duration::from_millis(ttl), force)?;
                Ok(object(json!({"client": self.id, "ttl_ms": ttl})))
            }
            Op::Renew {} => {
                hub.check_owner(self.id)?;
                Ok(Map::new())
            }
            Op::Release {} => {
                hub.release(self.id)?;
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
                let keys = self
                    .submit(true, vec![Work::Attach(Arc::clone(&memory))], true)
                    .await?;
                *area = Some(memory);
                Ok(keys)
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
                self.submit(
                    access == Access::Lease,
                    parts,
                    streams || wait.unwrap_or(self.waits),
                )
                .await
            }
        }
    }

    /// Hands a command to the machine, and waits for its outcome if `wait` is set.
    async fn submit(
        &self,
        needs_lease: bool,
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
        let owner = needs_lease.then_some(self.id);
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

    /// Returns the parts of a command.
    fn parts(&self, op: Op) -> Result<Vec<Work>, OpError> {
        let each = |axis: &str, request: &dyn Fn(AxisIndex) -> MachineRequest| {
            let axes = self.axes(axis)?;
            let parts = axes.into_iter().map(|axis| Work::Request(request(axis)));
            Ok(parts.collect())
        };
        let one = |axis: &str, request: &dyn Fn(AxisIndex) -> MachineRequest| {
            Ok(vec![Work::Request(request(self.axis(axis)?))])
        };
        match op {
            Op::Enable { axis } => each(&axis, &|axis| MachineRequest::Enable { axis }),
            Op::Disable { axis } => each(&axis, &|axis| MachineRequest::Disable { axis }),
            Op::Halt { axis } => each(&axis, &|axis| MachineRequest::Stop { axis }),
            Op::QuickStop { axis } => each(&axis, &|axis| MachineRequest::QuickStop { axis }),
            Op::Reset { axis } => each(&axis, &|axis| MachineRequest::Reset { axis }),
            Op::Move {
                axis,
                to,
                by,
                speed,
            } => match (to, by) {
                (Some(position), None) => one(&axis, &|axis| MachineRequest::MoveTo {
                    axis,
                    position,
                    speed,
                }),
                (None, Some(distance)) => one(&axis, &|axis| MachineRequest::MoveBy {
                    axis,
                    distance,
                    speed,
                }),
                _ => Err(OpError::new(
                    ErrorCode::BadRequest,
                    "`move` needs either `to` or `by`",
                )),
            },
            Op::Velocity { axis, velocity } => {
                one(&axis, &|axis| MachineRequest::Velocity { axis, velocity })
            }
            Op::Jog {
                seen_ns: Some(seen),
                ..
            } if self.is_old(seen) => {
                let message = "the client has not seen the machine for 500 ms";
                Err(OpError::new(ErrorCode::Refused, message)
                    .help("let the button go, and hold it again"))
            }
            Op::Jog { axis, velocity, .. } => {
                one(&axis, &|axis| MachineRequest::Jog { axis, velocity })
            }
            Op::Torque {
                axis,
                torque,
                ramp_s,
            } => one(&axis, &|axis| MachineRequest::Torque {
                axis,
                percent: torque,
                ramp_s,
            }),
            Op::Home { axis } => one(&axis, &|axis| MachineRequest::Home { axis }),
            Op::Mode { axis, mode } => {
                let at = self.axis(&axis)?;
                let mode = self.mode(at, &mode)?;
                one(&axis, &|axis| MachineRequest::SetMode { axis, mode })
            }
            Op::Output {
                device,
                output,
                value,
            } => self.output(&device, &output, value),
            Op::Override { factor } if factor > 0.0 && factor <= 1.0 => {
                Ok(vec![Work::Request(MachineRequest::Override { factor })])
            }
            Op::Override { factor } => {
                let message = format!("`factor` is {factor}: it must be above 0 and at most 1");
                Err(OpError::new(ErrorCode::BadRequest, message))
            }
            Op::Program { action } => {
                let request = match action {
                    ProgramAction::Start => ProgramRequest::Start,
                    ProgramAction::Pause => ProgramRequest::Pause,
                    ProgramAction::Resume => ProgramRequest::Resume,
                    ProgramAction::Step => ProgramRequest::Step,
                    ProgramAction::Stop => ProgramRequest::Stop,
                };
                Ok(vec![Work::Request(MachineRequest::Program(request))])
            }
            Op::StreamOpen {
                axis,
                interval_ms,
                interpolation,
                prefill,
            } => {
                let axis = self.axis(&axis)?.0;
                let config = self.stream(interval_ms, interpolation, prefill);
                Ok(vec![Work::Open { axis, config }])
            }
            Op::StreamPush { axis, points } if points.len() <= STREAM_POINTS => {
                let axis = self.axis(&axis)?;
                if points
                    .iter()
                    .any(|point| matches!(point, Point::WithTorque(_)))
                {
                    self.check_torque_offset(axis)?;
                }
                let points = points.iter().map(|point| {
                    let (position, velocity, torque) = match *point {
                        Point::Position([position]) => (position, 0.0, 0.0),
                        Point::WithVelocity([position, velocity]) => (position, velocity, 0.0),
                        Point::WithTorque([position, velocity, torque]) => {
                            (position, velocity, torque)
                        }
                    };
                    let knot = Knot { position, velocity };
                    StreamPoint { knot, torque }
                });
                let (axis, points) = (axis.0, points.collect());
                Ok(vec![Work::Push { axis, points }])
            }
            Op::StreamPush { points, .. } => {
                let message = format!("{} points at once; at most {STREAM_POINTS}", points.len());
                Err(OpError::new(ErrorCode::BadRequest, message))
            }
            Op::StreamClose { axis } => Ok(vec![Work::Close {
                axis: self.axis(&axis)?.0,
            }]),
            _ => Err(OpError::new(ErrorCode::BadRequest, "not a command")),
        }
    }

    fn check_torque_offset(&self, axis: AxisIndex) -> Result<(), OpError> {
        let machine = &self.hub.machine;
        let mapped = machine.axes.get(axis).is_some_and(|setup| {
            let object = ecaxis_esi::axis::object(TORQUE_OFFSET, setup.number);
            let device = machine.devices.get(setup.device);
            device.is_some_and(|d| d.selection.layout.rx_field(object, 0).is_some())
        });
        mapped.then_some(()).ok_or_else(|| {
            let message = "a torque feed-forward needs 0x60B2 in the process data";
            OpError::new(ErrorCode::Refused, message)
                .help("add it with `pdo.rx` in the machine file")
        })
    }

    fn is_old(&self, seen_ns: u64) -> bool {
        self.hub.now().saturating_sub(seen_ns) > OLD_NS
    }

    fn axis(&self, name: &str) -> Result<AxisIndex, OpError> {
        let mut axes = self.hub.machine.axes.enumerate();
        let found = axes.find(|(_, axis)| axis.name == name);
        found.map(|(index, _)| index).ok_or_else(|| {
            let names = self.hub.machine.axes.iter().map(|axis| axis.name.as_str());
            let names: Vec<_> = names.collect();
            OpError::new(
                ErrorCode::UnknownName,
                format!("no axis is called `{name}`"),
            )
            .help(format!("the axes are {}", names.join(", ")))
        })
    }

    fn axes(&self, name: &str) -> Result<Vec<AxisIndex>, OpError> {
        match name {
            ALL => Ok(self.hub.machine.axes.indices().collect()),
            name => Ok(vec![self.axis(name)?]),
        }
    }

    fn mode(&self, axis: AxisIndex, name: &str) -> Result<Mode, OpError> {
        let setup = self.hub.machine.axes.get(axis);
        let modes: Vec<_> = setup
            .map(|setup| state::modes(setup).collect())
            .unwrap_or_default();
        let mut known = modes.iter();
        let found = known.find(|mode: &&Mode| mode.to_string().eq_ignore_ascii_case(name));
        found.copied().ok_or_else(|| {
            let modes = modes.iter().map(|mode| mode.to_string().to_lowercase());
            let modes: Vec<_> = modes.collect();
            OpError::new(
                ErrorCode::UnknownName,
                format!("the axis has no mode `{name}`"),
            )
            .help(format!("the machine file prepares {}", modes.join(", ")))
        })
    }

    fn output(&self, device: &str, name: &str, value: f64) -> Result<Vec<Work>, OpError> {
        let machine = &self.hub.machine;
        let mut outputs = self.hub.outputs.iter();
        let found = outputs.find(|(_, signal)| {
            let address = address(signal.field.index, signal.field.sub).to_string();
            let (of, own) = state::split(machine, signal);
            of == device && (own.eq_ignore_ascii_case(name) || address.eq_ignore_ascii_case(name))
        });
        let Some((output, _)) = found else {
            let message = format!("`{device}` has no output `{name}` that a client may set");
            return Err(
                OpError::new(ErrorCode::UnknownName, message).help("`machine` lists the outputs")
            );
        };
        let output = *output;
        Ok(vec![Work::Request(MachineRequest::SetOutput {
            output,
            value,
        })])
    }

    fn stream(
        &self,
        interval_ms: f64,
        interpolation: InterpolationName,
        prefill: usize,
    ) -> StreamConfig {
        StreamConfig {
            interpolation: match interpolation {
                InterpolationName::Cubic => Interpolation::Cubic,
                InterpolationName::Linear => Interpolation::Linear,
            },
            interval_s: interval_ms * 1e-3,
            prefill,
            // The cycle knows the limits of the axis.
            limits: MotionLimits {
                velocity: 0.0,
                acceleration: 0.0,
                jerk: 0.0,
            },
            range: None,
            dt_s: self.hub.machine.bus.cycle_ns as f64 * 1e-9,
        }
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
        let now = format!("{:?}", bus.state).to_lowercase();
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

    // CoE.

    fn data_type(&self, device: &str, index: u16, sub: u8) -> Option<DataType> {
        let device = state::device_named(&self.hub.machine, device)?;
        let dictionary = &self.hub.machine.devices.get(device)?.selection.dictionary;
        let item = dictionary.item(index, sub)?;
        DataType::named(&item.type_name, item.bit_len)
    }

    async fn sdo_read(
        &self,
        device: &str,
        index: &Index,
        sub: u8,
        complete: bool,
    ) -> Result<Map<String, Value>, OpError> {
        let number = index.number()?;
        let mailbox = self.hub.mailboxes()?.device(device).map_err(refused)?;
        let data_type = self.data_type(device, number, sub).filter(|_| !complete);
        let transfer = async move {
            let read = match complete {
                true => mailbox.upload_complete(number, sub).await,
                false => mailbox.upload(number, sub).await,
            };
            let bytes = read.map_err(refused)?;
            let mut answer = object(json!({"data": hex(&bytes)}));
            if let Some(data_type) = data_type {
                answer.insert("value".to_owned(), value(data_type, &bytes));
            }
            Ok(answer)
        };
        self.transfer(false, transfer).await
    }

    async fn transfer(
        &self,
        needs_lease: bool,
        transfer: impl Future<Output = Outcome> + Send + 'static,
    ) -> Outcome {
        let work = Work::Transfer(Transfer(Box::pin(transfer)));
        let mut answer = self.submit(needs_lease, vec![work], true).await?;
        answer.remove("request");
        Ok(answer)
    }

    /// Returns the bytes of `data`, or of `value` in the type of the dictionary.
    fn sdo_bytes(
        &self,
        device: &str,
        index: &Index,
        sub: u8,
        data: Option<String>,
        value: Option<Value>,
    ) -> Result<Vec<u8>, OpError> {
        let number = index.number()?;
        let bad = |message: String| OpError::new(ErrorCode::BadRequest, message);
        match (data, value) {
            (Some(data), None) => {
                unhex(&data).ok_or_else(|| bad("`data` is not hex, such as \"0100\"".to_owned()))
            }
            (None, Some(value)) => {
                let Some(data_type) = self.data_type(device, number, sub) else {
                    let object = address(number, sub);
                    return Err(bad(format!("the type of {object} is not known"))
                        .help("give the bytes as `data`"));
                };
                let text = match &value {
                    Value::String(text) => text.clone(),
                    Value::Bool(on) => u8::from(*on).to_string(),
                    other => other.to_string(),
                };
                data_type
                    .read(&text)
                    .map_err(|error| bad(format!("`value`: {error}")))
            }
            _ => Err(bad("`sdo_write` needs either `data` or `value`".to_owned())),
        }
    }

    async fn sdo_write(
        &self,
        device: &str,
        index: &Index,
        sub: u8,
        complete: bool,
        bytes: &[u8],
    ) -> Result<Map<String, Value>, OpError> {
        if complete {
            let message = "complete access is for reading only";
            return Err(OpError::new(ErrorCode::BadRequest, message)
                .help("write the subindices one by one"));
        }
        let number = index.number()?;
        let mailbox = self.hub.mailboxes()?.device(device).map_err(refused)?;
        let bytes = bytes.to_vec();
        let transfer = async move {
            let written = mailbox.download(number, sub, &bytes).await;
            written.map(|()| Map::new()).map_err(refused)
        };
        self.transfer(true, transfer).await
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

/// Returns the JSON value of an object's bytes.
fn value(data_type: DataType, bytes: &[u8]) -> Value {
    match data_type.kind {
        Kind::Unsigned | Kind::Signed => {
            let integer = data_type.integer(bytes);
            let small = integer.and_then(|integer| i64::try_from(integer).ok());
            small.map_or_else(|| json!(integer.map(|n| n.to_string())), |n| json!(n))
        }
        Kind::Real => json!(data_type.show(bytes).parse::<f64>().ok()),
        _ => json!(data_type.show(bytes)),
    }
}

fn refused(error: MailboxError) -> OpError {
    let message = error.to_string();
    match error {
        MailboxError::Unknown { .. } => OpError::new(ErrorCode::UnknownName, message),
        MailboxError::None { .. } => OpError::new(ErrorCode::Refused, message),
        MailboxError::Closed { .. } => OpError::new(ErrorCode::NotUp, message),
        MailboxError::Sdo { source, .. } => match source.abort_code() {
            Some(code) => OpError::new(ErrorCode::Aborted, message).with("abort_code", code),
            None if source.is_timeout() => OpError::new(ErrorCode::Timeout, message),
            None => OpError::new(ErrorCode::Failed, message),
        },
    }
}

fn object(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn unhex(text: &str) -> Option<Vec<u8>> {
    let digits: Vec<u8> = text.bytes().filter(|byte| *byte != b' ').collect();
    if !digits.len().is_multiple_of(2) || !digits.iter().all(u8::is_ascii_hexdigit) {
        return None;
    }
    let pair = |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok();
    digits.chunks_exact(2).map(pair).collect()
}
