//! Between the drive's integers and the user's units.
//!
//! A [`Scale`] is checked when it is built; afterwards no conversion fails: values outside the wire's range saturate, and
//! everything is rounded to nearest.

use core::fmt;

use crate::units::{
    Counts, PerMille, Percent, RawAcceleration, RawVelocity, UserAcceleration, UserUnits,
    UserVelocity,
};

/// What a velocity counts: encoder increments or turns of the motor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum VelocityBase {
    CountsPerSecond,
    TurnsPerSecond,
    TurnsPerMinute,
}

/// The unit of the drive's velocity objects, as 0x60A9 tells it: `10^prefix × base`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct VelocityUnit {
    base: VelocityBase,
    prefix: i8,
}

impl VelocityUnit {
    pub const COUNTS_PER_SECOND: Self = Self::of(VelocityBase::CountsPerSecond);
    pub const TURNS_PER_SECOND: Self = Self::of(VelocityBase::TurnsPerSecond);
    pub const RPM: Self = Self::of(VelocityBase::TurnsPerMinute);
    pub const MILLI_RPM: Self = Self {
        base: VelocityBase::TurnsPerMinute,
        prefix: -3,
    };

    // CiA 303-2 notation indices: numerator in bits 16–23, denominator in bits 8–15, signed power of ten in bits 24–31.
    const REVOLUTION: u8 = 0xB4;
    const INCREMENT: u8 = 0xB5;
    const PER_SECOND: u8 = 0x03;
    const PER_MINUTE: u8 = 0x47;
    const PREFIXES: core::ops::RangeInclusive<i8> = -9..=9;

    const fn of(base: VelocityBase) -> Self {
        Self { base, prefix: 0 }
    }

    /// Reads the value of 0x60A9. `None` for a unit that is not a velocity of counts or turns.
    #[must_use]
    pub fn from_si_code(code: u32) -> Option<Self> {
        let [reserved, denominator, numerator, prefix] = code.to_le_bytes();
        let prefix = i8::from_le_bytes([prefix]);
        let base = match (numerator, denominator) {
            (Self::INCREMENT, Self::PER_SECOND) => VelocityBase::CountsPerSecond,
            (Self::REVOLUTION, Self::PER_SECOND) => VelocityBase::TurnsPerSecond,
            (Self::REVOLUTION, Self::PER_MINUTE) => VelocityBase::TurnsPerMinute,
            _ => return None,
        };
        (reserved == 0 && Self::PREFIXES.contains(&prefix)).then_some(Self { base, prefix })
    }

    /// The value of 0x60A9 that means this unit.
    #[must_use]
    pub const fn si_code(self) -> u32 {
        let (numerator, denominator) = match self.base {
            VelocityBase::CountsPerSecond => (Self::INCREMENT, Self::PER_SECOND),
            VelocityBase::TurnsPerSecond => (Self::REVOLUTION, Self::PER_SECOND),
            VelocityBase::TurnsPerMinute => (Self::REVOLUTION, Self::PER_MINUTE),
        };
        let [prefix] = self.prefix.to_le_bytes();
        u32::from_le_bytes([0, denominator, numerator, prefix])
    }

    #[must_use]
    pub const fn base(self) -> VelocityBase {
        self.base
    }

    /// Power of ten.
    #[must_use]
    pub const fn prefix(self) -> i8 {
        self.prefix
    }

    /// How many of this unit one turn per second is.
    fn per_turn_per_second(self, counts_per_turn: f64) -> f64 {
        let base = match self.base {
            VelocityBase::CountsPerSecond => counts_per_turn,
            VelocityBase::TurnsPerSecond => 1.0,
            VelocityBase::TurnsPerMinute => 60.0,
        };
        base * 10f64.powi(-i32::from(self.prefix))
    }
}

impl Default for VelocityUnit {
    /// What a drive without 0x60A9 is taken to use.
    fn default() -> Self {
        Self::COUNTS_PER_SECOND
    }
}

