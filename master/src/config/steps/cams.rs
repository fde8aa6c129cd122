//! Checks that followers can follow their cams.

use ecaxis_ecat::index::AxisIndex;

use super::ProgramChecker;
use super::follow::CLOCK_MARGIN;
use crate::config::problem::Problems;
use crate::config::{Action, AxisSetup, NumberPlace, Step};
use crate::rt::setpoint_generator::GearMaster;
use crate::text::rounded;

/// A larger excess of a limit is not rounding.
const ROUNDING: f64 = 1.0 + 1e-6;

/// What the program knows about the velocity of a master.
enum Speed {
    /// No step moves it.
    Free,
    /// The highest velocity of its steps.
    Known(f64),
    /// A step moves it with a velocity that only the run shows.
    Unknown,
}

impl ProgramChecker<'_> {
    /// Reports cams that exceed the limits of their followers at the highest velocity of the master.
    /// `all`: the program.
    pub(super) fn check_cams(&self, all: &[Step], steps: &[Step], p: &mut Problems<'_>) {
        for step in steps {
            if let Action::Gear {
                axis,
                master,
                ratio,
                cam: Some(cam),
                ..
            } = step.action
            {
                self.check_cam(all, step, (axis, master), (cam, ratio), p);
            }
            for inner in step.action.lists() {
                self.check_cams(all, inner, p);
            }
        }
    }

    fn check_cam(
        &self,
        all: &[Step],
        step: &Step,
        (axis, master): (AxisIndex, GearMaster),
        (cam, ratio): (usize, f64),
        p: &mut Problems<'_>,
    ) {
        let setup = |axis: AxisIndex| self.axes.get(axis)?.setup;
        let (Some(cam), Some(follower)) = (self.cams.get(cam), setup(axis)) else {
            return;
        };
        let (speed, ramp, origin, name, unit_of_master) = match master {
            GearMaster::Axis { axis: master, .. } => {
                let Some(leader) = setup(master) else { return };
                let limit = leader.config.limits.velocity;
                let (speed, origin) = match self.speed(all, master, leader) {
                    Speed::Free => (limit, "`limits.velocity` of"),
                    Speed::Known(speed) => (speed.min(limit), "the velocity of"),
                    Speed::Unknown => return,
                };
                (speed, 0.0, origin, &leader.name, &leader.unit)
            }
            GearMaster::LineShaft(shaft) => {
                let shaft = self.line_shafts.get(shaft);
                let Some(shaft) = shaft.and_then(|shaft| shaft.setup.as_ref()) else {
                    return;
                };
                // It decelerates at any place of the cam, and the followers stay in gear.
                let (speed, ramp) = (shaft.config.velocity, shaft.config.acceleration);
                let origin = "`velocity` and `acceleration` of";
                (
                    speed * CLOCK_MARGIN,
                    ramp * CLOCK_MARGIN,
                    origin,
                    &shaft.name,
                    &shaft.unit,
                )
            }
        };
        let limits = &follower.config.limits;
        let jerk = limits.jerk.unwrap_or(f64::INFINITY);
        let rows = [
            ("velocity", "/s", limits.velocity),
            ("acceleration", "/s²", limits.acceleration),
            ("jerk", "/s³", jerk),
        ];
        let on_cam = ratio.abs() * speed;
        let peaks = cam.cam.peaks();
        let [slope, ..] = peaks;
        for (order, (peak, (what, unit, limit))) in (1..).zip(peaks.iter().zip(rows)) {
            let braking = match order {
                2 => slope.value * ratio.abs() * ramp,
                _ => 0.0,
            };
            let needed = peak.value * on_cam.powi(order) + braking;
            if needed <= limit * ROUNDING {
                continue;
            }
            let unit = format!("{}{unit}", follower.unit);
            let message = format!(
                "`{}` cannot follow the cam `{}`: at {} of it, with {} {unit_of_master}/s, {origin} `{name}`, its {what} is {} {unit}, and its limit {}",
                follower.name,
                cam.name,
                rounded(peak.at),
                rounded(speed),
                rounded(needed),
                rounded(limit),
            );
            let hint = "make the cam flatter, or its master slower";
            p.add_hint(self.place_of(step), message, hint);
            return;
        }
    }

    /// Returns the highest velocity that steps give an axis.
    fn speed(&self, steps: &[Step], axis: AxisIndex, setup: &AxisSetup) -> Speed {
        let mut highest = Speed::Free;
        for step in steps {
            let own = match &step.action {
                Action::Move { speed, .. }
                | Action::Line { speed, .. }
                | Action::Probe { speed, .. } => {
                    let part = self.largest(step, NumberPlace::Speed, *speed);
                    Some(part * setup.config.limits.velocity)
                }
                Action::Velocity { targets, .. } => {
                    let target = targets.iter().find(|(of, _)| *of == axis);
                    target.map(|(_, n)| self.largest(step, NumberPlace::Target(axis), *n))
                }
                Action::Wave { .. }
                | Action::Table { .. }
                | Action::Gear { .. }
                | Action::Superimpose { .. }
                | Action::Torque { .. } => None,
                // The axis stands before or after them, or decelerates.
                _ => Some(0.0),
            };
            if step.action.commanded().contains(&axis) {
                highest = match (highest, own) {
                    (Speed::Unknown, _) | (_, None) => Speed::Unknown,
                    // A step that moves nothing says nothing.
                    (before, Some(0.0)) => before,
                    (Speed::Known(before), Some(own)) => Speed::Known(before.max(own)),
                    (Speed::Free, Some(own)) => Speed::Known(own),
                };
            }
            for inner in step.action.lists() {
                highest = match (highest, self.speed(inner, axis, setup)) {
                    (Speed::Unknown, _) | (_, Speed::Unknown) => Speed::Unknown,
                    (one, Speed::Free) | (Speed::Free, one) => one,
                    (Speed::Known(one), Speed::Known(other)) => Speed::Known(one.max(other)),
                };
            }
        }
        highest
    }

    /// Returns the largest absolute value of a number of a step.
    fn largest(&self, step: &Step, place: NumberPlace, value: f64) -> f64 {
        let used = step.uses.iter().find(|known| known.place == place);
        let range = used.and_then(|used| self.variables.get(used.variable.0)?.range);
        range.map_or(value.abs(), |[low, high]| low.abs().max(high.abs()))
    }
}
