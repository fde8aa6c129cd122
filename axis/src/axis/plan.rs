//! Where the set-point goes.

use super::{Axis, AxisConfig, Control};
use crate::cia402::{Mode, ModeStatus};
use crate::loops::bounded;
use crate::setpoint::{
    Goal, Hold, JerkLimited, Motion, MotionLimits, Order, Ramp, Setpoint, SetpointError, Trapezoid,
};
use crate::units::UserUnits;

#[derive(Debug, Clone, Copy, PartialEq)]
#[allow(
    clippy::large_enum_variant,
    reason = "nothing is allocated in the cycle, and a plan is copied only where a command makes it"
)]
pub(super) enum Plan {
    Hold(Hold),
    Move(Trapezoid),
    Jerk(JerkLimited),
    Velocity(Ramp),
    Torque(Ramp),
    /// The drive's own profile, or homing.
    Drive,
    /// From outside, anew in every cycle; a cycle without one ends it.
    Fed,
}

impl Plan {
    /// To rest, in the way of a mode.
    pub(super) fn braking(config: &AxisConfig, mode: Mode) -> Self {
        let slope = config.limits.acceleration;
        match config.control(mode) {
            Control::Position => Self::Hold(Hold {
                acceleration: slope,
            }),
            Control::Velocity => Self::Velocity(Ramp { target: 0.0, slope }),
            Control::Drive => Self::Drive,
            Control::Torque => Self::Torque(Ramp {
                target: 0.0,
                slope: config.torque_slope,
            }),
        }
    }

    /// Can a mode of this kind carry it out?
    pub(super) fn fits(&self, control: Control) -> bool {
        match self {
            Self::Hold(_) | Self::Move(_) | Self::Jerk(_) | Self::Fed => {
                control == Control::Position
            }
            Self::Velocity(_) => matches!(control, Control::Position | Control::Velocity),
            Self::Torque(_) | Self::Drive => false,
        }
    }
}

impl Axis {
    /// What is commanded now: a mode with a position loop takes a torque, too, and while modes are switched the position is
    /// commanded already if the new one needs it.
    pub(super) fn grip(&self) -> Control {
        match self.plan {
            Plan::Torque(_) => return Control::Torque,
            Plan::Drive => return Control::Drive,
            _ => {}
        }
        let now = self.config.control(self.mode);
        let next = self.switch.map(|switch| self.config.control(switch.to));
        if next == Some(Control::Position) {
            Control::Position
        } else {
            now
        }
    }

    /// The velocity that the axis turns out to have; noise is none.
    pub(super) fn drift(&self) -> f64 {
        if self.standing() {
            0.0
        } else {
            self.actual.velocity()
        }
    }

    /// The set-point of the cycle before, had it been what the axis does: by what it reports and the dead time, at
    /// `velocity`. To be advanced from.
    pub(super) fn tracked(&self, velocity: f64) -> Motion {
        let velocity = bounded(velocity, self.config.limits.velocity);
        // What is reported now shows the set-point of this cycle after the dead time.
        let late_s = self.config.dead_time_s - self.dt_s;
        Motion {
            position: self.actual.position() + velocity * late_s,
            velocity,
            acceleration: 0.0,
        }
    }

    /// The set-point of this cycle, where it is what the axis does.
    fn following(&self) -> Motion {
        let before = self.tracked(self.drift());
        Motion {
            position: before.position + before.velocity * self.dt_s,
            ..before
        }
    }

    /// The motion where none is commanded: as it turns out. A mode that is being switched to will take it over.
    fn uncommanded(&self) -> Motion {
        if self.switch.is_some() {
            self.following()
        } else {
            Motion::at(self.actual.position())
        }
    }

    /// Before a position or velocity is commanded where a torque was: from what the axis does, with the torque it has.
    pub(super) fn engage(&mut self) {
        if self.active && self.grip() == Control::Torque {
            self.motion = self.tracked(self.drift());
            self.given.take_over();
        }
    }

    /// A plan of bounded jerk from here; `part` of the acceleration and the jerk are used unless that would lead too far.
    pub(super) fn jerk_limited(
        &self,
        goal: Goal,
        velocity: f64,
        part: f64,
    ) -> Result<JerkLimited, SetpointError> {
        let limits = &self.config.limits;
        let motion = if self.grip() == Control::Torque {
            self.tracked(self.drift())
        } else {
            self.motion
        };
        let ceiling = MotionLimits {
            velocity: limits.velocity,
            acceleration: limits.acceleration,
            jerk: limits.jerk(),
        };
        let order = Order {
            goal,
            limits: MotionLimits {
                velocity,
                acceleration: ceiling.acceleration * part,
                jerk: ceiling.jerk * part,
            },
            ceiling,
            range: limits
                .position
                .map(|[low, high]| [low.min(motion.position), high.max(motion.position)]),
        };
        match self.plan {
            Plan::Jerk(ref source) => source.redirect(order, motion, self.dt_s),
            _ => JerkLimited::new(order, motion, self.dt_s),
        }
    }

    /// To rest, from whatever is going on.
    pub(super) fn brake(&mut self) {
        self.home.abort();
        let braking = Plan::braking(&self.config, self.mode);
        if braking == Plan::Drive {
            self.profile.halt();
        }
        if !matches!(braking, Plan::Torque(_) | Plan::Drive) {
            self.engage();
        }
        self.plan = braking;
    }

