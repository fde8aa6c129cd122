//! Memory of the server, mapped into this process.

use std::fmt;
use std::os::fd::OwnedFd;
use std::ptr::{self, NonNull};
use std::sync::atomic::{AtomicU64, Ordering};

use rustix::fs::{SealFlags, fcntl_get_seals, fstat};
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};

/// The largest memory that is mapped.
const MAX_BYTES: u64 = 4 << 30;

/// Words that the server shares. Those of a read-only mapping must not be written.
pub(crate) struct Memory {
    base: NonNull<AtomicU64>,
    bytes: usize,
}

// SAFETY: this value alone owns the mapping, which is not tied to a thread, and gives access to
// atomic words only.
unsafe impl Send for Memory {}
// SAFETY: as above; atomic words may be shared.
unsafe impl Sync for Memory {}

impl Memory {
    /// Maps a file with at least `words` words that cannot shrink: an access would end the program.
    pub fn map(fd: &OwnedFd, writable: bool, words: usize) -> Option<Self> {
        let sealed = fcntl_get_seals(fd).ok()?.contains(SealFlags::SHRINK);
        let size = u64::try_from(fstat(fd).ok()?.st_size).ok()?;
        if !sealed || size > MAX_BYTES || size < (words * size_of::<AtomicU64>()) as u64 {
            return None;
        }
        let bytes = usize::try_from(size).ok()?;
        let protection = if writable {
            ProtFlags::READ | ProtFlags::WRITE
        } else {
            ProtFlags::READ
        };
        let flags = MapFlags::SHARED | MapFlags::POPULATE;
        // SAFETY: a new mapping at an address that the kernel chooses; nothing else refers to it.
        let base = unsafe { mmap(ptr::null_mut(), bytes, protection, flags, fd, 0) }.ok()?;
        let base = NonNull::new(base.cast())?;
        Some(Self { base, bytes })
    }

    pub fn words(&self) -> &[AtomicU64] {
        let count = self.bytes / size_of::<AtomicU64>();
        // SAFETY: the mapping has this length and lives as long as `self`; it is page-aligned.
        // Other processes may write at any time, which atomic accesses permit; the seal keeps the
        // file from shrinking.
        unsafe { std::slice::from_raw_parts(self.base.as_ptr(), count) }
    }

    pub fn load(&self, at: usize) -> u64 {
        self.words()[at].load(Ordering::Relaxed)
    }

    /// Returns a word as a size; one that no memory has if it is too large.
    pub fn size(&self, at: usize) -> usize {
        usize::try_from(self.load(at)).unwrap_or(usize::MAX)
    }

    /// Copies bytes. `None`: they do not lie in the memory.
    pub fn bytes(&self, at: usize, count: usize) -> Option<Vec<u8>> {
        let end = at.checked_add(count).filter(|end| *end <= self.bytes)?;
        let (first, last) = (at / 8, end.div_ceil(8));
        let words = self.words().get(first..last)?;
        let bytes = words
            .iter()
            .flat_map(|word| word.load(Ordering::Relaxed).to_ne_bytes());
        Some(bytes.skip(at % 8).take(count).collect())
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        // SAFETY: this value owns the mapping, and no borrow of it outlives the value.
        let _ = unsafe { munmap(self.base.as_ptr().cast(), self.bytes) };
    }
}

impl fmt::Debug for Memory {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Memory")
            .field("bytes", &self.bytes)
            .finish_non_exhaustive()
    }
}
