//! The text of steps and conditions, for `explain`, progress and errors.

use ecaxis_axis::Edge;
use ecaxis_ecat::index::{AxisIndex, LineShaftIndex};

use super::{Action, AxisValue, Bound, NumberPlace, Step, Subject, Test, When};
use crate::config::{Bounds, Condition, Machine, Signal, duration};
use crate::rt::setpoint_generator::GearMaster;
use crate::text::rounded;

impl Machine {
    /// Returns a step as text, with the names of its variables. Their values are the initial ones.
    #[must_use]
    pub fn describe_step(&self, step: &Step) -> String {
        let each = step.uses.iter().filter_map(|known| {
            let name = &self.variables.get(known.variable.0)?.name;
            Some(match known.place {
                NumberPlace::Target(axis) => format!("{} from `{name}`", self.axes.get(axis)?.name),
                NumberPlace::Speed => format!("speed from `{name}`"),
                NumberPlace::Ramp => format!("ramp from `{name}`"),
                NumberPlace::Time => format!("time from `{name}`"),
                NumberPlace::Value(_) | NumberPlace::Output(_) => format!("from `{name}`"),
            })
        });
        let each: Vec<_> = each.collect();
        let text = self.describe(&step.action);
        match each.as_slice() {
            [] => text,
            each => format!("{text} ({})", each.join(", ")),
        }
    }

    /// Returns a step as text: `move x → 50 mm at 50 % of the velocity …`.
    #[must_use]
    pub fn describe(&self, action: &Action) -> String {
        match action {
            Action::Enable { axes } => format!("enable {}", self.names(axes)),
            Action::Disable { axes } => format!("disable {}", self.names(axes)),
            Action::Reset { axes } => format!("reset the faults of {}", self.names(axes)),
            Action::Home { axes } => format!("find home with {}", self.names(axes)),
            Action::Couple { axes, coupled } => {
                let verb = if *coupled { "couple" } else { "decouple" };
                let pairs = self.gantries.iter().filter(|g| axes.contains(&g.axes[0]));
                let pairs = pairs.map(|gantry| {
                    let [first, second] = gantry.axes.map(|axis| self.names(&[axis]));
                    format!("{first} and {second}")
                });
                format!("{verb} {}", pairs.collect::<Vec<_>>().join(", "))
            }
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
            Action::Table { name, tables, .. } => {
                let axes: Vec<_> = tables.iter().map(|&(axis, _)| axis).collect();
                let first = tables
                    .first()
                    .and_then(|&(_, table)| self.tables.get(table));
                format!(
                    "move {} along {name}, {} s",
                    self.names(&axes),
                    rounded(first.map_or(0.0, ecaxis_axis::setpoint::Table::duration_s))
                )
            }
            Action::Gear {
                axis,
                master,
                ratio,
                cam,
                ..
            } => format!(
                "gear {} to {} with a ratio of {ratio}{}",
                self.names(&[*axis]),
                match *master {
                    GearMaster::Axis { axis, actual } => {
                        let of = if actual {
                            "the reported position of "
                        } else {
                            ""
                        };
                        format!("{of}{}", self.names(&[axis]))
                    }
                    GearMaster::LineShaft(shaft) => self.line_shaft_name(shaft).to_owned(),
                },
                cam.and_then(|cam| self.cams.get(cam))
                    .map_or_else(String::new, |cam| format!(", by the cam {}", cam.name)),
            ),
            Action::Phase { targets } => format!("shift {}", self.targets(targets, "by", "")),
            Action::Superimpose { targets } => {
                format!("superimpose {}", self.targets(targets, "by", ""))
            }
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
            Action::Message { text } => text.clone(),
            Action::Override(values) => self.describe_overrides(values),
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
            Action::Call { name, .. } => format!("call {name}"),
            Action::Parallel { branches } => {
                format!("{} branches at the same time", branches.len())
            }
        }
    }

    /// Returns a condition as text: `io.Input 3 = 1`.
    #[must_use]
    pub fn condition(&self, condition: &Condition) -> String {
        self.test(&Test {
            of: Subject::Input(condition.input),
            bounds: condition.bounds.map(Bound::Number),
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
        let bounds = bounds.filter_map(|(sign, bound)| {
            Some(match bound? {
                Bound::Number(n) => format!("{sign} {n}"),
                Bound::Variable(at) => format!("{sign} {}", self.variables.get(at.0)?.name),
            })
        });
        let bounds: Vec<_> = bounds.collect();
        format!(
            "{} {}",
            name.as_deref().unwrap_or("?"),
            bounds.join(" and ")
        )
    }

    /// Returns the name of a line shaft.
    #[must_use]
    pub fn line_shaft_name(&self, shaft: LineShaftIndex) -> &str {
        let setup = self.line_shafts.get(shaft);
        setup.map_or("?", |setup| setup.name.as_str())
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
