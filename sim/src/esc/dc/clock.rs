//! A device clock with a drifting crystal.

use crate::Nanos;

/// Fraction bits of the fixed-point rate: 2^-40 ns per ns resolves 10^-12.
const FRACTION: u32 = 40;
const ONE: f64 = (1_u64 << FRACTION) as f64;

/// The clock of a device as a function of true time, in ns since power-on.
#[derive(Debug, Clone)]
pub struct Clock {
    base_true: Nanos,
    base_local: i128,
    crystal: i64,
    correction: i64,
}

impl Clock {
    #[must_use]
    pub fn new(now: Nanos, offset_ns: u64, drift_ppm: f64) -> Self {
        Self {
            base_true: now,
            base_local: i128::from(offset_ns) << FRACTION,
            crystal: (drift_ppm * 1e-6 * ONE) as i64,
            correction: 0,
        }
    }

    fn rate(&self) -> i128 {
        (1_i128 << FRACTION) + i128::from(self.crystal) + i128::from(self.correction)
    }

    fn fixed(&self, now: Nanos) -> i128 {
        self.base_local + i128::from(now.saturating_sub(self.base_true)) * self.rate()
    }

    /// Returns the local time at a true time.
    #[must_use]
    pub fn local(&self, now: Nanos) -> u64 {
        (self.fixed(now) >> FRACTION) as u64
    }

    /// Returns the first true time at which the clock shows `local`.
    #[must_use]
    pub fn true_time(&self, local: u64) -> Nanos {
        let ahead = ((i128::from(local) << FRACTION) - self.base_local).max(0);
        let rate = self.rate().max(1);
        // Shortly after a rate change, 64 bits are enough; a wider division is much slower.
        let ns = match (u64::try_from(ahead), u64::try_from(rate)) {
            (Ok(ahead), Ok(rate)) => ahead / rate,
            _ => u64::try_from(ahead / rate).unwrap_or(u64::MAX),
        };
        self.base_true.saturating_add(ns)
    }

    /// Returns a lower bound of the true time until the clock, at its present rate, advances by
    /// `local` ns.
    #[must_use]
    pub fn at_least(&self, local: u64) -> Nanos {
        // Assumes a clock that is 1/64 fast, which avoids a division.
        if self.rate() > (1 << FRACTION) + (1 << FRACTION) / 64 {
            return 0;
        }
        local.saturating_sub(1 + local / 64)
    }

    /// Changes the rate relative to the crystal from `now` on.
    pub(super) fn bend(&mut self, now: Nanos, correction: f64) {
        self.base_local = self.fixed(now);
        self.base_true = self.base_true.max(now);
        self.correction = (correction * ONE) as i64;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_clock_drifts_and_inverts() {
        let clock = Clock::new(1_000, 500, 50.0);
        assert_eq!(clock.local(1_000), 500);
        assert_eq!(clock.local(1_000_001_000), 1_000_050_499);
        let back = clock.true_time(1_000_050_500);
        assert!(back.abs_diff(1_000_001_000) <= 1, "{back}");
    }
}
