//! The steps of the machine file, one after the other.
//!
//! | file | |
//! |---|---|
//! | here | the order of steps and their execution |
//! | `enable` | power for axes |
//! | `moves` | axes to their own targets, in all modes |
//! | `pause` | no step begins until the user continues |
//! | `probe` | a move that ends at an edge |
//! | `turn` | branches that run at the same time |
//! | `waits` | waiting for a condition |

use std::fmt::Display;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;

use ecaxis_axis::setpoint::{GearConfig, GearInMode};
use ecaxis_axis::units::UserUnits;
use ecaxis_axis::{AxisStatus, Command, CommandError};
use ecaxis_ecat::index::{AxisIndex, GroupIndex, IndexVec};
use tokio::sync::Mutex;

use super::groups::needed;
use super::{CommonStart, ProgramOutcome, Supervisor};
use crate::clock::{self, Nanos};
use crate::config::{Action, AxisSetup, LARGEST, Step, VariableRef};
use crate::report::{Cause, Error, Progress, StepRef};
use crate::rt::channel::{RtCommand, Snapshot};
use crate::rt::setpoint_generator::CamRef;

mod enable;
mod moves;
mod pause;
mod probe;
mod turn;
mod waits;

pub(crate) use pause::Buttons;
pub use pause::ProgramControl;
use probe::ProbeMove;
pub(super) use turn::Turn;

/// The timeout in ns for an axis to follow after its set-point has arrived.
const SETTLE_TIMEOUT: Nanos = 5_000_000_000;
/// The time in ns at standstill velocity after which an axis is at rest. A loop that overshoots stands
/// for tens of ms before it creeps back.
const STANDSTILL_TIME: Nanos = 100_000_000;

/// The quantity that a step's target sets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TargetKind {
    Position,
    Velocity,
    Torque,
}

/// The time since the set-points arrived.
#[derive(Debug, Default)]
pub(super) struct Settling(Option<Nanos>);

impl Settling {
    /// Returns `true` after the settle timeout; the first call starts the time.
    pub(super) fn time_limit_reached(&mut self) -> bool {
        let since = *self.0.get_or_insert_with(clock::now);
        clock::now().saturating_sub(since) > SETTLE_TIMEOUT
    }
}

/// The time for which an axis in a profile of its drive has come no closer to its target.
#[derive(Debug, Default)]
pub(super) struct Stall(Option<(AxisIndex, f64, Nanos)>);

impl Stall {
    /// Returns `true` after the settle timeout without progress by at least `least`.
    pub(super) fn time_limit_reached(
        &mut self,
        axis: AxisIndex,
        progress: f64,
        least: f64,
    ) -> bool {
        let now = clock::now();
        match self.0 {
            Some((of, best, since)) if of == axis && progress < best + least => {
                now.saturating_sub(since) > SETTLE_TIMEOUT
            }
            _ => {
                self.0 = Some((axis, progress, now));
                false
            }
        }
    }
}

impl From<&Step> for StepRef {
    fn from(step: &Step) -> Self {
        Self {
            number: step.number.clone(),
            line: step.line,
        }
    }
}

impl Supervisor {
    /// Runs the steps, the first one at an instant if one is given.
    pub(super) async fn run_program(
        &mut self,
        at: Option<CommonStart>,
        ended: &mut ProgramOutcome,
    ) -> Result<(), Error> {
        let shared = Mutex::new(self);
        let mut turn = Turn::take(&shared).await;
        if let Some(at) = at {
            turn.await_start(at).await?;
        }
        turn.run_program(ended).await
    }

    pub(super) async fn enable_axes(
        &mut self,
        step: Option<&Step>,
        axes: &[AxisIndex],
    ) -> Result<(), Error> {
        let shared = Mutex::new(self);
        let mut turn = Turn::take(&shared).await;
        turn.enable_axes(step, axes).await
    }

    /// Enables every axis and hands control to the controller until it has finished.
    pub(super) async fn follow_controller(
        &mut self,
        ended: &mut ProgramOutcome,
    ) -> Result<(), Error> {
        let start = clock::now();
        let steady = self.steady_axes();
        self.enable_axes(None, &steady).await?;
        while !self.over(start) {
            if self.poll_and_query().await?.finished {
                ended.runs += 1;
                break;
            }
        }
        Ok(())
    }

    pub(super) fn over(&self, start: Nanos) -> bool {
        self.limit
            .is_some_and(|limit| clock::now().saturating_sub(start) >= limit)
    }

