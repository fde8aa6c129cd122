//! How fast the shaft turns, from an encoder that counts: by the time between edges and a low-pass
//! filter, or by an observer that knows the motor. (IDX application notes, 2.3.2.)

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
    /// The count seen last.
    counts: i64,
    counts_per_rad: f64,
    /// rad/s.
    velocity: f64,
    /// Of both, in the last control cycle.
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

    /// What an output held for a control cycle meets on the whole: the count and the speed half a cycle
    /// from now, if they go on as in the last one.
    pub(super) fn counts_ahead(&self) -> f64 {
        float(self.counts) + 0.5 * self.counted
    }

    pub(super) fn velocity_ahead(&self) -> f64 {
        self.velocity + 0.5 * self.gained
    }

    /// rad/s.
    pub(super) fn velocity(&self) -> f64 {
        self.velocity
    }

    /// A control cycle has passed, with this mean current.
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

/// Share of a new value in a low-pass filter `2πf / (s + 2πf)`. Between edges there is a mean speed only,
/// which is half a cycle old: the filter lags by that much less.
fn share(cut_off: f64) -> f64 {
    let x = std::f64::consts::TAU * cut_off * DT;
    (x / (1.0 + 0.5 * x)).min(1.0)
}

/// So long without an edge, s, and the shaft stands.
const STANDS: f64 = 0.05;

#[derive(Debug, Clone)]
struct Filter {
    /// The edge seen last, in counts, and how long ago it was.
    edge: f64,
    since: f64,
    /// Counts/s between the last two edges.
    speed: f64,
    share: f64,
}

impl Filter {
    fn measure(&mut self, plant: &Plant, counted: f64) -> f64 {
        self.since += DT;
        // What the count alone says: no edge more than there were, and one that may be about to come.
        let most = if counted != 0.0 {
            (counted.abs() + 1.0) / DT
        } else if self.since < STANDS {
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

/// Far beyond every motor, and near enough to stay finite whatever the gains are.
const FASTEST: f64 = 1e6;
const HEAVIEST: f64 = 1e6;
const FARTHEST: f64 = 1e9;

#[derive(Debug, Clone)]
struct Observer {
    /// Counts that the observed position is off from the count seen last.
    ahead: f64,
    /// N·m.
    load: f64,
    // Per control cycle: what is left of the speed, what a newton metre adds, what a radian corrects.
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
        // No inertia is no model, not infinite acceleration.
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

    /// The notes add the load correction although the load slows the prediction down; that way round it
    /// would run away, so it is taken off here.
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
