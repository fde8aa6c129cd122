//! The memory of the samples: its header with names and units, and a reader.

use std::fmt;
use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering, fence};

use serde::Serialize;

use crate::clock::Nanos;
use crate::config::Machine;
use crate::rt::samples::{
    AXIS_COLUMNS, COUNT_COLUMNS, CYCLE_COLUMNS, LINE_SHAFT_COLUMNS, MAGIC, SampleWriter, VERSION,
    header, row_words,
};
use crate::sys::shared_memory::SharedMemory;

/// The maximum size of the memory in words (1 GiB).
const MAX_WORDS: usize = 1 << 27;
/// The minimum number of rows.
const MIN_ROWS: usize = 1024;

/// One value of a row.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SampleSignal {
    /// For example `x.position`, `bus.wake_up`, `io.Input 1`.
    pub name: String,
    pub unit: String,
    /// Its word in the row.
    pub word: usize,
}

/// The names of a row's values.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SampleLayout {
    pub row_words: usize,
    pub cycle_ns: u64,
    /// The first words of a row, unsigned integers.
    pub counts: [&'static str; COUNT_COLUMNS.len()],
    /// The other words, binary64 numbers.
    pub signals: Vec<SampleSignal>,
}

impl SampleLayout {
    /// Returns the layout of a machine's rows.
    #[must_use]
    pub fn new(machine: &Machine) -> Self {
        let mut signals = Vec::new();
        let mut add = |name: String, unit: String| {
            let word = COUNT_COLUMNS.len() + signals.len();
            signals.push(SampleSignal { name, unit, word });
        };
        for (name, unit) in CYCLE_COLUMNS {
            add(format!("bus.{name}"), unit.to_owned());
        }
        for axis in &machine.axes {
            for (name, unit) in AXIS_COLUMNS {
                let unit = match unit {
                    "" | "/s" => format!("{}{unit}", axis.unit),
                    unit => unit.to_owned(),
                };
                add(format!("{}.{name}", axis.name), unit);
            }
        }
        for input in &machine.inputs {
            add(input.name.clone(), String::new());
        }
        for shaft in &machine.line_shafts {
            for (name, unit) in LINE_SHAFT_COLUMNS {
                let unit = match unit {
                    "s" => unit.to_owned(),
                    per => format!("{}{per}", shaft.unit),
                };
                add(format!("{}.{name}", shaft.name), unit);
            }
        }
        let of_shafts = machine.line_shafts.len() * LINE_SHAFT_COLUMNS.len();
        Self {
            row_words: row_words(machine.axes.len(), machine.inputs.len()) + of_shafts,
            cycle_ns: machine.bus.cycle_ns,
            counts: COUNT_COLUMNS,
            signals,
        }
    }

    /// Returns the signal with this name.
    #[must_use]
    pub fn signal(&self, name: &str) -> Option<&SampleSignal> {
        self.signals.iter().find(|signal| signal.name == name)
    }
}

/// The samples of the last cycles, across runs of the same machine.
#[derive(Clone)]
pub struct Samples {
    memory: Arc<SharedMemory>,
    layout: Arc<SampleLayout>,
    rows_at: usize,
    rows: u64,
}

impl Samples {
    /// Creates the memory for the samples of `duration_ns`, within 1 GiB.
    ///
    /// # Errors
    /// Fails if the system refuses the memory.
    pub fn create(layout: SampleLayout, duration_ns: Nanos) -> io::Result<Self> {
        let description = serde_json::to_vec(&layout).map_err(io::Error::other)?;
        let rows_at = header::WORDS + description.len().div_ceil(8);
        let room = MAX_WORDS.saturating_sub(rows_at) / layout.row_words;
        let wanted = usize::try_from(duration_ns / layout.cycle_ns.max(1)).unwrap_or(usize::MAX);
        let rows = wanted.max(MIN_ROWS).min(room);
        let memory = SharedMemory::create("ecaxis-samples", rows_at + rows * layout.row_words)?;
        let words = memory.words();
        let values = [
            (header::VERSION, VERSION),
            (header::ROWS_AT, rows_at as u64),
            (header::ROW_WORDS, layout.row_words as u64),
            (header::ROWS, rows as u64),
            (header::CYCLE_NS, layout.cycle_ns),
            (header::DESCRIPTION_AT, (header::WORDS * 8) as u64),
            (header::DESCRIPTION_BYTES, description.len() as u64),
        ];
        for (at, value) in values {
            words[at].store(value, Ordering::Relaxed);
        }
        for (word, bytes) in words[header::WORDS..].iter().zip(description.chunks(8)) {
            let mut whole = [b' '; 8];
            whole[..bytes.len()].copy_from_slice(bytes);
            word.store(u64::from_ne_bytes(whole), Ordering::Relaxed);
        }
        words[header::MAGIC].store(u64::from_ne_bytes(MAGIC), Ordering::Release);
        memory.forbid_writes_of_others()?;
        Ok(Self {
            memory: Arc::new(memory),
            layout: Arc::new(layout),
            rows_at,
            rows: rows as u64,
        })
    }

    #[must_use]
    pub fn layout(&self) -> &SampleLayout {
        &self.layout
    }

    /// Returns the number of rows that the memory keeps.
    #[must_use]
    pub fn capacity(&self) -> u64 {
        self.rows
    }

    /// Returns the writer for a run. Only one may be in use.
    #[must_use]
    pub fn writer(&self) -> Option<SampleWriter> {
        SampleWriter::new(Arc::clone(&self.memory) as Arc<_>)
    }

    /// Returns the number of rows written so far.
    #[must_use]
    pub fn written(&self) -> u64 {
        self.memory.words()[header::WRITTEN].load(Ordering::Acquire)
    }

    /// Copies row `number` into `row`. Returns `false` if it is not yet written or no longer kept.
    pub fn read(&self, number: u64, row: &mut Vec<u64>) -> bool {
        let slot = usize::try_from(number % self.rows).unwrap_or(0);
        let at = self.rows_at + slot * self.layout.row_words;
        let Some(words) = self.memory.words().get(at..at + self.layout.row_words) else {
            return false;
        };
        let expected = number + 1;
        if words[0].load(Ordering::Acquire) != expected {
            return false;
        }
        row.clear();
        row.extend(words.iter().map(|word| word.load(Ordering::Relaxed)));
        fence(Ordering::Acquire);
        words[0].load(Ordering::Relaxed) == expected
    }

    /// Calls `take` with each row from `next` on, with its number and words, and advances `next`.
    /// Returns the number of rows that were overwritten before they were read.
    pub fn read_new(&self, next: &mut u64, mut take: impl FnMut(u64, &[u64])) -> u64 {
        let (mut missed, mut row) = (0, Vec::with_capacity(self.layout.row_words));
        let end = self.written();
        while *next < end {
            let oldest = self.written().saturating_sub(self.rows);
            if *next < oldest {
                missed += oldest - *next;
                *next = oldest;
                continue;
            }
            if self.read(*next, &mut row) {
                take(*next, &row);
            } else {
                missed += 1;
            }
            *next += 1;
        }
        missed
    }
}

impl AsFd for Samples {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.memory.as_fd()
    }
}

impl AsRef<[AtomicU64]> for SharedMemory {
    fn as_ref(&self) -> &[AtomicU64] {
        self.words()
    }
}

impl fmt::Debug for Samples {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Samples")
            .field("signals", &self.layout.signals.len())
            .field("rows", &self.rows)
            .field("written", &self.written())
            .finish_non_exhaustive()
    }
}
