//! Shaft speed from encoder counts (IDX application notes, 2.3.2). It comes from the time between
//! edges with a low-pass filter, or from an observer with a motor model.

use super::Tuning;
use crate::drive::CONTROL_STEP as DT;
use crate::drive::objects::float;
use crate::drive::plant::Plant;

/// 0x3000:02, velocity control structure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(in crate::drive) enum Feedback {
    #[default]
    Filter,
    Observer,
}

#[derive(Debug, Clone)]
pub(super) struct Estimator {
    feedback: Feedback,
    filter: Filter,
    observer: Observer,
    /// The last count.
    counts: i64,
    counts_per_rad: f64,
    /// The estimated speed, in rad/s.
    velocity: f64,
    /// The change of count and speed in the last control cycle.
    counted: f64,
    gained: f64,
}

impl Estimator {
    pub(super) fn new(tuning: &Tuning, plant: &Plant, counts_per_rad: f64) -> Self {
        let counts = plant.counts();
        Self {
            feedback: tuning.feedback,
            filter: Filter {
                edge: float(counts),
                since: DT,
                speed: 0.0,
                share: share(tuning.gains.velocity.cut_off),
            },
            observer: Observer::new(tuning, counts_per_rad),
            counts,
            counts_per_rad,
            velocity: 0.0,
            counted: 0.0,
            gained: 0.0,
        }
    }

    pub(super) fn tune(&mut self, tuning: &Tuning) {
        self.filter.share = share(tuning.gains.velocity.cut_off);
        self.observer.tune(tuning);
        if tuning.feedback != self.feedback {
            self.feedback = tuning.feedback;
            self.observer.ahead = 0.0;
            self.observer.load = 0.0;
            self.filter.speed = self.velocity * self.counts_per_rad;
        }
    }

    pub(super) fn counts(&self) -> i64 {
        self.counts
    }

    /// Returns the count half a control cycle ahead, extrapolated from the last cycle. An output
    /// that holds for a cycle acts on this count on average.
    pub(super) fn counts_ahead(&self) -> f64 {
        float(self.counts) + 0.5 * self.counted
    }

    pub(super) fn velocity_ahead(&self) -> f64 {
        self.velocity + 0.5 * self.gained
    }

    /// Returns the estimated speed, in rad/s.
    pub(super) fn velocity(&self) -> f64 {
        self.velocity
    }

    /// Updates the estimate after a control cycle with this mean current.
    pub(super) fn observe(&mut self, plant: &Plant, current: f64) {
        let counts = plant.counts();
        self.counted = float(counts - self.counts);
        self.counts = counts;
        let before = self.velocity;
        let going_on = match self.feedback {
            Feedback::Filter => {
                let raw = self.filter.measure(plant, self.counted) / self.counts_per_rad;
                self.velocity += self.filter.share * (raw - before);
                self.velocity
            }
            Feedback::Observer => {
                let predicted = self.observer.predict(before, current);
                self.velocity = self.observer.correct(before, predicted, self.counted);
                predicted
            }
        };
        super::flush(&mut self.velocity);
        self.gained = going_on - before;
    }
}

/// Returns the share of a new value in a low-pass filter `2πf / (s + 2πf)`. The mean speed between
/// edges is half a cycle old, so the filter lags by half a cycle less.
fn share(cut_off: f64) -> f64 {
    let x = std::f64::consts::TAU * cut_off * DT;
    (x / (1.0 + 0.5 * x)).min(1.0)
}

/// The time without an edge after which the shaft counts as standing, in s.
const STANDSTILL_S: f64 = 0.05;

#[derive(Debug, Clone)]
struct Filter {
    /// The position of the last edge in counts, and its age.
    edge: f64,
    since: f64,
    /// The speed between the last two edges, in counts/s.
    speed: f64,
    share: f64,
}

impl Filter {
    fn measure(&mut self, plant: &Plant, counted: f64) -> f64 {
        self.since += DT;
        // The count alone bounds the speed: at most the counted edges and one that may follow.
        let most = if counted != 0.0 {
            (counted.abs() + 1.0) / DT
        } else if self.since < STANDSTILL_S {
            1.0 / self.since
        } else {
            0.0
        };
        if counted != 0.0 {
            let (edge, age) = plant.edge(DT);
            let between = self.since - age;
            if between > 0.0 {
                self.speed = (edge - self.edge) / between;
            }
            (self.edge, self.since) = (edge, age);
        }
        self.speed = self.speed.clamp(-most, most);
        self.speed
    }
}

/// A speed far beyond every motor that stays finite with any gains.
const FASTEST: f64 = 1e6;
const HEAVIEST: f64 = 1e6;
const FARTHEST: f64 = 1e9;

#[derive(Debug, Clone)]
struct Observer {
    /// The observed position minus the last count, in counts.
    ahead: f64,
    /// The observed load torque, in N·m.
    load: f64,
    // Per control cycle: decay of the speed, gain per N·m, correction per rad.
    decay: f64,
    per_torque: f64,
    torque_constant: f64,
    position_gain: f64,
    velocity_gain: f64,
    load_gain: f64,
    counts_per_rad: f64,
}

impl Observer {
    fn new(tuning: &Tuning, counts_per_rad: f64) -> Self {
        let mut fresh = Self {
            ahead: 0.0,
            load: 0.0,
            decay: 1.0,
            per_torque: 0.0,
            torque_constant: 0.0,
            position_gain: 0.0,
            velocity_gain: 0.0,
            load_gain: 0.0,
            counts_per_rad,
        };
        fresh.tune(tuning);
        fresh
    }

    fn tune(&mut self, tuning: &Tuning) {
        let gains = &tuning.gains.observer;
        // An inertia of zero means "no model", not infinite acceleration.
        let x = DT * gains.friction / gains.inertia.max(1e-10);
        let gain = if x > 0.0 { -(-x).exp_m1() / x } else { 1.0 };
        self.decay = (-x).exp();
        self.per_torque = gain * DT / gains.inertia.max(1e-10);
        self.torque_constant = tuning.torque_constant;
        self.position_gain = gains.position;
        self.velocity_gain = gains.velocity / self.counts_per_rad;
        self.load_gain = gains.load / self.counts_per_rad;
    }

    fn predict(&self, velocity: f64, current: f64) -> f64 {
        let torque = self.torque_constant * current - self.load;
        (velocity * self.decay + torque * self.per_torque).clamp(-FASTEST, FASTEST)
    }

    /// The notes add the load correction although the load decelerates the prediction. That sign
    /// would be unstable, so the correction is subtracted here.
    fn correct(&mut self, before: f64, predicted: f64, counted: f64) -> f64 {
        let moved = 0.5 * (before + predicted) * DT * self.counts_per_rad;
        let error = counted - (self.ahead + moved);
        self.ahead =
            (self.ahead + moved + self.position_gain * error - counted).clamp(-FARTHEST, FARTHEST);
        self.load = (self.load - self.load_gain * error).clamp(-HEAVIEST, HEAVIEST);
        super::flush(&mut self.load);
        (predicted + self.velocity_gain * error).clamp(-FASTEST, FASTEST)
    }
}
