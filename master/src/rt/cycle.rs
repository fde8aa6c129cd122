//! One turn of the loop: wake, send, receive, check, step, publish.

use std::panic::AssertUnwindSafe;

use ecaxis_axis::setpoint::Table;
use ecaxis_axis::{Command, State};

use super::controller::{self, Controller};
use super::exchange::{Answer, Exchange, Received};
use super::feed::{self, FeedState};
use super::guard::{Guard, StopCause};
use super::handover::{Event, PhaseStatus, RtEnd, Snapshot};
use super::image::SignalBits;
use super::phase::Phase;
use super::slot::AxisSlot;
use super::stats::Stats;
pub(in crate::rt) mod orders;

use orders::quick_stop;

use crate::clock::{self, Clock, Nanos};
use crate::config::{Condition, StopSetup};
use crate::link::port::Port;
use crate::link::{Link, LinkError, MAX_FRAME};

/// Frames taken in a row without looking at the clock; more than a cycle and a mailbox ever bring.
const FRAMES_AT_ONCE: usize = 32;

/// An axis at rest settles on its target this long before its power is taken away.
const SETTLE: Nanos = 100_000_000;

/// The process data that the program reads and sets.
#[derive(Debug, Clone, Default)]
pub struct Signals {
    pub inputs: Vec<SignalBits>,
    pub outputs: Vec<SignalBits>,
}

/// How the loop is timed.
#[derive(Debug, Clone, Copy)]
pub struct Timing {
    pub cycle_ns: u64,
    /// Spinning before the release; the rest is slept.
    pub spin_ns: u64,
    /// How long the slowest axis may take from full speed to rest. One that is not at rest this long
    /// after the machine began to stop is left to its drive's own quick stop.
    pub stop_patience_ns: u64,
}

/// Everything that a cycle touches.
#[derive(Debug)]
pub struct Engine {
    clock: Clock,
    timing: Timing,
    link: Box<dyn Link>,
    port: Port,
    exchange: Exchange,
    axes: Vec<AxisSlot>,
    signals: Signals,
    /// Of the last cycle with fresh inputs.
    inputs: Vec<f64>,
    controller: Option<Box<dyn Controller>>,
    tables: Box<[Table]>,
    stop_setup: StopSetup,
    finished: bool,
    phase: Option<Phase>,
    phase_error: i64,
    guard: Guard,
    guarding: bool,
    stats: Stats,
    end: RtEnd,
    next: Nanos,
    stopping: Option<(StopCause, Nanos)>,
    severity: u8,
    answer: Answer,
    events_lost: u64,
    orders_taken: u64,
    halted: bool,
    buf: [u8; MAX_FRAME],
}

/// What an engine is made of.
#[derive(Debug)]
pub struct Parts {
    pub clock: Clock,
    pub timing: Timing,
    pub link: Box<dyn Link>,
    pub port: Port,
    pub exchange: Exchange,
    pub axes: Vec<AxisSlot>,
    pub signals: Signals,
    pub controller: Option<Box<dyn Controller>>,
    pub tables: Box<[Table]>,
    pub stop: StopSetup,
    pub phase: Option<Phase>,
    pub guard: Guard,
    pub end: RtEnd,
}

/// What remains when the loop has ended.
#[derive(Debug)]
pub struct Remains {
    pub link: Box<dyn Link>,
    pub port: Port,
    pub axes: Vec<AxisSlot>,
    pub stats: Stats,
}

impl Engine {
    /// The first cycle is due one cycle from now.
    #[must_use]
    #[allow(clippy::disallowed_macros, reason = "prepares")]
    pub fn new(parts: Parts) -> Self {
        Self {
            clock: parts.clock,
            timing: parts.timing,
            link: parts.link,
            port: parts.port,
            exchange: parts.exchange,
            axes: parts.axes,
            inputs: vec![0.0; parts.signals.inputs.len()],
            signals: parts.signals,
            controller: parts.controller,
            tables: parts.tables,
            stop_setup: parts.stop,
            finished: false,
            phase: parts.phase,
            phase_error: 0,
            guard: parts.guard,
            guarding: false,
            stats: Stats::default(),
            end: parts.end,
            next: clock::now() + parts.timing.cycle_ns,
            stopping: None,
            severity: 0,
            answer: Answer::default(),
            events_lost: 0,
            orders_taken: 0,
            halted: false,
            buf: [0; MAX_FRAME],
        }
    }

