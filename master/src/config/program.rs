//! The program of a machine, its stop settings, and their text for `explain`, progress and errors.

use std::path::PathBuf;

use ecaxis_axis::{Edge, StopMethod};
use ecaxis_ecat::index::{AxisIndex, DeviceIndex};

use super::{Condition, GroupStopScope, Machine, OutputRef, duration};
use crate::text::rounded;

/// One step of the program.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// The step number: `2`, or `2.1` for the first step inside the second.
    pub number: String,
    /// The line in the machine file.
    pub line: u32,
    pub action: Action,
}

/// The action of a step. Targets are pairs of an axis and a value
/// in user units.
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
    /// Wait until all conditions hold in the same cycle.
    Wait {
        conditions: Vec<Condition>,
        timeout_ns: u64,
    },
    /// Set outputs to values.
    Set {
        values: Vec<(OutputRef, f64)>,
    },
    Repeat {
        times: u32,
        steps: Vec<Step>,
    },
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
                conditions,
                timeout_ns,
            } => {
                let each = conditions.iter().map(|c| self.condition(c));
                format!(
                    "wait until {}, {} at most",
                    each.collect::<Vec<_>>().join(" and "),
                    duration::show(*timeout_ns),
                )
            }
            Action::Set { values } => {
                let each = values.iter().filter_map(|&(output, value)| {
                    Some(format!("{} = {value}", self.outputs.get(output.0)?.name))
                });
                format!("set {}", each.collect::<Vec<_>>().join(", "))
            }
            Action::Repeat { times: 1, .. } => "once".to_owned(),
            Action::Repeat { times, .. } => format!("{times} times"),
        }
    }

    /// Returns a condition as text: `io.Input 3 = 1`.
    #[must_use]
    pub fn condition(&self, condition: &Condition) -> String {
        let name = self
            .inputs
            .get(condition.input.0)
            .map_or("?", |input| input.name.as_str());
        let bounds = [
            ("=", condition.equal),
            (">", condition.above),
            ("<", condition.below),
        ];
        let bounds = bounds.into_iter();
        let bounds = bounds.filter_map(|(sign, n)| Some(format!("{sign} {}", n?)));
        format!("{name} {}", bounds.collect::<Vec<_>>().join(" and "))
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

/// Returns a fraction in percent, without digits that come from rounding.
fn percent(fraction: f64) -> f64 {
    rounded(fraction * 100.0)
}
