//! Steps as text, for `explain`, progress and errors.

use ecaxis_axis::Edge;

use super::{Action, Condition, Machine, duration};

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
                    Some(format!("{} to {mode}", self.devices.get(*axis)?.name))
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
                    Some(format!("{} = {value}", self.outputs.get(output)?.name))
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
            .get(condition.input)
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

    fn names(&self, axes: &[usize]) -> String {
        let names = axes.iter().filter_map(|&axis| self.devices.get(axis));
        names
            .map(|d| d.name.as_str())
            .collect::<Vec<_>>()
            .join(", ")
    }

    fn targets(&self, targets: &[(usize, f64)], arrow: &str, suffix: &str) -> String {
        let each = targets.iter().filter_map(|&(index, target)| {
            let device = self.devices.get(index)?;
            let axis = device.axis.as_ref()?;
            if suffix == TORQUE {
                let (torque, unit) = (short(axis.torque.shown(target)), axis.torque.unit);
                return Some(format!("{} {arrow} {torque} {unit}", device.name));
            }
            let unit = &axis.unit;
            Some(format!("{} {arrow} {target} {unit}{suffix}", device.name))
        });
        each.collect::<Vec<_>>().join(", ")
    }
}

fn rounded(x: f64) -> f64 {
    (x * 1e6).round() / 1e6
}

/// The placeholder of the axis's torque unit.
const TORQUE: &str = "torque";

/// Rounds to six significant digits.
fn short(x: f64) -> f64 {
    format!("{x:.5e}").parse().unwrap_or(x)
}

/// Returns a fraction in percent, without digits that come from rounding.
fn percent(fraction: f64) -> f64 {
    (fraction * 1e8).round() / 1e6
}
