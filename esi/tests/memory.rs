//! Damaged files and images need bounded memory: the peak resident memory of this process on Linux;
//! elsewhere 0.

#![allow(clippy::print_stdout, reason = "tests print counts and what they skip")]

mod common;
mod mutations;
mod sii_damage;

use std::sync::{Mutex, MutexGuard, PoisonError};

static MEASUREMENT: Mutex<()> = Mutex::new(());

/// Keeps the tests apart: what one of them needs would count in the measurement of another.
pub fn measure() -> MutexGuard<'static, ()> {
    MEASUREMENT.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Resets the peak.
pub fn reset() {
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// Returns the peak in bytes.
pub fn peak() -> usize {
    let text = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|line| line.split_whitespace().next());
    kilobytes
        .and_then(|kb| kb.parse::<usize>().ok())
        .unwrap_or(0)
        << 10
}
