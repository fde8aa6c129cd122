//! Simulates the program before the bus starts and finds steps that are certain to fail.
//!
//! The state of an axis before a step (mode, power, master, position) is either known exactly or
//! unknown. Only a known state rejects a step. The axis would reject such a step as well, but only
//! after all steps before it.

use ecaxis_axis::Mode;
use ecaxis_ecat::index::{AxisIndex, IndexVec};

use super::target::TargetKind;
use super::{ProgramChecker, enables};
use crate::config::problem::{Problems, Span};
use crate::config::{Action, AxisSetup, Step};

/// The maximum number of steps checked, with repetitions expanded.
const MOST_VISITS: u32 = 200_000;

/// The tolerance for comparing range ends with sums of the file's numbers.
const ROUNDING: f64 = 1e-9;

/// The state of an axis between two steps.
#[derive(Debug, Clone, PartialEq)]
struct State {
    /// `None`: it depends on a condition.
    mode: Option<Mode>,
    /// The step that switched the mode.
    switched_by: Option<String>,
    power: bool,
    /// The step that removed the power.
    disabled_by: Option<String>,
    /// The step since which the axis follows another axis.
    follows_since: Option<String>,
    /// `true` if the axis follows another axis on some path.
    may_follow: bool,
    /// The step since which the axis moves at constant velocity, unless the end of its range may
    /// have stopped it.
    turns_since: Option<String>,
    /// The step since which the axis has a torque other than 0.
    pushes_since: Option<String>,
    /// The position of its set-point after arrival, if known.
    position: Option<f64>,
    /// `true` after a rejected step: later steps are not reached.
    given_up: bool,
}

/// What a step requires of an axis.
#[derive(Debug, Clone, Copy)]
struct Precondition {
    verb: &'static str,
    what: Option<TargetKind>,
    /// The axis must be at rest.
    rest: bool,
    /// The axis must have no torque set-point other than 0.
    no_torque: bool,
    /// The axis must not follow another axis.
    free: bool,
}

struct ProgramState<'w, 'c, 'p, 's> {
    checker: &'w ProgramChecker<'c>,
    axes: IndexVec<AxisIndex, Option<State>>,
    visits: u32,
    /// `true` if a step is being repeated.
    again: bool,
    /// `true` while the state of a repetition is searched.
    silent: bool,
    p: &'p mut Problems<'s>,
}

impl ProgramChecker<'_> {
    pub(super) fn flow(&self, steps: &[Step], repeat: u32, p: &mut Problems<'_>) {
        let power = !enables(steps);
        let axes = self.axes.iter().map(|axis| {
            let axis = axis.setup?;
            Some(State {
                mode: Some(axis.config.mode),
                switched_by: None,
                power,
                disabled_by: None,
                follows_since: None,
                may_follow: false,
                turns_since: None,
                pushes_since: None,
                position: None,
                given_up: false,
            })
        });
        let mut walk = ProgramState {
            checker: self,
            axes: axes.collect(),
            visits: 0,
            again: false,
            silent: false,
            p,
        };
        walk.times(repeat, steps);
    }
}

impl ProgramState<'_, '_, '_, '_> {
    /// Runs the steps repeatedly until a round changes nothing.
    fn times(&mut self, times: u32, steps: &[Step]) {
        let again = self.again;
        for round in 0..times {
            let before = self.axes.clone();
            self.again = again || round > 0;
            self.all(steps);
            if self.axes == before || self.visits > MOST_VISITS {
                break;
            }
        }
        self.again = again;
    }

    fn all(&mut self, steps: &[Step]) {
        for step in steps {
            self.visits += 1;
            if self.visits > MOST_VISITS {
                return;
            }
            self.step(step);
        }
    }

    /// Runs the steps as often as a condition may repeat them, also never. A step is refused if no
    /// number of rounds makes it possible.
    fn perhaps_often(&mut self, steps: &[Step]) {
        let silent = std::mem::replace(&mut self.silent, true);
        loop {
            let before = self.axes.clone();
            self.all(steps);
            self.or(&before);
            if self.axes == before || self.visits > MOST_VISITS {
                break;
            }
        }
        self.silent = silent;
        let before = self.axes.clone();
        self.all(steps);
        self.or(&before);
    }

    /// The axes are in one of two states.
    fn or(&mut self, other: &IndexVec<AxisIndex, Option<State>>) {
        for (state, other) in self.axes.iter_mut().zip(other) {
            if let (Some(state), Some(other)) = (state, other) {
                state.or(other);
            }
        }
    }

