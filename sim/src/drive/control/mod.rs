//! The control loops, as in the controller architecture of the IDX application notes (chapter 2). A
//! position PID and a velocity PI run every 0.4 ms. Each drives a current PI every 0.04 ms.
//!
//! * `gains`: control parameters, in SI units
//! * `outer`: position and velocity loop
//! * `current`: current loop, I²t
//! * `batch`: current loops and motors of several drives at once
//! * `estimate`: speed from counts
//!
//! The output of a sampled loop holds until the next sample and so acts half a period late on
//! average. Each loop compensates: it extrapolates its measurement by half a period. The drive then
//! responds as the transfer functions of the notes.

mod batch;
mod current;
mod estimate;
mod gains;
mod outer;
#[cfg(test)]
mod tests;

use super::objects::CurrentLimits;
use super::plant::{Plant, PlantParams};

use current::{CurrentLoop, I2tModel};
use estimate::Estimator;
pub(super) use estimate::Feedback;
pub(super) use gains::{
    CurrentGains, FeedGains, Gains, ObserverGains, PositionGains, VelocityGains,
};
use outer::OuterLoop;

/// Current-loop steps in one control cycle.
const SUBSTEPS: u32 = 10;

/// The low-pass coefficient of averaged values, as the share of the new value: 10 ms.
const AVERAGE: f64 = 0.04;

/// The demand on the loops for one control cycle. Velocities in counts/s, torque offset in N·m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Demand {
    /// The output stage is off.
    Off,
    Position {
        position: f64,
        feed: Feed,
        torque: f64,
    },
    Velocity {
        velocity: f64,
        feed: Feed,
        torque: f64,
    },
    Torque(f64),
}

/// Inputs of the feed-forwards, in counts/s and counts/s². Only profile modes use them (2.3.4); in
/// cyclic modes the MainDevice adds offsets.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Feed {
    pub velocity: f64,
    pub acceleration: f64,
}

/// The limits of the loops.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bounds {
    pub current: CurrentLimits,
    /// The speed limit, in counts/s.
    pub speed: f64,
}

/// Parameters of the loops and the motor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Tuning {
    pub gains: Gains,
    pub feedback: Feedback,
    /// The torque constant, in N·m/A.
    pub torque_constant: f64,
    /// The nominal current, in A. A larger current is possible for a limited time only.
    pub nominal_current: f64,
    /// The thermal time constant, in s.
    pub thermal_time_constant: f64,
}

#[derive(Debug, Clone)]
pub(super) struct Controller {
    outer: OuterLoop,
    current_loop: CurrentLoop,
    winding: I2tModel,
    estimator: Estimator,
    counts_per_rad: f64,
    /// The current demand, in A. `None`: output stage off.
    wanted: Option<f64>,
    /// The mean current of the last control cycle, in A.
    current: f64,
    /// The averaged velocity, in rad/s.
    averaged_velocity: f64,
    averaged_current: f64,
}

impl Controller {
    pub(super) fn new(tuning: &Tuning, params: &PlantParams, plant: &Plant) -> Self {
        let counts_per_rad = params.counts_per_rad();
        Self {
            outer: OuterLoop::new(tuning, counts_per_rad),
            current_loop: CurrentLoop::new(&tuning.gains.current, params.supply_voltage),
            winding: I2tModel::new(tuning),
            estimator: Estimator::new(tuning, plant, counts_per_rad),
            counts_per_rad,
            wanted: None,
            current: 0.0,
            averaged_velocity: 0.0,
            averaged_current: 0.0,
        }
    }

    /// Applies new gains from the next step on. The integrals keep their values.
    pub(super) fn tune(&mut self, tuning: &Tuning) {
        self.outer.tune(tuning, self.counts_per_rad);
        self.current_loop.tune(&tuning.gains.current);
        self.estimator.tune(tuning);
        self.winding.tune(tuning);
    }

    /// Returns the present encoder count.
    pub(super) fn counts(&self) -> i64 {
        self.estimator.counts()
    }

