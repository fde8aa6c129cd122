//! The operator of a run: carries the clients' commands to the machine and the outcomes back.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::task::{Context, Poll, Waker};
use std::time::{Duration, Instant};

use ecaxis_axis::setpoint::LineShaftState;
use ecaxis_ecat::index::{AxisIndex, IndexVec, LineShaftIndex};
use ecaxis_master::supervise::operator::{
    Activity, LimitShares, Operator, OperatorInput, Presence, ProgramRequest, Request,
    RequestEvent, View,
};
use serde_json::{Map, Value, json};

use crate::error::{ErrorCode, OpError};
use crate::external::{AreaStop, ExternalClient, MESSAGES_PER_CYCLE, Message, Report, StreamEnd};
use crate::hub::{Count, Hub, Latest, QueuedWork, RunningStep, Transfer, Work};
use crate::state::state_name;

/// The pieces of work that one call takes; the machine accepts 64 requests, and each piece is at
/// most two.
const WORK_PER_CALL: usize = 30;
/// The period at which the state is published without a reason.
const PUBLISH: Duration = Duration::from_millis(10);

/// The operator of one run.
#[derive(Debug)]
pub struct ServerOperator {
    hub: Arc<Hub>,
    cycle: ExternalClient,
    /// The number of requests of this run.
    requests: u64,
    /// The commands behind the requests that have no outcome yet.
    commands: HashMap<u64, Command>,
    /// The last jog of each axis: only it has an outcome.
    jogs: IndexVec<AxisIndex, u64>,
    /// Faults and trips that were reported.
    troubles: IndexVec<AxisIndex, Option<String>>,
    /// The states of the line shafts that were reported.
    line_shafts: IndexVec<LineShaftIndex, LineShaftState>,
    /// Jogs of the last call. They are accepted unless they are refused before the next call.
    new_jogs: Vec<u64>,
    transfers: Vec<(u64, Transfer)>,
    published: Option<Instant>,
}

#[derive(Debug, Clone, Copy)]
struct Command {
    ticket: u64,
    /// The command asks for standstill.
    stops: bool,
}

impl ServerOperator {
    #[must_use]
    pub fn new(hub: Arc<Hub>, cycle: ExternalClient) -> Self {
        let axes = hub.machine.axes.len();
        Self {
            cycle,
            requests: 0,
            commands: HashMap::new(),
            jogs: IndexVec::from(vec![0; axes]),
            troubles: IndexVec::from(vec![None; axes]),
            line_shafts: vec![LineShaftState::Waiting; hub.machine.line_shafts.len()].into(),
            new_jogs: Vec::new(),
            transfers: Vec::new(),
            published: None,
            hub,
        }
    }

    fn axis_name(&self, axis: AxisIndex) -> &str {
        let axis = self.hub.machine.axes.get(axis);
        axis.map_or("?", |axis| axis.name.as_str())
    }

