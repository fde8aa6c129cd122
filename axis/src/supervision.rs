//! Supervision in addition to the limits, reaction to a trip, brake, and fault reset.
//!
//! ```
//! use ecaxis_axis::supervision::{StopMethod, Supervision, TorqueWatch};
//!
//! let supervision = Supervision {
//!     reaction: StopMethod::Ramp,
//!     torque: Some(TorqueWatch { percent: 80.0, time_s: 2.0 }),
//!     ..Supervision::default()
//! };
//! assert_eq!(supervision.emergency, StopMethod::QuickStop);
//! ```

/// Supervision in addition to [`crate::Limits`]. The default adds nothing and stops by quick stop.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Supervision {
    /// Reaction to a trip. If the drive does not follow set-points, a ramp becomes a quick stop.
    pub reaction: StopMethod,
    /// Stop method of [`crate::Command::EmergencyStop`].
    pub emergency: StopMethod,
    /// Highest permanent torque. `None`: not supervised.
    pub torque: Option<TorqueWatch>,
    /// Largest reported acceleration, user units/s². The value is filtered over 10 ms and must be
    /// exceeded in five consecutive cycles.
    pub acceleration: Option<f64>,
    /// Reported velocity up to which the axis stands still, user units/s. `None`: 1 % of the
    /// velocity limit.
    pub standstill: Option<f64>,
    /// Time in seconds that the axis must be within the target window before it is in target.
    pub target_dwell_s: f64,
    /// Time in seconds that the axis must stand still before it is at rest.
    pub standstill_dwell_s: f64,
}

/// The method that stops an axis before its power is removed, gentlest first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub enum StopMethod {
    /// Set-points within the limits of the axis.
    Ramp,
    /// Quick stop of the drive (0x605A, 0x6085).
    #[default]
    QuickStop,
    /// Immediate removal of power; the axis coasts, or its brake stops it.
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

/// A torque limit that may be exceeded for a limited time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TorqueWatch {
    /// Percent of rated torque.
    pub percent: f64,
    /// The time for which the torque may exceed the limit, seconds.
    pub time_s: f64,
}

/// Brake times. Without a brake both are 0.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Brake {
    /// Time from Operation enabled to the first motion; the axis holds its position meanwhile.
    pub release_s: f64,
    /// Time from standstill to the removal of power; the axis holds its position meanwhile.
    pub engage_s: f64,
}

/// Trigger of a fault reset. After a reset, power stays off until the next enable command.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum FaultReset {
    /// Only [`crate::Command::ResetFault`].
    #[default]
    Manual,
    /// The axis resets faults by itself.
    Automatic {
        /// Number of automatic resets without a command in between.
        tries: u8,
        /// Time from the fault to the reset, seconds.
        delay_s: f64,
    },
}
