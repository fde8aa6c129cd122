//! Turns the cycle until it halts, with the supervisor beside it.

use std::future::Future;
use std::pin::pin;
use std::sync::mpsc::Sender;
use std::task::{Context, Poll, Waker};
use std::thread;

use super::{Progress, RunError, panic_text};
use crate::clock::{self, Nanos};
use crate::config;
use crate::os::process::ThreadUse;
use crate::rt::cycle::{Engine, Parts, Remains};
use crate::rt::thread::{self as rt_thread, Denied, Held, Overload};
use crate::supervise::{Ended, Supervisor, executor};

/// A machine that has been run.
pub(super) struct Turned {
    pub remains: Remains,
    pub result: (Ended, Result<(), RunError>),
    /// What its thread took in how many nanoseconds, where time is real.
    pub used: Option<(ThreadUse, Nanos)>,
}

/// On the calling thread alone. The supervisor gets its turn after every cycle.
pub(super) fn in_virtual_time(parts: Parts, supervisor: Supervisor) -> Turned {
    let mut engine = Engine::new(parts);
    let mut beside = pin!(supervisor.run());
    let mut context = Context::from_waker(Waker::noop());
    let mut result = None;
    while !engine.halted() {
        engine.cycle();
        if result.is_none()
            && let Poll::Ready(done) = beside.as_mut().poll(&mut context)
        {
            result = Some(done);
        }
    }
    Turned {
        remains: engine.into_remains(),
        result: result.unwrap_or_else(died),
        used: None,
    }
}

/// On the calling thread, which becomes the real-time thread, with the supervisor beside it.
///
/// # Errors
/// [`RunError::Thread`] where the supervisor's thread cannot be started.
pub(super) fn in_real_time(
    parts: Parts,
    supervisor: Supervisor,
    config: &config::Bus,
    told: &Sender<Progress>,
) -> Result<Turned, RunError> {
    // Started first, because a thread inherits the scheduling class and CPU of its parent.
    let beside = thread::Builder::new()
        .name("ecaxis-mailbox".to_owned())
        .spawn(move || executor::block_on(supervisor.run()))
        .map_err(|error| RunError::Thread(error.to_string()))?;
    let (_held, mut denied) = Held::take(config.cpu.filter(|_| config.awake));
    denied.extend(rt_thread::prepare(config.priority, config.cpu));
    let fifo = !denied.iter().any(|d| matches!(d, Denied::Priority { .. }));
    for denied in denied {
        let _ = told.send(Progress::Denied(denied));
    }
    // Locking the memory takes milliseconds; the first cycle is due one cycle from here.
    let mut engine = Engine::new(parts);
    let (before, began) = (ThreadUse::now(), clock::now());
    while !engine.halted() {
        engine.cycle();
    }
    let (after, wall_ns) = (ThreadUse::now(), clock::now().saturating_sub(began));
    let used = match (before, after) {
        (Ok(before), Ok(after)) => Some((after.since(before), wall_ns)),
        _ => None,
    };
    if let Some((used, wall_ns)) = used
        && fifo
        && let Some(overload) = Overload::of(&used, wall_ns)
    {
        let _ = told.send(Progress::Overload(overload));
    }
    let result = match beside.join() {
        Ok(Ok(result)) => result,
        Ok(Err(error)) => (Ended::default(), Err(RunError::Thread(error.to_string()))),
        Err(panic) => (
            Ended::default(),
            Err(RunError::Panicked(panic_text(&*panic))),
        ),
    };
    Ok(Turned {
        remains: engine.into_remains(),
        result,
        used,
    })
}

fn died() -> (Ended, Result<(), RunError>) {
    (
        Ended::default(),
        Err(RunError::Panicked("the supervisor ended early".to_owned())),
    )
}
