//! The history of all signals, and the distribution of times, from the samples of every cycle.
//!
//! The samples keep every cycle of the last minute. Here, buckets keep the least and the greatest
//! value of each signal for an hour, so that a spike of one cycle stays visible.

use std::sync::{Mutex, MutexGuard, PoisonError};

use ecaxis_master::clock::Nanos;
use ecaxis_master::rt::samples::CYCLE_COLUMNS;
use ecaxis_master::rt::stats::{LatencyHistogram, Percentiles};
use ecaxis_master::samples::Samples;
use serde_json::{Value, json};

/// The number of buckets.
const BUCKETS: usize = 16_384;
/// The time in ns that the buckets cover.
const HISTORY_NS: Nanos = 3600 * 1_000_000_000;
/// The words of a row before its numbers.
const COUNTS: usize = ecaxis_master::rt::samples::COUNT_COLUMNS.len();

/// The least and the greatest value of each signal, for consecutive buckets.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct History {
    /// True if each bucket is one cycle.
    pub exact: bool,
    /// The begin of each bucket.
    pub times_ns: Vec<u64>,
    /// For each signal the least values, then the greatest. NaN: no value.
    pub signals: Vec<[Vec<f64>; 2]>,
}

impl History {
    /// Returns the binary frame, see docs/server.md.
    #[must_use]
    pub fn frame(&self) -> Vec<u8> {
        let (buckets, signals) = (self.times_ns.len(), self.signals.len());
        let mut frame = Vec::with_capacity(16 + 8 * buckets * (2 * signals + 1));
        let count = |n: usize| u32::try_from(n).unwrap_or(u32::MAX).to_le_bytes();
        frame.extend([2, 0, 0, 0]);
        frame.extend(count(buckets));
        frame.extend(count(signals));
        frame.extend(u32::from(self.exact).to_le_bytes());
        for time in &self.times_ns {
            frame.extend(time.to_le_bytes());
        }
        for value in self.signals.iter().flatten().flatten() {
            frame.extend(value.to_le_bytes());
        }
        frame
    }
}

/// The distribution of the times of a cycle, in the order of the columns of a cycle.
#[derive(Debug, Clone)]
pub struct Timing {
    pub histograms: [LatencyHistogram; CYCLE_COLUMNS.len()],
}

/// The times and what was missed: read often, by commands too.
#[derive(Debug)]
struct Counted {
    timing: Timing,
    missed: u64,
}

#[derive(Debug)]
struct Inner {
    /// The first row that was not taken yet.
    next: u64,
    /// The number of the newest bucket: its time divided by its length.
    newest: Option<u64>,
    /// For each bucket and signal the least and the greatest value.
    least: Vec<f64>,
    greatest: Vec<f64>,
}

/// Takes all samples.
#[derive(Debug)]
pub struct Sampler {
    signals: usize,
    bucket_ns: Nanos,
    /// For as long as a history takes.
    inner: Mutex<Inner>,
    /// For a moment. Locked after `inner`, if both are.
    counted: Mutex<Counted>,
}

