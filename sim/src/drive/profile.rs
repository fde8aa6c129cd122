//! Trapezoidal profiles, one control cycle at a time, in counts and seconds.

use super::CONTROL_STEP as DT;
use super::control::Feed;

/// A point that moves within speed and acceleration limits.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Profile {
    pub position: f64,
    pub velocity: f64,
    /// The acceleration of the last step, for the feed-forward.
    pub acceleration: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Dynamics {
    pub velocity: f64,
    pub acceleration: f64,
    pub deceleration: f64,
}

impl Profile {
    pub(super) fn at(position: f64, velocity: f64) -> Self {
        Self {
            position,
            velocity,
            acceleration: 0.0,
        }
    }

    pub(super) fn feed(&self) -> Feed {
        Feed {
            velocity: self.velocity,
            acceleration: self.acceleration,
        }
    }

    /// Moves towards a velocity. True once it is reached.
    pub(super) fn ramp(&mut self, target: f64, acceleration: f64, deceleration: f64) -> bool {
        let slowing = target.abs() < self.velocity.abs() || target * self.velocity < 0.0;
        let step = DT * if slowing { deceleration } else { acceleration };
        let before = self.velocity;
        self.velocity += (target - before).clamp(-step, step);
        self.acceleration = (self.velocity - before) / DT;
        self.position += 0.5 * (before + self.velocity) * DT;
        self.velocity == target
    }

    /// Moves towards a position and stops there. True once it is reached.
    pub(super) fn approach(&mut self, target: f64, limits: &Dynamics) -> bool {
        let distance = target - self.position;
        let step = limits.deceleration * DT;
        if distance.abs() <= 0.5 * step * DT && self.velocity.abs() <= 1.5 * step {
            *self = Self::at(target, 0.0);
            return true;
        }
        // The speed after this cycle from which the remaining distance suffices to stop: the root
        // of v²/2a + (v₀ + v)/2·Δt = distance.
        let half = 0.5 * step;
        let left = (distance.abs() - 0.5 * self.velocity * distance.signum() * DT).max(0.0);
        let allowed = (half * half + 2.0 * limits.deceleration * left).sqrt() - half;
        let wanted = distance.signum() * allowed.min(limits.velocity);
        self.ramp(wanted, limits.acceleration, limits.deceleration);
        false
    }
}

/// Linear interpolation between the last two cyclic set-points.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Interpolator {
    from: f64,
    to: f64,
    /// The time since the segment began. Negative if the set-point came between two control cycles.
    elapsed_ns: i64,
    period_ns: i64,
    output: f64,
}

const STEP_NS: i64 = super::CONTROL_PERIOD_NS.cast_signed();

impl Interpolator {
    pub(super) fn at(value: f64) -> Self {
        Self {
            from: value,
            to: value,
            output: value,
            ..Self::default()
        }
    }

    /// Takes a set-point. A `period_ns` of 0 disables interpolation.
    pub(super) fn take(&mut self, value: f64, period_ns: i64) {
        // SYNC0 and the control cycle are not in step. The next segment inherits the last one's
        // time error, otherwise every segment would begin with the same wrong phase.
        self.elapsed_ns = (self.elapsed_ns - self.period_ns).clamp(-STEP_NS, 0);
        self.from = self.to;
        self.to = value;
        self.period_ns = period_ns;
    }

    /// Advances one control cycle. Returns the value and its slope per second.
    pub(super) fn advance(&mut self) -> (f64, f64) {
        let before = self.output;
        if self.period_ns <= 0 {
            self.output = self.to;
            return (self.to, (self.to - before) / DT);
        }
        self.elapsed_ns = self.elapsed_ns.saturating_add(STEP_NS);
        if self.elapsed_ns > self.period_ns {
            self.output = self.to;
            // Overdue: hold the last set-point with zero slope.
            let overdue = self.elapsed_ns >= self.period_ns + STEP_NS;
            return (self.to, if overdue { 0.0 } else { self.slope() });
        }
        self.output = self.from + (self.to - self.from) * ratio(self.elapsed_ns, self.period_ns);
        (self.output, self.slope())
    }

    fn slope(&self) -> f64 {
        (self.to - self.from) * ratio(1_000_000_000, self.period_ns)
    }
}

/// Both values are far below 2^53.
#[expect(clippy::cast_precision_loss, reason = "nanoseconds of a few cycles")]
fn ratio(a: i64, b: i64) -> f64 {
    a as f64 / b as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the largest overshoot and the control cycles to the target.
    fn approach(from: Profile, target: f64, limits: &Dynamics) -> (f64, u32) {
        let (mut point, mut overshoot, mut cycles) = (from, 0.0_f64, 0);
        let way = (target - from.position).signum();
        while !point.approach(target, limits) {
            overshoot = overshoot.max(way * (point.position - target));
            assert!(point.velocity.abs() <= limits.velocity.max(from.velocity.abs()) + 1e-9);
            cycles += 1;
            assert!(cycles < 100_000, "{point:?}");
        }
        assert_eq!((point.position, point.velocity), (target, 0.0));
        (overshoot, cycles)
    }

    #[test]
    fn profile_ends_at_its_target_without_overshoot() {
        let limits = Dynamics {
            velocity: 50_000.0,
            acceleration: 333_333.0,
            deceleration: 250_000.0,
        };
        for distance in [0.3, 1.0, 7.0, 100.0, 4000.0, 20_000.0, -4001.0, -250_000.0] {
            let (overshoot, cycles) = approach(Profile::at(5.0, 0.0), 5.0 + distance, &limits);
            assert!(overshoot <= 0.1, "{distance}: {overshoot}");
            let d = distance.abs();
            let a = 2.0 / (1.0 / limits.acceleration + 1.0 / limits.deceleration);
            let ideal = if d > 50_000.0 * 50_000.0 / a {
                d / 50_000.0 + 50_000.0 / a
            } else {
                2.0 * (d / a).sqrt()
            };
            let took = f64::from(cycles) * DT;
            assert!(
                took < ideal + 0.01,
                "{distance}: {took} s, ideally {ideal} s"
            );
        }
    }

    #[test]
    fn profile_reverses_towards_its_target() {
        let limits = Dynamics {
            velocity: 10_000.0,
            acceleration: 100_000.0,
            deceleration: 100_000.0,
        };
        approach(Profile::at(0.0, 40_000.0), -100.0, &limits);
        approach(Profile::at(0.0, -9_000.0), 50.0, &limits);
    }

    #[test]
    fn interpolation_keeps_its_phase_with_unsynchronised_cycles() {
        let mut line = Interpolator::at(0.0);
        let (mut control, mut worst) = (STEP_NS, 0.0_f64);
        for cycle in 0..100 {
            let sync = cycle * 1_000_000;
            line.take(ratio(cycle, 1), 1_000_000);
            while control <= sync + 1_000_000 {
                let (value, slope) = line.advance();
                // The output lags by exactly one period.
                worst = worst.max((value - (ratio(control, 1_000_000) - 1.0).max(0.0)).abs());
                assert!(cycle == 0 || (slope - 1000.0).abs() < 1e-9);
                control += STEP_NS;
            }
        }
        assert!(worst < 1e-9, "{worst}");
    }
}
