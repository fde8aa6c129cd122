//! Commands: checked completely before anything changes.

use super::stop::{PowerGoal, Resets};
use super::{Axis, ControlledQuantity, Plan};
use crate::HomingError;
use crate::cia402::{Mode, State};
use crate::profile_mode::Goal;
use crate::setpoint::{self, Ramp, Trapezoid};
use crate::status::{CommandError, PowerLossCause};
use crate::supervision::StopMethod;
use crate::touch_probe::{Edge, Probe, Source};
use crate::units::{Counts, UserUnits};

/// A command to an axis; an unsuitable one is rejected with a [`CommandError`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Command {
    /// Takes the drive to Operation enabled. Does not reset a fault.
    Enable,
    /// Decelerates, then removes the power.
    Disable,
    /// Acknowledges a trip, and resets the fault of a drive in Fault.
    ResetFault,
    /// Decelerates with the limit acceleration and holds; the axis stays enabled. In CST without a
    /// position loop: reduces the torque to zero.
    Stop,
    /// As [`Command::Stop`], for a hold: a search for home fails with [`HomingError::Held`].
    HoldHoming,
    /// Triggers the drive's quick stop. The drive stays in Quick stop active if its option code
    /// (0x605A) says so.
    QuickStop,
    /// Removes the power at once, without deceleration: the axis coasts, or its brake stops it.
    DisableVoltage,
    /// Stops as fast as configured: quick stop or disable voltage. The axis stays without power
    /// until it is reset and enabled again.
    EmergencyStop,
    /// Captures the position of the next edge, once.
    ArmProbe {
        /// The touch probe.
        probe: Probe,
        /// The edge.
        edge: Edge,
        /// The signal of the edge.
        source: Source,
        /// Stops like [`Command::Stop`] in the cycle that shows the edge. An axis with external
        /// set-points continues with them.
        stop: bool,
    },
    /// Switches a touch probe off.
    DisarmProbe {
        /// The touch probe.
        probe: Probe,
    },
    /// Switches the mode of operation, also in motion. The motion continues if the new mode
    /// supports it; otherwise the axis decelerates to rest.
    SetMode(Mode),
    /// Starts homing by the drive, with the method and parameters stored there. The axis must stand
    /// still. Afterwards the axis returns to its mode. [`Command::Stop`] aborts homing.
    Home {
        /// Time limit of the search, seconds.
        timeout_s: f64,
    },
    /// Moves to a position. In CSP and PP, and in CSV and CST with a position loop.
    MoveTo {
        /// The target, user units.
        position: f64,
        /// Fraction of the velocity limit, above 0 and at most 1.
        speed: f64,
        /// Fraction of the acceleration limit, above 0 and at most 1.
        ramp: f64,
    },
    /// Moves by a distance from the set-point; otherwise like [`Command::MoveTo`].
    MoveBy {
        /// The distance, user units.
        distance: f64,
        /// Fraction of the velocity limit, above 0 and at most 1.
        speed: f64,
        /// Fraction of the acceleration limit, above 0 and at most 1.
        ramp: f64,
    },
    /// Sets a target velocity. In CSV, CSP, PV, and CST with a position loop.
    Velocity {
        /// The velocity, user units per second.
        velocity: f64,
        /// Fraction of the acceleration limit, above 0 and at most 1.
        ramp: f64,
    },
    /// Sets a target torque. In CST.
    Torque {
        /// Percent of rated torque.
        percent: f64,
        /// Time from the present to the new torque in seconds. `torque_slope` limits the slope.
        ramp_s: f64,
    },
}

/// Tolerance: differences of f64 positions within a limit may exceed it by rounding.
const SET_POINT_ROUNDING: f64 = 1.0 + 1e-6;
/// The part of the room to stop that a jerk-limited stop may need in excess.
const STOP_RESERVE: f64 = 0.005;

