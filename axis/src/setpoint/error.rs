//! Reasons to reject a set-point before its first cycle.

use super::{Motion, MotionLimits};

/// Largest accepted position. Products of larger positions could exceed the range of f64.
const FARTHEST: f64 = 1e15;

/// Accepted range of limits, so that no quotient or product overflows.
const USABLE: core::ops::RangeInclusive<f64> = 1e-12..=1e15;

#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum SetpointError {
    #[error("{what} is {value}: it must be a finite number")]
    NotFinite { what: &'static str, value: f64 },
    #[error("{what} is {value:e}: it must lie between 1e-12 and 1e15")]
    NotUsable { what: &'static str, value: f64 },
    #[error("{what} is {value:e}, farther than 1e15")]
    TooFar { what: &'static str, value: f64 },
    #[error("{reaches} would be reached on the way, outside the range [{low}, {high}]")]
    LeavesRange { reaches: f64, low: f64, high: f64 },
    #[error("a velocity of {velocity} would be reached, above the limit {limit}")]
    TooFast { velocity: f64, limit: f64 },
    #[error("an acceleration of {acceleration} would be reached, above the limit {limit}")]
    TooSteep { acceleration: f64, limit: f64 },
    #[error("a jerk of {jerk} would be reached, above the limit {limit}")]
    TooMuchJerk { jerk: f64, limit: f64 },
    #[error("{frequency} Hz is more than the {highest} Hz that the cycle can show")]
    TooOften { frequency: f64, highest: f64 },
    #[error("there is no time, or too little, for the way")]
    NoTime,
    #[error("the axis stands at {at} and must stand at {expected}")]
    Elsewhere { at: f64, expected: f64 },
    #[error("all {capacity} places are taken")]
    Full { capacity: usize },
    #[error("the points have ended")]
    Ended,
    #[error("the axis must stand still first; its set-point moves at {velocity}")]
    NotAtRest { velocity: f64 },
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
    pub fn check(&self) -> Result<(), SetpointError> {
        position("position", self.position)?;
        position("velocity", self.velocity)?;
        position("acceleration", self.acceleration)
    }
}
