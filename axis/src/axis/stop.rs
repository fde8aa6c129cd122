//! Power and stops. Power is removed in one order only: decelerate → standstill → power off.
//!
//! A stop has one method and one timer. The method only becomes harder: set-points (`Ramp`), quick
//! stop of the drive (`QuickStop`), no voltage (`DisableVoltage`). It becomes harder by a command,
//! if the drive no longer follows set-points, and at the time-out. Without a configured time-out,
//! an axis that still slows down gets more time.
//!
//! The time-out follows from the initial speed, the acceleration limit and, with jerk limits, the
//! jerk. The timer also runs while frames are lost, so power is removed in bounded time even
//! without any further answer.

use super::{Axis, AxisConfig, ControlledQuantity, Plan};
use crate::HomingError;
use crate::cia402::{Power, State};
use crate::setpoint::{Goal, JerkLimited, Motion, MotionLimits, MoveRequest};
use crate::status::{PowerLossCause, StopPhase, StopStatus, Trip};
use crate::supervision::{FaultReset, StopMethod};

/// Time in seconds that an axis stands before its power is removed: its following error settles.
pub(super) const SETTLE_S: f64 = 0.1;
/// After the time-out, an axis that has not slowed down for this long is not decelerating.
const UNSLOWED_S: f64 = 1.0;
/// A drive whose quick stop ends by itself has this time for its brake (S-0-0207); then its voltage
/// is removed.
const DRIVE_OFF_S: f64 = 2.0;
/// A drive that still reports power this long after the request does not obey.
const POWER_OFF_S: f64 = 3.0;
/// After this time enabled without a fault, all automatic resets are available again.
const AUTO_RESET_FORGET_S: f64 = 60.0;
/// Longer than any brake or stop time; keeps sums finite.
const LONGEST_S: f64 = 3600.0;

/// The requested power of the axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum PowerGoal {
    Off,
    On,
    Stopping(Stop),
}

/// An active stop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Stop {
    pub(super) method: StopMethod,
    /// True: the drive stays in Quick stop active and keeps its power.
    pub(super) stays: bool,
    removing_power: bool,
    deceleration: Deceleration,
    /// Time in seconds for which the axis has been standing.
    standing_s: f64,
}

/// The progress of a deceleration against its time-out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Deceleration {
    elapsed_s: f64,
    timeout_s: f64,
    /// Lowest reported speed, and the time in seconds since it last fell.
    slowest: f64,
    unslowed_s: f64,
}

impl Deceleration {
    pub(super) const fn new(speed: f64, timeout_s: f64) -> Self {
        Self {
            elapsed_s: 0.0,
            timeout_s,
            slowest: speed,
            unslowed_s: 0.0,
        }
    }

    pub(super) const fn elapsed_s(&self) -> f64 {
        self.elapsed_s
    }

    pub(super) fn pass(&mut self, dt_s: f64) {
        self.elapsed_s = (self.elapsed_s + dt_s).min(LONGEST_S);
        self.unslowed_s = (self.unslowed_s + dt_s).min(LONGEST_S);
    }

    /// Notes a fresh speed. `window`: what counts as slower.
    pub(super) fn note(&mut self, speed: f64, window: f64) {
        if speed < self.slowest - window {
            (self.slowest, self.unslowed_s) = (speed, 0.0);
        }
    }

    /// True at the time-out. Without a configured one, an axis that still slows down gets more time.
    pub(super) fn is_late(&self, config: &AxisConfig) -> bool {
        let slows = config.stop_timeout_s.is_none() && self.unslowed_s <= UNSLOWED_S;
        self.elapsed_s > self.timeout_s && !slows
    }
}

impl Stop {
    /// Returns the request to the power state machine.
    pub(super) fn power(self) -> Power {
        match (self.removing_power, self.method) {
            (true, StopMethod::DisableVoltage) => Power::Off,
            (true, _) => Power::Disabled,
            (false, StopMethod::Ramp) => Power::Enabled,
            (false, _) => Power::QuickStop,
        }
    }

    pub(super) const fn removes_power(&self) -> bool {
        self.removing_power
    }

    /// True if the time to remove the power has passed and the axis does not slow down.
    fn is_over(&self) -> bool {
        let Deceleration {
            elapsed_s,
            unslowed_s,
            ..
        } = self.deceleration;
        self.removing_power && elapsed_s > POWER_OFF_S && unslowed_s > POWER_OFF_S
    }
}

