//! Supervision of the feedback, and the final limits of the set-point.

use super::stop::PowerGoal;
use super::{Axis, ControlledQuantity};
use crate::cia402::{Mode, ModeStatus, State, Statusword};
use crate::limits::Limits;
use crate::position_loop::bounded;
use crate::setpoint::{Motion, braking_velocity};
use crate::status::{DriveFault, Trip};
use crate::units::Counts;

/// Factor on the velocity limit, and consecutive fresh cycles above it until the axis trips.
pub(super) const OVER_VELOCITY: f64 = 1.2;
const OVER_VELOCITY_CYCLES: u8 = 5;

/// Consecutive fresh cycles without Statusword bit 12 until the axis counts as not following.
const FOLLOW_CYCLES: u8 = 10;

/// A plausible change of the reported position: the cycles by which its age may differ, the time
/// after which a drive with a slow position loop reports a new one, and counts.
const JUMP_CYCLES: f64 = 3.0;
const JUMP_S: f64 = 0.002;
const JUMP_COUNTS: f64 = 8.0;

/// Time in seconds for which a reported velocity may contradict the positions: filters of drives
/// delay it.
const CONTRADICTION_S: f64 = 0.05;
/// Fraction of the velocity limit up to which velocities are not compared.
const CONTRADICTION_FLOOR: f64 = 0.05;

/// Consecutive cycles with a Statusword that a drive with power cannot show, in which the last
/// command holds.
const UNLISTED_CYCLES: u8 = 5;
/// The longest time in seconds for which such words delay enabling.
const UNLISTED_S: f64 = 1.0;

/// Fresh cycles after a lost frame until the drive has the newest target and reports it.
const CATCH_UP_CYCLES: u8 = 2;

/// Rounding of a product of f64s.
const VELOCITY_TOLERANCE: f64 = 1.0 + 1e-9;

/// Rounding of a second difference of positions: of the difference, and of the positions.
const SECOND_DIFFERENCE_TOLERANCE: f64 = 2e-6;
const POSITION_EPSILON: f64 = 4.0 * f64::EPSILON;

/// Fraction of the acceleration used to plan braking at the end of the range. The rest covers
/// rounding.
const BRAKING_RESERVE: f64 = 1.0 - 1e-4;

/// The range of an axis without position limits.
const UNBOUNDED_RANGE: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

/// State of supervision while an axis is enabled.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct SupervisionState {
    pub(super) following_error: f64,
    pub(super) max_following_error: f64,
    over_velocity_cycles: u8,
    over_acceleration_cycles: u8,
    /// Time in seconds for which reported velocity and positions have contradicted each other.
    contradiction_s: f64,
    /// Time in seconds for which the torque has exceeded its limit.
    over_torque_s: f64,
    /// The last target that the drive surely has, and the consecutive fresh cycles since.
    last_received_target: Option<Counts>,
    fresh_cycles: u8,
    /// The configured range, widened to the position at enabling. So an axis outside its range can
    /// return; the range narrows again as it does.
    active_range: Option<[f64; 2]>,
}

impl SupervisionState {
    pub(super) fn starting_at(position: f64, limits: &Limits) -> Self {
        Self {
            active_range: limits
                .position
                .map(|[low, high]| [low.min(position), high.max(position)]),
            ..Self::default()
        }
    }

    /// Records a lost frame; `sent` is the target of the last answered frame.
    pub(super) fn lost(&mut self, sent: Counts) {
        if self.last_received_target.is_none() || self.fresh_cycles > 0 {
            self.last_received_target = Some(sent);
        }
        self.fresh_cycles = 0;
        self.contradiction_s = 0.0;
    }

    fn narrow(&mut self, position: f64, limits: &Limits) {
        if let (Some(range), Some([low, high])) = (&mut self.active_range, limits.position) {
            range[0] = range[0].max(low.min(position));
            range[1] = range[1].min(high.max(position));
        }
    }
}

