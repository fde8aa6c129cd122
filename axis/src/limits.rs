//! Limits of an axis. [`Limits::check`] checks them once; afterwards [`crate::axis`] relies on
//! them.

use crate::scale::Scale;
use crate::setpoint::MotionLimits;
use crate::units::UserVelocity;

/// The limits of an axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Lowest and highest position, user units. `None`: unlimited.
    pub position: Option<[f64; 2]>,
    /// Highest velocity, user units per second.
    pub velocity: f64,
    /// Highest acceleration, user units per second².
    pub acceleration: f64,
    /// Jerk of jerk-limited moves, user units per second³. `None`: the acceleration limit is
    /// reached within [`Limits::JERK_TIME_S`].
    pub jerk: Option<f64>,
    /// Highest torque, percent of rated torque.
    pub torque: f64,
    /// Largest difference between commanded and reported position, user units. The reported
    /// position is a few cycles old, so the limit must include the way of a few cycles. `None`: the
    /// following error is not supervised here.
    pub following_error: Option<f64>,
}

/// A limit is invalid. Values in user units.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum LimitError {
    /// A limit is not a finite number above zero.
    #[error("limit {what} is {value}: it must be a finite number above zero")]
    NotPositive {
        /// The limit's name.
        what: &'static str,
        /// The rejected value.
        value: f64,
    },
    /// The position range is empty.
    #[error("position range [{low}, {high}] is empty or not finite")]
    EmptyRange {
        /// The lower end.
        low: f64,
        /// The upper end.
        high: f64,
    },
    /// The position range exceeds 32 bits of counts.
    #[error(
        "position range [{low}, {high}] is {counts:e} counts wide, more than the 2^31 a drive can distinguish"
    )]
    RangeTooWide {
        /// The lower end.
        low: f64,
        /// The upper end.
        high: f64,
        /// The width in counts.
        counts: f64,
    },
    /// The velocity limit exceeds 32 bits of the drive's unit.
    #[error("velocity limit {velocity} units/s is {raw:e} {unit}, more than 32 bits hold")]
    VelocityNotRepresentable {
        /// The limit per second.
        velocity: f64,
        /// The limit in the drive's unit.
        raw: f64,
        /// The drive's unit.
        unit: crate::scale::VelocityUnit,
    },
    /// The torque limit exceeds 16 bits of per mille.
    #[error("torque limit {torque} % is more than the 3276.7 % that 16 bits of per mille hold")]
    TorqueNotRepresentable {
        /// The limit in percent.
        torque: f64,
    },
}

impl Limits {
    /// Time in seconds in which a jerk-limited move reaches full acceleration if no jerk is
    /// configured.
    pub const JERK_TIME_S: f64 = 0.05;

    /// Returns the effective jerk limit, user units per second³.
    #[must_use]
    pub fn jerk(&self) -> f64 {
        self.jerk.unwrap_or(self.acceleration / Self::JERK_TIME_S)
    }

    /// Returns velocity, acceleration and jerk.
    #[must_use]
    pub fn motion(&self) -> MotionLimits {
        MotionLimits {
            velocity: self.velocity,
            acceleration: self.acceleration,
            jerk: self.jerk(),
        }
    }

    /// Checks the limits. Fails at the first invalid one.
    pub fn check(&self, scale: &Scale) -> Result<(), LimitError> {
        let positive = [
            ("velocity", Some(self.velocity)),
            ("acceleration", Some(self.acceleration)),
            ("jerk", self.jerk),
            ("torque", Some(self.torque)),
            ("following_error", self.following_error),
        ];
        for (what, value) in positive {
            if let Some(value) = value
                && !(value.is_finite() && value > 0.0)
            {
                return Err(LimitError::NotPositive { what, value });
            }
        }
        if let Some([low, high]) = self.position {
            if !(low.is_finite() && high.is_finite() && low < high) {
                return Err(LimitError::EmptyRange { low, high });
            }
            let counts = (high - low) * scale.counts_per_unit();
            if counts > f64::from(i32::MAX) {
                return Err(LimitError::RangeTooWide { low, high, counts });
            }
        }
        let raw = self.velocity / scale.velocity_resolution();
        // Headroom: an over-velocity must still have a distinct raw value.
        if scale
            .velocity_to_raw(UserVelocity(self.velocity * 1.5))
            .0
            .unsigned_abs()
            >= i32::MAX.unsigned_abs()
        {
            return Err(LimitError::VelocityNotRepresentable {
                velocity: self.velocity,
                raw,
                unit: scale.velocity_unit(),
            });
        }
        if self.torque * 10.0 > f64::from(i16::MAX) {
            return Err(LimitError::TorqueNotRepresentable {
                torque: self.torque,
            });
        }
        Ok(())
    }

    /// Returns how far the reported position may leave the range before the axis trips. This is the
    /// following error limit, or 1 % of the range.
    #[must_use]
    pub fn position_margin(&self) -> f64 {
        let range = self.position.map_or(0.0, |[low, high]| high - low);
        self.following_error.unwrap_or(range * 0.01)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: Limits = Limits {
        position: Some([-50.0, 50.0]),
        velocity: 200.0,
        acceleration: 2000.0,
        jerk: None,
        torque: 100.0,
        following_error: Some(1.0),
    };

    #[test]
    fn limits_are_checked_row_by_row() {
        let scale = Scale::new(2000.0, 5.0).unwrap();
        assert_eq!(GOOD.check(&scale), Ok(()));
        let bad = [
            Limits {
                velocity: 0.0,
                ..GOOD
            },
            Limits {
                velocity: f64::NAN,
                ..GOOD
            },
            Limits {
                velocity: 1e9,
                ..GOOD
            },
            Limits {
                acceleration: -1.0,
                ..GOOD
            },
            Limits {
                acceleration: f64::INFINITY,
                ..GOOD
            },
            Limits {
                jerk: Some(0.0),
                ..GOOD
            },
            Limits {
                torque: 0.0,
                ..GOOD
            },
            Limits {
                torque: 4000.0,
                ..GOOD
            },
            Limits {
                following_error: Some(0.0),
                ..GOOD
            },
            Limits {
                position: Some([1.0, 1.0]),
                ..GOOD
            },
            Limits {
                position: Some([f64::NAN, 1.0]),
                ..GOOD
            },
            Limits {
                position: Some([-1e9, 1e9]),
                ..GOOD
            },
        ];
        for limits in bad {
            let error = limits.check(&scale).expect_err("must be refused");
            assert!(!error.to_string().is_empty());
        }
    }
}
