//! The machine in somebody's hands: what is asked for while it runs takes the place of the file's program.
//!
//! | file | |
//! |---|---|
//! | here | who asks, and what can be asked for |
//! | `desk` | requests, time and what the axes report → commands: the dead-man rule, the speeds, what became of it |
//! | `attend` | the loop that listens |
//!
//! Nothing here is a safety function. The dead-man rule lives beside the cycle: a computer that stalls stalls it, too.

use std::collections::VecDeque;
use std::fmt;

use ecaxis_axis::Mode;

use crate::clock::Nanos;
use crate::config::{Machine, Outside, StopGroup};
use crate::rt::handover::Snapshot;

mod attend;
mod desk;

pub use desk::{Doing, Hand};

/// A jog goes on for so long after it was last asked for; then the axis brakes within its limits.
pub const LET_GO: Nanos = 300_000_000;
/// The highest speed of whatever is asked for by hand, as a fraction of an axis' velocity limit.
pub const MOST_SPEED: f64 = 0.25;
/// How such a motion begins and arrives, as a fraction of the acceleration limit. Stops take all of it.
pub const RAMP: f64 = 0.25;

/// Who has the machine in hand. Asked beside the cycle, every millisecond or so of the run's clock.
pub trait Operator: Send + fmt::Debug {
    /// What is to happen now. Does not block.
    fn turn(&mut self, view: &View<'_>) -> Turn;
}

/// What an operator sees.
#[derive(Debug)]
pub struct View<'v> {
    /// The run's clock.
    pub now: Nanos,
    pub machine: &'v Machine,
    /// Indices into the machine's devices, one an axis.
    pub axes: &'v [usize],
    pub snapshot: &'v Snapshot,
    /// What each axis is doing for the operator.
    pub hands: &'v [Hand],
    /// Since the last turn, in order.
    pub news: &'v [News],
}

impl View<'_> {
    /// Whether everything that was asked for is done, or has failed.
    #[must_use]
    pub fn idle(&self) -> bool {
        self.hands.iter().all(|hand| hand.doing == Doing::Nothing)
    }

    /// Of an axis by its place in the cycle.
    #[must_use]
    pub fn name(&self, axis: usize) -> &str {
        let device = self.axes.get(axis);
        let device = device.and_then(|&device| self.machine.devices.get(device));
        device.map_or("?", |device| device.name.as_str())
    }
}

/// An operator's answer.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Turn {
    pub presence: Presence,
    /// In order. At most 64 are taken, and every stop.
    pub requests: Vec<Request>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Presence {
    #[default]
    Here,
    /// Not to be seen for the moment: everything that moves brakes, nothing new begins.
    Away,
    /// For good: the machine is brought to rest and the bus down.
    Gone,
}

/// Axes by their places in the cycle; values in user units. A jog that is followed by anything else has been let go; so has
/// a move by what is none.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Request {
    Enable {
        axis: usize,
    },
    /// Decelerate, then take the power away.
    Disable {
        axis: usize,
    },
    /// Turn at this velocity for [`LET_GO`]. Whoever wants more asks again.
    Jog {
        axis: usize,
        velocity: f64,
    },
    MoveBy {
        axis: usize,
        distance: f64,
        /// Fraction of the velocity limit, at most [`MOST_SPEED`].
        speed: f64,
    },
    /// On a modulo axis the place, the way that its machine file says.
    MoveTo {
        axis: usize,
        position: f64,
        /// As in [`Request::MoveBy`].
        speed: f64,
    },
    /// With what the machine file says of homing.
    Home {
        axis: usize,
    },
    SetMode {
        axis: usize,
        mode: Mode,
    },
    /// Acknowledge trips and faults of the axis and of what stopped with it.
    Reset {
        axis: usize,
    },
    /// Decelerate and hold.
    Stop {
        axis: usize,
    },
    StopAll,
    /// The shortest way to no motion and no power, as each axis is configured.
    EmergencyStop,
}

impl Request {
    /// Whether it only ends motion: such a request is never refused for being one too many, late, or from afar.
    #[must_use]
    pub fn stops(&self) -> bool {
        matches!(
            self,
            Self::Stop { .. } | Self::StopAll | Self::EmergencyStop | Self::Disable { .. }
        )
    }
}

/// What became of a request.
#[derive(Debug, Clone, PartialEq)]
pub enum News {
    /// It is done.
    Done { axis: usize, what: Doing },
    /// It was not taken. Where it would have moved the axis, the axis brakes from what it did before.
    Refused { axis: usize, why: String },
    /// A jog was not asked for again, and the axis brakes.
    LetGo { axis: usize },
    /// It has come to nothing.
    Failed {
        axis: usize,
        what: Doing,
        why: String,
    },
}

impl News {
    /// By its place in the cycle.
    #[must_use]
    pub fn axis(&self) -> usize {
        match self {
            Self::Done { axis, .. }
            | Self::Refused { axis, .. }
            | Self::LetGo { axis }
            | Self::Failed { axis, .. } => *axis,
        }
    }

    /// Whether something was not done as it was asked for.
    #[must_use]
    pub fn bad(&self) -> bool {
        matches!(self, Self::Refused { .. } | Self::Failed { .. })
    }
}

/// Without the axis' name.
impl fmt::Display for News {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Done { what, .. } => f.write_str(match what {
                Doing::Enabling => "enabled",
                Doing::Disabling => "disabled",
                Doing::Jogging { .. } | Doing::Stopping => "stopped",
                Doing::Moving { .. } => "is there",
                Doing::Homing => "homed",
                Doing::Switching { to } => return write!(f, "in {to}"),
                Doing::Resetting => "reset",
                Doing::Nothing => "idle",
            }),
            Self::Refused { why, .. } => write!(f, "refused: {why}"),
            Self::LetGo { .. } => f.write_str("let go, brakes"),
            Self::Failed { what, why, .. } => write!(f, "{what}: {why}"),
        }
    }
}

/// The machine as it is run by hand: axes that are in no group become one that stops without the rest. What stops
/// them is as before, but a machine that has stopped is over, and a group can be reset. Devices with emergency inputs stay
/// where an emergency stops everything.
#[must_use]
pub fn by_hand(mut machine: Machine) -> Machine {
    let watched: Vec<usize> = machine
        .stop
        .emergency
        .iter()
        .filter_map(|condition| Some(machine.inputs.get(condition.input)?.device))
        .collect();
    let free = |&device: &usize| {
        machine.devices[device].axis.is_some()
            && machine.group_of(device) == 0
            && !watched.contains(&device)
    };
    let devices: Vec<usize> = (0..machine.devices.len()).filter(free).collect();
    if !devices.is_empty() {
        machine.stop.groups.push(StopGroup {
            name: "axes".to_owned(),
            devices,
            others: machine.stop.others,
            outside: Outside::Continue,
        });
    }
    machine
}

/// News that wait for the operator's turn.
type Pending = VecDeque<News>;
