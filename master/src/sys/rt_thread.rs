//! Operating system settings for the real-time thread. Each setting may be denied. The thread then
//! continues, and the user gets a message with the consequence and the fix.

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

use super::idle_spinner::IdleSpinner;
use crate::sys::process::{self, ThreadUsage};

/// A number written to this file rules out CPU idle states with a longer exit latency in µs, while
/// the file is open (Documentation/admin-guide/pm/cpuidle.rst).
const CPU_LATENCY: &str = "/dev/cpu_dma_latency";

/// The kernel's settings for the CPU share of real-time threads.
const RT_LIMIT: &str = "/proc/sys/kernel";

/// The minimum distance to that limit, in percent of a CPU.
const NEAR_LIMIT: f64 = 5.0;

/// Stack touched once, so that no stack page faults in a cycle.
const STACK_TO_TOUCH: usize = 256 * 1024;

/// A setting that was denied.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RtSetupError {
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

/// Host-wide settings while a machine runs; dropping this restores them.
#[derive(Debug, Default)]
pub struct CpuWakeGuard {
    latency: Option<File>,
    awake: Option<IdleSpinner>,
}

impl CpuWakeGuard {
    /// Requests a low wake-up latency of all CPUs and keeps the CPU `awake` out of idle states.
    /// Call this before [`become_realtime`]: a new thread would inherit the real-time class.
    #[must_use]
    #[allow(clippy::disallowed_methods, reason = "runs before the loop")]
    pub fn take(awake: Option<usize>) -> (Self, Vec<RtSetupError>) {
        let mut held = Self::default();
        let mut denied = Vec::new();
        match open_latency() {
            Ok(file) => held.latency = Some(file),
            // This host has no idle states, or hides them: nothing to rule out.
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => denied.push(RtSetupError::CpuLatency {
                reason: error.to_string(),
            }),
        }
        if let Some(cpu) = awake {
            match IdleSpinner::start(cpu) {
                Ok(awake) => held.awake = Some(awake),
                Err(error) => denied.push(error),
            }
        }
        (held, denied)
    }
}

fn open_latency() -> std::io::Result<File> {
    let mut file = OpenOptions::new().write(true).open(CPU_LATENCY)?;
    file.write_all(&0_i32.to_ne_bytes())?;
    Ok(file)
}

/// A real-time thread that leaves too little of its CPU to other threads.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RtThrottlingRisk {
    /// The thread's CPU load in percent.
    pub load: f64,
    /// The percentage at which the kernel throttles real-time threads.
    pub limit: f64,
}

impl fmt::Display for RtThrottlingRisk {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "the real-time thread took {:.0} % of its CPU; at {:.0} % the kernel stops real-time threads for the rest of a second, \
             and already before that others on this CPU starve",
            self.load, self.limit
        )
    }
}

impl RtThrottlingRisk {
    fn at(load: f64, limit: f64) -> Option<Self> {
        (load > limit - NEAR_LIMIT).then_some(Self { load, limit })
    }

    /// Returns `None` if the load is far enough below the limit ([`rt_limit`]), or without a limit.
    #[must_use]
    pub fn of(used: &ThreadUsage, wall_ns: u64, limit: Option<f64>) -> Option<Self> {
        Self::at(used.load_percent(wall_ns), limit?)
    }
}

/// Returns the CPU share of real-time threads in percent; `None` if it is unlimited or unknown.
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

/// Makes the calling thread a real-time thread as far as permitted.
#[allow(clippy::disallowed_methods, reason = "runs before the loop")]
pub fn become_realtime(priority: u8, cpu: Option<usize>) -> Vec<RtSetupError> {
    let mut denied = Vec::new();
    // Without this, timers of threads without a real-time class are late by 50 µs. Never denied.
    let _ = set_current_timer_slack(NonZeroU64::new(1));
    process::keep_heap();
    denied.extend(lock_memory().err());
    touch_stack();
    if let Some(cpu) = cpu {
        denied.extend(pin(cpu).err());
    }
    if let Err(reason) = set_fifo(priority) {
        denied.push(RtSetupError::Priority { priority, reason });
    }
    denied
}

/// Locks the memory of the process. The first call takes tens of milliseconds.
///
/// # Errors
/// [`RtSetupError::MemoryLock`].
pub fn lock_memory() -> Result<(), RtSetupError> {
    let locked = mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE);
    locked.map_err(|error| RtSetupError::MemoryLock {
        reason: error.to_string(),
    })
}

/// Pins the calling thread to one CPU.
///
/// # Errors
/// [`RtSetupError::Affinity`].
#[allow(clippy::disallowed_methods, reason = "runs before the loop")]
pub fn pin(cpu: usize) -> Result<(), RtSetupError> {
    let mut set = CpuSet::new();
    let result = if cpu < CpuSet::MAX_CPU {
        set.set(cpu);
        sched_setaffinity(None, &set).map_err(|error| error.to_string())
    } else {
        Err("no such CPU".to_string())
    };
    result.map_err(|reason| RtSetupError::Affinity { cpu, reason })
}

#[allow(clippy::disallowed_methods, reason = "runs before the loop")]
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
    fn throttling_risk_is_reported_near_the_limit() {
        assert_eq!(RtThrottlingRisk::at(89.0, 95.0), None);
        let reported = RtThrottlingRisk::at(92.4, 95.0).expect("near").to_string();
        assert!(
            reported.contains("92 %") && reported.contains("95 %"),
            "{reported}"
        );
    }

    #[test]
    fn pin_fails_for_a_missing_cpu() {
        for cpu in [1023, 1_000_000] {
            assert!(
                matches!(pin(cpu), Err(RtSetupError::Affinity { .. })),
                "{cpu}"
            );
        }
    }
}
