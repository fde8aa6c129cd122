//! Statistics of the served frames.

use crate::Nanos;

/// The buckets per power of two.
const STEPS: usize = 8;
const BUCKETS: usize = 64 * STEPS;

/// Counters of a served segment.
#[derive(Debug, Clone, Default)]
#[non_exhaustive]
pub struct ServeStats {
    /// EtherCAT frames received.
    pub frames: u64,
    /// Replies sent.
    pub answered: u64,
    /// Frames lost through the fault script or an open ring.
    pub lost: u64,
    /// Frames answered twice through the fault script.
    pub duplicated: u64,
    /// Replies delayed to the time of the simulated wire.
    pub delayed: u64,
    /// Frames passed on unprocessed because they were malformed, or too long even for that.
    pub malformed: u64,
    /// Frames other than EtherCAT. SubDevices destroy them unless configured otherwise.
    pub foreign: u64,
    /// Replies that could not be sent.
    pub send_errors: u64,
    /// The time from the arrival of a frame until its reply is sent or delayed.
    pub turnaround: Histogram,
}

/// Durations in buckets an eighth of a power of two wide: bounded memory, resolution 12 %.
#[derive(Debug, Clone)]
pub struct Histogram {
    counts: Vec<u64>,
    max: Nanos,
}

impl Default for Histogram {
    fn default() -> Self {
        Self {
            counts: vec![0; BUCKETS],
            max: 0,
        }
    }
}

impl Histogram {
    /// Counts a duration in ns.
    pub fn add(&mut self, value: Nanos) {
        if let Some(count) = self.counts.get_mut(bucket(value)) {
            *count += 1;
        }
        self.max = self.max.max(value);
    }

    /// Returns the longest duration in ns.
    #[must_use]
    pub fn max(&self) -> Nanos {
        self.max
    }

    /// Returns the value that `share` of all values do not exceed; `None` without values.
    #[must_use]
    pub fn quantile(&self, share: f64) -> Option<Nanos> {
        let all: u64 = self.counts.iter().sum();
        let wanted = (share.clamp(0.0, 1.0) * all as f64).ceil() as u64;
        let mut seen = 0;
        let found = self.counts.iter().position(|count| {
            seen += count;
            *count > 0 && seen >= wanted
        })?;
        Some(upper(found).min(self.max))
    }
}

/// Returns the bucket of a value: one per value below `STEPS`, then `STEPS` per power of two.
fn bucket(value: Nanos) -> usize {
    let steps = STEPS as u64;
    let exponent = (value | steps).ilog2() - steps.ilog2();
    let within = (value >> exponent) as usize;
    // For values from STEPS on, `within` lies between STEPS and 2·STEPS.
    exponent as usize * STEPS + within
}

/// Returns the largest value of a bucket.
fn upper(bucket: usize) -> Nanos {
    let exponent = (bucket / STEPS).saturating_sub(1);
    let within = (bucket - exponent * STEPS) as u128;
    u64::try_from(((within + 1) << exponent) - 1).unwrap_or(Nanos::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn histogram_buckets_are_ordered_and_bound_their_values() {
        let mut last = 0;
        for shift in 0..64 {
            for value in [
                1_u64 << shift,
                (1 << shift) + (1 << shift) / 3,
                u64::MAX >> (63 - shift),
            ] {
                let at = bucket(value);
                assert!(at < BUCKETS, "{value}");
                assert!(at >= last, "{value}");
                assert!(upper(at) >= value, "{value}");
                assert!(upper(at) - value <= value / 8 + 1, "{value}");
                last = at;
            }
        }
    }

    #[test]
    fn histogram_returns_the_quantiles_of_a_known_distribution() {
        let mut histogram = Histogram::default();
        assert_eq!(histogram.quantile(0.5), None);
        for value in 1..=1000 {
            histogram.add(value);
        }
        for (share, exact) in [(0.0, 1), (0.5, 500), (0.99, 990), (1.0, 1000)] {
            let got = histogram.quantile(share).unwrap();
            assert!((exact..=exact + exact / 8).contains(&got), "{share}: {got}");
        }
        assert_eq!(histogram.max(), 1000);
    }
}
