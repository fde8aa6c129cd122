//! An operator's requests in place of the file's program: a person who jogs, or a server's clients.
//!
//! | file | |
//! |---|---|
//! | here | the operator interface and its requests |
//! | `activity` | what an axis does |
//! | `requests` | requests, time and status → commands: hold-to-run, speed limits, results |
//! | `run` | the loop that serves the operator, and the program that the operator starts |
//!
//! Nothing here is a safety function. Hold-to-run is checked outside the cycle: a computer that
//! stalls also stalls this check.

use std::collections::VecDeque;
use std::fmt;

use ecaxis_axis::Mode;
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, GroupIndex, IndexVec};

use crate::clock::Nanos;
use crate::config::{GroupStopScope, Machine, OutputRef, StopGroup};
use crate::link::sim::SimInput;
use crate::rt::channel::Snapshot;
pub use crate::rt::gateway::NodeCommand;

mod activity;
mod requests;
mod run;

pub use activity::Activity;
pub use requests::AxisActivity;
pub(crate) use run::Attendance;

/// The time in ns after the last jog request at which the axis brakes within its limits.
pub const HOLD_TO_RUN_TIMEOUT: Nanos = 300_000_000;
/// The maximum speed in manual mode, as a fraction of an axis's velocity limit.
pub const MAX_MANUAL_SPEED: f64 = 0.25;
/// The acceleration in manual mode, as a fraction of the acceleration limit. Stops use the whole
/// limit.
pub const RAMP: f64 = 0.25;

/// An operator. Called outside the cycle, about every millisecond of the run's clock.
pub trait Operator: Send + fmt::Debug {
    /// Returns the operator's present requests. Must not block, except in virtual time, which
    /// stands meanwhile.
    fn turn(&mut self, view: &View<'_>) -> OperatorInput;

    /// Returns the maximum speed and the acceleration of moves. Jogs keep [`MAX_MANUAL_SPEED`].
    fn shares(&self) -> LimitShares {
        LimitShares::MANUAL
    }
}

/// Fractions of an axis's limits, above 0 and at most 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LimitShares {
    /// The maximum speed of a move, as a fraction of the velocity limit.
    pub speed: f64,
    /// The acceleration of a move, as a fraction of the acceleration limit.
    pub ramp: f64,
}

impl LimitShares {
    /// The shares in manual mode.
    pub const MANUAL: Self = Self {
        speed: MAX_MANUAL_SPEED,
        ramp: RAMP,
    };
    /// The whole limits.
    pub const WHOLE: Self = Self {
        speed: 1.0,
        ramp: 1.0,
    };
}

/// The state that an operator sees.
#[derive(Debug)]
pub struct View<'v> {
    /// The time on the run's clock.
    pub now: Nanos,
    pub machine: &'v Machine,
    pub snapshot: &'v Snapshot,
    /// The state of each axis in manual mode.
    pub hands: &'v IndexVec<AxisIndex, AxisActivity>,
    /// Events since the last call, in order.
    pub news: &'v [RequestEvent],
    /// The program that the operator has started.
    pub program: &'v ProgramStatus,
}

/// The state of the file's program under an operator.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ProgramStatus {
    pub running: bool,
    /// The program waits before its next step.
    pub paused: bool,
}

impl View<'_> {
    /// Returns `true` if every request is done or has failed.
    #[must_use]
    pub fn idle(&self) -> bool {
        self.hands
            .iter()
            .all(|hand| hand.doing == Activity::Nothing)
    }

    /// Returns the name of an axis.
    #[must_use]
    pub fn name(&self, axis: AxisIndex) -> &str {
        let axis = self.machine.axes.get(axis);
        axis.map_or("?", |axis| axis.name.as_str())
    }
}

/// The operator's input of one call.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct OperatorInput {
    pub presence: Presence,
    /// The requests in order. Beyond the first 64, only stops are accepted. All requests of an
    /// operator are numbered from 1; events name the request by this number.
    pub requests: Vec<Request>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Presence {
    #[default]
    Here,
    /// Temporarily absent: everything that moves brakes, and nothing new starts.
    Away,
    /// Gone for good: the machine stops and the bus shuts down.
    Gone,
}