/// The commanded state of the brake.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct BrakeState {
    /// True if the brake is to be open.
    pub(super) open: bool,
    /// Time in seconds since the brake was commanded open or closed.
    since_s: f64,
}

/// State of automatic fault resets.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Resets {
    pub(super) tried: u8,
    waited_s: f64,
    healthy_s: f64,
}

impl Axis {
    /// Stops the axis and removes its power, for a cause outside of it. An active stop only becomes
    /// harder. RT: O(1).
    pub fn stop_by(&mut self, method: StopMethod) {
        self.stop_with(PowerLossCause::Outside, method, false);
    }

    /// The only entry to a stop that ends without power. The first cause since the axis was enabled
    /// remains.
    pub(super) fn stop_with(&mut self, cause: PowerLossCause, method: StopMethod, stays: bool) {
        if self.goal != PowerGoal::Off {
            self.power_loss_cause.get_or_insert(cause);
        }
        self.cancel_mode_cycle();
        let method = match method {
            StopMethod::Ramp if !self.follows_set_points() => StopMethod::QuickStop,
            method => method,
        };
        let may_move = self.state.has_power() || self.has_control();
        match &mut self.goal {
            PowerGoal::Off => return,
            // While the power is removed, only its immediate removal is harder.
            PowerGoal::Stopping(stop)
                if stop.method >= method
                    || stop.removing_power && method != StopMethod::DisableVoltage =>
            {
                stop.stays &= stays;
                return;
            }
            // Without power the drive cannot move.
            PowerGoal::On if !may_move => {
                self.goal = PowerGoal::Off;
                return;
            }
            PowerGoal::On | PowerGoal::Stopping(_) => {}
        }
        match method {
            StopMethod::Ramp => self.stop(),
            StopMethod::QuickStop | StopMethod::DisableVoltage => self.brake(),
        }
        let mut stop = self.new_stop(method);
        stop.stays = stays;
        self.goal = PowerGoal::Stopping(stop);
        if stop.removing_power {
            self.brake_state = BrakeState::default();
        }
    }

    /// Removes the power of an axis at rest, to switch its mode.
    pub(super) fn remove_power_at_rest(&mut self) {
        self.power_loss_cause.get_or_insert(PowerLossCause::Command);
        self.forget_target();
        self.goal = PowerGoal::Stopping(self.new_stop(StopMethod::Ramp));
    }

    /// True if the drive follows set-points: it has power, shows the mode and sets Statusword bit
    /// 12.
    pub(super) fn follows_set_points(&self) -> bool {
        self.follows()
            && self.state == State::OperationEnabled
            && self.mode_confirmed()
            && self.reported_to_follow()
    }

    fn new_stop(&self, method: StopMethod) -> Stop {
        let speed = self.actual.velocity().abs();
        let fastest = speed.max(self.motion.velocity.abs());
        Stop {
            method,
            stays: false,
            removing_power: method == StopMethod::DisableVoltage,
            deceleration: Deceleration::new(speed, self.stop_time_s(fastest)),
            standing_s: 0.0,
        }
    }

    /// Returns the time in seconds after which a stop from `speed` becomes harder. A speed above the
    /// limit may be reported in a wrong unit and gives no more time.
    pub(super) fn stop_time_s(&self, speed: f64) -> f64 {
        let most = self.config.limits.velocity * super::supervision::OVER_VELOCITY;
        self.config.stop_time_s(self.mode, speed.min(most))
    }

