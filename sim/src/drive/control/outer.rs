//! Position PID and velocity PI. Both output a current and share one integral, so that switching
//! between them is bumpless.

use super::estimate::Estimator;
use super::{Bounds, Demand, Feed, FeedGains, Tuning};
use crate::drive::CONTROL_STEP as DT;

#[derive(Debug, Clone)]
pub(super) struct OuterLoop {
    position: Pid,
    velocity: Pi,
    torque_constant: f64,
    counts_per_rad: f64,
    /// The integral, in A.
    integral: f64,
    /// The position error of the previous cycle, in counts. `None`: no position was controlled.
    error: Option<f64>,
    /// The D part, in A.
    derivative: f64,
}

/// `C(s) = P + I/s + D·s / (1 + D/(10·P)·s)` (2.3.3), held for a control cycle: A per count.
#[derive(Debug, Clone)]
struct Pid {
    p: f64,
    i: f64,
    /// The step of the D part per change of the error, and its decay factor per cycle.
    d: f64,
    d_decay: f64,
    feed: FeedGains,
}

/// `C(s) = P + I/s` (2.3.2), held for a control cycle: A per rad/s.
#[derive(Debug, Clone)]
struct Pi {
    p: f64,
    i: f64,
    feed: FeedGains,
}

/// Converts the gains to A per count.
fn per_count(feed: &FeedGains, counts_per_rad: f64) -> FeedGains {
    FeedGains {
        velocity: feed.velocity / counts_per_rad,
        acceleration: feed.acceleration / counts_per_rad,
    }
}

impl FeedGains {
    fn of(&self, feed: &Feed) -> f64 {
        self.velocity * feed.velocity + self.acceleration * feed.acceleration
    }
}

impl Pid {
    fn new(tuning: &Tuning, counts_per_rad: f64) -> Self {
        let g = &tuning.gains.position;
        // Without a P part the filter's time constant is infinite and the D part vanishes.
        let (d, d_decay) = if g.p > 0.0 && g.d > 0.0 {
            let decay = (-DT * 10.0 * g.p / g.d).exp();
            (g.d * (1.0 - decay) / DT, decay)
        } else {
            (0.0, 0.0)
        };
        let i = g.i * DT;
        Self {
            // Half a step of the integral is its mean while the output holds.
            p: (g.p + 0.5 * i) / counts_per_rad,
            i: i / counts_per_rad,
            d: d / counts_per_rad,
            d_decay,
            feed: per_count(&g.feed, counts_per_rad),
        }
    }
}

impl Pi {
    fn new(tuning: &Tuning, counts_per_rad: f64) -> Self {
        let g = &tuning.gains.velocity;
        let i = g.i * DT;
        Self {
            p: g.p + 0.5 * i,
            i,
            feed: per_count(&g.feed, counts_per_rad),
        }
    }
}

impl OuterLoop {
    pub(super) fn new(tuning: &Tuning, counts_per_rad: f64) -> Self {
        Self {
            position: Pid::new(tuning, counts_per_rad),
            velocity: Pi::new(tuning, counts_per_rad),
            torque_constant: tuning.torque_constant,
            counts_per_rad,
            integral: 0.0,
            error: None,
            derivative: 0.0,
        }
    }

    pub(super) fn tune(&mut self, tuning: &Tuning, counts_per_rad: f64) {
        self.position = Pid::new(tuning, counts_per_rad);
        self.velocity = Pi::new(tuning, counts_per_rad);
        self.torque_constant = tuning.torque_constant;
    }

    /// Returns the current demand and whether it was limited. `None`: output stage off. The speed
    /// limit is in rad/s.
    pub(super) fn ask(
        &mut self,
        demand: Demand,
        estimator: &Estimator,
        bounds: &Bounds,
    ) -> Option<(f64, bool)> {
        let before = self.error.take();
        let (wanted, step) = match demand {
            Demand::Off => {
                self.integral = 0.0;
                return None;
            }
            Demand::Torque(torque) => {
                self.integral = 0.0;
                return Some(self.torque(torque, estimator.velocity(), bounds));
            }
            Demand::Position {
                position,
                feed,
                torque,
            } => {
                let pid = &self.position;
                let error = position - estimator.counts_ahead();
                self.derivative = match before {
                    Some(before) => pid.d_decay * self.derivative + pid.d * (error - before),
                    None => 0.0,
                };
                super::flush(&mut self.derivative);
                self.error = Some(error);
                let fed = pid.feed.of(&feed) + torque / self.torque_constant;
                (pid.p * error + self.derivative + fed, pid.i * error)
            }
            Demand::Velocity {
                velocity,
                feed,
                torque,
            } => {
                let pi = &self.velocity;
                let error = velocity / self.counts_per_rad - estimator.velocity_ahead();
                let fed = pi.feed.of(&feed) + torque / self.torque_constant;
                (pi.p * error + fed, pi.i * error)
            }
        };
        let total = wanted + self.integral;
        let cut = bounds.current.clamp(total);
        // Anti-windup: while the output is limited, the integral may only decrease in magnitude.
        if total == cut || total * step < 0.0 {
            self.integral = bounds.current.clamp(self.integral + step);
        }
        Some((cut, cut != total))
    }

    fn torque(&self, torque: f64, velocity: f64, bounds: &Bounds) -> (f64, bool) {
        let wanted = torque / self.torque_constant;
        // The accelerating current fades out near the speed limit.
        let upper = self.velocity.p * (bounds.speed - velocity);
        let lower = self.velocity.p * (-bounds.speed - velocity);
        let allowed = wanted.min(upper).max(lower);
        let allowed = bounds.current.clamp(allowed);
        (allowed, allowed != wanted)
    }
}
