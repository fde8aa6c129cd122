//! Finds waits and repetitions that nothing can end, and axes that two branches move.

use std::collections::{BTreeMap, BTreeSet};

use ecaxis_ecat::index::AxisIndex;

use super::ProgramChecker;
use crate::config::problem::Problems;
use crate::config::{Action, AxisValue, Bound, Step, Subject, Test, VariableRef, When};

impl ProgramChecker<'_> {
    /// `others`: the variables that other branches set meanwhile.
    pub(super) fn check_endings(
        &self,
        steps: &[Step],
        others: &BTreeSet<usize>,
        p: &mut Problems<'_>,
    ) {
        for step in steps {
            match &step.action {
                Action::Wait { when, timeout_ns } => {
                    self.check_possible(step, when, p);
                    if timeout_ns.is_none() && !self.changes(when, others) {
                        let message = "nothing can end this wait: no other branch sets its variables meanwhile";
                        let hint = "test variables with `if` or `while`, or write a `timeout`";
                        p.add_hint(self.place_of(step), message, hint);
                    }
                }
                Action::While { when, steps } => {
                    self.check_loop(step, when, steps, others, "`while`", p);
                }
                Action::Repeat {
                    until: Some(when),
                    times: None,
                    steps,
                } => self.check_loop(step, when, steps, others, "`until`", p),
                Action::If { when, .. }
                | Action::Repeat {
                    until: Some(when), ..
                } => {
                    self.check_possible(step, when, p);
                }
                Action::Parallel { branches } => {
                    self.check_branches(branches, p);
                    let assigned: Vec<_> = branches.iter().map(|steps| assigned(steps)).collect();
                    for (own, steps) in branches.iter().enumerate() {
                        let all = assigned
                            .iter()
                            .enumerate()
                            .filter(|(branch, _)| *branch != own);
                        let mut others = others.clone();
                        others.extend(all.flat_map(|(_, variables)| variables));
                        self.check_endings(steps, &others, p);
                    }
                    continue;
                }
                _ => {}
            }
            for steps in step.action.lists() {
                self.check_endings(steps, others, p);
            }
        }
    }

    /// True if something besides the program, or another branch, changes a value of the condition.
    fn changes(&self, when: &When, others: &BTreeSet<usize>) -> bool {
        let varies = |bound: Option<Bound>| match bound {
            Some(Bound::Variable(VariableRef(at))) => others.contains(&at),
            _ => false,
        };
        let changes = |Test { of, bounds }: &Test| match of {
            Subject::Variable(VariableRef(at)) if !others.contains(at) => {
                [bounds.equal, bounds.above, bounds.below]
                    .into_iter()
                    .any(varies)
            }
            _ => true,
        };
        when.0.iter().any(|tests| tests.iter().any(changes))
    }

    fn check_loop(
        &self,
        step: &Step,
        when: &When,
        steps: &[Step],
        others: &BTreeSet<usize>,
        key: &str,
        p: &mut Problems<'_>,
    ) {
        self.check_possible(step, when, p);
        let mut changed = assigned(steps);
        changed.extend(others);
        if !self.changes(when, &changed) {
            let message = format!(
                "nothing can end this repetition: no step in it sets the variables of its {key}"
            );
            let hint = "set one in it with `let` or `add`";
            p.add_hint(self.place_of(step), message, hint);
        }
    }

    /// Reports a condition that no value satisfies.
    fn check_possible(&self, step: &Step, when: &When, p: &mut Problems<'_>) {
        for test in when.0.iter().flatten() {
            let (name, [low, high]) = match test.of {
                Subject::Input(input) => {
                    let Some(signal) = self.inputs.get(input.0) else {
                        continue;
                    };
                    let (low, high, _) = signal.range();
                    (signal.name.clone(), [low, high])
                }
                Subject::Variable(VariableRef(at)) => {
                    let known = self.variables.get(at);
                    let Some((known, range)) = known.and_then(|v| Some((v, v.range?))) else {
                        continue;
                    };
                    (known.name.clone(), range)
                }
                Subject::Axis(axis, AxisValue::Position) => {
                    let setup = self.axes.get(axis).and_then(|axis| axis.setup);
                    let Some(range) = setup.and_then(|setup| setup.config.limits.position) else {
                        continue;
                    };
                    (format!("{}.position", self.axes[axis].name), range)
                }
                Subject::Axis(..) => continue,
            };
            let (bounds, text) = (test.bounds, |bound| self.bound_text(bound));
            let [least, greatest] = [0, 1].map(|end| move |bound| self.ends(bound)[end]);
            let never = match (bounds.equal, bounds.above, bounds.below) {
                (Some(n), ..) if greatest(n) < low || least(n) > high => text(n),
                (_, Some(n), _) if least(n) >= high => format!("above {}", text(n)),
                (_, _, Some(n)) if greatest(n) <= low => format!("below {}", text(n)),
                _ => continue,
            };
            let message = format!("`{name}` is never {never}: it is {low} to {high}");
            p.add_hint(self.place_of(step), message, "correct the condition");
        }
    }

    /// Reports an axis that two branches move.
    fn check_branches(&self, branches: &[Vec<Step>], p: &mut Problems<'_>) {
        let mut owners: BTreeMap<AxisIndex, &Step> = BTreeMap::new();
        let mut reported = BTreeSet::new();
        for branch in branches {
            let mut own = BTreeMap::new();
            moving(branch, &mut own);
            for (axis, step) in own {
                let Some(other) = owners.get(&axis) else {
                    owners.insert(axis, step);
                    continue;
                };
                if !reported.insert(axis) {
                    continue;
                }
                let message = format!(
                    "`{}` moves in two branches at once: step {} in line {} and step {} in line {}",
                    self.axes[axis].name, other.number, other.line, step.number, step.line,
                );
                let hint = "command it in one branch, and let the other wait for a variable";
                p.add_hint(self.place(&step.number, axis), message, hint);
            }
        }
    }
}

/// Returns the variables that steps set.
fn assigned(steps: &[Step]) -> BTreeSet<usize> {
    let mut all = BTreeSet::new();
    for step in steps {
        if let Action::Assign { values, .. } = &step.action {
            all.extend(values.iter().map(|(variable, _)| variable.0));
        }
        for steps in step.action.lists() {
            all.extend(assigned(steps));
        }
    }
    all
}

/// Collects the axes that steps command, each with the first of its steps.
fn moving<'s>(steps: &'s [Step], all: &mut BTreeMap<AxisIndex, &'s Step>) {
    for step in steps {
        // These act on a motion that another branch may command.
        let on_top = matches!(
            step.action,
            Action::Phase { .. } | Action::Superimpose { .. }
        );
        for axis in step.action.commanded() {
            if !on_top {
                all.entry(axis).or_insert(step);
            }
        }
        for steps in step.action.lists() {
            moving(steps, all);
        }
    }
}
