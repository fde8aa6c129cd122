//! The control loops: position PID and velocity PI at 0.4 ms, current PI at 0.04 ms, and the velocity
//! observer that feeds them. Torques in N·m, positions in counts, velocities in rad/s.

use std::f64::consts::TAU;

use super::CONTROL_STEP as DT;
use super::plant::{CURRENT_STEP, Plant, PlantParams};

/// Current-loop steps in one control cycle.
const SUBSTEPS: u32 = 10;

/// Bandwidths in rad/s. The observer is three times faster than what it feeds, the current loop
/// more than ten times faster than the observer.
const POSITION_BANDWIDTH: f64 = TAU * 20.0;
const VELOCITY_BANDWIDTH: f64 = TAU * 20.0;
const OBSERVER_BANDWIDTH: f64 = TAU * 60.0;
const CURRENT_BANDWIDTH: f64 = TAU * 1000.0;

/// Low-pass filters of what is shown, as the share of the new value: 2 ms and 10 ms.
const FILTER: f64 = 0.2;
const AVERAGE: f64 = 0.04;

/// What the loops are asked for in one control cycle. Velocities in counts/s, accelerations in
/// counts/s², torque as offset in N·m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Demand {
    /// Output stage off.
    Off,
    Position {
        position: f64,
        velocity: f64,
        acceleration: f64,
        torque: f64,
    },
    Velocity {
        velocity: f64,
        acceleration: f64,
        torque: f64,
    },
    Torque(f64),
}

#[derive(Debug, Clone)]
struct Gains {
    position_p: f64,
    position_i: f64,
    position_d: f64,
    velocity_p: f64,
    velocity_i: f64,
    current_p: f64,
    current_i: f64,
    /// Feed-forwards: N·m per counts/s and per counts/s².
    velocity_ff: f64,
    acceleration_ff: f64,
}

/// Position, speed and load torque from counts and current: two of them cannot be measured, the third
/// only in whole counts.
#[derive(Debug, Clone)]
struct Observer {
    /// Counts off from the count measured last.
    ahead: f64,
    velocity: f64,
    /// Acceleration nobody asked for, rad/s²: load and friction.
    unexplained: f64,
    position_gain: f64,
    velocity_gain: f64,
    load_gain: f64,
    damping: f64,
}

#[derive(Debug, Clone)]
pub(super) struct Controller {
    gains: Gains,
    observer: Observer,
    counts: i64,
    counts_per_rad: f64,
    inertia: f64,
    torque_constant: f64,
    supply_voltage: f64,
    /// N·m. Shared by the position and the velocity loop, so that changing over is without a bump.
    integral: f64,
    /// A; `None`: output stage off.
    wanted: Option<f64>,
    /// V.
    current_integral: f64,
    /// A, over the last control cycle.
    current: f64,
    filtered_velocity: f64,
    averaged_velocity: f64,
    averaged_current: f64,
}

/// What limits the loops.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bounds {
    /// A.
    pub current: f64,
    /// Counts/s.
    pub speed: f64,
}

impl Controller {
    pub(super) fn new(plant: &PlantParams, counts: i64) -> Self {
        let (inertia, w) = (plant.inertia.max(1e-9), POSITION_BANDWIDTH);
        let counts_per_rad = plant.counts_per_rad();
        let pole = (-OBSERVER_BANDWIDTH * DT).exp();
        let inductance = plant.inductance.max(1e-6);
        Self {
            gains: Gains {
                // A triple pole at the bandwidth.
                position_p: 3.0 * inertia * w * w / counts_per_rad,
                position_i: inertia * w * w * w / counts_per_rad,
                position_d: 3.0 * inertia * w,
                velocity_p: 2.0 * inertia * VELOCITY_BANDWIDTH,
                velocity_i: inertia * VELOCITY_BANDWIDTH * VELOCITY_BANDWIDTH,
                current_p: inductance * CURRENT_BANDWIDTH,
                current_i: plant.resistance * CURRENT_BANDWIDTH,
                velocity_ff: plant.viscous_friction / counts_per_rad,
                acceleration_ff: inertia / counts_per_rad,
            },
            observer: Observer {
                ahead: 0.0,
                velocity: 0.0,
                unexplained: 0.0,
                position_gain: 1.0 - pole.powi(3),
                velocity_gain: 1.5 * (1.0 - pole * pole) * (1.0 - pole) / DT / counts_per_rad,
                load_gain: (1.0 - pole).powi(3) / (DT * DT) / counts_per_rad,
                damping: plant.viscous_friction / inertia,
            },
            counts,
            counts_per_rad,
            inertia,
            torque_constant: plant.torque_constant.max(1e-9),
            supply_voltage: plant.supply_voltage,
            integral: 0.0,
            wanted: None,
            current_integral: 0.0,
            current: 0.0,
            filtered_velocity: 0.0,
            averaged_velocity: 0.0,
            averaged_current: 0.0,
        }
    }

    /// What the encoder counts now.
    pub(super) fn counts(&self) -> i64 {
        self.counts
    }

    /// Counts/s, as observed.
    pub(super) fn velocity(&self) -> f64 {
        self.observer.velocity * self.counts_per_rad
    }

    /// Counts/s, as 0x606C shows it.
    pub(super) fn filtered_velocity(&self) -> f64 {
        self.filtered_velocity * self.counts_per_rad
    }