impl Axis {
    /// Supervises fresh inputs: unrequested state changes, and values outside the limits.
    pub(super) fn supervise(&mut self) {
        let before = self.state;
        self.state = State::from_statusword(self.statusword);
        self.unfollowed_cycles = if self.follows_now() {
            0
        } else {
            self.unfollowed_cycles.saturating_add(1)
        };
        if self.state.is_fault() {
            if !before.is_fault() {
                self.fault.get_or_insert(DriveFault {
                    statusword: self.statusword.bits(),
                    code: None,
                });
                self.stop_by_fault();
                self.reset = false;
            }
            return;
        }
        if self.reset {
            self.reset = false;
            self.fault = None;
        }
        let jump = self.position_jump();
        if jump.is_some() && self.goal == PowerGoal::On {
            self.home.invalidate();
        }
        if let Some(trip) = self.check_late_mode() {
            self.trip(trip);
            return;
        }
        if !self.has_control() {
            return;
        }
        if self.state != State::OperationEnabled {
            if self.goal == PowerGoal::On || self.precedes_mode_cycle() {
                self.trip(Trip::PowerLost { state: self.state });
            }
            return;
        }
        if let Some(display) = self.mode_display
            && self.follows()
            && !self.mode_confirmed()
        {
            self.trip(Trip::ModeLost {
                expected: self.mode,
                display: Mode::from_code(display),
            });
            return;
        }
        // Also at rest: a drive that does not follow holds no load. At rest a mode switch may take
        // its time, which is limited.
        let switches = self.switch.is_some() && self.setpoint_at_rest();
        if self.follows() && !self.reported_to_follow() && !switches {
            self.trip(Trip::NotFollowing { mode: self.mode });
            return;
        }
        if let Some(trip) = jump.or_else(|| self.check_limits()) {
            self.trip(trip);
        }
    }

    /// Returns true if the drive follows in CSP, CSV or CST. Enabling requires Statusword bit 12.
    /// Afterwards the bit may be missing for a few cycles. A drive that catches up after a lost
    /// frame may limit the step and clear the bit.
    pub(super) fn reported_to_follow(&self) -> bool {
        let most = if self.follows() { FOLLOW_CYCLES } else { 1 };
        self.unfollowed_cycles < most
    }

    /// Returns Statusword bit 12 if it has this meaning in the mode that 0x6061 shows.
    pub(super) fn follows_now(&self) -> bool {
        let mode = self.mode_display.map_or(self.mode, Mode::from_code);
        match self.statusword.in_mode(mode) {
            ModeStatus::Csp { follows, .. }
            | ModeStatus::Csv { follows }
            | ModeStatus::Cst { follows } => follows || !self.config.follows_bit,
            _ => true,
        }
    }

    /// Trips the axis. The first cause remains.
    fn trip(&mut self, trip: Trip) {
        self.trip_by(trip, self.config.supervision.reaction);
    }

    pub(super) fn emergency_stop(&mut self) {
        self.trip_by(Trip::EmergencyStop, self.config.supervision.emergency);
    }

    /// Returns true for a Statusword that the drive cannot show now: one that the table does not list,
    /// or Not ready to switch on, which is left once after the start (transition 1). While an axis is
    /// being enabled, such words last at most a second: a new command would take the drive back.
    pub(super) fn is_unlisted(&self, word: u16) -> bool {
        let state = State::from_statusword(Statusword::from_bits_retain(word));
        let powered = self.state.has_power() || self.unlisted_cycles > 0;
        (powered || self.is_being_enabled() && self.unlisted_s < UNLISTED_S)
            && matches!(state, State::Unknown(_) | State::NotReadyToSwitchOn)
    }

    fn is_being_enabled(&self) -> bool {
        // The drive may have left the last listed state.
        let passing = matches!(
            self.state,
            State::SwitchOnDisabled | State::ReadyToSwitchOn | State::SwitchedOn
        );
        self.goal == PowerGoal::On && passing
    }

    /// Counts a cycle whose inputs are not believed. The last command holds for some of them; then
    /// the axis trips.
    pub(super) fn count_unlisted(&mut self, word: u16) {
        if self.is_being_enabled() {
            self.unlisted_s += self.dt_s;
            return;
        }
        // While the power is removed, the time of the stop decides.
        if matches!(self.goal, PowerGoal::Stopping(stop) if stop.removes_power()) {
            return;
        }
        self.unlisted_cycles = self.unlisted_cycles.saturating_add(1);
        if self.unlisted_cycles > UNLISTED_CYCLES && !matches!(self.state, State::Unknown(_)) {
            self.state = State::Unknown(word);
            self.statusword = Statusword::from_bits_retain(word);
            if self.goal != PowerGoal::Off {
                self.trip(Trip::UnlistedStatusword { word });
            }
        }
    }

