//! Any source that needs nothing but the motion, as one type.

use super::{Goal, Hold, JerkLimited, Motion, PositionWave, Setpoint, Trapezoid};
use crate::group::Along;

/// For an axis to hold whatever it follows. The sources that need something else in each cycle stand beside it: a
/// [`super::Stream`] its buffer, a [`super::Playback`] its table, a [`super::Gear`] its master.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Source {
    Hold(Hold),
    Trapezoid(Trapezoid),
    JerkLimited(JerkLimited),
    Line(Along),
    Wave(PositionWave),
}

impl Source {
    /// Where it ends, if it is on its way to a position.
    #[must_use]
    pub const fn target(&self) -> Option<f64> {
        match self {
            Self::Trapezoid(trapezoid) => Some(trapezoid.target),
            Self::JerkLimited(source) => match source.order().goal {
                Goal::Position(target) => Some(target),
                Goal::Velocity(_) => None,
            },
            Self::Line(along) => along.destination(),
            Self::Hold(_) | Self::Wave(_) => None,
        }
    }

    /// The acceleration it may brake with, which a successor must not be given less of: see [`Trapezoid::taking_over`].
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
    fn advance(&mut self, motion: Motion, dt_s: f64) -> Motion {
        match self {
            Self::Hold(hold) => hold.advance(motion, dt_s),
            Self::Trapezoid(trapezoid) => trapezoid.advance(motion, dt_s),
            Self::JerkLimited(source) => source.advance(motion, dt_s),
            Self::Line(along) => along.advance(motion, dt_s),
            Self::Wave(wave) => wave.advance(motion, dt_s),
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
