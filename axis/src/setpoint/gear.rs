//! Electronic gear: follower = ratio × master + offset.
//!
//! The caller chooses the master position, commanded or reported. While engaged, the follower is
//! exactly at its ideal position in every cycle, within its own limits. If the limits do not allow
//! this, at the start or after a jump of the master, it catches up within them. With smoothing, the
//! follower is at its ideal position on average: it does not follow the noise of reported
//! positions.

use super::error::{position, usable};
use super::{
    Goal, Hold, HoldResponse, JerkLimited, Motion, MotionLimits, MoveRequest, Rate, Setpoint,
    SetpointError, braking_velocity,
};

/// Fraction of the acceleration used to plan braking. The rest covers rounding.
const PLANNED: f64 = 1.0 - 1e-4;

/// Fraction of the acceleration limit for catching up and for shifts. The rest is for following
/// meanwhile.
const CATCHING_UP: f64 = 0.5;

/// Least fraction of the velocity limit for a shift.
const LEAST: f64 = 0.01;

/// The way in which a gear engages.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum GearInMode {
    /// With the present offset: the follower only has to reach the velocity.
    Here,
    /// With this offset in the follower's units: the follower also catches up with the position.
    At {
        /// The offset in the follower's units.
        offset: f64,
    },
}

/// The configuration of a gear.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GearConfig {
    /// Follower's units per master's unit; negative for opposite directions.
    pub ratio: f64,
    /// The way in which the gear engages.
    pub engage: GearInMode,
    /// Time constant in seconds that smooths the master's velocity; 0: no smoothing.
    ///
    /// Reported positions are whole counts, and their differences would exceed the follower's
    /// acceleration. A master at rest or at constant velocity is followed without lag. With
    /// smoothing, the follower counts as engaged while it is near on average, because the remaining
    /// noise may exceed its acceleration.
    pub smoothing_s: f64,
    /// The limits of the follower.
    pub limits: MotionLimits,
    /// Lowest and highest position of the follower; `None`: unlimited.
    pub range: Option<[f64; 2]>,
}

/// The longest smoothing time, seconds.
const SMOOTHEST_S: f64 = 10.0;

/// Follows a master axis. Takes over from any motion, and any other source takes over from it. To
/// disengage, give the follower another source.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gear {
    ratio: f64,
    offset: f64,
    limits: MotionLimits,
    range: Option<[f64; 2]>,
    smoothing_s: f64,
    /// The smoothed master.
    master: Motion,
    /// Ideal position of the follower in the last cycle.
    ideal: f64,
    /// The way of a shift in progress, and the part that is done.
    shift: Option<(JerkLimited, Motion)>,
    /// Distance from the ideal position, averaged over the smoothing time.
    behind: f64,
    engaged: bool,
    slips: u32,
}

impl Gear {
    /// `master` and `motion` (the follower's set-point) are the present motions.
    pub fn new(config: GearConfig, master: Motion, motion: Motion) -> Result<Self, SetpointError> {
        usable("gear ratio", config.ratio.abs())?;
        config.limits.check()?;
        master.check()?;
        motion.check()?;
        if !(0.0..=SMOOTHEST_S).contains(&config.smoothing_s) {
            return Err(SetpointError::NotUsable {
                what: "smoothing time",
                value: config.smoothing_s,
            });
        }
        let offset = match config.engage {
            GearInMode::Here => motion.position - config.ratio * master.position,
            GearInMode::At { offset } => offset,
        };
        position("gear offset", offset)?;
        let ideal = config.ratio * master.position + offset;
        position("gear position", ideal)?;
        Ok(Self {
            ratio: config.ratio,
            offset,
            limits: config.limits,
            range: config.range,
            smoothing_s: config.smoothing_s,
            master,
            ideal,
            shift: None,
            behind: ideal - motion.position,
            engaged: false,
            slips: 0,
        })
    }

    /// Returns true if the follower is at its ideal position, with smoothing on average, and no
    /// shift is in progress.
    #[must_use]
    pub const fn engaged(&self) -> bool {
        self.engaged && self.shift.is_none()
    }

