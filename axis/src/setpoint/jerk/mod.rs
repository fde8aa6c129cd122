//! Moves and changes of velocity with bounded velocity, acceleration and jerk.
//!
//! `profile` contains segments of constant jerk and the change from one velocity to another. `plan`
//! finds the profile that ends at a position. This file follows a profile, one cycle at a time.
//!
//! The drive gets a continuous profile, sampled once per cycle. Each difference of positions is a
//! mean over neighbouring cycles. So velocity, acceleration and jerk of the samples keep the
//! profile's limits exactly, with any cycle time. A change of plan keeps them as well: the new
//! profile starts from the state of the old one, not from means of the cycle.

mod plan;
mod profile;

use super::{HoldResponse, Motion, MotionLimits, Rate, Setpoint, SetpointError};
use profile::{Profile, State, coasting, velocity_change};

/// Fraction of every limit used for planning. The rest covers the rounding of positions in their
/// differences.
const PLANNED: f64 = 1.0 - 1e-6;

/// The goal of a jerk-limited move.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Goal {
    /// Standstill at a position.
    Position(f64),
    /// A constant velocity; 0 is a stop.
    Velocity(f64),
}

/// The goal of a motion and its limits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MoveRequest {
    /// The goal.
    pub goal: Goal,
    /// The limits of velocity, acceleration and jerk.
    pub limits: MotionLimits,
    /// The axis limits, none below `limits`. Their acceleration and jerk apply if the present
    /// motion would otherwise pass the target or exceed the velocity limit.
    pub ceiling: MotionLimits,
    /// Range of positions during the motion and during a stop from it. A motion with constant
    /// velocity stops in time to stay in the range.
    pub range: Option<[f64; 2]>,
}

impl MoveRequest {
    /// Returns the request with its velocity multiplied by `rate`, at most the velocity of the
    /// ceiling. At rate 0 the goal is a stop on the way.
    #[must_use]
    pub fn at_rate(self, rate: f64) -> Self {
        if rate <= 0.0 {
            return Self {
                goal: Goal::Velocity(0.0),
                // The range could only reject a stop.
                range: None,
                ..self
            };
        }
        let most = self.ceiling.velocity.max(self.limits.velocity);
        let velocity = (self.limits.velocity * rate).min(most);
        let goal = match self.goal {
            // Not `clamp`: it panics if a bound is NaN.
            Goal::Velocity(goal) => Goal::Velocity((goal * rate).max(-velocity).min(velocity)),
            Goal::Position(target) => Goal::Position(target),
        };
        Self {
            goal,
            limits: MotionLimits {
                velocity,
                ..self.limits
            },
            ..self
        }
    }

    /// Returns a move in the shortest time that the limits allow.
    #[must_use]
    pub const fn within(goal: Goal, limits: MotionLimits) -> Self {
        Self {
            goal,
            limits,
            ceiling: limits,
            range: None,
        }
    }
}

/// Follows a [`MoveRequest`]. Cheap to copy (some 400 bytes); allocates nothing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JerkLimited {
    /// The request, and the rate at which it is executed.
    nominal: MoveRequest,
    rate: f64,
    /// The request at this rate.
    order: MoveRequest,
    /// The limits of the profile, without the factor [`PLANNED`].
    used: MotionLimits,
    origin: f64,
    profile: Profile,
    index: usize,
    /// State at the start of the segment, and the time since then.
    base: State,
    elapsed: f64,
    now: State,
    span: [f64; 2],
    total: f64,
    duration: f64,
    stopped_by_range: bool,
    last: Motion,
}

impl JerkLimited {
    /// Plans from `motion` of any source; `dt_s` is the cycle time that produced it. O(1): some
    /// microseconds, no allocation.
    ///
    /// Keeps the present acceleration as far as the velocity stays within its limit. From then on
    /// the jerk is bounded.
    pub fn new(order: MoveRequest, motion: Motion, dt_s: f64) -> Result<Self, SetpointError> {
        check(&order, motion)?;
        let start = entry(motion, order.ceiling.scaled(PLANNED), dt_s);
        Self::plan(order, start, motion, None)
    }

    /// Plans from the state of this source, with bounded jerk at the change as well. Plans from
    /// `motion` if it is not this source's last result. O(1), like [`JerkLimited::new`].
    pub fn redirect(
        &self,
        order: MoveRequest,
        motion: Motion,
        dt_s: f64,
    ) -> Result<Self, SetpointError> {
        if !self.continues(motion) {
            return Self::new(order, motion, dt_s);
        }
        check(&order, motion)?;
        Self::plan(order, self.now, motion, Some(self.used))
    }

