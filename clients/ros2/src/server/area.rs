//! The samples and the commands in shared memory.

use std::os::fd::OwnedFd;
use std::ptr::{self, NonNull};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering, fence};

use rustix::fs::fstat;
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};
use serde_json::Value;

const VERSION: u64 = 1;
/// Words of the samples.
const ROWS_AT: usize = 2;
const ROW_WORDS: usize = 3;
const ROWS: usize = 4;
const CYCLE_NS: usize = 5;
const WRITTEN: usize = 6;
const NEXT_NS: usize = 7;
const TEXT_AT: usize = 8;
const TEXT_BYTES: usize = 9;
/// Words of the commands.
const AXES_AT: usize = 2;
const AXIS_WORDS: usize = 3;
const AXES: usize = 4;
const SEQUENCE: usize = 5;
const COUNTER: usize = 6;
const FROM_ROW: usize = 7;
const BLOCKED: usize = 12;
const HEADER_WORDS: usize = 16;

/// Mapped memory as words.
#[derive(Debug)]
struct Words {
    base: NonNull<AtomicU64>,
    count: usize,
}

// SAFETY: this value alone owns the mapping and gives access to atomic words only.
unsafe impl Send for Words {}
// SAFETY: as above.
unsafe impl Sync for Words {}

impl Words {
    fn map(fd: &OwnedFd, protection: ProtFlags) -> Result<Self, String> {
        let failed = |error: rustix::io::Errno| format!("the area cannot be mapped: {error}");
        let bytes = usize::try_from(fstat(fd).map_err(failed)?.st_size).unwrap_or_default();
        let count = bytes / size_of::<AtomicU64>();
        if count < HEADER_WORDS {
            return Err("the area is too small".to_owned());
        }
        // SAFETY: a new mapping at an address that the kernel chooses.
        let base = unsafe { mmap(ptr::null_mut(), bytes, protection, MapFlags::SHARED, fd, 0) };
        let base = NonNull::new(base.map_err(failed)?.cast()).ok_or("the area has no address")?;
        Ok(Self { base, count })
    }

    fn get(&self) -> &[AtomicU64] {
        // SAFETY: the mapping has this length, is page-aligned, and lives as long as `self`. The
        // server writes at any time, which atomic accesses permit, and has sealed the size.
        unsafe { std::slice::from_raw_parts(self.base.as_ptr(), self.count) }
    }

    fn word(&self, at: usize) -> u64 {
        self.get()
            .get(at)
            .map_or(0, |word| word.load(Ordering::Relaxed))
    }

    fn place(&self, at: usize) -> usize {
        usize::try_from(self.word(at)).unwrap_or(usize::MAX)
    }

    fn check(&self, magic: &[u8; 8]) -> Result<(), String> {
        if self.word(0) == u64::from_ne_bytes(*magic) && self.word(1) == VERSION {
            return Ok(());
        }
        Err("the server has another version of the area: use the node of its release".to_owned())
    }
}

impl Drop for Words {
    fn drop(&mut self) {
        // SAFETY: this value owns the mapping, and no borrow outlives it.
        let _ = unsafe {
            munmap(
                self.base.as_ptr().cast(),
                self.count * size_of::<AtomicU64>(),
            )
        };
    }
}

/// The values of each cycle. Copies read the same memory.
#[derive(Debug, Clone)]
pub struct Samples {
    words: Arc<Words>,
    rows_at: usize,
    row_words: usize,
    rows: u64,
    pub cycle_ns: u64,
    /// Name and word of each signal.
    signals: Arc<Vec<(String, usize)>>,
}

impl Samples {
    /// Maps the samples.
    ///
    /// # Errors
    /// Fails if the memory is not as described.
    pub fn map(fd: &OwnedFd) -> Result<Self, String> {
        let words = Words::map(fd, ProtFlags::READ)?;
        words.check(b"ECAXSMPL")?;
        let (at, bytes) = (words.place(TEXT_AT), words.place(TEXT_BYTES));
        let end = at.checked_add(bytes).filter(|end| *end <= words.count * 8);
        let end = end.ok_or("the description of the samples is incomplete")?;
        let text: Vec<u8> = (at..end)
            .map(|byte| words.word(byte / 8).to_ne_bytes()[byte % 8])
            .collect();
        let description: Value = serde_json::from_slice(&text)
            .map_err(|error| format!("the description of the samples: {error}"))?;
        let signals = description["signals"].as_array().into_iter().flatten();
        let signals = signals.filter_map(|signal| {
            let word = usize::try_from(signal["word"].as_u64()?).ok()?;
            Some((signal["name"].as_str()?.to_owned(), word))
        });
        let (rows_at, row_words) = (words.place(ROWS_AT), words.place(ROW_WORDS));
        let rows = words.word(ROWS);
        let size = usize::try_from(rows)
            .ok()
            .and_then(|rows| rows.checked_mul(row_words));
        let fits = size
            .and_then(|size| size.checked_add(rows_at))
            .is_some_and(|end| end <= words.count);
        if !fits || rows == 0 || row_words < 4 {
            return Err("the rows of the samples do not fit in their memory".to_owned());
        }
        let cycle_ns = words.word(CYCLE_NS).max(1);
        let signals = Arc::new(signals.collect());
        Ok(Self {
            words: Arc::new(words),
            rows_at,
            row_words,
            rows,
            cycle_ns,
            signals,
        })
    }