    /// Returns the present offset in the follower's units.
    #[must_use]
    pub fn offset(&self) -> f64 {
        self.offset + self.shifted().position
    }

    /// Shifts the follower by `distance` against its master. A second shift adds to one in progress.
    /// The shift is jerk-limited. It uses half of the acceleration limit, and the velocity that the
    /// master leaves at its start. If the limits do not suffice later, the follower catches up. RT:
    /// O(1).
    ///
    /// # Errors
    /// Fails if the distance leads to no valid offset; nothing changes.
    pub fn shift(&mut self, distance: f64, dt_s: f64) -> Result<(), SetpointError> {
        let target = match &self.shift {
            Some((plan, _)) => match plan.request().goal {
                Goal::Position(target) => target,
                Goal::Velocity(_) => 0.0,
            },
            None => 0.0,
        } + distance;
        position("gear offset", self.offset + target)?;
        let done = self.shifted();
        let limits = self.limits;
        let follows = (self.ratio * self.master.velocity).abs();
        let request = MoveRequest::within(
            Goal::Position(target),
            MotionLimits {
                velocity: (limits.velocity - follows).max(limits.velocity * LEAST),
                acceleration: limits.acceleration * CATCHING_UP,
                jerk: limits.jerk,
            },
        );
        let plan = match &self.shift {
            Some((plan, _)) => plan.redirect(request, done, dt_s),
            None => JerkLimited::new(request, done, dt_s),
        }?;
        self.shift = Some((plan, done));
        Ok(())
    }

    /// Returns the motion of the shift in progress.
    fn shifted(&self) -> Motion {
        self.shift
            .as_ref()
            .map_or(Motion::default(), |(_, done)| *done)
    }

    fn advance_shift(&mut self, rate: Rate, dt_s: f64) {
        let Some((plan, done)) = &mut self.shift else {
            return;
        };
        *done = plan.advance(*done, rate, dt_s);
        if plan.finished(*done) {
            self.offset += done.position;
            self.shift = None;
        }
    }

    /// Returns how many times the engaged follower could not follow.
    #[must_use]
    pub const fn lag_cycles(&self) -> u32 {
        self.slips
    }