    /// Whether [`Order::Halt`] has been taken.
    #[must_use]
    pub fn halted(&self) -> bool {
        self.halted
    }

    #[must_use]
    pub fn into_remains(self) -> Remains {
        Remains {
            link: self.link,
            port: self.port,
            axes: self.axes,
            stats: self.stats,
        }
    }

    /// One cycle. RT: blocks on the clock and the wire only; O(image + axes).
    pub fn cycle(&mut self) {
        self.clock.sleep_until(self.next, self.timing.spin_ns);
        let woke = clock::now();
        let lateness = woke.saturating_sub(self.next);
        self.stats.lateness.record(lateness);
        self.stats.counters.cycles += 1;

        self.send();
        self.receive(woke);
        self.answer = self.exchange.answer();
        self.count();
        let adjust = self.follow_clock(lateness);
        if self.guarding
            && let Some(cause) = self.guard.check(&self.answer)
        {
            self.stop(cause);
        }

        self.observe();
        self.take_orders();
        self.call_controller();
        self.act();
        self.exchange.stage();
        self.publish(woke);
        self.plan_next(adjust);
        self.stats.work.record(clock::now().saturating_sub(woke));
    }

    fn send(&mut self) {
        let sent = self.exchange.send(self.link.as_mut());
        self.note(sent);
        // Mailbox frames follow the cyclic ones, one a cycle.
        let sent = self.port.send(self.link.as_mut(), 1).map(|_| ());
        self.note(sent);
    }

    fn note(&mut self, result: Result<(), LinkError>) {
        if result.is_err() {
            self.stats.counters.link_errors += 1;
        }
    }

    /// Until the cyclic frames are back or three quarters of the cycle are over.
    fn receive(&mut self, woke: Nanos) {
        let released = self.next;
        let quarter = self.timing.cycle_ns / 4;
        // A thread that woke late still gives its frame time to come back.
        let deadline = (released + 3 * quarter).max(woke + quarter);
        loop {
            for _ in 0..FRAMES_AT_ONCE {
                match self.link.recv(&mut self.buf) {
                    Ok(Some(len)) => self.sort(len),
                    Ok(None) => break,
                    Err(_) => {
                        self.stats.counters.link_errors += 1;
                        break;
                    }
                }
            }
            let now = clock::now();
            if self.exchange.complete() {
                self.stats.round_trip.record(now.saturating_sub(released));
                return;
            }
            if now >= deadline {
                return;
            }
            self.clock.relax(
                self.link
                    .next_arrival()
                    .map_or(deadline, |at| at.min(deadline)),
            );
        }
    }

    fn sort(&mut self, len: usize) {
        let frame = &self.buf[..len];
        match self.exchange.receive(frame) {
            Received::Current => {}
            Received::Late => self.stats.counters.late_frames += 1,
            Received::Foreign => self.port.receive(frame),
        }
    }

    fn count(&mut self) {
        if self.guarding {
            if !self.answer.complete {
                self.stats.counters.lost_frames += 1;
            } else if !self.answer.inputs_fresh {
                self.stats.counters.wkc_errors += 1;
            }
        }
        self.stats.counters.refused_answers = self.port.refused;
    }

