//! Set-points, advanced one cycle at a time, in user units.
//!
//! A [`Motion`] is where the set-point is; [`Hold`], [`Trapezoid`] and [`Ramp`] say where it goes next. None of them remembers
//! a start or a time, so a new one can take over in any cycle, at any velocity, without a jump.
//!
//! The velocity of a cycle is the step the position makes in it, divided by its length. So velocity and acceleration, as seen
//! in the sequence of positions that reaches the drive, are what the plans bound, exactly.

mod hold;
mod ramp;
mod trapezoid;

pub use hold::Hold;
pub use ramp::Ramp;
pub use trapezoid::Trapezoid;
pub(crate) use trapezoid::braking_velocity;

/// A set-point: position and the velocity at which it was reached.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Motion {
    pub position: f64,
    pub velocity: f64,
}

impl Motion {
    /// Standing still.
    #[must_use]
    pub const fn at(position: f64) -> Self {
        Self {
            position,
            velocity: 0.0,
        }
    }
}
