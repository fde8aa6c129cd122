//! From one mode to another: 0x6060 is written, 0x6061 awaited.
//!
//! The drive changes over somewhere between the frame that carries the new mode and the one that shows it. So from the first
//! to the last of these cycles the targets of both modes are valid, made from the one set-point.
//!
//! While frames are lost nobody knows whether it has. A drive that turns meanwhile must not find itself in CSP with a target
//! from before: until an answer has come to a frame that asked for CSP, the mode before is asked for again. The other way the
//! drive stands at its last target, or already has the velocity that is still being sent.

use super::supervise::Watch;
use super::{Axis, Control, Plan};
use crate::cia402::{Mode, State};
use crate::profile::{Goal, Profile};
use crate::setpoint::Ramp;
use crate::units::UserUnits;

/// A drive that was asked for one mode and the other in turn, and does not change over at once, is in the new one after so
/// many fresh cycles that show it.
const CERTAIN_CYCLES: u8 = 10;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Switch {
    pub(super) to: Mode,
    /// Without the new mode, though it was asked for.
    elapsed_s: f64,
    /// Cycles in a row whose outputs ask for the new mode.
    asked: u8,
    /// The drive has answered a frame that did.
    pub(super) reached: bool,
    /// Frames are being lost: the mode before is asked for.
    pub(super) held_back: bool,
    /// Fresh cycles in a row that have shown the new mode, and how many it takes.
    shown: u8,
    certain: u8,
}

impl Switch {
    const fn new(to: Mode) -> Self {
        Self {
            to,
            elapsed_s: 0.0,
            asked: 0,
            reached: false,
            held_back: false,
            shown: 0,
            certain: 1,
        }
    }
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
        self.switch = Some(Switch::new(to));
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
        let (display, late) = (self.mode_display, self.config.answers_late);
        let Some(switch) = &mut self.switch else {
            return;
        };
        let to = switch.to;
        let shows = display == Some(to.code());
        if fresh {
            // What is answered now was asked while the mode was held back.
            if core::mem::take(&mut switch.held_back) {
                switch.asked = 0;
            }
            switch.reached |= switch.asked > late;
            let counts = shows && switch.reached;
            switch.shown = if counts { switch.shown + 1 } else { 0 };
            if switch.shown >= switch.certain {
                self.enter(to);
                return;
            }
        }
        if switch.held_back {
            return;
        }
        switch.asked = switch.asked.saturating_add(1);
        if !shows {
            switch.elapsed_s += dt_s;
        }
        if switch.elapsed_s > self.config.mode_time_s {
            self.switch = None;
            self.switch_failed = Some(to);
        }
    }

    /// Too many frames in a row were lost, and the drive may turn in the mode before. After homing it stands, and bit 4 might
    /// start another.
    pub(super) fn hold_back(&mut self) {
        let turns = self.mode != Mode::Hm;
        // A set-point that follows the axis must not be followed by it for long.
        let certain = if self.grip() == Control::Position {
            CERTAIN_CYCLES
        } else {
            1
        };
        let frozen = self.frozen();
        if let Some(switch) = &mut self.switch
            && frozen
            && turns
            && !switch.reached
            && switch.to == Mode::Csp
        {
            (switch.held_back, switch.asked) = (true, 0);
            (switch.shown, switch.certain) = (0, certain);
        }
    }

    /// CSP was left: the drive keeps what it has got of the new mode, and does not stand at its last target.
    pub(super) fn left_csp(&self) -> bool {
        self.switch
            .is_some_and(|switch| switch.reached && switch.to != Mode::Csp)
    }

    /// The drive shows the new mode, which does not count yet.
    pub(super) fn shows_next(&self) -> bool {
        self.switch
            .is_some_and(|switch| self.mode_display == Some(switch.to.code()))
    }

    /// 0x6060.
    pub(super) fn mode_asked(&self) -> Mode {
        let switch = self.switch.filter(|switch| !switch.held_back);
        switch.map_or(self.mode, |switch| switch.to)
    }

    /// The drive is in the new mode: from now on its law counts alone.
    fn enter(&mut self, to: Mode) {
        let from = self.mode;
        self.mode = to;
        self.switch = None;
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
