//! The program of a machine, its stop settings, and their text for `explain`, progress and errors.

use std::path::PathBuf;

use ecaxis_axis::{AxisStatus, Edge, StopMethod};
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, GroupIndex};

use super::{
    AxisSetup, Bounds, Condition, GroupStopScope, InputRef, Machine, OutputRef, Signal, duration,
};
use crate::text::{percent, rounded};

/// One step of the program.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// The step number: `2`, or `2.1` for the first step inside the second.
    pub number: String,
    /// The line in the machine file.
    pub line: u32,
    pub action: Action,
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
    /// Move to the table's first position, then play the table.
    Table {
        axis: AxisIndex,
        /// The index into [`Machine::tables`].
        table: usize,
        /// The fractions for the move to the first position, as in [`Action::Move`].
        speed: f64,
        ramp: f64,
    },
    /// Make one axis follow another until its next motion.
    Gear {
        axis: AxisIndex,
        master: AxisIndex,
        /// `true` to follow the master's actual position instead of its set-point.
        actual: bool,
        /// The number of follower units per master unit.
        ratio: f64,
        /// The follower's position at master position 0. `None`: the present relation stays.
        offset: Option<f64>,
        smoothing_ns: u64,
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
}

impl Action {
    /// Returns the steps inside the step.
    pub fn inner(&self) -> impl Iterator<Item = &Step> {
        let (steps, otherwise): (&[Step], &[Step]) = match self {
            Self::Repeat { steps, .. } | Self::While { steps, .. } => (steps, &[]),
            Self::If {
                steps, otherwise, ..
            } => (steps, otherwise),
            _ => (&[], &[]),
        };
        steps.iter().chain(otherwise)
    }

    /// True for a step after which no other one runs.
    pub(crate) fn never_ends(&self) -> bool {
        match self {
            Self::Alarm { .. } => true,
            Self::Repeat {
                times: None,
                until: None,
                ..
            } => true,
            Self::Repeat { steps, .. } => steps.last().is_some_and(|s| s.action.never_ends()),
            Self::If {
                steps, otherwise, ..
            } => [steps, otherwise]
                .iter()
                .all(|steps| steps.last().is_some_and(|s| s.action.never_ends())),
            _ => false,
        }
    }

    /// As [`Action::inner`].
    pub(crate) fn inner_mut(&mut self) -> impl Iterator<Item = &mut Step> {
        let (steps, otherwise): (&mut [Step], &mut [Step]) = match self {
            Self::Repeat { steps, .. } | Self::While { steps, .. } => (steps, &mut []),
            Self::If {
                steps, otherwise, ..
            } => (steps, otherwise),
            _ => (&mut [], &mut []),
        };
        steps.iter_mut().chain(otherwise)
    }
}

/// A condition of the program: alternatives, each of which is tests that hold at once.
#[derive(Debug, Clone, PartialEq)]
pub struct When(pub Vec<Vec<Test>>);

impl When {
    /// `value` returns the present value of a subject.
    pub fn holds(&self, value: impl Fn(Subject) -> f64) -> bool {
        let all = |tests: &Vec<Test>| tests.iter().all(|test| test.bounds.holds(value(test.of)));
        self.0.iter().any(all)
    }
}

/// A test of one value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Test {
    pub of: Subject,
    pub bounds: Bounds,
}

/// A value that a condition tests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Subject {
    Input(InputRef),
    Axis(AxisIndex, AxisValue),
    Variable(VariableRef),
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

/// A variable by its place in [`Machine::variables`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VariableRef(pub usize);

