//! Commands: checked completely before anything changes.

use super::{Axis, Command, Plan, Wish};
use crate::cia402::{Mode, State};
use crate::setpoint::{Ramp, Trapezoid};
use crate::status::Refused;

/// Beyond this many counts f64 no longer tells two apart.
const FARTHEST_COUNTS: f64 = 1e15;

impl Axis {
    pub(super) fn take(&mut self, command: Command) -> Result<(), Refused> {
        match command {
            Command::Enable => self.enable(),
            Command::Disable => {
                self.disable();
                Ok(())
            }
            Command::ResetFault => {
                self.reset_fault();
                Ok(())
            }
            Command::Stop => {
                self.plan = self.braking();
                Ok(())
            }
            Command::QuickStop => {
                self.quick_stop(false);
                Ok(())
            }
            Command::MoveTo {
                position,
                speed,
                ramp,
            } => self.move_to(position, speed, ramp),
            Command::Velocity { velocity, ramp } => self.run_at(velocity, ramp),
            Command::Torque { percent, ramp_s } => self.push(percent, ramp_s),
        }
    }

    fn enable(&mut self) -> Result<(), Refused> {
        if let Some(trip) = self.trip {
            return Err(Refused::Tripped(trip));
        }
        if let Some(fault) = self.fault
            && !self.reset
        {
            return Err(Refused::Faulted(fault));
        }
        if let Wish::QuickStop { then_disable, .. } = self.wish {
            if then_disable || self.state == State::OperationEnabled {
                return Err(Refused::Stopping);
            }
            if !self.standing() {
                return Err(Refused::StillMoving {
                    velocity: self.actual.velocity(),
                });
            }
        }
        // The power is on its way off and the drive has not answered yet: what it answers would look like a loss.
        if self.active && self.wish == Wish::Disabled {
            return Err(Refused::Stopping);
        }
        self.wish = Wish::Enabled;
        Ok(())
    }

    fn disable(&mut self) {
        self.plan = self.braking();
        self.wish = match self.wish {
            Wish::QuickStop { elapsed_s, .. } => Wish::QuickStop {
                then_disable: true,
                elapsed_s,
            },
            // Asked for already, and perhaps granted without the set-point at rest: no power again.
            Wish::Disabling { .. } | Wish::Disabled => self.wish,
            _ if self.active => Wish::Disabling { frozen_s: 0.0 },
            _ => Wish::Disabled,
        };
    }

    /// Also how a trip stops the axis.
    pub(super) fn quick_stop(&mut self, then_disable: bool) {
        self.plan = self.braking();
        self.wish = match self.wish {
            Wish::QuickStop {
                then_disable: before,
                elapsed_s,
            } => Wish::QuickStop {
                then_disable: before || then_disable,
                elapsed_s,
            },
            // No power, or on its way off, perhaps after a quick stop that took too long: not from the beginning again.
            Wish::Disabled => Wish::Disabled,
            _ => Wish::QuickStop {
                then_disable,
                elapsed_s: 0.0,
            },
        };
    }

    fn reset_fault(&mut self) {
        self.trip = None;
        self.reset_failed = false;
        if self.state.is_fault() {
            self.reset = true;
        } else {
            self.fault = None;
        }
    }

    /// Motion is taken only from an axis that is enabled and is to stay so.
    fn check_ready(&self) -> Result<(), Refused> {
        if let Some(trip) = self.trip {
            return Err(Refused::Tripped(trip));
        }
        if let Some(fault) = self.fault {
            return Err(Refused::Faulted(fault));
        }
        if self.state == State::OperationEnabled
            && let Some(display) = self.mode_display
            && !self.mode_confirmed()
        {
            return Err(Refused::ModeNotConfirmed {
                expected: self.config.mode,
                display: Mode::from_code(display),
            });
        }
        if !self.active {
            return Err(Refused::NotEnabled { state: self.state });
        }
        if self.wish != Wish::Enabled {
            return Err(Refused::Stopping);
        }
        Ok(())
    }

    fn check_mode(&self, command: &'static str, needs: Mode) -> Result<(), Refused> {
        if self.config.mode == needs {
            return Ok(());
        }
        Err(Refused::WrongMode {
            command,
            needs,
            mode: self.config.mode,
        })
    }

    fn move_to(&mut self, position: f64, speed: f64, ramp: f64) -> Result<(), Refused> {
        self.check_mode("a move", Mode::Csp)?;
        finite("position", position)?;
        fraction("speed", speed)?;
        fraction("ramp", ramp)?;
        let limits = self.config.limits;
        let scale = &self.config.scale;
        let far = scale.units_of_counts(FARTHEST_COUNTS);
        let [low, high] = limits
            .position
            .unwrap_or([scale.offset() - far, scale.offset() + far]);
        if !(low..=high).contains(&position) {
            return Err(Refused::OutsideRange {
                position,
                low,
                high,
            });
        }
        self.check_ready()?;
        let earlier = match self.plan {
            Plan::Move(trapezoid) => trapezoid.braking,
            Plan::Hold(hold) => hold.acceleration,
            Plan::Velocity(_) | Plan::Torque(_) => limits.acceleration,
        };
        let acceleration = limits.acceleration * ramp;
        let trapezoid = Trapezoid {
            target: position,
            velocity: limits.velocity * speed,
            acceleration,
            braking: acceleration,
        };
        self.plan =
            Plan::Move(trapezoid.taking_over(self.motion, earlier, limits.acceleration, self.dt_s));
        Ok(())
    }

    fn run_at(&mut self, velocity: f64, ramp: f64) -> Result<(), Refused> {
        self.check_mode("a velocity", Mode::Csv)?;
        finite("velocity", velocity)?;
        fraction("ramp", ramp)?;
        let limits = self.config.limits;
        if velocity.abs() > limits.velocity {
            return Err(Refused::TooFast {
                velocity,
                limit: limits.velocity,
            });
        }
        self.check_ready()?;
        self.plan = Plan::Velocity(Ramp {
            target: velocity,
            slope: limits.acceleration * ramp,
        });
        Ok(())
    }

    fn push(&mut self, percent: f64, ramp_s: f64) -> Result<(), Refused> {
        self.check_mode("a torque", Mode::Cst)?;
        finite("torque", percent)?;
        finite("ramp time", ramp_s)?;
        if ramp_s < 0.0 {
            return Err(Refused::Negative {
                what: "ramp time",
                value: ramp_s,
            });
        }
        let limit = self.config.limits.torque;
        if percent.abs() > limit {
            return Err(Refused::TooMuchTorque { percent, limit });
        }
        self.check_ready()?;
        // Division by zero is infinitely steep, and then the configured slope is the smaller one.
        let asked = (percent - self.torque).abs() / ramp_s;
        let slope = if asked > 0.0 {
            asked.min(self.config.torque_slope)
        } else {
            self.config.torque_slope
        };
        self.plan = Plan::Torque(Ramp {
            target: percent,
            slope,
        });
        Ok(())
    }
}

fn finite(what: &'static str, value: f64) -> Result<(), Refused> {
    if value.is_finite() {
        Ok(())
    } else {
        Err(Refused::NotFinite { what, value })
    }
}

fn fraction(what: &'static str, value: f64) -> Result<(), Refused> {
    finite(what, value)?;
    if value > 0.0 && value <= 1.0 {
        Ok(())
    } else {
        Err(Refused::NotAFraction { what, value })
    }
}
