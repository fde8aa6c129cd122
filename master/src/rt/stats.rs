//! Numbers that prove the timing: bounded, preallocated, recorded in a few nanoseconds.

use hdrhistogram::Histogram;
use serde::Serialize;

/// Longest time a histogram tells apart; longer ones count as this.
const LONGEST_NS: u64 = 10_000_000_000;

/// A distribution of nanoseconds.
#[derive(Debug, Clone)]
pub struct Times(Histogram<u64>);

impl Times {
    #[must_use]
    pub fn new() -> Self {
        let Ok(histogram) = Histogram::new_with_bounds(1, LONGEST_NS, 3) else {
            unreachable!("constant bounds are valid");
        };
        Self(histogram)
    }

    /// RT.
    pub fn record(&mut self, nanos: u64) {
        self.0.saturating_record(nanos);
    }

    #[must_use]
    pub fn summary(&self) -> Percentiles {
        Percentiles {
            count: self.0.len(),
            p50_ns: self.0.value_at_quantile(0.5),
            p99_ns: self.0.value_at_quantile(0.99),
            p99_9_ns: self.0.value_at_quantile(0.999),
            max_ns: self.0.max(),
        }
    }
}

impl Default for Times {
    fn default() -> Self {
        Self::new()
    }
}

/// What is told of a distribution.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Percentiles {
    pub count: u64,
    pub p50_ns: u64,
    pub p99_ns: u64,
    pub p99_9_ns: u64,
    pub max_ns: u64,
}

/// How often things happened.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Counters {
    pub cycles: u64,
    /// Cycles whose frames did not all come back before the deadline.
    pub lost_frames: u64,
    /// Frames of ours that came back in a later cycle, or twice.
    pub late_frames: u64,
    /// Cycles with a working counter other than expected.
    pub wkc_errors: u64,
    /// Cycles left out because the thread woke up too late for them.
    pub overruns: u64,
    /// Sends and receives that the link refused.
    pub link_errors: u64,
    /// Answers that came too late for the mailbox side, or damaged.
    pub refused_answers: u64,
}

/// Everything the cycle records.
#[derive(Debug, Clone, Default)]
pub struct Stats {
    pub counters: Counters,
    /// Wake-up after the planned release.
    pub lateness: Times,
    /// Release to the last answer.
    pub round_trip: Times,
    /// Amount of the phase error against SYNC0.
    pub phase: Times,
    /// Wake-up to going to sleep again.
    pub work: Times,
}