impl fmt::Display for VelocityUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let base = match self.base {
            VelocityBase::CountsPerSecond => "counts/s",
            VelocityBase::TurnsPerSecond => "turns/s",
            VelocityBase::TurnsPerMinute => "rpm",
        };
        match (self.prefix, self.base) {
            (0, _) => f.write_str(base),
            (-3, VelocityBase::TurnsPerMinute) => f.write_str("mrpm"),
            (prefix, _) => write!(f, "10^{prefix} {base}"),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum ScaleError {
    #[error("{what} is {value}: it must be a finite number above zero")]
    NotPositive { what: &'static str, value: f64 },
    #[error("offset is {value}: it must be a finite number")]
    Offset { value: f64 },
    #[error("one user unit is {counts_per_unit:e} counts, outside 1e-6 … 1e15")]
    Unusable { counts_per_unit: f64 },
}

/// One axis's conversions. `position = ±counts / counts_per_unit + offset`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scale {
    counts_per_turn: f64,
    units_per_turn: f64,
    velocity_unit: VelocityUnit,
    invert: bool,
    offset: f64,
    // Derived; the sign of `invert` is in both.
    counts_per_unit: f64,
    raw_velocity_per_unit: f64,
}

impl Scale {
    /// `counts_per_turn`: encoder counts per motor turn (after quadrature). `units_per_turn`: user units per motor turn, gear included.
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
            invert: false,
            offset: 0.0,
            counts_per_unit: 0.0,
            raw_velocity_per_unit: 0.0,
        }
        .derived())
    }

    #[must_use]
    pub fn with_velocity_unit(mut self, unit: VelocityUnit) -> Self {
        self.velocity_unit = unit;
        self.derived()
    }

    /// Positive user direction is the drive's negative one (position, velocity and torque).
    #[must_use]
    pub fn with_invert(mut self, invert: bool) -> Self {
        self.invert = invert;
        self.derived()
    }

    /// User position at count 0.
    pub fn with_offset(mut self, offset: f64) -> Result<Self, ScaleError> {
        if !offset.is_finite() {
            return Err(ScaleError::Offset { value: offset });
        }
        self.offset = offset;
        Ok(self)
    }

    fn derived(mut self) -> Self {
        let sign = self.sign();
        self.counts_per_unit = sign * self.counts_per_turn / self.units_per_turn;
        self.raw_velocity_per_unit = sign
            * self.velocity_unit.per_turn_per_second(self.counts_per_turn)
            / self.units_per_turn;
        self
    }

    fn sign(&self) -> f64 {
        if self.invert { -1.0 } else { 1.0 }
    }

    /// Always positive.
    #[must_use]
    pub fn counts_per_unit(&self) -> f64 {
        self.counts_per_unit.abs()
    }

    #[must_use]
    pub const fn counts_per_turn(&self) -> f64 {
        self.counts_per_turn
    }

    #[must_use]
    pub const fn units_per_turn(&self) -> f64 {
        self.units_per_turn
    }

    #[must_use]
    pub const fn velocity_unit(&self) -> VelocityUnit {
        self.velocity_unit
    }

    #[must_use]
    pub const fn inverted(&self) -> bool {
        self.invert
    }

    #[must_use]
    pub const fn offset(&self) -> f64 {
        self.offset
    }

    /// A length of so many counts, without offset or sign.
    #[must_use]
    pub fn units_of_counts(&self, counts: f64) -> f64 {
        counts / self.counts_per_unit()
    }

    /// The smallest step of the drive's velocity, in user units per second.
    #[must_use]
    pub fn velocity_resolution(&self) -> f64 {
        1.0 / self.raw_velocity_per_unit.abs()
    }

    #[must_use]
    pub fn position_to_user(&self, counts: Counts) -> UserUnits {
        UserUnits(counts.0 as f64 / self.counts_per_unit + self.offset)
    }

    #[must_use]
    pub fn position_to_counts(&self, position: UserUnits) -> Counts {
        Counts(round_i64((position.0 - self.offset) * self.counts_per_unit))
    }

    #[must_use]
    pub fn velocity_to_user(&self, raw: RawVelocity) -> UserVelocity {
        UserVelocity(f64::from(raw.0) / self.raw_velocity_per_unit)
    }

    #[must_use]
    pub fn velocity_to_raw(&self, velocity: UserVelocity) -> RawVelocity {
        RawVelocity(round_i32(velocity.0 * self.raw_velocity_per_unit))
    }

    /// In the unit of 0x60A9 per second; direction does not matter to an acceleration.
    #[must_use]
    pub fn acceleration_to_user(&self, raw: RawAcceleration) -> UserAcceleration {
        UserAcceleration(f64::from(raw.0) * self.velocity_resolution())
    }

    #[must_use]
    pub fn acceleration_to_raw(&self, acceleration: UserAcceleration) -> RawAcceleration {
        let raw = (acceleration.0 * self.raw_velocity_per_unit).abs().round();
        // `as` saturates floats, and maps NaN to 0.
        RawAcceleration(raw as u32)
    }

    #[must_use]
    pub fn torque_to_user(&self, raw: PerMille) -> Percent {
        Percent(f64::from(raw.0) / 10.0 * self.sign())
    }

    #[must_use]
    pub fn torque_to_raw(&self, torque: Percent) -> PerMille {
        PerMille((torque.0 * 10.0 * self.sign()).round() as i16)
    }
}

// `as` from float to integer saturates and maps NaN to 0, which is what the two below rely on.

fn round_i64(value: f64) -> i64 {
    value.round() as i64
}

