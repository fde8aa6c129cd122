//! Steps and gantries: a program commands the first half, and the second half follows.

use ecaxis_ecat::index::AxisIndex;

use super::ProgramChecker;
use crate::config::problem::Problems;
use crate::config::raw::RawAxes;
use crate::config::{Action, Step};
use crate::rt::gantry::GantryConfig;

impl ProgramChecker<'_> {
    /// Returns the gantries with these first halves; `None`: all.
    pub(super) fn couple(
        &self,
        axes: RawAxes,
        coupled: bool,
        p: &mut Problems<'_>,
    ) -> Option<Action> {
        let firsts: Vec<_> = self.gantries.iter().map(|g| g.axes[0]).collect();
        let Some(names) = axes else {
            return Some(Action::Couple {
                axes: firsts,
                coupled,
            });
        };
        let mut axes = Vec::with_capacity(names.len());
        for name in &names {
            let (axis, _) = self.axis(name, p)?;
            if !firsts.contains(&axis) {
                let message = format!("`{}` is not the first axis of a gantry", name.get_ref());
                let firsts = firsts
                    .iter()
                    .map(|&axis| format!("`{}`", self.axes[axis].name));
                let hint = match firsts.collect::<Vec<_>>().as_slice() {
                    [] => "the machine has no [[gantry]]".to_owned(),
                    firsts => format!("name one of {}", firsts.join(", ")),
                };
                p.add_hint(name.span(), message, hint);
                return None;
            }
            axes.push(axis);
        }
        Some(Action::Couple { axes, coupled })
    }

    /// Gives steps that switch a half of a gantry both halves, and reports motions of second
    /// halves. The halves of a gantry that the program decouples are axes of their own.
    pub(super) fn join_halves(&self, steps: &mut [Step], p: &mut Problems<'_>) {
        let whole: Vec<_> = self
            .gantries
            .iter()
            .filter(|gantry| !decouples(steps, gantry.axes[0]))
            .copied()
            .collect();
        if !whole.is_empty() {
            self.join_in(steps, &whole, p);
        }
    }

    fn join_in(&self, steps: &mut [Step], whole: &[GantryConfig], p: &mut Problems<'_>) {
        for step in steps {
            let second_half = |axis: AxisIndex| whole.iter().find(|g| g.axes[1] == axis);
            match &mut step.action {
                Action::Enable { axes }
                | Action::Disable { axes }
                | Action::Reset { axes }
                | Action::Stop { axes } => {
                    for gantry in whole {
                        if gantry.axes.iter().any(|half| axes.contains(half)) {
                            let halves = gantry.axes.into_iter();
                            let missing: Vec<_> =
                                halves.filter(|half| !axes.contains(half)).collect();
                            axes.extend(missing);
                        }
                    }
                }
                // `home = true` names both.
                Action::Home { axes } => {
                    let all = axes.clone();
                    axes.retain(|axis| {
                        second_half(*axis).is_none_or(|g| !all.contains(&g.axes[0]))
                    });
                }
                _ => {}
            }
            let switches = matches!(
                step.action,
                Action::Enable { .. }
                    | Action::Disable { .. }
                    | Action::Reset { .. }
                    | Action::Stop { .. }
            );
            let commanded = step.action.commanded();
            let mut commanded = commanded.iter().filter(|_| !switches);
            if let Some((axis, gantry)) = commanded.find_map(|&a| Some((a, second_half(a)?))) {
                let [first, second] = [gantry.axes[0], axis].map(|axis| self.axes[axis].name);
                let message = format!("`{second}` is the second half of the gantry of `{first}`");
                let hint = format!("name `{first}`: both halves move, or decouple them before");
                let place = (step.number.clone(), Some(axis));
                let place = self.places.borrow().get(&place).cloned();
                let place = place.unwrap_or_else(|| self.place_of(step));
                p.add_hint(place, message, hint);
            }
            for step in step.action.inner_mut() {
                self.join_in(std::slice::from_mut(step), whole, p);
            }
        }
    }
}

/// True if a step decouples the gantry with this first half.
fn decouples(steps: &[Step], first: AxisIndex) -> bool {
    steps.iter().any(|step| match &step.action {
        Action::Couple { axes, coupled } => !coupled && axes.contains(&first),
        action => (action.lists().into_iter()).any(|steps| decouples(steps, first)),
    })
}
