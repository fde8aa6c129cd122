//! The shortest jerk-limited way from any state to rest at a position.
//!
//! Every way consists of a change to some velocity, a cruise, and a stop; the search finds this
//! velocity. The direct stop divides the targets: a target ahead of it is reached forwards, any
//! other mirrored. Ahead of the stop, the distance grows with the velocity, except in two cases:
//!
//! - While braking, a target slightly ahead of the stop needs no velocity without acceleration: the
//!   brake is released for a moment and applied again.
//! - With a limit below the present velocity, slowing down to the limit takes longer and farther
//!   than the direct stop. Then some velocity in between fits.

use super::profile::{JerkSegment, Profile, State, coasting, mirrored, travel, velocity_change};
use crate::setpoint::MotionLimits;

/// Plans from `start` (position 0) to `distance`. The limits must be usable
/// ([`MotionLimits::check`]).
pub(crate) fn to_position(start: State, distance: f64, limits: MotionLimits) -> Profile {
    let stop = stopping(start, limits);
    let reached = travel(start, &stop).position;
    if reached == distance {
        return Profile::of(&[&stop]);
    }
    if distance > reached {
        forwards(start, distance, limits)
    } else {
        forwards(mirrored(start, -1.0), -distance, limits).mirrored()
    }
}

/// Plans a stop and then a move to `distance` that is slow enough to take `duration` in total.
/// Returns `None` if `duration` is too short.
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

/// Returns the minimum duration of [`stop_then_go`].
pub(crate) fn stop_then_go_time(start: State, distance: f64, limits: MotionLimits) -> f64 {
    let stop = stopping(start, limits);
    let stopped = travel(start, &stop).position;
    let go = to_position(State::default(), distance - stopped, limits);
    Profile::of(&[&stop]).duration() + go.duration()
}

/// Returns the lowest and highest position of the shortest stop.
pub(crate) fn stop_span(start: State, limits: MotionLimits) -> [f64; 2] {
    Profile::of(&[&stopping(start, limits)]).span(start)
}

fn stopping(start: State, limits: MotionLimits) -> [JerkSegment; 3] {
    velocity_change(start, 0.0, limits.acceleration, limits.jerk)
}

/// Plans to a target ahead of the direct stop.
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
        let profile = Profile::of(&[&first, &[JerkSegment::cruise(cruise)], &last]);
        // Corrects the cruise by the rounding error.
        let missing = distance - profile.end(start).position;
        let cruise = if v > 0.0 { cruise + missing / v } else { 0.0 };
        Profile::of(&[&first, &[JerkSegment::cruise(cruise)], &last])
    };
    if through(velocity).2 <= distance {
        return with_cruise(velocity);
    }
    let coasting = coasting(start, jerk);
    let lowest = coasting.max(0.0);
    if coasting > 0.0 && start.acceleration < 0.0 && through(coasting).2 > distance {
        let released = |time: f64| {
            let first = JerkSegment::new(jerk, time);
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

/// A third of the tries halve the bracket: enough for all bits of an f64.
const MAX_ROUNDS: u32 = 180;

/// Returns the argument at which `function` has the value `wanted`. The value at `below` is lower,
/// at `above` higher.
///
/// Uses the secant with the Illinois correction, and bisects at every third step, so that the
/// bracket shrinks for any function.
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
    for round in 0..MAX_ROUNDS {
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
        // Illinois correction: an end that remains twice gets half its weight.
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
