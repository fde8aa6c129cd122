//! Reasons to reject a set-point before its first cycle.

use super::{Motion, MotionLimits};

/// Largest accepted position. Products of larger positions could exceed the range of f64.
const FARTHEST: f64 = 1e15;

/// Accepted range of limits, so that no quotient or product overflows.
const USABLE: core::ops::RangeInclusive<f64> = 1e-12..=1e15;

/// A set-point source is impossible. Values in user units.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SetpointError {
    /// A value is not finite.
    #[error("{what} is {value}: it must be a finite number")]
    NotFinite {
        /// The value's name.
        what: &'static str,
        /// The rejected value.
        value: f64,
    },
    /// A limit is too small or too large for the calculation.
    #[error("{what} is {value:e}: it must lie between 1e-12 and 1e15")]
    NotUsable {
        /// The value's name.
        what: &'static str,
        /// The rejected value.
        value: f64,
    },
    /// A position is too far from zero.
    #[error("{what} is {value:e}, farther than 1e15")]
    TooFar {
        /// The value's name.
        what: &'static str,
        /// The rejected value.
        value: f64,
    },
    /// The motion leaves the position range.
    #[error("{reaches} would be reached on the way, outside the range [{low}, {high}]")]
    LeavesRange {
        /// The position outside the range.
        reaches: f64,
        /// The lower end of the range.
        low: f64,
        /// The upper end of the range.
        high: f64,
    },
    /// The motion exceeds the velocity limit.
    #[error("a velocity of {velocity} would be reached, above the limit {limit}")]
    TooFast {
        /// The velocity per second.
        velocity: f64,
        /// The limit.
        limit: f64,
    },
    /// The motion exceeds the acceleration limit.
    #[error("an acceleration of {acceleration} would be reached, above the limit {limit}")]
    TooSteep {
        /// The acceleration per second².
        acceleration: f64,
        /// The limit.
        limit: f64,
    },
    /// The motion exceeds the jerk limit.
    #[error("a jerk of {jerk} would be reached, above the limit {limit}")]
    TooMuchJerk {
        /// The jerk per second³.
        jerk: f64,
        /// The limit.
        limit: f64,
    },
    /// The oscillation is too fast for the cycle time.
    #[error("{frequency} Hz is more than the {highest} Hz that the cycle can show")]
    TooOften {
        /// The frequency in Hz.
        frequency: f64,
        /// The highest frequency in Hz.
        highest: f64,
    },
    /// The duration is zero or too short.
    #[error("the time is 0 or too short for the distance")]
    NoTime,
    /// The motion starts at another position.
    #[error("the axis stands at {at} and must stand at {expected}")]
    Elsewhere {
        /// The position of the axis.
        at: f64,
        /// The start of the motion.
        expected: f64,
    },
    /// The buffer has no free place.
    #[error("all {capacity} places are taken")]
    Full {
        /// The capacity in points.
        capacity: usize,
    },
    /// The stream is closed or has run out of points.
    #[error("the points have ended")]
    Ended,
    /// The axis moves.
    #[error("the axis must stand still first; its set-point moves at {velocity}")]
    NotAtRest {
        /// The velocity of the set-point.
        velocity: f64,
    },
}

pub(crate) fn finite(what: &'static str, value: f64) -> Result<(), SetpointError> {
    if value.is_finite() {
        Ok(())
    } else {
        Err(SetpointError::NotFinite { what, value })
    }
}

pub(crate) fn position(what: &'static str, value: f64) -> Result<(), SetpointError> {
    finite(what, value)?;
    if value.abs() > FARTHEST {
        return Err(SetpointError::TooFar { what, value });
    }
    Ok(())
}

pub(crate) fn usable(what: &'static str, value: f64) -> Result<(), SetpointError> {
    finite(what, value)?;
    if USABLE.contains(&value) {
        Ok(())
    } else {
        Err(SetpointError::NotUsable { what, value })
    }
}

impl MotionLimits {
    /// Checks that all limits are in the usable range.
    pub fn check(&self) -> Result<(), SetpointError> {
        usable("velocity limit", self.velocity)?;
        usable("acceleration limit", self.acceleration)?;
        usable("jerk limit", self.jerk)
    }
}

impl Motion {
    /// Fails if a value is not finite or too far from zero.
    pub fn check(&self) -> Result<(), SetpointError> {
        position("position", self.position)?;
        position("velocity", self.velocity)?;
        position("acceleration", self.acceleration)
    }
}
