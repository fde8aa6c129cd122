//! Commands: checked completely before anything changes.

use super::stop::{PowerGoal, Resets};
use super::{Axis, Control, Plan};
use crate::cia402::{Mode, State};
use crate::probe::{Edge, Probe, Source};
use crate::profile::Goal;
use crate::setpoint::{self, Ramp, Trapezoid};
use crate::status::Refused;
use crate::supervision::StopMethod;
use crate::units::{Counts, UserUnits};

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Command {
    /// Take the drive to Operation enabled. Does not reset a fault.
    Enable,
    /// Decelerate, then take the power away.
    Disable,
    /// Acknowledge a trip, and reset the drive's fault if it is in one.
    ResetFault,
    /// Decelerate with the limit acceleration and hold; stays enabled. In CST without a position loop: torque to zero.
    Stop,
    /// The drive's own quick stop; it then stays in Quick stop active if its option code says so.
    QuickStop,
    /// No power at once, without deceleration: the axis coasts, or its brake stops it.
    DisableVoltage,
    /// The shortest way to no motion: quick stop or no voltage, as configured; no power until it is reset and enabled again.
    EmergencyStop,
    /// Capture the position of the next edge, once.
    ArmProbe {
        probe: Probe,
        edge: Edge,
        source: Source,
        /// As by [`Command::Stop`], in the very cycle that shows the edge. An axis that is given set-points goes on with them.
        stop: bool,
    },
    DisarmProbe {
        probe: Probe,
    },
    /// Switch the mode of operation, also in motion. Where the new mode can do what the set-point is about, it goes on
    /// with it; otherwise it comes to rest.
    SetMode(Mode),
    /// Homing by the drive, with the method and parameters that it has. The axis must stand; afterwards it is back in its
    /// mode. [`Command::Stop`] aborts it.
    Home {
        /// For the search, seconds.
        timeout_s: f64,
    },
    /// In CSP and PP, and where a position loop is configured in CSV and CST.
    MoveTo {
        position: f64,
        /// Fraction of the velocity limit, above 0 and at most 1.
        speed: f64,
        /// Fraction of the acceleration limit, above 0 and at most 1.
        ramp: f64,
    },
    /// From where the set-point is; otherwise as [`Command::MoveTo`].
    MoveBy {
        distance: f64,
        /// Fraction of the velocity limit, above 0 and at most 1.
        speed: f64,
        /// Fraction of the acceleration limit, above 0 and at most 1.
        ramp: f64,
    },
    /// In CSV, CSP, PV, and CST with a position loop.
    Velocity {
        velocity: f64,
        /// Fraction of the acceleration limit, above 0 and at most 1.
        ramp: f64,
    },
    /// In CST.
    Torque {
        /// Of rated torque.
        percent: f64,
        /// Seconds from the present torque to the new one; never steeper than `torque_slope`.
        ramp_s: f64,
    },
}

/// Quotients of differences of f64s that were within a limit may be a little beyond it.
const SET_POINT_ROUNDING: f64 = 1.0 + 1e-6;

