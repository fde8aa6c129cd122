//! What the kernel counts for a thread, and how the C library's heap behaves.

use std::io;
use std::mem;

use serde::Serialize;

use super::checked;

/// What a thread has used so far: getrusage(2) with RUSAGE_THREAD.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct ThreadUse {
    /// User and system.
    pub cpu_ns: u64,
    /// Page faults that needed no I/O.
    pub minor_faults: u64,
    /// Page faults that needed I/O.
    pub major_faults: u64,
    /// It waited.
    pub voluntary_switches: u64,
    /// It was made to wait.
    pub involuntary_switches: u64,
}

impl ThreadUse {
    /// Of the calling thread.
    ///
    /// # Errors
    /// What getrusage(2) says.
    pub fn now() -> io::Result<Self> {
        Self::of(libc::RUSAGE_THREAD)
    }

    /// Of all child processes that have ended and been waited for.
    ///
    /// # Errors
    /// What getrusage(2) says.
    pub fn of_children() -> io::Result<Self> {
        Self::of(libc::RUSAGE_CHILDREN)
    }

    fn of(whose: libc::c_int) -> io::Result<Self> {
        // SAFETY: all-zero is a valid rusage.
        let mut usage: libc::rusage = unsafe { mem::zeroed() };
        // SAFETY: `usage` takes what the call writes.
        checked(unsafe { libc::getrusage(whose, &raw mut usage) })?;
        let count = |n: libc::c_long| u64::try_from(n).unwrap_or(0);
        let nanos = |t: libc::timeval| {
            let seconds = u64::try_from(t.tv_sec).unwrap_or(0);
            seconds * 1_000_000_000 + u64::try_from(t.tv_usec).unwrap_or(0) * 1_000
        };
        Ok(Self {
            cpu_ns: nanos(usage.ru_utime) + nanos(usage.ru_stime),
            minor_faults: count(usage.ru_minflt),
            major_faults: count(usage.ru_majflt),
            voluntary_switches: count(usage.ru_nvcsw),
            involuntary_switches: count(usage.ru_nivcsw),
        })
    }

    /// What two pieces of work used together.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self {
            cpu_ns: self.cpu_ns + other.cpu_ns,
            minor_faults: self.minor_faults + other.minor_faults,
            major_faults: self.major_faults + other.major_faults,
            voluntary_switches: self.voluntary_switches + other.voluntary_switches,
            involuntary_switches: self.involuntary_switches + other.involuntary_switches,
        }
    }

    /// Percent of a CPU, over so long.
    #[must_use]
    pub fn load_percent(&self, wall_ns: u64) -> f64 {
        self.cpu_ns as f64 / wall_ns.max(1) as f64 * 100.0
    }

    /// What has been used since `before`.
    #[must_use]
    pub fn since(self, before: Self) -> Self {
        Self {
            cpu_ns: self.cpu_ns.saturating_sub(before.cpu_ns),
            minor_faults: self.minor_faults.saturating_sub(before.minor_faults),
            major_faults: self.major_faults.saturating_sub(before.major_faults),
            voluntary_switches: self
                .voluntary_switches
                .saturating_sub(before.voluntary_switches),
            involuntary_switches: self
                .involuntary_switches
                .saturating_sub(before.involuntary_switches),
        }
    }
}

/// Lets the heap keep what is freed: memory is neither given back to the kernel nor mapped piece by piece. Unmapping
/// interrupts every CPU that runs a thread of the process, the real-time thread's too. False where the C library has no such
/// setting (musl).
pub fn keep_heap() -> bool {
    #[cfg(target_env = "gnu")]
    {
        // SAFETY: sets two numbers of the allocator.
        unsafe {
            libc::mallopt(libc::M_TRIM_THRESHOLD, -1) == 1
                && libc::mallopt(libc::M_MMAP_MAX, 0) == 1
        }
    }
    #[cfg(not(target_env = "gnu"))]
    {
        false
    }
}

/// Gives the calling thread a network namespace of its own, which lives as long as the thread or a socket in it; the
/// thread's number, by which others find it.
///
/// # Errors
/// What unshare(2) says; needs CAP_SYS_ADMIN.
pub fn own_network() -> io::Result<i32> {
    // SAFETY: no pointers; it concerns the calling thread alone.
    checked(unsafe { libc::unshare(libc::CLONE_NEWNET) })?;
    Ok(rustix::thread::gettid().as_raw_nonzero().get())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_is_told_its_page_faults_and_waits() {
        let before = ThreadUse::now().unwrap();
        let mut memory = vec![0_u8; 16 << 20];
        for byte in memory.iter_mut().step_by(4096) {
            *byte = 1;
        }
        std::hint::black_box(&memory);
        std::thread::sleep(std::time::Duration::from_millis(1));
        let used = ThreadUse::now().unwrap().since(before);
        // Another test of this process may have locked its memory, which is then there without a fault.
        let status = std::fs::read_to_string("/proc/self/status").unwrap();
        let locked = status.lines().find(|line| line.starts_with("VmLck:"));
        let locked = !locked.is_some_and(|line| line.contains(" 0 kB"));
        // Huge pages take 512 of them at once.
        assert!(used.minor_faults >= 8 || locked, "{used:?}");
        assert!(used.voluntary_switches >= 1, "{used:?}");
    }
}
