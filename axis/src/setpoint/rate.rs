//! The rate at which the time of waves and tables passes.
//!
//! Tables have no jerk limit, and a constant rate up to 1 keeps their limits. So each cycle takes
//! the rate nearest to the wanted one that keeps the limits in this cycle: [`table_rate`].
//!
//! A wave p(s) with the rate r has the velocity p′·r, the acceleration p″·r² + p′·r′ and the jerk
//! p‴·r³ + 3·p″·r·r′ + p′·r″. With the highest slopes V, A and J of the wave, bounded r′ and r″ keep
//! all of them within the limits:
//!
//! - r′ ≤ (acceleration − A·h²) / V and r′ ≤ S / (6·A·h)
//! - r″ ≤ S / (2·V) with S = jerk − J·h³
//!
//! h is the highest rate until the rate is constant again.

use super::{MotionLimits, braking_velocity};

/// Share of the limits that a changing rate uses; the rest covers differences of cycles.
const USED: f64 = 0.99;

/// A rate from 0 to 1 that changes within the limits of an axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rate {
    value: f64,
    slope: f64,
    /// The highest rate until the slope is 0.
    highest: f64,
}

impl Rate {
    pub(super) const WHOLE: Self = Self {
        value: 1.0,
        slope: 0.0,
        highest: 1.0,
    };

    /// Advances one cycle towards `wanted` and returns the rate of this cycle. `slopes`: highest
    /// velocity, acceleration and jerk at rate 1. RT: O(1).
    pub(super) fn advance(
        &mut self,
        wanted: f64,
        slopes: [f64; 3],
        limits: &MotionLimits,
        dt_s: f64,
    ) -> f64 {
        let left = wanted.clamp(0.0, 1.0) - self.value;
        if left == 0.0 && self.slope == 0.0 {
            return self.value;
        }
        self.highest = match (self.slope > 0.0, left > 0.0) {
            (true, _) => self.highest.max(self.value + left),
            (false, true) if self.slope == 0.0 => self.value + left,
            (false, _) => self.value,
        };
        let [velocity, acceleration, jerk] = slopes;
        let top = self.highest;
        let jerk_left = (limits.jerk * USED - jerk * top.powi(3)).max(0.0);
        let steepest = ((limits.acceleration * USED - acceleration * top * top).max(0.0)
            / velocity)
            .min(jerk_left / (6.0 * acceleration * top));
        let bend = jerk_left / (2.0 * velocity) * dt_s;
        // The last change of the slope, to 0, is as large as the others.
        let slope = braking_velocity(left.abs(), jerk_left / (2.0 * velocity), dt_s);
        let slope = slope.min(steepest).copysign(left);
        let mut next = slope.max(self.slope - bend).min(self.slope + bend);
        // The bounds of a rising rate are not those of a falling one.
        if next * self.slope < 0.0 {
            next = 0.0;
        }
        let step = next * dt_s;
        if (left - step).abs() <= left.abs() * 1e-9 {
            self.value += left;
        } else {
            self.value = (self.value + step).clamp(0.0, 1.0);
        }
        self.slope = next;
        self.value
    }
}

/// Change of a table's rate per second.
const TABLE_SLEW: f64 = 5.0;

/// Number of halvings of the change that the limits do not permit.
const HALVINGS: u32 = 6;

/// Returns the next rate of tables that play in step, between `now` and `wanted`, neither above 1.
/// `permits`: true if one cycle at a rate keeps the limits of every table. RT: eight calls of
/// `permits` at most.
#[must_use]
pub fn table_rate(now: f64, wanted: f64, dt_s: f64, mut permits: impl FnMut(f64) -> bool) -> f64 {
    let most = TABLE_SLEW * dt_s;
    let to = wanted.max(now - most).min(now + most);
    if to == now || permits(to) {
        return to;
    }
    let (mut kept, mut refused) = (now, to);
    for _ in 0..HALVINGS {
        let middle = kept + (refused - kept) * 0.5;
        if permits(middle) {
            kept = middle;
        } else {
            refused = middle;
        }
    }
    kept
}
