//! What happens to the set-point while frames are lost or late.
//!
//! A lost frame takes its targets with it, and the first one that gets through makes up for all of them in one step. So only
//! [`RIDE_THROUGH_CYCLES`] are planned blind; then the set-point waits where it is, as the drive does with the last target it
//! got. When an answer comes, the set-point goes on from what the drive has done meanwhile: in CSP it stands at its last
//! target, in every other mode it moved on.
//!
//! A late answer proves that the targets arrive: the set-point then decelerates within its limits.
//!
//! A cycle that was left out sent nothing, which is the same for the drive as a lost frame.

use super::{Axis, Control, Outputs, Plan};
use crate::cia402::Mode;
use crate::setpoint::{Goal, Hold, Motion, Ramp, Trapezoid};

/// The drive is never further behind than these and the cycle whose loss was not known yet.
pub(super) const RIDE_THROUGH_CYCLES: u32 = 2;

impl Axis {
    /// Too many lost frames in a row: nothing is planned until one gets through.
    pub(super) const fn frozen(&self) -> bool {
        self.undelivered_cycles > RIDE_THROUGH_CYCLES
    }

    /// `cycles` in a row were left out: their frames never went, which for the drive are so many that were lost. To be called
    /// before the [`Axis::observe`] that follows them, and before the frame that waits is sent: with these outputs in the place of
    /// those it has. RT: O(1).
    #[must_use]
    pub fn skipped(&mut self, cycles: u32) -> Outputs {
        let heard = self.stale_cycles == 0;
        if cycles > 0 {
            self.stale_cycles = self.stale_cycles.saturating_add(cycles);
            self.undelivered_cycles = self.undelivered_cycles.saturating_add(cycles);
            self.watch.lost(self.sent_before);
            self.actual.pass(f64::from(cycles) * self.dt_s);
        }
        if self.frozen() {
            // Answers that were under way are from before.
            self.overdue = self.config.answers_late;
            self.hold_back();
            if self.active {
                if heard {
                    self.take_back();
                }
                self.freeze();
            }
        }
        self.outputs()
    }

    /// The target that waits never went: a drive in CSP stands at the one before.
    fn take_back(&mut self) {
        if self.mode == Mode::Csp && !self.left_csp() && self.motion.velocity != 0.0 {
            self.sent = self.sent_before;
            self.motion.position = self.config.scale.position_to_user(self.sent).0;
        }
    }

    /// Instead of an advance. The plan stays: in CSP it goes on from rest, for the drive stands at its last target; in CSV and
    /// CST it goes on from the velocity or torque that the drive has kept. What comes from outside does not go on.
    pub(super) fn freeze(&mut self) {
        if self.mode == Mode::Csp && !self.left_csp() {
            self.motion = Motion::at(self.motion.position);
        }
        self.interrupted = true;
        if self.plan == Plan::Fed {
            self.brake();
        }
        self.shadow();
    }

    /// Instead of an advance, where targets arrive and answers do not come in time. The plan stays and goes on with the
    /// next answer.
    pub(super) fn slow_down(&mut self, dt_s: f64) {
        if self.plan == Plan::Fed {
            self.brake();
        }
        let grip = self.grip();
        let before = self.motion;
        match grip {
            Control::Position | Control::Velocity => {
                let hold = Hold {
                    acceleration: self.config.limits.acceleration,
                };
                self.motion = hold.advance(before, dt_s);
            }
            Control::Torque => {
                let ramp = Ramp {
                    target: 0.0,
                    slope: self.config.torque_slope,
                };
                self.given.torque = ramp.advance(self.given.torque, dt_s);
            }
            Control::Drive => {}
        }
        self.guard(grip, before, dt_s);
        self.send_position(grip);
        self.close_loops(false, dt_s);
    }

    /// The first advance after an interruption.
    pub(super) fn go_on(&mut self) {
        if !core::mem::take(&mut self.interrupted) || self.grip() != Control::Position {
            return;
        }
        if self.mode == Mode::Csp {
            // Also where it was entered meanwhile: the drive has the target that came with the mode, and stands there.
            self.motion = Motion::at(self.motion.position);
            return;
        }
        let velocity = match self.mode {
            Mode::Csv if !self.shows_next() => self.motion.velocity,
            _ => self.drift(),
        };
        self.motion = self.tracked(velocity);
        self.given.take_over();
        // It may be nearer to its target now than it could brake gently.
        let limit = self.config.limits.acceleration;
        let trapezoid = match &self.plan {
            Plan::Move(trapezoid) => *trapezoid,
            Plan::Jerk(source) => match source.order().goal {
                Goal::Position(target) => Trapezoid {
                    target,
                    velocity: source.order().limits.velocity,
                    acceleration: source.order().limits.acceleration,
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
