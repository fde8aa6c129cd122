//! Units read from a drive, compared with the configuration of the axis.

use core::fmt;

use super::{AccelerationUnit, INCREMENTS, Scale, VelocityUnit};

/// Unit objects as read from the drive. `None`: the drive does not have the object, or it was not
/// read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DriveUnits {
    /// 0x608F: encoder increments, motor turns.
    pub encoder_resolution: Option<[u32; 2]>,
    /// 0x6091: motor turns, driving shaft turns.
    pub gear_ratio: Option<[u32; 2]>,
    /// 0x6092: feed in position units, driving shaft turns.
    pub feed_constant: Option<[u32; 2]>,
    /// 0x60A8.
    pub position_unit: Option<u32>,
    /// 0x60A9.
    pub velocity_unit: Option<u32>,
    /// 0x60AA.
    pub acceleration_unit: Option<u32>,
    /// 0x6076, in the drive's unit (mNm by the standard; EPOS4 counts µNm).
    pub rated_torque: Option<u32>,
    /// maxon's 0x3001:05, µNm/A.
    pub torque_constant: Option<u32>,
    /// 0x607E: bit 7 position, bit 6 velocity, bit 5 torque (not of CiA 402-2; several vendors).
    pub polarity: Option<u8>,
}

/// A contradiction between the drive and the configuration.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum UnitMismatch {
    /// A ratio with a zero.
    Ratio {
        /// The object that decides.
        index: u16,
        /// The numerator.
        above: u32,
        /// The denominator.
        below: u32,
    },
    /// Position units per motor turn, computed from 0x608F, 0x6091 and 0x6092. `index` is the
    /// object that decides.
    CountsPerTurn {
        /// The object that decides.
        index: u16,
        /// The configured value.
        expected: f64,
        /// The value of the drive.
        found: f64,
    },
    /// 0x6091 scales the counts of an encoder that the drive does not report (no 0x608F, 0x6092).
    GearAlone {
        /// Motor turns, driving shaft turns.
        gear: [u32; 2],
        /// The configured counts per motor turn.
        expected: f64,
    },
    /// 0x60A8.
    PositionUnit {
        /// The value of the drive.
        found: u32,
    },
    /// 0x60A9.
    VelocityUnit {
        /// The configured value.
        expected: VelocityUnit,
        /// The value of the drive.
        found: u32,
    },
    /// 0x60AA.
    AccelerationUnit {
        /// The configured value.
        expected: AccelerationUnit,
        /// The value of the drive.
        found: u32,
    },
    /// 0x6076 in the drive's unit; `expected` is the configured value, if any.
    RatedTorque {
        /// The configured value.
        expected: Option<u32>,
        /// The value of the drive.
        found: u32,
    },
    /// maxon's 0x3001:05, µNm/A. [`DriveUnits::contradictions`] does not report it; the caller
    /// compares the configured value.
    TorqueConstant {
        /// The configured value.
        expected: u32,
        /// The value of the drive.
        found: u32,
    },
    /// 0x607E: the drive inverts position, velocity or torque.
    Polarity {
        /// The value of the drive.
        found: u8,
    },
}

/// Largest relative difference between equal ratios. A larger difference is another gear.
const SAME: f64 = 1e-9;

/// Largest relative difference between equal motor data. Torque commands have this resolution.
const SAME_TORQUE: f64 = 1e-3;

/// Returns true if a motor parameter has the expected value. Both are in the drive's unit.
#[must_use]
pub fn same_motor(expected: u32, found: u32) -> bool {
    let (expected, found) = (f64::from(expected), f64::from(found));
    (expected - found).abs() <= expected * SAME_TORQUE
}

/// The bits of 0x607E that turn values: position, velocity, torque.
const POLARITIES: u8 = 0xE0;

impl DriveUnits {
    /// Returns position units per motor turn, computed from 0x608F, 0x6091 and 0x6092, and the
    /// index of the object that decides. Returns `None` if the drive does not report them.
    #[must_use]
    pub fn counts_per_turn(&self) -> Option<(u16, f64)> {
        let ratio = |ratio: Option<[u32; 2]>| {
            let [above, below] = ratio.filter(|[above, below]| *above > 0 && *below > 0)?;
            Some(f64::from(above) / f64::from(below))
        };
        said(
            ratio(self.encoder_resolution),
            ratio(self.gear_ratio),
            ratio(self.feed_constant),
        )
    }

