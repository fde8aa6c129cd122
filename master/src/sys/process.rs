//! The resource usage of threads, and the settings of the C library's heap.

use std::io;
use std::mem;

use serde::Serialize;

use super::checked;

/// The resources that a thread has used so far: getrusage(2) with RUSAGE_THREAD.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct ThreadUsage {
    /// User and system time in ns.
    pub cpu_ns: u64,
    /// Page faults that needed no I/O.
    pub minor_faults: u64,
    /// Page faults that needed I/O.
    pub major_faults: u64,
    /// Context switches because the thread waited.
    pub voluntary_switches: u64,
    /// Context switches because the kernel preempted the thread.
    pub involuntary_switches: u64,
}

impl ThreadUsage {
    /// Returns the usage of the calling thread.
    ///
    /// # Errors
    /// The error of getrusage(2).
    pub fn now() -> io::Result<Self> {
        Self::of(libc::RUSAGE_THREAD)
    }

    /// Returns the usage of all child processes that have ended and were waited for.
    ///
    /// # Errors
    /// The error of getrusage(2).
    pub fn of_children() -> io::Result<Self> {
        Self::of(libc::RUSAGE_CHILDREN)
    }

    fn of(whose: libc::c_int) -> io::Result<Self> {
        // SAFETY: all-zero is a valid rusage.
        let mut usage: libc::rusage = unsafe { mem::zeroed() };
        // SAFETY: the call writes to `usage`, which is large enough.
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

    /// Returns the sum of two usages.
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

    /// Returns the CPU load over `wall_ns`, in percent of one CPU.
    #[must_use]
    pub fn load_percent(&self, wall_ns: u64) -> f64 {
        self.cpu_ns as f64 / wall_ns.max(1) as f64 * 100.0
    }

    /// Returns the usage since `before`.
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

/// Makes the heap keep freed memory. Memory is neither returned to the kernel nor mapped per
/// allocation. Unmapping interrupts every CPU that runs a thread of the process, including that of
/// the real-time thread. Returns false if the C library has no such setting (musl).
pub fn keep_heap() -> bool {
    #[cfg(target_env = "gnu")]
    {
        // SAFETY: sets two parameters of the allocator.
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

/// Moves the calling thread into a new network namespace. The namespace lives as long as the thread
/// or a socket in it. Returns the thread id, by which other threads find the namespace.
///
/// # Errors
/// The error of unshare(2); needs CAP_SYS_ADMIN.
pub fn own_network() -> io::Result<i32> {
    // SAFETY: passes no pointers and affects the calling thread only.
    checked(unsafe { libc::unshare(libc::CLONE_NEWNET) })?;
    Ok(rustix::thread::gettid().as_raw_nonzero().get())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Touches new pages and sleeps. They are not from the heap: other tests make it keep its pages.
    fn use_memory() -> ThreadUsage {
        const LEN: usize = 16 << 20;
        let before = ThreadUsage::now().unwrap();
        let (access, kind) = (
            libc::PROT_READ | libc::PROT_WRITE,
            libc::MAP_PRIVATE | libc::MAP_ANONYMOUS,
        );
        // SAFETY: a new mapping, written within its length, and removed.
        unsafe {
            let pages = libc::mmap(std::ptr::null_mut(), LEN, access, kind, -1, 0);
            assert_ne!(pages, libc::MAP_FAILED);
            for at in (0..LEN).step_by(4096) {
                pages.cast::<u8>().add(at).write_volatile(1);
            }
            assert_eq!(libc::munmap(pages, LEN), 0);
        }
        std::thread::sleep(std::time::Duration::from_millis(1));
        ThreadUsage::now().unwrap().since(before)
    }

    #[test]
    fn thread_usage_counts_page_faults_and_waits() {
        // Another test in this process may lock its memory meanwhile, which then causes no page
        // faults.
        let locked = || {
            let status = std::fs::read_to_string("/proc/self/status").unwrap();
            let locked = status.lines().find(|line| line.starts_with("VmLck:"));
            !locked.is_some_and(|line| line.contains(" 0 kB"))
        };
        let mut tries = Vec::new();
        for _ in 0..100 {
            let used = use_memory();
            assert!(used.voluntary_switches >= 1, "{used:?}");
            // One fault on a huge page covers 512 pages.
            if used.minor_faults >= 8 || locked() {
                return;
            }
            tries.push(used);
        }
        panic!("{tries:?}");
    }
}
