//! Runs the real cycle on a real-time thread and measures it.

use std::sync::atomic::{AtomicU8, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use super::bus::{Bus, Counts};
use super::fixture::{self, RigError, Setup};
use crate::host::counters::{CpuCounters, CpuTimeDelta};
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::{self, Clock, Nanos};
use ecaxis_master::rt::channel::HostEndpoint;
use ecaxis_master::rt::cycle::{Engine, EngineConfig};
use ecaxis_master::rt::stats::Stats;
use ecaxis_master::sys::process::ThreadUsage;
use ecaxis_master::sys::rt_thread::{RtSetupError, become_realtime};

/// The stack size in bytes, sufficient for the engine's vectors and ethercrab's tables.
const STACK: usize = 4 * 1024 * 1024;
const TICK: Duration = Duration::from_millis(50);

/// Set by the host thread during operation.
const MEASURE: u8 = 1;
const END: u8 = 2;

/// The result of a number of cycles.
#[derive(Debug, Clone, Default)]
pub struct Measured {
    pub stats: Stats,
    pub used: ThreadUsage,
    /// The load of its CPU by others, if the thread is pinned.
    pub taken: Option<CpuTimeDelta>,
    pub wall_ns: Nanos,
    /// The final spin time before a release in ns.
    pub spin_ns: Nanos,
    /// The counters of the bus during the measurement.
    pub bus: Option<Counts>,
    pub denied: Vec<RtSetupError>,
}

impl Measured {
    /// Adds another result of the same variant.
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

/// The thread and its run time.
#[derive(Debug, Clone, Copy)]
pub struct Thread {
    pub priority: u8,
    pub cpu: Option<usize>,
    pub time: Duration,
}

/// Why the measurement failed.
#[derive(Debug, thiserror::Error)]
pub enum TurnError {
    #[error("cannot start a thread: {0}")]
    Thread(#[from] std::io::Error),
    #[error("the cycle's thread panicked")]
    Panicked,
    #[error("{0}")]
    Rig(#[from] RigError),
}

/// Starts the axes of a fixture, then measures for the time in `thread` or until `stop`. Returns
/// `None` if it was stopped before the axes moved.
///
/// # Errors
/// Fails if the axes do not start to move.
pub fn rig(
    parts: EngineConfig,
    mut outer: HostEndpoint,
    setup: Setup,
    thread: Thread,
    bus: Option<&Bus>,
    stop: &CancelToken,
) -> Result<Option<Measured>, TurnError> {
    let step = AtomicU8::new(0);
    thread::scope(|scope| {
        let cycle = thread::Builder::new()
            .name("ecaxis-rt".to_owned())
            .stack_size(STACK)
            .spawn_scoped(scope, || turn(parts, thread, &step))?;
        let moving = fixture::set_in_motion(&mut outer, setup, stop);
        let counts = bus.map(Bus::counts);
        if matches!(moving, Ok(true)) {
            step.store(MEASURE, Ordering::Release);
            let start = Instant::now();
            while start.elapsed() < thread.time && !stop.is_cancelled() {
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

fn turn(parts: EngineConfig, thread: Thread, step: &AtomicU8) -> Measured {
    Clock::Real.enter();
    let denied = become_realtime(thread.priority, thread.cpu);
    let mut engine = Engine::new(parts);
    while step.load(Ordering::Acquire) == 0 && !engine.halted() {
        engine.cycle();
    }
    let seen = thread.cpu.map(|_| CpuCounters::now(thread.cpu));
    engine.reset_statistics();
    let (before, began) = (ThreadUsage::now(), clock::now());
    while step.load(Ordering::Acquire) == MEASURE && !engine.halted() {
        engine.cycle();
    }
    let (after, ended) = (ThreadUsage::now(), clock::now());
    let used = match (before, after) {
        (Ok(before), Ok(after)) => after.since(before),
        _ => ThreadUsage::default(),
    };
    let taken = match (thread.cpu, seen) {
        (Some(_), Some(before)) => Some(CpuCounters::now(thread.cpu).since(&before)),
        _ => None,
    };
    let remains = engine.finish();
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
