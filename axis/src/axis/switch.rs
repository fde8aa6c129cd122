//! From one mode to another: 0x6060 is written, 0x6061 awaited.
//!
//! The drive changes over somewhere between the frame that carries the new mode and the one that shows it. So from the first
//! to the last of these cycles the targets of both modes are valid, made from the one set-point.

use super::supervise::Watch;
use super::{Axis, Control, Plan};
use crate::cia402::{Mode, State};
use crate::profile::{Goal, Profile};
use crate::setpoint::Ramp;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Switch {
    pub(super) to: Mode,
    elapsed_s: f64,
}

impl Axis {
    /// 0x6061 shows the mode that counts or the one on its way, or is not mapped.
    pub(super) fn mode_confirmed(&self) -> bool {
        match self.mode_display {
            None => true,
            Some(display) if display == self.mode.code() => true,
            Some(display) => self
                .switch
                .is_some_and(|switch| display == switch.to.code()),
        }
    }

    pub(super) fn begin_switch(&mut self, to: Mode) {
        if self.grip() == Control::Velocity && self.config.control(to) == Control::Position {
            // Where the axis is now is where the position set-point begins.
            self.motion.position = self.tracked(self.motion.velocity).position;
        }
        self.switch = Some(Switch { to, elapsed_s: 0.0 });
        self.switch_failed = None;
    }

    /// Once a cycle.
    pub(super) fn settle_mode(&mut self, fresh: bool, dt_s: f64) {
        let Some(switch) = &mut self.switch else {
            return;
        };
        let to = switch.to;
        if fresh && self.mode_display == Some(to.code()) {
            self.enter(to);
            return;
        }
        switch.elapsed_s += dt_s;
        if switch.elapsed_s > self.config.mode_time_s {
            self.switch = None;
            self.switch_failed = Some(to);
        }
    }

    /// The drive is in the new mode: from now on its law counts alone.
    fn enter(&mut self, to: Mode) {
        let from = self.mode;
        self.mode = to;
        self.switch = None;
        self.given.enter();
        if to != Mode::Cst {
            self.given.torque = 0.0;
        }
        if from == Mode::Hm {
            self.watch = Watch::starting_at(self.actual.position(), &self.config.limits);
        }
        self.hand_over(from);
        if !self.plan.fits(self.config.control(to)) {
            self.plan = Plan::braking(&self.config, to);
        }
    }

    /// A velocity under way goes on, whether it is the drive's profile or ours.
    fn hand_over(&mut self, from: Mode) {
        let goal = match (from, self.profile.goal(), self.plan) {
            (Mode::Pv, Some(&goal), _) => goal,
            (_, _, Plan::Velocity(ramp)) => Goal {
                target: ramp.target,
                velocity: self.config.limits.velocity,
                acceleration: ramp.slope,
            },
            _ => Goal {
                target: 0.0,
                velocity: self.config.limits.velocity,
                acceleration: self.config.limits.acceleration,
            },
        };
        self.profile = Profile::new();
        if self.mode == Mode::Pv {
            self.profile.run_at(goal);
        } else if from == Mode::Pv && goal.target != 0.0 {
            self.plan = Plan::Velocity(Ramp {
                target: goal.target,
                slope: goal.acceleration,
            });
        }
    }

    /// Power went while modes were being switched: there is no motion to take over.
    pub(super) fn end_switch(&mut self) {
        if let Some(switch) = self.switch.take()
            && self.state != State::OperationEnabled
        {
            self.mode = switch.to;
        }
    }
}