/// A variable of the program.
#[derive(Debug, Clone, PartialEq)]
pub struct Variable {
    pub name: String,
    pub initial: f64,
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
            Self::Homed => yes(status.homed),
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

/// A table of set-points and its file.
#[derive(Debug, Clone, PartialEq)]
pub struct TableFile {
    pub path: PathBuf,
    pub table: ecaxis_axis::setpoint::Table,
}

impl Machine {
    /// Returns a step as text: `move x → 50 mm at 50 % of the velocity …`.
    #[must_use]
    pub fn describe(&self, action: &Action) -> String {
        match action {
            Action::Enable { axes } => format!("enable {}", self.names(axes)),
            Action::Disable { axes } => format!("disable {}", self.names(axes)),
            Action::Reset { axes } => format!("reset the faults of {}", self.names(axes)),
            Action::Home { axes } => format!("find home with {}", self.names(axes)),
            Action::Stop { axes } => format!("stop {}", self.names(axes)),
            Action::Move {
                relative,
                targets,
                speed,
                ramp,
                together,
            } => format!(
                "move {} at {} % of the velocity and {} % of the acceleration limit{}",
                self.targets(targets, if *relative { "by" } else { "→" }, ""),
                percent(*speed),
                percent(*ramp),
                if *together {
                    ", to arrive together"
                } else {
                    ""
                },
            ),
            Action::Probe {
                axis,
                probe,
                edge,
                relative,
                target,
                speed,
                ramp,
            } => format!(
                "probe {} until input {} {}, at {} % of the velocity and {} % of the acceleration limit",
                self.targets(&[(*axis, *target)], if *relative { "by" } else { "→" }, ""),
                probe.number(),
                match edge {
                    Edge::Positive => "rises",
                    Edge::Negative => "falls",
                },
                percent(*speed),
                percent(*ramp),
            ),
            Action::Line {
                relative,
                targets,
                speed,
                ramp,
            } => format!(
                "straight line {} at {} % of the velocity and {} % of the acceleration limits",
                self.targets(targets, if *relative { "by" } else { "→" }, ""),
                percent(*speed),
                percent(*ramp),
            ),
            Action::Wave { axis, wave } => format!(
                "swing {} for {} s",
                self.names(&[*axis]),
                rounded(wave.duration_s())
            ),
            Action::Table { axis, table, .. } => {
                let file = self
                    .tables
                    .get(*table)
                    .map(|t| t.path.display().to_string());
                format!(
                    "move {} along {}",
                    self.names(&[*axis]),
                    file.unwrap_or_default()
                )
            }
            Action::Gear {
                axis,
                master,
                actual,
                ratio,
                ..
            } => format!(
                "gear {} to {}{} with a ratio of {ratio}",
                self.names(&[*axis]),
                if *actual {
                    "the reported position of "
                } else {
                    ""
                },
                self.names(&[*master]),
            ),
            Action::Velocity { targets, ramp } => format!(
                "turn {} at {} % of the acceleration limit",
                self.targets(targets, "→", "/s"),
                percent(*ramp),
            ),
            Action::Torque { targets, ramp_ns } => format!(
                "torque {} within {}",
                self.targets(targets, "→", TORQUE),
                duration::show(*ramp_ns),
            ),
            Action::Mode { targets } => {
                let each = targets.iter().filter_map(|(axis, mode)| {
                    Some(format!("{} to {mode}", self.axes.get(*axis)?.name))
                });
                format!("switch {}", each.collect::<Vec<_>>().join(", "))
            }
            Action::Dwell { ns } => format!("wait {}", duration::show(*ns)),
            Action::Wait {
                when,
                timeout_ns: None,
            } => format!("wait until {}", self.when(when)),
            Action::Wait {
                when,
                timeout_ns: Some(ns),
            } => format!(
                "wait until {}, {} at most",
                self.when(when),
                duration::show(*ns)
            ),
            Action::Assign { add, values } => {
                let sign = if *add { "+=" } else { "=" };
                let each = values.iter().filter_map(|&(variable, value)| {
                    Some(format!(
                        "{} {sign} {value}",
                        self.variables.get(variable.0)?.name
                    ))
                });
                each.collect::<Vec<_>>().join(", ")
            }
            Action::Override(values) => self.describe_overrides(values),
            Action::Message { text } => text.clone(),
            Action::Alarm { text } => format!("alarm: {text}"),
            Action::Set { values } => {
                let each = values.iter().filter_map(|&(output, value)| {
                    Some(format!(
                        "{} = {value}",
                        self.short(self.outputs.get(output.0)?)
                    ))
                });
                format!("set {}", each.collect::<Vec<_>>().join(", "))
            }
            Action::Repeat { times, until, .. } => {
                let times = match times {
                    None => "for ever".to_owned(),
                    Some(1) => "once".to_owned(),
                    Some(times) => format!("{times} times"),
                };
                let until = until
                    .as_ref()
                    .map(|when| format!(", until {}", self.when(when)));
                times + &until.unwrap_or_default()
            }
            Action::While { when, .. } => format!("while {}", self.when(when)),
            Action::If { when, .. } => format!("if {}", self.when(when)),
        }
    }

