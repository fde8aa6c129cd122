//! The shortest jerk-limited way from any state to rest at a position.
//!
//! Every way is a change to some velocity, a cruise, and a stop; what is sought is that velocity. The direct stop divides the
//! targets: to those ahead of it the way leads forwards, to the others, mirrored, too. Ahead of it the distance grows with the
//! velocity between the changes, apart from two corners:
//!
//! - While braking, a target a little ahead of the stop needs no velocity without acceleration at all: the brake is
//!   released for a moment and applied again.
//! - With a limit below the present velocity, slowing down to it takes longer, and so leads further, than the direct stop; then
//!   some velocity in between fits.

use super::profile::{Profile, Segment, State, coasting, facing, travel, velocity_change};
use crate::setpoint::MotionLimits;

/// `start.position` is 0, `distance` where to. The limits are usable ([`MotionLimits::check`]).
pub(crate) fn to_position(start: State, distance: f64, limits: MotionLimits) -> Profile {
    let stop = stopping(start, limits);
    let reached = travel(start, &stop).position;
    if reached == distance {
        return Profile::of(&[&stop]);
    }
    if distance > reached {
        forwards(start, distance, limits)
    } else {
        forwards(facing(start, -1.0), -distance, limits).mirrored()
    }
}

/// Stops, then goes to `distance` so slowly that everything takes `duration`. `None`: it cannot be done so quickly.
pub(crate) fn stop_then_go(
    start: State,
    distance: f64,
    limits: MotionLimits,
    duration: f64,
) -> Option<Profile> {
    let stop = stopping(start, limits);
    let stopped = travel(start, &stop).position;
    let left = duration - Profile::of(&[&stop]).duration();
    let go = to_position(State::default(), distance - stopped, limits);
    let shortest = go.duration();
    if left < shortest || shortest <= 0.0 {
        return None;
    }
    let go = go.slowed(left / shortest);
    Some(Profile::of(&[&stop, go.segments()]))
}

/// How long [`stop_then_go`] takes at least.
pub(crate) fn stop_then_go_time(start: State, distance: f64, limits: MotionLimits) -> f64 {
    let stop = stopping(start, limits);
    let stopped = travel(start, &stop).position;
    let go = to_position(State::default(), distance - stopped, limits);
    Profile::of(&[&stop]).duration() + go.duration()
}

/// Lowest and highest position of the shortest stop.
pub(crate) fn stop_span(start: State, limits: MotionLimits) -> [f64; 2] {
    Profile::of(&[&stopping(start, limits)]).span(start)
}

fn stopping(start: State, limits: MotionLimits) -> [Segment; 3] {
    velocity_change(start, 0.0, limits.acceleration, limits.jerk)
}

/// The target lies ahead of the direct stop.
fn forwards(start: State, distance: f64, limits: MotionLimits) -> Profile {
    let MotionLimits {
        velocity,
        acceleration,
        jerk,
    } = limits;
    let through = |v: f64| {
        let first = velocity_change(start, v, acceleration, jerk);
        let between = travel(start, &first);
        let level = State {
            position: between.position,
            velocity: v,
            acceleration: 0.0,
        };
        let last = velocity_change(level, 0.0, acceleration, jerk);
        (first, last, travel(level, &last).position)
    };
    let with_cruise = |v: f64| {
        let (first, last, reached) = through(v);
        let left = (distance - reached).max(0.0);
        let cruise = if v > 0.0 { left / v } else { 0.0 };
        let profile = Profile::of(&[&first, &[Segment::cruise(cruise)], &last]);
        // Once more with what rounding makes of it.
        let missing = distance - profile.end(start).position;
        let cruise = if v > 0.0 { cruise + missing / v } else { 0.0 };
        Profile::of(&[&first, &[Segment::cruise(cruise)], &last])
    };
    if through(velocity).2 <= distance {
        return with_cruise(velocity);
    }
    let coasting = coasting(start, jerk);
    let lowest = coasting.max(0.0);
    if coasting > 0.0 && start.acceleration < 0.0 && through(coasting).2 > distance {
        let released = |time: f64| {
            let first = Segment::new(jerk, time);
            let between = travel(start, &[first]);
            let last = velocity_change(between, 0.0, acceleration, jerk);
            (first, last, travel(between, &last).position)
        };
        let longest = -start.acceleration / jerk;
        let time = find(0.0, longest, distance, |time| released(time).2);
        let (first, last, _) = released(time);
        return Profile::of(&[&[first], &last]);
    }
    with_cruise(find(lowest, velocity, distance, |v| through(v).2))
}

/// A third of them halve the bracket: enough for all bits of an f64.
const TRIES: u32 = 180;

/// Where `function` has the value `wanted`, between `below`, where it has less, and `above`, where it has more.
///
/// The secant with the Illinois correction, and every third time the middle, so that the bracket shrinks whatever the function.
fn find(mut below: f64, mut above: f64, wanted: f64, mut function: impl FnMut(f64) -> f64) -> f64 {
    let mut low = function(below) - wanted;
    let mut high = function(above) - wanted;
    let close = wanted.abs() * 4.0 * f64::EPSILON;
    let mut best = if low.abs() <= high.abs() {
        (below, low)
    } else {
        (above, high)
    };
    let mut last_below = None;
    for round in 0..TRIES {
        if best.1.abs() <= close {
            break;
        }
        let middle = below + (above - below) * 0.5;
        if middle == below || middle == above {
            break;
        }
        let secant = below - low * (above - below) / (high - low);
        let at = if round % 3 == 2 || !secant.is_finite() || secant == below || secant == above {
            middle
        } else {
            secant
        };
        let value = function(at) - wanted;
        if value.abs() < best.1.abs() {
            best = (at, value);
        }
        let is_below = value <= 0.0;
        if is_below {
            (below, low) = (at, value);
        } else {
            (above, high) = (at, value);
        }
        // The end that stays a second time weighs half.
        if last_below == Some(is_below) {
            if is_below {
                high *= 0.5;
            } else {
                low *= 0.5;
            }
        }
        last_below = Some(is_below);
    }
    best.0
}
