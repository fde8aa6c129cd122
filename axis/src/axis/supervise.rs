//! Judging what the drive reports, and the last guard before the outputs.

use super::stop::PowerGoal;
use super::{Axis, Control};
use crate::cia402::{Mode, ModeStatus, State};
use crate::limits::Limits;
use crate::loops::bounded;
use crate::setpoint::{Motion, braking_velocity};
use crate::status::{DriveFault, Trip};
use crate::units::Counts;

/// How much faster than the limit, and for how many fresh cycles in a row.
const OVER_VELOCITY: f64 = 1.2;
const OVER_VELOCITY_CYCLES: u8 = 5;

/// Fresh cycles in a row without Statusword bit 12 after which an axis has lost control of its drive.
const FOLLOW_CYCLES: u8 = 10;

/// Fresh cycles after a lost frame until the drive has the newest target and its report shows it.
const CATCH_UP_CYCLES: u8 = 2;

/// Rounding of a product of f64s.
const ROUNDING: f64 = 1.0 + 1e-9;

/// Rounding of a second difference of positions: of the difference, and of the positions.
const LOOSE: f64 = 2e-6;
const ROUNDED: f64 = 4.0 * f64::EPSILON;

/// Braking for the end of the range is planned with this part of the acceleration, so that rounding cannot add up.
const PLANNED: f64 = 1.0 - 1e-4;

/// Where there is no range.
const EVERYWHERE: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

/// What supervision remembers while an axis is enabled.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Watch {
    pub(super) following_error: f64,
    pub(super) max_following_error: f64,
    fast_cycles: u8,
    steep_cycles: u8,
    /// For so long the torque has been above what is supervised.
    strained_s: f64,
    /// The last target the drive surely has, and for how many fresh cycles in a row it has got newer ones.
    known: Option<Counts>,
    fresh_cycles: u8,
    /// The configured range, widened to where the axis stood when it was enabled, so that an axis outside its range can be
    /// driven back; narrowed again as it comes back.
    range: Option<[f64; 2]>,
}

impl Watch {
    pub(super) fn starting_at(position: f64, limits: &Limits) -> Self {
        Self {
            range: limits
                .position
                .map(|[low, high]| [low.min(position), high.max(position)]),
            ..Self::default()
        }
    }

    /// A frame was lost; `sent` is the target of the last one that came back.
    pub(super) fn lost(&mut self, sent: Counts) {
        if self.known.is_none() || self.fresh_cycles > 0 {
            self.known = Some(sent);
        }
        self.fresh_cycles = 0;
    }

    fn narrow(&mut self, position: f64, limits: &Limits) {
        if let (Some(range), Some([low, high])) = (&mut self.range, limits.position) {
            range[0] = range[0].max(low.min(position));
            range[1] = range[1].min(high.max(position));
        }
    }
}

impl Axis {
    /// Fresh inputs only: state changes nobody asked for, and values outside the limits.
    pub(super) fn judge(&mut self) {
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
        if !self.active {
            return;
        }
        if self.state != State::OperationEnabled {
            if self.goal == PowerGoal::On {
                self.trip(Trip::PowerLost { state: self.state });
            }
            return;
        }
        if let Some(display) = self.mode_display
            && !self.mode_confirmed()
        {
            self.trip(Trip::ModeLost {
                expected: self.mode,
                display: Mode::from_code(display),
            });
            return;
        }
        // Targets follow actual values again where the axis stands; in motion it is a loss of control.
        if !self.reported_to_follow() && !self.setpoint_at_rest() {
            self.trip(Trip::NotFollowing { mode: self.mode });
            return;
        }
        if let Some(trip) = self.exceeded() {
            self.trip(trip);
        }
    }

