//! Numbers that prove the timing: bounded, preallocated, recorded in a few nanoseconds.

use hdrhistogram::Histogram;
use serde::Serialize;

use super::journal::Journal;

/// Longest time a histogram tells apart; longer ones count as this.
const LONGEST_NS: u64 = 10_000_000_000;

/// A distribution of nanoseconds.
#[derive(Debug, Clone)]
pub struct Times(Histogram<u64>);

impl Times {
    #[must_use]
    pub fn new() -> Self {
        let Ok(mut histogram) = Histogram::new_with_bounds(1, LONGEST_NS, 3) else {
            unreachable!("constant bounds are valid");
        };
        // Writes to every page of it, so that none is met for the first time in a cycle.
        histogram.reset();
        Self(histogram)
    }

    /// RT.
    pub fn record(&mut self, nanos: u64) {
        self.0.saturating_record(nanos);
    }

    /// So many at once. RT.
    pub fn record_n(&mut self, nanos: u64, count: u64) {
        // None at all would still be the longest.
        if count > 0 {
            self.0.saturating_record_n(nanos, count);
        }
    }

    /// Forgets everything, without giving memory back.
    pub fn clear(&mut self) {
        self.0.reset();
    }

    /// Adds what another has recorded.
    pub fn add(&mut self, other: &Self) {
        for (nanos, count) in other.recorded() {
            self.record_n(nanos, count);
        }
    }

    /// The shortest times first, as far as they are told apart, and how often each was recorded.
    pub fn recorded(&self) -> impl Iterator<Item = (u64, u64)> + '_ {
        let each = self.0.iter_recorded();
        each.map(|step| (step.value_iterated_to(), step.count_at_value()))
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

impl Counters {
    /// Both together.
    #[must_use]
    pub fn plus(&self, other: &Self) -> Self {
        Self {
            cycles: self.cycles + other.cycles,
            lost_frames: self.lost_frames + other.lost_frames,
            late_frames: self.late_frames + other.late_frames,
            wkc_errors: self.wkc_errors + other.wkc_errors,
            overruns: self.overruns + other.overruns,
            link_errors: self.link_errors + other.link_errors,
            refused_answers: self.refused_answers + other.refused_answers,
        }
    }
}

impl Stats {
    /// Forgets everything, without giving memory back.
    pub fn clear(&mut self) {
        self.counters = Counters::default();
        for times in [
            &mut self.lateness,
            &mut self.slept,
            &mut self.round_trip,
            &mut self.phase,
            &mut self.work,
        ] {
            times.clear();
        }
    }

    /// Adds what another has recorded.
    pub fn add(&mut self, other: &Self) {
        self.counters = self.counters.plus(&other.counters);
        self.lateness.add(&other.lateness);
        self.slept.add(&other.slept);
        self.round_trip.add(&other.round_trip);
        self.phase.add(&other.phase);
        self.work.add(&other.work);
    }
}

/// Everything the cycle records.
#[derive(Debug, Clone, Default)]
pub struct Stats {
    pub counters: Counters,
    /// Wake-up after the planned release.
    pub lateness: Times,
    /// How late sleeping ended, whatever was spun after it.
    pub slept: Times,
    /// Release to the last answer.
    pub round_trip: Times,
    /// Amount of the phase error against SYNC0.
    pub phase: Times,
    /// Wake-up to going to sleep again.
    pub work: Times,
    /// What led to it.
    pub journal: Journal,
}
