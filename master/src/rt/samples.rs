//! One row of values for every cycle, in memory that other threads and processes read.
//!
//! The memory is an array of 64-bit words: a header, then the rows as a ring. The writer never
//! waits. A reader copies a row and checks afterwards that its first word has stayed the same.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering, fence};

use ecaxis_axis::AxisStatus;
use ecaxis_axis::setpoint::LineShaftState;

use super::line_shaft::LineShaftStatus;
use crate::clock::Nanos;

/// Word 0 of the header, as bytes.
pub const MAGIC: [u8; 8] = *b"ECAXSMPL";
/// The version of the layout, word 1.
pub const VERSION: u64 = 1;

/// The words of the header.
pub mod header {
    pub const MAGIC: usize = 0;
    pub const VERSION: usize = 1;
    /// The first word of the rows.
    pub const ROWS_AT: usize = 2;
    /// The number of words of a row.
    pub const ROW_WORDS: usize = 3;
    /// The number of rows in the ring.
    pub const ROWS: usize = 4;
    /// The nominal cycle time in ns.
    pub const CYCLE_NS: usize = 5;
    /// The number of rows written so far. Row `n` is at `n % ROWS`.
    pub const WRITTEN: usize = 6;
    /// The due time of the next cycle in ns of the run's clock; `CLOCK_MONOTONIC` in real time.
    pub const NEXT_NS: usize = 7;
    /// First byte and number of bytes of the description (JSON).
    pub const DESCRIPTION_AT: usize = 8;
    pub const DESCRIPTION_BYTES: usize = 9;
    /// The number of words of the header without the description.
    pub const WORDS: usize = 16;
}

/// The words at the begin of a row: its number plus 1, time in ns, cycle, flags; then numbers.
pub const COUNT_COLUMNS: [&str; 4] = ["row", "time_ns", "cycle", "flags"];
/// The numbers of the cycle (f64) with their units. NaN: no value in this cycle.
pub const CYCLE_COLUMNS: [(&str, &str); 4] = [
    ("wake_up", "s"),
    ("exchange", "s"),
    ("phase_error", "s"),
    ("work", "s"),
];
/// The numbers of an axis (f64); units `""` are those of the axis, `/s` and `%` as written. NaN: no
/// value in this cycle.
pub const AXIS_COLUMNS: [(&str, &str); 11] = [
    ("position", ""),
    ("velocity", "/s"),
    ("torque", "%"),
    ("target_position", ""),
    ("target_velocity", "/s"),
    ("target_torque", "%"),
    ("following_error", ""),
    ("statusword", "bits"),
    ("controlword", "bits"),
    ("mode", "code"),
    ("encoder_difference", ""),
];

/// The numbers of a line shaft (f64), behind the inputs; units as those of an axis. NaN: it does not
/// run.
pub const LINE_SHAFT_COLUMNS: [(&str, &str); 4] = [
    ("position", ""),
    ("velocity", "/s"),
    ("age", "s"),
    ("error", ""),
];

/// Bits of the flags.
pub mod flags {
    /// All inputs are from this cycle.
    pub const FRESH: u64 = 1;
    /// All devices are in Op and the bus monitor is active.
    pub const IN_OP: u64 = 2;
    /// The machine is stopping.
    pub const STOPPING: u64 = 4;
    /// The release of frames is in phase with SYNC0.
    pub const PHASE_LOCKED: u64 = 8;
}

/// Returns the number of words of a row.
#[must_use]
pub const fn row_words(axes: usize, inputs: usize) -> usize {
    COUNT_COLUMNS.len() + CYCLE_COLUMNS.len() + axes * AXIS_COLUMNS.len() + inputs
}

/// The memory of the rows.
pub type Words = Arc<dyn AsRef<[AtomicU64]> + Send + Sync>;

/// The values of a cycle that belong to no axis.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CycleSample {
    pub time: Nanos,
    pub number: u64,
    /// See [`flags`].
    pub flags: u64,
    pub wake_up: Nanos,
    /// `None`: frames were lost.
    pub exchange: Option<Nanos>,
    /// `None`: no distributed clocks.
    pub phase_error: Option<i64>,
    /// From wake-up to the end of the last cycle's work.
    pub work: Nanos,
    pub next: Nanos,
}

/// The writer; there is one for each memory.
pub struct SampleWriter {
    memory: Words,
    rows_at: usize,
    row_words: usize,
    rows: u64,
    written: u64,
}

