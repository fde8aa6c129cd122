//! Tests in real time, judged where the computer let them run. A virtual machine's host, or a neighbour, takes processors
//! away for tens of milliseconds at a time; what a cycle of one millisecond did meanwhile says nothing about the program.

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
/// Nor once more after this long.
const PATIENCE: Duration = Duration::from_secs(90);
/// Above every thread of the program and of the tests: what keeps the watch from running is not theirs.
const PRIORITY: u8 = 95;
const EVERY: Duration = Duration::from_millis(1);
/// A wake-up later than this was held up.
const LATE: Duration = Duration::from_millis(2);
/// Of a test's time: where every try lost more than this, there is nothing to judge. CI included: what fails there without a
/// fair try would be read as a fault of the program.
const TOO_MUCH: f64 = 0.1;

/// What one processor did not give.
#[derive(Debug, Default, Clone, Copy)]
struct Taken {
    longest: Duration,
    total: Duration,
    /// The watch had its priority; otherwise the tests themselves may have held it up.
    certain: bool,
}

/// Wakes up on one processor every millisecond until told to end.
fn watch(cpu: usize, ended: &AtomicBool) -> Taken {
    let priority = ThreadPriorityValue::try_from(PRIORITY).expect("1 to 99");
    let granted = set_thread_priority_and_policy(
        thread_native_id(),
        ThreadPriority::Crossplatform(priority),
        ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo),
    );
    let pinned = ecaxis::rt::thread::pin(cpu);
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

/// Those that may be used.
fn cpus() -> Vec<usize> {
    let allowed = rustix::thread::sched_getaffinity(None).expect("Linux");
    let all = 0..rustix::thread::CpuSet::MAX_CPU;
    all.filter(|&cpu| allowed.is_set(cpu)).collect()
}

/// Runs a test that depends on real time. It fails as any test does; but where the computer stood still meanwhile it is
/// repeated, and where it never gave a fair try, that is said instead.
pub fn calmly(test: impl Fn()) {
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
