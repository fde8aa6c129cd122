//! Standstill; a moving axis brakes first.

use super::{HoldResponse, Motion, Ramp, Rate, Setpoint};

/// Brakes to standstill and holds the position.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hold {
    /// The deceleration, user units per second².
    pub acceleration: f64,
}

impl Hold {
    /// Advances one cycle. No override delays a stop. RT: O(1).
    #[must_use]
    pub fn brake(self, motion: Motion, dt_s: f64) -> Motion {
        let velocity = Ramp {
            target: 0.0,
            slope: self.acceleration,
        }
        .advance(motion.velocity, dt_s);
        motion.then(motion.position + velocity * dt_s, velocity, dt_s)
    }

    /// True if the axis stands.
    #[must_use]
    pub fn finished(self, motion: Motion) -> bool {
        motion.velocity == 0.0
    }
}

impl Setpoint for Hold {
    fn advance(&mut self, motion: Motion, _: Rate, dt_s: f64) -> Motion {
        self.brake(motion, dt_s)
    }

    fn at_hold(&self) -> HoldResponse {
        HoldResponse::Waits
    }

    fn finished(&self, motion: Motion) -> bool {
        Self::finished(*self, motion)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hold_brakes_then_stands() {
        let hold = Hold {
            acceleration: 100.0,
        };
        let mut motion = Motion {
            position: 1.0,
            velocity: -10.0,
            acceleration: 0.0,
        };
        for _ in 0..1000 {
            let next = hold.brake(motion, 0.001);
            assert!((next.velocity - motion.velocity).abs() <= 0.1 + 1e-12);
            let change = next.velocity - motion.velocity;
            assert!((next.acceleration * 0.001 - change).abs() <= 1e-12);
            motion = next;
        }
        assert_eq!(motion.velocity, 0.0);
        // v²/2a = 0.5, minus half a cycle.
        assert!((motion.position - 0.5).abs() < 0.006);
    }
}
