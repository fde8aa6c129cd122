//! The current loop: PI every 0.04 ms, and the I²t model of the winding.

use super::Tuning;
use super::gains::CurrentGains;
use crate::drive::CONTROL_STEP;
use crate::drive::plant::CURRENT_STEP;

/// `C(s) = P + I/s`. The integral never exceeds the voltage of the output stage (anti-windup as in
/// the IDX application notes, 2.3.1).
#[derive(Debug, Clone)]
pub(super) struct CurrentLoop {
    pub(super) p: f64,
    /// The integral gain per step.
    pub(super) i: f64,
    pub(super) supply: f64,
    /// The integral, in V.
    pub(super) integral: f64,
    /// The current one step earlier, in A.
    pub(super) before: f64,
}

impl CurrentLoop {
    pub(super) fn new(gains: &CurrentGains, supply: f64) -> Self {
        let mut fresh = Self {
            p: 0.0,
            i: 0.0,
            supply: supply.max(0.0),
            integral: 0.0,
            before: 0.0,
        };
        fresh.tune(gains);
        fresh
    }

    pub(super) fn tune(&mut self, gains: &CurrentGains) {
        self.i = gains.i * CURRENT_STEP;
        // The voltage holds for a step while a continuous integral would keep growing. Half a
        // step's growth is the mean.
        self.p = gains.p + 0.5 * self.i;
    }

    /// Returns the voltage for the next step.
    pub(super) fn step(&mut self, wanted: f64, current: f64) -> f64 {
        // The mean current during the next step, extrapolated.
        let ahead = current + 0.5 * (current - self.before);
        self.before = current;
        let error = wanted - ahead;
        let voltage = (self.p * error + self.integral).clamp(-self.supply, self.supply);
        self.integral = (self.integral + self.i * error).clamp(-self.supply, self.supply);
        voltage
    }

    pub(super) fn reset(&mut self) {
        self.integral = 0.0;
        self.before = 0.0;
    }

    pub(super) fn flush(&mut self) {
        super::flush(&mut self.integral);
    }
}

/// I²t model: the temperature of the winding. It allows more than the nominal current for a limited
/// time.
#[derive(Debug, Clone)]
pub(super) struct I2tModel {
    /// 1 is the steady state at nominal current.
    level: f64,
    nominal: f64,
    // Per control cycle: heating per square ampere, and the share that cools off.
    heating: f64,
    cooling: f64,
}

impl I2tModel {
    pub(super) fn new(tuning: &Tuning) -> Self {
        let mut cold = Self {
            level: 0.0,
            nominal: 0.0,
            heating: 0.0,
            cooling: 0.0,
        };
        cold.tune(tuning);
        cold
    }

    pub(super) fn tune(&mut self, tuning: &Tuning) {
        self.nominal = tuning.nominal_current.max(1e-3);
        self.cooling = CONTROL_STEP / tuning.thermal_time_constant.max(CONTROL_STEP);
        self.heating = self.cooling / (self.nominal * self.nominal);
    }

    /// Updates the model by one control cycle at this current.
    pub(super) fn warm(&mut self, current: f64) {
        self.level += self.heating * current * current - self.cooling * self.level;
        super::flush(&mut self.level);
    }

    /// Returns the usable part of the current limit, in A.
    pub(super) fn allow(&self, limit: f64) -> f64 {
        if self.level < 1.0 {
            limit
        } else {
            limit.min(self.nominal)
        }
    }

    pub(super) fn level(&self) -> f64 {
        self.level
    }
}
