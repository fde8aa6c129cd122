//! The correction of the mechanics: conversion between load and drive, and taking up backlash.
//!
//! Set-points and limits are of the load. Targets and following errors are of the drive. Reports say
//! where the load is: it moves with the drive once the drive has passed the play.
//!
//! When the set-point of the load has reversed, the play changes by a ramp with limits of its own,
//! not faster than the motion is asked to be. A motion ends after this ramp. A stop, a hold or a
//! lost frame ends the ramp where it is; nothing moves before the next motion.

use super::stop::PowerGoal;
use super::{Axis, ControlledQuantity, Plan};
use crate::setpoint::{
    Goal, Hold, JerkLimited, Motion, MotionLimits, MoveRequest, Rate, Setpoint, Trapezoid,
};
use crate::units::{Counts, UserUnits};

/// The play of the set-point.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Correction {
    play: Motion,
    /// The plan of the play of a jerk-limited axis, while it moves.
    plan: Option<JerkLimited>,
    reversal: Reversal,
    /// The state in the cycle before.
    before: PlayState,
    /// The leader of this axis takes up its backlash.
    pub(super) led: bool,
    /// The source of the set-point has ended at rest, and its play still moves.
    pub(super) completes: bool,
}

/// The last reversal of the load's set-point.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Reversal {
    /// The direction since then: 1, −1, or 0 before the first motion.
    direction: f64,
    /// The farthest position in this direction.
    turn: f64,
}

/// What a cycle changes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct PlayState {
    play: f64,
    reversal: Reversal,
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
            before: self.correction.before,
            reversal: Reversal {
                direction: 0.0,
                turn: self.motion.position,
            },
            ..Correction::default()
        };
    }

    pub(super) const fn play_state(&self) -> PlayState {
        PlayState {
            play: self.correction.play.position,
            reversal: self.correction.reversal,
        }
    }

    /// Keeps the state before the cycle that ends, for a target that is not sent.
    pub(super) const fn keep_play(&mut self, before: PlayState) {
        self.correction.before = before;
    }

    /// Goes back to the cycle before, to the target `sent`.
    pub(super) fn restore_play(&mut self, sent: Counts) {
        let PlayState { play, reversal } = self.correction.before;
        self.correction.play.position = play;
        self.correction.reversal = reversal;
        self.motion.position = self.load_position(sent, play);
    }

    /// Ends the motion of the play at once: the drive stands at its last target.
    pub(super) const fn freeze_play(&mut self) {
        self.correction.play = Motion::at(self.correction.play.position);
        self.correction.plan = None;
    }

    /// True while the plan is a motion that also ends on its flank.
    pub(super) fn takes_up(&self) -> bool {
        let ends = match &self.plan {
            Plan::Move(_) => true,
            Plan::Jerk(source) => matches!(source.request().goal, Goal::Position(_)),
            Plan::External => !self.led || self.correction.led,
            Plan::Hold(_) => self.correction.completes,
            _ => false,
        };
        ends && self.may_take_up()
    }

    fn may_take_up(&self) -> bool {
        // A follower in a hold still follows a master of another group.
        let follows = matches!(self.plan, Plan::External) && self.motion.velocity != 0.0;
        let held = self.rate == 0.0 && !follows;
        let stops = match &self.plan {
            Plan::Hold(_) => !self.correction.completes,
            Plan::Jerk(source) => source.request().goal == Goal::Velocity(0.0),
            Plan::Velocity(ramp) => ramp.target == 0.0,
            _ => false,
        };
        self.follows() && self.goal == PowerGoal::On && self.switch.is_none() && !held && !stops
    }

    /// Returns the velocity of the motion as it is asked for, which the play does not exceed.
    fn asked_velocity(&self) -> f64 {
        let velocity = match &self.plan {
            Plan::Move(trapezoid) => trapezoid.velocity,
            Plan::Jerk(source) => source.request().limits.velocity,
            Plan::Velocity(ramp) => ramp.target.abs(),
            // The source knows its velocity, and obeys a hold itself.
            Plan::External => return f64::INFINITY,
            _ => f64::INFINITY,
        };
        velocity * self.rate
    }

    /// Advances the play after the set-point of the load has moved from `before`. `may`: false while
    /// answers are late.
    pub(super) fn take_up(&mut self, before: Motion, may: bool, dt_s: f64) {
        let Some(share) = self.compensation.take_up() else {
            return;
        };
        self.note_reversal();
        let moved = self.motion.position != before.position;
        let play = self.correction.play;
        let direction = self.correction.reversal.direction;
        let goes = may && direction != 0.0 && (self.takes_up() || (moved && self.may_take_up()));
        let flank = self.compensation.play_towards(direction);
        if play.velocity == 0.0 && (!goes || play.position == flank) {
            self.freeze_play();
            return;
        }
        let (goal, limits) = if goes {
            let velocity = share.velocity.min(self.asked_velocity());
            let limits = MotionLimits { velocity, ..share };
            (Goal::Position(flank), limits)
        } else if self.motion.velocity == 0.0 && before.velocity == 0.0 {
            // The load at rest leaves its share.
            (Goal::Velocity(0.0), self.config.limits.motion())
        } else {
            (Goal::Velocity(0.0), share)
        };
        self.correction.play = self.advance_play(goal, limits, dt_s);
    }

    fn note_reversal(&mut self) {
        let to = self.motion.position;
        let Reversal { direction, turn } = self.correction.reversal;
        let way = to - turn;
        if way * direction > 0.0 {
            self.correction.reversal.turn = to;
        } else if way.abs() > self.config.scale.units_of_counts(1.0) {
            self.correction.reversal = Reversal {
                direction: way.signum(),
                turn: to,
            };
        }
    }

    fn advance_play(&mut self, goal: Goal, limits: MotionLimits, dt_s: f64) -> Motion {
        let play = self.correction.play;
        if self.config.jerk_limited {
            let request = MoveRequest::within(goal, limits);
            let plan = match self.correction.plan {
                Some(plan) if *plan.request() == request => Ok(plan),
                Some(plan) => plan.redirect(request, play, dt_s),
                None => JerkLimited::new(request, play, dt_s),
            };
            self.correction.plan = plan.ok();
            if let Some(plan) = &mut self.correction.plan {
                return plan.advance(play, Rate::WHOLE, dt_s);
            }
        }
        let acceleration = limits.acceleration;
        match goal {
            Goal::Position(target) => Trapezoid {
                target,
                velocity: limits.velocity,
                acceleration,
                braking: acceleration,
            }
            .advance(play, Rate::WHOLE, dt_s),
            Goal::Velocity(_) => Hold { acceleration }.brake(play, dt_s),
        }
    }

    /// True if the play has arrived on the flank of the motion.
    pub(super) fn play_arrived(&self) -> bool {
        let direction = self.correction.reversal.direction;
        let flank = self.compensation.play_towards(direction);
        direction == 0.0 || self.correction.play.stands_at(flank)
    }

    pub(super) fn play_rests(&self) -> bool {
        self.correction.play.velocity == 0.0
    }

    /// True if the play has ended with the motion.
    pub(super) fn play_ended(&self) -> bool {
        match self.takes_up() {
            true => self.play_arrived(),
            false => self.play_rests(),
        }
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