    /// Returns true if the present deceleration can end, with bounded jerk, before the velocity
    /// changes its sign.
    pub(crate) fn can_rest_before_turning(&self) -> bool {
        let State {
            velocity,
            acceleration,
            ..
        } = self.now;
        let most = 2.0 * self.used.scaled(PLANNED).jerk * velocity.abs();
        velocity * acceleration < 0.0 && acceleration * acceleration <= most
    }

    /// Returns the request of this move.
    #[must_use]
    pub const fn request(&self) -> &MoveRequest {
        &self.nominal
    }

    /// Multiplies the velocity of the request by `rate` ([`MoveRequest::at_rate`]). 0 stops on the
    /// way, and a later rate continues from there. Plans only if the rate changes.
    ///
    /// If no plan is possible, the present one continues and the next call tries again.
    fn set_rate(&mut self, rate: f64, motion: Motion, dt_s: f64) {
        let stops = self.nominal.goal == Goal::Velocity(0.0);
        if rate == self.rate || stops {
            return;
        }
        let nominal = self.nominal;
        if let Goal::Position(target) = nominal.goal
            && motion.stands_at(target)
        {
            self.rate = rate;
        } else if let Ok(plan) = self.redirect(nominal.at_rate(rate), motion, dt_s) {
            *self = Self {
                nominal,
                rate,
                ..plan
            };
        }
    }

    /// Returns the limits of the motion: those of the request, or higher ones if these did not
    /// suffice.
    #[must_use]
    pub const fn used(&self) -> &MotionLimits {
        &self.used
    }

    /// Returns true if a constant velocity was replaced by a stop at the end of the range.
    #[must_use]
    pub const fn stopped_by_range(&self) -> bool {
        self.stopped_by_range
    }

    /// Returns the time from start to arrival, seconds.
    #[must_use]
    pub const fn duration_s(&self) -> f64 {
        self.duration
    }

    /// Returns the time to the end of the move in seconds.
    #[must_use]
    pub fn remaining_s(&self) -> f64 {
        (self.duration - self.total).max(0.0)
    }

    /// Returns the lowest and highest position from start to arrival.
    #[must_use]
    pub fn span(&self) -> [f64; 2] {
        self.span.map(|position| self.origin + position)
    }

    /// Returns a duration such that every longer duration is possible as well. At least
    /// [`JerkLimited::duration_s`].
    pub(crate) fn any_duration_from(&self) -> f64 {
        match self.order.goal {
            Goal::Position(target)
                if self.base.velocity != 0.0 || self.base.acceleration != 0.0 =>
            {
                plan::stop_then_go_time(self.base, target - self.origin, self.used.scaled(PLANNED))
            }
            _ => self.duration,
        }
    }

    /// Returns the same move stretched to `duration_s` from its start, or `None` if impossible.
    /// Only before the first cycle.
    pub(crate) fn lasting(&self, duration_s: f64) -> Option<Self> {
        let Goal::Position(target) = self.order.goal else {
            return None;
        };
        let distance = target - self.origin;
        let (start, limits) = (self.base, self.used.scaled(PLANNED));
        let at_rest = start.velocity == 0.0 && start.acceleration == 0.0;
        let profile = if distance == 0.0 && at_rest {
            Profile::default()
        } else if at_rest {
            self.profile.slowed((duration_s / self.duration).max(1.0))
        } else if duration_s <= self.duration {
            self.profile
        } else {
            slower(start, distance, limits, duration_s)
                .or_else(|| plan::stop_then_go(start, distance, limits, duration_s))?
        };
        Some(Self {
            span: profile.span(start),
            profile,
            duration: duration_s,
            ..*self
        })
    }

    /// Returns a move from rest at `rate`, stretched as a whole. Only before the first cycle. Moves
    /// that arrive together still do.
    #[must_use]
    pub fn slowed(&self, rate: f64) -> Self {
        let stretched = match rate > 0.0 && rate < 1.0 {
            true => self.lasting(self.duration / rate),
            false => None,
        };
        stretched.map_or(*self, |stretched| Self { rate, ..stretched })
    }