    /// CSP, CSV and CST: an axis is enabled with Statusword bit 12, and keeps its set-points while it is missing for a few
    /// cycles: a drive that catches up after a lost frame may limit the step, and clears it meanwhile.
    pub(super) fn reported_to_follow(&self) -> bool {
        let most = if self.active { FOLLOW_CYCLES } else { 1 };
        self.unfollowed_cycles < most
    }

    /// Statusword bit 12 where it says this. While modes are switched it is the new mode's once that shows.
    pub(super) fn follows_now(&self) -> bool {
        let mode = self.mode_display.map_or(self.mode, Mode::from_code);
        match self.statusword.in_mode(mode) {
            ModeStatus::Csp { follows, .. }
            | ModeStatus::Csv { follows }
            | ModeStatus::Cst { follows } => follows || !self.config.follows_bit,
            _ => true,
        }
    }

    /// The first cause stays.
    fn trip(&mut self, trip: Trip) {
        self.trip.get_or_insert(trip);
        self.stop_by(self.config.supervision.reaction);
    }

    pub(super) fn emergency_stop(&mut self) {
        self.trip.get_or_insert(Trip::EmergencyStop);
        self.stop_by(self.config.supervision.emergency);
    }

    fn exceeded(&mut self) -> Option<Trip> {
        let limits = self.config.limits;
        let position = self.actual.position();
        let mut cause = None;
        // What the drive did without a set-point is no deviation from one.
        let unknown = self.interrupted && (self.mode != Mode::Csp || self.left_csp());
        if self.grip() == Control::Position && !unknown {
            let scale = &self.config.scale;
            // The set-point here is a cycle old already.
            let commanded = self.expected(self.config.dead_time_s - self.dt_s);
            self.watch.following_error = commanded - position;
            // Frames that were lost took targets with them: then the axis may be anywhere on the way between.
            let error = match self.watch.known {
                None => commanded - position,
                Some(known) => {
                    let known = scale.position_to_user(known).0;
                    let nearest = position.max(commanded.min(known)).min(commanded.max(known));
                    nearest - position
                }
            };
            self.watch.max_following_error = self.watch.max_following_error.max(error.abs());
            self.watch.fresh_cycles = self.watch.fresh_cycles.saturating_add(1);
            if self.watch.fresh_cycles >= CATCH_UP_CYCLES {
                self.watch.known = None;
            }
            if let Some(limit) = limits.following_error
                && error.abs() > limit
            {
                cause = Some(Trip::FollowingError { error, limit });
            }
        } else {
            self.watch.following_error = 0.0;
        }
        if self.mode == Mode::Pp && self.profile.not_taken() {
            cause = Some(Trip::SetPointNotTaken);
        }
        // While homing, positions mean nothing yet.
        if self.mode != Mode::Hm
            && self.actual.counts().is_some()
            && let Some([low, high]) = self.watch.range
        {
            let margin = limits.position_margin();
            if position < low - margin || position > high + margin {
                cause = cause.or(Some(Trip::PositionLimit {
                    position,
                    low,
                    high,
                }));
            }
            self.watch.narrow(position, &limits);
        }
        let velocity = self.actual.velocity();
        let slack = self.velocity_slack();
        let fast = velocity.abs() > limits.velocity * OVER_VELOCITY + slack;
        if let Some(watch) = self.config.supervision.torque {
            let torque = self.actual.torque();
            self.watch.strained_s = if torque.abs() > watch.percent {
                self.watch.strained_s + self.dt_s
            } else {
                0.0
            };
            if self.watch.strained_s > watch.time_s {
                cause = cause.or(Some(Trip::OverTorque {
                    torque,
                    limit: watch.percent,
                    time_s: watch.time_s,
                }));
            }
        }
        if let Some(limit) = self.config.supervision.acceleration {
            let acceleration = self.actual.acceleration();
            self.watch.steep_cycles = if acceleration.abs() > limit {
                self.watch.steep_cycles.saturating_add(1)
            } else {
                0
            };
            if self.watch.steep_cycles >= OVER_VELOCITY_CYCLES {
                cause = cause.or(Some(Trip::OverAcceleration {
                    acceleration,
                    limit,
                }));
            }
        }
        self.watch.fast_cycles = if fast {
            self.watch.fast_cycles.saturating_add(1)
        } else {
            0
        };
        if self.watch.fast_cycles >= OVER_VELOCITY_CYCLES {
            cause = cause.or(Some(Trip::OverVelocity {
                velocity,
                limit: limits.velocity,
            }));
        }
        cause
    }

