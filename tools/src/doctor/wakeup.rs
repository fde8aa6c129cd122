//! Measures the wake-up latency of a real-time thread with two methods in turn: sleep only, and
//! sleep with a final spin.

use std::io;
use std::thread;

use serde::Serialize;

use super::fix::Fix;
use super::{ReportBuilder, Severity};
use crate::host::counters::{CpuCounters, CpuTimeDelta};
use ecaxis_master::clock::{self, Clock};
use ecaxis_master::config::duration;
use ecaxis_master::rt::exchange::ExchangeMode;
use ecaxis_master::rt::spin::{Spin, SpinWindow};
use ecaxis_master::rt::stats::{LatencyHistogram, Percentiles};
use ecaxis_master::sys::process::ThreadUsage;
use ecaxis_master::sys::rt_thread::{CpuWakeGuard, RtSetupError, become_realtime};

/// The time of one turn in ns.
const TURN_NS: u64 = 250_000_000;
/// The fraction of a cycle that a late wake-up may use; replies may take three quarters.
const SHARE: u64 = 4;
/// Typical cycle times in ns.
const CYCLES_NS: [u64; 10] = [
    62_500, 125_000, 250_000, 500_000, 1_000_000, 2_000_000, 4_000_000, 5_000_000, 10_000_000,
    20_000_000,
];

/// The result of one wait method.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct WaitMethod {
    pub lateness: Percentiles,
    /// The number of wake-ups later than a quarter of the cycle.
    pub too_late: u64,
    /// The number of times the thread was preempted. `None`: unknown.
    pub involuntary_switches: Option<u64>,
    /// Interrupts on the CPU during the measurement, or on all CPUs if the thread is not pinned.
    /// `None`: unknown.
    pub interrupts: Option<u64>,
    /// Stolen time in ms with a resolution of 10 ms, of the CPU or of all. `None`: unknown.
    pub stolen_ms: Option<u64>,
}

/// The complete measurement.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct WakeUp {
    pub cycle_ns: u64,
    /// The final spin time before the release in ns.
    pub spin_ns: u64,
    pub seconds: u32,
    /// The CPU of the thread, if pinned.
    pub cpu: Option<usize>,
    pub priority: u8,
    pub sleep: WaitMethod,
    pub sleep_and_spin: WaitMethod,
    #[serde(skip)]
    pub denied: Vec<RtSetupError>,
    /// [`Self::denied`] as text.
    pub denials: Vec<String>,
}

/// The parameters of a measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Setup {
    pub seconds: u32,
    pub cpu: Option<usize>,
    pub priority: u8,
    pub cycle_ns: u64,
    pub spin: Spin,
}

/// Measures for `setup.seconds`. Fails if no thread can be started.
pub fn measure(setup: Setup) -> io::Result<WakeUp> {
    let thread = thread::Builder::new().name("wake-up".to_owned());
    let running = thread.spawn(move || run(setup))?;
    running
        .join()
        .map_err(|_| io::Error::other("the measuring thread has panicked"))
}

fn run(setup: Setup) -> WakeUp {
    let (held, mut denied) = CpuWakeGuard::take(None);
    denied.extend(become_realtime(setup.priority, setup.cpu));
    let affine = !denied
        .iter()
        .any(|d| matches!(d, RtSetupError::Affinity { .. }));
    let cpu = setup.cpu.filter(|_| affine);
    let mut sleeping = Sampling::new(Spin::For(0), setup.cycle_ns);
    let mut spinning = Sampling::new(setup.spin, setup.cycle_ns);
    let end = clock::now() + u64::from(setup.seconds) * 1_000_000_000;
    while clock::now() < end {
        sleeping.turn(cpu, setup.cycle_ns);
        spinning.turn(cpu, setup.cycle_ns);
    }
    drop(held);
    WakeUp {
        cycle_ns: setup.cycle_ns,
        spin_ns: spinning.margin.get(),
        seconds: setup.seconds,
        cpu,
        priority: setup.priority,
        sleep: sleeping.way(),
        sleep_and_spin: spinning.way(),
        denials: denied.iter().map(ToString::to_string).collect(),
        denied,
    }
}

#[derive(Debug)]
struct Sampling {
    margin: SpinWindow,
    lateness: LatencyHistogram,
    too_late: u64,
    /// The increments of the turns so far; `None` before the first.
    usage: Option<TurnUsage>,
}

/// The increments of the kernel's counters in one turn or several.
#[derive(Debug)]
struct TurnUsage {
    involuntary_switches: Option<u64>,
    cpu: CpuTimeDelta,
}

impl TurnUsage {
    fn add(&mut self, other: &Self) {
        let switches = self.involuntary_switches.zip(other.involuntary_switches);
        self.involuntary_switches = switches.map(|(a, b)| a + b);
        self.cpu.add(&other.cpu);
    }
}

