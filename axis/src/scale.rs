//! Conversion between the drive's integers and the user's units.
//!
//! The constructors check a [`Scale`]; afterwards no conversion fails. Values outside the range of
//! the wire type saturate. All conversions round to nearest.
//!
//! ```
//! use ecaxis_axis::units::{Counts, RawVelocity, UserUnits, UserVelocity};
//! use ecaxis_axis::{Scale, VelocityUnit};
//!
//! // 2000 counts and 5 mm per turn; the drive's velocities are in mrpm.
//! let scale = Scale::new(2000.0, 5.0)?.with_velocity_unit(VelocityUnit::MILLI_RPM);
//! assert_eq!(scale.position_to_counts(UserUnits(2.5)), Counts(1000));
//! assert_eq!(scale.velocity_to_raw(UserVelocity(5.0)), RawVelocity(60_000));
//! # Ok::<(), ecaxis_axis::ScaleError>(())
//! ```

mod drive_unit;
mod drive_units;
mod modulo;
mod torque;

pub use drive_unit::{
    AccelerationBase, AccelerationUnit, INCREMENTS, UnknownVelocityUnit, VelocityBase, VelocityUnit,
};
pub use drive_units::{DriveUnits, UnitMismatch, same_motor};
pub use modulo::ModuloDirection;
pub use torque::TorqueScale;

use crate::units::{
    Counts, PerMille, Percent, RawAcceleration, RawVelocity, UserAcceleration, UserUnits,
    UserVelocity,
};

/// A scale is invalid.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ScaleError {
    /// A factor is not a finite number above zero.
    #[error("{what} is {value}: it must be a finite number above zero")]
    NotPositive {
        /// The factor's name.
        what: &'static str,
        /// The rejected value.
        value: f64,
    },
    /// The offset is not finite.
    #[error("offset is {value}: it must be a finite number")]
    Offset {
        /// The rejected value.
        value: f64,
    },
    /// A ratio contains a zero.
    #[error("{what} is {above}:{below}: neither may be zero")]
    Ratio {
        /// The factor's name.
        what: &'static str,
        /// The numerator.
        above: u32,
        /// The denominator.
        below: u32,
    },
    /// The modulo range is too small or too large.
    #[error("a modulo of {value} units is less than 2 counts, or more than 2^31")]
    Modulo {
        /// The rejected value.
        value: f64,
    },
    /// A torque cannot be converted: a property of the motor is missing.
    #[error("{what} is not known, which a torque in {unit} needs")]
    Torque {
        /// The missing property.
        what: &'static str,
        /// The unit of the torque.
        unit: &'static str,
    },
    /// The resolution is out of range.
    #[error("one user unit is {counts_per_unit:e} counts, outside 1e-6 … 1e15")]
    Unusable {
        /// The counts of one user unit.
        counts_per_unit: f64,
    },
}

/// The conversions of one axis. `position = ±counts / counts_per_unit + offset`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scale {
    counts_per_turn: f64,
    units_per_turn: f64,
    velocity_unit: VelocityUnit,
    /// `None`: the velocity unit, per second.
    acceleration_unit: Option<AccelerationUnit>,
    invert: bool,
    offset: f64,
    modulo: Option<f64>,
    // Derived values. `invert` negates the first two.
    counts_per_unit: f64,
    raw_velocity_per_unit: f64,
    raw_acceleration_per_unit: f64,
}

/// The path from the encoder to the machine part, in the terms of the drive's objects.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drivetrain {
    /// Encoder increments (after quadrature) per motor turns (0x608F).
    pub encoder: [u32; 2],
    /// Motor turns per turns of the driving shaft (0x6091).
    pub gear: [u32; 2],
    /// User units per turn of the driving shaft.
    pub feed: f64,
}

