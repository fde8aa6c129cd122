//! A mapped receive ring (TPACKET_V2). The kernel fills slots in order. The status word of each
//! slot says whether the kernel or the process owns the slot.

use std::fmt;
use std::io;
use std::os::fd::AsFd;
use std::ptr::{self, NonNull};
use std::sync::atomic::{AtomicU32, Ordering};

use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};

/// The slots of a socket's ring, read in the order in which the kernel fills them.
pub struct Ring {
    base: NonNull<u8>,
    slots: usize,
    slot_len: usize,
    next: usize,
}

// SAFETY: this value alone owns the mapping, and the mapping is not tied to a thread.
unsafe impl Send for Ring {}

impl Ring {
    /// Maps the ring that was configured on `socket`.
    pub(super) fn map(socket: impl AsFd, slots: usize, slot_len: usize) -> io::Result<Self> {
        // SAFETY: a new mapping at an address that the kernel chooses; nothing else refers to it.
        // The kernel rejects a length other than the ring's.
        let base = unsafe {
            mmap(
                ptr::null_mut(),
                slots * slot_len,
                ProtFlags::READ | ProtFlags::WRITE,
                MapFlags::SHARED,
                socket,
                0,
            )?
        };
        let base = NonNull::new(base.cast::<u8>()).ok_or(io::ErrorKind::OutOfMemory)?;
        Ok(Self {
            base,
            slots,
            slot_len,
            next: 0,
        })
    }

    fn status(&self) -> &AtomicU32 {
        // SAFETY: `next` is below `slots`, so the slot lies in the mapping, which lives as long as
        // `self`. Slots begin at multiples of `slot_len`, a divisor of the page size, with the
        // aligned status word. The kernel writes the word in one access, so an atomic load is
        // sound.
        unsafe { self.base.add(self.next * self.slot_len).cast().as_ref() }
    }

    /// Returns the next slot, header and frame, if the kernel has filled it. RT: no system call.
    #[must_use]
    pub fn front(&self) -> Option<&[u8]> {
        // Pairs with the kernel's barrier between filling a slot and releasing it.
        if self.status().load(Ordering::Acquire) & libc::TP_STATUS_USER == 0 {
            return None;
        }
        // SAFETY: the slot lies in the mapping (see `status`). While the bit is set, the kernel
        // does not write to the slot. Clearing the bit takes `&mut self`, which ends this borrow.
        Some(unsafe {
            std::slice::from_raw_parts(
                self.base.add(self.next * self.slot_len).as_ptr(),
                self.slot_len,
            )
        })
    }

    /// Returns the slot of [`Ring::front`] to the kernel and advances to the next. Does nothing if
    /// the slot is not filled. RT.
    pub fn release(&mut self) {
        let status = self.status();
        if status.load(Ordering::Relaxed) & libc::TP_STATUS_USER == 0 {
            return;
        }
        status.store(libc::TP_STATUS_KERNEL, Ordering::Release);
        self.next = (self.next + 1) % self.slots;
    }
}

impl Drop for Ring {
    fn drop(&mut self) {
        // SAFETY: this value owns the mapping, and no borrow of it outlives the value.
        let _ = unsafe { munmap(self.base.as_ptr().cast(), self.slots * self.slot_len) };
    }
}

impl fmt::Debug for Ring {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Ring")
            .field("slots", &self.slots)
            .field("slot_len", &self.slot_len)
            .field("next", &self.next)
            .finish()
    }
}
