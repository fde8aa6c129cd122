//! Real-time tests whose result counts only if the computer did not stall. A host or neighbour of a
//! virtual machine may take processors away for tens of milliseconds. The behaviour of a 1 ms cycle
//! during such a stall says nothing about the program.

#![allow(clippy::print_stdout, reason = "what the computer did")]

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

const TRIES: usize = 5;
/// No retry starts after this time.
const PATIENCE: Duration = Duration::from_secs(90);
/// Above every thread of the program and of the tests, so that none of them delays the watch.
const PRIORITY: u8 = 95;
const EVERY: Duration = Duration::from_millis(1);
/// A later wake-up counts as a stall.
const LATE: Duration = Duration::from_millis(2);
/// The maximum stalled share of a test's time. If every try exceeds it, the test has no result,
/// also on CI: a failure without a valid try would look like a program fault.
const TOO_MUCH: f64 = 0.1;

/// The stalls of one processor.
#[derive(Debug, Default, Clone, Copy)]
struct Taken {
    longest: Duration,
    total: Duration,
    /// True if the watch had its priority. Otherwise, the tests themselves may have delayed it.
    certain: bool,
}

/// Wakes up on one processor every millisecond until the flag is set.
fn watch(cpu: usize, ended: &AtomicBool) -> Taken {
    let priority = ThreadPriorityValue::try_from(PRIORITY).expect("1 to 99");
    let granted = set_thread_priority_and_policy(
        thread_native_id(),
        ThreadPriority::Crossplatform(priority),
        ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo),
    );
    let pinned = ecaxis_master::sys::rt_thread::pin(cpu);
    let mut taken = Taken {
        certain: granted.is_ok() && pinned.is_ok(),
        ..Taken::default()
    };
    while !ended.load(Ordering::Relaxed) {
        let began = Instant::now();
        thread::sleep(EVERY);
        let late = began.elapsed().saturating_sub(EVERY);
        if late > LATE {
            taken.longest = taken.longest.max(late);
            taken.total += late;
        }
    }
    taken
}

/// Returns the available processors.
fn cpus() -> Vec<usize> {
    let allowed = rustix::thread::sched_getaffinity(None).expect("Linux");
    let all = 0..rustix::thread::CpuSet::MAX_CPU;
    all.filter(|&cpu| allowed.is_set(cpu)).collect()
}

/// Runs a test that depends on real time. A failed try is repeated if the computer stalled during
/// it. If every try was stalled, prints this instead of failing.
pub fn retry_if_host_stalled(test: impl Fn()) {
    let mut fair = false;
    let first = Instant::now();
    for attempt in 1.. {
        let ended = AtomicBool::new(false);
        let began = Instant::now();
        let (result, taken) = thread::scope(|scope| {
            let watches: Vec<_> = cpus()
                .into_iter()
                .map(|cpu| {
                    scope.spawn({
                        let ended = &ended;
                        move || watch(cpu, ended)
                    })
                })
                .collect();
            let result = catch_unwind(AssertUnwindSafe(&test));
            ended.store(true, Ordering::Relaxed);
            let taken = watches.into_iter().map(|w| w.join().expect("watches"));
            (result, taken.max_by_key(|t| t.total).unwrap_or_default())
        });
        let Err(panic) = result else { return };
        let share = taken.total.as_secs_f64() / began.elapsed().as_secs_f64();
        fair |= share <= TOO_MUCH || !taken.certain;
        println!(
            "a processor stood still for {:.1?} in all, {:.1?} at once",
            taken.total, taken.longest
        );
        if taken.longest.is_zero() {
            resume_unwind(panic);
        }
        if attempt == TRIES || first.elapsed() > PATIENCE {
            if fair {
                resume_unwind(panic);
            }
            println!(
                "skipped: a processor was away for more than a tenth of the time in each of {attempt} tries"
            );
            return;
        }
    }
}
