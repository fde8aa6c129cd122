//! The steps of the machine file, one after the other.

use ecaxis_axis::{AxisStatus, Command};

use super::{Ended, Supervisor};
use crate::clock::{self, Nanos};
use crate::config::Step;
use crate::rt::handover::Order;
use crate::session::{Progress, RunError};

/// How long an axis may take to follow once its set-point has arrived.
const SETTLE_TIMEOUT: Nanos = 5_000_000_000;

impl Supervisor {
    pub(super) async fn run_program(&mut self, ended: &mut Ended) -> Result<(), RunError> {
        let start = clock::now();
        let steps = self.machine.steps.clone();
        if steps.is_empty() {
            // Without a program the axes hold their position until somebody ends it.
            return self.hold(start).await;
        }
        loop {
            for (index, step) in steps.iter().enumerate() {
                if self.over(start) {
                    return Ok(());
                }
                self.tell(Progress::Program {
                    run: ended.runs + 1,
                    step: index + 1,
                    of: steps.len(),
                });
                self.run_step(index, step, start).await?;
            }
            if self.over(start) {
                return Ok(());
            }
            ended.runs += 1;
            if self.limit.is_none() && ended.runs >= self.repeat {
                return Ok(());
            }
        }
    }

    fn over(&self, start: Nanos) -> bool {
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

    async fn run_step(&mut self, index: usize, step: &Step, start: Nanos) -> Result<(), RunError> {
        let command: &dyn Fn(f64) -> Command = match step {
            Step::Move { speed, ramp, .. } => &|position| Command::MoveTo {
                position,
                speed: *speed,
                ramp: *ramp,
            },
            Step::Velocity { ramp, .. } => &|velocity| Command::Velocity {
                velocity,
                ramp: *ramp,
            },
            Step::Torque { ramp_ns, .. } => &|percent| Command::Torque {
                percent,
                ramp_s: *ramp_ns as f64 * 1e-9,
            },
            Step::Dwell { ns } => {
                let until = clock::now() + ns;
                while clock::now() < until && !self.over(start) {
                    self.tick().await?;
                }
                return Ok(());
            }
        };
        let (Step::Move { targets, .. }
        | Step::Velocity { targets, .. }
        | Step::Torque { targets, .. }) = step
        else {
            return Ok(());
        };
        let mut waiting = Vec::with_capacity(targets.len());
        for &(device, target) in targets {
            let Some(axis) = self.axes.iter().position(|&d| d == device) else {
                continue;
            };
            self.order(Order::Axis {
                axis,
                command: command(target),
            })
            .await;
            waiting.push((axis, target));
        }
        self.await_targets(index, &waiting, start).await
    }

    /// Until every axis has arrived; an axis whose set-point has arrived but which does not follow
    /// fails the step.
    async fn await_targets(
        &mut self,
        step: usize,
        waiting: &[(usize, f64)],
        start: Nanos,
    ) -> Result<(), RunError> {
        // The orders are taken one a cycle; until then the status is that of the step before.
        let ordered = self.orders_given;
        let mut settling_since = None;
        loop {
            let snapshot = self.tick().await?;
            if self.over(start) {
                // Winding down brings the axes to rest from wherever they are.
                return Ok(());
            }
            if snapshot.orders_taken < ordered {
                continue;
            }
            let status = |axis: usize| snapshot.axes.get(axis).copied();
            if let Some((axis, reason)) = self.refused.take() {
                return Err(RunError::Refused {
                    device: self.device_of(axis),
                    step: step + 1,
                    reason: reason.to_string(),
                });
            }
            let late = waiting.iter().find_map(|&(axis, target)| {
                status(axis)
                    .filter(|s| !s.in_target)
                    .map(|s| (axis, target, s))
            });
            let Some((axis, target, last)) = late else {
                return Ok(());
            };
            if waiting
                .iter()
                .any(|&(axis, _)| status(axis).is_some_and(|s| s.moving))
            {
                settling_since = None;
                continue;
            }
            let since = *settling_since.get_or_insert_with(clock::now);
            if clock::now().saturating_sub(since) > SETTLE_TIMEOUT {
                return Err(RunError::NotReached {
                    device: self.device_of(axis),
                    step: step + 1,
                    target,
                    actual: reported(&last),
                });
            }
        }
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