    fn step(&mut self, step: &Step) {
        let number = &step.number;
        match &step.action {
            Action::Repeat {
                times,
                until: None,
                steps,
            } => self.times(times.unwrap_or(u32::MAX), steps),
            Action::Repeat {
                until: Some(_),
                steps,
                ..
            } => {
                self.all(steps);
                self.perhaps_often(steps);
            }
            Action::While { steps, .. } => self.perhaps_often(steps),
            Action::Call { steps, .. } => self.all(steps),
            // No axis is in two branches, so their order does not matter.
            Action::Parallel { branches } => branches.iter().for_each(|steps| self.all(steps)),
            Action::If {
                steps, otherwise, ..
            } => {
                let before = self.axes.clone();
                self.all(steps);
                let then = std::mem::replace(&mut self.axes, before);
                self.all(otherwise);
                self.or(&then);
            }
            Action::Enable { axes } => self.each(axes, |state| {
                if !state.power {
                    state.power = true;
                    state.position = None;
                }
            }),
            Action::Disable { axes } => self.each(axes, |state| {
                state.power = false;
                state.disabled_by = Some(number.clone());
                state.stops();
            }),
            Action::Stop { axes } => self.each(axes, State::stops),
            Action::Home { axes } => {
                let need = Precondition {
                    rest: true,
                    no_torque: true,
                    free: true,
                    ..Precondition::power("home")
                };
                for &axis in axes {
                    self.need(step, axis, need);
                }
                self.each(axes, State::stops);
            }
            Action::Move {
                relative,
                targets,
                together,
                speed,
                ramp,
                ..
            } => {
                let paced = (*speed, *ramp) != (1.0, 1.0);
                for (axis, _) in targets.iter().filter(|_| paced) {
                    self.free_profile(step, *axis);
                }
                let what = if *together {
                    TargetKind::SetPoint
                } else {
                    TargetKind::Position
                };
                let verb = if *relative { "move_by" } else { "move" };
                let verb = match (together, relative) {
                    (true, true) => "move_by` with `arrive = \"together\"",
                    (true, false) => "move` with `arrive = \"together\"",
                    _ => verb,
                };
                self.moved(step, verb, what, *together, *relative, targets);
            }
            Action::Line {
                relative, targets, ..
            } => {
                let verb = if *relative { "line_by" } else { "line" };
                self.moved(step, verb, TargetKind::SetPoint, true, *relative, targets);
            }
            Action::Probe {
                axis,
                relative,
                target,
                ..
            } => {
                let targets = [(*axis, *target)];
                self.moved(
                    step,
                    "probe",
                    TargetKind::Position,
                    false,
                    *relative,
                    &targets,
                );
                // The position of the edge is unknown.
                self.each(&[*axis], |state| state.position = None);
            }
            Action::Wave { axis, wave } => {
                self.keep_in_range(step, *axis, wave.amplitude());
                self.follow_setpoints(step, "sine` or `square", *axis, true)
            }
            Action::Table { tables, .. } => {
                for &(axis, _) in tables {
                    self.follow_setpoints(step, "table", axis, false);
                }
            }
            Action::Gear { axis, master, .. } => {
                if let Some(master) = master.axis() {
                    self.need(step, master, Precondition::power("gear"));
                }
                self.follow_setpoints(step, "gear", *axis, false);
                self.each(&[*axis], |state| {
                    state.follows_since = Some(number.clone());
                    state.may_follow = true;
                    state.position = None;
                });
            }
            Action::Velocity { targets, .. } => {
                for &(axis, velocity) in targets {
                    self.need(
                        step,
                        axis,
                        Precondition::of("velocity", TargetKind::Velocity),
                    );
                    let endless = self.limits(axis).is_none();
                    self.each(&[axis], |state| {
                        state.stops();
                        let turns = endless && (velocity != 0.0 || step.varies(axis));
                        state.turns_since = turns.then(|| number.clone());
                    });
                }
            }
            Action::Torque { targets, .. } => {
                for &(axis, torque) in targets {
                    self.need(step, axis, Precondition::of("torque", TargetKind::Torque));
                    self.each(&[axis], |state| {
                        state.stops();
                        let pushes = torque != 0.0 && !step.varies(axis);
                        state.pushes_since = pushes.then(|| number.clone());
                    });
                }
            }
            Action::Mode { targets } => {
                for &(axis, mode) in targets {
                    self.switch(step, axis, mode);
                }
            }
            Action::Phase { targets } => {
                for &(axis, _) in targets {
                    self.need(step, axis, Precondition::power("phase"));
                    self.needs_master(step, axis);
                }
            }
            Action::Superimpose { targets } => {
                for &(axis, _) in targets {
                    let need = Precondition::of("superimpose", TargetKind::Shift);
                    self.need(step, axis, need);
                    self.each(&[axis], |state| state.position = None);
                }
            }
            Action::Couple { axes, coupled } => self.couple(step, axes, *coupled),
            Action::Reset { .. }
            | Action::Dwell { .. }
            | Action::Wait { .. }
            | Action::Set { .. }
            | Action::Override(_)
            | Action::Assign { .. }
            | Action::Message { .. }
            | Action::Alarm { .. } => {}
        }
    }

