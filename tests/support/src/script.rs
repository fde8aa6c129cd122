//! Runs commands in sequence through a [`Controller`] and records the axis status of every cycle.

use std::sync::{Arc, Mutex};

use ecaxis_axis::cia402::Mode;
use ecaxis_axis::status::HomingStatus;
use ecaxis_axis::{AxisStatus, Command};
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::{AxisRef, Machine};
use ecaxis_master::rt::controller::{Controller, CycleContext};
use ecaxis_master::session::{Options, Outcome, run_with};

use crate::Heard;

/// One act of a script.
#[derive(Debug, Clone, Copy)]
pub enum Act {
    /// Sends the command and waits until it is done.
    Do(Command),
    /// Sends the command and continues at once.
    Begin(Command),
    /// Waits for this time in seconds.
    Dwell(f64),
    /// Waits until the reported position is beyond this one.
    Above(f64),
    Below(f64),
}

/// The status of every cycle since the axis was ready, and the start cycle of each act.
#[derive(Debug, Default)]
pub struct Trace {
    pub cycles: Vec<AxisStatus>,
    pub began: Vec<usize>,
    pub dt_s: f64,
}

impl Trace {
    /// Returns the cycles of an act, from its start to the cycle that detected its end.
    pub fn of(&self, act: usize) -> &[AxisStatus] {
        let end = self.began.get(act + 1).map(|next| next + 1);
        &self.cycles[self.began[act]..end.unwrap_or(self.cycles.len())]
    }

    pub fn at_end_of(&self, act: usize) -> &AxisStatus {
        self.of(act).last().expect("it took a cycle")
    }
}

pub fn move_to(position: f64, speed: f64) -> Act {
    Act::Do(Command::MoveTo {
        position,
        speed,
        ramp: 1.0,
    })
}

pub fn velocity(velocity: f64) -> Act {
    Act::Do(Command::Velocity {
        velocity,
        ramp: 1.0,
    })
}

pub fn mode(mode: Mode) -> Act {
    Act::Do(Command::SetMode(mode))
}

pub fn home(timeout_s: f64) -> Act {
    Act::Do(Command::Home { timeout_s })
}

struct Script {
    axis: AxisRef,
    acts: Vec<Act>,
    next: usize,
    since: u64,
    trace: Arc<Mutex<Trace>>,
}

impl Script {
    fn over(&self, status: &AxisStatus, elapsed: u64, dt_s: f64) -> bool {
        match self.acts[self.next - 1] {
            Act::Begin(_) => true,
            Act::Dwell(seconds) => elapsed as f64 * dt_s >= seconds,
            Act::Above(position) => status.position > position,
            Act::Below(position) => status.position < position,
            // The status in the cycle of the command still describes the time before it.
            Act::Do(_) if elapsed < 2 => false,
            Act::Do(Command::SetMode(mode)) => status.mode == mode && status.switching.is_none(),
            Act::Do(Command::Home { .. }) => {
                matches!(
                    status.homing,
                    HomingStatus::Attained | HomingStatus::Failed(_)
                ) && status.ready
            }
            Act::Do(_) => status.in_target,
        }
    }
}

impl Controller for Script {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        let status = machine.axis(self.axis);
        if machine.stopping() || (!status.ready && self.next == 0) {
            return;
        }
        let mut trace = self.trace.lock().expect("no panic while it is locked");
        trace.dt_s = machine.dt_s();
        trace.cycles.push(status);
        let elapsed = machine.number() - self.since;
        if self.next > 0 && !self.over(&status, elapsed, machine.dt_s()) {
            return;
        }
        while let Some(&act) = self.acts.get(self.next) {
            let cycle = trace.cycles.len() - 1;
            trace.began.push(cycle);
            self.next += 1;
            self.since = machine.number();
            match act {
                Act::Do(command) | Act::Begin(command) => {
                    if let Err(refused) = machine.command(self.axis, command) {
                        panic!("{command:?}: {refused}");
                    }
                    if matches!(act, Act::Do(_)) {
                        return;
                    }
                }
                _ => return,
            }
        }
        machine.finish();
    }
}

/// Runs the acts on the named axis of the machine. A time limit stops endless scripts.
pub fn perform(machine: Machine, axis: &str, acts: &[Act], options: Options) -> (Outcome, Trace) {
    let axis = machine.axis(axis).expect("an axis");
    let trace = Arc::new(Mutex::new(Trace::default()));
    let script = Script {
        axis,
        acts: acts.to_vec(),
        next: 0,
        since: 0,
        trace: Arc::clone(&trace),
    };
    let options = Options {
        limit: options.limit.or(Some(120_000_000_000)),
        ..options
    };
    let stop = Arc::<CancelToken>::default();
    let mut heard = Heard::default();
    let outcome = run_with(machine, options, stop, &mut heard, Box::new(script));
    let mut kept = trace.lock().expect("no panic while it is locked");
    (outcome, std::mem::take(&mut kept))
}

/// Same as [`perform`], but every act must complete.
pub fn perform_well(machine: Machine, axis: &str, acts: &[Act], options: Options) -> Trace {
    let (outcome, trace) = perform(machine, axis, acts, options);
    if let Err(error) = outcome.result {
        panic!("{error}; at {:?}", trace.cycles.last());
    }
    let last = trace.cycles.last();
    assert_eq!(trace.began.len(), acts.len(), "{last:?}");
    trace
}
