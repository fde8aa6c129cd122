//! Mode switches: write 0x6060, wait for 0x6061.
//!
//! The drive changes its mode between the frame with the new mode and the frame that shows it.
//! During these cycles the targets of both modes are valid, and both follow from the one set-point.
//! The control law of the mode that the drive shows is active.
//!
//! While frames are lost, the drive may or may not have changed its mode. A moving drive must not
//! enter CSP with an old target. So the previous mode is requested again until an answer to a frame
//! with CSP has arrived. A drive that received both modes in turn may show either mode for some
//! cycles.

use super::stop::PowerGoal;
use super::supervision::SupervisionState;
use super::{Axis, Plan};
use crate::cia402::{Mode, State};
use crate::profile_mode::{Goal, Profile};
use crate::setpoint::Ramp;
use crate::status::Trip;

/// Fresh cycles that must show the new mode, if the drive received both modes in turn.
const MODE_CONFIRM_CYCLES: u8 = 10;

/// Fresh cycles after a withdrawn request before the next one.
const WITHDRAWN_CYCLES: u8 = 5;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Switch {
    from: Mode,
    pub(super) to: Mode,
    /// Time in seconds for which the new mode was requested and not shown.
    elapsed_s: f64,
    /// Consecutive cycles whose outputs request the new mode.
    asked: u8,
    /// True if the drive has answered a frame that requested the new mode.
    reached: bool,
    /// Consecutive fresh cycles that have shown the new mode, and the required number of them.
    shown: u8,
    certain: u8,
    /// Consecutive fresh cycles until the new mode is requested again after a withdrawal. Frames that
    /// are lost in the meantime would change the mode of the drive once more.
    pause: u8,
}

impl Axis {
    /// True if 0x6061 shows a mode of the switch or the active mode, or is not mapped.
    pub(super) fn mode_confirmed(&self) -> bool {
        self.mode_display.is_none() || self.shows(self.mode) || self.next_mode_displayed()
    }

    fn shows(&self, mode: Mode) -> bool {
        self.mode_display == Some(mode.code())
    }

    /// Returns the inactive mode of a switch, whose targets are valid as well.
    pub(super) fn other_mode(&self) -> Option<Mode> {
        let switch = self.switch?;
        Some(if self.mode == switch.to {
            switch.from
        } else {
            switch.to
        })
    }

    /// Returns the mode of a pending switch.
    pub(super) fn switching(&self) -> Option<Mode> {
        let cycle = self.mode_cycle.map(|cycle| cycle.to);
        self.switch.map(|switch| switch.to).or(cycle)
    }

    /// Returns the trip of a drive with power that should show its mode by now. Until then targets
    /// follow actual values.
    pub(super) fn check_late_mode(&self) -> Option<Trip> {
        let display = Mode::from_code(self.mode_display?);
        let time_s = self.config.mode_time_s;
        let waits = self.config.mode_display_enabled
            && self.goal == PowerGoal::On
            && self.state == State::OperationEnabled
            && !self.follows()
            && !self.mode_confirmed();
        (waits && self.memory.in_state_s() > time_s).then_some(Trip::ModeNotShown {
            expected: self.mode,
            display,
            time_s,
        })
    }

    pub(super) fn begin_switch(&mut self, to: Mode) {
        if self.config.mode_change_unpowered {
            self.begin_mode_cycle(to);
            return;
        }
        if self.config.control(to) == super::ControlledQuantity::Position
            && self.controlled_quantity() == super::ControlledQuantity::Velocity
        {
            // The position set-point starts at the position of the axis in the next cycle.
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
            pause: 0,
        });
        self.switch_failed = None;
    }

    /// Starts a switch in a cycle that has already called [`Axis::settle_mode`].
    pub(super) fn begin_switch_late(&mut self, to: Mode) {
        self.begin_switch(to);
        if let Some(switch) = &mut self.switch {
            switch.asked = 1;
        }
    }

    /// Advances the mode switch, once per cycle.
    pub(super) fn settle_mode(&mut self, fresh: bool, dt_s: f64) {
        self.revert_pending_mode();
        let Some(mut switch) = self.switch else {
            return;
        };
        let shows = self.shows(switch.to);
        switch.pause = match fresh {
            true => switch.pause.saturating_sub(1),
            false if switch.pause > 0 => WITHDRAWN_CYCLES,
            false => 0,
        };
        if fresh {
            // The answered frame requested the new mode, and all frames since have done so.
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

    /// True if the previous mode must be requested: too many consecutive frames were lost a few
    /// cycles ago, and the drive may move in that mode. After homing the drive stands, and bit 4
    /// could start another homing.
    fn is_held_back(&self, switch: &Switch) -> bool {
        (self.setpoint_frozen() || switch.pause > 0)
            && !switch.reached
            && switch.to == Mode::Csp
            && !matches!(self.mode, Mode::Hm | Mode::Csp)
    }

    pub(super) fn revert_pending_mode(&mut self) {
        if let Some(mut switch) = self.switch
            && self.is_held_back(&switch)
        {
            // The next answers belong to frames that requested the previous mode.
            (switch.asked, switch.certain) = (0, MODE_CONFIRM_CYCLES);
            if self.setpoint_frozen() {
                switch.pause = WITHDRAWN_CYCLES;
            }
            self.switch = Some(switch);
        }
    }

    /// True if the drive has left CSP: it keeps the target of the new mode and does not stand at
    /// its last position.
    pub(super) fn left_csp(&self) -> bool {
        self.switch
            .is_some_and(|switch| switch.reached && switch.to != Mode::Csp)
    }

    /// True if 0x6061 shows the inactive mode of a switch.
    pub(super) fn next_mode_displayed(&self) -> bool {
        self.other_mode().is_some_and(|mode| self.shows(mode))
    }

    /// Returns the mode for 0x6060.
    pub(super) fn mode_asked(&self) -> Mode {
        let switch = self.switch.filter(|switch| !self.is_held_back(switch));
        switch.map_or(self.mode, |switch| switch.to)
    }

    /// Activates the control law of `to`, which the drive now shows.
    fn change_law(&mut self, to: Mode) {
        let from = self.mode;
        self.mode = to;
        self.loop_state.enter();
        if to == Mode::Csp {
            // This position is already the target in the drive.
            self.sent = self.drive_counts(self.motion.position);
        }
        if to != Mode::Cst {
            self.loop_state.torque = 0.0;
        }
        if from == Mode::Hm {
            self.supervision =
                SupervisionState::starting_at(self.actual.position(), &self.own_limits());
        }
        self.transfer_setpoint(from);
        if !self.plan.fits(self.config.control(to)) {
            self.plan = Plan::braking(&self.config, to);
            self.forget_target();
        }
    }

    /// Continues a velocity, whether from a profile of the drive or from the set-point.
    fn transfer_setpoint(&mut self, from: Mode) {
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

    /// Ends the switch without power: there is no motion to transfer.
    pub(super) fn end_switch(&mut self) {
        if let Some(switch) = self.switch.take()
            && self.state != State::OperationEnabled
        {
            self.mode = switch.to;
        }
    }
}
