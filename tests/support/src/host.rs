//! Tests that depend on the host: on real time, on idle processors, or on root.
//!
//! A hypervisor or other processes may take processors away for tens of milliseconds. The behaviour
//! of a 1 ms cycle during such a stall says nothing about the program. Therefore, a failure counts
//! only if the host was quiet, or if it repeats.

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use ecaxis_tools::bench::veth::VethPair;
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

use crate::skip;

/// After a failure that a stall may explain, so many tries must pass before [`MAX_FAILURES`] have
/// failed. A bug that fails in four runs of five passes this with a probability of 3 %.
const CONFIRMATIONS: usize = 3;
const MAX_FAILURES: usize = 3;
/// No retry starts after this time.
const TIMEOUT: Duration = Duration::from_secs(180);
/// Above every thread of the program and of the tests, so that none of them delays the watch.
const PRIORITY: u8 = 95;
const EVERY: Duration = Duration::from_millis(1);
/// A later wake-up of the watch counts as a stall.
const LATE: Duration = Duration::from_millis(2);
/// The user-visible clock tick of Linux.
const TICK_S: f64 = 0.01;

/// Waits until no other test of this process depends on the host.
pub fn alone() -> MutexGuard<'static, ()> {
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Runs a test over a pair of interfaces like [`retry_if_host_stalled`].
pub fn over_a_pair(test: impl Fn(VethPair)) {
    retry_if_host_stalled(|| match VethPair::new() {
        Ok(pair) => test(pair),
        Err(error) => skip(&format!("no veth pair (needs root): {error}")),
    });
}

/// The shares of the time that the host took away during a try.
#[derive(Debug, Default, Clone, Copy)]
struct Taken {
    /// Of the most affected processor: by the hypervisor, or while even the watch did not run.
    stalled: f64,
    /// Of all processors: by other processes.
    others: f64,
}

impl Taken {
    /// True if it may explain a failure.
    fn may_explain(self) -> bool {
        self.stalled > 0.0 || self.others > 0.1
    }
}

struct Try {
    passed: bool,
    taken: Taken,
}

#[derive(Debug, PartialEq, Eq)]
enum Verdict {
    Again,
    Passed,
    Failed,
}

fn judge(tries: &[Try], in_time: bool) -> Verdict {
    let failed: Vec<_> = tries.iter().filter(|t| !t.passed).collect();
    let passed = tries.len() - failed.len();
    if failed.iter().any(|t| !t.taken.may_explain()) {
        Verdict::Failed
    } else if failed.is_empty() || passed >= CONFIRMATIONS {
        Verdict::Passed
    } else if failed.len() < MAX_FAILURES && in_time {
        Verdict::Again
    } else {
        Verdict::Failed
    }
}

/// Runs a test that depends on real time, exclusively. A try that fails while the host takes
/// processors away is repeated.
pub fn retry_if_host_stalled(test: impl Fn()) {
    let _alone = alone();
    let began = Instant::now();
    let mut tries = Vec::new();
    let mut last_panic = None;
    loop {
        let (result, taken) = watched(&test);
        let passed = result.is_ok();
        last_panic = result.err().or(last_panic);
        tries.push(Try { passed, taken });
        println!("try {}: passed: {passed}, {taken:?}", tries.len());
        match judge(&tries, began.elapsed() < TIMEOUT) {
            Verdict::Passed => return,
            Verdict::Failed => resume_unwind(last_panic.expect("a try has failed")),
            Verdict::Again => {}
        }
    }
}

fn watched(test: impl Fn()) -> (thread::Result<()>, Taken) {
    let ended = AtomicBool::new(false);
    let before = Processors::read();
    let began = Instant::now();
    let (result, stalls) = thread::scope(|scope| {
        let ended = &ended;
        let cpus = cpus().into_iter();
        let watches: Vec<_> = cpus
            .map(|cpu| scope.spawn(move || watch(cpu, ended)))
            .collect();
        let result = catch_unwind(AssertUnwindSafe(test));
        ended.store(true, Ordering::Relaxed);
        let stalls = watches.into_iter().map(|w| w.join().expect("watches"));
        (result, stalls.max().unwrap_or_default())
    });
    let (elapsed, after) = (began.elapsed().as_secs_f64(), Processors::read());
    let ticks = |after: u64, before: u64| after.saturating_sub(before) as f64 * TICK_S / elapsed;
    let stolen = after.stolen.iter().zip(&before.stolen);
    let stolen = stolen.map(|(after, before)| ticks(*after, *before));
    let count = after.stolen.len().max(1) as f64;
    let busy = ticks(after.busy, before.busy) - ticks(after.own, before.own);
    let taken = Taken {
        stalled: stolen.fold(stalls.as_secs_f64() / elapsed, f64::max),
        others: busy.max(0.0) / count,
    };
    (result, taken)
}

