//! Memory that other processes can map: an anonymous file (memfd) that this process hands over.

use std::fmt;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::ptr::{self, NonNull};
use std::sync::atomic::AtomicU64;

use rustix::fs::{MemfdFlags, SealFlags, fcntl_add_seals, ftruncate, memfd_create};
use rustix::mm::{MapFlags, ProtFlags, mlock, mmap, munmap};

/// Zeroed memory as atomic words, shared with every process that has the descriptor.
pub struct SharedMemory {
    fd: OwnedFd,
    base: NonNull<AtomicU64>,
    words: usize,
}

// SAFETY: this value alone owns the mapping, which is not tied to a thread, and gives access to
// atomic words only.
unsafe impl Send for SharedMemory {}
// SAFETY: as above.
unsafe impl Sync for SharedMemory {}

impl SharedMemory {
    /// Creates and maps `words` zeroed words. The pages are present and, if the limits of the
    /// process allow it, locked.
    ///
    /// # Errors
    /// Fails if the system refuses the memory.
    pub fn create(name: &str, words: usize) -> io::Result<Self> {
        let fd = memfd_create(name, MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING)?;
        let bytes = words
            .max(1)
            .checked_mul(size_of::<AtomicU64>())
            .ok_or(io::ErrorKind::OutOfMemory)?;
        ftruncate(&fd, u64::try_from(bytes).unwrap_or(u64::MAX))?;
        // A file that shrinks would turn an access into SIGBUS.
        fcntl_add_seals(&fd, SealFlags::SHRINK | SealFlags::GROW)?;
        // SAFETY: a new mapping at an address that the kernel chooses; nothing else refers to it.
        let base = unsafe {
            mmap(
                ptr::null_mut(),
                bytes,
                ProtFlags::READ | ProtFlags::WRITE,
                MapFlags::SHARED | MapFlags::POPULATE,
                &fd,
                0,
            )?
        };
        // SAFETY: the whole mapping, which exists.
        let _ = unsafe { mlock(base, bytes) };
        let base = NonNull::new(base.cast()).ok_or(io::ErrorKind::OutOfMemory)?;
        Ok(Self { fd, base, words })
    }

    /// Lets only this process write: other processes can map the memory for reading only.
    ///
    /// # Errors
    /// Fails if the system does not know the seal (before Linux 5.1).
    pub fn forbid_writes_of_others(&self) -> io::Result<()> {
        Ok(fcntl_add_seals(
            &self.fd,
            SealFlags::FUTURE_WRITE | SealFlags::SEAL,
        )?)
    }

    /// Returns the words.
    #[must_use]
    pub fn words(&self) -> &[AtomicU64] {
        // SAFETY: the mapping has this length and lives as long as `self`. It is page-aligned and
        // zeroed. Other processes may write at any time, which atomic accesses permit; the seal
        // keeps the file from shrinking.
        unsafe { std::slice::from_raw_parts(self.base.as_ptr(), self.words) }
    }
}

impl AsFd for SharedMemory {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.fd.as_fd()
    }
}

impl Drop for SharedMemory {
    fn drop(&mut self) {
        let bytes = self.words.max(1) * size_of::<AtomicU64>();
        // SAFETY: this value owns the mapping, and no borrow of it outlives the value.
        let _ = unsafe { munmap(self.base.as_ptr().cast(), bytes) };
    }
}

impl fmt::Debug for SharedMemory {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SharedMemory")
            .field("fd", &self.fd)
            .field("words", &self.words)
            .finish()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::Ordering;

    use super::*;

    /// memfd_create(2), fcntl(2): F_SEAL_FUTURE_WRITE lets existing mappings write on.
    #[test]
    fn shared_memory_of_one_writer_is_read_only_for_others() {
        let memory = SharedMemory::create("test", 512).unwrap();
        memory.forbid_writes_of_others().unwrap();
        memory.words()[511].store(7, Ordering::Relaxed);
        let map = |protection| {
            // SAFETY: a new mapping, which is only unmapped.
            unsafe {
                mmap(
                    ptr::null_mut(),
                    4096,
                    protection,
                    MapFlags::SHARED,
                    &memory,
                    0,
                )
            }
        };
        assert!(map(ProtFlags::READ | ProtFlags::WRITE).is_err());
        let other = map(ProtFlags::READ).unwrap();
        // SAFETY: the mapping has 512 words.
        let seen = unsafe { other.cast::<u64>().add(511).read() };
        assert_eq!(seen, 7);
        // SAFETY: the mapping from above.
        unsafe { munmap(other, 4096) }.unwrap();
        assert!(ftruncate(&memory, 0).is_err());
    }
}
