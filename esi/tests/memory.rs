//! Damaged files and images need bounded memory: the peak of this process' allocations.

#![allow(clippy::print_stdout, reason = "tests print counts and what they skip")]
#![allow(unsafe_code, reason = "a global allocator that counts")]

mod common;
mod mutations;
mod sii_damage;

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

static MEASUREMENT: Mutex<()> = Mutex::new(());

/// Keeps the tests apart: what one of them needs would count in the measurement of another.
pub fn measure() -> MutexGuard<'static, ()> {
    MEASUREMENT.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Counts the bytes that are allocated now, and their maximum since [`reset`].
struct Counting;

static NOW: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

fn add(bytes: usize) {
    let now = NOW.fetch_add(bytes, Ordering::Relaxed) + bytes;
    PEAK.fetch_max(now, Ordering::Relaxed);
}

// SAFETY: every call goes to the system allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        add(layout.size());
        // SAFETY: the caller's contract is the same.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        NOW.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller's contract is the same.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Resets the peak.
pub fn reset() {
    PEAK.store(NOW.load(Ordering::Relaxed), Ordering::Relaxed);
}

/// Returns the peak in bytes.
pub fn peak() -> usize {
    PEAK.load(Ordering::Relaxed)
}