    fn switch(&mut self, step: &Step, axis: AxisIndex, mode: Mode) {
        let powered = self.state(axis).is_some_and(|s| s.power);
        if powered {
            let unpowered = |axis: &AxisSetup| axis.config.mode_change_unpowered;
            let rests = mode == Mode::Pp || self.axis(axis).is_some_and(unpowered);
            // A switch to the mode that the axis has does nothing.
            let switches = self.state(axis).and_then(|state| state.mode) != Some(mode);
            let need = Precondition {
                rest: rests && switches,
                no_torque: rests && switches,
                free: true,
                ..Precondition::power("mode")
            };
            self.need(step, axis, need);
        }
        self.each(&[axis], |state| {
            if state.mode != Some(mode) {
                state.mode = Some(mode);
                state.switched_by = Some(step.number.clone());
                state.position = None;
            }
            // Whether the motion continues depends on the mode.
            (state.turns_since, state.pushes_since) = (None, None);
        });
    }

    /// Checks a step `couple` or `decouple`: both halves rest, and `couple` waits for their power.
    fn couple(&mut self, step: &Step, axes: &[AxisIndex], coupled: bool) {
        let gantries = self.checker.gantries.iter();
        let named = gantries.filter(|gantry| axes.contains(&gantry.axes[0]));
        let halves: Vec<_> = named.flat_map(|gantry| gantry.axes).collect();
        for axis in halves {
            if coupled || self.state(axis).is_some_and(|state| state.power) {
                let need = Precondition {
                    rest: true,
                    free: true,
                    ..Precondition::power(if coupled { "couple" } else { "decouple" })
                };
                self.need(step, axis, need);
            }
            // The second half moves to the first one.
            self.each(&[axis], |state| state.position = None);
        }
    }

    /// Rejects a step for an axis that follows no other axis on any path.
    fn needs_master(&mut self, step: &Step, axis: AxisIndex) {
        if self.state(axis).is_none_or(|state| state.may_follow) {
            return;
        }
        let name = self.name(axis);
        let message = format!(
            "`phase` shifts `{name}` against its master, and no step before lets it follow one{}",
            self.round()
        );
        let hint = format!("let a step engage it before: `gear = {{ {name} = {{ to = … }} }}`");
        self.refuse(step, axis, message, hint);
    }

    /// Handles a step that ends with its axes at their targets.
    fn moved(
        &mut self,
        step: &Step,
        verb: &'static str,
        what: TargetKind,
        rest: bool,
        relative: bool,
        targets: &[(AxisIndex, f64)],
    ) {
        for &(axis, target) in targets {
            self.need(
                step,
                axis,
                Precondition {
                    rest,
                    ..Precondition::of(verb, what)
                },
            );
            let from = self.state(axis).and_then(|state| state.position);
            let to = if relative {
                from.map(|from| from + target)
            } else {
                Some(target)
            };
            let to = to.filter(|_| !step.varies(axis));
            if let (Some([low, high]), Some(to), Some(from), true) =
                (self.limits(axis), to, from, relative)
            {
                let rounding = ROUNDING * (high - low);
                if to < low - rounding || to > high + rounding {
                    let unit = self.axis(axis).map_or("", |axis| axis.unit.as_str());
                    let message = format!(
                        "`{verb}` of {target} {unit} leads `{}` from {from} to {to} {unit}, outside its limits, {low} to {high} {unit}{}",
                        self.name(axis),
                        self.round(),
                    );
                    let hint = "go back before, or repeat it less often";
                    self.refuse(step, axis, message, hint.to_owned());
                }
            }
            let modulo = self
                .axis(axis)
                .is_some_and(|axis| axis.config.scale.modulo().is_some());
            self.each(&[axis], |state| {
                state.stops();
                state.position = to.filter(|_| !modulo);
            });
        }
    }