    fn check_limits(&mut self) -> Option<Trip> {
        let limits = self.own_limits();
        let position = self.actual.position();
        let mut cause = None;
        // A motion of the drive without a set-point is not a following error.
        let unknown = self.interrupted && (self.mode != Mode::Csp || self.left_csp());
        let commands = self.follows() && !unknown;
        if self.controlled_quantity() == ControlledQuantity::Position && commands {
            let scale = &self.config.scale;
            // This set-point is already one cycle old.
            let commanded = self.expected(self.config.dead_time_s - self.dt_s);
            let position = self.actual.drive();
            self.supervision.following_error = commanded - position;
            // Lost frames took their targets with them: the axis may be anywhere between the last
            // known and the present target.
            let error = match self.supervision.last_received_target {
                None => commanded - position,
                Some(known) => {
                    let known = scale.position_to_user(known).0;
                    let nearest = position.max(commanded.min(known)).min(commanded.max(known));
                    nearest - position
                }
            };
            self.supervision.max_following_error =
                self.supervision.max_following_error.max(error.abs());
            self.supervision.fresh_cycles = self.supervision.fresh_cycles.saturating_add(1);
            if self.supervision.fresh_cycles >= CATCH_UP_CYCLES {
                self.supervision.last_received_target = None;
            }
            if let Some(limit) = limits.following_error
                && error.abs() > limit
            {
                cause = Some(Trip::FollowingError { error, limit });
            }
        } else {
            self.supervision.following_error = 0.0;
        }
        let elsewhere = self.check_second_encoder();
        // Where the load is, is known again after homing.
        if elsewhere.is_some() {
            self.home.invalidate();
        }
        cause = cause.or(elsewhere);
        if self.mode == Mode::Pp && self.profile.not_taken() {
            cause = Some(Trip::SetPointNotTaken);
        }
        // While homing, positions have no defined origin.
        if self.mode != Mode::Hm
            && self.actual.counts().is_some()
            && let Some([low, high]) = self.supervision.active_range
        {
            let margin = limits.position_margin();
            if position < low - margin || position > high + margin {
                cause = cause.or(Some(Trip::PositionLimit {
                    position,
                    low,
                    high,
                }));
            }
            self.supervision.narrow(position, &limits);
        }
        let velocity = self.actual.velocity();
        let slack = self.velocity_slack();
        // A wrong unit of 0x606C, or a drive that runs away, shows in the positions.
        let derived = self.actual.derived_velocity();
        let most = limits.velocity * OVER_VELOCITY;
        let shifts = self.mode == Mode::Hm || self.actual.counts().is_none();
        let runs = !shifts && derived.abs() > most + self.derived.slack[1];
        let fast = velocity.abs() > most + slack || runs;
        cause = cause.or_else(|| self.velocity_contradiction(shifts));
        if let Some(watch) = self.config.supervision.torque {
            let torque = self.actual.torque();
            self.supervision.over_torque_s = if torque.abs() > watch.percent {
                self.supervision.over_torque_s + self.dt_s
            } else {
                0.0
            };
            if self.supervision.over_torque_s > watch.time_s {
                cause = cause.or(Some(Trip::OverTorque {
                    torque,
                    limit: watch.percent,
                    time_s: watch.time_s,
                }));
            }
        }
        if let Some(limit) = self.config.supervision.acceleration {
            let acceleration = self.actual.acceleration();
            self.supervision.over_acceleration_cycles = if acceleration.abs() > limit {
                self.supervision.over_acceleration_cycles.saturating_add(1)
            } else {
                0
            };
            if self.supervision.over_acceleration_cycles >= OVER_VELOCITY_CYCLES {
                cause = cause.or(Some(Trip::OverAcceleration {
                    acceleration,
                    limit,
                }));
            }
        }
        self.supervision.over_velocity_cycles = if fast {
            self.supervision.over_velocity_cycles.saturating_add(1)
        } else {
            0
        };
        if self.supervision.over_velocity_cycles >= OVER_VELOCITY_CYCLES {
            let velocity = if runs { derived } else { velocity };
            cause = cause.or(Some(Trip::OverVelocity {
                velocity,
                limit: limits.velocity,
            }));
        }
        cause
    }

    /// Returns the trip for a reported position that the axis cannot have reached. Homing shifts the
    /// origin.
    fn position_jump(&self) -> Option<Trip> {
        let homes = self.other_mode() == Some(Mode::Hm) && self.next_mode_displayed();
        if self.mode == Mode::Hm || homes {
            return None;
        }
        let (step, step_s) = self.actual.step();
        let velocity = self
            .compensation
            .drive_velocity(self.config.limits.velocity);
        let time_s = step_s + (JUMP_CYCLES * self.dt_s).max(JUMP_S);
        let slack = self.config.scale.units_of_counts(JUMP_COUNTS);
        let most = velocity * OVER_VELOCITY * time_s + slack;
        (step.abs() > most).then_some(Trip::PositionJump { step, most })
    }

    /// Returns the trip for a reported velocity that contradicts the reported positions, by a factor
    /// of two or by its sign.
    fn velocity_contradiction(&mut self, shifts: bool) -> Option<Trip> {
        let reported = self.actual.filtered_velocity();
        let derived = self.actual.derived_velocity();
        let larger = reported.abs().max(derived.abs());
        let floor = (self.config.limits.velocity * CONTRADICTION_FLOOR)
            .max(self.standstill_window())
            .max(self.derived.slack[1] * 4.0);
        let agrees = reported * derived >= larger * larger * 0.5;
        let measured = self.actual.velocity_is_measured() && !shifts;
        if !measured || larger <= floor || agrees {
            self.supervision.contradiction_s = 0.0;
            return None;
        }
        self.supervision.contradiction_s += self.dt_s;
        (self.supervision.contradiction_s > CONTRADICTION_S)
            .then_some(Trip::VelocityContradiction { reported, derived })
    }