    /// Nanoseconds to add to the next cycle.
    fn follow_clock(&mut self, lateness: Nanos) -> i64 {
        let Some(phase) = &mut self.phase else {
            return 0;
        };
        let Some(system_time) = self.answer.system_time else {
            return phase.holdover();
        };
        let before = phase.locked();
        let step = phase.update(system_time, lateness);
        let now_locked = phase.locked();
        self.phase_error = step.error;
        if now_locked {
            self.stats.phase.record(step.error.unsigned_abs());
        }
        let cycle = self.stats.counters.cycles;
        match (before, now_locked) {
            (false, true) => self.report(Event::PhaseLocked { cycle }),
            (true, false) => self.report(Event::PhaseLost { cycle }),
            _ => {}
        }
        step.adjust
    }

    fn without_power(&self) -> bool {
        self.axes
            .iter()
            .all(|slot| !has_power(slot.axis.status().state))
    }

    fn observe(&mut self) {
        let dt = self.timing.cycle_ns as f64 * 1e-9;
        let fresh = self.answer.inputs_fresh && self.answer.complete;
        let image = self.exchange.inputs();
        for slot in &mut self.axes {
            let inputs = slot.read(image, fresh);
            slot.axis.observe(&inputs, dt);
            slot.acted = false;
        }
        if fresh {
            for (to, signal) in self.inputs.iter_mut().zip(&self.signals.inputs) {
                *to = signal.get(image);
            }
            let inputs = &self.inputs;
            // What is no number says nothing about what it stands for.
            let pressed = |c: &Condition| {
                inputs
                    .get(c.input)
                    .is_none_or(|n| n.is_nan() || c.holds(*n))
            };
            if self.guarding && self.stop_setup.emergency.iter().any(pressed) {
                self.stop(StopCause::EmergencyStop);
            }
        }
    }

    /// The user's own code. What it has done when it panics is kept: the axes guard themselves.
    fn call_controller(&mut self) {
        let Some(controller) = &mut self.controller else {
            return;
        };
        let mut view = controller::Cycle {
            number: self.stats.counters.cycles,
            dt_s: self.timing.cycle_ns as f64 * 1e-9,
            fresh: self.answer.inputs_fresh && self.answer.complete,
            stopping: self.stopping.is_some(),
            guarded: self.guarding,
            axes: &mut self.axes,
            inputs: &self.inputs,
            signals: &self.signals,
            outputs: self.exchange.outputs_mut(),
            finished: &mut self.finished,
        };
        let call = AssertUnwindSafe(|| controller.cycle(&mut view));
        if std::panic::catch_unwind(call).is_err() {
            self.controller = None;
            self.stop(StopCause::Controller);
        }
    }

    /// Masters before those that follow them, so that a follower's set-point is of the same cycle.
    fn act(&mut self) {
        let mut cause = None;
        // Gears form no rings, so every round acts on one axis at least.
        for _ in 0..self.axes.len() {
            let mut waiting = false;
            for index in 0..self.axes.len() {
                let Some(slot) = self.axes.get(index) else {
                    continue;
                };
                if slot.acted {
                    continue;
                }
                let followed = slot.feed.master().and_then(|(m, _)| self.axes.get(m));
                if followed.is_some_and(|master| !master.acted) {
                    waiting = true;
                } else {
                    let found = self.act_on(index);
                    cause = cause.or(found);
                }
            }
            if !waiting {
                break;
            }
        }
        if let Some(cause) = cause {
            self.stop(cause);
        }
    }

