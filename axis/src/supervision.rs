//! What is supervised besides the limits, what a trip does, and how faults are reset.

/// Besides [`crate::Limits`]. The default supervises nothing more, and stops by quick stop.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Supervision {
    /// What a trip does. Where the drive does not follow set-points, a ramp becomes a quick stop.
    pub reaction: StopMethod,
    /// What [`crate::Command::EmergencyStop`] does.
    pub emergency: StopMethod,
    /// Reported torque that may not last.
    pub torque: Option<TorqueWatch>,
    /// Largest reported acceleration, user units/s², filtered over 10 ms and for five cycles in a row.
    pub acceleration: Option<f64>,
    /// The axis stands when its reported velocity is this small, user units/s. `None`: 1 % of the velocity limit.
    pub standstill: Option<f64>,
    /// How long the axis must be within the target window before it is in target, seconds.
    pub target_dwell_s: f64,
    /// How long it must stand before it is at rest, seconds.
    pub standstill_dwell_s: f64,
}

/// How an axis is brought to rest before its power is removed, gentlest first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub enum StopMethod {
    /// Set-points within the limits of the axis.
    Ramp,
    /// The drive's quick stop (0x605A, 0x6085).
    #[default]
    QuickStop,
    /// No power at once; the axis coasts, or its brake stops it.
    DisableVoltage,
}

impl core::fmt::Display for StopMethod {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Ramp => "the ramp",
            Self::QuickStop => "the drive's quick stop",
            Self::DisableVoltage => "disable voltage",
        })
    }
}

/// Torque above a limit for a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TorqueWatch {
    /// Of rated torque.
    pub percent: f64,
    pub time_s: f64,
}

/// How long a brake takes. Without one both are 0.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Brake {
    /// From Operation enabled to the first motion; the axis holds meanwhile.
    pub release_s: f64,
    /// From rest to the loss of power; the axis holds meanwhile.
    pub engage_s: f64,
}

/// Who resets a drive's fault. Power stays off after a reset until it is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum FaultReset {
    /// [`crate::Command::ResetFault`] alone.
    #[default]
    Manual,
    Automatic {
        /// Resets that are tried without a command in between.
        tries: u8,
        /// From the fault to the reset, seconds.
        delay_s: f64,
    },
}