    /// Rejects a wave about a known position that leaves the limits of its axis.
    fn keep_in_range(&mut self, step: &Step, axis: AxisIndex, amplitude: f64) {
        let from = self.state(axis).and_then(|state| state.position);
        let (Some([low, high]), Some(from)) = (self.limits(axis), from) else {
            return;
        };
        let rounding = ROUNDING * (high - low);
        if from - amplitude < low - rounding || from + amplitude > high + rounding {
            let unit = self.axis(axis).map_or("", |axis| axis.unit.as_str());
            let message = format!(
                "an amplitude of {amplitude} {unit} about {from} {unit} leads `{}` outside its limits, {low} to {high} {unit}{}",
                self.name(axis),
                self.round(),
            );
            let hint = "take a smaller amplitude, or move to another position before";
            self.refuse(step, axis, message, hint.to_owned());
        }
    }

    /// Rejects a speed or ramp for a drive that moves with its own.
    fn free_profile(&mut self, step: &Step, axis: AxisIndex) {
        let (Some(state), Some(setup)) = (self.state(axis), self.axis(axis)) else {
            return;
        };
        if state.mode == Some(Mode::Pp) && setup.config.profile_fixed {
            let name = self.name(axis);
            let message = format!(
                "`{name}` moves with the speed and ramp of its drive in mode \"pp\"{}",
                self.round()
            );
            let hint =
                "leave `speed` and `ramp` out, or switch it before: `mode = { … = \"csp\" }`";
            self.refuse(step, axis, message, hint.to_owned());
        }
    }

    /// Handles a step that sets every set-point of an axis. `back`: it ends where it began.
    fn follow_setpoints(&mut self, step: &Step, verb: &'static str, axis: AxisIndex, back: bool) {
        // A wave begins at rest; the others decelerate before or begin in motion.
        let need = Precondition {
            rest: back,
            ..Precondition::of(verb, TargetKind::SetPoint)
        };
        self.need(step, axis, need);
        self.each(&[axis], |state| {
            let position = state.position.filter(|_| back);
            state.stops();
            state.position = position;
        });
    }

    fn each(&mut self, axes: &[AxisIndex], change: impl Fn(&mut State)) {
        for &axis in axes {
            if let Some(Some(state)) = self.axes.get_mut(axis) {
                change(state);
            }
        }
    }

    fn state(&self, axis: AxisIndex) -> Option<&State> {
        self.axes.get(axis)?.as_ref()
    }

    fn axis(&self, axis: AxisIndex) -> Option<&AxisSetup> {
        self.checker.axes.get(axis)?.setup
    }

    fn limits(&self, axis: AxisIndex) -> Option<[f64; 2]> {
        self.axis(axis)?.config.limits.position
    }

    fn name(&self, axis: AxisIndex) -> &str {
        self.checker.axes.get(axis).map_or("", |axis| axis.name)
    }

    fn round(&self) -> &'static str {
        if self.again {
            ", when it is repeated"
        } else {
            ""
        }
    }

    /// Rejects the step if the axis cannot run it.
    fn need(&mut self, step: &Step, axis: AxisIndex, need: Precondition) {
        let (Some(state), Some(setup)) = (self.state(axis), self.axis(axis)) else {
            return;
        };
        let (name, round, verb) = (self.name(axis), self.round(), need.verb);
        let (message, hint) = if !state.power {
            let message = match &state.disabled_by {
                Some(by) => format!(
                    "`{verb}` needs `{name}` to have power, which step {by} has taken away{round}"
                ),
                None => format!(
                    "`{verb}` needs `{name}` to have power, and no step before has enabled it{round}"
                ),
            };
            let hint = format!("let a step enable it before: `enable = [\"{name}\"]`");
            (message, hint)
        } else if let Some(by) = state.follows_since.as_ref().filter(|_| need.free) {
            let message = format!(
                "`{verb}` needs `{name}` to be free, but since step {by} it follows another axis{round}"
            );
            (
                message,
                format!("let a step stop it before: `stop = [\"{name}\"]`"),
            )
        } else if let Some(by) = state.turns_since.as_ref().filter(|_| need.rest) {
            let message =
                format!("`{verb}` needs `{name}` at rest, but since step {by} it turns{round}");
            let hint = format!(
                "let a step stop it before: `velocity = {{ {name} = 0.0 }}` or `stop = [\"{name}\"]`"
            );
            (message, hint)
        } else if let Some(by) = state.pushes_since.as_ref().filter(|_| need.no_torque) {
            let message = format!(
                "`{verb}` needs `{name}` without torque, but since step {by} it has one{round}"
            );
            let hint = format!(
                "let a step take it away before: `torque = {{ {name} = 0.0 }}` or `stop = [\"{name}\"]`"
            );
            (message, hint)
        } else if let (Some(what), Some(mode)) = (need.what, state.mode)
            && !what.possible(mode, setup)
        {
            let by = match &state.switched_by {
                Some(by) => format!(", to which step {by} has switched it"),
                None => String::new(),
            };
            let message = format!(
                "`{verb}` is not possible for `{name}` in mode \"{}\"{by}{round}",
                word(mode)
            );
            (message, better(name, setup, what))
        } else {
            return;
        };
        self.refuse(step, axis, message, hint);
    }

    fn refuse(&mut self, step: &Step, axis: AxisIndex, message: String, hint: String) {
        let Some(Some(state)) = self.axes.get_mut(axis).filter(|_| !self.silent) else {
            return;
        };
        if !std::mem::replace(&mut state.given_up, true) {
            let at = self.checker.place(&step.number, axis);
            self.p.add_hint(at, message, hint);
        }
    }
}