    /// Returns the source of set-points that follows `master` in this cycle.
    pub const fn with_master(&mut self, master: Master) -> FollowingGear<'_> {
        FollowingGear { gear: self, master }
    }

    fn follow(&mut self, master: Master, motion: Motion, rate: Rate, dt_s: f64) -> Motion {
        let before = self.ideal;
        if master.motion.check().is_ok() {
            self.track(master.motion, dt_s);
        }
        self.advance_shift(rate.min(Rate::WHOLE), dt_s);
        let ideal = self.ratio * self.master.position + self.offset();
        if position("gear position", ideal).is_ok() {
            self.ideal = ideal;
        }
        if rate.is_held() && !(self.engaged && master.comes_to_rest) {
            self.engaged = false;
            let acceleration = self.limits.acceleration;
            return Hold { acceleration }.brake(motion, dt_s);
        }
        let [slowest, fastest] = self.possible(motion, dt_s);
        let was_engaged = self.engaged;
        let left = before - motion.position;
        let braking = self.limits.acceleration * CATCHING_UP * PLANNED;
        let closing = braking_velocity(left.abs(), braking, dt_s);
        let wanted = if self.smoothing_s > 0.0 {
            // The remaining noise is averaged and not followed.
            let closing = closing.min(left.abs() / self.smoothing_s);
            let follows = self.ratio * self.master.velocity + self.shifted().velocity;
            follows + closing.copysign(left)
        } else {
            let velocity = (self.ideal - before) / dt_s;
            // Exactly at the ideal position, with a velocity that keeps it there.
            let needed = (self.ideal - motion.position) / dt_s;
            let possible = (slowest..=fastest).contains(&needed);
            let change = self.limits.acceleration * CATCHING_UP * dt_s;
            self.engaged = possible && (was_engaged || (needed - velocity).abs() <= change);
            if self.engaged {
                return motion.then(self.ideal, needed, dt_s);
            }
            velocity + closing.copysign(left)
        };
        // Not `clamp`: it panics if a bound is NaN.
        let velocity = wanted.max(slowest).min(fastest);
        let next = motion.then(motion.position + velocity * dt_s, velocity, dt_s);
        self.engaged = self.follows(next, was_engaged, dt_s);
        self.slips = self
            .slips
            .saturating_add(u32::from(was_engaged && !self.engaged));
        next
    }

    /// Returns true if the follower is engaged. With smoothing it must be as near as smoothing and
    /// noise allow.
    fn follows(&mut self, next: Motion, was_engaged: bool, dt_s: f64) -> bool {
        let limits = &self.limits;
        if self.smoothing_s == 0.0 {
            return false;
        }
        let kept = (-dt_s / self.smoothing_s).exp();
        self.behind = self.behind * kept + (self.ideal - next.position) * (1.0 - kept);
        // A master that accelerates with the follower's limit is ahead by half of this distance.
        // The smoothed velocity lags by twice the smoothing time.
        let near = self.behind.abs() <= 4.0 * limits.acceleration * self.smoothing_s.powi(2);
        let follows = self.ratio * self.master.velocity + self.shifted().velocity;
        let relative = (follows - next.velocity).abs();
        near && (was_engaged || relative <= limits.acceleration * self.smoothing_s)
    }

    /// Updates the smoothed master: an α-β filter, critically damped.
    fn track(&mut self, master: Motion, dt_s: f64) {
        if self.smoothing_s == 0.0 {
            self.master = master;
            return;
        }
        let kept = (-dt_s / self.smoothing_s).exp();
        let expected = self.master.position + self.master.velocity * dt_s;
        let error = master.position - expected;
        let position = expected + error * (1.0 - kept * kept);
        let velocity = self.master.velocity + error / dt_s * (1.0 - kept) * (1.0 - kept);
        self.master = Motion {
            position,
            velocity,
            acceleration: 0.0,
        };
    }

    /// Returns the lowest and highest velocity of this cycle, within the limits and such that the
    /// follower can stop in its range.
    fn possible(&self, motion: Motion, dt_s: f64) -> [f64; 2] {
        let limits = &self.limits;
        let change = limits.acceleration * dt_s;
        let mut slowest = (motion.velocity - change).max(-limits.velocity);
        let mut fastest = (motion.velocity + change).min(limits.velocity);
        if let Some([low, high]) = self.range {
            let braking = limits.acceleration * PLANNED;
            let up = braking_velocity((high - motion.position).max(0.0), braking, dt_s);
            let down = braking_velocity((motion.position - low).max(0.0), braking, dt_s);
            fastest = fastest.min(up.max(motion.velocity - change));
            slowest = slowest.max((-down).min(motion.velocity + change));
        }
        // The motion was faster than the limit at the take-over: it can only brake.
        if slowest > fastest {
            if motion.velocity > 0.0 {
                fastest = slowest;
            } else {
                slowest = fastest;
            }
        }
        [slowest, fastest]
    }
}

/// What a gear follows in one cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Master {
    /// The master's motion at the end of the cycle. The master stays as it was if a value is not
    /// finite.
    pub motion: Motion,
    /// The hold of the follower holds the master as well and brings this motion to rest.
    pub comes_to_rest: bool,
}

/// A [`Gear`] with its master of one cycle.
#[derive(Debug)]
pub struct FollowingGear<'g> {
    gear: &'g mut Gear,
    master: Master,
}

impl Setpoint for FollowingGear<'_> {
    /// The rate slows only a shift: the motion is that of the master. RT: O(1).
    fn advance(&mut self, motion: Motion, rate: Rate, dt_s: f64) -> Motion {
        if dt_s.is_nan() || dt_s <= 0.0 {
            return motion;
        }
        self.gear.follow(self.master, motion, rate, dt_s)
    }

    fn at_hold(&self) -> HoldResponse {
        HoldResponse::FollowsToRest
    }

    /// A gear ends by a command only.
    fn finished(&self, _: Motion) -> bool {
        false
    }
}

#[cfg(test)]
#[path = "gear_tests.rs"]
mod tests;