impl Scale {
    /// Builds a scale. `counts_per_turn`: encoder counts per motor turn, after quadrature.
    /// `units_per_turn`: user units per motor turn, gear included.
    pub fn new(counts_per_turn: f64, units_per_turn: f64) -> Result<Self, ScaleError> {
        for (what, value) in [
            ("encoder counts per turn", counts_per_turn),
            ("user units per turn", units_per_turn),
        ] {
            if !(value.is_finite() && value > 0.0) {
                return Err(ScaleError::NotPositive { what, value });
            }
        }
        let counts_per_unit = counts_per_turn / units_per_turn;
        if !(1e-6..=1e15).contains(&counts_per_unit) {
            return Err(ScaleError::Unusable { counts_per_unit });
        }
        Ok(Self {
            counts_per_turn,
            units_per_turn,
            velocity_unit: VelocityUnit::default(),
            acceleration_unit: None,
            invert: false,
            offset: 0.0,
            modulo: None,
            counts_per_unit: 0.0,
            raw_velocity_per_unit: 0.0,
            raw_acceleration_per_unit: 0.0,
        }
        .derived())
    }

    /// Returns the scale of a motor with gear and feed.
    pub fn of_drivetrain(drivetrain: &Drivetrain) -> Result<Self, ScaleError> {
        let ratio = |what, [above, below]: [u32; 2]| {
            if above == 0 || below == 0 {
                Err(ScaleError::Ratio { what, above, below })
            } else {
                Ok((f64::from(above), f64::from(below)))
            }
        };
        let (increments, turns) = ratio("encoder resolution", drivetrain.encoder)?;
        let (motor, shaft) = ratio("gear ratio", drivetrain.gear)?;
        Self::new(increments / turns, drivetrain.feed * shaft / motor)
    }

    /// Sets the drive's unit of velocities (0x60A9).
    #[must_use]
    pub fn with_velocity_unit(mut self, unit: VelocityUnit) -> Self {
        self.velocity_unit = unit;
        self.derived()
    }

    /// Sets the unit of 0x60AA if it differs from the unit of 0x60A9 per second.
    #[must_use]
    pub fn with_acceleration_unit(mut self, unit: AccelerationUnit) -> Self {
        self.acceleration_unit = Some(unit);
        self.derived()
    }

    /// Inverts the direction if `invert` is set: positive user direction is negative drive
    /// direction (position, velocity and torque).
    #[must_use]
    pub fn with_invert(mut self, invert: bool) -> Self {
        self.invert = invert;
        self.derived()
    }

    /// Sets the user position at count 0.
    pub fn with_offset(mut self, offset: f64) -> Result<Self, ScaleError> {
        if !offset.is_finite() {
            return Err(ScaleError::Offset { value: offset });
        }
        self.offset = offset;
        Ok(self)
    }

    /// Sets the offset so that `counts` is the position `position`, as found by homing.
    pub fn homed(self, counts: Counts, position: UserUnits) -> Result<Self, ScaleError> {
        self.with_offset(position.0 - counts.0 as f64 / self.counts_per_unit)
    }

    fn derived(mut self) -> Self {
        let sign = self.sign();
        self.counts_per_unit = sign * self.counts_per_turn / self.units_per_turn;
        self.raw_velocity_per_unit = sign
            * self.velocity_unit.per_turn_per_second(self.counts_per_turn)
            / self.units_per_turn;
        self.raw_acceleration_per_unit = self
            .acceleration_unit()
            .per_turn_per_second_squared(self.counts_per_turn)
            / self.units_per_turn;
        self
    }

    fn sign(&self) -> f64 {
        if self.invert { -1.0 } else { 1.0 }
    }

    /// Returns encoder counts per user unit. The result is always positive.
    #[must_use]
    pub fn counts_per_unit(&self) -> f64 {
        self.counts_per_unit.abs()
    }

    /// Returns the counts per motor turn.
    #[must_use]
    pub const fn counts_per_turn(&self) -> f64 {
        self.counts_per_turn
    }

