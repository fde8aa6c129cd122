//! Seeded randomness: the same seed reproduces a run.

/// The splitmix64 generator.
#[derive(Debug, Clone)]
pub(crate) struct Random(u64);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }

    pub(crate) fn chance(&mut self, probability: f64) -> bool {
        // An `f64` represents 53 bits exactly.
        ((self.next() >> 11) as f64) < probability * (1_u64 << 53) as f64
    }
}

/// Seeded noise on time stamps, as caused by PHYs and clock domains.
#[derive(Debug, Clone)]
pub(crate) struct Jitter {
    amplitude: u32,
    random: Random,
}

impl Jitter {
    /// Creates noise that is uniformly distributed over ±`amplitude` ns.
    pub(crate) fn new(amplitude: u32, seed: u64) -> Self {
        Self {
            amplitude,
            random: Random::new(seed),
        }
    }

    /// True if time stamps are exact.
    pub(crate) fn is_none(&self) -> bool {
        self.amplitude == 0
    }

    /// Returns a noisy time stamp of `local`.
    pub(crate) fn stamp(&mut self, local: u64) -> u64 {
        if self.amplitude == 0 {
            return local;
        }
        let span = u64::from(self.amplitude) * 2 + 1;
        let noise = self.random.next() % span;
        local
            .saturating_add(noise)
            .saturating_sub(u64::from(self.amplitude))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