impl SampleWriter {
    /// Creates a writer for memory with a complete header. `None`: the header does not fit the
    /// memory.
    #[must_use]
    pub fn new(memory: Words) -> Option<Self> {
        let words = (*memory).as_ref();
        let word = |at: usize| words.get(at).map(|word| word.load(Ordering::Relaxed));
        let size = |at: usize| word(at).and_then(|n| usize::try_from(n).ok());
        let rows = word(header::ROWS).filter(|rows| *rows > 0)?;
        let (rows_at, row_words) = (size(header::ROWS_AT)?, size(header::ROW_WORDS)?);
        let needed = usize::try_from(rows).ok()?.checked_mul(row_words)?;
        let fits = rows_at.checked_add(needed)? <= words.len();
        let enough = row_words >= COUNT_COLUMNS.len() + CYCLE_COLUMNS.len();
        // A new run continues the count, so that readers see no row twice.
        let written = word(header::WRITTEN)?;
        (fits && enough).then_some(Self {
            memory,
            rows_at,
            row_words,
            rows,
            written,
        })
    }

    /// Writes one row. Values beyond the row's length are left out. RT.
    pub fn write(
        &mut self,
        cycle: &CycleSample,
        axes: &[AxisStatus],
        inputs: &[f64],
        line_shafts: &[LineShaftStatus],
    ) {
        let words = (*self.memory).as_ref();
        // Below `rows`, which fits the memory.
        let slot = usize::try_from(self.written % self.rows).unwrap_or(0);
        let at = self.rows_at + slot * self.row_words;
        let Some(row) = words.get(at..at + self.row_words) else {
            return;
        };
        let Some((number, values)) = row.split_first() else {
            return;
        };
        number.store(0, Ordering::Relaxed);
        // A reader that sees a new value also sees that the number has changed.
        fence(Ordering::Release);
        let seconds = |ns: Nanos| ns as f64 * 1e-9;
        let mut to = values.iter();
        let mut put = |bits: u64| {
            if let Some(word) = to.next() {
                word.store(bits, Ordering::Relaxed);
            }
        };
        for count in [cycle.time, cycle.number, cycle.flags] {
            put(count);
        }
        for value in [
            seconds(cycle.wake_up),
            cycle.exchange.map_or(f64::NAN, seconds),
            cycle.phase_error.map_or(f64::NAN, |ns| ns as f64 * 1e-9),
            seconds(cycle.work),
        ] {
            put(value.to_bits());
        }
        for axis in axes {
            for value in axis_values(axis) {
                put(value.to_bits());
            }
        }
        for input in inputs {
            put(input.to_bits());
        }
        for value in line_shafts.iter().flat_map(line_shaft_values) {
            put(value.to_bits());
        }
        self.written += 1;
        number.store(self.written, Ordering::Release);
        if let (Some(written), Some(next)) =
            (words.get(header::WRITTEN), words.get(header::NEXT_NS))
        {
            next.store(cycle.next, Ordering::Relaxed);
            written.store(self.written, Ordering::Release);
        }
    }
}

/// The values in the order of [`AXIS_COLUMNS`].
fn axis_values(axis: &AxisStatus) -> [f64; AXIS_COLUMNS.len()] {
    [
        axis.position,
        axis.velocity,
        axis.torque,
        axis.target_position,
        axis.target_velocity,
        axis.target_torque,
        axis.following_error,
        f64::from(axis.statusword),
        f64::from(axis.controlword),
        f64::from(axis.mode.code()),
        axis.encoder_difference.unwrap_or(f64::NAN),
    ]
}

/// The values in the order of [`LINE_SHAFT_COLUMNS`].
fn line_shaft_values(shaft: &LineShaftStatus) -> [f64; LINE_SHAFT_COLUMNS.len()] {
    if shaft.state == LineShaftState::Waiting {
        return [f64::NAN; LINE_SHAFT_COLUMNS.len()];
    }
    [
        shaft.motion.position,
        shaft.motion.velocity,
        shaft.age_ns.map_or(f64::NAN, |ns| ns as f64 * 1e-9),
        shaft.error,
    ]
}

impl fmt::Debug for SampleWriter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SampleWriter")
            .field("row_words", &self.row_words)
            .field("rows", &self.rows)
            .field("written", &self.written)
            .finish_non_exhaustive()
    }
}