    /// One axis; what of it has to stop the machine.
    fn act_on(&mut self, index: usize) -> Option<StopCause> {
        let dt_s = self.timing.cycle_ns as f64 * 1e-9;
        let out_of_patience = self.stopping.is_some_and(|(_, since)| {
            self.next.saturating_sub(since) > self.timing.stop_patience_ns
        });
        let followed = self.axes.get(index)?.feed.master();
        let master = followed.and_then(|(master, actual)| {
            let status = self.axes.get(master)?.axis.status();
            feed::master_motion(&status, actual)
        });
        let slot = self.axes.get_mut(index)?;
        slot.acted = true;
        let lost = slot.feed.give(&mut slot.axis, &self.tables, master, dt_s);
        let outputs = slot.axis.act();
        slot.write(self.exchange.outputs_mut(), &outputs);
        let status = slot.axis.status();
        slot.armed |= slot.ordered && status.fault.is_none();
        if status.enabled {
            slot.largest_following_error =
                slot.largest_following_error.max(status.max_following_error);
            slot.last_enabled = Some(status);
        }
        if self.stopping.is_some() {
            let at_rest = status.at_rest && !status.moving;
            slot.rested = if at_rest {
                slot.rested + self.timing.cycle_ns
            } else {
                0
            };
            if status.enabled && out_of_patience {
                quick_stop(&mut slot.axis);
            } else if status.enabled && slot.rested >= SETTLE {
                let _ = slot.axis.command(Command::Disable);
            }
            return None;
        }
        match (status.fault, status.trip) {
            (Some(_), _) if slot.armed => Some(StopCause::DriveFault { axis: index }),
            (None, Some(trip)) if slot.armed => Some(StopCause::Trip { axis: index, trip }),
            _ => lost.then_some(StopCause::FollowLost { axis: index }),
        }
    }

    fn publish(&mut self, woke: Nanos) {
        let stopped = self.stopping.is_some() && self.without_power();
        let snapshot = self.end.snapshots.input_buffer_mut();
        snapshot.time = woke;
        snapshot.counters = self.stats.counters;
        snapshot.phase = self.phase.as_ref().map(|phase| PhaseStatus {
            locked: phase.locked(),
            error_ns: self.phase_error,
            drift_ppm: phase.drift_ppm(),
        });
        snapshot.inputs_fresh = self.answer.inputs_fresh;
        snapshot.al_status = self.answer.al_status;
        for (to, slot) in snapshot.axes.iter_mut().zip(&self.axes) {
            *to = slot.axis.status();
        }
        for (to, slot) in snapshot.feeds.iter_mut().zip(&self.axes) {
            *to = slot.feed.state();
        }
        snapshot.finished = self.finished;
        snapshot.inputs.copy_from_slice(&self.inputs);
        for (to, diagnosis) in snapshot.diagnoses.iter_mut().zip(self.exchange.diagnoses()) {
            *to = *diagnosis;
        }
        snapshot.stopping = self.stopping.map(|(cause, _)| cause);
        snapshot.stopped = stopped;
        snapshot.events_lost = self.events_lost;
        snapshot.orders_taken = self.orders_taken;
        self.end.snapshots.publish();
    }

    /// A cycle that is already over is left out instead of sent in a burst.
    fn plan_next(&mut self, adjust: i64) {
        self.next = (self.next + self.timing.cycle_ns).saturating_add_signed(adjust);
        let now = clock::now();
        if now > self.next {
            let missed = (now - self.next) / self.timing.cycle_ns + 1;
            self.stats.counters.overruns += missed;
            self.next += missed * self.timing.cycle_ns;
        }
    }

    fn report(&mut self, event: Event) {
        if self.end.events.push(event).is_err() {
            self.events_lost += 1;
        }
    }
}

/// Whether a drive in this state can move its axis.
#[must_use]
pub fn has_power(state: State) -> bool {
    matches!(
        state,
        State::OperationEnabled | State::QuickStopActive | State::FaultReactionActive
    )
}

/// The snapshot before the first cycle, with room for `axes` and `devices`.
#[must_use]
#[allow(
    clippy::disallowed_methods,
    clippy::disallowed_macros,
    reason = "prepares"
)]
pub fn first_snapshot(axes: &[AxisSlot], signals: &Signals, devices: usize) -> Snapshot {
    Snapshot {
        time: clock::now(),
        counters: super::stats::Counters::default(),
        phase: None,
        inputs_fresh: false,
        al_status: None,
        axes: axes.iter().map(|slot| slot.axis.status()).collect(),
        feeds: vec![FeedState::None; axes.len()],
        inputs: vec![0.0; signals.inputs.len()],
        finished: false,
        diagnoses: vec![super::exchange::Diagnosis::default(); devices],
        stopping: None,
        stopped: false,
        events_lost: 0,
        orders_taken: 0,
    }
}