impl Axis {
    pub(super) fn take(&mut self, command: Command) -> Result<(), Refused> {
        match command {
            Command::Enable => self.enable(),
            Command::Disable => {
                self.stop_by(StopMethod::Ramp);
                Ok(())
            }
            Command::ResetFault => {
                self.reset_fault();
                Ok(())
            }
            Command::Stop => {
                self.stop();
                Ok(())
            }
            Command::DisableVoltage => {
                self.stop_by(StopMethod::DisableVoltage);
                Ok(())
            }
            Command::EmergencyStop => {
                self.emergency_stop();
                Ok(())
            }
            Command::ArmProbe {
                probe,
                edge,
                source,
                stop,
            } => {
                if !self.probe_mapped {
                    return Err(Refused::NoProbe);
                }
                self.probes.arm(probe, edge, source, stop);
                Ok(())
            }
            Command::DisarmProbe { probe } => {
                self.probes.disarm(probe);
                Ok(())
            }
            Command::SetMode(mode) => self.set_mode(mode),
            Command::Home { timeout_s } => self.home(timeout_s),
            Command::QuickStop => {
                self.begin_stop(StopMethod::QuickStop, true);
                Ok(())
            }
            Command::MoveTo {
                position,
                speed,
                ramp,
            } => self.move_to(position, speed, ramp),
            Command::MoveBy {
                distance,
                speed,
                ramp,
            } => {
                finite("distance", distance)?;
                self.move_to(self.move_start() + distance, speed, ramp)
            }
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
        match self.goal {
            PowerGoal::Stopping(stop) if stop.removes_power() => {
                // What the drive answers to the removal would look like a loss of power.
                if self.active {
                    return Err(Refused::Stopping);
                }
            }
            PowerGoal::Stopping(stop) => {
                if !stop.stays || self.state == State::OperationEnabled {
                    return Err(Refused::Stopping);
                }
                if !self.standing() {
                    return Err(Refused::StillMoving {
                        velocity: self.actual.velocity(),
                    });
                }
            }
            PowerGoal::Off | PowerGoal::On => {}
        }
        self.goal = PowerGoal::On;
        Ok(())
    }

    fn reset_fault(&mut self) {
        self.trip = None;
        self.reset_failed = false;
        self.resets = Resets::default();
        if self.state.is_fault() {
            self.reset = true;
        } else {
            self.fault = None;
        }
    }

    /// Motion is taken only from an axis that is enabled and is to stay so.
    pub(super) fn check_ready(&self) -> Result<(), Refused> {
        if let Some(trip) = self.trip {
            return Err(Refused::Tripped(trip));
        }
        if let Some(fault) = self.fault {
            return Err(Refused::Faulted(fault));
        }
        if self.home.running() {
            return Err(Refused::Homing);
        }
        if let Some(switch) = self.switch {
            return Err(Refused::Switching { to: switch.to });
        }
        if matches!(self.state, State::SwitchedOn | State::OperationEnabled)
            && let Some(display) = self.mode_display
            && !self.mode_confirmed()
        {
            return Err(Refused::ModeNotConfirmed {
                expected: self.mode,
                display: Mode::from_code(display),
            });
        }
        if !self.active {
            return Err(Refused::NotEnabled { state: self.state });
        }
        if self.goal != PowerGoal::On {
            return Err(Refused::Stopping);
        }
        if self.braked() {
            return Err(Refused::BrakeOpening);
        }
        Ok(())
    }

    /// Is the axis in a mode that takes this?
    fn check_control(
        &self,
        command: &'static str,
        needs: Mode,
        possible: impl Fn(Control, Mode) -> bool,
    ) -> Result<(), Refused> {
        if self.mode == needs || possible(self.config.control(self.mode), self.mode) {
            return Ok(());
        }
        Err(Refused::WrongMode {
            command,
            needs,
            mode: self.mode,
        })
    }

    fn set_mode(&mut self, to: Mode) -> Result<(), Refused> {
        // Homing is a sequence, not a mode to stay in.
        let possible = matches!(to, Mode::Csp | Mode::Csv | Mode::Cst | Mode::Pp | Mode::Pv);
        if !possible || !(self.config.modes.contains(to) || to == self.config.mode) {
            return Err(Refused::ModeNotOffered { mode: to });
        }
        if !self.active {
            self.mode = to;
            self.switch_failed = None;
            return Ok(());
        }
        if self.switch.is_some_and(|switch| switch.to == to) {
            return Ok(());
        }
        self.check_switch(to)?;
        if to != self.mode {
            self.begin_switch(to);
        }
        Ok(())
    }

    /// Where a relative move starts.
    fn move_start(&self) -> f64 {
        match self.profile.goal() {
            Some(goal) if self.mode == Mode::Pp && self.profile.reached() => goal.target,
            _ if self.grip() == Control::Position => self.motion.position,
            _ => self.actual.position(),
        }
    }

    fn move_to(&mut self, position: f64, speed: f64, ramp: f64) -> Result<(), Refused> {
        self.check_control("a move", Mode::Csp, |c, mode| {
            c == Control::Position || mode == Mode::Pp
        })?;
        finite("position", position)?;
        fraction("speed", speed)?;
        fraction("ramp", ramp)?;
        let limits = self.config.limits;
        let scale = &self.config.scale;
        let [low, high] = limits.position.unwrap_or(scale.range());
        if !(low..=high).contains(&position) {
            return Err(Refused::OutsideRange {
                position,
                low,
                high,
            });
        }
        self.check_ready()?;
        if self.mode == Mode::Pp {
            // The drive goes there by itself, and it counts 32 bits.
            let Counts(counts) = scale.position_to_counts(UserUnits(position));
            if i32::try_from(counts).is_err() {
                let [low, high] = [i32::MIN, i32::MAX]
                    .map(|end| scale.position_to_user(Counts(i64::from(end))).0);
                return Err(Refused::OutsideRange {
                    position,
                    low: low.min(high),
                    high: high.max(low),
                });
            }
            self.profile.go_to(Goal {
                target: position,
                velocity: limits.velocity * speed,
                acceleration: limits.acceleration * ramp,
            });
            return Ok(());
        }
        if self.config.jerk_limited {
            let goal = setpoint::Goal::Position(position);
            let plan = self.jerk_limited(goal, limits.velocity * speed, ramp)?;
            self.engage();
            self.plan = Plan::Jerk(plan);
            return Ok(());
        }
        self.engage();
        let earlier = match self.plan {
            Plan::Move(trapezoid) => trapezoid.braking,
            Plan::Hold(hold) => hold.acceleration,
            _ => limits.acceleration,
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
        self.check_control("a velocity", Mode::Csv, |c, mode| {
            matches!(c, Control::Position | Control::Velocity) || mode == Mode::Pv
        })?;
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
        if self.mode == Mode::Pv {
            self.profile.run_at(Goal {
                target: velocity,
                velocity: limits.velocity,
                acceleration: limits.acceleration * ramp,
            });
            return Ok(());
        }
        self.engage();
        self.plan = Plan::Velocity(Ramp {
            target: velocity,
            slope: limits.acceleration * ramp,
        });
        Ok(())
    }

    /// The set-point of the next cycle, from outside.
    pub(super) fn take_set_point(&mut self, position: f64) -> Result<(), Refused> {
        self.check_control("a set-point", Mode::Csp, |c, _| c == Control::Position)?;
        finite("position", position)?;
        self.check_ready()?;
        if self.frozen() {
            return Err(Refused::FramesLost);
        }
        self.engage();
        let limits = self.config.limits;
        let before = self.motion;
        let step = position - before.position;
        let velocity = step / self.dt_s;
        let most = limits.velocity * self.dt_s;
        if step.abs() > most * SET_POINT_ROUNDING {
            return Err(Refused::Step { step, most });
        }
        let change = velocity - before.velocity;
        let most = limits.acceleration * self.dt_s;
        // No cycle yet: not a number.
        if change.is_nan() || change.abs() > most * SET_POINT_ROUNDING {
            return Err(Refused::Jump { change, most });
        }
        if let Some([low, high]) = limits.position {
            // From outside its range an axis may come back.
            let [low, high] = [low.min(before.position), high.max(before.position)];
            if !(low..=high).contains(&position) {
                return Err(Refused::OutsideRange {
                    position,
                    low,
                    high,
                });
            }
        }
        self.fed = Some(before.then(position, velocity, self.dt_s));
        self.plan = Plan::Fed;
        Ok(())
    }

    fn push(&mut self, percent: f64, ramp_s: f64) -> Result<(), Refused> {
        self.check_control("a torque", Mode::Cst, |_, _| false)?;
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
        let asked = (percent - self.given.torque).abs() / ramp_s;
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
