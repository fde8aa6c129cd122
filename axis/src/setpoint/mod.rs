//! Set-points, advanced one cycle at a time, in user units.
//!
//! A [`Motion`] is the present set-point; a [`Setpoint`] advances it, with the override of the cycle
//! as its [`Rate`]:
//!
//! | source | motion |
//! |---|---|
//! | [`Hold`] | brakes, then stands |
//! | [`Trapezoid`] | to a position, with bounded velocity and acceleration |
//! | [`JerkLimited`] | to a position or a velocity, with bounded jerk as well |
//! | [`crate::group::LinePath`] | to a position, on a straight line with other axes |
//! | [`PositionWave`] | sine and square waves for commissioning |
//! | [`Stream`] | through points that arrive during the motion |
//! | [`Playback`] | through the points of a [`Table`] |
//! | [`Gear`] | follows another axis, by a ratio or a [`Cam`] |
//! | [`LineShaft`] | the motion of a master on another machine, for gears |
//!
//! [`Source`] is any of the sources that need only the motion. [`Ramp`] is for a single value:
//! velocity in CSV, torque in CST.
//!
//! [`Hold`], [`Trapezoid`] and [`Ramp`] store neither a start nor a time. The others follow a plan,
//! and plan again if `motion` differs from their last result. So each of them can take over in any
//! cycle, at any velocity, without a jump.
//!
//! The velocity of a cycle is its change of position divided by its duration. So the plans bound
//! exactly the velocity and acceleration of the positions sent to the drive.
//!
//! ```
//! use ecaxis_axis::setpoint::{Goal, JerkLimited, Motion, MotionLimits, MoveRequest, Rate, Setpoint};
//!
//! let limits = MotionLimits { velocity: 100.0, acceleration: 1000.0, jerk: 20_000.0 };
//! let mut motion = Motion::default();
//! let request = MoveRequest::within(Goal::Position(10.0), limits);
//! let mut plan = JerkLimited::new(request, motion, 0.001)?;
//! while !plan.finished(motion) {
//!     motion = plan.advance(motion, Rate::WHOLE, 0.001);
//!     assert!(motion.velocity <= limits.velocity * (1.0 + 1e-9));
//! }
//! assert_eq!(motion.position, 10.0);
//! # Ok::<(), ecaxis_axis::setpoint::SetpointError>(())
//! ```

mod cam;
mod error;
mod gear;
mod hold;
mod jerk;
mod line_shaft;
mod ramp;
mod rate;
mod source;
mod spline;
mod stream;
mod table;
#[cfg(test)]
mod test_support;
mod trapezoid;
mod wave;

pub use cam::{Cam, CamError, CamLaw, CamPeak, CamPoint};
pub use error::SetpointError;
pub(crate) use error::position as check_position;
pub use gear::{FollowingGear, Gear, GearConfig, GearInMode, Master};
pub use hold::Hold;
pub use jerk::{Goal, JerkLimited, MoveRequest};
pub use line_shaft::{
    LineShaft, LineShaftConfig, LineShaftEnd, LineShaftPoint, LineShaftPointError, LineShaftState,
};
pub use ramp::Ramp;
pub use rate::{Rate, RateCourse, TableRate};
pub use source::Source;
pub use spline::{Interpolation, Knot};
pub use stream::{Stream, StreamConfig, StreamState};
pub use table::{Playback, Table, TableError, TablePlayback, TablePoint, TableProblem};
pub use trapezoid::Trapezoid;
pub(crate) use trapezoid::braking_velocity;
pub use wave::{PositionWave, Shape, Wave};

/// A set-point: position, mean velocity of the last cycle, and its acceleration.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Motion {
    /// The position, user units.
    pub position: f64,
    /// The last cycle's change of position divided by its duration.
    pub velocity: f64,
    /// The last cycle's change of velocity divided by its duration.
    pub acceleration: f64,
}

impl Motion {
    /// Returns a standstill at `position`.
    #[must_use]
    pub const fn at(position: f64) -> Self {
        Self {
            position,
            velocity: 0.0,
            acceleration: 0.0,
        }
    }

    /// Returns true at exactly `position` with velocity 0.
    #[must_use]
    pub fn stands_at(self, position: f64) -> bool {
        self.position == position && self.velocity == 0.0
    }

    /// Returns the motion one cycle later, at `position` with `velocity`. Computes the
    /// acceleration.
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

/// Limits of a jerk-limited motion, user units per second, second² and second³.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionLimits {
    /// The velocity limit, user units per second.
    pub velocity: f64,
    /// The acceleration limit, user units per second².
    pub acceleration: f64,
    /// The jerk limit, user units per second³.
    pub jerk: f64,
}

impl MotionLimits {
    /// Returns the limits multiplied by `factor`.
    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        Self {
            velocity: self.velocity * factor,
            acceleration: self.acceleration * factor,
            jerk: self.jerk * factor,
        }
    }
}

/// What a source does while its axis is held ([`Rate::HELD`]). Its set-point comes to rest in each
/// case: a held axis does not move.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HoldResponse {
    /// It decelerates within its limits, waits and continues.
    Waits,
    /// It follows a master that the same hold brings to rest. From any other master it decelerates
    /// within its limits, waits, and catches up afterwards.
    FollowsToRest,
    /// It decelerates within its limits and ends.
    Ends,
}

/// A source of set-points. Every source takes the override of each cycle and states its response to
/// a hold: there are no defaults.
pub trait Setpoint {
    /// Advances one cycle of `dt_s` seconds from `motion`, with the override `rate`. `motion` is the
    /// result of the previous cycle, or the caller's modification of it; a source then continues from
    /// there. RT: O(1).
    fn advance(&mut self, motion: Motion, rate: Rate, dt_s: f64) -> Motion;

    /// Returns what the source does at [`Rate::HELD`].
    fn at_hold(&self) -> HoldResponse;

    /// Returns true if further cycles would change neither position nor velocity.
    fn finished(&self, motion: Motion) -> bool;
}