    fn plan(
        order: MoveRequest,
        start: State,
        motion: Motion,
        earlier: Option<MotionLimits>,
    ) -> Result<Self, SetpointError> {
        let start = State {
            position: 0.0,
            ..start
        };
        let origin = motion.position;
        let harder = MotionLimits {
            velocity: order.limits.velocity,
            ..order.ceiling
        };
        let as_before = earlier.map_or(order.limits, |earlier| MotionLimits {
            velocity: order.limits.velocity,
            acceleration: order.limits.acceleration.max(earlier.acceleration),
            jerk: order.limits.jerk.max(earlier.jerk),
        });
        let mut chosen = None;
        for limits in [order.limits, as_before, harder] {
            let planned = limits.scaled(PLANNED);
            let profile = match order.goal {
                Goal::Position(target) => plan::to_position(start, target - origin, planned),
                Goal::Velocity(velocity) => Profile::of(&[&velocity_change(
                    start,
                    velocity,
                    planned.acceleration,
                    planned.jerk,
                )]),
            };
            let span = profile.span(start);
            let stop = plan::stop_span(start, planned);
            let way = match order.goal {
                Goal::Position(_) => span,
                Goal::Velocity(_) => stop,
            };
            let outside = leaves(&order, origin, [way, stop]);
            chosen = Some((limits, profile, span, outside));
            if outside.is_none() && stays_within(&order, origin, start, planned.jerk, span) {
                break;
            }
        }
        // The loop has three iterations.
        let (used, profile, span, outside) = chosen.ok_or(SetpointError::NoTime)?;
        outside.map_or(Ok(()), Err)?;
        Ok(Self {
            nominal: order,
            rate: 1.0,
            order,
            used,
            origin,
            duration: profile.duration(),
            profile,
            index: 0,
            base: start,
            elapsed: 0.0,
            now: start,
            span,
            total: 0.0,
            stopped_by_range: false,
            last: motion,
        })
    }

    /// Returns true if `motion` is the result of the last cycle. A velocity goal accepts any
    /// position, because it may be the drive's.
    fn continues(&self, motion: Motion) -> bool {
        let same_place = match self.order.goal {
            Goal::Position(_) => motion.position == self.last.position,
            Goal::Velocity(_) => true,
        };
        same_place && motion.velocity == self.last.velocity
    }

    /// Plans again to the same goal after an interruption, with the full limits of the axis.
    fn resume(&mut self, motion: Motion, dt_s: f64) {
        let order = MoveRequest {
            range: None,
            ..self.order
        };
        if let Ok(resumed) = Self::new(order, motion, dt_s) {
            *self = Self {
                nominal: self.nominal,
                rate: self.rate,
                order: self.order,
                ..resumed
            };
        }
    }

    /// Returns true if, after one more cycle at this velocity, a stop would no longer end inside
    /// the range.
    fn must_stop(&self, motion: Motion, dt_s: f64) -> bool {
        if matches!(self.order.goal, Goal::Position(_) | Goal::Velocity(0.0)) {
            return false;
        }
        let mut ahead = *self;
        ahead.pass(dt_s);
        let stop = plan::stop_span(ahead.now, self.used.scaled(PLANNED));
        let origin = motion.position - self.now.position;
        let stop = stop.map(|position| origin + position - motion.position);
        leaves(&self.order, motion.position, [stop, [0.0, 0.0]]).is_some()
    }

    fn stop(&mut self, motion: Motion) {
        let order = MoveRequest {
            goal: Goal::Velocity(0.0),
            limits: self.used,
            // This stop exists to keep the range. A check of the range could only reject it.
            range: None,
            ..self.order
        };
        if let Ok(stopping) = Self::plan(order, self.now, motion, None) {
            *self = Self {
                stopped_by_range: true,
                ..stopping
            };
        }
    }

    fn pass(&mut self, dt_s: f64) {
        self.total += dt_s;
        self.elapsed += dt_s;
        while let Some(segment) = self.profile.get(self.index) {
            if self.elapsed < segment.time {
                self.now = self.base.after(segment.jerk, self.elapsed);
                return;
            }
            self.base = self.base.after(segment.jerk, segment.time);
            self.elapsed -= segment.time;
            self.index += 1;
            if let Some(next) = self.profile.get(self.index) {
                self.base = next.enter(self.base);
            }
        }
        self.now = match self.order.goal {
            Goal::Position(_) => State {
                velocity: 0.0,
                acceleration: 0.0,
                ..self.base
            },
            Goal::Velocity(velocity) => {
                self.base.velocity = velocity;
                self.base.acceleration = 0.0;
                self.base.after(0.0, self.elapsed)
            }
        };
    }

    fn ended(&self) -> bool {
        self.total >= self.duration && self.profile.get(self.index).is_none()
    }
}

impl Setpoint for JerkLimited {
    /// RT: O(1). Plans again if `motion` is not the last result of this source.
    fn advance(&mut self, motion: Motion, rate: Rate, dt_s: f64) -> Motion {
        if dt_s.is_nan() || dt_s <= 0.0 {
            return motion;
        }
        self.set_rate(rate.value(), motion, dt_s);
        if !self.continues(motion) {
            self.resume(motion, dt_s);
        }
        if self.order.range.is_some() && self.must_stop(motion, dt_s) {
            self.stop(motion);
        }
        let (before, had_ended) = (self.now.position, self.ended());
        self.pass(dt_s);
        let step = self.now.position - before;
        self.last = match self.order.goal {
            Goal::Position(target) if self.total >= self.duration => {
                self.index = usize::MAX;
                self.now = State {
                    position: target - self.origin,
                    ..State::default()
                };
                self.base = self.now;
                let left = target - motion.position;
                motion.then(target, left / dt_s, dt_s)
            }
            Goal::Position(_) => motion.then(self.origin + self.now.position, step / dt_s, dt_s),
            Goal::Velocity(velocity) if had_ended => {
                self.now = State {
                    position: 0.0,
                    ..self.now
                };
                self.base = self.now;
                self.elapsed = 0.0;
                motion.then(motion.position + velocity * dt_s, velocity, dt_s)
            }
            Goal::Velocity(_) => motion.then(motion.position + step, step / dt_s, dt_s),
        };
        self.last
    }

