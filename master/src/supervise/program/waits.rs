//! Steps that wait for a condition: states, homing, inputs.

use ecaxis_axis::HomingError;
use ecaxis_axis::status::HomingStatus;
use ecaxis_axis::{AxisStatus, Command, CommandError, EnableBlocker, Mode};
use ecaxis_ecat::index::{AxisIndex, GroupIndex};

use super::super::Supervisor;
use super::{SETTLE_TIMEOUT, STANDSTILL_TIME, Turn};
use crate::clock::{self, Nanos};
use crate::config::{Action, Step, Subject, When};
use crate::report::{Cause, Error};
use crate::rt::channel::Snapshot;
use crate::rt::overrides::Override;

impl Turn<'_, '_> {
    /// Waits until `holds` is true for every axis. Fails after the enable timeout or the longest
    /// stop.
    pub(super) async fn until(
        &mut self,
        step: &Step,
        start: Nanos,
        holds: impl Fn(&Snapshot, AxisIndex) -> bool,
        axes: &[AxisIndex],
    ) -> Result<(), Error> {
        let mut begun = clock::now();
        let timeout = self.machine.bus.enable_timeout_ns.max(self.longest_stop());
        self.wait_until(step, start, |this, snapshot| {
            let Some(&axis) = axes.iter().find(|&&axis| !holds(snapshot, axis)) else {
                return Ok(true);
            };
            if snapshot.axes[axis].waiting == Some(EnableBlocker::Held) {
                begun = clock::now();
            }
            if let Some(mode) = snapshot.axes[axis].switch_failed
                && matches!(step.action, Action::Mode { .. })
            {
                return Err(Cause::NotSwitched { mode }
                    .with_device(this.device_of(axis))
                    .with_step(step));
            }
            if clock::now().saturating_sub(begun) > timeout {
                return Err(Cause::StepTimeout {
                    what: this.machine.describe(&step.action),
                    state: snapshot.axes[axis].state,
                    timeout_ms: timeout / 1_000_000,
                }
                .with_device(this.device_of(axis))
                .with_step(step));
            }
            Ok(false)
        })
        .await
    }

    /// Waits until axes whose set-point rests are at rest. Some commands require standstill. An
    /// axis that oscillates is also slow at each turning point, so it must stay slow.
    pub(in crate::supervise) async fn settle(
        &mut self,
        axes: &[AxisIndex],
        start: Nanos,
    ) -> Result<(), Error> {
        let begun = clock::now();
        let mut moved = begun;
        loop {
            let snapshot = self.poll_and_query().await?;
            let status = axes.iter().filter_map(|&axis| snapshot.axes.get(axis));
            // At constant velocity an axis has arrived but never rests. In other modes the velocity
            // is the reported one.
            let led = |s: &AxisStatus| matches!(s.mode, Mode::Csp | Mode::Csv | Mode::Pv);
            let turns = |s: &AxisStatus| led(s) && s.target_velocity != 0.0;
            let rests = |s: &&AxisStatus| s.enabled && !s.moving && !turns(s);
            let settling: Vec<_> = status.filter(rests).collect();
            let now = clock::now();
            if settling.iter().any(|status| !status.at_rest) {
                moved = now;
            }
            let stand = settling.is_empty() || now.saturating_sub(moved) >= STANDSTILL_TIME;
            if stand || self.over(start) || now.saturating_sub(begun) > SETTLE_TIMEOUT {
                return Ok(());
            }
        }
    }

    /// Gives commands that need standstill, and repeats those that are refused for a motion: the
    /// velocity that a drive reports at rest may be higher for a cycle.
    pub(super) async fn command_at_rest(
        &mut self,
        step: &Step,
        start: Nanos,
        commands: &[(AxisIndex, Command)],
    ) -> Result<(), Error> {
        let axes: Vec<_> = commands.iter().map(|&(axis, _)| axis).collect();
        self.settle(&axes, start).await?;
        let begun = clock::now();
        self.command(commands.iter().copied()).await;
        let mut sent = self.commands_sent;
        loop {
            let snapshot = self.poll_and_query().await?;
            self.ensure_not_stopped(Some(step), &axes)?;
            if self.over(start) || clock::now().saturating_sub(begun) > SETTLE_TIMEOUT {
                return Ok(());
            }
            if snapshot.commands_taken < sent {
                continue;
            }
            let moves = |(axis, reason): &(AxisIndex, CommandError)| {
                axes.contains(axis) && matches!(reason, CommandError::StillMoving { .. })
            };
            let Some(at) = self.refused.iter().position(moves) else {
                return Ok(());
            };
            let refused = self.refused.remove(at).map(|(axis, _)| axis);
            let again = commands.iter().copied();
            self.command(again.filter(|&(axis, _)| Some(axis) == refused))
                .await;
            sent = self.commands_sent;
        }
    }

    /// Waits until none of these axes is held.
    async fn await_release(&mut self, axes: &[AxisIndex], start: Nanos) -> Result<(), Error> {
        loop {
            let snapshot = self.poll_and_query().await?;
            let held = axes.iter().any(|&axis| self.is_held(&snapshot, axis));
            if !held || self.over(start) {
                return Ok(());
            }
        }
    }

