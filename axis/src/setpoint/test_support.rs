//! Test support: derives velocity and acceleration from a sequence of positions, independently of
//! the source.

use proptest::prelude::*;

use super::{Motion, MotionLimits};

pub(crate) struct Sequence {
    pub(crate) motion: Motion,
    velocity: f64,
    limits: MotionLimits,
    dt: f64,
}

impl Sequence {
    pub(crate) fn from(motion: Motion, limits: MotionLimits, dt: f64) -> Self {
        Self {
            motion,
            velocity: motion.velocity,
            limits,
            dt,
        }
    }

    /// Frames are lost: the axis stands.
    pub(crate) fn hold_up(&mut self) {
        self.motion.velocity = 0.0;
        self.velocity = 0.0;
    }

    /// Rounding for positions of up to 1000.
    pub(crate) fn then(&mut self, next: Motion) -> Result<(), TestCaseError> {
        let rounding = 1e-12 / self.dt;
        let velocity = (next.position - self.motion.position) / self.dt;
        prop_assert!((velocity - next.velocity).abs() <= rounding, "{next:?}");
        prop_assert!(
            velocity.abs() <= self.limits.velocity + rounding,
            "{velocity}"
        );
        let rounding = 2.0 * rounding / self.dt;
        let acceleration = (velocity - self.velocity) / self.dt;
        prop_assert!(
            acceleration.abs() <= self.limits.acceleration + rounding,
            "{acceleration} at {next:?}"
        );
        self.velocity = velocity;
        self.motion = next;
        Ok(())
    }
}
