//! Variables, and the numbers of steps that come from them.

use std::borrow::Cow;

use ecaxis_ecat::index::AxisIndex;

use super::{Action, Step};
use crate::config::{Machine, Signal};

/// A variable by its place in [`Machine::variables`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VariableRef(pub usize);

/// A variable of the program.
#[derive(Debug, Clone, PartialEq)]
pub struct Variable {
    pub name: String,
    pub initial: f64,
    /// The values that it may have. `None`: all; then no step takes it as a number.
    pub range: Option<[f64; 2]>,
}

/// A number of a step that is the value of a variable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VariableUse {
    pub place: NumberPlace,
    pub variable: VariableRef,
}

/// A number of a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NumberPlace {
    /// The target of an axis.
    Target(AxisIndex),
    Speed,
    Ramp,
    /// The time of `dwell`, in s.
    Time,
    /// A number of `let` or `add`, by its place.
    Value(usize),
    /// The value of an output of `set`, by its place.
    Output(usize),
}

impl Step {
    /// Returns true if the target of the axis is the value of a variable.
    pub(crate) fn varies(&self, axis: AxisIndex) -> bool {
        let place = NumberPlace::Target(axis);
        self.uses.iter().any(|known| known.place == place)
    }
}

impl Machine {
    /// Returns the step with the present values of its variables.
    #[must_use]
    pub fn filled<'s>(&self, step: &'s Step, variables: &[f64]) -> Cow<'s, Step> {
        if step.uses.is_empty() {
            return Cow::Borrowed(step);
        }
        let mut step = step.clone();
        for VariableUse { place, variable } in step.uses.clone() {
            // The check has seen that the variable exists.
            let value = variables.get(variable.0).copied().unwrap_or(f64::NAN);
            self.fill(&mut step.action, place, value);
        }
        Cow::Owned(step)
    }

    fn fill(&self, action: &mut Action, place: NumberPlace, value: f64) {
        match (action, place) {
            (Action::Torque { targets, .. }, NumberPlace::Target(axis)) => {
                let setup = self.axes.get(axis);
                let percent = setup.map_or(f64::NAN, |setup| setup.torque.percent(value));
                set_target(targets, axis, percent);
            }
            (
                Action::Move { targets, .. }
                | Action::Line { targets, .. }
                | Action::Velocity { targets, .. },
                NumberPlace::Target(axis),
            ) => set_target(targets, axis, value),
            (
                Action::Move { speed, .. }
                | Action::Line { speed, .. }
                | Action::Probe { speed, .. }
                | Action::Table { speed, .. },
                NumberPlace::Speed,
            ) => *speed = value,
            (
                Action::Move { ramp, .. }
                | Action::Line { ramp, .. }
                | Action::Velocity { ramp, .. }
                | Action::Probe { ramp, .. }
                | Action::Table { ramp, .. },
                NumberPlace::Ramp,
            ) => *ramp = value,
            // The range is above 0; the cast saturates.
            (Action::Dwell { ns }, NumberPlace::Time) => *ns = (value * 1e9) as u64,
            (Action::Assign { values, .. }, NumberPlace::Value(at)) => {
                if let Some((_, number)) = values.get_mut(at) {
                    *number = value;
                }
            }
            (Action::Set { values }, NumberPlace::Output(at)) => {
                if let Some((output, number)) = values.get_mut(at) {
                    let signal = self.outputs.get(output.0);
                    let whole = signal.is_some_and(Signal::is_whole);
                    *number = if whole { value.round() } else { value };
                }
            }
            _ => {}
        }
    }
}

fn set_target(targets: &mut [(AxisIndex, f64)], axis: AxisIndex, value: f64) {
    for (_, target) in targets.iter_mut().filter(|(of, _)| *of == axis) {
        *target = value;
    }
}