    /// Advances a stop by one cycle, also while frames are lost.
    pub(super) fn settle_stop(&mut self, fresh: bool, dt_s: f64) {
        self.brake_state.since_s = (self.brake_state.since_s + dt_s).min(LONGEST_S);
        let mut stop = match self.goal {
            PowerGoal::Stopping(stop) => stop,
            // The drive became enabled after the request to remove its power.
            PowerGoal::Off if fresh && self.state == State::OperationEnabled => {
                self.power_loss_cause
                    .get_or_insert(PowerLossCause::Unrequested);
                Stop {
                    removing_power: true,
                    ..self.new_stop(StopMethod::QuickStop)
                }
            }
            _ => return,
        };
        if fresh && !self.state.has_power() {
            self.goal = PowerGoal::Off;
            return;
        }
        stop.deceleration.pass(dt_s);
        if fresh {
            let speed = self.actual.velocity().abs();
            stop.deceleration.note(speed, self.standstill_window());
        }
        if stop.removing_power {
            let slowing = stop.deceleration;
            let late = slowing.elapsed_s.min(slowing.unslowed_s) > DRIVE_OFF_S;
            if self.config.quick_stop_ends && !self.state.is_fault() && late {
                stop.method = StopMethod::DisableVoltage;
            }
            self.goal = PowerGoal::Stopping(stop);
            return;
        }
        if stop.method == StopMethod::Ramp && fresh && !self.follows_set_points() {
            self.goal = PowerGoal::Stopping(self.new_stop(StopMethod::QuickStop));
            return;
        }
        let commanded = match stop.method {
            StopMethod::Ramp => self.setpoint_at_rest(),
            _ => self.state == State::QuickStopActive,
        };
        stop.standing_s = if commanded && self.at_standstill() {
            stop.standing_s + dt_s
        } else {
            0.0
        };
        let standing = stop.standing_s >= SETTLE_S;
        if standing && !stop.stays {
            if self.brake_state.open {
                self.brake_state = BrakeState::default();
            }
            if self.brake_state.since_s >= self.config.brake.engage_s {
                (stop.removing_power, stop.deceleration.elapsed_s) = (true, 0.0);
            }
        } else if !standing && stop.deceleration.is_late(&self.config) {
            stop = self.harder(stop);
        }
        self.goal = PowerGoal::Stopping(stop);
    }

    /// Selects the next harder method at the time-out. An axis that still moves has failed to stop,
    /// except with a torque ramp.
    fn harder(&mut self, stop: Stop) -> Stop {
        let expected = stop.method == StopMethod::Ramp
            && self.config.control(self.mode) == ControlledQuantity::Torque;
        if !expected && self.stale_cycles == 0 && !self.at_standstill() {
            self.note_trip(Trip::NotStopped {
                velocity: self.actual.velocity(),
                time_s: stop.deceleration.elapsed_s,
                method: stop.method,
            });
        }
        let method = match stop.method {
            StopMethod::Ramp => StopMethod::QuickStop,
            _ => StopMethod::DisableVoltage,
        };
        Stop {
            stays: stop.stays && method == StopMethod::QuickStop,
            ..self.new_stop(method)
        }
    }

    /// Handles a fault of the drive: its fault reaction brakes, and it removes the power itself. An
    /// immediate removal of the power goes on.
    pub(super) fn stop_by_fault(&mut self) {
        if matches!(self.goal, PowerGoal::Stopping(stop) if stop.method == StopMethod::DisableVoltage)
        {
            return;
        }
        self.power_loss_cause.get_or_insert(PowerLossCause::Fault);
        self.goal = if self.state.has_power() {
            let stop = self.new_stop(StopMethod::QuickStop);
            PowerGoal::Stopping(Stop {
                removing_power: true,
                ..stop
            })
        } else {
            PowerGoal::Off
        };
    }

    /// Returns true if the stop cannot do more. The axis has no power, or does not slow down long
    /// after the request. RT: O(1).
    #[must_use]
    pub fn stop_ended(&self) -> bool {
        match self.goal {
            PowerGoal::Stopping(stop) => stop.is_over(),
            PowerGoal::On | PowerGoal::Off => !self.state.has_power(),
        }
    }

    pub(super) fn stop_status(&self) -> Option<StopStatus> {
        let PowerGoal::Stopping(stop) = self.goal else {
            return None;
        };
        let phase = match stop.removing_power {
            true if stop.is_over() && self.stale_cycles == 0 => StopPhase::PowerKept,
            true if stop.is_over() => StopPhase::Silent,
            true => StopPhase::RemovingPower,
            false if stop.standing_s >= SETTLE_S => StopPhase::Standstill,
            false => StopPhase::Decelerating,
        };
        Some(StopStatus {
            method: stop.method,
            phase,
            elapsed_s: stop.deceleration.elapsed_s,
            timeout_s: stop.deceleration.timeout_s,
        })
    }

