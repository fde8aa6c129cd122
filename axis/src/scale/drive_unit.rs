//! The units of the drive's integers: 0x60A9 and 0x60AA in the codes of CiA 303-2.

use core::fmt;

// Notation indices.
const REVOLUTION: u8 = 0xB4;
const INCREMENT: u8 = 0xB5;
/// Revolutions per minute in one code.
const RPM: u8 = 0xC0;
const PER_SECOND: u8 = 0x03;
const PER_MINUTE: u8 = 0x47;
const PER_SECOND_SQUARED: u8 = 0x57;
const PREFIXES: core::ops::RangeInclusive<i8> = -9..=9;

/// The value of 0x60A8 for encoder increments, which [`crate::units::Counts`] requires.
pub const INCREMENTS: u32 = write((INCREMENT, 0), 0);

/// Splits a code: numerator in bits 16–23, denominator in bits 8–15, signed power of ten in bits
/// 24–31.
fn read(code: u32) -> Option<((u8, u8), i8)> {
    let [reserved, denominator, numerator, prefix] = code.to_le_bytes();
    let prefix = i8::from_le_bytes([prefix]);
    (reserved == 0 && PREFIXES.contains(&prefix)).then_some(((numerator, denominator), prefix))
}

const fn write((numerator, denominator): (u8, u8), prefix: i8) -> u32 {
    let [prefix] = prefix.to_le_bytes();
    u32::from_le_bytes([0, denominator, numerator, prefix])
}

/// The base unit of a velocity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum VelocityBase {
    /// Counts per second.
    CountsPerSecond,
    /// Motor turns per second.
    TurnsPerSecond,
    /// Motor turns per minute.
    TurnsPerMinute,
}

/// The unit of the drive's velocity objects (0x60A9): `10^prefix × base`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct VelocityUnit {
    base: VelocityBase,
    prefix: i8,
}

impl VelocityUnit {
    /// Counts per second.
    pub const COUNTS_PER_SECOND: Self = Self::of(VelocityBase::CountsPerSecond);
    /// Motor turns per second.
    pub const TURNS_PER_SECOND: Self = Self::of(VelocityBase::TurnsPerSecond);
    /// Motor turns per minute.
    pub const RPM: Self = Self::of(VelocityBase::TurnsPerMinute);
    /// Thousandths of motor turns per minute.
    pub const MILLI_RPM: Self = Self {
        base: VelocityBase::TurnsPerMinute,
        prefix: -3,
    };

    const fn of(base: VelocityBase) -> Self {
        Self { base, prefix: 0 }
    }

    /// Decodes the value of 0x60A9. Returns `None` for a unit other than counts or turns per time.
    #[must_use]
    pub fn from_si_code(code: u32) -> Option<Self> {
        let (fraction, prefix) = read(code)?;
        let base = match fraction {
            (INCREMENT, PER_SECOND) => VelocityBase::CountsPerSecond,
            (REVOLUTION, PER_SECOND) => VelocityBase::TurnsPerSecond,
            (REVOLUTION, PER_MINUTE) => VelocityBase::TurnsPerMinute,
            _ => return None,
        };
        Some(Self { base, prefix })
    }

    /// Returns the value of 0x60A9 for this unit.
    #[must_use]
    pub const fn si_code(self) -> u32 {
        let fraction = match self.base {
            VelocityBase::CountsPerSecond => (INCREMENT, PER_SECOND),
            VelocityBase::TurnsPerSecond => (REVOLUTION, PER_SECOND),
            VelocityBase::TurnsPerMinute => (REVOLUTION, PER_MINUTE),
        };
        write(fraction, self.prefix)
    }

    /// Returns the unit without its prefix.
    #[must_use]
    pub const fn base(self) -> VelocityBase {
        self.base
    }

    /// Returns the power of ten.
    #[must_use]
    pub const fn prefix(self) -> i8 {
        self.prefix
    }

    /// Returns the value of one turn per second in this unit.
    pub(super) fn per_turn_per_second(self, counts_per_turn: f64) -> f64 {
        let base = match self.base {
            VelocityBase::CountsPerSecond => counts_per_turn,
            VelocityBase::TurnsPerSecond => 1.0,
            VelocityBase::TurnsPerMinute => 60.0,
        };
        base * 10f64.powi(-i32::from(self.prefix))
    }
}

impl Default for VelocityUnit {
    /// The unit assumed for a drive without 0x60A9.
    fn default() -> Self {
        Self::COUNTS_PER_SECOND
    }
}

/// The text is not a power of ten times `rpm`, `counts/s` or `turns/s`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "a unit of velocity is `rpm`, `mrpm`, `counts/s` or `turns/s`, with a power of ten before it"
)]
pub struct UnknownVelocityUnit;

/// The names of the base units.
const VELOCITY_BASES: [(&str, VelocityBase); 3] = [
    ("counts/s", VelocityBase::CountsPerSecond),
    ("turns/s", VelocityBase::TurnsPerSecond),
    ("rpm", VelocityBase::TurnsPerMinute),
];

