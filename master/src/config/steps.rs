//! The program: axes and signals by name, targets within limits.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use ecaxis_ecat::index::{AxisIndex, DeviceIndex, IndexVec, LineShaftIndex};
use toml::Spanned;

mod cams;
mod condition;
mod endings;
mod follow;
mod gantries;
mod modes;
mod number;
mod overrides;
mod preconditions;
mod probe;
mod stop;
mod target;

use super::fields::{Key, KeyExt};
use super::gantry::CheckedGantry;
use super::line_shaft::ResolvedLineShaft;
use super::path::NamedPath;
use super::problem::{Problems, Span, suggestion};
use super::raw::{
    Levels, NamedValues, RawAction, RawAxes, RawNumber, RawOverride, RawProgram, RawSimulation,
    RawStep, RawStop, RawVariable, TimeLimit,
};
use super::roles::{InputUse, UsedInput};
use super::subprograms::MOST_STEPS;
use super::{
    Action, AxisSetup, DeviceConfig, NamedCam, NamedSignal, NumberPlace, OverrideConfig,
    ProgramInputs, Signal, Step, StopSetup, SwitchedInput, Variable, VariableUse,
};
use crate::rt::gantry::GantryConfig;
use ecaxis_axis::Mode;
use ecaxis_axis::setpoint::Table;
use target::TargetKind;

/// The default fraction of the limits for the move to the beginning of a table.
const GENTLE: f64 = 0.1;
const WHOLE_TORQUE_RAMP_NS: u64 = 100_000_000;
/// The default timeout for an input in ns.
const WAIT_NS: u64 = 10_000_000_000;

/// Returns `true` if the program itself enables axes.
pub(crate) fn enables(steps: &[Step]) -> bool {
    steps.iter().any(|step| match &step.action {
        Action::Enable { .. } => true,
        action => action
            .inner()
            .any(|step| enables(std::slice::from_ref(step))),
    })
}

/// What steps know about a device; `None`: it is invalid and has been reported.
#[derive(Clone, Copy)]
pub(crate) struct ResolvedDevice<'c> {
    pub name: &'c str,
    pub device: Option<&'c DeviceConfig>,
}

/// What steps know about an axis; `None`: it is invalid and has been reported.
#[derive(Clone, Copy)]
pub(crate) struct ResolvedAxis<'c> {
    pub name: &'c str,
    pub device: DeviceIndex,
    pub setup: Option<&'c AxisSetup>,
}

/// The devices and axes of the machine.
#[derive(Clone, Copy)]
pub(crate) struct Resolved<'c> {
    pub devices: &'c IndexVec<DeviceIndex, ResolvedDevice<'c>>,
    pub axes: &'c IndexVec<AxisIndex, ResolvedAxis<'c>>,
    /// The base of relative file names.
    pub folder: &'c Path,
    pub cycle_s: f64,
    pub gantries: &'c [CheckedGantry],
    pub cams: &'c [NamedCam],
    pub line_shafts: &'c IndexVec<LineShaftIndex, ResolvedLineShaft<'c>>,
    /// The paths, with indices into `tables`.
    pub paths: &'c [NamedPath],
    pub tables: &'c [Table],
}

/// The steps with their signals.
#[derive(Debug, Default)]
pub(crate) struct Program {
    pub stop: StopSetup,
    pub overrides: OverrideConfig,
    pub steps: Vec<Step>,
    pub inputs: Vec<Signal>,
    /// What the inputs decide, each with its place.
    pub used: Vec<UsedInput>,
    pub outputs: Vec<Signal>,
    /// For each output, the first place that sets it.
    pub output_places: Vec<Span>,
    pub tables: Vec<Table>,
    pub signals: Vec<NamedSignal>,
    pub variables: Vec<Variable>,
    pub buttons: ProgramInputs,
    pub switched: Vec<SwitchedInput>,
}

