//! A crystal that drifts.

use crate::Nanos;

/// Fixed point: 2^-40 ns per ns resolves a rate of 10^-12.
const FRACTION: u32 = 40;
const ONE: f64 = (1_u64 << FRACTION) as f64;

/// A device's own clock as a function of true time; counts nanoseconds since power-on.
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

    /// Local time at a true time.
    #[must_use]
    pub fn local(&self, now: Nanos) -> u64 {
        (self.fixed(now) >> FRACTION) as u64
    }

    /// The first true time at which the clock shows `local`.
    #[must_use]
    pub fn true_time(&self, local: u64) -> Nanos {
        let ahead = ((i128::from(local) << FRACTION) - self.base_local).max(0);
        let rate = self.rate().max(1);
        // Soon after a bend 64 bits are enough; dividing more takes much longer.
        let ns = match (u64::try_from(ahead), u64::try_from(rate)) {
            (Ok(ahead), Ok(rate)) => ahead / rate,
            _ => u64::try_from(ahead / rate).unwrap_or(u64::MAX),
        };
        self.base_true.saturating_add(ns)
    }

    /// True time that passes at least until the clock, as it runs now, shows so much more.
    #[must_use]
    pub fn at_least(&self, local: u64) -> Nanos {
        // Without a division: as if it were a 64th fast.
        if self.rate() > (1 << FRACTION) + (1 << FRACTION) / 64 {
            return 0;
        }
        local.saturating_sub(1 + local / 64)
    }

    /// From now on the clock runs off its crystal by this share.
    pub(super) fn bend(&mut self, now: Nanos, correction: f64) {
        self.base_local = self.fixed(now);
        self.base_true = self.base_true.max(now);
        self.correction = (correction * ONE) as i64;
    }
}

/// Seeded noise on time stamps, as PHYs and clock domains make it.
#[derive(Debug, Clone)]
pub struct Jitter {
    amplitude: u32,
    state: u64,
}

impl Jitter {
    /// Evenly spread over ±`amplitude` nanoseconds.
    #[must_use]
    pub fn new(amplitude: u32, seed: u64) -> Self {
        Self {
            amplitude,
            state: seed,
        }
    }

    /// Time stamps are exact.
    #[must_use]
    pub fn is_none(&self) -> bool {
        self.amplitude == 0
    }

    /// A time stamp of `local`.
    pub fn stamp(&mut self, local: u64) -> u64 {
        if self.amplitude == 0 {
            return local;
        }
        // splitmix64
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.state;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        let span = u64::from(self.amplitude) * 2 + 1;
        let noise = (z ^ z >> 31) % span;
        local
            .saturating_add(noise)
            .saturating_sub(u64::from(self.amplitude))
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

    #[test]
    fn jitter_fills_its_span_and_repeats_from_its_seed() {
        let stamps = |seed| {
            let mut jitter = Jitter::new(5, seed);
            (0..1_000)
                .map(|_| jitter.stamp(1_000))
                .collect::<Vec<u64>>()
        };
        let seen = stamps(7);
        assert_eq!(
            (seen.iter().min(), seen.iter().max()),
            (Some(&995), Some(&1_005))
        );
        assert_eq!(seen, stamps(7));
        assert_ne!(seen, stamps(8));
        assert_eq!(Jitter::new(0, 1).stamp(42), 42);
    }
}
