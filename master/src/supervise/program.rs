//! The steps of the machine file, one after the other.

use std::fmt::Display;
use std::future::Future;
use std::pin::Pin;

use ecaxis_axis::setpoint::{Engage, GearConfig};
use ecaxis_axis::status::HomingStatus;
use ecaxis_axis::units::UserUnits;
use ecaxis_axis::{AxisStatus, Command};

use super::{Ended, Supervisor};
use crate::clock::{self, Nanos};
use crate::config::{Action, AxisSetup, Condition, Step};
use crate::rt::feed::{FeedState, Start};
use crate::rt::handover::{Order, Snapshot};
use crate::session::{Progress, RunError, StepRef};

/// How long an axis may take to follow once its set-point has arrived.
pub(super) const SETTLE_TIMEOUT: Nanos = 5_000_000_000;

/// Whether the program itself says when axes are enabled.
pub(super) fn enables(steps: &[Step]) -> bool {
    steps.iter().any(|step| match &step.action {
        Action::Enable { .. } => true,
        Action::Repeat { steps, .. } => enables(steps),
        _ => false,
    })
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
    pub(super) async fn run_program(&mut self, ended: &mut Ended) -> Result<(), RunError> {
        let start = clock::now();
        let steps = self.machine.steps.clone();
        if steps.is_empty() {
            // Without a program the axes hold their position until somebody ends it.
            return self.hold(start).await;
        }
        loop {
            let begun = clock::now();
            self.run_steps(&steps, ended.runs + 1, start).await?;
            if self.over(start) {
                return Ok(());
            }
            ended.runs += 1;
            if self.limit.is_none() && ended.runs >= self.repeat {
                return Ok(());
            }
            // A program that takes no time must not keep the cycle from its turn.
            if clock::now() == begun {
                self.tick().await?;
            }
        }
    }

    /// Enables every axis and leaves them to the controller until it has finished.
    pub(super) async fn follow_controller(&mut self, ended: &mut Ended) -> Result<(), RunError> {
        let start = clock::now();
        let all: Vec<usize> = (0..self.axes.len()).collect();
        self.enable_axes(&all).await?;
        while !self.over(start) {
            if self.tick().await?.finished {
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

    /// Until the time limit ends it; the user can at any time.
    pub(super) async fn hold(&mut self, start: Nanos) -> Result<(), RunError> {
        while !self.over(start) {
            self.tick().await?;
        }
        Ok(())
    }

    /// Boxed, because steps may hold steps.
    fn run_steps<'s>(
        &'s mut self,
        steps: &'s [Step],
        run: u32,
        start: Nanos,
    ) -> Pin<Box<dyn Future<Output = Result<(), RunError>> + Send + 's>> {
        Box::pin(async move {
            for step in steps {
                if self.over(start) {
                    return Ok(());
                }
                if let Action::Repeat { times, steps } = &step.action {
                    for _ in 0..*times {
                        let begun = clock::now();
                        self.run_steps(steps, run, start).await?;
                        if self.over(start) {
                            return Ok(());
                        }
                        if clock::now() == begun {
                            self.tick().await?;
                        }
                    }
                    continue;
                }
                self.tell(Progress::Program {
                    run,
                    step: step.into(),
                    what: self.machine.describe(&step.action),
                });
                self.run_step(step, start).await?;
            }
            Ok(())
        })
    }

    async fn run_step(&mut self, step: &Step, start: Nanos) -> Result<(), RunError> {
        match &step.action {
            Action::Enable { axes } => {
                let axes = self.places(axes);
                self.enable_axes(&axes).await
            }
            Action::Disable { axes } => {
                let axes = self.places(axes);
                self.command(axes.iter().map(|&axis| (axis, Command::Disable)))
                    .await;
                self.until(step, start, |s, axis| !s.axes[axis].enabled, &axes)
                    .await
            }
            Action::Reset { axes } => {
                let axes = self.places(axes);
                self.command(axes.iter().map(|&axis| (axis, Command::ResetFault)))
                    .await;
                self.until(step, start, |s, axis| !s.axes[axis].resetting, &axes)
                    .await
            }
            Action::Home { axes } => self.home(step, start, axes).await,
            Action::Stop { axes } => {
                let axes = self.places(axes);
                self.command(axes.iter().map(|&axis| (axis, Command::Stop)))
                    .await;
                self.until(step, start, |s, axis| !s.axes[axis].moving, &axes)
                    .await
            }
            Action::Move {
                relative,
                targets,
                speed,
                ramp,
            } => {
                let turning = self
                    .targets(targets)
                    .iter()
                    .any(|&(axis, _)| self.modulo(axis));
                let origin = if *relative || turning {
                    self.tick().await?.axes
                } else {
                    Vec::new()
                };
                let targets: Vec<(usize, f64)> = self
                    .targets(targets)
                    .into_iter()
                    .map(|(axis, target)| {
                        let from = origin.get(axis).map_or(0.0, |s| s.target_position);
                        let target = match relative {
                            true => from + target,
                            false => self.place_to_go(axis, from, target),
                        };
                        (axis, target)
                    })
                    .collect();
                self.reach(step, start, &targets, |position| Command::MoveTo {
                    position,
                    speed: *speed,
                    ramp: *ramp,
                })
                .await
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
                axis,
                table,
                speed,
                ramp,
            } => {
                self.play(step, start, [*axis, *table], [*speed, *ramp])
                    .await
            }
            Action::Gear {
                axis,
                master,
                actual,
                ratio,
                offset,
                smoothing_ns,
            } => {
                let config = GearConfig {
                    ratio: *ratio,
                    engage: offset.map_or(Engage::Here, |offset| Engage::At { offset }),
                    smoothing_s: *smoothing_ns as f64 * 1e-9,
                    limits: self.limits(*axis).motion(),
                    range: self.limits(*axis).position,
                };
                let start_with = |places: &[usize]| match *places {
                    [axis, master] => Some((
                        axis,
                        Start::Gear {
                            master,
                            actual: *actual,
                            config,
                        },
                    )),
                    _ => None,
                };
                let feed = start_with(&self.places(&[*axis, *master]));
                let feeds: Vec<_> = feed.into_iter().collect();
                self.follow(step, start, &feeds, FeedState::Engaged).await
            }
            Action::Velocity { targets, ramp } => {
                let targets = self.targets(targets);
                self.reach(step, start, &targets, |velocity| Command::Velocity {
                    velocity,
                    ramp: *ramp,
                })
                .await
            }
            Action::Torque { targets, ramp_ns } => {
                let targets = self.targets(targets);
                self.reach(step, start, &targets, |percent| Command::Torque {
                    percent,
                    ramp_s: *ramp_ns as f64 * 1e-9,
                })
                .await
            }
            Action::Mode { targets } => {
                let axes = targets.iter().filter_map(|&(device, mode)| {
                    Some((self.axes.iter().position(|&d| d == device)?, mode))
                });
                let targets: Vec<_> = axes.collect();
                self.settle(
                    &targets.iter().map(|&(axis, _)| axis).collect::<Vec<_>>(),
                    start,
                )
                .await?;
                self.command(
                    targets
                        .iter()
                        .map(|&(axis, mode)| (axis, Command::SetMode(mode))),
                )
                .await;
                let axes: Vec<usize> = targets.iter().map(|&(axis, _)| axis).collect();
                let there = |s: &Snapshot, axis: usize| {
                    let mode = targets
                        .iter()
                        .find(|(a, _)| *a == axis)
                        .map(|(_, mode)| *mode);
                    let status = &s.axes[axis];
                    Some(status.mode) == mode && status.switching.is_none()
                };
                self.until(step, start, there, &axes).await
            }
            Action::Dwell { ns } => {
                let until = clock::now().saturating_add(*ns);
                while clock::now() < until && !self.over(start) {
                    self.tick().await?;
                }
                Ok(())
            }
            Action::Wait {
                conditions,
                timeout_ns,
            } => self.wait(step, start, conditions, *timeout_ns).await,
            Action::Set { values } => {
                let orders = values
                    .iter()
                    .map(|&(output, value)| Order::Output { output, value });
                self.orders(&orders.collect::<Vec<_>>()).await;
                self.taken(start).await
            }
            // `run_steps` unfolds them.
            Action::Repeat { .. } => Ok(()),
        }
    }

    /// Places in the cycle of axes given as devices.
    pub(super) fn places(&self, devices: &[usize]) -> Vec<usize> {
        let places = devices
            .iter()
            .filter_map(|device| self.axes.iter().position(|d| d == device));
        places.collect()
    }

    pub(super) fn targets(&self, targets: &[(usize, f64)]) -> Vec<(usize, f64)> {
        let places = targets.iter().filter_map(|&(device, target)| {
            Some((self.axes.iter().position(|&d| d == device)?, target))
        });
        places.collect()
    }

    fn setup(&self, axis: usize) -> Option<&AxisSetup> {
        let device = self.machine.devices.get(*self.axes.get(axis)?)?;
        device.axis.as_ref()
    }

    fn modulo(&self, axis: usize) -> bool {
        let setup = self.setup(axis);
        setup.is_some_and(|s| s.config.scale.modulo().is_some())
    }

    /// The position for a target; on a modulo axis the one that its way leads to.
    pub(super) fn place_to_go(&self, axis: usize, from: f64, target: f64) -> f64 {
        let Some(setup) = self.setup(axis) else {
            return target;
        };
        let scale = &setup.config.scale;
        let to = UserUnits(target);
        scale.destination(UserUnits(from), to, setup.way).0
    }

    /// All of them in the same cycle.
    async fn command(&mut self, commands: impl Iterator<Item = (usize, Command)>) {
        let orders = commands.map(|(axis, command)| Order::Axis { axis, command });
        self.orders(&orders.collect::<Vec<_>>()).await;
    }

    /// Until the cycle has taken every order.
    async fn taken(&mut self, start: Nanos) -> Result<(), RunError> {
        while self.tick().await?.orders_taken < self.orders_given && !self.over(start) {}
        Ok(())
    }

    /// Looks at every cycle from the one on that has taken all orders, until `look` says that the step is done or the program's
    /// time limit is over.
    pub(super) async fn watch(
        &mut self,
        step: &Step,
        start: Nanos,
        mut look: impl FnMut(&Self, &Snapshot) -> Result<bool, RunError>,
    ) -> Result<(), RunError> {
        loop {
            let snapshot = self.tick().await?;
            if self.over(start) {
                // Winding down brings the axes to rest from wherever they are.
                return Ok(());
            }
            // Until then the status is that of the step before.
            if snapshot.orders_taken < self.orders_given {
                continue;
            }
            if let Some((axis, reason)) = self.refused.take() {
                return Err(RunError::Refused {
                    device: self.device_of(axis),
                    step: step.into(),
                    reason: reason.to_string(),
                    by_axis: Some(Box::new(reason)),
                });
            }
            if look(self, &snapshot)? {
                return Ok(());
            }
        }
    }

    pub(super) fn refusal(&self, step: &Step, axis: usize, reason: &dyn Display) -> RunError {
        RunError::Refused {
            device: self.device_of(axis),
            step: step.into(),
            reason: reason.to_string(),
            by_axis: None,
        }
    }

    /// Until something holds of every axis, or the time an axis may take to be enabled is over.
    async fn until(
        &mut self,
        step: &Step,
        start: Nanos,
        holds: impl Fn(&Snapshot, usize) -> bool,
        axes: &[usize],
    ) -> Result<(), RunError> {
        let begun = clock::now();
        let timeout = self.machine.bus.enable_timeout_ns.max(self.stop_patience);
        self.watch(step, start, |this, snapshot| {
            let Some(&axis) = axes.iter().find(|&&axis| !holds(snapshot, axis)) else {
                return Ok(true);
            };
            if let Some(mode) = snapshot.axes[axis].switch_failed
                && matches!(step.action, Action::Mode { .. })
            {
                return Err(RunError::NotSwitched {
                    device: this.device_of(axis),
                    step: step.into(),
                    mode,
                });
            }
            if clock::now().saturating_sub(begun) > timeout {
                return Err(RunError::StepTimeout {
                    device: this.device_of(axis),
                    step: step.into(),
                    what: this.machine.describe(&step.action),
                    state: snapshot.axes[axis].state,
                    timeout_ms: timeout / 1_000_000,
                });
            }
            Ok(false)
        })
        .await
    }

    /// Until axes whose set-point has come to rest have come to rest themselves; some orders are for standing axes only.
    pub(super) async fn settle(&mut self, axes: &[usize], start: Nanos) -> Result<(), RunError> {
        let begun = clock::now();
        loop {
            let snapshot = self.tick().await?;
            let settling = |&axis: &usize| {
                let status = &snapshot.axes[axis];
                status.enabled && !status.moving && !status.at_rest
            };
            let waited = clock::now().saturating_sub(begun);
            if !axes.iter().any(settling) || self.over(start) || waited > SETTLE_TIMEOUT {
                return Ok(());
            }
        }
    }

    /// Each by its own timeout, which the axis keeps.
    async fn home(&mut self, step: &Step, start: Nanos, devices: &[usize]) -> Result<(), RunError> {
        let timeout = |device: &usize| {
            let axis = self.machine.devices[*device].axis.as_ref();
            let ns = axis.and_then(|a| a.homing.as_ref()).map(|h| h.timeout_ns);
            ns.unwrap_or_default() as f64 * 1e-9
        };
        let timeouts: Vec<f64> = devices.iter().map(timeout).collect();
        let axes = self.places(devices);
        self.settle(&axes, start).await?;
        let commands = axes.iter().zip(&timeouts);
        self.command(commands.map(|(&axis, &timeout_s)| (axis, Command::Home { timeout_s })))
            .await;
        self.watch(step, start, |this, snapshot| {
            let mut homed = true;
            for &axis in &axes {
                let status = &snapshot.axes[axis];
                homed &= match status.homing {
                    HomingStatus::Failed(error) => {
                        return Err(RunError::NotHomed {
                            device: this.device_of(axis),
                            step: step.into(),
                            method: this.homing_method(axis),
                            error,
                        });
                    }
                    HomingStatus::Attained => status.switching.is_none() && status.ready,
                    HomingStatus::None | HomingStatus::Running => false,
                };
            }
            Ok(homed)
        })
        .await
    }

    fn homing_method(&self, axis: usize) -> i8 {
        let device = self
            .axes
            .get(axis)
            .and_then(|&d| self.machine.devices.get(d));
        let setup = device.and_then(|d| d.axis.as_ref()?.homing.as_ref());
        setup.map_or(0, |setup| setup.homing.method)
    }

    /// Until every condition holds in one and the same cycle.
    async fn wait(
        &mut self,
        step: &Step,
        start: Nanos,
        conditions: &[Condition],
        timeout: Nanos,
    ) -> Result<(), RunError> {
        let begun = clock::now();
        loop {
            let snapshot = self.tick().await?;
            let value = |input: usize| snapshot.inputs.get(input).copied().unwrap_or(f64::NAN);
            let open = conditions.iter().find(|c| !c.holds(value(c.input)));
            let Some(open) = open else { return Ok(()) };
            if self.over(start) {
                return Ok(());
            }
            if clock::now().saturating_sub(begun) > timeout {
                return Err(RunError::WaitTimeout {
                    step: step.into(),
                    condition: self.machine.condition(open),
                    value: value(open.input),
                    timeout_ms: timeout / 1_000_000,
                });
            }
        }
    }

    /// Orders every axis to its target and waits until all have arrived; an axis whose set-point has arrived but which
    /// does not follow fails the step.
    pub(super) async fn reach(
        &mut self,
        step: &Step,
        start: Nanos,
        targets: &[(usize, f64)],
        command: impl Fn(f64) -> Command,
    ) -> Result<(), RunError> {
        self.command(
            targets
                .iter()
                .map(|&(axis, target)| (axis, command(target))),
        )
        .await;
        let mut settling_since = None;
        self.watch(step, start, |this, snapshot| {
            let status = |axis: usize| &snapshot.axes[axis];
            let late = targets.iter().find(|(axis, _)| !status(*axis).in_target);
            let Some(&(axis, target)) = late else {
                return Ok(true);
            };
            let on_its_way = |axis: usize| status(axis).moving && !status(axis).held_by_range;
            if targets.iter().any(|&(axis, _)| on_its_way(axis)) {
                settling_since = None;
                return Ok(false);
            }
            let since = *settling_since.get_or_insert_with(clock::now);
            if clock::now().saturating_sub(since) > SETTLE_TIMEOUT {
                return Err(RunError::NotReached {
                    device: this.device_of(axis),
                    step: step.into(),
                    target,
                    actual: reported(status(axis)),
                });
            }
            Ok(false)
        })
        .await
    }
}

/// The reported value that a step's target is compared with.
fn reported(status: &AxisStatus) -> f64 {
    use ecaxis_axis::Mode;
    match status.mode {
        Mode::Csv | Mode::Pv => status.velocity,
        Mode::Cst => status.torque,
        _ => status.position,
    }
}