/// A request, with values in user units. Any later request ends a jog; a request that is not a
/// motion ends a move.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Request {
    Enable {
        axis: AxisIndex,
    },
    /// Decelerates, then removes power.
    Disable {
        axis: AxisIndex,
    },
    /// Moves at this velocity for [`HOLD_TO_RUN_TIMEOUT`]. Repeated requests prolong the motion.
    Jog {
        axis: AxisIndex,
        velocity: f64,
    },
    MoveBy {
        axis: AxisIndex,
        distance: f64,
        /// The fraction of the velocity limit, at most [`MAX_MANUAL_SPEED`].
        speed: f64,
    },
    /// Moves to a position. On a modulo axis the position lies within one turn, and the machine
    /// file gives the direction.
    MoveTo {
        axis: AxisIndex,
        position: f64,
        /// The speed, as in [`Request::MoveBy`].
        speed: f64,
    },
    /// Homes the axis as configured in the machine file.
    Home {
        axis: AxisIndex,
    },
    /// Moves at this velocity until another request, at most at the operator's share of the limit.
    Velocity {
        axis: AxisIndex,
        velocity: f64,
    },
    /// Applies a torque in percent of the rated torque, in CST.
    Torque {
        axis: AxisIndex,
        percent: f64,
        /// The time in s from the present to the new torque.
        ramp_s: f64,
    },
    SetMode {
        axis: AxisIndex,
        mode: Mode,
    },
    /// Acknowledges trips and faults of the axis and of everything that stopped with it.
    Reset {
        axis: AxisIndex,
    },
    /// Decelerates and holds.
    Stop {
        axis: AxisIndex,
    },
    /// Triggers the drive's quick stop (0x605A).
    QuickStop {
        axis: AxisIndex,
    },
    StopAll,
    /// Sets an output that no axis drives.
    SetOutput {
        output: OutputRef,
        value: f64,
    },
    /// Commands the NMT state of a node behind a gateway, whose axis has no power.
    Node {
        gateway: DeviceIndex,
        /// The index in [`GatewaySetup::nodes`](crate::config::GatewaySetup::nodes).
        node: usize,
        command: NodeCommand,
    },
    /// Switches an input of the simulated bus.
    SimInput(SimInput),
    /// Scales the speed of all motions of the machine (the first group) or of a group.
    Override {
        group: GroupIndex,
        /// From 0 to [`ecaxis_axis::MAX_RATE`].
        factor: f64,
    },
    /// Holds all motions of the machine or of a group on their way, or lets them continue.
    Hold {
        group: GroupIndex,
        held: bool,
    },
    Program(ProgramRequest),
    /// Stops all axes and removes power as fast as possible, as configured for each axis.
    EmergencyStop,
}

impl Request {
    /// Returns the axis; `None` for requests to all axes, to outputs and to the program.
    #[must_use]
    pub fn axis(&self) -> Option<AxisIndex> {
        match *self {
            Self::Enable { axis }
            | Self::Disable { axis }
            | Self::Jog { axis, .. }
            | Self::MoveBy { axis, .. }
            | Self::MoveTo { axis, .. }
            | Self::Home { axis }
            | Self::Velocity { axis, .. }
            | Self::Torque { axis, .. }
            | Self::SetMode { axis, .. }
            | Self::Reset { axis }
            | Self::Stop { axis }
            | Self::QuickStop { axis } => Some(axis),
            Self::StopAll
            | Self::EmergencyStop
            | Self::SetOutput { .. }
            | Self::Node { .. }
            | Self::SimInput(_)
            | Self::Override { .. }
            | Self::Hold { .. }
            | Self::Program(_) => None,
        }
    }

    /// Returns `true` if the request only ends motion. Such a request is never dropped, neither for
    /// the number of requests nor for absence.
    #[must_use]
    pub fn stops(&self) -> bool {
        matches!(
            self,
            Self::Stop { .. }
                | Self::QuickStop { .. }
                | Self::StopAll
                | Self::EmergencyStop
                | Self::Disable { .. }
                | Self::Program(ProgramRequest::Stop)
        )
    }
}

/// A request to the file's program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProgramRequest {
    /// Starts the program. It enables the axes first, unless its steps do so.
    Start,
    /// Starts the program at an instant of common time, in ns since 1970. It enables the axes at once,
    /// unless its steps do so.
    StartAt {
        at_unix_ns: u64,
    },
    /// Waits before the next step.
    Pause,
    Resume,
    /// Runs one step of a paused program, then pauses again.
    Step,
    /// Stops the axes and ends the program.
    Stop,
}