    /// Returns all contradictions to `scale` and to the rated torque, if given (in the unit of
    /// 0x6076). Allocates: do not call in the cycle.
    #[must_use]
    pub fn contradictions(&self, scale: &Scale, rated_torque: Option<u32>) -> Vec<UnitMismatch> {
        let mut found = Vec::new();
        let ratio = |index: u16, ratio: Option<[u32; 2]>, found: &mut Vec<_>| match ratio? {
            [above, below] if above == 0 || below == 0 => {
                found.push(UnitMismatch::Ratio {
                    index,
                    above,
                    below,
                });
                None
            }
            [above, below] => Some(f64::from(above) / f64::from(below)),
        };
        let encoder = ratio(0x608F, self.encoder_resolution, &mut found);
        let gear = ratio(0x6091, self.gear_ratio, &mut found);
        let feed = ratio(0x6092, self.feed_constant, &mut found);
        found.extend(match (encoder, feed.filter(|&feed| feed != 1.0), gear) {
            (None, None, Some(_)) => self
                .gear_ratio
                .and_then(|gear| gear_alone(gear, scale.counts_per_turn())),
            _ => counts_per_turn(encoder, gear, feed, scale),
        });
        if let Some(code) = self.position_unit
            && code != INCREMENTS
        {
            found.push(UnitMismatch::PositionUnit { found: code });
        }
        if let Some(code) = self.velocity_unit
            && VelocityUnit::from_si_code(code) != Some(scale.velocity_unit())
        {
            found.push(UnitMismatch::VelocityUnit {
                expected: scale.velocity_unit(),
                found: code,
            });
        }
        if let Some(code) = self.acceleration_unit
            && AccelerationUnit::from_si_code(code) != Some(scale.acceleration_unit())
        {
            found.push(UnitMismatch::AccelerationUnit {
                expected: scale.acceleration_unit(),
                found: code,
            });
        }
        if let Some(torque) = self.rated_torque {
            let other = |expected: u32| !same_motor(expected, torque);
            if torque == 0 || rated_torque.is_some_and(other) {
                found.push(UnitMismatch::RatedTorque {
                    expected: rated_torque,
                    found: torque,
                });
            }
        }
        if let Some(polarity) = self.polarity
            && polarity & POLARITIES != 0
        {
            found.push(UnitMismatch::Polarity { found: polarity });
        }
        found
    }
}

/// Returns position units per motor turn and the object that decides.
///
/// A drive with a feed constant counts it per turn of the driving shaft. A drive without one counts
/// its encoder. Drives that do not use the feed constant report 1: one count per turn would allow
/// no positioning.
fn said(encoder: Option<f64>, gear: Option<f64>, feed: Option<f64>) -> Option<(u16, f64)> {
    let feed = feed.filter(|&feed| feed != 1.0);
    let gear_ratio = gear.unwrap_or(1.0);
    match (feed, encoder) {
        (Some(counts), _) => Some((0x6092, counts / gear_ratio)),
        (None, Some(counts)) if gear_ratio != 1.0 => Some((0x6091, counts / gear_ratio)),
        (None, Some(counts)) => Some((0x608F, counts)),
        (None, None) => None,
    }
}

/// Returns the counts of a motor turn before the gear.
fn counts_before([motor, shaft]: [u32; 2], counts: f64) -> f64 {
    counts * f64::from(motor) / f64::from(shaft)
}

/// Returns true if an encoder can have this resolution: a whole number of counts, and a power of
/// two as absolute encoders have it.
fn is_absolute_resolution(counts: f64) -> bool {
    let whole = counts.round();
    (counts - whole).abs() <= counts * SAME
        && (2.0..=f64::from(u32::MAX)).contains(&whole)
        && (whole as u64).is_power_of_two()
}

/// Checks a gear of a drive that reports neither its encoder nor a feed constant. Users write the
/// encoder's resolution and the counts that they want: then the denominator is the configured
/// figure.
fn gear_alone(gear: [u32; 2], expected: f64) -> Option<UnitMismatch> {
    let [motor, shaft] = gear;
    let is_usual = (f64::from(shaft) - expected).abs() <= expected * SAME;
    (motor != shaft && !is_usual).then_some(UnitMismatch::GearAlone { gear, expected })
}

fn counts_per_turn(
    encoder: Option<f64>,
    gear: Option<f64>,
    feed: Option<f64>,
    scale: &Scale,
) -> Option<UnitMismatch> {
    let expected = scale.counts_per_turn();
    let (index, found) = said(encoder, gear, feed)?;
    let same = (found - expected).abs() <= expected * SAME;
    (!same).then_some(UnitMismatch::CountsPerTurn {
        index,
        expected,
        found,
    })
}

impl UnitMismatch {
    /// Returns true if a gear without 0x608F cannot belong to the configured counts per turn: no
    /// encoder has the resolution that follows.
    #[must_use]
    pub fn is_impossible_gear(&self) -> bool {
        match *self {
            Self::GearAlone { gear, expected } => {
                !is_absolute_resolution(counts_before(gear, expected))
            }
            _ => false,
        }
    }