impl Precondition {
    /// A step that needs power and nothing else.
    const fn power(verb: &'static str) -> Self {
        Self {
            verb,
            what: None,
            rest: false,
            no_torque: false,
            free: false,
        }
    }

    const fn of(verb: &'static str, what: TargetKind) -> Self {
        Self {
            what: Some(what),
            ..Self::power(verb)
        }
    }
}

impl State {
    /// Keeps what both states have. An axis that may have power counts as one that has it.
    fn or(&mut self, other: &Self) {
        let Self {
            mode,
            switched_by,
            power,
            disabled_by,
            follows_since,
            may_follow,
            turns_since,
            pushes_since,
            position,
            given_up,
        } = self;
        *mode = mode.filter(|mode| other.mode == Some(*mode));
        *power |= other.power;
        *given_up |= other.given_up;
        *may_follow |= other.may_follow;
        *position = position.filter(|at| other.position == Some(*at));
        let keep = |own: &mut Option<String>, other: &Option<String>| {
            if other.is_none() {
                *own = None;
            }
        };
        keep(switched_by, &other.switched_by);
        keep(disabled_by, &other.disabled_by);
        keep(follows_since, &other.follows_since);
        keep(turns_since, &other.turns_since);
        keep(pushes_since, &other.pushes_since);
    }

    /// Ends the previous motion because of a new command.
    fn stops(&mut self) {
        self.follows_since = None;
        self.may_follow = false;
        self.turns_since = None;
        self.pushes_since = None;
        self.position = None;
    }
}

impl ProgramChecker<'_> {
    /// Returns the place of a step's condition.
    pub(super) fn place_of(&self, step: &Step) -> Span {
        let places = self.places.borrow();
        let of = |key: String| places.get(&(key, None)).cloned();
        let condition = of(format!("{}?", step.number));
        condition
            .or_else(|| of(step.number.clone()))
            .unwrap_or_default()
    }

    /// Returns the place of the axis's name in a step, otherwise of the step.
    pub(super) fn place(&self, number: &str, axis: AxisIndex) -> Span {
        let places = self.places.borrow();
        let of = |axis| places.get(&(number.to_owned(), axis)).cloned();
        of(Some(axis)).or_else(|| of(None)).unwrap_or_default()
    }
}

/// Returns the mode as the machine file writes it.
fn word(mode: Mode) -> String {
    ecaxis_esi::Mode::ALL
        .into_iter()
        .find(|known| known.code() == mode.code())
        .map_or_else(|| mode.to_string(), |known| known.name().to_owned())
}

/// Returns the mode to switch to, or another remedy.
fn better(name: &str, setup: &AxisSetup, what: TargetKind) -> String {
    let modes = ecaxis_esi::Mode::ALL.into_iter().filter(|mode| {
        let mode = Mode::from_code(mode.code());
        let offered = setup.config.modes.contains(mode) || setup.config.mode == mode;
        offered && what.possible(mode, setup)
    });
    let names: Vec<String> = modes.map(|mode| format!("\"{}\"", mode.name())).collect();
    match names.as_slice() {
        [] => what.impossible(name, setup).1,
        [first, rest @ ..] => {
            let more = if rest.is_empty() {
                String::new()
            } else {
                format!(", or {}", rest.join(", "))
            };
            format!("let a step switch it before: `mode = {{ {name} = {first} }}`{more}")
        }
    }
}

#[cfg(test)]
#[path = "preconditions_tests.rs"]
mod tests;