    /// RT: O(1).
    pub(super) fn advance(&mut self, fresh: bool, dt_s: f64) {
        self.go_on();
        let before = self.motion;
        let grip = self.grip();
        self.held_by_range &= matches!(self.plan, Plan::Velocity(_) | Plan::Drive);
        match self.plan {
            // The new mode shows, and the drive does not follow in it yet.
            _ if grip == Control::Position && self.switch.is_some() && !self.follows_now() => {
                self.motion = self.following();
            }
            Plan::Hold(hold) => self.motion = hold.advance(before, dt_s),
            Plan::Jerk(ref mut source) => self.motion = source.advance(before, dt_s),
            Plan::Move(trapezoid) => self.motion = trapezoid.advance(before, dt_s),
            Plan::Velocity(ramp) => self.motion = self.run(ramp, before, dt_s),
            Plan::Torque(ramp) => {
                self.given.torque = ramp.advance(self.given.torque, dt_s);
                self.motion = self.uncommanded();
            }
            Plan::Drive => {
                if fresh
                    && let ModeStatus::Pp {
                        target_reached,
                        acknowledged,
                        ..
                    } = self.statusword.in_mode(self.mode)
                {
                    self.profile.step(acknowledged, target_reached, dt_s);
                }
                if fresh {
                    self.halt_inside_range();
                }
                self.motion = self.uncommanded();
            }
            Plan::Fed => match self.fed {
                Some(motion) => self.motion = motion,
                None => {
                    let hold = Hold {
                        acceleration: self.config.limits.acceleration,
                    };
                    self.plan = Plan::Hold(hold);
                    self.motion = hold.advance(before, dt_s);
                }
            },
        }
        self.guard(grip, before, dt_s);
        self.send_position(grip);
    }

    /// The set-point's position as the drive gets it; the actual one where no position is commanded.
    pub(super) fn send_position(&mut self, grip: Control) {
        self.sent = if grip == Control::Position {
            let position = UserUnits(self.motion.position);
            self.config.scale.position_to_counts(position)
        } else {
            self.actual.counts().unwrap_or_default()
        };
        if grip == Control::Velocity {
            self.motion.position = self.config.scale.position_to_user(self.sent).0;
        }
    }

    /// PV: a velocity that leads out of the range is halted where the drive can still stop inside it.
    fn halt_inside_range(&mut self) {
        let (Mode::Pv, Some(goal), Some([low, high])) =
            (self.mode, self.profile.goal(), self.config.limits.position)
        else {
            return;
        };
        let velocity = self.actual.velocity();
        let late_s = self.config.dead_time_s + 2.0 * self.dt_s;
        // A halt brakes with the limit, which is then in 0x6084.
        let braking = 2.0 * self.config.limits.acceleration;
        let way = velocity * (velocity.abs() / braking + late_s);
        let end = self.actual.position() + way;
        let outwards = goal.target > 0.0 && end >= high || goal.target < 0.0 && end <= low;
        if outwards && self.actual.counts().is_some() {
            self.profile.halt();
        }
        self.held_by_range = outwards;
    }

    fn run(&mut self, ramp: Ramp, before: Motion, dt_s: f64) -> Motion {
        let [lowest, highest] = self.allowed_by_range();
        let asked = ramp.advance(before.velocity, dt_s);
        // Braking for the end of the range may be steeper than the ramp that was asked for.
        let wanted = asked.min(highest).max(lowest);
        self.held_by_range = wanted != asked || ramp.target > highest || ramp.target < lowest;
        let steepest = Ramp {
            target: wanted,
            slope: self.config.limits.acceleration,
        };
        let velocity = steepest.advance(before.velocity, dt_s);
        before.then(before.position + velocity * dt_s, velocity, dt_s)
    }

    /// The drive's profile has come to its end, as far as it can be told.
    fn profile_arrived(&self) -> bool {
        match (self.mode, self.profile.goal()) {
            (Mode::Pp, Some(_)) => !self.profile.pending(),
            (Mode::Pp, None) if self.profile.pending() => false,
            (Mode::Pv, Some(goal)) => self.velocity_reached(goal.target),
            _ => !self.home.running() && self.standing(),
        }
    }

    pub(super) fn setpoint_at_rest(&self) -> bool {
        match self.plan {
            Plan::Torque(_) => self.given.torque == 0.0,
            Plan::Drive => !self.home.running() && self.standing(),
            _ => self.motion.velocity == 0.0,
        }
    }

    /// The set-point has nowhere left to go.
    pub(super) fn setpoint_arrived(&self) -> bool {
        match self.plan {
            Plan::Hold(hold) => hold.finished(self.motion),
            Plan::Move(trapezoid) => trapezoid.finished(self.motion),
            Plan::Jerk(ref source) => source.finished(self.motion),
            Plan::Velocity(ramp) => self.motion.velocity == ramp.target,
            Plan::Torque(ramp) => self.given.torque == ramp.target,
            Plan::Drive => self.profile_arrived(),
            Plan::Fed => self.motion.velocity == 0.0,
        }
    }
}
