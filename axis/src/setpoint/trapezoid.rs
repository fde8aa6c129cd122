//! A move to a position with bounded velocity and acceleration.
//!
//! Each cycle takes the highest velocity from which braking by the same amount in every following
//! cycle ends exactly on the target. The continuous rule √(2·a·d) overshoots by up to one cycle, so
//! the sum over cycles is inverted instead.

use super::{HoldResponse, Motion, Rate, Setpoint};

/// Fraction of the acceleration used to plan braking. Rounding makes some cycles slightly too fast;
/// without a reserve the errors would add up and end beyond the target.
const PLANNED: f64 = 1.0 - 1e-4;

/// A move to a position with limited velocity and acceleration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trapezoid {
    /// The target, user units.
    pub target: f64,
    /// The velocity limit, user units per second.
    pub velocity: f64,
    /// The acceleration limit, user units per second².
    pub acceleration: f64,
    /// Deceleration used if `acceleration` would overshoot: the reserve of the interrupted move.
    /// Never below `acceleration`.
    pub braking: f64,
}

impl Trapezoid {
    /// Takes over from `motion`. The earlier plan could stop it with `earlier`; the axis allows
    /// `limit`.
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

    /// Advances one cycle with the velocity as it is. RT: O(1).
    fn step(self, motion: Motion, dt_s: f64) -> Motion {
        if dt_s <= 0.0 {
            return motion;
        }
        let left = self.target - motion.position;
        let brake = braking_velocity(left.abs(), self.acceleration * PLANNED, dt_s);
        let wanted = brake.min(self.velocity).copysign(left);
        // More than the requested deceleration only if it would overshoot: too fast for the
        // distance, or moving away.
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

    /// Returns true at the target and at rest.
    #[must_use]
    pub fn finished(&self, motion: Motion) -> bool {
        motion.stands_at(self.target)
    }
}

impl Setpoint for Trapezoid {
    /// The velocity is that of the move × rate. The caller limits a rate above 1.
    fn advance(&mut self, motion: Motion, rate: Rate, dt_s: f64) -> Motion {
        let velocity = self.velocity * rate.value();
        Self { velocity, ..*self }.step(motion, dt_s)
    }

    fn at_hold(&self) -> HoldResponse {
        HoldResponse::Waits
    }

    fn finished(&self, motion: Motion) -> bool {
        Self::finished(self, motion)
    }
}

/// Returns the velocity from `from` towards `to`. It changes by at most `faster` away from zero and
/// at most `slower` towards zero, and never both in one cycle.
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
        // Same direction, slower: at most down to `to`.
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

/// Returns the highest velocity of this cycle from which braking by `acceleration` in every
/// following cycle ends at `distance`.
///
/// Starting with v and losing δ = a·dt per cycle, the way is dt·Σ(v − kδ), k = 0…n with n = ⌊v/δ⌋.
/// In units of δ·dt this is x = (n+1)·u − n(n+1)/2 with u = v/δ. It is piecewise linear and
/// inverted piece by piece.
pub(crate) fn braking_velocity(distance: f64, acceleration: f64, dt_s: f64) -> f64 {
    let delta = acceleration * dt_s;
    let x = distance / (delta * dt_s);
    if x < 1e15 {
        let n = (((1.0 + 8.0 * x).sqrt() - 1.0) * 0.5).floor();
        delta * (x + n * (n + 1.0) * 0.5) / (n + 1.0)
    } else {
        // With so many cycles the sum equals the integral. The result is not finite if the
        // acceleration is 0.
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
