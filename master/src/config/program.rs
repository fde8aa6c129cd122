//! The program of a machine, its stop settings, and their text for `explain`, progress and errors.

mod describe;
mod variables;

pub use variables::{NumberPlace, Variable, VariableRef, VariableUse};

use ecaxis_axis::{AxisStatus, Edge, StopMethod};
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, GroupIndex};

use crate::rt::setpoint_generator::GearMaster;

use super::{AxisSetup, Bounds, Condition, GroupStopScope, InputRef, OutputRef, Signal};

/// One step of the program.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// The step number: `2`, or `2.1` for the first step inside the second.
    pub number: String,
    /// The line in the machine file.
    pub line: u32,
    pub action: Action,
    /// The numbers of the action that are values of variables.
    pub uses: Vec<VariableUse>,
}

/// The action of a step. Targets are pairs of an axis and a value in user units.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    Enable {
        axes: Vec<AxisIndex>,
    },
    /// Decelerate, then remove power.
    Disable {
        axes: Vec<AxisIndex>,
    },
    /// Acknowledge trips and reset drive faults.
    Reset {
        axes: Vec<AxisIndex>,
    },
    /// Homing by the drive.
    Home {
        axes: Vec<AxisIndex>,
    },
    /// Couple the halves of gantries, by their first halves, or decouple them.
    Couple {
        axes: Vec<AxisIndex>,
        coupled: bool,
    },
    /// Decelerate and hold position.
    Stop {
        axes: Vec<AxisIndex>,
    },
    /// Move and wait until every axis is in target.
    Move {
        /// `true` if targets are relative to the position at the start of the step.
        relative: bool,
        targets: Vec<(AxisIndex, f64)>,
        /// The fraction of each axis's velocity limit.
        speed: f64,
        /// The fraction of each axis's acceleration limit.
        ramp: f64,
        /// `true` for jerk-limited motion from rest in which all axes arrive in the same cycle.
        together: bool,
    },
    /// Move until the touch probe's input has an edge. The step fails without an edge.
    Probe {
        axis: AxisIndex,
        probe: ecaxis_axis::Probe,
        edge: Edge,
        /// `true` if the end of the move is relative to the present position.
        relative: bool,
        target: f64,
        /// The fractions, as in [`Action::Move`].
        speed: f64,
        ramp: f64,
    },
    /// Move all axes along a straight line, jerk-limited; they arrive in the same cycle.
    Line {
        relative: bool,
        targets: Vec<(AxisIndex, f64)>,
        /// The fraction of each axis's velocity limit.
        speed: f64,
        /// The fraction of each axis's acceleration and jerk limits.
        ramp: f64,
    },
    /// Move in a wave around the present position.
    Wave {
        axis: AxisIndex,
        wave: ecaxis_axis::setpoint::Wave,
    },
    /// Move to the first positions of the tables, then play them in common time.
    Table {
        /// The files, or the path.
        name: String,
        /// Each axis with an index into [`Machine::tables`](super::Machine::tables).
        tables: Vec<(AxisIndex, usize)>,
        /// The fractions for the move to the first position, as in [`Action::Move`].
        speed: f64,
        ramp: f64,
    },
    /// Make one axis follow another, or a line shaft, until its next motion.
    Gear {
        axis: AxisIndex,
        master: GearMaster,
        /// The number of follower units per master unit.
        ratio: f64,
        /// The follower's position at master position 0. `None`: the present relation stays.
        offset: Option<f64>,
        smoothing_ns: u64,
        /// The index into [`Machine::cams`](super::Machine::cams). `ratio` is then the way on the cam
        /// per way of the master.
        cam: Option<usize>,
    },
    /// Shift followers against their masters.
    Phase {
        targets: Vec<(AxisIndex, f64)>,
    },
    /// Add moves to the motions of the axes.
    Superimpose {
        targets: Vec<(AxisIndex, f64)>,
    },
    /// Reach the velocities and keep moving.
    Velocity {
        targets: Vec<(AxisIndex, f64)>,
        /// The fraction of each axis's acceleration limit.
        ramp: f64,
    },
    /// Apply torques in percent of rated torque.
    Torque {
        targets: Vec<(AxisIndex, f64)>,
        /// The time of the ramp to the new torque.
        ramp_ns: u64,
    },
    /// Switch modes of operation, even in motion.
    Mode {
        targets: Vec<(AxisIndex, ecaxis_axis::Mode)>,
    },
    Dwell {
        ns: u64,
    },
    /// Wait until the condition holds.
    Wait {
        when: When,
        /// `None`: without limit.
        timeout_ns: Option<u64>,
    },
    /// Set outputs to values.
    Set {
        values: Vec<(OutputRef, f64)>,
    },
    /// Set the override of the machine (the first group) or of groups.
    Override(Vec<(GroupIndex, f64)>),
    /// Set variables, or add to them.
    Assign {
        add: bool,
        values: Vec<(VariableRef, f64)>,
    },
    /// Report a text.
    Message {
        text: String,
    },
    /// End the program with an error.
    Alarm {
        text: String,
    },
    Repeat {
        /// `None`: without end.
        times: Option<u32>,
        /// Checked after each round, which is then the last one.
        until: Option<When>,
        steps: Vec<Step>,
    },
    /// Repeat while the condition holds. It is checked before each round.
    While {
        when: When,
        steps: Vec<Step>,
    },
    If {
        when: When,
        steps: Vec<Step>,
        otherwise: Vec<Step>,
    },
    /// Run the steps of a named subprogram.
    Call {
        name: String,
        steps: Vec<Step>,
    },
    /// Run all branches at the same time. Each axis belongs to one branch.
    Parallel {
        branches: Vec<Vec<Step>>,
    },
}

