//! The correction of the mechanics: conversion between load and drive, and taking up backlash.
//!
//! Set-points and limits are of the load. Targets and following errors are of the drive. Reports say
//! where the load is: it moves with the drive once the drive has passed the play.
//!
//! While the set-point of the load reverses, the play changes by a ramp with limits of its own. A
//! move ends after this ramp. A stop, a hold or a lost frame ends the ramp where it is; nothing
//! moves before the next motion.

use super::stop::PowerGoal;
use super::{Axis, ControlledQuantity, Plan};
use crate::setpoint::{Goal, Hold, Motion, Trapezoid};
use crate::units::{Counts, UserUnits};

/// The play of the set-point.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Correction {
    pub(super) play: Motion,
    /// The play of the cycle before.
    pub(super) previous_play: f64,
    /// The direction of the load's set-point: 1, −1, or 0 before its first motion.
    direction: f64,
    /// The farthest position in this direction.
    turn: f64,
    /// The leader of this axis takes up its backlash.
    pub(super) led: bool,
}

impl Axis {
    /// Returns the set-point of the drive, user units.
    pub(super) fn drive_motion(&self) -> Motion {
        let load = self.motion;
        if !self.compensation.is_active() {
            return load;
        }
        let [error, slope] = self.compensation.error(load.position);
        let (ratio, play) = (1.0 - slope, self.correction.play);
        Motion {
            position: load.position - error + play.position,
            velocity: load.velocity * ratio + play.velocity,
            acceleration: load.acceleration * ratio + play.acceleration,
        }
    }

    /// Returns the drive's position for a position of the load, with the present play.
    pub(super) fn drive_counts(&self, load: f64) -> Counts {
        let position = if self.compensation.is_active() {
            self.compensation.screw(load) + self.correction.play.position
        } else {
            load
        };
        self.config.scale.position_to_counts(UserUnits(position))
    }

    /// Returns the load's position for a target that was sent with this play.
    pub(super) fn load_position(&self, target: Counts, play: f64) -> f64 {
        let drive = self.config.scale.position_to_user(target).0;
        if !self.compensation.is_active() {
            return drive;
        }
        self.compensation.load(drive - play)
    }

    /// Returns the reported position of the load; that of count 0 if none is reported.
    pub(super) fn reported_load(&self) -> f64 {
        match self.actual.counts() {
            Some(_) => self.actual.position(),
            None => self.load_position(Counts::default(), 0.0),
        }
    }

    /// Takes the play as it is, while no position is commanded.
    pub(super) fn track_play(&mut self) {
        self.correction = Correction {
            play: Motion::at(self.actual.play()),
            previous_play: self.correction.previous_play,
            turn: self.motion.position,
            ..Correction::default()
        };
    }

    /// Ends the motion of the play at once: the drive stands at its last target.
    pub(super) const fn freeze_play(&mut self) {
        self.correction.play = Motion::at(self.correction.play.position);
    }

    /// True while the plan is a move that also ends on its flank.
    pub(super) fn takes_up(&self) -> bool {
        let moves = match &self.plan {
            Plan::Move(_) => true,
            Plan::Jerk(source) => matches!(source.request().goal, Goal::Position(_)),
            Plan::External => self.led && self.correction.led,
            _ => false,
        };
        moves && self.may_take_up()
    }

    fn may_take_up(&self) -> bool {
        let held = self.rate == 0.0 && !matches!(self.plan, Plan::External);
        let stops = match &self.plan {
            Plan::Hold(_) => true,
            Plan::Jerk(source) => source.request().goal == Goal::Velocity(0.0),
            _ => false,
        };
        self.active && self.goal == PowerGoal::On && self.switch.is_none() && !held && !stops
    }

    /// Advances the play after the set-point of the load has moved from `before`. `may`: false while
    /// answers are late.
    pub(super) fn take_up(&mut self, before: Motion, may: bool, dt_s: f64) {
        let Some(limits) = self.compensation.take_up() else {
            return;
        };
        let to = self.motion.position;
        let way = to - self.correction.turn;
        if way * self.correction.direction > 0.0 {
            self.correction.turn = to;
        } else if way.abs() > self.config.scale.units_of_counts(1.0) {
            self.correction.direction = way.signum();
            self.correction.turn = to;
        }
        let moved = to != before.position;
        let play = self.correction.play;
        let towards = self.correction.direction;
        let goes = may && towards != 0.0 && (self.takes_up() || (moved && self.may_take_up()));
        self.correction.play = if goes {
            Trapezoid {
                target: self.compensation.play_towards(towards),
                velocity: limits.velocity,
                acceleration: limits.acceleration,
                braking: limits.acceleration,
            }
            .advance(play, dt_s)
        } else if play.velocity == 0.0 {
            Motion::at(play.position)
        } else {
            // The load at rest leaves its share of the acceleration.
            let rests = self.motion.velocity == 0.0 && before.velocity == 0.0;
            let acceleration = match rests {
                true => self.config.limits.acceleration,
                false => limits.acceleration,
            };
            Hold { acceleration }.advance(play, dt_s)
        };
    }

    /// True if the play has arrived on the flank of the motion.
    pub(super) fn play_arrived(&self) -> bool {
        let Correction {
            play, direction, ..
        } = self.correction;
        let flank = self.compensation.play_towards(direction);
        direction == 0.0 || play.stands_at(flank)
    }

    pub(super) fn play_rests(&self) -> bool {
        self.correction.play.velocity == 0.0
    }

    /// Updates the drive's target of a commanded position, or the play of a position that is not
    /// commanded.
    pub(super) fn update_target(&mut self, grip: ControlledQuantity) {
        self.sent = if grip == ControlledQuantity::Position {
            self.drive_counts(self.motion.position)
        } else {
            // The drive goes on with the velocity of both.
            let [_, slope] = self.compensation.error(self.motion.position);
            self.motion.velocity += self.correction.play.velocity / (1.0 - slope);
            self.track_play();
            self.actual.counts().unwrap_or_default()
        };
    }
}