    /// Counts/s.
    pub(super) fn averaged_velocity(&self) -> f64 {
        self.averaged_velocity * self.counts_per_rad
    }

    /// A.
    pub(super) fn current(&self) -> f64 {
        self.current
    }

    /// A.
    pub(super) fn averaged_current(&self) -> f64 {
        self.averaged_current
    }

    /// The control cycle that has passed: current loop, motor, and what was seen of it.
    pub(super) fn advance(&mut self, plant: &mut Plant) {
        match self.wanted {
            Some(current) => self.drive(plant, current),
            None => self.coast(plant),
        }
        self.observe(plant);
    }

    /// What the current loop works at until the next control cycle. True if a limit kept the loops
    /// from asking for what they should.
    pub(super) fn ask(&mut self, demand: Demand, bounds: &Bounds) -> bool {
        let torque = self.torque(demand, bounds);
        self.wanted = torque.map(|(torque, _)| torque / self.torque_constant);
        torque.is_some_and(|(_, limited)| limited)
    }

    /// The outer loops: torque to apply, and whether it was cut.
    fn torque(&mut self, demand: Demand, bounds: &Bounds) -> Option<(f64, bool)> {
        let limit = bounds.current * self.torque_constant;
        let gains = &self.gains;
        let (wanted, error_gain) = match demand {
            Demand::Off => {
                self.integral = 0.0;
                return None;
            }
            Demand::Position {
                position,
                velocity,
                acceleration,
                torque,
            } => {
                let error = position - super::objects::float(self.counts);
                let velocity_error = velocity / self.counts_per_rad - self.observer.velocity;
                let wanted = gains.position_p * error
                    + gains.position_d * velocity_error
                    + gains.velocity_ff * velocity
                    + gains.acceleration_ff * acceleration
                    + torque;
                (wanted, gains.position_i * error)
            }
            Demand::Velocity {
                velocity,
                acceleration,
                torque,
            } => {
                let error = velocity / self.counts_per_rad - self.observer.velocity;
                let wanted = gains.velocity_p * error
                    + gains.velocity_ff * velocity
                    + gains.acceleration_ff * acceleration
                    + torque;
                (wanted, gains.velocity_i * error)
            }
            Demand::Torque(torque) => {
                self.integral = 0.0;
                // Near the speed limit the torque that would go on accelerating fades out.
                let margin = bounds.speed / self.counts_per_rad;
                let upper = gains.velocity_p * (margin - self.observer.velocity);
                let lower = gains.velocity_p * (-margin - self.observer.velocity);
                let allowed = torque.min(upper).max(lower).clamp(-limit, limit);
                return Some((allowed, allowed != torque));
            }
        };
        let total = wanted + self.integral;
        let cut = total.clamp(-limit, limit);
        let step = error_gain * DT;
        // Wind-up: while the output is cut, the integral may only come back.
        if total == cut || total * step < 0.0 {
            self.integral = (self.integral + step).clamp(-limit, limit);
        }
        Some((cut, cut != total))
    }

    fn drive(&mut self, plant: &mut Plant, wanted: f64) {
        let step = self.gains.current_i * CURRENT_STEP;
        let supply = self.supply_voltage;
        let mut sum = 0.0;
        for _ in 0..SUBSTEPS {
            let error = wanted - plant.current();
            let integral = (self.current_integral + step * error).clamp(-supply, supply);
            let voltage = (self.gains.current_p * error + integral).clamp(-supply, supply);
            self.current_integral = integral;
            plant.energise(voltage);
            plant.turn();
            sum += plant.current();
        }
        plant.flush();
        self.current = sum / f64::from(SUBSTEPS);
    }

    fn coast(&mut self, plant: &mut Plant) {
        plant.open();
        self.current_integral = 0.0;
        self.current = 0.0;
        if !plant.at_rest() {
            for _ in 0..SUBSTEPS {
                plant.turn();
            }
        }
    }

    fn observe(&mut self, plant: &Plant) {
        let o = &mut self.observer;
        let accelerating = self.torque_constant * self.current / self.inertia
            - o.damping * o.velocity
            + o.unexplained;
        let predicted = o.velocity + accelerating * DT;
        let moved = 0.5 * (o.velocity + predicted) * DT * self.counts_per_rad;
        let counts = plant.counts();
        let counted = super::objects::float(counts - self.counts);
        let error = counted - (o.ahead + moved);
        o.velocity = predicted + o.velocity_gain * error;
        o.unexplained += o.load_gain * error;
        o.ahead += moved + o.position_gain * error - counted;
        self.counts = counts;
        self.filtered_velocity += FILTER * (o.velocity - self.filtered_velocity);
        self.averaged_velocity += AVERAGE * (o.velocity - self.averaged_velocity);
        self.averaged_current += AVERAGE * (self.current - self.averaged_current);
        for decaying in [
            &mut o.velocity,
            &mut o.unexplained,
            &mut self.filtered_velocity,
            &mut self.averaged_velocity,
            &mut self.averaged_current,
            &mut self.current_integral,
        ] {
            flush(decaying);
        }
    }
}

/// What decays towards zero would end as a subnormal number, which is slow to calculate with.
pub(super) fn flush(value: &mut f64) {
    if value.abs() < 1e-30 {
        *value = 0.0;
    }
}
