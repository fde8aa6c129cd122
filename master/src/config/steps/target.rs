//! Checks that targets are within limits and possible in one of the axis's modes.

use ecaxis_ecat::index::AxisIndex;
use toml::Spanned;

use super::ProgramChecker;
use crate::config::axis::too_long;
use crate::config::problem::{Problems, Span};
use crate::config::raw::{Named, RawNumber};
use crate::config::{AxisSetup, NumberPlace};
use ecaxis_axis::Mode;

impl ProgramChecker<'_> {
    pub(super) fn targets(
        &mut self,
        targets: Named<RawNumber>,
        what: TargetKind,
        p: &mut Problems<'_>,
    ) -> Option<Vec<(AxisIndex, f64)>> {
        let count = targets.len();
        let mut resolved = Vec::with_capacity(count);
        for (name, value) in targets {
            let Some((index, _)) = self.axis(&name, p) else {
                continue;
            };
            let number = self.number(&value, NumberPlace::Target(index), p);
            let (Some(axis), Some(number)) = (self.axes[index].setup, number) else {
                continue;
            };
            let end = |end| within(&Spanned::new(value.span(), end), what, axis, p);
            if !self.any_mode(index, |mode| what.possible(mode, axis)) {
                let (message, hint) = what.impossible(name.get_ref(), axis);
                p.add_hint(name.span(), message, hint);
            } else if number.ends.into_iter().all(end) {
                let value = number.value;
                let torque = what == TargetKind::Torque;
                resolved.push((
                    index,
                    if torque {
                        axis.torque.percent(value)
                    } else {
                        value
                    },
                ));
            }
        }
        resolved.sort_by_key(|(index, _)| *index);
        (count > 0 && resolved.len() == count).then_some(resolved)
    }

    /// Reports an axis that would take more than one hour to reach its velocity.
    pub(super) fn check_ramp_time(
        &self,
        targets: &[(AxisIndex, f64)],
        ramp: f64,
        at: Option<Span>,
        p: &mut Problems<'_>,
        velocity: impl Fn(f64, f64) -> f64,
    ) {
        let Some(at) = at else { return };
        let slow = targets.iter().find_map(|&(index, target)| {
            let axis = self.axes.get(index)?;
            let limits = &axis.setup?.config.limits;
            let velocity = velocity(target, limits.velocity);
            Some((axis.name, too_long(velocity, limits.acceleration * ramp)?))
        });
        if let Some((name, time)) = slow {
            let message =
                format!("with a `ramp` of {ramp}, `{name}` takes {time} to reach its velocity");
            p.add_hint(at, message, "a ramp may last an hour at most");
        }
    }
}

/// The kind of a target.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum TargetKind {
    Position,
    /// A position set-point that is computed in every cycle.
    SetPoint,
    /// A distance from the present position.
    Way,
    /// A distance from the motion of the axis.
    Shift,
    Velocity,
    Torque,
}

impl TargetKind {
    pub(super) fn of_move(relative: bool) -> Self {
        if relative { Self::Way } else { Self::Position }
    }

    fn verb(self) -> &'static str {
        match self {
            Self::Position | Self::SetPoint => "move",
            Self::Way => "move_by",
            Self::Shift => "superimpose",
            Self::Velocity => "velocity",
            Self::Torque => "torque",
        }
    }

    /// Returns `true` if the axis accepts the target in this mode.
    pub(super) fn possible(self, mode: Mode, axis: &AxisSetup) -> bool {
        let loops = &axis.config.loops;
        let position = match mode {
            Mode::Csv => loops.csv.is_some(),
            Mode::Cst => loops.cst.is_some(),
            Mode::Csp | Mode::Pp => true,
            _ => false,
        };
        match self {
            Self::Position | Self::Way => position,
            Self::SetPoint | Self::Shift => position && mode != Mode::Pp,
            Self::Velocity => position && mode != Mode::Pp || matches!(mode, Mode::Csv | Mode::Pv),
            Self::Torque => mode == Mode::Cst,
        }
    }

    pub(super) fn impossible(self, name: &str, axis: &AxisSetup) -> (String, String) {
        let message = format!(
            "`{}` is not possible for `{name}` in mode \"{}\"",
            self.verb(),
            axis.mode
        );
        let instead = match axis.config.mode {
            Mode::Csv => {
                "write `velocity = { … }`, or give the axis a position loop: `csv = { kv = 20.0 }`"
            }
            Mode::Cst => {
                "write `torque = { … }`, or give the axis a position loop: `cst = { kp = 10.0 }`"
            }
            _ => "write `move = { … }`, or switch it before: `mode = { … = \"cst\" }`",
        };
        (message, instead.to_owned())
    }
}

pub(super) fn within(
    value: &Spanned<f64>,
    what: TargetKind,
    axis: &AxisSetup,
    p: &mut Problems<'_>,
) -> bool {
    let limits = &axis.config.limits;
    let unit = &axis.unit;
    let range = limits.position.unwrap_or(axis.config.scale.range());
    let (low, high, unit) = match what {
        TargetKind::Position | TargetKind::SetPoint => (range[0], range[1], unit.clone()),
        // The end position is only known at run time, but the distance cannot exceed the range.
        TargetKind::Way | TargetKind::Shift => {
            (range[0] - range[1], range[1] - range[0], unit.clone())
        }
        TargetKind::Velocity => (-limits.velocity, limits.velocity, format!("{unit}/s")),
        TargetKind::Torque => {
            let limit = axis.torque.shown(limits.torque);
            (-limit, limit, axis.torque.unit.to_string())
        }
    };
    let n = *value.get_ref();
    // A limit converted twice may have a rounding error.
    let rounding = if what == TargetKind::Torque {
        high * 1e-9
    } else {
        0.0
    };
    if (low - rounding..=high + rounding).contains(&n) {
        return true;
    }
    let message = match what {
        TargetKind::Way | TargetKind::Shift => format!(
            "a way of {n} {unit} is longer than the axis' range, {} to {} {unit}",
            range[0], range[1]
        ),
        _ => format!("{n} {unit} is outside the axis' limits, {low} to {high} {unit}"),
    };
    let hint = match what {
        TargetKind::Velocity => "correct the step, or `limits.velocity` of the axis",
        TargetKind::Torque => "correct the step, or `limits.torque` of the axis",
        _ if limits.position.is_none() => "the drive counts no further; correct the step",
        _ => "correct the step, or `limits.position` of the axis",
    };
    p.add_hint(value.span(), message, hint);
    false
}