    fn at_hold(&self) -> HoldResponse {
        HoldResponse::Waits
    }

    /// A velocity goal is finished when it is reached. A goal that is held by rate 0 is not
    /// finished.
    fn finished(&self, motion: Motion) -> bool {
        match (self.nominal.goal, self.order.goal) {
            (Goal::Position(target), _) => motion.stands_at(target),
            (Goal::Velocity(nominal), Goal::Velocity(velocity)) => {
                (self.rate > 0.0 || nominal == 0.0) && motion.velocity == velocity
            }
            (Goal::Velocity(_), Goal::Position(_)) => false,
        }
    }
}

fn check(order: &MoveRequest, motion: Motion) -> Result<(), SetpointError> {
    order.limits.check()?;
    order.ceiling.check()?;
    motion.check()?;
    match order.goal {
        Goal::Position(target) => super::error::position("target", target)?,
        Goal::Velocity(velocity) => super::error::finite("velocity", velocity)?,
    }
    if let Goal::Velocity(velocity) = order.goal
        && velocity.abs() > order.limits.velocity
    {
        return Err(SetpointError::TooFast {
            velocity,
            limit: order.limits.velocity,
        });
    }
    Ok(())
}

/// Returns true if the way is not faster than necessary and does not pass a target that the axis is
/// moving to.
fn stays_within(order: &MoveRequest, origin: f64, start: State, jerk: f64, span: [f64; 2]) -> bool {
    let fastest = order.limits.velocity.max(start.velocity.abs());
    if coasting(start, jerk).abs() > fastest {
        return false;
    }
    let Goal::Position(target) = order.goal else {
        return true;
    };
    let distance = target - origin;
    let slack = distance.abs() * 1e-9;
    let beyond = if distance > 0.0 {
        start.velocity > 0.0 && span[1] > distance + slack
    } else {
        start.velocity < 0.0 && span[0] < distance - slack
    };
    !beyond
}

/// Returns an error if the way, or a stop on it, leaves the range and goes farther out than its
/// start.
///
/// The shortest way back reverses without a standstill, before the position where a stop would end.
/// A stop must still be possible.
fn leaves(order: &MoveRequest, origin: f64, spans: [[f64; 2]; 2]) -> Option<SetpointError> {
    let [low, high] = order.range?;
    let inside = low.min(origin)..=high.max(origin);
    spans
        .into_iter()
        .flatten()
        .map(|position| origin + position)
        .find(|position| !inside.contains(position))
        .map(|reaches| SetpointError::LeavesRange { reaches, low, high })
}

/// Returns the state at the end of a cycle with known means. With constant acceleration, a cycle's
/// mean velocity is that of its middle. Extrapolated in this way, the velocity stays within its
/// limit.
fn entry(motion: Motion, limits: MotionLimits, dt_s: f64) -> State {
    // Interrupted at this position, or reversing: start from rest.
    if motion.velocity == 0.0 {
        return State::default();
    }
    let sign = 1f64.copysign(motion.acceleration);
    let headroom = (limits.velocity - sign * motion.velocity).max(0.0);
    let half = dt_s.max(0.0) / 2.0;
    let most = limits.jerk * ((half * half + 2.0 * headroom / limits.jerk).sqrt() - half);
    let acceleration = motion
        .acceleration
        .abs()
        .min(most)
        .min(limits.acceleration)
        .copysign(sign);
    State {
        position: 0.0,
        velocity: motion.velocity + acceleration * half,
        acceleration,
    }
}

/// Returns a profile with a lower velocity limit that takes `duration`.
fn slower(start: State, distance: f64, limits: MotionLimits, duration: f64) -> Option<Profile> {
    let (mut slow, mut fast) = (0.0, limits.velocity);
    for _ in 0..64 {
        let velocity = slow + (fast - slow) * 0.5;
        let profile = plan::to_position(start, distance, MotionLimits { velocity, ..limits });
        let time = profile.duration();
        if (time - duration).abs() <= duration * 1e-12 {
            return Some(profile);
        }
        if time > duration {
            slow = velocity;
        } else {
            fast = velocity;
        }
    }
    None
}

#[cfg(test)]
#[path = "jerk_tests.rs"]
mod tests;
