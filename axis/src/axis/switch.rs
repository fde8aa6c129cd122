//! From one mode to another: 0x6060 is written, 0x6061 awaited.
//!
//! The drive changes over somewhere between the frame that carries the new mode and the one that shows it. So from the first
//! to the last of these cycles the targets of both modes are valid, made from the one set-point, and the law in force is
//! that of the mode that the drive shows.
//!
//! While frames are lost, it is not known whether the drive has changed over. A drive that turns meanwhile must not find
//! itself in CSP with a target from before: until an answer has come to a frame that asked for CSP, the mode before is asked
//! for again. A drive that was asked for both in turn may show either for some cycles.

use super::supervise::Watch;
use super::{Axis, Plan};
use crate::cia402::{Mode, State};
use crate::profile::{Goal, Profile};
use crate::setpoint::Ramp;
use crate::units::UserUnits;

/// A drive that was asked for both modes in turn is in the new one after so many fresh cycles that show it.
const CERTAIN_CYCLES: u8 = 10;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Switch {
    from: Mode,
    pub(super) to: Mode,
    /// Without the new mode, though it was asked for.
    elapsed_s: f64,
    /// Cycles in a row whose outputs ask for the new mode.
    asked: u8,
    /// The drive has answered a frame that did.
    reached: bool,
    /// Fresh cycles in a row that have shown the new mode, and how many it takes.
    shown: u8,
    certain: u8,
}

impl Axis {
    /// 0x6061 shows the mode that counts or the other one of a switch, or is not mapped.
    pub(super) fn mode_confirmed(&self) -> bool {
        self.mode_display.is_none() || self.shows(self.mode) || self.shows_next()
    }

    fn shows(&self, mode: Mode) -> bool {
        self.mode_display == Some(mode.code())
    }

    /// While modes are switched: the one whose law is not in force, whose targets are valid as well.
    pub(super) fn other_mode(&self) -> Option<Mode> {
        let switch = self.switch?;
        Some(if self.mode == switch.to {
            switch.from
        } else {
            switch.to
        })
    }

    pub(super) fn begin_switch(&mut self, to: Mode) {
        if self.config.control(to) == super::Control::Position
            && self.grip() == super::Control::Velocity
        {
            // Where the axis is in the next cycle is where the position set-point begins.
            self.interrupted = true;
        }
        self.switch = Some(Switch {
            from: self.mode,
            to,
            elapsed_s: 0.0,
            asked: 0,
            reached: false,
            shown: 0,
            certain: 1,
        });
        self.switch_failed = None;
    }

    /// [`Axis::begin_switch`] in a cycle whose [`Axis::settle_mode`] is over.
    pub(super) fn begin_switch_late(&mut self, to: Mode) {
        self.begin_switch(to);
        if let Some(switch) = &mut self.switch {
            switch.asked = 1;
        }
    }

    /// Once a cycle.
    pub(super) fn settle_mode(&mut self, fresh: bool, dt_s: f64) {
        self.hold_back();
        let Some(mut switch) = self.switch else {
            return;
        };
        let shows = self.shows(switch.to);
        if fresh {
            // No frame has asked for the mode before since the one that is answered.
            let answered = switch.asked > self.config.answers_late;
            switch.reached |= answered;
            switch.shown = if shows && self.follows_now() {
                switch.shown + 1
            } else {
                0
            };
            if shows && answered && self.mode != switch.to {
                self.change_law(switch.to);
            } else if self.shows(switch.from) && self.mode != switch.from {
                self.change_law(switch.from);
            }
            if switch.shown >= switch.certain && self.mode == switch.to {
                self.switch = None;
                return;
            }
        }
        if !self.is_held_back(&switch) {
            switch.asked = switch.asked.saturating_add(1);
            if !shows {
                switch.elapsed_s += dt_s;
            }
        }
        self.switch = Some(switch);
        if switch.elapsed_s > self.config.mode_time_s {
            if self.mode != switch.from {
                self.change_law(switch.from);
            }
            self.switch = None;
            self.switch_failed = Some(switch.to);
        }
    }

    /// Too many frames in a row were lost, and the drive may turn in the mode before. After homing it stands, and bit 4 might
    /// start another.
    fn is_held_back(&self, switch: &Switch) -> bool {
        self.frozen()
            && !switch.reached
            && switch.to == Mode::Csp
            && !matches!(self.mode, Mode::Hm | Mode::Csp)
    }

    pub(super) fn hold_back(&mut self) {
        if let Some(mut switch) = self.switch
            && self.is_held_back(&switch)
        {
            // What is answered next was asked for the mode before.
            (switch.asked, switch.certain) = (0, CERTAIN_CYCLES);
            self.switch = Some(switch);
        }
    }

    /// CSP was left: the drive keeps what it has got of the new mode, and does not stand at its last target.
    pub(super) fn left_csp(&self) -> bool {
        self.switch
            .is_some_and(|switch| switch.reached && switch.to != Mode::Csp)
    }

    /// The drive shows the other mode of a switch.
    pub(super) fn shows_next(&self) -> bool {
        self.other_mode().is_some_and(|mode| self.shows(mode))
    }

    /// 0x6060.
    pub(super) fn mode_asked(&self) -> Mode {
        let switch = self.switch.filter(|switch| !self.is_held_back(switch));
        switch.map_or(self.mode, |switch| switch.to)
    }

    /// The drive is in this mode: from now on its law counts.
    fn change_law(&mut self, to: Mode) {
        let from = self.mode;
        self.mode = to;
        self.given.enter();
        if to == Mode::Csp {
            // That was its target already.
            let position = UserUnits(self.motion.position);
            self.sent = self.config.scale.position_to_counts(position);
        }
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