    /// Returns a condition as text: `io.Input 3 = 1`.
    #[must_use]
    pub fn condition(&self, condition: &Condition) -> String {
        self.test(&Test {
            of: Subject::Input(condition.input),
            bounds: condition.bounds,
        })
    }

    /// Returns the condition of a step as text: `io.Input 3 = 1 and x.position > 5, or …`.
    #[must_use]
    pub fn when(&self, when: &When) -> String {
        let all = |tests: &Vec<Test>| {
            let each: Vec<_> = tests.iter().map(|test| self.test(test)).collect();
            each.join(" and ")
        };
        when.0.iter().map(all).collect::<Vec<_>>().join(", or ")
    }

    /// Returns the name of `[signals]`, otherwise the signal's own.
    fn short(&self, signal: &Signal) -> String {
        let named = self
            .signals
            .iter()
            .find(|named| named.signal == signal.name);
        named.map_or_else(|| signal.name.clone(), |named| named.name.clone())
    }

    pub(crate) fn test(&self, test: &Test) -> String {
        let name = match test.of {
            Subject::Input(input) => self.inputs.get(input.0).map(|input| self.short(input)),
            Subject::Variable(at) => self.variables.get(at.0).map(|known| known.name.clone()),
            Subject::Axis(axis, value) => {
                let word = AxisValue::ALL.iter().find(|(_, each)| *each == value);
                let axis = self.axes.get(axis);
                axis.zip(word)
                    .map(|(axis, (word, _))| format!("{}.{word}", axis.name))
            }
        };
        let Bounds {
            equal,
            above,
            below,
        } = test.bounds;
        let bounds = [("=", equal), (">", above), ("<", below)].into_iter();
        let bounds = bounds.filter_map(|(sign, n)| Some(format!("{sign} {}", n?)));
        let bounds: Vec<_> = bounds.collect();
        format!(
            "{} {}",
            name.as_deref().unwrap_or("?"),
            bounds.join(" and ")
        )
    }

    fn names(&self, axes: &[AxisIndex]) -> String {
        let names = axes.iter().filter_map(|&axis| self.axes.get(axis));
        names
            .map(|axis| axis.name.as_str())
            .collect::<Vec<_>>()
            .join(", ")
    }

    fn targets(&self, targets: &[(AxisIndex, f64)], arrow: &str, suffix: &str) -> String {
        let each = targets.iter().filter_map(|&(index, target)| {
            let axis = self.axes.get(index)?;
            if suffix == TORQUE {
                let (torque, unit) = (short(axis.torque.shown(target)), axis.torque.unit);
                return Some(format!("{} {arrow} {torque} {unit}", axis.name));
            }
            let unit = &axis.unit;
            Some(format!("{} {arrow} {target} {unit}{suffix}", axis.name))
        });
        each.collect::<Vec<_>>().join(", ")
    }
}

/// The placeholder of the axis's torque unit.
const TORQUE: &str = "torque";

/// Rounds to six significant digits.
fn short(x: f64) -> f64 {
    format!("{x:.5e}").parse().unwrap_or(x)
}
