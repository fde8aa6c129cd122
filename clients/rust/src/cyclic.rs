//! Set-points in every cycle, in shared memory.

use std::fmt;
use std::os::fd::OwnedFd;
use std::sync::atomic::{Ordering, fence};
use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};
use serde_json::Value;

use crate::layout::{commands, samples};
use crate::memory::Memory;
use crate::{Error, Result};

/// The longest time without a cycle.
const NO_CYCLE: Duration = Duration::from_secs(1);
/// The pause between two looks at the samples.
const PAUSE: Duration = Duration::from_micros(20);

/// The place of an axis in the set-points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AxisNumber(usize);

/// A value of the samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Signal(usize);

/// A set-point in the units of its axis.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum SetPoint {
    /// The axis decelerates and holds.
    #[default]
    None,
    /// A position. The first one must be where the axis is.
    Position(f64),
    /// A velocity.
    Velocity(f64),
    /// A torque in percent.
    Torque(f64),
}

/// What the server has done with the set-points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Counters {
    /// Sets used.
    pub used: u64,
    /// Cycles without a new set.
    pub late: u64,
    /// Set-points refused.
    pub refused: u64,
    /// The number of the last set that was used.
    pub last: u64,
}

/// The set-points and the values of every cycle. Its functions use neither the connection nor a
/// lock, and allocate nothing.
///
/// The lease still needs [`Machine::keep`](crate::Machine::keep). Once this value is dropped, its
/// axes decelerate and hold.
pub struct Cyclic {
    samples: Memory,
    commands: Memory,
    axes: Box<[String]>,
    signals: Vec<(String, usize)>,
    rows_at: usize,
    rows: u64,
    cycle_ns: u64,
    axes_at: usize,
    axis_words: usize,
    /// The number of the next row.
    next: u64,
    counter: u64,
    row: Box<[u64]>,
    set_points: Box<[SetPoint]>,
}

impl Cyclic {
    /// Maps the memory of a server. `None`: it does not have the layout of `docs/server.md`. Every
    /// offset is read once and checked here.
    pub(crate) fn map(descriptors: &[OwnedFd], axes: Box<[String]>) -> Option<Self> {
        let [first, second] = descriptors else {
            return None;
        };
        let samples = Memory::map(first, false, samples::HEADER)?;
        let commands = Memory::map(second, true, commands::HEADER)?;
        let known = samples.load(0) == u64::from_ne_bytes(samples::MAGIC)
            && samples.load(samples::VERSION_AT) == samples::VERSION
            && commands.load(0) == u64::from_ne_bytes(commands::MAGIC)
            && commands.load(commands::VERSION_AT) == commands::VERSION;
        let (rows_at, row_words) = (
            samples.size(samples::ROWS_AT),
            samples.size(samples::ROW_WORDS),
        );
        let rows = samples.size(samples::ROWS);
        let rows_end = rows.checked_mul(row_words)?.checked_add(rows_at)?;
        let (axes_at, axis_words) = (
            commands.size(commands::AXES_AT),
            commands.size(commands::AXIS_WORDS),
        );
        let axes_end = axes.len().checked_mul(axis_words)?.checked_add(axes_at)?;
        let cycle_ns = samples.load(samples::CYCLE_NS);
        let fits = row_words > samples::FLAGS
            && rows > 0
            && cycle_ns > 0
            && rows_end <= samples.words().len()
            && commands.size(commands::AXES) == axes.len()
            && axes_at >= commands::HEADER
            && axis_words >= 2
            && axes_end <= commands.words().len();
        if !known || !fits {
            return None;
        }
        let (at, count) = (
            samples.size(samples::DESCRIPTION_AT),
            samples.size(samples::DESCRIPTION_BYTES),
        );
        let text: Value = serde_json::from_slice(&samples.bytes(at, count)?).ok()?;
        let signal = |signal: &Value| {
            let word = usize::try_from(signal["word"].as_u64()?).ok()?;
            let name = signal["name"].as_str()?.to_owned();
            (word > samples::FLAGS && word < row_words).then_some((name, word))
        };
        let signals = text["signals"]
            .as_array()?
            .iter()
            .filter_map(signal)
            .collect();
        let next = samples.load(samples::WRITTEN).wrapping_sub(1);
        let mut cyclic = Self {
            counter: commands.load(commands::COUNTER),
            set_points: vec![SetPoint::None; axes.len()].into(),
            row: vec![0; row_words].into(),
            rows: rows as u64,
            samples,
            commands,
            axes,
            signals,
            rows_at,
            cycle_ns,
            axes_at,
            axis_words,
            next,
        };
        cyclic.poll();
        Some(cyclic)
    }

