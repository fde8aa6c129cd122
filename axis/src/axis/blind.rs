//! What happens to the set-point while frames are lost.
//!
//! A lost frame takes its targets with it, and the first one that gets through makes up for all of them in one step. So only
//! [`RIDE_THROUGH_CYCLES`] are planned blind; then the set-point waits where it is, as the drive does with the last target it
//! got.

use super::{Axis, Control, Plan};
use crate::cia402::Mode;
use crate::setpoint::{Goal, Motion, Trapezoid};

/// The drive is never further behind than these and the cycle whose loss was not known yet.
const RIDE_THROUGH_CYCLES: u32 = 2;

impl Axis {
    /// Too many lost frames in a row: nothing is planned until one gets through.
    pub(super) const fn frozen(&self) -> bool {
        self.stale_cycles > RIDE_THROUGH_CYCLES
    }

    /// Instead of an advance. The plan stays: in CSP it goes on from rest, for the drive stands at its last target; in CSV and
    /// CST it goes on from the velocity or torque that the drive has kept. What comes from outside does not go on.
    pub(super) fn freeze(&mut self) {
        if self.mode == Mode::Csp {
            self.come_to_rest();
        } else if self.grip() == Control::Position && self.motion.velocity != 0.0 {
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
            // Entered while frames were lost: the drive has the target that came with the mode, and goes there.
            self.come_to_rest();
            return;
        }
        let velocity = match self.mode {
            Mode::Csv => self.motion.velocity,
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
