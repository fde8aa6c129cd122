//! The set-point while frames are lost or late.
//!
//! A lost frame loses its targets. The next frame that arrives carries the sum of all lost steps,
//! which the drive executes at once. To bound this jump, an axis plans only [`RIDE_THROUGH_CYCLES`]
//! cycles without an answer; then its set-point waits, like a drive at its last target. When an
//! answer arrives, the set-point continues from what the drive has done meanwhile. In CSP the drive
//! stands at its last target; in every other mode it has moved on.
//!
//! A late answer proves that the targets arrive: the set-point then decelerates within its limits.
//!
//! A skipped cycle sends no frame. For the drive this equals a lost frame.

use super::stop::taken_over;
use super::{Axis, ControlledQuantity, Outputs, Plan};
use crate::cia402::Mode;
use crate::setpoint::{Goal, Hold, Motion, Ramp, Trapezoid};

/// Number of cycles planned without an answer. The drive lags by at most these cycles, plus the one
/// whose loss was not known yet.
pub(super) const RIDE_THROUGH_CYCLES: u32 = 2;

impl Axis {
    /// True after too many consecutive lost frames: the set-point waits until a frame arrives.
    pub(super) const fn setpoint_frozen(&self) -> bool {
        self.undelivered_cycles > RIDE_THROUGH_CYCLES
    }

    /// Reports `cycles` consecutive skipped cycles. Their frames were never sent; for the drive
    /// they are lost.
    ///
    /// Call it before the [`Axis::observe`] that follows, and before the pending frame is sent.
    /// Send the returned outputs in that frame instead of its previous ones. RT: O(1).
    #[must_use]
    pub fn skipped(&mut self, cycles: u32) -> Outputs {
        let heard = self.stale_cycles == 0;
        if cycles > 0 {
            self.stale_cycles = self.stale_cycles.saturating_add(cycles);
            self.undelivered_cycles = self.undelivered_cycles.saturating_add(cycles);
            self.supervision.lost(self.previous_target);
            self.actual.pass(f64::from(cycles) * self.dt_s);
        }
        if self.setpoint_frozen() {
            // Answers still expected are from before the gap.
            self.stale_answers = self.config.answers_late;
            self.revert_pending_mode();
            if self.follows() {
                if heard {
                    self.restore_last_sent();
                }
                self.freeze();
            }
        }
        self.outputs()
    }

    /// The pending target was never sent: a drive in CSP stands at the target before it.
    fn restore_last_sent(&mut self) {
        let moves = self.motion.velocity != 0.0 || !self.play_rests();
        if self.mode == Mode::Csp && !self.left_csp() && moves {
            self.sent = self.previous_target;
            self.restore_play(self.sent);
        }
    }

    /// Replaces an advance while frames are lost. The plan remains. In CSP it continues from rest,
    /// because the drive stands at its last target. In CSV and CST it continues from the velocity
    /// or torque that the drive has kept. External set-points do not continue.
    pub(super) fn freeze(&mut self) {
        if self.mode == Mode::Csp && !self.left_csp() {
            self.motion = Motion::at(self.motion.position);
            self.freeze_play();
        }
        self.interrupted = true;
        if self.plan == Plan::External {
            self.brake();
        }
        self.preload_next_mode();
    }

    /// Replaces an advance while targets arrive and answers are late. The plan remains and
    /// continues with the next answer.
    pub(super) fn slow_down(&mut self, dt_s: f64) {
        if self.plan == Plan::External {
            self.brake();
        }
        let grip = self.controlled_quantity();
        let before = self.motion;
        match grip {
            ControlledQuantity::Position | ControlledQuantity::Velocity => {
                let hold = Hold {
                    acceleration: self.config.limits.acceleration,
                };
                self.motion = hold.brake(before, dt_s);
                // From here, a plan can end the deceleration before the axis reverses.
                if self.config.jerk_limited {
                    let limits = self.config.limits.motion();
                    self.motion.acceleration = taken_over(self.motion, limits, dt_s);
                }
            }
            ControlledQuantity::Torque => {
                let ramp = Ramp {
                    target: 0.0,
                    slope: self.config.torque_slope,
                };
                self.loop_state.take_limited();
                self.loop_state.torque = ramp.advance(self.loop_state.torque, dt_s);
            }
            ControlledQuantity::Drive => {}
        }
        self.clamp_setpoint(grip, before, dt_s);
        self.take_up(before, false, dt_s);
        self.send_position(grip);
        self.close_loops(false, dt_s);
    }

    /// Adapts the motion and the plan in the first advance after an interruption.
    pub(super) fn resume_after_loss(&mut self) {
        if !core::mem::take(&mut self.interrupted)
            || self.controlled_quantity() != ControlledQuantity::Position
        {
            return;
        }
        if self.mode == Mode::Csp {
            // This includes CSP entered meanwhile: the drive has the target sent with the mode, and
            // stands there.
            self.motion = Motion::at(self.motion.position);
            self.freeze_play();
            return;
        }
        let velocity = match self.mode {
            Mode::Csv if !self.next_mode_displayed() => self.motion.velocity,
            _ => self.held_velocity(),
        };
        self.motion = self.motion_at_actual(velocity);
        self.track_play();
        self.loop_state.take_over();
        // The target may now be too near for the planned deceleration.
        let limit = self.config.limits.acceleration;
        let trapezoid = match &self.plan {
            Plan::Move(trapezoid) => *trapezoid,
            Plan::Jerk(source) => match source.request().goal {
                Goal::Position(target) => Trapezoid {
                    target,
                    velocity: source.request().limits.velocity,
                    acceleration: source.request().limits.acceleration,
                    braking: limit,
                },
                Goal::Velocity(_) => {
                    self.plan = Plan::braking(&self.config, self.mode);
                    return;
                }
            },
            _ => return,
        };
        self.plan = Plan::Move(trapezoid.taking_over(self.motion, limit, limit, self.dt_s));
    }
}
