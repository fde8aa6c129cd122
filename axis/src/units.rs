//! Newtypes for quantities of the drive and of the user. They prevent a mix-up that would move a
//! machine by the wrong amount.
//!
//! Drive side: [`Counts`], [`RawVelocity`], [`RawAcceleration`], [`PerMille`]. User side:
//! [`UserUnits`], [`UserVelocity`], [`UserAcceleration`], [`Percent`]. [`crate::Scale`] is the only
//! conversion between both sides. [`crate::scale::TorqueScale`] first converts a torque in
//! [`NewtonMetres`] or [`Amperes`] to [`Percent`].
//!
//! ```
//! use ecaxis_axis::units::Counts;
//!
//! // The drive's 32-bit position wraps; the axis continues to count.
//! let before = Counts(i64::from(i32::MAX));
//! assert_eq!(before.unwrap_next(i32::MIN), Counts(i64::from(i32::MAX) + 1));
//! ```

/// Position in encoder counts, unwrapped: the value continues where the drive's 32-bit value wraps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct Counts(pub i64);

impl Counts {
    /// Returns the position as the drive counts it: modulo 2³².
    #[must_use]
    pub const fn wrapped(self) -> i32 {
        let [a, b, c, d, ..] = self.0.to_le_bytes();
        i32::from_le_bytes([a, b, c, d])
    }

    /// Returns the position nearest to `self` whose wrapped value is `raw`. The result is correct
    /// if the axis moves less than 2³¹ counts between two readings.
    #[must_use]
    pub fn unwrap_next(self, raw: i32) -> Self {
        let moved = raw.wrapping_sub(self.wrapped());
        Self(self.0.saturating_add(i64::from(moved)))
    }
}

/// Velocity as transmitted, in the unit of 0x60A9.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct RawVelocity(pub i32);

/// Acceleration as transmitted, in the unit of 0x60AA.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct RawAcceleration(pub u32);

/// Torque as transmitted: thousandths of the motor's rated torque (0x6076).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct PerMille(pub i16);

/// Position in the unit of the machine file (mm, degrees, turns …).
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Default)]
pub struct UserUnits(pub f64);

/// Velocity in user units per second.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Default)]
pub struct UserVelocity(pub f64);

/// Acceleration in user units per second².
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Default)]
pub struct UserAcceleration(pub f64);

/// Torque in percent of the motor's rated torque.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Default)]
pub struct Percent(pub f64);

/// Torque of the motor, before any gear.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Default)]
pub struct NewtonMetres(pub f64);

/// Torque-producing current.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Default)]
pub struct Amperes(pub f64);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unwraps_across_both_ends() {
        let mut p = Counts(i64::from(i32::MAX) - 1);
        p = p.unwrap_next(i32::MIN + 2);
        assert_eq!(p, Counts(i64::from(i32::MAX) + 3));
        assert_eq!(p.wrapped(), i32::MIN + 2);
        p = p.unwrap_next(i32::MAX - 5);
        assert_eq!(p, Counts(i64::from(i32::MAX) - 5));
        let q = Counts(i64::from(i32::MIN)).unwrap_next(i32::MAX);
        assert_eq!(q, Counts(i64::from(i32::MIN) - 1));
    }

    #[test]
    fn extremes_do_not_panic() {
        for start in [i64::MIN, -1, 0, i64::MAX] {
            for raw in [i32::MIN, -1, 0, i32::MAX] {
                let next = Counts(start).unwrap_next(raw);
                let _ = next.wrapped();
            }
        }
    }
}
