//! Set-points, advanced one cycle at a time, in user units.
//!
//! A [`Motion`] is where the set-point is; a [`Setpoint`] says where it goes next:
//!
//! | source | what it does |
//! |---|---|
//! | [`Hold`] | brakes, then stands |
//! | [`Trapezoid`] | to a position, with bounded velocity and acceleration |
//! | [`JerkLimited`] | to a position, or to a velocity, with bounded jerk as well |
//! | [`crate::group::Along`] | to a position, on a straight line with other axes |
//! | [`PositionWave`] | sine and square waves for commissioning |
//! | [`Stream`] | through points that arrive while it moves |
//! | [`Playback`] | through the points of a [`Table`] |
//! | [`Gear`] | after another axis |
//!
//! [`Source`] is any of those that need nothing but the motion. [`Ramp`] is for a single value: velocity in CSV, torque in CST. [`Hold`], [`Trapezoid`] and [`Ramp`] remember neither a start nor a time;
//! the others follow a plan, and make a new one when they find the axis elsewhere than they left it. So any of them can take over in any
//! cycle, at any velocity, without a jump.
//!
//! The velocity of a cycle is the step the position makes in it, divided by its length. So velocity and acceleration, as seen
//! in the sequence of positions that reaches the drive, are what the plans bound, exactly.

mod error;
mod gear;
mod hold;
mod jerk;
mod ramp;
#[cfg(test)]
mod sequence;
mod source;
mod spline;
mod stream;
mod table;
mod trapezoid;
mod wave;

pub use error::SetpointError;
pub use gear::{Engage, Gear, GearConfig};
pub use hold::Hold;
pub use jerk::{Goal, JerkLimited, Order};
pub use ramp::Ramp;
pub use source::Source;
pub use spline::{Interpolation, Knot};
pub use stream::{Stream, StreamConfig, StreamState};
pub use table::{Playback, Table, TableError, TableProblem};
pub use trapezoid::Trapezoid;
pub(crate) use trapezoid::braking_velocity;
pub use wave::{PositionWave, Shape, Wave};

/// A set-point: position, the velocity at which it was reached, and how that changed.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Motion {
    pub position: f64,
    /// The last cycle's step divided by its length.
    pub velocity: f64,
    /// The last cycle's change of velocity divided by its length.
    pub acceleration: f64,
}

impl Motion {
    /// Standing still.
    #[must_use]
    pub const fn at(position: f64) -> Self {
        Self {
            position,
            velocity: 0.0,
            acceleration: 0.0,
        }
    }

    /// There and not moving.
    #[must_use]
    pub fn stands_at(self, position: f64) -> bool {
        self.position == position && self.velocity == 0.0
    }

    /// One cycle later: `position` was reached at `velocity`. The acceleration follows.
    #[must_use]
    pub fn then(self, position: f64, velocity: f64, dt_s: f64) -> Self {
        let acceleration = (velocity - self.velocity) / dt_s;
        Self {
            position,
            velocity,
            acceleration: if acceleration.is_finite() {
                acceleration
            } else {
                0.0
            },
        }
    }
}

/// What a jerk-limited motion may use, user units per second, second² and second³.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionLimits {
    pub velocity: f64,
    pub acceleration: f64,
    pub jerk: f64,
}

impl MotionLimits {
    /// Each multiplied by `factor`.
    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        Self {
            velocity: self.velocity * factor,
            acceleration: self.acceleration * factor,
            jerk: self.jerk * factor,
        }
    }
}

/// Where the set-point goes next.
pub trait Setpoint {
    /// One cycle of `dt_s` seconds on from `motion`, which is what the cycle before returned or what the caller has made of
    /// it: a source that finds another motion than its own goes on from there. RT: O(1).
    fn advance(&mut self, motion: Motion, dt_s: f64) -> Motion;

    /// Nothing is left to do: further cycles would neither move nor change the velocity.
    fn finished(&self, motion: Motion) -> bool;
}