    /// Returns the cycle time.
    #[must_use]
    pub fn cycle_time(&self) -> Duration {
        Duration::from_nanos(self.cycle_ns)
    }

    /// Returns the place of an axis.
    ///
    /// # Errors
    /// Fails if the machine has no such axis.
    pub fn axis(&self, name: &str) -> Result<AxisNumber> {
        let found = self.axes.iter().position(|axis| axis == name);
        let error = || Error::new("unknown_name", "the machine has no such axis");
        found
            .map(AxisNumber)
            .ok_or_else(|| error().at("area", name))
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
        self.row[samples::FLAGS] & (samples::IN_OP | samples::STOPPING) == samples::IN_OP
    }

    /// Prepares the set-point of an axis. [`Cyclic::publish`] makes it valid; it stays until it is
    /// replaced.
    pub fn set(&mut self, axis: AxisNumber, set_point: SetPoint) {
        if let Some(prepared) = self.set_points.get_mut(axis.0) {
            *prepared = set_point;
        }
    }

    /// Makes the prepared set-points valid for the next cycle. Returns the number of the set. An
    /// axis that starts fast keeps its first position until the server has used that set.
    pub fn publish(&mut self) -> u64 {
        let words = self.commands.words();
        let sequence = self.commands.load(commands::SEQUENCE) & !1;
        self.counter = self.counter.wrapping_add(1);
        words[commands::SEQUENCE].store(sequence.wrapping_add(1), Ordering::Relaxed);
        fence(Ordering::Release);
        words[commands::COUNTER].store(self.counter, Ordering::Relaxed);
        words[commands::FROM_ROW].store(self.next, Ordering::Relaxed);
        let axes = words[self.axes_at..].chunks_exact(self.axis_words);
        for (axis, set_point) in axes.zip(&self.set_points) {
            let (kind, value) = match *set_point {
                SetPoint::None => (0, 0.0),
                SetPoint::Position(value) => (1, value),
                SetPoint::Velocity(value) => (2, value),
                SetPoint::Torque(value) => (3, value),
            };
            axis[0].store(kind, Ordering::Relaxed);
            axis[1].store(value.to_bits(), Ordering::Relaxed);
        }
        words[commands::SEQUENCE].store(sequence.wrapping_add(2), Ordering::Release);
        self.counter
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

    /// As [`Cyclic::wait`] without waiting: 0 if there is no new cycle.
    pub fn poll(&mut self) -> u64 {
        let words = self.samples.words();
        for _ in 0..3 {
            let written = words[samples::WRITTEN].load(Ordering::Acquire);
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

    /// Returns the due time of the next cycle in ns of `CLOCK_MONOTONIC`.
    #[must_use]
    pub fn next_ns(&self) -> u64 {
        self.samples.load(samples::NEXT_NS)
    }

    /// Returns true if the server has refused a set-point of the axis, or none came in time: the
    /// axis has stopped, and follows again after a set with [`SetPoint::None`].
    #[must_use]
    pub fn is_stopped(&self, axis: AxisNumber) -> bool {
        self.commands.load(commands::BLOCKED) >> axis.0.min(63) & 1 == 1
    }

    /// Returns what the server has done with the set-points.
    #[must_use]
    pub fn counters(&self) -> Counters {
        Counters {
            used: self.commands.load(commands::USED),
            late: self.commands.load(commands::LATE),
            refused: self.commands.load(commands::REFUSED),
            last: self.commands.load(commands::LAST_USED),
        }
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

impl Drop for Cyclic {
    fn drop(&mut self) {
        self.set_points.fill(SetPoint::None);
        self.publish();
    }
}

impl fmt::Debug for Cyclic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Cyclic")
            .field("axes", &self.axes)
            .field("set_points", &self.set_points)
            .field("next", &self.next)
            .finish_non_exhaustive()
    }
}