impl Action {
    /// Returns the lists of steps inside the step.
    #[must_use]
    pub fn lists(&self) -> Vec<&[Step]> {
        match self {
            Self::Repeat { steps, .. } | Self::While { steps, .. } | Self::Call { steps, .. } => {
                vec![steps]
            }
            Self::If {
                steps, otherwise, ..
            } => vec![steps, otherwise],
            Self::Parallel { branches } => branches.iter().map(Vec::as_slice).collect(),
            _ => Vec::new(),
        }
    }

    /// Returns the axes to which the step gives commands.
    pub fn commanded(&self) -> Vec<AxisIndex> {
        match self {
            Self::Enable { axes }
            | Self::Disable { axes }
            | Self::Reset { axes }
            | Self::Home { axes }
            | Self::Couple { axes, .. }
            | Self::Stop { axes } => axes.clone(),
            Self::Move { targets, .. }
            | Self::Line { targets, .. }
            | Self::Velocity { targets, .. }
            | Self::Phase { targets }
            | Self::Superimpose { targets }
            | Self::Torque { targets, .. } => targets.iter().map(|&(axis, _)| axis).collect(),
            Self::Table { tables, .. } => tables.iter().map(|&(axis, _)| axis).collect(),
            Self::Mode { targets } => targets.iter().map(|&(axis, _)| axis).collect(),
            Self::Wave { axis, .. } | Self::Probe { axis, .. } | Self::Gear { axis, .. } => {
                vec![*axis]
            }
            _ => Vec::new(),
        }
    }

    /// Returns the steps inside the step.
    pub fn inner(&self) -> impl Iterator<Item = &Step> {
        self.lists().into_iter().flatten()
    }

    /// True for a step after which no other one runs.
    pub(crate) fn never_ends(&self) -> bool {
        let ends_never = |steps: &&[Step]| steps.last().is_some_and(|s| s.action.never_ends());
        let mut lists = self.lists().into_iter();
        match self {
            Self::Alarm { .. }
            | Self::Repeat {
                times: None,
                until: None,
                ..
            } => true,
            Self::If { .. } => lists.all(|steps| ends_never(&steps)),
            Self::Repeat { .. } | Self::Call { .. } | Self::Parallel { .. } => {
                lists.any(|steps| ends_never(&steps))
            }
            _ => false,
        }
    }

    /// As [`Action::inner`].
    pub(crate) fn inner_mut(&mut self) -> impl Iterator<Item = &mut Step> {
        let lists: Vec<&mut Vec<Step>> = match self {
            Self::Repeat { steps, .. } | Self::While { steps, .. } | Self::Call { steps, .. } => {
                vec![steps]
            }
            Self::If {
                steps, otherwise, ..
            } => vec![steps, otherwise],
            Self::Parallel { branches } => branches.iter_mut().collect(),
            _ => Vec::new(),
        };
        lists.into_iter().flatten()
    }
}

/// A condition of the program: alternatives, each of which is tests that hold at once.
#[derive(Debug, Clone, PartialEq)]
pub struct When(pub Vec<Vec<Test>>);