    /// Returns index and subindex of the contradicting object.
    #[must_use]
    pub const fn object(&self) -> (u16, u8) {
        match *self {
            Self::Ratio { index, below, .. } => (index, if below == 0 { 2 } else { 1 }),
            Self::CountsPerTurn { index, .. } => (index, 1),
            Self::GearAlone { .. } => (0x6091, 1),
            Self::PositionUnit { .. } => (0x60A8, 0),
            Self::VelocityUnit { .. } => (0x60A9, 0),
            Self::AccelerationUnit { .. } => (0x60AA, 0),
            Self::RatedTorque { .. } => (0x6076, 0),
            Self::TorqueConstant { .. } => (0x3001, 5),
            Self::Polarity { .. } => (0x607E, 0),
        }
    }

    /// Returns one action that resolves the contradiction.
    #[must_use]
    pub const fn advice(&self) -> &'static str {
        match self {
            Self::Ratio { .. } => "write a ratio to the drive in which neither number is zero",
            Self::CountsPerTurn { index: 0x608F, .. } => {
                "correct the encoder's counts per turn in the machine file, or the drive's encoder resolution"
            }
            Self::CountsPerTurn { .. } => {
                "set the drive's gear ratio to 1:1 and its feed constant to the encoder's counts per turn, and describe the gear in \
                 the machine file; or give in the machine file what the drive counts per motor turn"
            }
            Self::GearAlone { .. } => {
                "write the drive's counts per motor turn, after 0x6091, as the encoder of the machine file"
            }
            Self::PositionUnit { .. } => "set 0x60A8 to 0x00B50000, encoder increments",
            Self::VelocityUnit { .. } => {
                "write the expected unit to 0x60A9 at start-up, or name the drive's unit in the machine file"
            }
            Self::AccelerationUnit { .. } => {
                "write the expected unit to 0x60AA at start-up, or name the drive's unit in the machine file"
            }
            Self::RatedTorque { found: 0, .. } => {
                "configure the motor in the drive: with a rated torque of zero a torque in thousandths of it means nothing"
            }
            Self::RatedTorque { .. } => {
                "correct the motor's rated torque in the machine file, or the drive's motor data"
            }
            Self::TorqueConstant { .. } => {
                "correct the motor's torque constant in the machine file, or the drive's motor data"
            }
            Self::Polarity { .. } => {
                "set 0x607E to 0 and invert the axis in the machine file (`invert`): drives differ in what 0x607E turns"
            }
        }
    }
}

impl fmt::Display for UnitMismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (index, subindex) = self.object();
        write!(f, "0x{index:04x}:{subindex:02x} ")?;
        let unit = |f: &mut fmt::Formatter<'_>, expected: &dyn fmt::Display, code: u32| {
            write!(f, "is 0x{code:08X}")?;
            if let Some(known) = VelocityUnit::from_si_code(code) {
                write!(f, " ({known})")?;
            } else if let Some(known) = AccelerationUnit::from_si_code(code) {
                write!(f, " ({known})")?;
            }
            write!(f, ", expected {expected}")
        };
        match *self {
            Self::Ratio { above, below, .. } => write!(f, "is {above}:{below}, expected a ratio"),
            Self::CountsPerTurn {
                expected, found, ..
            } => write!(
                f,
                "makes {found} counts per motor turn, expected {expected}"
            ),
            Self::GearAlone { gear, expected } => {
                let [motor, shaft] = gear;
                write!(
                    f,
                    "and :02 are {motor}:{shaft}: {expected} counts per motor turn need an encoder of {}; \
                     an encoder of {expected} makes {} counts",
                    counts_before(gear, expected),
                    counts_before([shaft, motor], expected),
                )
            }
            Self::PositionUnit { found } => {
                write!(f, "is 0x{found:08X}, expected encoder increments")
            }
            Self::VelocityUnit { expected, found } => unit(f, &expected, found),
            Self::AccelerationUnit { expected, found } => unit(f, &expected, found),
            Self::RatedTorque {
                expected: Some(expected),
                found,
            } => write!(f, "is {found}, expected {expected}"),
            Self::RatedTorque { found, .. } => write!(f, "is {found}, expected a rated torque"),
            Self::TorqueConstant { expected, found } => {
                write!(f, "is {found} µNm/A, expected {expected}")
            }
            Self::Polarity { found } => write!(f, "is 0x{found:02X}, expected 0x00"),
        }
    }
}

#[cfg(test)]
#[path = "drive_units_tests.rs"]
mod tests;
