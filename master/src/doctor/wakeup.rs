//! Measures how late a thread of the cycle's kind wakes up: sleeping alone, and sleeping until shortly
//! before with the rest spun, in turns in the same run.

use std::io;
use std::thread;

use serde::Serialize;

use super::host::Host;
use super::mend::Mend;
use super::{Notes, Severity, interrupts};
use crate::clock::{self, Clock};
use crate::config::duration;
use crate::os::process::ThreadUse;
use crate::rt::exchange::Mode;
use crate::rt::margin::{Margin, Spin};
use crate::rt::stats::{Percentiles, Times};
use crate::rt::thread::{Denied, Held, prepare};

/// Time of one turn.
const TURN_NS: u64 = 250_000_000;
/// The part of a cycle that may be lost to a late wake-up: replies may take three quarters of it.
const SHARE: u64 = 4;
/// Cycle times that a bus is run at.
const CYCLES_NS: [u64; 10] = [
    62_500, 125_000, 250_000, 500_000, 1_000_000, 2_000_000, 4_000_000, 5_000_000, 10_000_000,
    20_000_000,
];

/// One way of waiting.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Way {
    pub lateness: Percentiles,
    /// Wake-ups later than a quarter of the cycle.
    pub too_late: u64,
    /// The thread was taken off its CPU.
    pub involuntary_switches: u64,
    /// Taken by the CPU meanwhile, or by all of them where the thread is not pinned.
    pub interrupts: Option<u64>,
    /// In units of 10 ms, of the CPU or of all.
    pub stolen_ms: Option<u64>,
}

/// The whole measurement.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct WakeUp {
    pub cycle_ns: u64,
    /// How long before the release sleeping ended, at last.
    pub spin_ns: u64,
    pub seconds: u32,
    /// Where the thread was pinned to.
    pub cpu: Option<usize>,
    pub priority: u8,
    pub sleep: Way,
    pub sleep_and_spin: Way,
    #[serde(skip)]
    pub denied: Vec<Denied>,
    /// [`Self::denied`] in words.
    pub denials: Vec<String>,
}

/// What is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Setup {
    pub seconds: u32,
    pub cpu: Option<usize>,
    pub priority: u8,
    pub cycle_ns: u64,
    pub spin: Spin,
}

/// Takes as long as `setup.seconds`. Fails when no thread can be started.
pub fn measure(setup: Setup) -> io::Result<WakeUp> {
    let thread = thread::Builder::new().name("wake-up".to_owned());
    let running = thread.spawn(move || run(setup))?;
    running
        .join()
        .map_err(|_| io::Error::other("the measuring thread has panicked"))
}

fn run(setup: Setup) -> WakeUp {
    let (held, mut denied) = Held::take(None);
    denied.extend(prepare(setup.priority, setup.cpu));
    let affine = !denied.iter().any(|d| matches!(d, Denied::Affinity { .. }));
    let cpu = setup.cpu.filter(|_| affine);
    let host = Host::here();
    let mut sleeping = Taking::new(Spin::For(0), setup.cycle_ns);
    let mut spinning = Taking::new(setup.spin, setup.cycle_ns);
    let end = clock::now() + u64::from(setup.seconds) * 1_000_000_000;
    while clock::now() < end {
        sleeping.turn(&host, cpu, setup.cycle_ns);
        spinning.turn(&host, cpu, setup.cycle_ns);
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
struct Taking {
    margin: Margin,
    lateness: Times,
    way: Way,
}

impl Taking {
    fn new(spin: Spin, cycle: u64) -> Self {
        Self {
            margin: Margin::new(spin, cycle, Mode::SameCycle),
            lateness: Times::new(),
            way: Way::default(),
        }
    }

    fn turn(&mut self, host: &Host, cpu: Option<usize>, cycle: u64) {
        let before = Outside::now(host, cpu);
        let mut next = clock::now() + cycle;
        for _ in 0..(TURN_NS / cycle).max(4) {
            let slept = Clock::Real.sleep_until(next, self.margin.get());
            self.margin.slept(slept);
            let now = clock::now();
            let late = now.saturating_sub(next);
            self.lateness.record(late);
            self.way.too_late += u64::from(late > cycle / SHARE);
            // A cycle that is over already is left out.
            next += cycle * (1 + late / cycle);
        }
        let after = Outside::now(host, cpu);
        let way = &mut self.way;
        way.involuntary_switches += after.switches.saturating_sub(before.switches);
        way.interrupts = more(way.interrupts, before.interrupts, after.interrupts);
        way.stolen_ms = more(way.stolen_ms, before.stolen_ms, after.stolen_ms);
    }

    fn way(self) -> Way {
        Way {
            lateness: self.lateness.summary(),
            ..self.way
        }
    }
}

fn more(sum: Option<u64>, before: Option<u64>, after: Option<u64>) -> Option<u64> {
    Some(sum.unwrap_or(0) + after?.saturating_sub(before?))
}

/// What else happened.
#[derive(Debug)]
struct Outside {
    switches: u64,
    interrupts: Option<u64>,
    stolen_ms: Option<u64>,
}

impl Outside {
    fn now(host: &Host, cpu: Option<usize>) -> Self {
        let stat = host.text("proc/stat").unwrap_or_default();
        let name = cpu.map_or("cpu".to_owned(), |cpu| format!("cpu{cpu}"));
        let line = stat
            .lines()
            .find(|line| line.split_whitespace().next() == Some(&name));
        // The eighth after the name, in ticks of USER_HZ, which is 100.
        let ticks = line.and_then(|line| line.split_whitespace().nth(8)?.parse::<u64>().ok());
        Self {
            switches: ThreadUse::now().map_or(0, |used| used.involuntary_switches),
            interrupts: interrupts::taken(host, cpu),
            stolen_ms: ticks.map(|ticks| ticks.saturating_mul(10)),
        }
    }
}

/// The shortest usual cycle of which a wake-up so late loses no more than a quarter.
fn good_for(late_ns: u64) -> Option<u64> {
    CYCLES_NS.into_iter().find(|cycle| late_ns <= cycle / SHARE)
}

impl WakeUp {
    /// The shortest usual cycles that 99.9 % of the wake-ups, and all of them, would have been in time for.
    #[must_use]
    pub fn good_for(&self) -> (Option<u64>, Option<u64>) {
        let lateness = &self.sleep_and_spin.lateness;
        (good_for(lateness.p99_9_ns), good_for(lateness.max_ns))
    }
}

pub(super) fn examine(wake_up: &WakeUp, notes: &mut Notes) {
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
    let mut mend = vec![Mend::advice(match stolen {
        Some(ms) => format!(
            "The host of this virtual machine took {ms} ms meanwhile: give it CPUs of its own there, or take a computer of metal."
        ),
        None => "Mend what else is found here, then measure again with the machine's usual load."
            .to_owned(),
    })];
    if let Some(cycle) = wake_up.good_for().0.filter(|c| *c > wake_up.cycle_ns) {
        mend.push(Mend::advice(format!(
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
        mend,
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cycles_that_a_lateness_allows() {
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
    fn both_ways_are_measured_as_often() {
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