    /// Stops with the limits of the axis instead of those of the plan ([`super::Command::Stop`] and
    /// stops by set-points). The speed falls from the first cycle on: an acceleration that
    /// increases it ends at once.
    pub(super) fn stop(&mut self) {
        let braking = matches!(self.plan, Plan::Hold(_));
        if self.config.jerk_limited
            && !braking
            && self.controlled_quantity() == ControlledQuantity::Position
            && let Some(plan) = self.jerk_limited_stop()
        {
            self.forget_target();
            self.home.abort(HomingError::Aborted);
            self.plan = Plan::Jerk(plan);
            return;
        }
        self.brake();
    }

    fn jerk_limited_stop(&self) -> Option<JerkLimited> {
        let motion = self.motion;
        let range = self.config.limits.position;
        let range = range.map(|[low, high]| [low.min(motion.position), high.max(motion.position)]);
        let order = MoveRequest {
            range,
            ..self.stop_request()
        };
        if let Plan::Jerk(source) = &self.plan
            && source.can_rest_before_turning()
        {
            return source.redirect(order, motion, self.dt_s).ok();
        }
        self.stop_from(order, motion)
    }

    /// Returns how far a jerk-limited stop from an external set-point goes: lowest and highest
    /// position. `None` without jerk limit. RT: O(1).
    pub(super) fn jerk_limited_reach(&self, motion: Motion) -> Option<[f64; 2]> {
        let limited = self.config.jerk_limited;
        let plan = limited.then(|| self.stop_from(self.stop_request(), motion));
        plan.flatten().map(|plan| plan.span())
    }

    /// Returns the request to come to rest, within any range.
    fn stop_request(&self) -> MoveRequest {
        MoveRequest::within(Goal::Velocity(0.0), self.config.limits.motion())
    }

    fn stop_from(&self, order: MoveRequest, motion: Motion) -> Option<JerkLimited> {
        let start = Motion {
            acceleration: taken_over(motion, order.ceiling, self.dt_s),
            ..motion
        };
        JerkLimited::new(order, start, self.dt_s).ok()
    }

    /// Updates the brake after the power state: opens it when the axis is enabled, closes it
    /// without power.
    pub(super) fn settle_brake(&mut self) {
        let powered = matches!(self.state, State::OperationEnabled | State::QuickStopActive);
        if self.follows() && self.goal == PowerGoal::On && !self.brake_state.open {
            self.brake_state = BrakeState {
                open: true,
                since_s: 0.0,
            };
        } else if !powered && self.brake_state.open {
            self.brake_state = BrakeState::default();
        }
    }

    /// True until the brake has opened.
    pub(super) fn braked(&self) -> bool {
        !self.brake_state.open || self.brake_state.since_s < self.config.brake.release_s
    }

    /// Resets a fault automatically, if configured and attempts remain.
    pub(super) fn settle_reset(&mut self, dt_s: f64) {
        let FaultReset::Automatic { tries, delay_s } = self.config.fault_reset else {
            return;
        };
        if self.follows() {
            self.auto_reset.healthy_s += dt_s;
            if self.auto_reset.healthy_s > AUTO_RESET_FORGET_S {
                self.auto_reset.tried = 0;
            }
            return;
        }
        self.auto_reset.healthy_s = 0.0;
        if self.state != State::Fault || self.reset {
            self.auto_reset.waited_s = 0.0;
            return;
        }
        self.auto_reset.waited_s += dt_s;
        if self.auto_reset.waited_s >= delay_s && self.auto_reset.tried < tries {
            self.auto_reset.tried = self.auto_reset.tried.saturating_add(1);
            self.auto_reset.waited_s = 0.0;
            self.reset_failed = false;
            self.reset = true;
        }
    }
}

/// Returns the initial deceleration of a stop. An acceleration that increases the speed becomes 0.
/// A deceleration is bounded so that the jerk limit can end it before the axis reverses.
pub(super) fn taken_over(motion: Motion, limits: MotionLimits, dt_s: f64) -> f64 {
    if motion.acceleration * motion.velocity >= 0.0 {
        return 0.0;
    }
    // The velocity of a motion is the mean of its cycle: half a cycle of deceleration follows.
    let half = dt_s / 2.0;
    let speed = motion.velocity.abs();
    let most = limits.jerk * ((half * half + 2.0 * speed / limits.jerk).sqrt() - half);
    motion.acceleration.max(-most).min(most)
}