    /// Homes all axes. A hold interrupts the search for home; it begins again afterwards.
    pub(super) async fn home(
        &mut self,
        step: &Step,
        start: Nanos,
        axes: &[AxisIndex],
    ) -> Result<(), Error> {
        let mut axes = axes.to_vec();
        loop {
            self.await_release(&axes, start).await?;
            match self.search_home(step, start, &axes).await {
                Ok(()) => {}
                Err(error) if was_held(&error) => {}
                Err(error) => return Err(error),
            }
            let mut snapshot = self.poll_and_query().await?;
            let runs = |snapshot: &Snapshot, axis: &AxisIndex| {
                snapshot.axes[*axis].homing == HomingStatus::Running
            };
            while axes.iter().any(|axis| runs(&snapshot, axis)) {
                snapshot = self.poll_and_query().await?;
            }
            axes.retain(|&axis| snapshot.axes[axis].homing != HomingStatus::Attained);
            if axes.is_empty() || self.over(start) {
                return Ok(());
            }
        }
    }

    /// Homes all axes at the same time, until they are homed or a hold has stopped one of them. Each
    /// axis supervises its own timeout.
    async fn search_home(
        &mut self,
        step: &Step,
        start: Nanos,
        axes: &[AxisIndex],
    ) -> Result<(), Error> {
        let timeout = |axis: &AxisIndex| {
            let homing = self.machine.axes[*axis].homing.as_ref();
            homing.map_or(0, |homing| homing.timeout_ns) as f64 * 1e-9
        };
        let timeouts: Vec<f64> = axes.iter().map(timeout).collect();
        let commands = axes.iter().zip(&timeouts);
        let commands = commands.map(|(&axis, &timeout_s)| (axis, Command::Home { timeout_s }));
        self.command_at_rest(step, start, &commands.collect::<Vec<_>>())
            .await?;
        self.wait_until(step, start, |this, snapshot| {
            let (mut homed, mut held) = (true, false);
            for &axis in axes {
                let status = &snapshot.axes[axis];
                let powerless = status.switching.is_none() && !status.powered;
                let found = match status.homing {
                    // Nothing gives the axis power for the motions of its mode any more.
                    HomingStatus::Attained if powerless => {
                        HomingStatus::Failed(HomingError::PowerLost)
                    }
                    found => found,
                };
                homed &= match found {
                    HomingStatus::Failed(HomingError::Held) => {
                        held = true;
                        continue;
                    }
                    HomingStatus::Failed(error) => {
                        // The first half shows the failure of the second.
                        let other = this.machine.other_half(axis).filter(|&other| {
                            let homing = snapshot.axes[other].homing;
                            homing == status.homing && error != HomingError::Aborted
                        });
                        let axis = other.unwrap_or(axis);
                        return Err(Cause::NotHomed {
                            method: this.homing_method(axis),
                            error,
                        }
                        .with_device(this.device_of(axis))
                        .with_step(step));
                    }
                    HomingStatus::Attained => status.switching.is_none() && status.ready,
                    HomingStatus::None | HomingStatus::Running => false,
                };
            }
            Ok(homed || held)
        })
        .await
    }

    fn homing_method(&self, axis: AxisIndex) -> i8 {
        let setup = self.setup(axis).and_then(|setup| setup.homing.as_ref());
        setup.map_or(0, |setup| setup.homing.method)
    }

    /// Returns whether a condition holds in the next cycle.
    pub(super) async fn holds(&mut self, when: &When) -> Result<bool, Error> {
        let snapshot = self.poll_and_query().await?;
        Ok(when.holds(|subject| self.value(&snapshot, subject)))
    }

    /// Waits until a condition holds.
    pub(super) async fn wait(
        &mut self,
        step: &Step,
        start: Nanos,
        when: &When,
        timeout: Option<Nanos>,
    ) -> Result<(), Error> {
        let begun = clock::now();
        loop {
            let snapshot = self.poll_and_query().await?;
            let value = |subject| self.value(&snapshot, subject);
            if when.holds(value) || self.over(start) {
                return Ok(());
            }
            let Some(timeout) = timeout else { continue };
            if clock::now().saturating_sub(begun) > timeout {
                let tests = || when.0.iter().flatten();
                let open = tests().find(|test| !test.holds(value));
                let (condition, value) = match (open, tests().count()) {
                    (Some(open), _) if when.0.len() == 1 => {
                        (self.machine.test(open), value(open.of))
                    }
                    _ => (self.machine.when(when), f64::NAN),
                };
                let cause = Cause::WaitTimeout {
                    condition,
                    value,
                    timeout_ms: timeout / 1_000_000,
                };
                return Err(Error::from(cause).with_step(step));
            }
        }
    }
}

/// True if the cause of an error is the hold of an axis.
fn was_held(error: &Error) -> bool {
    let Cause::Refused { by_axis, .. } = &*error.cause else {
        return false;
    };
    by_axis.as_deref() == Some(&CommandError::Held)
}

impl Supervisor {
    /// Returns true if an axis is held.
    pub(super) fn is_held(&self, snapshot: &Snapshot, axis: AxisIndex) -> bool {
        let of = |group: GroupIndex| snapshot.groups.get(group).map(|group| group.rate);
        let machine = of(GroupIndex::MACHINE).unwrap_or_default();
        let own = match self.group_of(axis) {
            GroupIndex::MACHINE => Override::default(),
            group => of(group).unwrap_or_default(),
        };
        machine.rate(own).is_held()
    }

    /// Returns the value of a subject. An unknown value satisfies no condition.
    pub(super) fn value(&self, snapshot: &Snapshot, subject: Subject) -> f64 {
        let value = match subject {
            Subject::Input(input) => snapshot.inputs.get(input.0).copied(),
            Subject::Variable(variable) => self.variables.get(variable.0).copied(),
            Subject::Axis(axis, value) => {
                let (status, setup) = (snapshot.axes.get(axis), self.setup(axis));
                status
                    .zip(setup)
                    .map(|(status, setup)| value.of(status, setup))
            }
        };
        value.unwrap_or(f64::NAN)
    }
}
