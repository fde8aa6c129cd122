//! Runs the cycle until it halts, with the supervisor on a second thread or between cycles.

use std::future::Future;
use std::pin::pin;
use std::sync::mpsc::Sender;
use std::task::{Context, Poll, Waker};
use std::thread;

use super::{Cause, Error, Progress, panic_text};
use crate::clock::{self, Nanos};
use crate::config;
use crate::rt::cycle::{Engine, EngineConfig, EngineReport};
use crate::supervise::{ProgramOutcome, Supervisor};
use crate::sys::executor;
use crate::sys::process::ThreadUsage;
use crate::sys::rights;
use crate::sys::rt_thread::{self, CpuWakeGuard, RtSetupError, RtThrottlingRisk};

/// Result of a run: the engine and the link after the last cycle.
pub(super) struct CycleRun {
    pub remains: EngineReport,
    pub result: (ProgramOutcome, Result<(), Error>),
    /// CPU usage of the real-time thread and the elapsed time; `None` in virtual time.
    pub used: Option<(ThreadUsage, Nanos)>,
}

/// Runs cycle and supervisor on the calling thread. The supervisor runs once after every cycle.
pub(super) fn in_virtual_time(parts: EngineConfig, supervisor: Supervisor) -> CycleRun {
    let mut engine = Engine::new(parts);
    let mut during = pin!(supervisor.run());
    let mut context = Context::from_waker(Waker::noop());
    let mut result = None;
    while !engine.halted() {
        engine.cycle();
        if result.is_none()
            && let Poll::Ready(done) = during.as_mut().poll(&mut context)
        {
            result = Some(done);
        }
    }
    CycleRun {
        remains: engine.finish(),
        result: result.unwrap_or_else(supervisor_ended_early),
        used: None,
    }
}

/// Runs the cycle on the calling thread, which becomes the real-time thread. The supervisor runs on
/// a second thread.
///
/// # Errors
/// [`Cause::Thread`] if the supervisor's thread cannot be started.
pub(super) fn in_real_time(
    parts: EngineConfig,
    supervisor: Supervisor,
    config: &config::Bus,
    reported: &Sender<Progress>,
) -> Result<CycleRun, Error> {
    // The supervisor's thread starts first: a thread inherits scheduling class and CPU of its
    // parent.
    let during = thread::Builder::new()
        .name("ecaxis-services".to_owned())
        .spawn(move || {
            rights::drop_capabilities();
            executor::block_on(supervisor.run())
        })
        .map_err(|error| Cause::Thread(error.to_string()))?;
    // The thread reads no files once its rights are limited.
    let limit = rt_thread::rt_limit();
    let (_held, mut denied) = CpuWakeGuard::take(config.cpu.filter(|_| config.awake));
    denied.extend(rt_thread::become_realtime(config.priority, config.cpu));
    let fifo = !denied
        .iter()
        .any(|d| matches!(d, RtSetupError::Priority { .. }));
    for denied in denied {
        let _ = reported.send(Progress::Denied(denied));
    }
    // Locking the memory takes milliseconds, so this happens before the first cycle is scheduled.
    let mut engine = Engine::new(parts);
    if let Err(error) = rights::limit_cycle() {
        let _ = reported.send(Progress::Warning(error.to_string()));
    }
    let (before, began) = (ThreadUsage::now(), clock::now());
    while !engine.halted() {
        engine.cycle();
    }
    let (after, wall_ns) = (ThreadUsage::now(), clock::now().saturating_sub(began));
    let used = match (before, after) {
        (Ok(before), Ok(after)) => Some((after.since(before), wall_ns)),
        _ => None,
    };
    if let Some((used, wall_ns)) = used
        && fifo
        && let Some(overload) = RtThrottlingRisk::of(&used, wall_ns, limit)
    {
        let _ = reported.send(Progress::Overload(overload));
    }
    let result = match during.join() {
        Ok(Ok(result)) => result,
        Ok(Err(error)) => (
            ProgramOutcome::default(),
            Err(Cause::Thread(error.to_string()).into()),
        ),
        Err(panic) => (
            ProgramOutcome::default(),
            Err(Cause::Panicked(panic_text(&*panic)).into()),
        ),
    };
    Ok(CycleRun {
        remains: engine.finish(),
        result,
        used,
    })
}

fn supervisor_ended_early() -> (ProgramOutcome, Result<(), Error>) {
    (
        ProgramOutcome::default(),
        Err(Cause::Panicked("the supervisor ended early".to_owned()).into()),
    )
}