    /// Returns the word of a signal.
    #[must_use]
    pub fn signal(&self, name: &str) -> Option<usize> {
        let found = self.signals.iter().find(|(signal, _)| signal == name)?.1;
        (found < self.row_words).then_some(found)
    }

    /// Returns the number of rows written so far.
    #[must_use]
    pub fn written(&self) -> u64 {
        self.words.get()[WRITTEN].load(Ordering::Acquire)
    }

    /// Returns the due time of the next cycle in ns of CLOCK_MONOTONIC.
    #[must_use]
    pub fn next_ns(&self) -> u64 {
        self.words.word(NEXT_NS)
    }

    /// Copies a row. Returns false if it is not there.
    pub fn read(&self, row: u64, into: &mut Vec<u64>) -> bool {
        let at = self.rows_at + (row % self.rows) as usize * self.row_words;
        let words = &self.words.get()[at..at + self.row_words];
        if words[0].load(Ordering::Acquire) != row.wrapping_add(1) {
            return false;
        }
        into.clear();
        into.extend(words.iter().map(|word| word.load(Ordering::Relaxed)));
        fence(Ordering::Acquire);
        words[0].load(Ordering::Relaxed) == row.wrapping_add(1)
    }

    /// Copies the newest row. Returns false if there is none.
    pub fn read_newest(&self, into: &mut Vec<u64>) -> bool {
        (0..4).any(|_| {
            self.written()
                .checked_sub(1)
                .is_some_and(|row| self.read(row, into))
        })
    }
}

/// The set-points of the next cycle.
#[derive(Debug)]
pub struct Commands {
    words: Words,
    axes_at: usize,
    axis_words: usize,
    axes: usize,
}

/// The kind and value of a set-point.
pub type SetPoint = (u64, f64);

impl Commands {
    /// Maps the commands.
    ///
    /// # Errors
    /// Fails if the memory is not as described.
    pub fn map(fd: &OwnedFd) -> Result<Self, String> {
        let words = Words::map(fd, ProtFlags::READ | ProtFlags::WRITE)?;
        words.check(b"ECAXCMDS")?;
        let (axes_at, axis_words, axes) = (
            words.place(AXES_AT),
            words.place(AXIS_WORDS),
            words.place(AXES),
        );
        let end = axes
            .checked_mul(axis_words)
            .and_then(|size| size.checked_add(axes_at));
        if end.is_none_or(|end| end > words.count) || axis_words < 2 {
            return Err("the axes of the commands do not fit in their memory".to_owned());
        }
        Ok(Self {
            words,
            axes_at,
            axis_words,
            axes,
        })
    }

    /// True if the server waits for kind 0 of an axis.
    #[must_use]
    pub fn blocked(&self, axis: usize) -> bool {
        self.words.word(BLOCKED) >> axis.min(63) & 1 != 0
    }

    /// Writes the set-points for the next cycle, calculated from `row`.
    pub fn write(&mut self, row: u64, set: &[SetPoint]) {
        let words = self.words.get();
        let sequence = words[SEQUENCE].load(Ordering::Relaxed);
        words[SEQUENCE].store(sequence.wrapping_add(1), Ordering::Relaxed);
        fence(Ordering::Release);
        words[COUNTER].store(self.words.word(COUNTER).wrapping_add(1), Ordering::Relaxed);
        words[FROM_ROW].store(row, Ordering::Relaxed);
        for (axis, (kind, value)) in set.iter().enumerate().take(self.axes) {
            let at = self.axes_at + axis * self.axis_words;
            words[at].store(*kind, Ordering::Relaxed);
            words[at + 1].store(value.to_bits(), Ordering::Relaxed);
        }
        words[SEQUENCE].store(sequence.wrapping_add(2), Ordering::Release);
    }
}
