//! Trapezoidal profiles, one control cycle at a time. Counts and seconds throughout.

use super::CONTROL_STEP as DT;

/// A point moving under limits.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Profile {
    pub position: f64,
    pub velocity: f64,
    /// Of the last step, for the feed-forward.
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

    /// Towards a velocity. True once it is reached.
    pub(super) fn ramp(&mut self, target: f64, acceleration: f64, deceleration: f64) -> bool {
        let slowing = target.abs() < self.velocity.abs() || target * self.velocity < 0.0;
        let step = DT * if slowing { deceleration } else { acceleration };
        let before = self.velocity;
        self.velocity += (target - before).clamp(-step, step);
        self.acceleration = (self.velocity - before) / DT;
        self.position += 0.5 * (before + self.velocity) * DT;
        self.velocity == target
    }

    /// Towards a position, coming to rest there. True once it is reached.
    pub(super) fn approach(&mut self, target: f64, limits: &Dynamics) -> bool {
        let distance = target - self.position;
        let step = limits.deceleration * DT;
        if distance.abs() <= 0.5 * step * DT && self.velocity.abs() <= 1.5 * step {
            *self = Self::at(target, 0.0);
            return true;
        }
        // The speed from which the remaining way still suffices, in whole control cycles.
        let half = 0.5 * step;
        let allowed = (half * half + 2.0 * limits.deceleration * distance.abs()).sqrt() - half;
        let wanted = distance.signum() * allowed.min(limits.velocity);
        self.ramp(wanted, limits.acceleration, limits.deceleration);
        false
    }
}

/// Set-points that arrive once a cycle, drawn out to a line between the last two.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Interpolator {
    from: f64,
    to: f64,
    /// Since the segment began. Negative right after a set-point that came between two control cycles.
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

    /// A set-point arrived. `period_ns` 0: no interpolation.
    pub(super) fn take(&mut self, value: f64, period_ns: i64) {
        // SYNC0 and the control cycle are not in step: what the last segment ran over or short of its
        // period goes to this one, else every segment would begin with the same false phase.
        self.elapsed_ns = (self.elapsed_ns - self.period_ns).clamp(-STEP_NS, 0);
        self.from = self.to;
        self.to = value;
        self.period_ns = period_ns;
    }

    /// One control cycle: value and slope per second.
    pub(super) fn advance(&mut self) -> (f64, f64) {
        let before = self.output;
        if self.period_ns <= 0 {
            self.output = self.to;
            return (self.to, (self.to - before) / DT);
        }
        self.elapsed_ns = self.elapsed_ns.saturating_add(STEP_NS);
        if self.elapsed_ns > self.period_ns {
            self.output = self.to;
            // Overdue: the last set-point stays, standing still.
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

/// Both far below 2^53.
#[expect(clippy::cast_precision_loss, reason = "nanoseconds of a few cycles")]
fn ratio(a: i64, b: i64) -> f64 {
    a as f64 / b as f64
}