    /// Gives the outcome of a request to its client.
    fn take_event(&mut self, news: &RequestEvent) {
        let request = news.request();
        let command = self.commands.remove(&request);
        let ticket = command.map_or(0, |command| command.ticket);
        let stopped = matches!(
            news,
            RequestEvent::Done {
                what: Activity::Stopping | Activity::Disabling,
                ..
            }
        );
        // A stop takes over the number of the motion or of the enabling that it ends.
        let interrupted = stopped && command.is_some_and(|command| !command.stops);
        let text = news.to_string();
        let (kind, error) = match news {
            RequestEvent::Done { .. } if interrupted => (
                "replaced",
                Some(OpError::new(
                    ErrorCode::Replaced,
                    "stopped by another command",
                )),
            ),
            RequestEvent::Done { .. } => ("done", None),
            RequestEvent::Refused { why, .. } => {
                ("refused", Some(OpError::new(ErrorCode::Refused, why)))
            }
            RequestEvent::LetGo { .. } => ("let_go", None),
            RequestEvent::Failed { why, .. } => {
                ("failed", Some(OpError::new(ErrorCode::Failed, why)))
            }
            RequestEvent::Replaced { .. } => (
                "replaced",
                Some(OpError::new(
                    ErrorCode::Replaced,
                    "replaced by another command",
                )),
            ),
            RequestEvent::Signal { result, .. } => {
                let refused = |why: &String| OpError::new(ErrorCode::Refused, why);
                let outcome = result.as_ref().map(|()| Map::new()).map_err(refused);
                self.hub.finish(ticket, outcome);
                return;
            }
            RequestEvent::Program { result, .. } => {
                self.hub.set_step(RunningStep::default());
                if ticket == 0 {
                    return;
                }
                let why = result.as_ref().err();
                self.hub.event(json!({
                    "event": "program", "request": ticket, "ok": why.is_none(), "why": why,
                }));
                let outcome = result.clone().map(|()| Map::new());
                let outcome = outcome.map_err(|why| OpError::new(ErrorCode::Failed, why));
                self.hub.finish(ticket, outcome);
                return;
            }
        };
        let Some(axis) = news.axis() else {
            return;
        };
        if ticket != 0 {
            let axis = self.axis_name(axis);
            let why = error.as_ref().map(|error| error.message.clone());
            self.hub.event(json!({
                "event": kind, "request": ticket, "axis": axis, "what": text, "why": why,
            }));
            let error = error.map(|error| OpError {
                message: format!("`{axis}`: {}", error.message),
                ..error
            });
            self.hub.finish(ticket, error.map_or(Ok(Map::new()), Err));
        }
    }

    /// Takes the reports of the cycle.
    fn take_reports(&mut self) {
        while let Ok(report) = self.cycle.reports.pop() {
            let (ticket, outcome) = match report {
                Report::Opened { ticket, result } | Report::Closed { ticket, result } => {
                    let refused = |e: crate::external::StreamError| {
                        OpError::new(ErrorCode::Refused, e.to_string())
                    };
                    (ticket, result.map(|()| Map::new()).map_err(refused))
                }
                Report::Pushed {
                    ticket,
                    accepted,
                    free,
                    error,
                    points: _,
                } => {
                    let keys = |map: &mut Map<String, Value>| {
                        map.insert("accepted".to_owned(), json!(accepted));
                        map.insert("free".to_owned(), json!(free));
                    };
                    let outcome = match error {
                        None => {
                            let mut map = Map::new();
                            keys(&mut map);
                            Ok(map)
                        }
                        Some(error) => {
                            let message = format!("point {}: {error}", accepted + 1);
                            let mut error = OpError::new(ErrorCode::Refused, message);
                            keys(&mut error.more);
                            Err(error)
                        }
                    };
                    (ticket, outcome)
                }
                Report::StreamEnded { axis, end } => {
                    self.report_stream(AxisIndex(axis), end);
                    continue;
                }
                Report::AreaStopped { axis, cause } => {
                    self.report_area(AxisIndex(axis), cause);
                    continue;
                }
                Report::Detached(_) => continue,
            };
            self.hub.finish(ticket, outcome);
        }
    }

    fn poll_transfers(&mut self) {
        let mut context = Context::from_waker(Waker::noop());
        let hub = &self.hub;
        self.transfers.retain_mut(|(ticket, transfer)| {
            match transfer.0.as_mut().poll(&mut context) {
                Poll::Ready(outcome) => {
                    hub.finish(*ticket, outcome);
                    false
                }
                Poll::Pending => true,
            }
        });
    }

    fn report_stream(&self, axis: AxisIndex, end: StreamEnd) {
        let (state, why) = match end {
            StreamEnd::Done => ("done", None),
            StreamEnd::Underrun => ("underrun", Some("the points ran out".to_owned())),
            StreamEnd::Refused(error) => ("refused", Some(error.to_string())),
        };
        let axis = self.axis_name(axis);
        self.hub
            .event(json!({"event": "stream", "axis": axis, "state": state, "why": why}));
    }

