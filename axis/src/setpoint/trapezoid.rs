//! A move to a position with bounded velocity and acceleration.
//!
//! Each cycle asks one question: how fast may this cycle be, so that braking by the same amount in every following cycle ends
//! exactly on the target? The continuous rule √(2·a·d) overshoots by up to a cycle, so the sum over cycles is inverted instead.

use super::{Motion, Setpoint};

/// Braking is planned with this part of the acceleration. Rounding makes some cycles a hair too fast; with nothing in reserve
/// that could only add up, and end beyond the target.
const PLANNED: f64 = 1.0 - 1e-4;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trapezoid {
    pub target: f64,
    pub velocity: f64,
    pub acceleration: f64,
    /// Used where `acceleration` would overshoot: what the move that was interrupted could brake with. Never below it.
    pub braking: f64,
}

impl Trapezoid {
    /// Takes over from `motion`, which an earlier plan could stop with `earlier` and the axis with `limit`.
    #[must_use]
    pub fn taking_over(mut self, motion: Motion, earlier: f64, limit: f64, dt_s: f64) -> Self {
        self.braking = self.acceleration;
        if motion.velocity != 0.0 {
            self.braking = self.braking.max(earlier).min(limit);
            let left = self.target - motion.position;
            let towards = left * motion.velocity > 0.0;
            if towards
                && motion.velocity.abs()
                    > braking_velocity(left.abs(), self.braking * PLANNED, dt_s)
            {
                self.braking = limit;
            }
        }
        self
    }

    /// RT: O(1).
    #[must_use]
    pub fn advance(self, motion: Motion, dt_s: f64) -> Motion {
        if dt_s <= 0.0 {
            return motion;
        }
        let left = self.target - motion.position;
        let brake = braking_velocity(left.abs(), self.acceleration * PLANNED, dt_s);
        let wanted = brake.min(self.velocity).copysign(left);
        // More than the gentle deceleration only where that would overshoot: too fast for the distance, or going away.
        let too_fast = motion.velocity * left <= 0.0
            || motion.velocity.abs() > brake + self.acceleration * dt_s;
        let slowing = if too_fast {
            self.braking
        } else {
            self.acceleration
        };
        let velocity = approach(
            motion.velocity,
            wanted,
            self.acceleration * dt_s,
            slowing * dt_s,
        );
        let step = velocity * dt_s;
        let position = if (left - step).abs() <= left.abs() * 1e-9 {
            self.target
        } else {
            motion.position + step
        };
        motion.then(position, velocity, dt_s)
    }

    /// On the target and standing.
    #[must_use]
    pub fn finished(&self, motion: Motion) -> bool {
        motion.stands_at(self.target)
    }
}

impl Setpoint for Trapezoid {
    fn advance(&mut self, motion: Motion, dt_s: f64) -> Motion {
        Self::advance(*self, motion, dt_s)
    }

    fn finished(&self, motion: Motion) -> bool {
        Self::finished(self, motion)
    }
}

/// From `from` towards `to`: away from zero by at most `faster`, towards zero by at most `slower`, and not both in one cycle.
fn approach(from: f64, to: f64, faster: f64, slower: f64) -> f64 {
    let away_from_zero = from == 0.0 || (from * to > 0.0 && to.abs() > from.abs());
    if away_from_zero {
        return if (to - from).abs() <= faster {
            to
        } else {
            from + faster.copysign(to - from)
        };
    }
    if (to - from).abs() <= slower.min(faster) {
        return to;
    }
    let slowed = from - slower.copysign(from);
    if from * to > 0.0 {
        // Same direction, slower: no further than asked.
        if (to - from).abs() <= slower {
            to
        } else {
            slowed
        }
    } else if slowed * from > 0.0 {
        slowed
    } else {
        0.0
    }
}

/// The highest velocity of this cycle from which braking by `acceleration` in every cycle after it ends at `distance`.
///
/// Starting with v and losing δ = a·dt per cycle, the way is dt·Σ(v − kδ), k = 0…n with n = ⌊v/δ⌋. In units of δ·dt that is
/// x = (n+1)·u − n(n+1)/2 with u = v/δ: piecewise linear, so it is inverted piece by piece.
pub(crate) fn braking_velocity(distance: f64, acceleration: f64, dt_s: f64) -> f64 {
    let delta = acceleration * dt_s;
    let x = distance / (delta * dt_s);
    if x < 1e15 {
        let n = (((1.0 + 8.0 * x).sqrt() - 1.0) * 0.5).floor();
        delta * (x + n * (n + 1.0) * 0.5) / (n + 1.0)
    } else {
        // So many cycles that the sum is the integral; infinite or undefined where the acceleration is nothing.
        let velocity = (2.0 * acceleration * distance).sqrt() - delta;
        if velocity.is_finite() {
            velocity.max(0.0)
        } else {
            0.0
        }
    }
}

#[cfg(test)]
#[path = "trapezoid_tests.rs"]
mod tests;
