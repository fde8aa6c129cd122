//! Timing statistics: bounded, preallocated, recorded in a few nanoseconds.

use hdrhistogram::Histogram;
use serde::Serialize;

use super::event_log::EventLog;

/// The longest time that a histogram resolves; longer ones count as this.
const LONGEST_NS: u64 = 10_000_000_000;

/// A distribution of times in ns.
#[derive(Debug, Clone)]
pub struct LatencyHistogram(Histogram<u64>);

impl LatencyHistogram {
    #[must_use]
    pub fn new() -> Self {
        let Ok(mut histogram) = Histogram::new_with_bounds(1, LONGEST_NS, 3) else {
            unreachable!("constant bounds are valid");
        };
        // Writes to every page, so that no page faults in a cycle.
        histogram.reset();
        Self(histogram)
    }

    /// Records one value. RT.
    pub fn record(&mut self, nanos: u64) {
        self.0.saturating_record(nanos);
    }

    /// Records a value `count` times. RT.
    pub fn record_n(&mut self, nanos: u64, count: u64) {
        // A count of zero would still raise the maximum.
        if count > 0 {
            self.0.saturating_record_n(nanos, count);
        }
    }

    /// Clears the values and keeps the memory.
    pub fn clear(&mut self) {
        self.0.reset();
    }

    /// Adds the values of another histogram.
    pub fn add(&mut self, other: &Self) {
        for (nanos, count) in other.recorded() {
            self.record_n(nanos, count);
        }
    }

    /// Returns each recorded value with its count, shortest first, at the histogram's resolution.
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

impl Default for LatencyHistogram {
    fn default() -> Self {
        Self::new()
    }
}

/// A summary of a distribution.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Percentiles {
    pub count: u64,
    pub p50_ns: u64,
    pub p99_ns: u64,
    pub p99_9_ns: u64,
    pub max_ns: u64,
}

/// Event counters.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Counters {
    pub cycles: u64,
    /// Cycles whose frames did not all come back before the deadline.
    pub lost_frames: u64,
    /// Cyclic frames that came back in a later cycle, or twice.
    pub late_frames: u64,
    /// Cycles with an unexpected working counter.
    pub wkc_errors: u64,
    /// Cycles skipped because the thread woke up too late for them.
    pub overruns: u64,
    /// Sends and receives that failed in the link.
    pub link_errors: u64,
    /// Acyclic answers that came too late or damaged, since the cycle started.
    pub refused_answers: u64,
}

impl Counters {
    /// Returns the sum of both.
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
    /// Clears the values and keeps the memory.
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

    /// Adds the values of another.
    pub fn add(&mut self, other: &Self) {
        self.counters = self.counters.plus(&other.counters);
        self.lateness.add(&other.lateness);
        self.slept.add(&other.slept);
        self.round_trip.add(&other.round_trip);
        self.phase.add(&other.phase);
        self.work.add(&other.work);
    }
}

/// All statistics of the cycle.
#[derive(Debug, Clone, Default)]
pub struct Stats {
    pub counters: Counters,
    /// Wake-up after the planned release.
    pub lateness: LatencyHistogram,
    /// How late the sleep ended, before any spinning.
    pub slept: LatencyHistogram,
    /// Release to the last answer.
    pub round_trip: LatencyHistogram,
    /// Magnitude of the phase error against SYNC0.
    pub phase: LatencyHistogram,
    /// Wake-up until going to sleep again.
    pub work: LatencyHistogram,
    /// The events of the cycle, in order.
    pub journal: EventLog,
}