/// Processor times in ticks.
#[derive(Default)]
struct Processors {
    /// By the hypervisor, for each processor.
    stolen: Vec<u64>,
    /// By all processes.
    busy: u64,
    /// By this process and its ended children.
    own: u64,
}

impl Processors {
    fn read() -> Self {
        let mut all = Self::default();
        let stat = std::fs::read_to_string("/proc/stat").unwrap_or_default();
        for line in stat.lines().filter(|line| line.starts_with("cpu")) {
            let mut words = line.split_whitespace();
            let name = words.next().unwrap_or_default();
            let times: Vec<u64> = words.filter_map(|word| word.parse().ok()).collect();
            // user, nice, system, idle, iowait, irq, softirq, steal
            let [user, nice, system, _, _, irq, softirq, steal, ..] = times[..] else {
                continue;
            };
            match name {
                "cpu" => all.busy = user + nice + system + irq + softirq,
                _ => all.stolen.push(steal),
            }
        }
        let own = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
        // After the name in brackets: the state is field 3, utime to cstime are 14 to 17.
        let fields = own.rsplit(") ").next().unwrap_or_default().split(' ');
        let times = fields.skip(11).take(4);
        all.own = times.filter_map(|time| time.parse::<u64>().ok()).sum();
        all
    }
}

/// Wakes up on one processor every millisecond until the flag is set. Returns the time during which
/// it could not, or zero without the priority: then the tests themselves may have delayed it.
fn watch(cpu: usize, ended: &AtomicBool) -> Duration {
    let priority = ThreadPriorityValue::try_from(PRIORITY).expect("1 to 99");
    let granted = set_thread_priority_and_policy(
        thread_native_id(),
        ThreadPriority::Crossplatform(priority),
        ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo),
    );
    let certain = granted.is_ok() && ecaxis_master::sys::rt_thread::pin(cpu).is_ok();
    let mut stalled = Duration::ZERO;
    while certain && !ended.load(Ordering::Relaxed) {
        let began = Instant::now();
        thread::sleep(EVERY);
        let late = began.elapsed().saturating_sub(EVERY);
        if late > LATE {
            stalled += late;
        }
    }
    stalled
}

/// Returns the available processors.
fn cpus() -> Vec<usize> {
    let allowed = rustix::thread::sched_getaffinity(None).expect("Linux");
    let all = 0..rustix::thread::CpuSet::MAX_CPU;
    all.filter(|&cpu| allowed.is_set(cpu)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const QUIET: Taken = Taken {
        stalled: 0.0,
        others: 0.05,
    };
    const DISTURBED: Taken = Taken {
        stalled: 0.01,
        others: 0.3,
    };
    fn judged(results: &str, taken: Taken) -> Verdict {
        let results = results.chars();
        let tries = results.map(|result| Try {
            passed: result == 'p',
            taken,
        });
        judge(&tries.collect::<Vec<_>>(), true)
    }

    #[test]
    fn a_failure_counts_on_a_quiet_host_and_if_it_repeats() {
        for (results, taken, expected) in [
            ("p", QUIET, Verdict::Passed),
            ("f", QUIET, Verdict::Failed),
            ("f", DISTURBED, Verdict::Again),
            ("fpp", DISTURBED, Verdict::Again),
            ("fppp", DISTURBED, Verdict::Passed),
            ("fpfp", DISTURBED, Verdict::Again),
            ("fpfpp", DISTURBED, Verdict::Passed),
            ("fpfpf", DISTURBED, Verdict::Failed),
            ("fff", DISTURBED, Verdict::Failed),
        ] {
            assert_eq!(judged(results, taken), expected, "{results} {taken:?}");
        }
    }

    /// Returns the probability of a result if a try passes with the probability `p`.
    fn probability(of: &Verdict, before: &str, p: f64) -> f64 {
        let each = [('p', p), ('f', 1.0 - p)];
        let each = each.map(|(result, p_now)| {
            let results = format!("{before}{result}");
            match judged(&results, DISTURBED) {
                Verdict::Again => p_now * probability(of, &results, p),
                verdict if verdict == *of => p_now,
                _ => 0.0,
            }
        });
        each.iter().sum()
    }

    #[test]
    fn retries_do_not_hide_a_frequent_bug() {
        let hidden = probability(&Verdict::Passed, "f", 0.2);
        assert!(hidden < 0.03, "{hidden}");
        let usual = probability(&Verdict::Passed, "", 0.95);
        assert!(usual > 0.999, "{usual}");
    }
}