impl Sampling {
    fn new(spin: Spin, cycle: u64) -> Self {
        Self {
            margin: SpinWindow::new(spin, cycle, ExchangeMode::SameCycle),
            lateness: LatencyHistogram::new(),
            too_late: 0,
            usage: None,
        }
    }

    fn turn(&mut self, cpu: Option<usize>, cycle: u64) {
        let (cpu_before, thread_before) = (CpuCounters::now(cpu), ThreadUsage::now().ok());
        let mut next = clock::now() + cycle;
        for _ in 0..(TURN_NS / cycle).max(4) {
            let slept = Clock::Real.sleep_until(next, self.margin.get());
            self.margin.record_wakeup(slept);
            let now = clock::now();
            let late = now.saturating_sub(next);
            self.lateness.record(late);
            self.too_late += u64::from(late > cycle / SHARE);
            // Skip cycles that are already over.
            next += cycle * (1 + late / cycle);
        }
        let thread = ThreadUsage::now().ok().zip(thread_before);
        let usage = TurnUsage {
            involuntary_switches: thread
                .map(|(now, before)| now.since(before).involuntary_switches),
            cpu: CpuCounters::now(cpu).since(&cpu_before),
        };
        match &mut self.usage {
            Some(sum) => sum.add(&usage),
            None => self.usage = Some(usage),
        }
    }

    fn way(self) -> WaitMethod {
        let usage = self.usage.as_ref();
        let steal_ns = usage.and_then(|usage| usage.cpu.steal_ns);
        WaitMethod {
            lateness: self.lateness.summary(),
            too_late: self.too_late,
            involuntary_switches: usage.and_then(|usage| usage.involuntary_switches),
            interrupts: usage.and_then(|usage| usage.cpu.interrupts),
            stolen_ms: steal_ns.map(|ns| ns / 1_000_000),
        }
    }
}

/// Returns the shortest typical cycle of which this latency is at most a quarter.
fn good_for(late_ns: u64) -> Option<u64> {
    CYCLES_NS.into_iter().find(|cycle| late_ns <= cycle / SHARE)
}

impl WakeUp {
    /// Returns the shortest typical cycles for 99.9 % of the wake-ups, and for all of them.
    #[must_use]
    pub fn good_for(&self) -> (Option<u64>, Option<u64>) {
        let lateness = &self.sleep_and_spin.lateness;
        (good_for(lateness.p99_9_ns), good_for(lateness.max_ns))
    }
}

pub(super) fn examine(wake_up: &WakeUp, notes: &mut ReportBuilder) {
    let way = &wake_up.sleep_and_spin;
    let count = way.lateness.count;
    if way.too_late == 0 || count == 0 {
        return;
    }
    let share = way.too_late as f64 / count as f64;
    let severity = match share {
        s if s > 0.01 => Severity::Bad,
        s if s > 0.001 => Severity::Warning,
        _ => Severity::Note,
    };
    let stolen = way.stolen_ms.filter(|ms| *ms > 0);
    let mut fix = vec![Fix::advice(match stolen {
        Some(ms) => format!(
            "The host of this virtual machine took {ms} ms meanwhile: assign dedicated CPUs to it there, or use a physical computer."
        ),
        None => {
            "Fix the other findings, then measure again with the machine's usual load.".to_owned()
        }
    })];
    if let Some(cycle) = wake_up.good_for().0.filter(|c| *c > wake_up.cycle_ns) {
        fix.push(Fix::advice(format!(
            "`cycle = \"{}\"` would have lost fewer than one in a thousand.",
            duration::show(cycle).replace(' ', ""),
        )));
    }
    notes.find(
        severity,
        "wake-up",
        format!(
            "{} of {count} wake-ups came later than a quarter of the cycle of {}",
            way.too_late,
            duration::show(wake_up.cycle_ns),
        ),
        "The reply then has too little time left: a lost frame. `lost_frames` of them in a row stop the machine.",
        fix,
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn good_for_returns_the_shortest_cycle() {
        for (late, expected) in [
            (0, Some(62_500)),
            (15_625, Some(62_500)),
            (15_626, Some(125_000)),
            (250_000, Some(1_000_000)),
            (5_000_000, Some(20_000_000)),
            (5_000_001, None),
        ] {
            assert_eq!(good_for(late), expected, "{late}");
        }
    }

    #[test]
    fn measure_runs_both_methods_equally() {
        let setup = Setup {
            seconds: 1,
            cpu: None,
            priority: 80,
            cycle_ns: 1_000_000,
            spin: Spin::Auto,
        };
        let wake_up = measure(setup).unwrap();
        let (sleep, spin) = (wake_up.sleep.lateness, wake_up.sleep_and_spin.lateness);
        assert_eq!(sleep.count, spin.count);
        assert!(sleep.count >= 250 && sleep.count % 250 == 0, "{sleep:?}");
        assert!(sleep.max_ns >= sleep.p50_ns && sleep.max_ns > 0);
    }
}
