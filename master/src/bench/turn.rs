//! Turns the real cycle on a real-time thread and measures it.

use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use super::bus::{Bus, Counts};
use super::kernel::{CpuTaken, CpuView};
use super::rig::{self, RigError, Setup};
use crate::clock::{self, Clock, Nanos};
use crate::os::process::ThreadUse;
use crate::rt::cycle::{Engine, Parts};
use crate::rt::handover::OuterEnd;
use crate::rt::stats::Stats;
use crate::rt::thread::{Denied, prepare};

/// What the engine's vectors and ethercrab's tables need at most.
const STACK: usize = 4 * 1024 * 1024;
const TICK: Duration = Duration::from_millis(50);

/// Set by the thread beside the cycle.
const MEASURE: u8 = 1;
const END: u8 = 2;

/// What a stretch of cycles came to.
#[derive(Debug, Clone, Default)]
pub struct Measured {
    pub stats: Stats,
    pub used: ThreadUse,
    /// Of its CPU, where the thread was bound to one.
    pub taken: Option<CpuTaken>,
    pub wall_ns: Nanos,
    /// Spinning before a release, at the end.
    pub spin_ns: Nanos,
    /// What the bus saw meanwhile.
    pub bus: Option<Counts>,
    pub denied: Vec<Denied>,
}

impl Measured {
    /// Adds another stretch of the same.
    pub fn add(&mut self, other: &Self) {
        self.stats.add(&other.stats);
        self.used = self.used.plus(other.used);
        match (&mut self.taken, &other.taken) {
            (Some(taken), Some(more)) => taken.add(more),
            (taken @ None, more) => taken.clone_from(more),
            _ => {}
        }
        if let Some(more) = other.bus {
            self.bus = Some(self.bus.map_or(more, |bus| bus.plus(&more)));
        }
        self.wall_ns += other.wall_ns;
        self.spin_ns = other.spin_ns;
        for denied in &other.denied {
            if !self.denied.contains(denied) {
                self.denied.push(denied.clone());
            }
        }
    }
}

/// Where and for how long.
#[derive(Debug, Clone, Copy)]
pub struct Thread {
    pub priority: u8,
    pub cpu: Option<usize>,
    pub time: Duration,
}

/// Why nothing was measured.
#[derive(Debug, thiserror::Error)]
pub enum TurnError {
    #[error("a thread cannot be started: {0}")]
    Thread(#[from] std::io::Error),
    #[error("the cycle's thread panicked")]
    Panicked,
    #[error("{0}")]
    Rig(#[from] RigError),
}

/// Sets the axes of a [`rig`] in motion, then measures for as long as `thread` says or until `stop`, which gives `None` if
/// nothing moved yet.
///
/// # Errors
/// Where the axes do not get that far.
pub fn rig(
    parts: Parts,
    mut outer: OuterEnd,
    setup: Setup,
    thread: Thread,
    bus: Option<&Bus>,
    stop: &AtomicBool,
) -> Result<Option<Measured>, TurnError> {
    let step = AtomicU8::new(0);
    thread::scope(|scope| {
        let cycle = thread::Builder::new()
            .name("ecaxis-rt".to_owned())
            .stack_size(STACK)
            .spawn_scoped(scope, || turn(parts, thread, &step))?;
        let moving = rig::set_in_motion(&mut outer, setup, stop);
        let counts = bus.map(Bus::counts);
        if matches!(moving, Ok(true)) {
            step.store(MEASURE, Ordering::Release);
            let start = Instant::now();
            while start.elapsed() < thread.time && !stop.load(Ordering::Relaxed) {
                thread::sleep(TICK.min(thread.time.saturating_sub(start.elapsed())));
            }
        }
        step.store(END, Ordering::Release);
        let mut measured = cycle.join().map_err(|_| TurnError::Panicked)?;
        measured.bus = bus
            .zip(counts)
            .map(|(bus, before)| bus.counts().since(&before));
        Ok(moving?.then_some(measured))
    })
}

fn turn(parts: Parts, thread: Thread, step: &AtomicU8) -> Measured {
    Clock::Real.enter();
    let denied = prepare(thread.priority, thread.cpu);
    let mut engine = Engine::new(parts);
    while step.load(Ordering::Acquire) == 0 && !engine.halted() {
        engine.cycle();
    }
    let seen = thread.cpu.map(CpuView::now);
    engine.measure_anew();
    let (before, began) = (ThreadUse::now(), clock::now());
    while step.load(Ordering::Acquire) == MEASURE && !engine.halted() {
        engine.cycle();
    }
    let (after, ended) = (ThreadUse::now(), clock::now());
    let used = match (before, after) {
        (Ok(before), Ok(after)) => after.since(before),
        _ => ThreadUse::default(),
    };
    let taken = match (thread.cpu, seen) {
        (Some(cpu), Some(before)) => Some(CpuView::now(cpu).since(&before)),
        _ => None,
    };
    let remains = engine.into_remains();
    Measured {
        stats: remains.stats,
        spin_ns: remains.spin_ns,
        used,
        taken,
        wall_ns: ended.saturating_sub(began),
        bus: None,
        denied,
    }
}