    /// Waits until the time limit. The user can stop the run earlier.
    pub(super) async fn hold(&mut self, start: Nanos) -> Result<(), Error> {
        while !self.over(start) {
            self.poll_and_query().await?;
        }
        Ok(())
    }

    pub(super) fn setup(&self, axis: AxisIndex) -> Option<&AxisSetup> {
        self.machine.axes.get(axis)
    }

    /// Sends all commands in the same cycle.
    pub(super) async fn command(&mut self, commands: impl Iterator<Item = (AxisIndex, Command)>) {
        let commands = commands.map(|(axis, command)| RtCommand::Axis { axis, command });
        self.send_all(&commands.collect::<Vec<_>>()).await;
    }
}

impl Turn<'_, '_> {
    async fn run_program(&mut self, ended: &mut ProgramOutcome) -> Result<(), Error> {
        let start = clock::now();
        let steps = self.machine.steps.clone();
        if steps.is_empty() {
            // Without a program the axes hold their position until the run is stopped.
            return self.hold(start).await;
        }
        loop {
            let begun = clock::now();
            self.variables = self.machine.variables.iter().map(|v| v.initial).collect();
            self.run_steps(&steps, ended.runs + 1, start).await?;
            if self.over(start) {
                return Ok(());
            }
            ended.runs += 1;
            if self.limit.is_none() && ended.runs >= self.repeat {
                return Ok(());
            }
            // A program that takes no time must not block the cycle in virtual time.
            if clock::now() == begun {
                self.poll_and_query().await?;
            }
        }
    }

    /// Returns the first refusal of one of these axes. The others belong to other branches.
    fn take_refusal(&mut self, axes: &[AxisIndex]) -> Option<(AxisIndex, CommandError)> {
        let at = self
            .refused
            .iter()
            .position(|(axis, _)| axes.contains(axis))?;
        self.refused.remove(at)
    }

