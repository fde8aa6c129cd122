//! The control loops, as the controller architecture of the IDX application notes (chapter 2) has them:
//! a position PID and a velocity PI every 0.4 ms, each straight onto a current PI every 0.04 ms.
//!
//! * `gains`: what they are tuned to, in SI units
//! * `outer`: position and velocity loop
//! * `current`: current loop, I²t
//! * `lanes`: current loops and motors of several drives at once
//! * `estimate`: speed from counts
//!
//! A sampled loop acts half a period late on the whole, as what it puts out holds until the next sample.
//! Each makes up for that by taking what it measures half a period ahead, so that the drive responds as
//! the notes' transfer functions do.

mod current;
mod estimate;
mod gains;
mod lanes;
mod outer;
#[cfg(test)]
mod tests;

use super::objects::CurrentLimits;
use super::plant::{Plant, PlantParams};

use current::{CurrentLoop, Winding};
use estimate::Estimator;
pub(super) use estimate::Feedback;
pub(super) use gains::{
    CurrentGains, FeedGains, Gains, ObserverGains, PositionGains, VelocityGains,
};
use outer::Outer;

/// Current-loop steps in one control cycle.
const SUBSTEPS: u32 = 10;

/// Low-pass filter of what is shown as averaged, as the share of the new value: 10 ms.
const AVERAGE: f64 = 0.04;

/// What the loops are asked for in one control cycle. Velocities in counts/s, torque as offset in N·m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Demand {
    /// Output stage off.
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

/// What the feed-forwards are told: counts/s and counts/s². Of profiles only (2.3.4); the cyclic modes
/// leave it to the MainDevice.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Feed {
    pub velocity: f64,
    pub acceleration: f64,
}

/// What limits the loops.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bounds {
    pub current: CurrentLimits,
    /// Counts/s.
    pub speed: f64,
}

/// What the loops are told about themselves and the motor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Tuning {
    pub gains: Gains,
    pub feedback: Feedback,
    /// N·m/A.
    pub torque_constant: f64,
    /// A; more than that is for a while only.
    pub nominal_current: f64,
    /// s.
    pub thermal_time_constant: f64,
}

#[derive(Debug, Clone)]
pub(super) struct Controller {
    outer: Outer,
    current_loop: CurrentLoop,
    winding: Winding,
    estimator: Estimator,
    counts_per_rad: f64,
    /// A; `None`: output stage off.
    wanted: Option<f64>,
    /// A, over the last control cycle.
    current: f64,
    /// rad/s.
    averaged_velocity: f64,
    averaged_current: f64,
}

impl Controller {
    pub(super) fn new(tuning: &Tuning, params: &PlantParams, plant: &Plant) -> Self {
        let counts_per_rad = params.counts_per_rad();
        Self {
            outer: Outer::new(tuning, counts_per_rad),
            current_loop: CurrentLoop::new(&tuning.gains.current, params.supply_voltage),
            winding: Winding::new(tuning),
            estimator: Estimator::new(tuning, plant, counts_per_rad),
            counts_per_rad,
            wanted: None,
            current: 0.0,
            averaged_velocity: 0.0,
            averaged_current: 0.0,
        }
    }

    /// Other gains from the next step on. What has been integrated stays.
    pub(super) fn tune(&mut self, tuning: &Tuning) {
        self.outer.tune(tuning, self.counts_per_rad);
        self.current_loop.tune(&tuning.gains.current);
        self.estimator.tune(tuning);
        self.winding.tune(tuning);
    }

    /// What the encoder counts now.
    pub(super) fn counts(&self) -> i64 {
        self.estimator.counts()
    }

    /// Counts/s, as estimated.
    pub(super) fn velocity(&self) -> f64 {
        self.estimator.velocity() * self.counts_per_rad
    }

    /// Counts/s.
    pub(super) fn averaged_velocity(&self) -> f64 {
        self.averaged_velocity * self.counts_per_rad
    }

    /// A.
    pub(super) fn current(&self) -> f64 {
        self.current
    }

    /// A. What the current loop is asked for.
    pub(super) fn current_demand(&self) -> f64 {
        self.wanted.unwrap_or(0.0)
    }

    /// A.
    pub(super) fn averaged_current(&self) -> f64 {
        self.averaged_current
    }

    /// 1: the winding is as warm as it may be.
    pub(super) fn thermal_level(&self) -> f64 {
        self.winding.level()
    }

    /// The control cycle that has passed: current loop and motor.
    pub(super) fn turn(&mut self, plant: &mut Plant) {
        match self.wanted {
            Some(current) => self.drive(plant, current),
            None => self.coast(plant),
        }
    }

    /// As [`Controller::turn`] of each. Several at once take less time than one after the other.
    pub(super) fn turn_together<const N: usize>(mut together: [(&mut Self, &mut Plant); N]) {
        let wanted = together.each_ref().map(|(controller, plant)| {
            let driven = !plant.blocked;
            controller.wanted.filter(|_| driven)
        });
        if wanted.iter().all(Option::is_some) {
            lanes::drive(&mut together, wanted.map(Option::unwrap_or_default));
            return;
        }
        for (controller, plant) in together {
            controller.turn(plant);
        }
    }

    /// What was seen of the control cycle that has passed.
    pub(super) fn observe(&mut self, plant: &Plant) {
        self.winding.warm(self.current);
        self.estimator.observe(plant, self.current);
        let velocity = self.estimator.velocity();
        self.averaged_velocity += AVERAGE * (velocity - self.averaged_velocity);
        self.averaged_current += AVERAGE * (self.current - self.averaged_current);
        flush(&mut self.averaged_velocity);
        flush(&mut self.averaged_current);
    }

    /// What the current loop works at until the next control cycle. True if a limit kept the loops
    /// from asking for what they should.
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

    /// A control cycle's steps are over, with this sum of their currents.
    fn driven(&mut self, plant: &mut Plant, sum: f64) {
        plant.flush();
        self.current_loop.flush();
        self.current = sum / f64::from(SUBSTEPS);
    }

    /// One control period with the output stage off.
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

/// What decays towards zero would end as a subnormal number, which is slow to calculate with.
pub(super) fn flush(value: &mut f64) {
    if value.abs() < 1e-30 {
        *value = 0.0;
    }
}
