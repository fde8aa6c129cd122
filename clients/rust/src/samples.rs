//! The values of every cycle, in shared memory.

use std::fmt;
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::{Ordering, fence};
use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};
use serde_json::Value;

use crate::layout::samples as layout;
use crate::memory::Memory;
use crate::{Error, Result};

/// The longest time without a cycle.
const NO_CYCLE: Duration = Duration::from_secs(1);
/// The pause between two looks at the samples.
const PAUSE: Duration = Duration::from_micros(20);

/// A value of the samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Signal(usize);

/// The values of the last cycle that was read. A clone reads the same memory on its own, also in
/// another thread and without the lease. Nothing here uses the connection or a lock, or allocates.
#[derive(Clone)]
pub struct Samples {
    memory: Arc<Memory>,
    signals: Arc<[(String, usize)]>,
    rows_at: usize,
    rows: u64,
    cycle_ns: u64,
    /// The number of the next row.
    next: u64,
    row: Box<[u64]>,
}

impl Samples {
    /// Maps the memory of a server. `None`: it does not have the layout of `docs/server.md`. Every
    /// offset is read once and checked here.
    pub(crate) fn map(descriptor: &OwnedFd) -> Option<Self> {
        let memory = Memory::map(descriptor, false, layout::HEADER)?;
        let known = memory.load(0) == u64::from_ne_bytes(layout::MAGIC)
            && memory.load(layout::VERSION_AT) == layout::VERSION;
        let (rows_at, row_words) = (memory.size(layout::ROWS_AT), memory.size(layout::ROW_WORDS));
        let rows = memory.size(layout::ROWS);
        let rows_end = rows.checked_mul(row_words)?.checked_add(rows_at)?;
        let cycle_ns = memory.load(layout::CYCLE_NS);
        let fits = row_words > layout::FLAGS
            && rows > 0
            && cycle_ns > 0
            && rows_end <= memory.words().len();
        if !known || !fits {
            return None;
        }
        let (at, count) = (
            memory.size(layout::DESCRIPTION_AT),
            memory.size(layout::DESCRIPTION_BYTES),
        );
        let text: Value = serde_json::from_slice(&memory.bytes(at, count)?).ok()?;
        let signal = |signal: &Value| {
            let word = usize::try_from(signal["word"].as_u64()?).ok()?;
            let name = signal["name"].as_str()?.to_owned();
            (word > layout::FLAGS && word < row_words).then_some((name, word))
        };
        let signals = text["signals"].as_array()?.iter().filter_map(signal);
        let mut samples = Self {
            signals: signals.collect(),
            next: memory.load(layout::WRITTEN).wrapping_sub(1),
            row: vec![0; row_words].into(),
            rows: rows as u64,
            memory: Arc::new(memory),
            rows_at,
            cycle_ns,
        };
        samples.poll();
        Some(samples)
    }

    /// Returns the cycle time.
    #[must_use]
    pub fn cycle_time(&self) -> Duration {
        Duration::from_nanos(self.cycle_ns)
    }

    /// Returns a signal such as `x.position` or `io.Input 1`. The signals of an axis are
    /// `position`, `velocity`, `torque`, `target_position`, `target_velocity`, `target_torque`,
    /// `following_error`, `statusword`, `controlword` and `mode`.
    ///
    /// # Errors
    /// Fails if there is none with this name.
    pub fn signal(&self, name: &str) -> Result<Signal> {
        let found = self.signals.iter().find(|(signal, _)| signal == name);
        let error = || Error::new("unknown_name", format!("no signal is called `{name}`"));
        found
            .map(|(_, word)| Signal(*word))
            .ok_or_else(|| error().at("area", ""))
    }

    /// Returns the value of a signal in the last cycle; NaN: none.
    #[must_use]
    pub fn value(&self, signal: Signal) -> f64 {
        match self.row.get(signal.0) {
            Some(bits) if self.row[0] != 0 => f64::from_bits(*bits),
            _ => f64::NAN,
        }
    }

    /// Returns true if the bus was in Op in the last cycle, and no stop was under way.
    #[must_use]
    pub fn in_op(&self) -> bool {
        self.row[layout::FLAGS] & (layout::IN_OP | layout::STOPPING) == layout::IN_OP
    }

    /// Returns the number of the next cycle: those before have been read or missed.
    #[must_use]
    pub fn next_cycle(&self) -> u64 {
        self.next
    }

    /// Returns the due time of the last cycle in ns of `CLOCK_MONOTONIC`.
    #[must_use]
    pub fn time_ns(&self) -> u64 {
        self.row[layout::TIME_NS]
    }

    /// Returns the due time of the next cycle in ns of `CLOCK_MONOTONIC`.
    #[must_use]
    pub fn next_ns(&self) -> u64 {
        self.memory.load(layout::NEXT_NS)
    }

    /// Waits for the next cycle. Returns how many have passed: more than 1 if some were missed.
    ///
    /// # Errors
    /// Fails if no cycle comes for a second: the server has ended, or the bus is down.
    pub fn wait(&mut self) -> Result<u64> {
        let begin = Instant::now();
        loop {
            match self.poll() {
                0 if begin.elapsed() > NO_CYCLE => {
                    let cause = "no cycle for a second: the server has ended, or the bus is down";
                    return Err(Error::new("not_up", cause).at("wait", ""));
                }
                0 => std::thread::sleep(self.pause()),
                passed => return Ok(passed),
            }
        }
    }

    /// As [`Samples::wait`] without waiting: 0 if there is no new cycle.
    pub fn poll(&mut self) -> u64 {
        let words = self.memory.words();
        for _ in 0..3 {
            let written = words[layout::WRITTEN].load(Ordering::Acquire);
            let passed = written.wrapping_sub(self.next);
            if written == 0 || passed == 0 {
                return 0;
            }
            let slot = usize::try_from((written - 1) % self.rows).unwrap_or(0);
            let at = self.rows_at + slot * self.row.len();
            let row = &words[at..at + self.row.len()];
            let before = row[0].load(Ordering::Acquire);
            for (to, from) in self.row.iter_mut().zip(row) {
                *to = from.load(Ordering::Relaxed);
            }
            fence(Ordering::Acquire);
            if before == written && row[0].load(Ordering::Relaxed) == written {
                self.next = written;
                return passed;
            }
        }
        0
    }

    /// Until the next cycle is due, then short pauses until its row is there.
    fn pause(&self) -> Duration {
        let now = clock_gettime(ClockId::Monotonic);
        let now_ns = now
            .tv_sec
            .saturating_mul(1_000_000_000)
            .saturating_add(now.tv_nsec);
        let rest = self
            .next_ns()
            .saturating_sub(u64::try_from(now_ns).unwrap_or(0));
        match rest {
            0 => PAUSE,
            rest if rest < self.cycle_ns.saturating_mul(2) => {
                Duration::from_nanos(rest).min(NO_CYCLE)
            }
            _ => PAUSE,
        }
    }
}

impl fmt::Debug for Samples {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Samples")
            .field("signals", &self.signals.len())
            .field("next", &self.next)
            .finish_non_exhaustive()
    }
}
