//! What the operating system can do for the thread that turns the cycle. Every item may be denied;
//! then the thread goes on, and the user is told what that costs and what mends it.

use std::fmt;
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::num::NonZeroU64;

use rustix::mm::{MlockAllFlags, mlockall};
use rustix::thread::{CpuSet, sched_setaffinity, set_current_timer_slack};
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

use super::awake::Awake;
use crate::os::process::{self, ThreadUse};

/// What is held open with a number in it rules out sleep states of the CPUs that take longer to leave, in µs
/// (Documentation/admin-guide/pm/cpuidle.rst).
const CPU_LATENCY: &str = "/dev/cpu_dma_latency";

/// Where the kernel says how much of a CPU real-time threads may take.
const RT_LIMIT: &str = "/proc/sys/kernel";

/// How near to that limit is too near, in percent of a CPU.
const NEAR_LIMIT: f64 = 5.0;

/// Stack that is touched once, so that the cycle never meets a page for the first time.
const STACK_TO_TOUCH: usize = 256 * 1024;

/// Something that was not permitted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Denied {
    #[error(
        "SCHED_FIFO priority {priority} is not permitted ({reason}): other programs can delay the cycle"
    )]
    Priority { priority: u8, reason: String },
    #[error("CPU {cpu} cannot be taken ({reason}): the thread may move between CPUs")]
    Affinity { cpu: usize, reason: String },
    #[error("memory cannot be locked ({reason}): a page fault can delay a cycle")]
    MemoryLock { reason: String },
    #[error(
        "sleep states of the CPU cannot be ruled out ({reason}): waking from a deep one delays the cycle"
    )]
    CpuLatency { reason: String },
    #[error(
        "CPU {cpu} cannot be kept awake ({reason}): waking from a sleep state delays the cycle"
    )]
    Awake { cpu: usize, reason: String },
}

/// What is asked of the whole computer while a machine runs; ends when this is dropped.
#[derive(Debug, Default)]
pub struct Held {
    latency: Option<File>,
    awake: Option<Awake>,
}

impl Held {
    /// Asks for CPUs that wake at once, and keeps the one in `awake` from sleeping at all. Before [`prepare`], whose
    /// class a new thread would inherit.
    #[must_use]
    #[allow(clippy::disallowed_methods, reason = "prepares")]
    pub fn take(awake: Option<usize>) -> (Self, Vec<Denied>) {
        let mut held = Self::default();
        let mut denied = Vec::new();
        match open_latency() {
            Ok(file) => held.latency = Some(file),
            // This computer has no sleep states that the kernel knows of, or hides them: nothing to rule out.
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => denied.push(Denied::CpuLatency {
                reason: error.to_string(),
            }),
        }
        if let Some(cpu) = awake {
            match Awake::start(cpu) {
                Ok(awake) => held.awake = Some(awake),
                Err(error) => denied.push(error),
            }
        }
        (held, denied)
    }

    /// Whether the kernel keeps CPUs from deep sleep for us.
    #[must_use]
    pub fn has_latency(&self) -> bool {
        self.latency.is_some()
    }

    /// Whether a CPU is kept awake.
    #[must_use]
    pub fn has_awake(&self) -> bool {
        self.awake.is_some()
    }
}

fn open_latency() -> std::io::Result<File> {
    let mut file = OpenOptions::new().write(true).open(CPU_LATENCY)?;
    file.write_all(&0_i32.to_ne_bytes())?;
    Ok(file)
}

/// A real-time thread that leaves too little of its CPU to others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Overload {
    /// Percent of the CPU that it took.
    pub load: f64,
    /// Percent at which the kernel stops real-time threads.
    pub limit: f64,
}

impl fmt::Display for Overload {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "the real-time thread took {:.0} % of its CPU; at {:.0} % the kernel stops real-time threads for the rest of a second, \
             and already before that others on this CPU starve",
            self.load, self.limit
        )
    }
}

impl Overload {
    fn at(load: f64, limit: f64) -> Option<Self> {
        (load > limit - NEAR_LIMIT).then_some(Self { load, limit })
    }

    /// `None` where there is room enough, or no limit.
    #[must_use]
    pub fn of(used: &ThreadUse, wall_ns: u64) -> Option<Self> {
        Self::at(used.load_percent(wall_ns), rt_limit()?)
    }
}

/// Percent of a CPU that real-time threads may take; `None`: all of it, or nobody knows.
#[must_use]
pub fn rt_limit() -> Option<f64> {
    let read = |name: &str| {
        let text = std::fs::read_to_string([RT_LIMIT, "/", name].concat()).ok()?;
        text.trim().parse::<i64>().ok()
    };
    let runtime = read("sched_rt_runtime_us").filter(|us| *us >= 0)?;
    let period = read("sched_rt_period_us").filter(|us| *us > 0)?;
    let limit = runtime as f64 / period as f64 * 100.0;
    (limit < 100.0).then_some(limit)
}

/// Makes the calling thread a real-time thread as far as that is permitted.
#[allow(clippy::disallowed_methods, reason = "prepares")]
pub fn prepare(priority: u8, cpu: Option<usize>) -> Vec<Denied> {
    let mut denied = Vec::new();
    // Of threads without a real-time class, timers are late by 50 µs otherwise. Never denied.
    let _ = set_current_timer_slack(NonZeroU64::new(1));
    process::keep_heap();
    if let Err(error) = mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE) {
        denied.push(Denied::MemoryLock {
            reason: error.to_string(),
        });
    }
    touch_stack();
    if let Some(cpu) = cpu {
        denied.extend(pin(cpu).err());
    }
    if let Err(reason) = set_fifo(priority) {
        denied.push(Denied::Priority { priority, reason });
    }
    denied
}

/// Keeps the calling thread on one CPU.
///
/// # Errors
/// [`Denied::Affinity`].
#[allow(clippy::disallowed_methods, reason = "prepares")]
pub fn pin(cpu: usize) -> Result<(), Denied> {
    let mut set = CpuSet::new();
    let result = if cpu < CpuSet::MAX_CPU {
        set.set(cpu);
        sched_setaffinity(None, &set).map_err(|error| error.to_string())
    } else {
        Err("no such CPU".to_string())
    };
    result.map_err(|reason| Denied::Affinity { cpu, reason })
}

#[allow(clippy::disallowed_methods, reason = "prepares")]
fn set_fifo(priority: u8) -> Result<(), String> {
    let value = ThreadPriorityValue::try_from(priority)?;
    set_thread_priority_and_policy(
        thread_native_id(),
        ThreadPriority::Crossplatform(value),
        ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo),
    )
    .map_err(|error| match error {
        thread_priority::Error::OS(code) => std::io::Error::from_raw_os_error(code).to_string(),
        other => other.to_string(),
    })
}

#[inline(never)]
fn touch_stack() {
    let mut stack = [0_u8; STACK_TO_TOUCH];
    for page in stack.iter_mut().step_by(4096) {
        *page = 1;
    }
    std::hint::black_box(&stack);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_the_limit_is_too_near() {
        assert_eq!(Overload::at(89.0, 95.0), None);
        let told = Overload::at(92.4, 95.0).expect("near").to_string();
        assert!(told.contains("92 %") && told.contains("95 %"), "{told}");
    }

    #[test]
    fn a_cpu_that_is_not_there_is_denied() {
        for cpu in [1023, 1_000_000] {
            assert!(matches!(pin(cpu), Err(Denied::Affinity { .. })), "{cpu}");
        }
    }
}
