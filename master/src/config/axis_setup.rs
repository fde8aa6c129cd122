//! What the machine knows about an axis: its configuration, units, torque and homing.

use std::fmt;

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_esi as esi;

use super::Signal;

#[derive(Debug, Clone, PartialEq)]
pub struct AxisSetup {
    /// The name in the machine file.
    pub name: String,
    pub device: DeviceIndex,
    /// The number of the axis in its drive, from 0.
    pub number: u16,
    /// The index in [`GatewaySetup::nodes`](super::GatewaySetup::nodes) of an axis behind a gateway.
    pub node: Option<usize>,
    pub config: ecaxis_axis::AxisConfig,
    /// The user's name for the position unit, for example `mm`.
    pub unit: String,
    pub mode: esi::Mode,
    pub velocity_unit_from: UnitSource,
    pub acceleration_unit_from: UnitSource,
    pub torque: TorqueSetup,
    /// The direction in which a modulo axis moves.
    pub way: ecaxis_axis::scale::ModuloDirection,
    pub homing: Option<HomingSetup>,
    /// Its `config` has the limits of the load.
    pub compensation: ecaxis_axis::Compensation,
    /// The input of its second encoder.
    pub second_encoder: Option<Signal>,
    /// The one-bit output that releases the axis's brake.
    pub brake_output: Option<Signal>,
    /// What `limits.torque` does in modes other than CST.
    pub torque_limit: super::TorqueLimit,
}

/// The homing of an axis.
#[derive(Debug, Clone, PartialEq)]
pub struct HomingSetup {
    pub homing: ecaxis_axis::homing::Homing,
    /// The homing settings as SDOs.
    pub startup: Vec<esi::StartupSdo>,
    /// The timeout of the whole search in ns.
    pub timeout_ns: u64,
}

/// Adds the SDOs of an axis before SafeOp, after those of the ESI.
pub(super) fn add_startup(startup: &mut Vec<esi::StartupSdo>, added: &[esi::StartupSdo]) {
    let at = startup
        .iter()
        .position(|sdo| sdo.transition == "SO")
        .unwrap_or(startup.len());
    startup.splice(at..at, added.iter().cloned());
}

/// The unit of an axis's torques, and the motor data.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TorqueSetup {
    pub unit: TorqueUnit,
    /// The rated torque in Nm; `None` if only the drive knows it.
    pub rated: Option<f64>,
    pub rated_from: UnitSource,
    /// The torque constant in Nm/A.
    pub constant: Option<f64>,
    pub constant_from: UnitSource,
    /// The number of counts of 0x6076 per Nm.
    pub counts_per_newton_metre: f64,
    /// The percentage of rated torque per file unit. With an unknown rated torque: the percentage
    /// of the limit.
    pub(super) percent_per_unit: f64,
    /// `true` if the file sets a torque limit. Otherwise the limit is the rated torque.
    pub(super) limit_said: bool,
}

/// The key `torque_unit`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum TorqueUnit {
    /// Percent of the motor's rated torque.
    #[default]
    Percent,
    /// Nm at the motor, before any gear.
    NewtonMetres,
    Amperes,
}

impl TorqueUnit {
    #[must_use]
    pub const fn sign(self) -> &'static str {
        match self {
            Self::Percent => "%",
            Self::NewtonMetres => "Nm",
            Self::Amperes => "A",
        }
    }
}

impl fmt::Display for TorqueUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.sign())
    }
}

/// The source of a drive unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnitSource {
    /// A key of `[device.axis]`.
    File,
    /// A start-up SDO of the machine file.
    Sdo,
    /// The default in the ESI file.
    Esi,
    /// The drive itself.
    Drive,
    /// No source: the unit is assumed.
    Nothing,
}