/// Checks the steps.
pub(crate) fn check(
    steps: Vec<RawStep>,
    (stop, overrides): (RawStop, RawOverride),
    (signals, variables, buttons, sim): (
        NamedValues<String>,
        NamedValues<RawVariable>,
        RawProgram,
        RawSimulation,
    ),
    known: Resolved<'_>,
    repeat: u32,
    p: &mut Problems<'_>,
) -> Program {
    let before = p.count();
    let mut checker = ProgramChecker {
        devices: known.devices,
        axes: known.axes,
        folder: known.folder,
        cycle_s: known.cycle_s,
        gantries: known.gantries.iter().map(|gantry| gantry.config).collect(),
        cams: known.cams,
        line_shafts: known.line_shafts,
        paths: known.paths,
        tables: known.tables.to_vec(),
        inputs: Vec::new(),
        used: Vec::new(),
        usage: InputUse::Condition,
        outputs: Vec::new(),
        output_places: Vec::new(),
        count: 0,
        switched: Vec::new(),
        number: String::new(),
        places: RefCell::default(),
        signals: Vec::new(),
        variables: Vec::new(),
        groups: (stop.groups.iter())
            .map(|group| (group.name.as_ref()).map_or_else(String::new, |n| n.get_ref().clone()))
            .collect(),
        uses: Vec::new(),
    };
    checker.name_signals(signals, p);
    checker.name_variables(variables, p);
    let mut steps = checker.all(steps, "", p);
    checker.join_halves(&mut steps, p);
    // After an invalid step, the state of the axes is unknown.
    if p.count() == before {
        checker.check_endings(&steps, &BTreeSet::new(), p);
    }
    if p.count() == before {
        checker.flow(&steps, repeat, p);
    }
    let mut button = |raw: Option<Spanned<_>>, usage| {
        checker.usage = usage;
        raw.and_then(|raw| checker.when(raw.get_ref(), p))
    };
    let buttons = ProgramInputs {
        pause: button(buttons.pause, InputUse::Pause),
        step: button(buttons.step, InputUse::Step),
    };
    let stop = checker.stop(&stop, p);
    checker.check_groups(&steps, &stop, p);
    checker.check_cams(&steps, &steps, p);
    let overrides = checker.overrides(&overrides, p);
    let switched = checker.switched_inputs(sim, p);
    Program {
        stop,
        overrides,
        steps,
        inputs: checker.inputs,
        used: checker.used,
        outputs: checker.outputs,
        output_places: checker.output_places,
        tables: checker.tables,
        signals: checker.signals,
        variables: checker.variables,
        buttons,
        switched,
    }
}

struct ProgramChecker<'c> {
    devices: &'c IndexVec<DeviceIndex, ResolvedDevice<'c>>,
    axes: &'c IndexVec<AxisIndex, ResolvedAxis<'c>>,
    folder: &'c Path,
    cycle_s: f64,
    gantries: Vec<GantryConfig>,
    cams: &'c [NamedCam],
    line_shafts: &'c IndexVec<LineShaftIndex, ResolvedLineShaft<'c>>,
    paths: &'c [NamedPath],
    tables: Vec<Table>,
    inputs: Vec<Signal>,
    /// What the inputs decide, and what those decide that are being checked.
    used: Vec<UsedInput>,
    usage: InputUse,
    outputs: Vec<Signal>,
    output_places: Vec<Span>,
    count: usize,
    /// The modes to which previous steps have switched.
    switched: Vec<(AxisIndex, Mode)>,
    /// The number of the step being checked.
    number: String,
    /// The places of steps, and of axes named in them.
    places: RefCell<BTreeMap<(String, Option<AxisIndex>), Span>>,
    /// The names of `[signals]`, and `[variables]`.
    signals: Vec<NamedSignal>,
    variables: Vec<Variable>,
    /// The names of `[[stop.group]]`.
    groups: Vec<String>,
    /// The variables of the step being checked.
    uses: Vec<VariableUse>,
}