    /// Returns the error from the resolution of the velocity, user units per second.
    fn velocity_slack(&self) -> f64 {
        let [measured, derived] = self.derived.slack;
        if self.actual.velocity_is_measured() {
            measured
        } else {
            derived
        }
    }

    /// Returns true if the reported velocity is within the standstill window.
    pub(super) fn at_standstill(&self) -> bool {
        self.actual.velocity().abs() <= self.standstill_window()
    }

    pub(super) fn standstill_window(&self) -> f64 {
        let window = self.config.supervision.standstill;
        let window = window.unwrap_or(self.config.limits.velocity * 0.01);
        self.velocity_slack().max(window)
    }

    /// Returns true within 2 % of the target or within 10 motor rpm, whichever is larger. The 10
    /// rpm count at most a tenth of the velocity limit.
    pub(super) fn velocity_reached(&self, target: f64) -> bool {
        let ten_rpm = self.config.scale.units_per_turn() * 10.0 / 60.0;
        let floor = ten_rpm.min(self.config.limits.velocity * 0.1);
        let slack = self.velocity_slack();
        let window = (target.abs() * 0.02).max(floor).max(slack);
        (self.actual.velocity() - target).abs() <= window
    }

    /// Returns the lowest and highest velocity of the next cycle from which the axis can stop
    /// inside its range.
    pub(super) fn allowed_by_range(&self) -> [f64; 2] {
        let Some([low, high]) = self.config.limits.position else {
            return [f64::NEG_INFINITY, f64::INFINITY];
        };
        if self.actual.counts().is_none() {
            return [f64::NEG_INFINITY, f64::INFINITY];
        }
        let (acceleration, ahead) = if self.controlled_quantity() == ControlledQuantity::Position {
            (
                self.config.limits.acceleration * BRAKING_RESERVE,
                self.motion.position,
            )
        } else {
            // The reported position is one cycle old, and the next set-point takes effect one cycle
            // later.
            let ahead = self.actual.position() + self.motion.velocity * self.dt_s * 2.0;
            (self.config.limits.acceleration, ahead)
        };
        let up = braking_velocity((high - ahead).max(0.0), acceleration, self.dt_s);
        let down = braking_velocity((ahead - low).max(0.0), acceleration, self.dt_s);
        [-down, up]
    }

    /// Limits the set-point before the outputs, independently of the plan.
    pub(super) fn clamp_setpoint(&mut self, grip: ControlledQuantity, before: Motion, dt_s: f64) {
        let limits = self.config.limits;
        let planned = (self.motion, self.loop_state.torque);
        match grip {
            ControlledQuantity::Position => {
                let most = limits.velocity * dt_s * VELOCITY_TOLERANCE;
                let coasting = before.position + before.velocity * dt_s;
                let change = limits.acceleration * dt_s * dt_s;
                let rounded = change * SECOND_DIFFERENCE_TOLERANCE
                    + (coasting.abs() + before.position.abs()) * POSITION_EPSILON;
                // A motion taken over too near to the end of the range passes the end while
                // braking.
                let range = limits.position.filter(|_| !self.led);
                let [low, high] = range.map_or(UNBOUNDED_RANGE, |[low, high]| {
                    [
                        low.min(before.position).min(coasting + change - rounded),
                        high.max(before.position).max(coasting - change + rounded),
                    ]
                });
                let position = self.motion.position;
                if (position - before.position).abs() <= most
                    && (position - coasting).abs() <= change + rounded
                    && position >= low
                    && position <= high
                {
                    return;
                }
                // Not `clamp`: it panics if a bound is NaN.
                let least = (coasting - change - rounded).max(before.position - most);
                let most = (coasting + change + rounded).min(before.position + most);
                let position = position.max(low).min(high).max(least).min(most);
                if position != self.motion.position {
                    let velocity = if dt_s > 0.0 {
                        (position - before.position) / dt_s
                    } else {
                        before.velocity
                    };
                    self.motion = before.then(position, velocity, dt_s);
                }
            }
            ControlledQuantity::Velocity => {
                let velocity = bounded(self.motion.velocity, limits.velocity);
                self.motion.velocity = velocity;
            }
            ControlledQuantity::Drive => {}
            ControlledQuantity::Torque => {
                self.loop_state.torque = bounded(self.loop_state.torque, limits.torque)
            }
        }
        if planned != (self.motion, self.loop_state.torque) {
            self.guarded_cycles = self.guarded_cycles.saturating_add(1);
        }
    }
}