    /// Returns the estimated velocity, in counts/s.
    pub(super) fn velocity(&self) -> f64 {
        self.estimator.velocity() * self.counts_per_rad
    }

    /// Returns the averaged velocity, in counts/s.
    pub(super) fn averaged_velocity(&self) -> f64 {
        self.averaged_velocity * self.counts_per_rad
    }

    /// Returns the mean current of the last control cycle, in A.
    pub(super) fn current(&self) -> f64 {
        self.current
    }

    /// Returns the demand on the current loop, in A.
    pub(super) fn current_demand(&self) -> f64 {
        self.wanted.unwrap_or(0.0)
    }

    /// Returns the averaged current, in A.
    pub(super) fn averaged_current(&self) -> f64 {
        self.averaged_current
    }

    /// Returns the thermal level. At 1 the winding has its maximum temperature.
    pub(super) fn thermal_level(&self) -> f64 {
        self.winding.level()
    }

    /// Simulates one control cycle of current loop and motor.
    pub(super) fn turn(&mut self, plant: &mut Plant) {
        match self.wanted {
            Some(current) => self.drive(plant, current),
            None => self.coast(plant),
        }
    }

    /// As [`Controller::turn`] for each drive. A batch is faster than one drive after the other.
    pub(super) fn turn_together<const N: usize>(mut together: [(&mut Self, &mut Plant); N]) {
        let wanted = together.each_ref().map(|(controller, plant)| {
            let simple = plant.is_simple();
            controller.wanted.filter(|_| simple)
        });
        if wanted.iter().all(Option::is_some) {
            batch::drive(&mut together, wanted.map(Option::unwrap_or_default));
            return;
        }
        for (controller, plant) in together {
            controller.turn(plant);
        }
    }

    /// Updates the measurements after a control cycle.
    pub(super) fn observe(&mut self, plant: &Plant) {
        self.winding.warm(self.current);
        self.estimator.observe(plant, self.current);
        let velocity = self.estimator.velocity();
        self.averaged_velocity += AVERAGE * (velocity - self.averaged_velocity);
        self.averaged_current += AVERAGE * (self.current - self.averaged_current);
        flush(&mut self.averaged_velocity);
        flush(&mut self.averaged_current);
    }

    /// Sets the demand on the current loop until the next control cycle. True if a limit reduced
    /// the demand.
    pub(super) fn ask(&mut self, demand: Demand, bounds: &Bounds) -> bool {
        let bounds = Bounds {
            current: CurrentLimits {
                forward: self.winding.allow(bounds.current.forward).max(0.0),
                backward: self.winding.allow(bounds.current.backward).max(0.0),
            },
            speed: bounds.speed / self.counts_per_rad,
        };
        let asked = self.outer.ask(demand, &self.estimator, &bounds);
        self.wanted = asked.map(|(current, _)| current);
        asked.is_some_and(|(_, limited)| limited)
    }

    fn drive(&mut self, plant: &mut Plant, wanted: f64) {
        let mut sum = 0.0;
        for _ in 0..SUBSTEPS {
            let voltage = self.current_loop.step(wanted, plant.current());
            plant.drive(voltage);
            sum += plant.current();
        }
        self.driven(plant, sum);
    }

    /// Ends a control cycle with this sum of step currents.
    fn driven(&mut self, plant: &mut Plant, sum: f64) {
        plant.flush();
        self.current_loop.flush();
        self.current = sum / f64::from(SUBSTEPS);
    }

    /// Runs one control period with the output stage off.
    pub(super) fn coast(&mut self, plant: &mut Plant) {
        self.current_loop.reset();
        self.current = 0.0;
        if !plant.at_rest() {
            for _ in 0..SUBSTEPS {
                plant.coast();
            }
        }
    }
}

/// Sets tiny values to zero. Subnormal numbers slow the calculation down.
pub(super) fn flush(value: &mut f64) {
    if value.abs() < 1e-30 {
        *value = 0.0;
    }
}