impl When {
    /// `value` returns the present value of a subject.
    pub fn holds(&self, value: impl Fn(Subject) -> f64) -> bool {
        let all = |tests: &Vec<Test>| tests.iter().all(|test| test.holds(&value));
        self.0.iter().any(all)
    }
}

/// A test of one value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Test {
    pub of: Subject,
    pub bounds: Bounds<Bound>,
}

impl Test {
    /// `value` returns the present value of a subject.
    pub(crate) fn holds(&self, value: impl Fn(Subject) -> f64) -> bool {
        let bounds = self.bounds.map(|bound| match bound {
            Bound::Number(n) => n,
            Bound::Variable(variable) => value(Subject::Variable(variable)),
        });
        bounds.holds(value(self.of))
    }
}

/// A bound of a test.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bound {
    Number(f64),
    /// The present value of a variable.
    Variable(VariableRef),
}

/// A value that a condition tests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Subject {
    Input(InputRef),
    Axis(AxisIndex, AxisValue),
    Variable(VariableRef),
}

/// Conditions of `[program]` that pause the program.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ProgramInputs {
    /// No step begins while it holds.
    pub pause: Option<When>,
    /// One step of a paused program begins when it becomes true.
    pub step: Option<When>,
}

/// A name of `[signals]`, for a signal of a device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NamedSignal {
    pub name: String,
    /// As [`Signal::name`].
    pub signal: String,
}

/// An input of a simulated I/O device that is switched by time.
#[derive(Debug, Clone, PartialEq)]
pub struct SwitchedInput {
    /// Since the bus got its power.
    pub at_ns: u64,
    /// It is 0 again after this time. `None`: never.
    pub for_ns: Option<u64>,
    pub input: Signal,
    pub value: f64,
}

/// What a condition may test of an axis. Yes is 1, no is 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AxisValue {
    Position,
    Velocity,
    Torque,
    FollowingError,
    Enabled,
    Moving,
    AtRest,
    Homed,
    Fault,
}

impl AxisValue {
    pub const ALL: [(&str, Self); 9] = [
        ("position", Self::Position),
        ("velocity", Self::Velocity),
        ("torque", Self::Torque),
        ("following_error", Self::FollowingError),
        ("enabled", Self::Enabled),
        ("moving", Self::Moving),
        ("at_rest", Self::AtRest),
        ("homed", Self::Homed),
        ("fault", Self::Fault),
    ];

    /// Returns the value, in the unit of the machine file.
    pub(crate) fn of(self, status: &AxisStatus, setup: &AxisSetup) -> f64 {
        let yes = |is: bool| f64::from(u8::from(is));
        match self {
            Self::Position => status.position,
            Self::Velocity => status.velocity,
            Self::Torque => setup.torque.shown(status.torque),
            Self::FollowingError => status.following_error,
            Self::Enabled => yes(status.ready),
            Self::Moving => yes(status.moving),
            Self::AtRest => yes(status.at_rest),
            Self::Homed => yes(status.homed()),
            Self::Fault => yes(status.fault.is_some() || status.trip.is_some()),
        }
    }

    pub(crate) fn is_yes_or_no(self) -> bool {
        use AxisValue::{AtRest, Enabled, Fault, Homed, Moving};
        matches!(self, Enabled | Moving | AtRest | Homed | Fault)
    }
}

/// How the machine stops.
#[derive(Debug, Clone, PartialEq)]
pub struct StopSetup {
    /// The stop method of the other axes after a fault or trip, unless their group has its own.
    pub others: StopMethod,
    /// The stop method of axes without valid inputs. Axes that still answer stop by set-points.
    pub bus_lost: StopMethod,
    /// The conditions for an emergency stop; one is enough.
    pub emergency: Vec<Condition>,
    /// The groups of SubDevices that stop together. Devices without a group form one more group.
    pub groups: Vec<StopGroup>,
}

impl Default for StopSetup {
    fn default() -> Self {
        Self {
            others: StopMethod::Ramp,
            bus_lost: StopMethod::QuickStop,
            emergency: Vec::new(),
            groups: Vec::new(),
        }
    }
}

/// SubDevices that stop together.
#[derive(Debug, Clone, PartialEq)]
pub struct StopGroup {
    pub name: String,
    /// Its devices, with and without an axis. A device is in one group only.
    pub devices: Vec<DeviceIndex>,
    /// The stop method of its other axes after a fault or trip.
    pub others: StopMethod,
    pub outside: GroupStopScope,
}