/// The result of a request. `request` is its number; 0 without a request.
#[derive(Debug, Clone, PartialEq)]
pub enum RequestEvent {
    /// The request is done.
    Done {
        request: u64,
        axis: AxisIndex,
        what: Activity,
    },
    /// The request was refused. If it would have moved the axis, the axis brakes from its previous
    /// motion.
    Refused {
        request: u64,
        axis: AxisIndex,
        why: String,
    },
    /// A jog was not repeated, and the axis brakes.
    LetGo { request: u64, axis: AxisIndex },
    /// The request has failed.
    Failed {
        request: u64,
        axis: AxisIndex,
        what: Activity,
        why: String,
    },
    /// Another request has replaced this one.
    Replaced { request: u64, axis: AxisIndex },
    /// An output, a node or an input of the simulated bus is commanded, or the request was refused.
    Signal {
        request: u64,
        result: Result<(), String>,
    },
    /// A request to the program is done or refused, or the started program has ended.
    Program {
        request: u64,
        result: Result<(), String>,
    },
}

impl RequestEvent {
    /// Returns the axis index; `None` for events of the program.
    #[must_use]
    pub fn axis(&self) -> Option<AxisIndex> {
        match self {
            Self::Done { axis, .. }
            | Self::Refused { axis, .. }
            | Self::LetGo { axis, .. }
            | Self::Failed { axis, .. }
            | Self::Replaced { axis, .. } => Some(*axis),
            Self::Program { .. } | Self::Signal { .. } => None,
        }
    }

    /// Returns the number of the request.
    #[must_use]
    pub fn request(&self) -> u64 {
        match self {
            Self::Done { request, .. }
            | Self::Refused { request, .. }
            | Self::LetGo { request, .. }
            | Self::Failed { request, .. }
            | Self::Replaced { request, .. }
            | Self::Signal { request, .. }
            | Self::Program { request, .. } => *request,
        }
    }

    /// Returns `true` if a request was not carried out.
    #[must_use]
    pub fn is_failure(&self) -> bool {
        matches!(
            self,
            Self::Refused { .. }
                | Self::Failed { .. }
                | Self::Signal { result: Err(_), .. }
                | Self::Program { result: Err(_), .. }
        )
    }
}

/// Shows the event without the axis's name.
impl fmt::Display for RequestEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Done { what, .. } => f.write_str(match what {
                Activity::Enabling => "enabled",
                Activity::Disabling => "disabled",
                Activity::Jogging { .. } | Activity::Stopping => "stopped",
                Activity::Moving { .. } => "is there",
                Activity::Turning { .. } => "has the velocity",
                Activity::Pressing { .. } => "has the torque",
                Activity::Homing => "homed",
                Activity::Switching { to } => return write!(f, "in {to}"),
                Activity::Resetting => "reset",
                Activity::Nothing => "idle",
            }),
            Self::Refused { why, .. } => write!(f, "refused: {why}"),
            Self::LetGo { .. } => f.write_str("let go, brakes"),
            Self::Failed { what, why, .. } => write!(f, "{what}: {why}"),
            Self::Replaced { .. } => f.write_str("replaced by another request"),
            Self::Signal { result: Ok(()), .. } => f.write_str("signal: commanded"),
            Self::Signal {
                result: Err(why), ..
            } => write!(f, "refused: {why}"),
            Self::Program { result: Ok(()), .. } => f.write_str("program: done"),
            Self::Program {
                result: Err(why), ..
            } => write!(f, "program: {why}"),
        }
    }
}

/// Returns the machine for manual mode. Axes without a group form one that stops alone, because a
/// group can be reset and a stopped machine cannot. Causes of stops are unchanged. Devices with inputs
/// whose loss must stop the machine stay in the group whose stop stops everything.
#[must_use]
pub fn for_manual_mode(mut machine: Machine) -> Machine {
    let watched: Vec<_> = machine.roles.watched_devices().collect();
    let free = |&device: &DeviceIndex| {
        machine.devices[device].selection.mode.is_some()
            && machine.group_of(device) == GroupIndex::MACHINE
            && !watched.contains(&device)
    };
    let devices: Vec<_> = machine.devices.indices().filter(free).collect();
    if !devices.is_empty() {
        machine.stop.groups.push(StopGroup {
            name: "axes".to_owned(),
            devices,
            others: machine.stop.others,
            outside: GroupStopScope::Continue,
        });
    }
    machine
}

/// Events that wait for the operator's next call.
type Pending = VecDeque<RequestEvent>;
