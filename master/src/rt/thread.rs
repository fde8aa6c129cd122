//! What the operating system can do for the thread that turns the cycle. Every item may be denied;
//! then the thread goes on, and the user is told what that costs and what mends it.

use rustix::mm::{MlockAllFlags, mlockall};
use rustix::thread::{CpuSet, sched_setaffinity};
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

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
}

/// Makes the calling thread a real-time thread as far as that is permitted.
#[allow(clippy::disallowed_methods, reason = "prepares")]
pub fn prepare(priority: u8, cpu: Option<usize>) -> Vec<Denied> {
    let mut denied = Vec::new();
    if let Err(error) = mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE) {
        denied.push(Denied::MemoryLock {
            reason: error.to_string(),
        });
    }
    touch_stack();
    if let Some(cpu) = cpu {
        let mut set = CpuSet::new();
        let result = if cpu < CpuSet::MAX_CPU {
            set.set(cpu);
            sched_setaffinity(None, &set).map_err(|error| error.to_string())
        } else {
            Err("no such CPU".to_string())
        };
        if let Err(reason) = result {
            denied.push(Denied::Affinity { cpu, reason });
        }
    }
    if let Err(reason) = set_fifo(priority) {
        denied.push(Denied::Priority { priority, reason });
    }
    denied
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
