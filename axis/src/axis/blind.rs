//! What happens to the set-point while frames are lost.
//!
//! A lost frame takes its targets with it, and the first one that gets through makes up for all of them in one step. So only
//! [`RIDE_THROUGH_CYCLES`] are planned blind; then the set-point waits where it is, as the drive does with the last target it
//! got.
//!
//! A cycle that was left out sent nothing, which is the same for the drive.

use super::{Axis, Control, Outputs, Plan};
use crate::cia402::Mode;
use crate::setpoint::{Goal, Motion, Trapezoid};

/// The drive is never further behind than these and the cycle whose loss was not known yet.
const RIDE_THROUGH_CYCLES: u32 = 2;

impl Axis {
    /// Too many lost frames in a row: nothing is planned until one gets through.
    pub(super) const fn frozen(&self) -> bool {
        self.stale_cycles > RIDE_THROUGH_CYCLES
    }

    /// `cycles` in a row were left out: their frames never went, which for the drive are so many that were lost. To be called
    /// before the [`Axis::observe`] that follows them, and before the frame that waits is sent: with these outputs in the place of
    /// those it has. RT: O(1).
    #[must_use]
    pub fn skipped(&mut self, cycles: u32) -> Outputs {
        let heard = self.stale_cycles == 0;
        if cycles > 0 {
            self.stale_cycles = self.stale_cycles.saturating_add(cycles);
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
            self.come_to_rest();
        } else if self.motion.velocity != 0.0 {
            self.regain = true;
        }
        if self.plan == Plan::Fed {
            self.brake();
        }
        self.shadow();
    }

    /// The set-point, where it is.
    fn come_to_rest(&mut self) {
        self.cut_short |= self.motion.velocity != 0.0;
        self.motion = Motion::at(self.motion.position);
    }

    /// The first advance after a freeze in which the drive moved on without a set-point.
    pub(super) fn go_on(&mut self) {
        if !core::mem::take(&mut self.regain) || self.grip() != Control::Position {
            return;
        }
        if self.mode == Mode::Csp {
            // Entered while frames were lost: the drive has the target that came with the mode, and goes there. Or asked to leave
            // it, and still there.
            self.come_to_rest();
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