impl Axis {
    /// Returns the error with which [`Axis::command`] would reject `Enable` or `Home` now. Other
    /// commands are not checked. RT: O(1).
    ///
    /// # Errors
    /// As [`Axis::command`].
    pub fn check(&self, command: Command) -> Result<(), CommandError> {
        match command {
            Command::Enable => self.check_enable(),
            Command::Home { timeout_s } => self.check_home(timeout_s),
            _ => Ok(()),
        }
    }

    pub(super) fn take(&mut self, command: Command) -> Result<(), CommandError> {
        match command {
            Command::Enable => self.enable(),
            Command::Disable => {
                self.stop_with(PowerLossCause::Command, StopMethod::Ramp, false);
                Ok(())
            }
            Command::ResetFault => {
                self.reset_fault();
                Ok(())
            }
            Command::HoldHoming => {
                self.home.abort(HomingError::Held);
                // Without power for a change of mode, the axis does not move, and power returns with
                // the mode.
                match self.mode_cycle {
                    Some(_) => Ok(()),
                    None => self.take(Command::Stop),
                }
            }
            Command::Stop => {
                // Power must not return after a stop.
                self.cancel_mode_cycle();
                self.stop();
                Ok(())
            }
            Command::DisableVoltage => {
                self.stop_with(PowerLossCause::Command, StopMethod::DisableVoltage, false);
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
                    return Err(CommandError::NoProbe);
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
                self.stop_with(PowerLossCause::Command, StopMethod::QuickStop, true);
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

    pub(super) fn enable(&mut self) -> Result<(), CommandError> {
        self.check_enable()?;
        if self.goal != PowerGoal::On {
            self.power_loss_cause = None;
        }
        self.goal = PowerGoal::On;
        Ok(())
    }

    fn check_enable(&self) -> Result<(), CommandError> {
        if let Some(trip) = self.trip {
            return Err(CommandError::Tripped(trip));
        }
        if let Some(fault) = self.fault
            && !self.reset
        {
            return Err(CommandError::Faulted(fault));
        }
        match self.goal {
            PowerGoal::Stopping(stop) if stop.removes_power() => {
                // Otherwise the drive's confirmation would look like a loss of power.
                if self.has_control() {
                    return Err(CommandError::Stopping);
                }
            }
            PowerGoal::Stopping(stop) => {
                if !stop.stays || self.state == State::OperationEnabled {
                    return Err(CommandError::Stopping);
                }
                if !self.at_standstill() {
                    return Err(CommandError::StillMoving {
                        velocity: self.actual.velocity(),
                    });
                }
            }
            PowerGoal::Off | PowerGoal::On => {}
        }
        match self.has_control() {
            true => Ok(()),
            false => self.check_coasting(),
        }
    }

    /// Rejects the power of an axis that moves: its drive would brake it with a step of the target.
    fn check_coasting(&self) -> Result<(), CommandError> {
        if self.at_standstill() {
            Ok(())
        } else {
            Err(CommandError::StillMoving {
                velocity: self.actual.velocity(),
            })
        }
    }

    fn reset_fault(&mut self) {
        if !self.trip_is_new {
            self.trip = None;
        }
        self.reset_failed = false;
        self.auto_reset = Resets::default();
        if self.state.is_fault() {
            self.reset = true;
        } else {
            self.fault = None;
        }
    }

    /// Rejects motion unless the axis is enabled and stays enabled.
    pub(super) fn check_ready(&self) -> Result<(), CommandError> {
        if let Some(trip) = self.trip {
            return Err(CommandError::Tripped(trip));
        }
        if let Some(fault) = self.fault {
            return Err(CommandError::Faulted(fault));
        }
        if self.home.running() {
            return Err(CommandError::Homing);
        }
        if let Some(to) = self.switching() {
            return Err(CommandError::Switching { to });
        }
        if matches!(self.state, State::SwitchedOn | State::OperationEnabled)
            && let Some(display) = self.mode_display
            && !self.mode_confirmed()
        {
            return Err(CommandError::ModeNotConfirmed {
                expected: self.mode,
                display: Mode::from_code(display),
            });
        }
        if !self.follows() {
            return Err(CommandError::NotEnabled { state: self.state });
        }
        if self.goal != PowerGoal::On {
            return Err(CommandError::Stopping);
        }
        if self.braked() {
            return Err(CommandError::BrakeOpening);
        }
        Ok(())
    }

    /// Rejects `command` unless the active mode supports it.
    pub(super) fn check_control(
        &self,
        command: &'static str,
        needs: Mode,
        possible: impl Fn(ControlledQuantity, Mode) -> bool,
    ) -> Result<(), CommandError> {
        if self.mode == needs || possible(self.config.control(self.mode), self.mode) {
            return Ok(());
        }
        Err(CommandError::WrongMode {
            command,
            needs,
            mode: self.mode,
        })
    }

    fn set_mode(&mut self, to: Mode) -> Result<(), CommandError> {
        // Homing is a sequence and not a permanent mode.
        let possible = matches!(to, Mode::Csp | Mode::Csv | Mode::Cst | Mode::Pp | Mode::Pv);
        if !possible || !(self.config.modes.contains(to) || to == self.config.mode) {
            return Err(CommandError::ModeNotOffered { mode: to });
        }
        if !self.has_control() {
            self.mode = to;
            self.switch_failed = None;
            self.redirect_mode_cycle(to);
            return Ok(());
        }
        if self.switching() == Some(to) {
            return Ok(());
        }
        self.check_switch(to)?;
        if to != self.mode {
            self.begin_switch(to);
        }
        Ok(())
    }

    /// Returns the start position of a relative move.
    fn move_start(&self) -> f64 {
        match self.profile.goal() {
            Some(goal) if self.mode == Mode::Pp && self.profile.reached() => goal.target,
            _ if self.controlled_quantity() == ControlledQuantity::Position => self.motion.position,
            _ => self.actual.position(),
        }
    }

    fn move_to(&mut self, position: f64, speed: f64, ramp: f64) -> Result<(), CommandError> {
        self.check_control("a move", Mode::Csp, |c, mode| {
            c == ControlledQuantity::Position || mode == Mode::Pp
        })?;
        finite("position", position)?;
        fraction("speed", speed)?;
        fraction("ramp", ramp)?;
        let limits = self.config.limits;
        let scale = &self.config.scale;
        let [low, high] = limits.position.unwrap_or(scale.range());
        if !(low..=high).contains(&position) {
            return Err(self.outside(position, [low, high]));
        }
        self.check_ready()?;
        if self.mode == Mode::Pp {
            if self.config.profile_fixed && (speed, ramp) != (1.0, 1.0) {
                return Err(CommandError::ProfileFixed);
            }
            // The drive plans this move itself, with 32-bit positions.
            let Counts(counts) = scale.position_to_counts(UserUnits(position));
            if i32::try_from(counts).is_err() {
                let [low, high] = [i32::MIN, i32::MAX]
                    .map(|end| scale.position_to_user(Counts(i64::from(end))).0);
                return Err(CommandError::OutsideRange {
                    position,
                    low: low.min(high),
                    high: high.max(low),
                });
            }
            self.commanded_target = Some(position);
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
            self.commanded_target = Some(position);
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
        self.commanded_target = Some(position);
        self.plan =
            Plan::Move(trapezoid.taking_over(self.motion, earlier, limits.acceleration, self.dt_s));
        Ok(())
    }

    fn run_at(&mut self, velocity: f64, ramp: f64) -> Result<(), CommandError> {
        self.check_control("a velocity", Mode::Csv, |c, mode| {
            matches!(
                c,
                ControlledQuantity::Position | ControlledQuantity::Velocity
            ) || mode == Mode::Pv
        })?;
        finite("velocity", velocity)?;
        fraction("ramp", ramp)?;
        let limits = self.config.limits;
        if velocity.abs() > limits.velocity {
            return Err(CommandError::TooFast {
                velocity,
                limit: limits.velocity,
            });
        }
        self.check_ready()?;
        self.forget_target();
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

    /// Accepts the external set-point of the next cycle.
    pub(super) fn take_set_point(&mut self, position: f64) -> Result<(), CommandError> {
        self.check_control("a set-point", Mode::Csp, |c, _| {
            c == ControlledQuantity::Position
        })?;
        finite("position", position)?;
        self.check_ready()?;
        if self.setpoint_frozen() {
            return Err(CommandError::FramesLost);
        }
        self.engage();
        let limits = self.config.limits;
        let before = self.motion;
        let step = position - before.position;
        let velocity = step / self.dt_s;
        let most = limits.velocity * self.dt_s;
        if step.abs() > most * SET_POINT_ROUNDING {
            return Err(CommandError::Step { step, most });
        }
        let change = velocity - before.velocity;
        let most = limits.acceleration * self.dt_s;
        // Before the first cycle `change` is NaN.
        if change.is_nan() || change.abs() > most * SET_POINT_ROUNDING {
            return Err(CommandError::Jump { change, most });
        }
        if let Some([low, high]) = limits.position {
            // An axis outside its range may return into it.
            let [low, high] = [low.min(before.position), high.max(before.position)];
            if !(low..=high).contains(&position) {
                return Err(self.outside(position, [low, high]));
            }
            // From here the axis must be able to stop, whatever comes next.
            let slower = limits.acceleration * self.dt_s / 2.0;
            let braking = (velocity.abs() - slower).max(0.0).powi(2) / (2.0 * limits.acceleration);
            let room = if velocity < 0.0 {
                position - low
            } else {
                high - position
            };
            let next = before.then(position, velocity, self.dt_s);
            // A profile that uses the whole jerk limit leaves less room than the stop, which is
            // planned with a reserve and from mean velocities.
            let slack = step.abs() + room * STOP_RESERVE;
            let jerky = self
                .jerk_limited_reach(next)
                .is_some_and(|reach| reach[0] < low - slack || reach[1] > high + slack);
            if jerky || braking > room * SET_POINT_ROUNDING + f64::EPSILON * position.abs() * 8.0 {
                return Err(CommandError::NoRoomToStop {
                    velocity,
                    position,
                    low,
                    high,
                });
            }
        }
        self.external_setpoint = Some(before.then(position, velocity, self.dt_s));
        self.plan = Plan::External;
        self.forget_target();
        Ok(())
    }

    fn push(&mut self, percent: f64, ramp_s: f64) -> Result<(), CommandError> {
        self.check_control("a torque", Mode::Cst, |_, _| false)?;
        finite("torque", percent)?;
        finite("ramp time", ramp_s)?;
        if ramp_s < 0.0 {
            return Err(CommandError::Negative {
                what: "ramp time",
                value: ramp_s,
            });
        }
        let limit = self.config.limits.torque;
        if percent.abs() > limit {
            return Err(CommandError::TooMuchTorque { percent, limit });
        }
        self.check_ready()?;
        // A division by zero gives infinity; then the configured slope applies.
        let asked = (percent - self.loop_state.torque).abs() / ramp_s;
        let slope = if asked > 0.0 {
            asked.min(self.config.torque_slope)
        } else {
            self.config.torque_slope
        };
        self.plan = Plan::Torque(Ramp {
            target: percent,
            slope,
        });
        self.forget_target();
        self.permit_motion();
        Ok(())
    }
}

fn finite(what: &'static str, value: f64) -> Result<(), CommandError> {
    if value.is_finite() {
        Ok(())
    } else {
        Err(CommandError::NotFinite { what, value })
    }
}

fn fraction(what: &'static str, value: f64) -> Result<(), CommandError> {
    finite(what, value)?;
    if value > 0.0 && value <= 1.0 {
        Ok(())
    } else {
        Err(CommandError::NotAFraction { what, value })
    }
}
