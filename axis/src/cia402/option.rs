//! Option codes for stops of the drive (0x605A quick stop, 0x605D halt; CiA 402-2).

use core::fmt;

/// The deceleration of a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Deceleration {
    /// No torque; the axis coasts.
    Coast,
    /// 0x6084; during homing 0x609A.
    SlowDownRamp,
    /// 0x6085.
    QuickStopRamp,
    /// With the current limit.
    CurrentLimit,
    /// With the voltage limit.
    VoltageLimit,
    /// Codes below zero are vendor-specific, others are reserved.
    Other(i16),
}

/// 0x605A.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct QuickStopOption(pub i16);

impl QuickStopOption {
    /// Returns how the drive decelerates.
    #[must_use]
    pub const fn deceleration(self) -> Deceleration {
        match self.0 {
            0 => Deceleration::Coast,
            1 | 5 => Deceleration::SlowDownRamp,
            2 | 6 => Deceleration::QuickStopRamp,
            3 | 7 => Deceleration::CurrentLimit,
            4 | 8 => Deceleration::VoltageLimit,
            other => Deceleration::Other(other),
        }
    }

    /// Returns true if the drive stays in Quick stop active, where transition 16 is possible.
    /// Otherwise the drive continues to Switch on disabled.
    #[must_use]
    pub const fn stays(self) -> bool {
        matches!(self.0, 5..=8)
    }
}

/// 0x605D. The drive stays in Operation enabled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct HaltOption(pub i16);

impl HaltOption {
    /// Returns how the drive decelerates.
    #[must_use]
    pub const fn deceleration(self) -> Deceleration {
        match self.0 {
            1 => Deceleration::SlowDownRamp,
            2 => Deceleration::QuickStopRamp,
            3 => Deceleration::CurrentLimit,
            4 => Deceleration::VoltageLimit,
            other => Deceleration::Other(other),
        }
    }
}

impl fmt::Display for Deceleration {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Coast => "coasting",
            Self::SlowDownRamp => "on the slow down ramp",
            Self::QuickStopRamp => "on the quick stop ramp",
            Self::CurrentLimit => "at the current limit",
            Self::VoltageLimit => "at the voltage limit",
            Self::Other(code) => return write!(f, "by option code {code}"),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_row_by_row() {
        use Deceleration::*;
        for (code, deceleration, stays) in [
            (0, Coast, false),
            (1, SlowDownRamp, false),
            (2, QuickStopRamp, false),
            (3, CurrentLimit, false),
            (4, VoltageLimit, false),
            (5, SlowDownRamp, true),
            (6, QuickStopRamp, true),
            (7, CurrentLimit, true),
            (8, VoltageLimit, true),
            (9, Other(9), false),
            (-1, Other(-1), false),
        ] {
            let option = QuickStopOption(code);
            assert_eq!(
                (option.deceleration(), option.stays()),
                (deceleration, stays)
            );
        }
        for (code, deceleration) in [
            (0, Other(0)),
            (1, SlowDownRamp),
            (2, QuickStopRamp),
            (3, CurrentLimit),
            (4, VoltageLimit),
            (5, Other(5)),
        ] {
            assert_eq!(HaltOption(code).deceleration(), deceleration);
        }
    }
}