fn round_i32(value: f64) -> i32 {
    value.round() as i32
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn epos(unit: VelocityUnit) -> Scale {
        Scale::new(2000.0, 5.0).unwrap().with_velocity_unit(unit)
    }

    #[test]
    fn si_codes() {
        for (code, unit, text) in [
            (0x00B4_4700, VelocityUnit::RPM, "rpm"),
            (0xFDB4_4700, VelocityUnit::MILLI_RPM, "mrpm"),
            (0x00B5_0300, VelocityUnit::COUNTS_PER_SECOND, "counts/s"),
            (0x00B4_0300, VelocityUnit::TURNS_PER_SECOND, "turns/s"),
        ] {
            assert_eq!(VelocityUnit::from_si_code(code), Some(unit));
            assert_eq!(unit.si_code(), code);
            assert_eq!(unit.to_string(), text);
        }
        assert_eq!(
            VelocityUnit::from_si_code(0xFEB4_4700).unwrap().to_string(),
            "10^-2 rpm"
        );
        // An acceleration, a position, nonsense.
        for code in [0x00C0_0300, 0x00B5_0000, 0, u32::MAX, 0x80B4_4700] {
            assert_eq!(VelocityUnit::from_si_code(code), None, "{code:#010x}");
        }
    }

    #[test]
    fn velocity_in_each_unit() {
        // 5 mm per turn: 200 mm/s is 40 turns/s.
        for (unit, raw) in [
            (VelocityUnit::RPM, 2400),
            (VelocityUnit::MILLI_RPM, 2_400_000),
            (VelocityUnit::COUNTS_PER_SECOND, 80_000),
            (VelocityUnit::TURNS_PER_SECOND, 40),
        ] {
            let scale = epos(unit);
            assert_eq!(
                scale.velocity_to_raw(UserVelocity(200.0)),
                RawVelocity(raw),
                "{unit}"
            );
            assert_eq!(
                scale.velocity_to_user(RawVelocity(raw)),
                UserVelocity(200.0)
            );
            assert_eq!(
                scale.acceleration_to_raw(UserAcceleration(200.0)).0,
                raw.unsigned_abs()
            );
        }
    }

    #[test]
    fn rounds_to_nearest() {
        let scale = Scale::new(1.0, 1.0).unwrap();
        for (user, counts) in [(0.4, 0), (0.6, 1), (-0.4, 0), (-0.6, -1), (2.5, 3)] {
            assert_eq!(scale.position_to_counts(UserUnits(user)), Counts(counts));
        }
        assert_eq!(scale.torque_to_raw(Percent(12.36)), PerMille(124));
    }

    #[test]
    fn inversion_and_offset() {
        let scale = epos(VelocityUnit::RPM)
            .with_invert(true)
            .with_offset(10.0)
            .unwrap();
        assert_eq!(scale.position_to_counts(UserUnits(15.0)), Counts(-2000));
        assert_eq!(scale.position_to_user(Counts(-2000)), UserUnits(15.0));
        assert_eq!(scale.velocity_to_raw(UserVelocity(5.0)), RawVelocity(-60));
        assert_eq!(scale.torque_to_raw(Percent(5.0)), PerMille(-50));
        assert_eq!(scale.torque_to_user(PerMille(-50)), Percent(5.0));
        assert!(scale.counts_per_unit() > 0.0);
    }

    #[test]
    fn nonsense_is_refused() {
        for (counts, units) in [
            (0.0, 1.0),
            (-1.0, 1.0),
            (f64::NAN, 1.0),
            (1.0, 0.0),
            (1.0, f64::INFINITY),
            (1e300, 1e-300),
        ] {
            assert!(Scale::new(counts, units).is_err(), "{counts} {units}");
        }
        assert!(Scale::new(1.0, 1.0).unwrap().with_offset(f64::NAN).is_err());
    }

    proptest! {
        #[test]
        fn counts_round_trip(
            counts in -(1i64 << 40)..(1i64 << 40),
            per_turn in 1.0..1e7f64,
            units in 1e-3..1e3f64,
            invert: bool,
            offset in -1e3..1e3f64,
        ) {
            let scale = Scale::new(per_turn, units).unwrap().with_invert(invert).with_offset(offset).unwrap();
            prop_assert_eq!(scale.position_to_counts(scale.position_to_user(Counts(counts))), Counts(counts));
        }

        #[test]
        fn any_code_survives(code: u32) {
            if let Some(unit) = VelocityUnit::from_si_code(code) {
                prop_assert_eq!(unit.si_code(), code);
            }
        }

        #[test]
        fn any_value_converts(bits: u64) {
            let value = f64::from_bits(bits);
            let scale = epos(VelocityUnit::RPM);
            let _ = scale.position_to_counts(UserUnits(value));
            let _ = scale.velocity_to_raw(UserVelocity(value));
            let _ = scale.acceleration_to_raw(UserAcceleration(value));
            let _ = scale.torque_to_raw(Percent(value));
        }
    }
}