    fn report_area(&self, axis: AxisIndex, cause: AreaStop) {
        let axis = self.axis_name(axis);
        let owner = self.hub.owner().map(|(owner, _)| owner);
        let why = cause.to_string();
        self.hub
            .event(json!({"event": "area", "axis": axis, "owner": owner, "why": why}));
    }

    /// Reports each fault and trip once.
    fn report_troubles(&mut self, view: &View<'_>) {
        for (axis, status) in view.snapshot.axes.enumerate() {
            let fault = status.fault.map(|fault| fault.to_string());
            let trouble = fault.or_else(|| status.trip.map(|trip| trip.to_string()));
            let Some(known) = self.troubles.get_mut(axis) else {
                continue;
            };
            if *known == trouble {
                continue;
            }
            // The text changes once more as the drive's code was read.
            let first = known.is_none();
            (*known).clone_from(&trouble);
            if let Some(why) = trouble {
                let axis = view.name(axis);
                if first {
                    let count = match status.fault {
                        Some(_) => Count::Fault,
                        None => Count::Trip,
                    };
                    self.hub.count(count, axis);
                }
                self.hub
                    .event(json!({"event": "fault", "axis": axis, "why": why}));
            }
        }
    }

    /// Reports each change of the state of a line shaft.
    fn report_line_shafts(&mut self, view: &View<'_>) {
        let shafts = view.snapshot.line_shafts.enumerate();
        for ((shaft, status), known) in shafts.zip(&mut self.line_shafts) {
            if std::mem::replace(known, status.state) == status.state {
                continue;
            }
            let runs = status.state == LineShaftState::Running;
            self.hub.event(json!({
                "event": "line_shaft", "name": self.hub.machine.line_shaft_name(shaft),
                "state": state_name(status.state), "why": (!runs).then(|| status.end.to_string()),
            }));
        }
    }

    fn take_work(&mut self, view: &View<'_>) -> Vec<Request> {
        let mut requests = Vec::new();
        // The rest of the queue is for stops.
        let room = MESSAGES_PER_CYCLE.saturating_sub(self.cycle.waiting());
        for QueuedWork { ticket, work } in self.hub.take_work(WORK_PER_CALL, room) {
            match work {
                Work::Request(request) => {
                    if let Some(stop) = self.release(&request, view) {
                        self.take_request(0, stop);
                        requests.push(stop);
                    }
                    self.take_request(ticket, request);
                    requests.push(request);
                }
                Work::Open { axis, config } => self.send(
                    ticket,
                    Message::Open {
                        ticket,
                        axis,
                        config,
                    },
                ),
                Work::Push { axis, points } => self.send(
                    ticket,
                    Message::Push {
                        ticket,
                        axis,
                        points,
                    },
                ),
                Work::Close { axis } => self.send(ticket, Message::Close { ticket, axis }),
                Work::Attach(memory) => {
                    self.send(ticket, Message::Attach(memory));
                    self.hub.finish(ticket, Ok(Map::new()));
                }
                Work::Transfer(transfer) => self.transfers.push((ticket, transfer)),
                Work::Detach => self.send(ticket, Message::Detach),
            }
        }
        requests
    }

    /// Ends the set-points of a client at the axis of a motion or a stop. Returns the stop that
    /// precedes a motion: if the motion is refused, the axis must not keep the client's velocity.
    fn release(&mut self, request: &Request, view: &View<'_>) -> Option<Request> {
        let attached = self.hub.area.attached.load(Ordering::Relaxed) != 0;
        let (axis, stop) = match *request {
            // Set-points go on: the cycle ends them at an axis that is not ready.
            Request::Enable { .. }
            | Request::Reset { .. }
            | Request::SetMode { .. }
            | Request::SetOutput { .. }
            | Request::Node { .. }
            | Request::SimInput(_)
            | Request::Override { .. }
            | Request::Hold { .. }
            | Request::Program(ProgramRequest::Pause | ProgramRequest::Resume) => return None,
            Request::Program(
                ProgramRequest::Start | ProgramRequest::StartAt { .. } | ProgramRequest::Step,
            ) => (None, Some(Request::StopAll)),
            Request::Jog { axis, .. } => {
                let hand = view.hands.get(axis);
                let jogs = hand.is_some_and(|h| matches!(h.doing, Activity::Jogging { .. }));
                (Some(axis), (!jogs).then_some(Request::Stop { axis }))
            }
            request if request.stops() => (request.axis(), None),
            request => (
                request.axis(),
                request.axis().map(|axis| Request::Stop { axis }),
            ),
        };
        self.send(0, Message::Release(axis.map(|axis| axis.0)));
        // An axis that is being enabled follows no set-points: a stop would end its enabling.
        let hand = axis.and_then(|axis| view.hands.get(axis));
        let enables = hand.is_some_and(|hand| hand.doing == Activity::Enabling);
        stop.filter(|_| attached && !enables)
    }

