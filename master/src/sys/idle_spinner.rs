//! Keeps a CPU out of idle states between two cycles: a thread of the lowest class spins on it.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use thread_priority::{
    NormalThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

use super::rights;
use super::rt_thread::{RtSetupError, pin};

/// The time to wait for the thread's first time slice; a busy CPU may delay it.
const TIMEOUT: Duration = Duration::from_millis(200);

/// The thread calls nothing, so a small stack suffices.
const STACK: usize = 64 * 1024;

/// A thread of class SCHED_IDLE that spins on one CPU until this is dropped. Any other thread
/// preempts it at once.
#[derive(Debug)]
pub struct IdleSpinner {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<Result<(), RtSetupError>>>,
}

impl IdleSpinner {
    /// Starts the thread.
    ///
    /// # Errors
    /// [`RtSetupError::Awake`] if the thread cannot be started, [`RtSetupError::Affinity`] if it
    /// may not run on `cpu`.
    #[allow(clippy::disallowed_methods, reason = "runs before the loop")]
    pub fn start(cpu: usize) -> Result<Self, RtSetupError> {
        let stop = Arc::new(AtomicBool::new(false));
        let ended = Arc::clone(&stop);
        let turning = Arc::new(AtomicBool::new(false));
        let begun = Arc::clone(&turning);
        let thread = thread::Builder::new()
            .name("ecaxis-awake".to_string())
            .stack_size(STACK)
            .spawn(move || spin(cpu, &begun, &ended))
            .map_err(|error| RtSetupError::Awake {
                cpu,
                reason: error.to_string(),
            })?;
        let mut awake = Self {
            stop,
            thread: Some(thread),
        };
        let begin = Instant::now();
        while !turning.load(Ordering::Relaxed) && begin.elapsed() < TIMEOUT {
            if awake.thread.as_ref().is_some_and(JoinHandle::is_finished) {
                awake.end()?;
                break;
            }
            thread::sleep(Duration::from_millis(1));
        }
        Ok(awake)
    }

    fn end(&mut self) -> Result<(), RtSetupError> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread
            .take()
            .map_or(Ok(()), |thread| thread.join().unwrap_or(Ok(())))
    }
}

impl Drop for IdleSpinner {
    fn drop(&mut self) {
        let _ = self.end();
    }
}

/// Runs only as SCHED_IDLE and only on `cpu`.
#[allow(clippy::disallowed_methods, reason = "not the real-time thread")]
fn spin(cpu: usize, turning: &AtomicBool, stop: &AtomicBool) -> Result<(), RtSetupError> {
    pin(cpu)?;
    let idle = set_thread_priority_and_policy(
        thread_native_id(),
        ThreadPriority::Min,
        ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Idle),
    );
    idle.map_err(|error| RtSetupError::Awake {
        cpu,
        reason: error.to_string(),
    })?;
    rights::drop_capabilities();
    turning.store(true, Ordering::Relaxed);
    while !stop.load(Ordering::Relaxed) {
        std::hint::spin_loop();
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn idle_spinner_runs_as_sched_idle() {
        let allowed = rustix::thread::sched_getaffinity(None).unwrap();
        let mut cpus = 0..rustix::thread::CpuSet::MAX_CPU;
        let cpu = cpus.find(|&cpu| allowed.is_set(cpu)).unwrap();
        let awake = IdleSpinner::start(cpu).unwrap();
        // Another test's thread of this name may exist as well, and may end at any time.
        let found = || {
            let tasks = std::fs::read_dir("/proc/self/task").unwrap();
            tasks.flatten().any(|task| {
                let read = |file| std::fs::read_to_string(task.path().join(file));
                let stat = read("stat").unwrap_or_default();
                let fields = stat.rsplit_once(')').map_or("", |(_, fields)| fields);
                // Field 41 of proc_pid_stat(5) is the policy. The name is removed, so the fields
                // here begin at the third. 5 is SCHED_IDLE.
                let policy = fields.split_whitespace().nth(41 - 3);
                read("comm").is_ok_and(|name| name.trim() == "ecaxis-awake") && policy == Some("5")
            })
        };
        let start = Instant::now();
        while !found() {
            assert!(start.elapsed().as_secs() < 10, "no thread is SCHED_IDLE");
            thread::sleep(Duration::from_millis(10));
        }
        drop(awake);
    }

    #[test]
    fn idle_spinner_fails_for_a_missing_cpu() {
        let denied = IdleSpinner::start(1023).unwrap_err();
        assert!(
            matches!(denied, RtSetupError::Affinity { cpu: 1023, .. }),
            "{denied}"
        );
    }
}