    /// What the last digit of the velocity may be wrong by, user units per second.
    fn velocity_slack(&self) -> f64 {
        let [measured, derived] = self.fixed.slack;
        if self.actual.velocity_is_measured() {
            measured
        } else {
            derived
        }
    }

    /// The drive itself stands, as far as it can be told.
    pub(super) fn standing(&self) -> bool {
        self.actual.velocity().abs() <= self.standstill_window()
    }

    pub(super) fn standstill_window(&self) -> f64 {
        let window = self.config.supervision.standstill;
        let window = window.unwrap_or(self.config.limits.velocity * 0.01);
        self.velocity_slack().max(window)
    }

    /// Within 2 % of the target or 10 motor rpm of it, whichever is more; the latter never above a tenth of the limit.
    pub(super) fn velocity_reached(&self, target: f64) -> bool {
        let ten_rpm = self.config.scale.units_per_turn() * 10.0 / 60.0;
        let floor = ten_rpm.min(self.config.limits.velocity * 0.1);
        let slack = self.velocity_slack();
        let window = (target.abs() * 0.02).max(floor).max(slack);
        (self.actual.velocity() - target).abs() <= window
    }

    /// Lowest and highest velocity of the coming cycle from which the axis can still stop inside its range.
    pub(super) fn allowed_by_range(&self) -> [f64; 2] {
        let Some([low, high]) = self.config.limits.position else {
            return [f64::NEG_INFINITY, f64::INFINITY];
        };
        if self.actual.counts().is_none() {
            return [f64::NEG_INFINITY, f64::INFINITY];
        }
        let (acceleration, ahead) = if self.grip() == Control::Position {
            (
                self.config.limits.acceleration * PLANNED,
                self.motion.position,
            )
        } else {
            // The reported position is a cycle old, and the next set-point takes another one to act.
            let ahead = self.actual.position() + self.motion.velocity * self.dt_s * 2.0;
            (self.config.limits.acceleration, ahead)
        };
        let up = braking_velocity((high - ahead).max(0.0), acceleration, self.dt_s);
        let down = braking_velocity((ahead - low).max(0.0), acceleration, self.dt_s);
        [-down, up]
    }

    /// The last thing before the outputs: whatever was planned, nothing exceeds the limits.
    pub(super) fn guard(&mut self, grip: Control, before: Motion, dt_s: f64) {
        let limits = self.config.limits;
        let planned = (self.motion, self.given.torque);
        match grip {
            Control::Position => {
                let most = limits.velocity * dt_s * ROUNDING;
                let coasting = before.position + before.velocity * dt_s;
                let change = limits.acceleration * dt_s * dt_s;
                let rounded = change * LOOSE + (coasting.abs() + before.position.abs()) * ROUNDED;
                // A motion that was taken over too near to an end of the range passes it braking.
                let [low, high] = limits.position.map_or(EVERYWHERE, |[low, high]| {
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
                // Not `clamp`: it panics on bounds that are not numbers.
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
            Control::Velocity => {
                let velocity = bounded(self.motion.velocity, limits.velocity);
                self.motion.velocity = velocity;
            }
            Control::Drive => {}
            Control::Torque => self.given.torque = bounded(self.given.torque, limits.torque),
        }
        if planned != (self.motion, self.given.torque) {
            self.guarded_cycles = self.guarded_cycles.saturating_add(1);
        }
    }
}
