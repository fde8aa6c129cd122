//! Torque in user units. The drive uses thousandths of the motor's rated torque (0x6076).

use super::ScaleError;
use crate::units::{Amperes, NewtonMetres, Percent};

/// Torque parameters of a motor. The torque is the motor's, before any gear.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TorqueScale {
    rated: Option<f64>,
    constant: Option<f64>,
}

impl TorqueScale {
    /// `rated`: rated torque (0x6076) in Nm. `constant`: torque constant in Nm/A. Both may be
    /// unknown.
    pub fn new(rated: Option<f64>, constant: Option<f64>) -> Result<Self, ScaleError> {
        for (what, value) in [("rated torque", rated), ("torque constant", constant)] {
            if let Some(value) = value
                && !(value.is_finite() && value > 0.0)
            {
                return Err(ScaleError::NotPositive { what, value });
            }
        }
        Ok(Self { rated, constant })
    }

    /// Converts a torque in N·m. Fails if the rated torque is unknown.
    pub fn of_newton_metres(&self, torque: NewtonMetres) -> Result<Percent, ScaleError> {
        Ok(Percent(torque.0 / self.rated("Nm")? * 100.0))
    }

    /// Converts a torque to N·m. Fails if the rated torque is unknown.
    pub fn to_newton_metres(&self, torque: Percent) -> Result<NewtonMetres, ScaleError> {
        Ok(NewtonMetres(torque.0 / 100.0 * self.rated("Nm")?))
    }

    /// Converts a motor current in A. Fails if rated torque or torque constant is unknown.
    pub fn of_amperes(&self, current: Amperes) -> Result<Percent, ScaleError> {
        self.of_newton_metres(NewtonMetres(current.0 * self.constant()?))
    }

    /// Converts a torque to the motor current in A. Fails if rated torque or torque constant is
    /// unknown.
    pub fn to_amperes(&self, torque: Percent) -> Result<Amperes, ScaleError> {
        Ok(Amperes(
            torque.0 / 100.0 * self.rated("A")? / self.constant()?,
        ))
    }

    fn rated(&self, unit: &'static str) -> Result<f64, ScaleError> {
        let what = "the motor's rated torque (0x6076)";
        self.rated.ok_or(ScaleError::Torque { what, unit })
    }

    fn constant(&self) -> Result<f64, ScaleError> {
        let what = "the motor's torque constant";
        self.constant.ok_or(ScaleError::Torque { what, unit: "A" })
    }
}