impl ProgramChecker<'_> {
    fn all(&mut self, steps: Vec<RawStep>, prefix: &str, p: &mut Problems<'_>) -> Vec<Step> {
        let mut checked = Vec::with_capacity(steps.len());
        for (index, step) in steps.into_iter().enumerate() {
            let span = step.span.clone();
            self.count += 1;
            if self.count == MOST_STEPS + 1 {
                let message = format!("a program has {MOST_STEPS} steps at most");
                p.add_hint(span, message, "repeat steps with `repeat`");
                break;
            }
            let number = format!("{prefix}{}", index + 1);
            let line = p.line(&span);
            self.number.clone_from(&number);
            let place = (number.clone(), None);
            self.places.borrow_mut().insert(place, span.clone());
            if let Some(last) = checked
                .last()
                .filter(|step: &&Step| step.action.never_ends())
            {
                let message = format!(
                    "no run reaches this step: step {} in line {} does not end",
                    last.number, last.line
                );
                p.add_hint(
                    span,
                    message,
                    "remove it, or give the other step an end (`until`)",
                );
                break;
            }
            let outer = std::mem::take(&mut self.uses);
            let action = self.one(step, &number, p);
            let uses = std::mem::replace(&mut self.uses, outer);
            if let Some(action) = action {
                checked.push(Step {
                    number,
                    line,
                    action,
                    uses,
                });
            }
        }
        checked
    }

    /// Returns the fractions for the move to the first position of a table.
    fn gentle(
        &mut self,
        [speed, ramp]: [&Key<RawNumber>; 2],
        p: &mut Problems<'_>,
    ) -> Option<[f64; 2]> {
        let mut fraction = |value: &Key<RawNumber>, place| match value {
            Some(_) => self.fraction(value, place, p),
            None => Some(GENTLE),
        };
        let fractions = (
            fraction(speed, NumberPlace::Speed),
            fraction(ramp, NumberPlace::Ramp),
        );
        Some([fractions.0?, fractions.1?])
    }

    fn one(&mut self, raw: RawStep, number: &str, p: &mut Problems<'_>) -> Option<Action> {
        let RawStep {
            span,
            action,
            speed,
            ramp,
        } = raw;
        Some(match action {
            RawAction::Enable(axes) => Action::Enable {
                axes: self.steady_axes(axes, p)?,
            },
            RawAction::Disable(axes) => Action::Disable {
                axes: self.axes(axes, p)?,
            },
            RawAction::Reset(axes) => Action::Reset {
                axes: self.axes(axes, p)?,
            },
            RawAction::Home(axes) => self.home(axes, &span, p)?,
            RawAction::Couple { axes, coupled } => self.couple(axes, coupled, p)?,
            RawAction::Stop(axes) => Action::Stop {
                axes: self.steady_axes(axes, p)?,
            },
            RawAction::Move {
                relative,
                targets,
                together,
            } => {
                let at = ramp.place();
                let (speed, ramp) = (
                    self.fraction(&speed, NumberPlace::Speed, p),
                    self.fraction(&ramp, NumberPlace::Ramp, p),
                );
                let targets = self.targets(targets, TargetKind::of_move(relative), p)?;
                let (speed, ramp) = (speed?, ramp?);
                self.check_ramp_time(&targets, ramp, at, p, |_, limit| limit * speed);
                Action::Move {
                    relative,
                    targets,
                    speed,
                    ramp,
                    together,
                }
            }
            RawAction::Probe(axis, probe) => {
                let pace = (
                    self.fraction(&speed, NumberPlace::Speed, p),
                    self.fraction(&ramp, NumberPlace::Ramp, p),
                );
                self.probe(&axis, &probe, pace, p)?
            }
            RawAction::Line { relative, targets } => {
                let (speed, ramp) = (
                    self.fraction(&speed, NumberPlace::Speed, p),
                    self.fraction(&ramp, NumberPlace::Ramp, p),
                );
                Action::Line {
                    relative,
                    targets: self.targets(targets, TargetKind::of_move(relative), p)?,
                    speed: speed?,
                    ramp: ramp?,
                }
            }
            RawAction::Wave { square, axis, wave } => self.wave(square, &axis, &wave, p)?,
            RawAction::Table(files) => {
                let pace = self.gentle([&speed, &ramp], p)?;
                self.table(&files, pace, p)?
            }
            RawAction::Path(name) => {
                let pace = self.gentle([&speed, &ramp], p)?;
                self.path(&name, pace, p)?
            }
            RawAction::Gear(axis, gear) => self.gear(&axis, &gear, p)?,
            RawAction::Phase(targets) => Action::Phase {
                targets: self.targets(targets, TargetKind::Way, p)?,
            },
            RawAction::Superimpose(targets) => Action::Superimpose {
                targets: self.targets(targets, TargetKind::Shift, p)?,
            },
            RawAction::Velocity(targets) => {
                let at = ramp.place();
                let ramp = self.fraction(&ramp, NumberPlace::Ramp, p);
                let targets = self.targets(targets, TargetKind::Velocity, p)?;
                self.check_ramp_time(&targets, ramp?, at, p, |target, _| target.abs());
                Action::Velocity {
                    targets,
                    ramp: ramp?,
                }
            }
            RawAction::Torque { targets, ramp } => Action::Torque {
                targets: self.targets(targets, TargetKind::Torque, p)?,
                ramp_ns: ramp.unwrap_or(WHOLE_TORQUE_RAMP_NS),
            },
            RawAction::Mode(named) => {
                let count = named.len();
                let mut targets: Vec<(AxisIndex, Mode)> = named
                    .into_iter()
                    .filter_map(|(name, mode)| self.mode(&name, &mode, p))
                    .collect();
                targets.sort_by_key(|(index, _)| *index);
                (count > 0 && targets.len() == count).then_some(Action::Mode { targets })?
            }
            RawAction::Dwell(time) => Action::Dwell {
                ns: self.time(&time, p)?,
            },
            RawAction::Wait { when, timeout } => {
                let TimeLimit(timeout_ns) = timeout.unwrap_or(TimeLimit(Some(WAIT_NS)));
                Action::Wait {
                    when: self.when(&when, p)?,
                    timeout_ns,
                }
            }
            RawAction::Set(Levels(values)) => {
                let count = values.len();
                let values: Vec<_> = values
                    .into_iter()
                    .enumerate()
                    .filter_map(|(at, (signal, value))| self.output(at, &signal, &value, p))
                    .collect();
                (count > 0 && values.len() == count).then_some(Action::Set { values })?
            }
            RawAction::Override(values) => self.override_step(values, p)?,
            RawAction::Assign { add, values } => Action::Assign {
                add,
                values: self.assignments(add, values, p)?,
            },
            RawAction::Message(text) => Action::Message { text },
            RawAction::Alarm(text) => Action::Alarm { text },
            RawAction::Repeat {
                times,
                until,
                steps,
            } => {
                let until = until.map(|until| self.when(&until, p));
                let steps = self.all(steps, &format!("{number}."), p);
                Action::Repeat {
                    times,
                    until: until.map_or(Some(None), |until| until.map(Some))?,
                    steps,
                }
            }
            RawAction::While { when, steps } => {
                let when = self.when(&when, p);
                let steps = self.all(steps, &format!("{number}."), p);
                Action::While { when: when?, steps }
            }
            RawAction::If {
                when,
                steps,
                otherwise,
            } => {
                let when = self.when(&when, p);
                let steps = self.all(steps, &format!("{number}."), p);
                let otherwise = self.all(otherwise, &format!("{number}.else."), p);
                Action::If {
                    when: when?,
                    steps,
                    otherwise,
                }
            }
            RawAction::Call { name, steps } => Action::Call {
                name,
                steps: self.all(steps, &format!("{number}."), p),
            },
            RawAction::Parallel(branches) => {
                let branches = ('a'..).zip(branches);
                Action::Parallel {
                    branches: branches
                        .map(|(letter, steps)| self.all(steps, &format!("{number}.{letter}."), p))
                        .collect(),
                }
            }
        })
    }

    /// Returns `true` if `so` holds in any mode that the axis has in the program.
    fn any_mode(&self, index: AxisIndex, so: impl Fn(Mode) -> bool) -> bool {
        let own = self.axes[index].setup.map(|axis| axis.config.mode);
        let switched = self.switched.iter().filter(|(axis, _)| *axis == index);
        switched.map(|(_, mode)| *mode).chain(own).any(so)
    }

    /// Returns the named axes of the machine; `None`: all whose device is not optional.
    fn steady_axes(&self, names: RawAxes, p: &mut Problems<'_>) -> Option<Vec<AxisIndex>> {
        let all = names.is_none();
        let mut axes = self.axes(names, p)?;
        let is_optional = |axis: &AxisIndex| {
            let device = self.devices[self.axes[*axis].device].device;
            device.is_some_and(|device| device.optional)
        };
        axes.retain(|axis| !(all && is_optional(axis)));
        Some(axes)
    }

    /// Returns the named axes of the machine; `None`: all.
    fn axes(&self, names: RawAxes, p: &mut Problems<'_>) -> Option<Vec<AxisIndex>> {
        let Some(names) = names else {
            let axes = self
                .axes
                .enumerate()
                .filter(|(_, axis)| axis.setup.is_some());
            return Some(axes.map(|(index, _)| index).collect());
        };
        let count = names.len();
        let axes: Vec<_> = names
            .iter()
            .filter_map(|name| self.axis(name, p).map(|(index, _)| index))
            .collect();
        (axes.len() == count).then_some(axes)
    }

    fn device(&self, name: &Spanned<String>) -> Option<DeviceIndex> {
        let mut all = self.devices.enumerate();
        all.find_map(|(index, device)| (device.name == name.get_ref()).then_some(index))
    }

    fn axis(
        &self,
        name: &Spanned<String>,
        p: &mut Problems<'_>,
    ) -> Option<(AxisIndex, &AxisSetup)> {
        let Some(index) = self.axis_named(name) else {
            let (message, hint) = self.no_axis(name.get_ref());
            p.add_hint(name.span(), message, hint);
            return None;
        };
        let place = (self.number.clone(), Some(index));
        self.places.borrow_mut().insert(place, name.span());
        Some((index, self.axes[index].setup?))
    }

    fn axis_named(&self, name: &Spanned<String>) -> Option<AxisIndex> {
        let mut all = self.axes.enumerate();
        all.find_map(|(index, axis)| (axis.name == name.get_ref()).then_some(index))
    }

    /// Returns why a name is not that of an axis.
    fn no_axis(&self, name: &str) -> (String, String) {
        let device = self.devices.enumerate().find(|(_, d)| d.name == name);
        let Some((device, _)) = device else {
            let hint = suggestion(name, self.axes.iter().map(|axis| axis.name), "axes");
            return (format!("no device is named `{name}`"), hint);
        };
        let own = self.axes.iter().filter(|axis| axis.device == device);
        let own: Vec<_> = own.map(|axis| format!("`{}`", axis.name)).collect();
        if own.is_empty() {
            let hint = "give it a [device.axis], or leave it out here";
            return (format!("`{name}` has no axis to move"), hint.to_owned());
        }
        let message = format!("`{name}` has several axes");
        (message, format!("name one of them: {}", own.join(", ")))
    }
}
