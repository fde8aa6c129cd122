//! One type for all sources that need only the motion.

use super::{
    Goal, Hold, HoldResponse, JerkLimited, Motion, PositionWave, Rate, Setpoint, Trapezoid,
};
use crate::group::LinePath;

/// Any source of an axis that needs only the motion. Sources with further inputs are separate:
/// [`super::Stream`] (buffer), [`super::Playback`] (table), [`super::Gear`] (master).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Source {
    /// Standstill.
    Hold(Hold),
    /// A move without a jerk limit.
    Trapezoid(Trapezoid),
    /// A jerk-limited move or velocity.
    JerkLimited(JerkLimited),
    /// One axis of a straight line.
    Line(LinePath),
    /// An oscillating position.
    Wave(PositionWave),
}

impl Source {
    /// Returns the target of a source that moves to a position.
    #[must_use]
    pub const fn target(&self) -> Option<f64> {
        match self {
            Self::Trapezoid(trapezoid) => Some(trapezoid.target),
            Self::JerkLimited(source) => match source.request().goal {
                Goal::Position(target) => Some(target),
                Goal::Velocity(_) => None,
            },
            Self::Line(along) => Some(along.target()),
            Self::Hold(_) | Self::Wave(_) => None,
        }
    }

    /// Returns the acceleration reserved for braking. A successor must not get less: see
    /// [`Trapezoid::taking_over`].
    #[must_use]
    pub const fn braking(&self) -> f64 {
        match self {
            Self::Hold(hold) => hold.acceleration,
            Self::Trapezoid(trapezoid) => trapezoid.braking,
            Self::JerkLimited(source) => source.used().acceleration,
            Self::Line(along) => along.braking(),
            Self::Wave(wave) => wave.limits().acceleration,
        }
    }
}

impl Setpoint for Source {
    /// RT: O(1).
    fn advance(&mut self, motion: Motion, rate: Rate, dt_s: f64) -> Motion {
        match self {
            Self::Hold(hold) => hold.advance(motion, rate, dt_s),
            Self::Trapezoid(trapezoid) => trapezoid.advance(motion, rate, dt_s),
            Self::JerkLimited(source) => source.advance(motion, rate, dt_s),
            Self::Line(along) => along.advance(motion, rate, dt_s),
            Self::Wave(wave) => wave.advance(motion, rate, dt_s),
        }
    }

    fn at_hold(&self) -> HoldResponse {
        match self {
            Self::Hold(hold) => hold.at_hold(),
            Self::Trapezoid(trapezoid) => trapezoid.at_hold(),
            Self::JerkLimited(source) => source.at_hold(),
            Self::Line(along) => along.at_hold(),
            Self::Wave(wave) => wave.at_hold(),
        }
    }

    fn finished(&self, motion: Motion) -> bool {
        match self {
            Self::Hold(hold) => hold.finished(motion),
            Self::Trapezoid(trapezoid) => trapezoid.finished(motion),
            Self::JerkLimited(source) => source.finished(motion),
            Self::Line(along) => along.finished(motion),
            Self::Wave(wave) => wave.finished(motion),
        }
    }
}

#[cfg(test)]
#[path = "source_tests.rs"]
mod tests;