    /// Returns the user units per motor turn.
    #[must_use]
    pub const fn units_per_turn(&self) -> f64 {
        self.units_per_turn
    }

    /// Returns the drive's unit of velocities.
    #[must_use]
    pub const fn velocity_unit(&self) -> VelocityUnit {
        self.velocity_unit
    }

    /// Returns the drive's unit of accelerations.
    #[must_use]
    pub fn acceleration_unit(&self) -> AccelerationUnit {
        self.acceleration_unit
            .unwrap_or_else(|| self.velocity_unit.into())
    }

    /// True if user units and counts have opposite directions.
    #[must_use]
    pub const fn inverted(&self) -> bool {
        self.invert
    }

    /// Returns the position in user units at 0 counts.
    #[must_use]
    pub const fn offset(&self) -> f64 {
        self.offset
    }

    /// Returns the length of `counts` in user units, without offset or sign.
    #[must_use]
    pub fn units_of_counts(&self, counts: f64) -> f64 {
        counts / self.counts_per_unit()
    }

    /// Returns the smallest step of the drive's velocity, user units per second.
    #[must_use]
    pub fn velocity_resolution(&self) -> f64 {
        1.0 / self.raw_velocity_per_unit.abs()
    }

    /// Converts a position.
    #[must_use]
    pub fn position_to_user(&self, counts: Counts) -> UserUnits {
        UserUnits(counts.0 as f64 / self.counts_per_unit + self.offset)
    }

    /// Returns the valid positions of an axis without a configured range. Beyond 1e15 counts, f64
    /// does not represent every count.
    #[must_use]
    pub fn range(&self) -> [f64; 2] {
        let far = self.units_of_counts(1e15);
        [self.offset() - far, self.offset() + far]
    }

    /// Converts a position, rounded to the nearest count.
    #[must_use]
    pub fn position_to_counts(&self, position: UserUnits) -> Counts {
        Counts(round_i64((position.0 - self.offset) * self.counts_per_unit))
    }

    /// Converts a velocity.
    #[must_use]
    pub fn velocity_to_user(&self, raw: RawVelocity) -> UserVelocity {
        UserVelocity(f64::from(raw.0) / self.raw_velocity_per_unit)
    }

    /// Converts a velocity, rounded to the drive's resolution.
    #[must_use]
    pub fn velocity_to_raw(&self, velocity: UserVelocity) -> RawVelocity {
        RawVelocity(round_i32(velocity.0 * self.raw_velocity_per_unit))
    }

    /// Converts an acceleration from the unit of 0x60AA. The direction does not matter.
    #[must_use]
    pub fn acceleration_to_user(&self, raw: RawAcceleration) -> UserAcceleration {
        UserAcceleration(f64::from(raw.0) / self.raw_acceleration_per_unit)
    }

    /// Converts an acceleration, rounded to the drive's resolution.
    #[must_use]
    pub fn acceleration_to_raw(&self, acceleration: UserAcceleration) -> RawAcceleration {
        let raw = (acceleration.0 * self.raw_acceleration_per_unit)
            .abs()
            .round();
        // `as` saturates floats and maps NaN to 0.
        RawAcceleration(raw as u32)
    }

    /// Converts a torque.
    #[must_use]
    pub fn torque_to_user(&self, raw: PerMille) -> Percent {
        Percent(f64::from(raw.0) / 10.0 * self.sign())
    }

    /// Converts a torque, rounded to per mille.
    #[must_use]
    pub fn torque_to_raw(&self, torque: Percent) -> PerMille {
        PerMille((torque.0 * 10.0 * self.sign()).round() as i16)
    }
}

// `as` from float to integer saturates and maps NaN to 0. Both functions below rely on this.

fn round_i64(value: f64) -> i64 {
    value.round() as i64
}

fn round_i32(value: f64) -> i32 {
    value.round() as i32
}

#[cfg(test)]
mod tests;
