//! Keeps a CPU from sleeping between two cycles: something of the lowest class there is runs on it all the time.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use thread_priority::{
    NormalThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

use super::thread::{Denied, pin};

/// On a busy CPU it may take its time to get a first turn.
const PATIENCE: Duration = Duration::from_millis(200);

/// It calls nothing.
const STACK: usize = 64 * 1024;

/// A thread of class SCHED_IDLE that spins on one CPU until this is dropped. Whatever else wants the CPU gets it at once.
#[derive(Debug)]
pub struct Awake {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<Result<(), Denied>>>,
}

impl Awake {
    /// Starts it.
    ///
    /// # Errors
    /// [`Denied::Awake`] where no thread can be started, [`Denied::Affinity`] where it may not run there.
    #[allow(clippy::disallowed_methods, reason = "prepares")]
    pub fn start(cpu: usize) -> Result<Self, Denied> {
        let stop = Arc::new(AtomicBool::new(false));
        let ended = Arc::clone(&stop);
        let turning = Arc::new(AtomicBool::new(false));
        let begun = Arc::clone(&turning);
        let thread = thread::Builder::new()
            .name("ecaxis-awake".to_string())
            .stack_size(STACK)
            .spawn(move || spin(cpu, &begun, &ended))
            .map_err(|error| Denied::Awake {
                cpu,
                reason: error.to_string(),
            })?;
        let mut awake = Self {
            stop,
            thread: Some(thread),
        };
        let begin = Instant::now();
        while !turning.load(Ordering::Relaxed) && begin.elapsed() < PATIENCE {
            if awake.thread.as_ref().is_some_and(JoinHandle::is_finished) {
                awake.end()?;
                break;
            }
            thread::sleep(Duration::from_millis(1));
        }
        Ok(awake)
    }

    fn end(&mut self) -> Result<(), Denied> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread
            .take()
            .map_or(Ok(()), |thread| thread.join().unwrap_or(Ok(())))
    }
}

impl Drop for Awake {
    fn drop(&mut self) {
        let _ = self.end();
    }
}

/// Not a turn at any class but the lowest, and not a turn elsewhere.
#[allow(clippy::disallowed_methods, reason = "not the real-time thread")]
fn spin(cpu: usize, turning: &AtomicBool, stop: &AtomicBool) -> Result<(), Denied> {
    pin(cpu)?;
    let idle = set_thread_priority_and_policy(
        thread_native_id(),
        ThreadPriority::Min,
        ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Idle),
    );
    idle.map_err(|error| Denied::Awake {
        cpu,
        reason: error.to_string(),
    })?;
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
    fn it_spins_at_the_lowest_class() {
        let Ok(awake) = Awake::start(0) else { return };
        // Another test's thread of this name may be there, too, and end at any time.
        let found = || {
            let tasks = std::fs::read_dir("/proc/self/task").unwrap();
            tasks.flatten().any(|task| {
                let read = |file| std::fs::read_to_string(task.path().join(file));
                let stat = read("stat").unwrap_or_default();
                let fields = stat.rsplit_once(')').map_or("", |(_, fields)| fields);
                // Field 41 of proc_pid_stat(5), the third after the name being the first here: SCHED_IDLE.
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
    fn a_cpu_that_is_not_there_is_told() {
        let denied = Awake::start(1023).unwrap_err();
        assert!(
            matches!(denied, Denied::Affinity { cpu: 1023, .. }),
            "{denied}"
        );
    }
}