    fn send(&mut self, ticket: u64, message: Message) {
        // There is room unless the cycle stands still.
        if self.cycle.messages.push(message).is_err() {
            let error = OpError::new(ErrorCode::Busy, "the cycle takes no more messages");
            self.hub.finish(ticket, Err(error));
        }
    }

    /// Numbers a request as the machine does, and remembers whom its outcome concerns.
    fn take_request(&mut self, ticket: u64, request: Request) {
        self.requests += 1;
        let mut outcome = true;
        match request {
            Request::SetOutput { output, value } => {
                let mut outputs = self.hub.outputs.iter();
                if let Some(index) = outputs.position(|(known, _)| *known == output) {
                    self.hub.set_output(index, Some(value));
                }
            }
            Request::StopAll
            | Request::EmergencyStop
            | Request::Override { .. }
            | Request::Hold { .. } => outcome = false,
            Request::Jog { axis, .. } => {
                if let Some(last) = self.jogs.get_mut(axis) {
                    let last = std::mem::replace(last, self.requests);
                    if let Some(command) = self.commands.remove(&last) {
                        // Another jog of the same call.
                        self.hub.finish(command.ticket, Ok(Map::new()));
                    }
                }
                self.new_jogs.push(self.requests);
            }
            _ => {}
        }
        if outcome {
            let stops = request.stops() || matches!(request, Request::Jog { .. });
            self.commands
                .insert(self.requests, Command { ticket, stops });
        } else {
            self.hub.finish(ticket, Ok(Map::new()));
        }
    }

    fn publish(&mut self, view: &View<'_>, at_once: bool) {
        let due = self.published.is_none_or(|at| at.elapsed() >= PUBLISH);
        if due || at_once {
            self.published = Some(Instant::now());
            for (index, (_, signal)) in self.hub.outputs.iter().enumerate() {
                if view.snapshot.locked_outputs.get(signal.device) == Some(&true) {
                    self.hub.set_output(index, None);
                }
            }
            self.hub.publish(Latest {
                snapshot: view.snapshot.clone(),
                hands: view.hands.clone(),
                program: view.program.clone(),
            });
        }
    }
}

impl Operator for ServerOperator {
    fn turn(&mut self, view: &View<'_>) -> OperatorInput {
        // The state is newer than the outcomes that clients see.
        let at_once = self.hub.options.virtual_time || !view.news.is_empty();
        self.publish(view, at_once);
        for news in view.news {
            self.take_event(news);
        }
        for request in std::mem::take(&mut self.new_jogs) {
            if let Some(command) = self.commands.get(&request) {
                self.hub.finish(command.ticket, Ok(Map::new()));
            }
        }
        self.take_reports();
        self.poll_transfers();
        self.report_troubles(view);
        self.report_line_shafts(view);
        self.hub.expire_lease();
        let requests = self.take_work(view);
        OperatorInput {
            presence: match self.hub.is_wanted() {
                true => Presence::Here,
                false => Presence::Gone,
            },
            requests,
        }
    }

    fn shares(&self) -> LimitShares {
        LimitShares::WHOLE
    }
}

impl Drop for ServerOperator {
    fn drop(&mut self) {
        self.hub.area.attached.store(0, Ordering::Relaxed);
    }
}