    /// Runs steps; boxed because steps may contain steps.
    fn run_steps<'s>(
        &'s mut self,
        steps: &'s [Step],
        run: u32,
        start: Nanos,
    ) -> Pin<Box<dyn Future<Output = Result<(), Error>> + Send + 's>> {
        Box::pin(async move {
            for step in steps {
                if self.over(start) {
                    return Ok(());
                }
                self.await_program_step(step, start).await?;
                if self.run_branches(step, run, start).await? {
                    continue;
                }
                let machine = Arc::clone(&self.machine);
                let step = machine.filled(step, &self.variables);
                self.report(Progress::Program {
                    run,
                    step: step.as_ref().into(),
                    what: machine.describe(&step.action),
                });
                self.run_step(&step, run, start).await?;
            }
            Ok(())
        })
    }

    /// Runs the steps inside a step. Returns false if the step has none.
    async fn run_branches(&mut self, step: &Step, run: u32, start: Nanos) -> Result<bool, Error> {
        let (mut left, before, after, steps) = match &step.action {
            Action::Repeat {
                times,
                until,
                steps,
            } => (*times, None, until.as_ref(), steps),
            Action::While { when, steps } => (None, Some(when), None, steps),
            Action::If {
                when,
                steps,
                otherwise,
            } => {
                let steps = match self.holds(when).await? {
                    true => steps,
                    false => otherwise,
                };
                self.run_steps(steps, run, start).await?;
                return Ok(true);
            }
            Action::Call { steps, .. } => {
                self.run_steps(steps, run, start).await?;
                return Ok(true);
            }
            Action::Parallel { branches } => {
                self.run_parallel(branches, run, start).await?;
                return Ok(true);
            }
            _ => return Ok(false),
        };
        while left != Some(0) {
            if let Some(when) = before
                && !self.holds(when).await?
            {
                break;
            }
            let begun = clock::now();
            self.run_steps(steps, run, start).await?;
            if self.over(start) {
                break;
            }
            if clock::now() == begun {
                self.poll_and_query().await?;
            }
            if let Some(when) = after
                && self.holds(when).await?
            {
                break;
            }
            left = left.map(|left| left - 1);
        }
        Ok(true)
    }

    async fn run_step(&mut self, step: &Step, run: u32, start: Nanos) -> Result<(), Error> {
        self.ensure_not_stopped(Some(step), &needed(&step.action))?;
        match &step.action {
            Action::Enable { axes } => self.enable_axes(Some(step), axes).await,
            Action::Disable { axes } => {
                self.command(axes.iter().map(|&axis| (axis, Command::Disable)))
                    .await;
                // The state of an axis without process data is unknown.
                let groups = self.groups();
                let lost = |s: &Snapshot, axis: AxisIndex| {
                    let group = s.groups.get(groups[axis]);
                    group.is_some_and(|group| group.stopped.is_some() && !group.fresh)
                };
                let done = |s: &Snapshot, axis: AxisIndex| !s.axes[axis].enabled || lost(s, axis);
                self.until(step, start, done, axes).await
            }
            Action::Reset { axes } => {
                self.command(axes.iter().map(|&axis| (axis, Command::ResetFault)))
                    .await;
                let of = self.groups();
                let machine = Arc::clone(&self.machine);
                // A stopped group first comes to rest, then returns, unless faults of its other
                // axes prevent this.
                let coming = |s: &Snapshot, group: GroupIndex| {
                    let sound = |axis: &AxisStatus| axis.fault.is_none() && axis.trip.is_none();
                    let mut own = s.axes.iter().zip(&of).filter(|(_, of)| **of == group);
                    let state = &s.groups[group];
                    let kept = !state.powered && !own.all(|(axis, _)| sound(axis));
                    // An optional device is waited for.
                    let there = state.fresh || machine.is_optional(group);
                    state.stopped.is_some() && there && !kept
                };
                let done = |s: &Snapshot, axis: AxisIndex| {
                    let group = of[axis];
                    !s.axes[axis].resetting && !coming(s, group)
                };
                self.until(step, start, done, axes).await
            }
            Action::Home { axes } => self.home(step, start, axes).await,
            Action::Stop { axes } => {
                self.command(axes.iter().map(|&axis| (axis, Command::Stop)))
                    .await;
                self.until(step, start, |s, axis| !s.axes[axis].moving, axes)
                    .await
            }
            Action::Move {
                relative,
                targets,
                speed,
                ramp,
                together,
            } => {
                let part = [*speed, *ramp];
                if *together {
                    self.together(step, start, *relative, targets, part).await
                } else {
                    self.move_each(step, start, *relative, targets, part).await
                }
            }
            Action::Probe {
                axis,
                probe,
                edge,
                relative,
                target,
                speed,
                ramp,
            } => {
                let search = ProbeMove {
                    axis: *axis,
                    probe: *probe,
                    edge: *edge,
                    relative: *relative,
                    target: *target,
                    speed: *speed,
                    ramp: *ramp,
                };
                self.probe(step, start, run, search).await
            }
            Action::Line {
                relative,
                targets,
                speed,
                ramp,
            } => {
                self.line(step, start, *relative, targets, [*speed, *ramp])
                    .await
            }
            Action::Wave { axis, wave } => self.wave(step, start, *axis, *wave).await,
            Action::Table {
                tables,
                speed,
                ramp,
                ..
            } => self.play(step, start, tables, [*speed, *ramp]).await,
            Action::Gear {
                axis,
                master,
                ratio,
                offset,
                smoothing_ns,
                cam,
            } => {
                let cam = cam.map(|cam| CamRef { cam, scale: *ratio });
                let config = GearConfig {
                    ratio: if cam.is_some() { 1.0 } else { *ratio },
                    engage: offset.map_or(GearInMode::Here, |offset| GearInMode::At { offset }),
                    smoothing_s: *smoothing_ns as f64 * 1e-9,
                    limits: self.limits(*axis).motion(),
                    range: self.limits(*axis).position,
                };
                self.gear(step, start, *axis, (*master, cam), config).await
            }
            Action::Phase { targets } => self.shift(step, start, targets, false).await,
            Action::Superimpose { targets } => self.shift(step, start, targets, true).await,
            Action::Velocity { targets, ramp } => {
                self.move_and_wait(step, start, TargetKind::Velocity, targets, |velocity| {
                    Command::Velocity {
                        velocity,
                        ramp: *ramp,
                    }
                })
                .await
            }
            Action::Torque { targets, ramp_ns } => {
                self.move_and_wait(step, start, TargetKind::Torque, targets, |percent| {
                    Command::Torque {
                        percent,
                        ramp_s: *ramp_ns as f64 * 1e-9,
                    }
                })
                .await
            }
            Action::Mode { targets } => self.switch(step, start, targets).await,
            Action::Dwell { ns } => {
                let until = clock::now().saturating_add(*ns);
                while clock::now() < until && !self.over(start) {
                    self.poll_and_query().await?;
                }
                Ok(())
            }
            Action::Wait { when, timeout_ns } => self.wait(step, start, when, *timeout_ns).await,
            Action::Assign { add, values } => {
                for &(variable, value) in values {
                    self.assign(step, variable, value, *add)?;
                }
                Ok(())
            }
            Action::Override(values) => {
                let commands = values
                    .iter()
                    .map(|&(group, factor)| RtCommand::Override { group, factor });
                self.send_all(&commands.collect::<Vec<_>>()).await;
                self.taken(start).await
            }
            Action::Couple { axes, coupled } => {
                let gantries = self.machine.gantries.iter().enumerate();
                let named = gantries.filter(|(_, gantry)| axes.contains(&gantry.axes[0]));
                let commands = named.map(|(gantry, _)| RtCommand::Couple {
                    gantry,
                    coupled: *coupled,
                });
                let commands: Vec<_> = commands.collect();
                self.send_all(&commands).await;
                let done = |s: &Snapshot, axis: AxisIndex| s.axes[axis].ready || !coupled;
                self.until(step, start, done, axes).await
            }
            // The report of the step has the text.
            Action::Message { .. } => Ok(()),
            Action::Alarm { text } => {
                Err(Error::from(Cause::Alarm { text: text.clone() }).with_step(step))
            }
            Action::Set { values } => {
                self.ensure_unlocked(step, values).await?;
                let commands = values
                    .iter()
                    .map(|&(output, value)| RtCommand::Output { output, value });
                self.send_all(&commands.collect::<Vec<_>>()).await;
                self.taken(start).await
            }
            // `run_branches` runs them.
            Action::Repeat { .. }
            | Action::While { .. }
            | Action::If { .. }
            | Action::Call { .. }
            | Action::Parallel { .. } => Ok(()),
        }
    }

    /// Sets a variable, or adds to it. Fails if the value is out of its range.
    fn assign(
        &mut self,
        step: &Step,
        variable: VariableRef,
        value: f64,
        add: bool,
    ) -> Result<(), Error> {
        let machine = Arc::clone(&self.machine);
        let known = machine.variables.get(variable.0);
        let (Some(known), Some(number)) = (known, self.variables.get_mut(variable.0)) else {
            return Ok(());
        };
        let value = if add { *number + value } else { value };
        let [low, high] = known.range.unwrap_or([-LARGEST, LARGEST]);
        // Also a value that is not a number.
        if !(low..=high).contains(&value) {
            let name = known.name.clone();
            let cause = Cause::VariableRange {
                name,
                value,
                low,
                high,
            };
            return Err(Error::from(cause).with_step(step));
        }
        *number = value;
        Ok(())
    }

    /// Returns the group of each axis.
    fn groups(&self) -> IndexVec<AxisIndex, GroupIndex> {
        let axes = self.machine.axes.iter();
        axes.map(|axis| self.machine.group_of(axis.device))
            .collect()
    }

    /// Returns the position for a target; on a modulo axis the one that its direction leads to.
    pub(super) fn resolve_target(&self, axis: AxisIndex, from: f64, target: f64) -> f64 {
        let Some(setup) = self.setup(axis) else {
            return target;
        };
        let scale = &setup.config.scale;
        let to = UserUnits(target);
        scale.destination(UserUnits(from), to, setup.way).0
    }

    /// Waits until the cycle has taken every command.
    async fn taken(&mut self, start: Nanos) -> Result<(), Error> {
        // Other branches may send on.
        let sent = self.commands_sent;
        while self.poll_and_query().await?.commands_taken < sent && !self.over(start) {}
        Ok(())
    }

    /// Calls `look` with every snapshot after the cycle has taken all commands. Returns when `look`
    /// is done or the program's time limit is over.
    pub(super) async fn wait_until(
        &mut self,
        step: &Step,
        start: Nanos,
        mut look: impl FnMut(&Self, &Snapshot) -> Result<bool, Error>,
    ) -> Result<(), Error> {
        let needed = needed(&step.action);
        // Other branches may send on.
        let sent = self.commands_sent;
        loop {
            let snapshot = self.poll_and_query().await?;
            self.ensure_not_stopped(Some(step), &needed)?;
            if self.over(start) {
                // The shutdown stops the axes from any state.
                return Ok(());
            }
            // Until then the status belongs to the previous step.
            if snapshot.commands_taken < sent {
                continue;
            }
            if let Some((axis, reason)) = self.take_refusal(&step.action.commanded()) {
                return Err(Cause::Refused {
                    reason: reason.to_string(),
                    by_axis: Some(Box::new(reason)),
                }
                .with_device(self.device_of(axis))
                .with_step(step));
            }
            if look(self, &snapshot)? {
                return Ok(());
            }
        }
    }

    pub(super) fn refusal(&self, step: &Step, axis: AxisIndex, reason: &dyn Display) -> Error {
        Cause::Refused {
            reason: reason.to_string(),
            by_axis: None,
        }
        .with_device(self.device_of(axis))
        .with_step(step)
    }
}