impl Sampler {
    #[must_use]
    pub fn new(signals: usize, cycle_ns: Nanos) -> Self {
        let bucket_ns = (HISTORY_NS / BUCKETS as u64).max(cycle_ns);
        Self {
            signals,
            bucket_ns,
            counted: Mutex::new(Counted {
                timing: Timing {
                    histograms: std::array::from_fn(|_| LatencyHistogram::new()),
                },
                missed: 0,
            }),
            inner: Mutex::new(Inner {
                next: 0,
                newest: None,
                least: vec![f64::NAN; BUCKETS * signals],
                greatest: vec![f64::NAN; BUCKETS * signals],
            }),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn counted(&self) -> MutexGuard<'_, Counted> {
        self.counted.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes all new rows.
    pub fn take_new(&self, samples: &Samples) {
        let mut inner = self.lock();
        let mut next = inner.next;
        let missed = samples.read_new(&mut next, |_, row| self.take(&mut inner, row));
        inner.next = next;
        self.counted().missed += missed;
    }

    fn take(&self, inner: &mut Inner, row: &[u64]) {
        let (counts, values) = row.split_at(COUNTS.min(row.len()));
        for (histogram, bits) in self.counted().timing.histograms.iter_mut().zip(values) {
            let seconds = f64::from_bits(*bits);
            if seconds.is_finite() {
                // At most hours; the cast saturates.
                histogram.record((seconds.abs() * 1e9) as u64);
            }
        }
        let Some(&time) = counts.get(1) else {
            return;
        };
        let bucket = time / self.bucket_ns;
        let first = match inner.newest {
            Some(newest) if bucket <= newest => newest + 1,
            // Buckets without a cycle stay empty.
            Some(newest) => (newest + 1).max(bucket.saturating_sub(BUCKETS as u64 - 1)),
            None => bucket,
        };
        for empty in first..=bucket {
            let at = self.place(empty);
            inner.least[at.clone()].fill(f64::NAN);
            inner.greatest[at].fill(f64::NAN);
        }
        inner.newest = inner.newest.max(Some(bucket));
        let at = self.place(bucket);
        let least = inner.least[at.clone()].iter_mut();
        let greatest = inner.greatest[at].iter_mut();
        for ((least, greatest), bits) in least.zip(greatest).zip(values) {
            let value = f64::from_bits(*bits);
            // `min` and `max` ignore NaN.
            *least = least.min(value);
            *greatest = greatest.max(value);
        }
    }

    fn place(&self, bucket: u64) -> std::ops::Range<usize> {
        let slot = usize::try_from(bucket % BUCKETS as u64).unwrap_or(0);
        slot * self.signals..(slot + 1) * self.signals
    }

    /// Returns the distribution of the times since the start of the server.
    #[must_use]
    pub fn timing(&self) -> Timing {
        self.counted().timing.clone()
    }

    /// Returns percentiles of the times, in the order of the columns of a cycle.
    #[must_use]
    pub fn percentiles(&self) -> [Percentiles; CYCLE_COLUMNS.len()] {
        let counted = self.counted();
        std::array::from_fn(|column| counted.timing.histograms[column].summary())
    }

    /// Returns the recorded times with their counts as a JSON object.
    #[must_use]
    pub fn histogram_object(&self) -> Value {
        let timing = self.timing();
        let columns = CYCLE_COLUMNS.iter().zip(&timing.histograms);
        let object = columns.map(|((name, _), histogram)| {
            let mut from = 0;
            let buckets = histogram.recorded().map(|(to, count)| {
                let bucket = json!([from, to, count]);
                from = to;
                bucket
            });
            (
                (*name).to_owned(),
                json!({"buckets": buckets.collect::<Vec<_>>()}),
            )
        });
        Value::Object(object.collect())
    }

    /// Returns the number of rows that came and went before they were read.
    #[must_use]
    pub fn missed(&self) -> u64 {
        self.counted().missed
    }

    /// Returns the least and the greatest values of the signals with these words, in at most
    /// `buckets` buckets between both times.
    #[must_use]
    pub fn history(
        &self,
        samples: &Samples,
        words: &[usize],
        [from_ns, to_ns]: [Nanos; 2],
        buckets: usize,
    ) -> History {
        let columns: Vec<_> = words
            .iter()
            .map(|word| word.saturating_sub(COUNTS))
            .collect();
        if let Some(history) = recent(samples, &columns, [from_ns, to_ns], buckets) {
            return history;
        }
        let inner = self.lock();
        let Some(newest) = inner.newest else {
            return History::default();
        };
        let oldest = newest.saturating_sub(BUCKETS as u64 - 1);
        let first = (from_ns / self.bucket_ns).max(oldest);
        let last = (to_ns / self.bucket_ns).min(newest);
        let available = last.saturating_add(1).saturating_sub(first);
        let each = available.div_ceil(buckets.max(1) as u64).max(1);
        let mut history = History {
            exact: false,
            times_ns: Vec::new(),
            signals: vec![[Vec::new(), Vec::new()]; columns.len()],
        };
        let mut begin = first;
        while begin <= last {
            let end = (begin + each - 1).min(last);
            history.times_ns.push(begin * self.bucket_ns);
            for (column, [least, greatest]) in columns.iter().zip(&mut history.signals) {
                let (mut low, mut high) = (f64::NAN, f64::NAN);
                for bucket in begin..=end {
                    let at = self.place(bucket).start + column;
                    low = low.min(inner.least.get(at).copied().unwrap_or(f64::NAN));
                    high = high.max(inner.greatest.get(at).copied().unwrap_or(f64::NAN));
                }
                least.push(low);
                greatest.push(high);
            }
            begin = end + 1;
        }
        history
    }
}

/// Returns the history from the samples of every cycle, if they reach back to `from_ns`.
fn recent(
    samples: &Samples,
    columns: &[usize],
    [from_ns, to_ns]: [Nanos; 2],
    buckets: usize,
) -> Option<History> {
    let end = samples.written();
    let start = end.saturating_sub(samples.capacity());
    let mut row = Vec::new();
    let time = |number: u64, row: &mut Vec<u64>| samples.read(number, row).then(|| row[1]);
    // The oldest row may be overwritten at any time.
    let start = if start > 0 { start + 64 } else { 0 };
    let oldest = (start < end).then(|| time(start, &mut row))??;
    if from_ns < oldest && start > 0 {
        return None;
    }
    // Rows have ascending times.
    let find = |wanted: Nanos, row: &mut Vec<u64>| {
        let (mut low, mut high) = (start, end);
        while low < high {
            let middle = low + (high - low) / 2;
            match time(middle, row) {
                Some(at) if at >= wanted => high = middle,
                _ => low = middle + 1,
            }
        }
        low
    };
    let first = find(from_ns, &mut row);
    let last = find(to_ns.saturating_add(1), &mut row);
    let rows = last.saturating_sub(first);
    let each = rows.div_ceil(buckets.max(1) as u64).max(1);
    let mut history = History {
        exact: each == 1,
        times_ns: Vec::new(),
        signals: vec![[Vec::new(), Vec::new()]; columns.len()],
    };
    for number in first..last {
        if !samples.read(number, &mut row) {
            continue;
        }
        if (number - first) % each == 0 || history.times_ns.is_empty() {
            history.times_ns.push(row[1]);
            for [least, greatest] in &mut history.signals {
                least.push(f64::NAN);
                greatest.push(f64::NAN);
            }
        }
        for (column, [least, greatest]) in columns.iter().zip(&mut history.signals) {
            let value = row
                .get(COUNTS + column)
                .map_or(f64::NAN, |bits| f64::from_bits(*bits));
            if let (Some(low), Some(high)) = (least.last_mut(), greatest.last_mut()) {
                *low = low.min(value);
                *high = high.max(value);
            }
        }
    }
    Some(history)
}