/// Parses a power of ten: `0.1`, `100` or `10^-5`. An empty text is 1.
fn power_of_ten(text: &str) -> Option<i8> {
    let mut prefixes = PREFIXES;
    let prefix = match text.strip_prefix("10^") {
        Some(exponent) => exponent.parse().ok()?,
        None if text.is_empty() => 0,
        None => prefixes.find(|prefix| factor(*prefix) == text)?,
    };
    PREFIXES.contains(&prefix).then_some(prefix)
}

/// Returns the decimal digits of a power of ten.
fn factor(prefix: i8) -> String {
    let zeros = usize::from(prefix.unsigned_abs());
    match prefix {
        ..0 => format!("0.{}1", "0".repeat(zeros - 1)),
        _ => format!("1{}", "0".repeat(zeros)),
    }
}

impl core::str::FromStr for VelocityUnit {
    type Err = UnknownVelocityUnit;

    /// Parses `rpm`, `mrpm`, `0.1rpm`, `10^-5 turns/s`. Allocates: do not call in the cycle.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if text == "mrpm" {
            return Ok(Self::MILLI_RPM);
        }
        let mut bases = VELOCITY_BASES.into_iter();
        let unit = bases.find_map(|(name, base)| {
            let prefix = power_of_ten(text.strip_suffix(name)?.trim_end())?;
            Some(Self { base, prefix })
        });
        unit.ok_or(UnknownVelocityUnit)
    }
}

impl fmt::Display for VelocityUnit {
    /// Writes a text that [`VelocityUnit::from_str`](core::str::FromStr) parses.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut bases = VELOCITY_BASES.iter();
        let base = bases.find(|(_, base)| *base == self.base);
        let base = base.map_or("", |(name, _)| name);
        match (self.prefix, self.base) {
            (0, _) => f.write_str(base),
            (-1, _) => write!(f, "0.1 {base}"),
            (-2, _) => write!(f, "0.01 {base}"),
            (-3, VelocityBase::TurnsPerMinute) => f.write_str("mrpm"),
            (prefix, _) => write!(f, "10^{prefix} {base}"),
        }
    }
}

/// The base unit of an acceleration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum AccelerationBase {
    /// Counts per second².
    CountsPerSecondSquared,
    /// Motor turns per second².
    TurnsPerSecondSquared,
    /// Motor turns per minute and second.
    TurnsPerMinutePerSecond,
}

/// The unit of the drive's acceleration objects (0x60AA): `10^prefix × base`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct AccelerationUnit {
    base: AccelerationBase,
    prefix: i8,
}

impl AccelerationUnit {
    /// Motor turns per minute and second.
    pub const RPM_PER_SECOND: Self = Self {
        base: AccelerationBase::TurnsPerMinutePerSecond,
        prefix: 0,
    };

    /// Decodes the value of 0x60AA. Returns `None` for a unit other than counts or turns per time².
    #[must_use]
    pub fn from_si_code(code: u32) -> Option<Self> {
        let (fraction, prefix) = read(code)?;
        let base = match fraction {
            (INCREMENT, PER_SECOND_SQUARED) => AccelerationBase::CountsPerSecondSquared,
            (REVOLUTION, PER_SECOND_SQUARED) => AccelerationBase::TurnsPerSecondSquared,
            (RPM, PER_SECOND) => AccelerationBase::TurnsPerMinutePerSecond,
            _ => return None,
        };
        Some(Self { base, prefix })
    }

    /// Returns the value of 0x60AA for this unit.
    #[must_use]
    pub const fn si_code(self) -> u32 {
        let fraction = match self.base {
            AccelerationBase::CountsPerSecondSquared => (INCREMENT, PER_SECOND_SQUARED),
            AccelerationBase::TurnsPerSecondSquared => (REVOLUTION, PER_SECOND_SQUARED),
            AccelerationBase::TurnsPerMinutePerSecond => (RPM, PER_SECOND),
        };
        write(fraction, self.prefix)
    }

    /// Returns the value of one turn per second² in this unit.
    pub(super) fn per_turn_per_second_squared(self, counts_per_turn: f64) -> f64 {
        let base = match self.base {
            AccelerationBase::CountsPerSecondSquared => counts_per_turn,
            AccelerationBase::TurnsPerSecondSquared => 1.0,
            AccelerationBase::TurnsPerMinutePerSecond => 60.0,
        };
        base * 10f64.powi(-i32::from(self.prefix))
    }
}

impl From<VelocityUnit> for AccelerationUnit {
    /// The velocity unit per second.
    fn from(unit: VelocityUnit) -> Self {
        Self {
            base: match unit.base {
                VelocityBase::CountsPerSecond => AccelerationBase::CountsPerSecondSquared,
                VelocityBase::TurnsPerSecond => AccelerationBase::TurnsPerSecondSquared,
                VelocityBase::TurnsPerMinute => AccelerationBase::TurnsPerMinutePerSecond,
            },
            prefix: unit.prefix,
        }
    }
}

impl fmt::Display for AccelerationUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let base = match self.base {
            AccelerationBase::CountsPerSecondSquared => "counts/s²",
            AccelerationBase::TurnsPerSecondSquared => "turns/s²",
            AccelerationBase::TurnsPerMinutePerSecond => "rpm/s",
        };
        match self.prefix {
            0 => f.write_str(base),
            prefix => write!(f, "10^{prefix} {base}"),
        }
    }
}
