//! Manual mode: an operator's requests replace the file's program.
//!
//! | file | |
//! |---|---|
//! | here | the operator interface and its requests |
//! | `controller` | requests, time and status → commands: hold-to-run, speed limits, results |
//! | `run` | the loop that serves the operator |
//!
//! Nothing here is a safety function. Hold-to-run is checked outside the cycle: a computer that
//! stalls also stalls this check.

use std::collections::VecDeque;
use std::fmt;

use ecaxis_axis::Mode;
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, GroupIndex, IndexVec};

use crate::clock::Nanos;
use crate::config::{GroupStopScope, Machine, StopGroup};
use crate::rt::channel::Snapshot;

mod controller;
mod run;

pub use controller::{Activity, JogAxis};

/// The time in ns after the last jog request at which the axis brakes within its limits.
pub const HOLD_TO_RUN_TIMEOUT: Nanos = 300_000_000;
/// The maximum speed in manual mode, as a fraction of an axis's velocity limit.
pub const MAX_MANUAL_SPEED: f64 = 0.25;
/// The acceleration in manual mode, as a fraction of the acceleration limit. Stops use the whole
/// limit.
pub const RAMP: f64 = 0.25;

/// An operator. Called outside the cycle, about every millisecond of the run's clock.
pub trait Operator: Send + fmt::Debug {
    /// Returns the operator's present requests. Must not block.
    fn turn(&mut self, view: &View<'_>) -> OperatorInput;
}

/// The state that an operator sees.
#[derive(Debug)]
pub struct View<'v> {
    /// The time on the run's clock.
    pub now: Nanos,
    pub machine: &'v Machine,
    pub snapshot: &'v Snapshot,
    /// The state of each axis in manual mode.
    pub hands: &'v IndexVec<AxisIndex, JogAxis>,
    /// Events since the last call, in order.
    pub news: &'v [JogEvent],
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
    /// The requests in order. Beyond the first 64, only stops are accepted.
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
    StopAll,
    /// Stops all axes and removes power as fast as possible, as configured for each axis.
    EmergencyStop,
}

impl Request {
    /// Returns `true` if the request only ends motion. Such a request is never dropped, neither for
    /// the number of requests nor for absence.
    #[must_use]
    pub fn stops(&self) -> bool {
        matches!(
            self,
            Self::Stop { .. } | Self::StopAll | Self::EmergencyStop | Self::Disable { .. }
        )
    }
}

/// The result of a request.
#[derive(Debug, Clone, PartialEq)]
pub enum JogEvent {
    /// The request is done.
    Done { axis: AxisIndex, what: Activity },
    /// The request was refused. If it would have moved the axis, the axis brakes from its previous
    /// motion.
    Refused { axis: AxisIndex, why: String },
    /// A jog was not repeated, and the axis brakes.
    LetGo { axis: AxisIndex },
    /// The request has failed.
    Failed {
        axis: AxisIndex,
        what: Activity,
        why: String,
    },
}

impl JogEvent {
    /// Returns the axis index.
    #[must_use]
    pub fn axis(&self) -> AxisIndex {
        match self {
            Self::Done { axis, .. }
            | Self::Refused { axis, .. }
            | Self::LetGo { axis }
            | Self::Failed { axis, .. } => *axis,
        }
    }

    /// Returns `true` if a request was not carried out.
    #[must_use]
    pub fn is_failure(&self) -> bool {
        matches!(self, Self::Refused { .. } | Self::Failed { .. })
    }
}

/// Shows the event without the axis's name.
impl fmt::Display for JogEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Done { what, .. } => f.write_str(match what {
                Activity::Enabling => "enabled",
                Activity::Disabling => "disabled",
                Activity::Jogging { .. } | Activity::Stopping => "stopped",
                Activity::Moving { .. } => "is there",
                Activity::Homing => "homed",
                Activity::Switching { to } => return write!(f, "in {to}"),
                Activity::Resetting => "reset",
                Activity::Nothing => "idle",
            }),
            Self::Refused { why, .. } => write!(f, "refused: {why}"),
            Self::LetGo { .. } => f.write_str("let go, brakes"),
            Self::Failed { what, why, .. } => write!(f, "{what}: {why}"),
        }
    }
}

/// Returns the machine for manual mode. Axes without a group form one that stops alone, because a
/// group can be reset and a stopped machine cannot. Causes of stops are unchanged. Devices with
/// emergency inputs stay in the group whose stop stops everything.
#[must_use]
pub fn for_manual_mode(mut machine: Machine) -> Machine {
    let watched: Vec<_> = machine
        .stop
        .emergency
        .iter()
        .filter_map(|condition| Some(machine.inputs.get(condition.input.0)?.device))
        .collect();
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
type Pending = VecDeque<JogEvent>;
