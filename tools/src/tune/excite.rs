//! The controller that excites one axis and keeps what it commanded and saw.

use std::sync::mpsc::Sender;

use ecaxis_axis::{Command, CommandError};
use ecaxis_master::config::AxisRef;
use ecaxis_master::rt::controller::{Controller, CycleContext};

use super::TuneError;
use super::excitation::{Excitation, Quantity};

/// What was commanded and seen in one cycle, in units of the axis and in percent of rated torque.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Sample {
    /// The excitation.
    pub excitation: f64,
    /// The commanded velocity and torque that went out in this cycle.
    pub target_velocity: f64,
    pub target_torque: f64,
    /// The reported position from the start, and the reported torque.
    pub position: f64,
    pub torque: f64,
    /// True if the report is of this cycle.
    pub fresh: bool,
}

/// The samples of an excitation.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    pub samples: Vec<Sample>,
    /// Why it ended early.
    pub failed: Option<TuneError>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Stage {
    Waiting,
    Exciting,
    Ended,
}

/// Runs an excitation: one period to settle, then `periods`, then a period in which it fades.
#[derive(Debug)]
pub struct Exciter {
    axis: AxisRef,
    plan: Excitation,
    periods: usize,
    /// The greatest distance from the start, and its unit.
    window: f64,
    unit: String,
    stage: Stage,
    origin: f64,
    /// The cycles of the excitation so far.
    at: usize,
    samples: Vec<Sample>,
    failed: Option<TuneError>,
    rejected: Option<CommandError>,
    /// Receives the record when the cycle has ended.
    result: Sender<Record>,
}

impl Exciter {
    /// Creates the controller. It sends its record when it is dropped, after the cycle has ended.
    #[must_use]
    pub fn new(
        axis: AxisRef,
        plan: Excitation,
        periods: usize,
        (window, unit): (f64, &str),
        result: Sender<Record>,
    ) -> Self {
        let cycles = plan.samples.len() * (periods + 2);
        Self {
            axis,
            plan,
            periods,
            window,
            unit: unit.to_owned(),
            stage: Stage::Waiting,
            origin: 0.0,
            at: 0,
            samples: Vec::with_capacity(cycles),
            failed: None,
            rejected: None,
            result,
        }
    }

    /// Returns the share of the excitation in a cycle, from 0 to 1, with a smooth beginning and end.
    fn share(&self, at: usize) -> f64 {
        // Half a period: slow against all of its lines.
        let ramp = self.plan.samples.len() as f64 / 2.0;
        let all = self.plan.samples.len() * (self.periods + 2);
        let near = at.min(all.saturating_sub(at + 1)) as f64 / ramp;
        let s = near.min(1.0);
        // Its first and second derivative are 0 at both ends.
        s * s * s * (10.0 - s * (15.0 - s * 6.0))
    }

    /// Returns the excitation of a cycle.
    fn value(&self, at: usize) -> f64 {
        let period = self.plan.samples.len();
        self.plan.samples.get(at % period).copied().unwrap_or(0.0) * self.share(at)
    }

    fn excite(&mut self, machine: &mut CycleContext<'_>) -> Result<bool, TuneError> {
        let status = machine.axis(self.axis);
        if let Some(last) = self.samples.last_mut() {
            (last.target_velocity, last.target_torque) =
                (status.target_velocity, status.target_torque);
        }
        let position = status.position - self.origin;
        let all = self.plan.samples.len() * (self.periods + 2);
        if self.at >= all {
            return Ok(true);
        }
        if position.abs() > self.window {
            return Err(TuneError::Window {
                window: self.window,
                position,
                // Moved out of a failed run, which ends with this.
                unit: std::mem::take(&mut self.unit),
            });
        }
        let value = self.value(self.at);
        let done = match self.plan.quantity {
            Quantity::Motion => machine.set_point(self.axis, self.origin + value),
            Quantity::Velocity => machine.command(
                self.axis,
                Command::Velocity {
                    velocity: (self.value(self.at + 1) - value) / self.plan.dt_s,
                    ramp: 1.0,
                },
            ),
            Quantity::Torque => machine.command(
                self.axis,
                Command::Torque {
                    percent: value,
                    ramp_s: 0.0,
                },
            ),
        };
        if done.is_err() && (machine.stopping() || machine.stopped(self.axis).is_some()) {
            // The run reports the cause.
            return Ok(true);
        }
        if let Err(error) = done {
            self.rejected = Some(error);
            return Ok(true);
        }
        if self.samples.len() < self.samples.capacity() {
            self.samples.push(Sample {
                excitation: value,
                position,
                torque: status.torque,
                fresh: status.stale_cycles == 0,
                ..Sample::default()
            });
        }
        self.at += 1;
        Ok(false)
    }
}

impl Controller for Exciter {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        match self.stage {
            Stage::Waiting => {
                let status = machine.axis(self.axis);
                if status.ready && status.at_rest {
                    self.origin = match self.plan.quantity {
                        Quantity::Motion => status.target_position,
                        Quantity::Velocity | Quantity::Torque => status.position,
                    };
                    self.stage = Stage::Exciting;
                }
            }
            Stage::Exciting => match self.excite(machine) {
                Ok(false) => {}
                ended => {
                    self.failed = ended.err();
                    self.stage = Stage::Ended;
                    let _ = machine.command(self.axis, Command::Stop);
                    machine.finish();
                }
            },
            Stage::Ended => {}
        }
    }
}

impl Drop for Exciter {
    fn drop(&mut self) {
        let rejected = self.rejected.take();
        let rejected = rejected.map(|error| TuneError::Rejected(error.to_string()));
        let _ = self.result.send(Record {
            samples: std::mem::take(&mut self.samples),
            failed: self.failed.take().or(rejected),
        });
    }
}
