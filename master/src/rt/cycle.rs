//! One turn of the loop: wake, send, receive, check, step, publish.

use std::panic::AssertUnwindSafe;

use ecaxis_axis::setpoint::Table;

use super::controller::{self, Controller};
use super::exchange::{Answer, Diagnosis, Evidence, Exchange, Window};
use super::feed::FeedState;
use super::groups::{Group, GroupStatus};
use super::guard::{Guard, StopCause};
use super::handover::{Event, PhaseStatus, RtEnd, Snapshot};
use super::heartbeat;
use super::history::{self, History};
use super::image::SignalBits;
use super::journal::Note;
use super::margin::{Margin, Spin};
use super::phase::Phase;
use super::slot::AxisSlot;
use super::stats::Stats;

mod act;
mod orders;
mod panic;
mod wire;

use panic::Plain;

use crate::clock::{self, Clock, Nanos};
use crate::config::{Condition, StopSetup};
use crate::link::port::Port;
use crate::link::{Link, MAX_FRAME};

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
    /// A clock farther from the reference is told of.
    pub clock_window_ns: u64,
    /// Before the release; the rest is slept.
    pub spin: Spin,
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
    /// The first is the machine's: what no other holds.
    groups: Vec<Group>,
    signals: Signals,
    /// Each of the last cycle in which its group's were fresh.
    inputs: Vec<f64>,
    controller: Option<Box<dyn Controller>>,
    /// The controller has; it is not called again.
    panicked: bool,
    tables: Box<[Table]>,
    stop_setup: StopSetup,
    finished: bool,
    phase: Option<Phase>,
    phase_error: i64,
    /// As last noted.
    al_status: Option<(u8, u16)>,
    /// Of each SubDevice, whether its clock has been told of.
    clocks_off: Vec<bool>,
    guard: Guard,
    guarding: bool,
    supervisor: heartbeat::Watch,
    stats: Stats,
    history: History,
    end: RtEnd,
    next: Nanos,
    /// When the last frames went; `None`: none yet.
    woke: Option<Nanos>,
    started: Nanos,
    margin: Margin,
    plain: Plain,
    answer: Answer,
    events_lost: u64,
    orders_taken: u64,
    /// Frames of other MainDevices so far.
    main_devices: u64,
    /// The next window of the error counters begins then.
    window: Nanos,
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
    /// At least one.
    pub groups: Vec<Group>,
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
    /// Spinning before a release, at the end.
    pub spin_ns: Nanos,
    /// What the diagnostic slot has found, in the order of the exchange's members.
    pub diagnoses: Vec<Diagnosis>,
    /// Of their error counters, around the stop.
    pub windows: Vec<Window>,
    /// The first cycle was due then.
    pub started: Nanos,
    /// The cycles around the stop.
    pub history: History,
    /// Since when each group has been stopping.
    pub stops: Vec<Option<Nanos>>,
}

impl Engine {
    /// The first cycle is due one cycle from now.
    #[must_use]
    #[allow(clippy::disallowed_macros, reason = "prepares")]
    pub fn new(parts: Parts) -> Self {
        let started = clock::now() + parts.timing.cycle_ns;
        let clocks_off = vec![false; parts.exchange.diagnoses().len()];
        let mode = parts.exchange.mode();
        let history = History::new(parts.axes.len());
        Self {
            plain: Plain::new(&parts.axes),
            clock: parts.clock,
            timing: parts.timing,
            main_devices: parts.link.main_devices(),
            window: started + history::COUNTER_WINDOW,
            link: parts.link,
            port: parts.port,
            exchange: parts.exchange,
            axes: parts.axes,
            groups: parts.groups,
            inputs: vec![0.0; parts.signals.inputs.len()],
            signals: parts.signals,
            controller: parts.controller,
            panicked: false,
            tables: parts.tables,
            stop_setup: parts.stop,
            finished: false,
            phase: parts.phase,
            phase_error: 0,
            al_status: None,
            clocks_off,
            guard: parts.guard,
            guarding: false,
            supervisor: heartbeat::Watch::default(),
            stats: Stats::default(),
            history,
            end: parts.end,
            next: started,
            woke: None,
            started,
            margin: Margin::new(parts.timing.spin, parts.timing.cycle_ns, mode),
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

    /// Measures from here on. The time that this takes is not counted as an overrun.
    pub fn measure_anew(&mut self) {
        self.stats.clear();
        let now = clock::now();
        while self.next <= now {
            self.next += self.timing.cycle_ns;
        }
    }

    #[must_use]
    #[allow(clippy::disallowed_methods, reason = "the loop has ended")]
    pub fn into_remains(self) -> Remains {
        Remains {
            link: self.link,
            port: self.port,
            axes: self.axes,
            stats: self.stats,
            spin_ns: self.margin.get(),
            diagnoses: self.exchange.diagnoses().to_vec(),
            windows: self.exchange.windows().to_vec(),
            started: self.started,
            history: self.history,
            stops: self
                .groups
                .iter()
                .map(|group| group.stop().map(|stop| stop.since))
                .collect(),
        }
    }

    fn turn(&mut self) {
        let slept = self.clock.sleep_until(self.next, self.margin.get());
        let woke = clock::now();
        let lateness = woke.saturating_sub(self.next);
        self.stats.lateness.record(lateness);
        self.stats.counters.cycles += 1;
        if self.guarding && lateness > self.timing.cycle_ns / 4 {
            self.jot(Note::WokeLate(lateness));
        }

        self.catch_up(woke);
        self.send(lateness);
        self.margin.slept(slept);
        if let Some(late) = slept {
            self.stats.slept.record(late);
        }
        self.receive(woke);
        self.answer = self.exchange.answer();
        self.count();
        let adjust = self.follow_clock();
        if self.guarding {
            self.watch_bus();
            let heartbeat = &self.end.heartbeat;
            if self.supervisor.is_silent(heartbeat, self.timing.cycle_ns) {
                self.stop(None, StopCause::Unsupervised);
            }
        }

        self.observe();
        self.release();
        self.take_orders();
        self.call_controller();
        self.act();
        self.exchange.stage();
        self.publish(woke, lateness);
        self.plan_next(adjust);
        self.stats.work.record(clock::now().saturating_sub(woke));
    }

    fn watch_bus(&mut self) {
        let (shares, evidence) = (self.exchange.shares(), self.exchange.evidence());
        self.guard.look(&self.answer, shares, evidence);
        for group in 0..self.groups.len() {
            if let Some(cause) = self.guard.lost(group) {
                self.stop(Some(group), cause);
            }
        }
        if let Some(cause) = self.guard.left_op() {
            self.stop(None, cause);
        }
    }

    fn observe(&mut self) {
        let dt = self.timing.cycle_ns as f64 * 1e-9;
        let image = self.exchange.inputs();
        for slot in &mut self.axes {
            let evidence = self.exchange.evidence().get(slot.device);
            let fresh = evidence == Some(&Evidence::Fresh);
            if fresh {
                slot.heard = Some(self.next);
            }
            let inputs = slot.read(image, fresh, self.exchange.came_late(slot.device));
            slot.axis.observe(&inputs, dt);
            slot.acted = false;
        }
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
            self.stop(None, StopCause::EmergencyStop);
        }
    }

    /// The user's own code. What it has done when it panics is kept: the axes guard themselves.
    fn call_controller(&mut self) {
        let Some(controller) = self.controller.as_mut().filter(|_| !self.panicked) else {
            return;
        };
        let mut view = controller::Cycle {
            number: self.stats.counters.cycles,
            dt_s: self.timing.cycle_ns as f64 * 1e-9,
            fresh: self.answer.inputs_fresh,
            guarded: self.guarding,
            axes: &mut self.axes,
            groups: &mut self.groups,
            inputs: &self.inputs,
            signals: &self.signals,
            outputs: self.exchange.outputs_mut(),
            finished: &mut self.finished,
        };
        let call = AssertUnwindSafe(|| controller.cycle(&mut view));
        if std::panic::catch_unwind(call).is_err() {
            // Dropped when the loop has ended: that may free, and panic again.
            self.panicked = true;
            self.stop(None, StopCause::Controller);
        }
    }

    /// To those beside the cycle, and to the history.
    fn publish(&mut self, woke: Nanos, lateness: Nanos) {
        if self.next >= self.window {
            self.window = self.next + history::COUNTER_WINDOW;
            self.exchange.begin_windows();
        }
        let stopping = self.stopping();
        let stop_ended = stopping.is_some() && self.stop_ended();
        let mut stops = self.groups.iter().filter_map(Group::stop);
        let failure = stops.find_map(|stop| stop.failure);
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
        snapshot.stopping = stopping.map(|stop| stop.cause);
        snapshot.failure = failure;
        snapshot.stop_ended = stop_ended;
        let groups = self.groups.iter().zip(self.exchange.shares());
        for (to, (group, share)) in snapshot.groups.iter_mut().zip(groups) {
            *to = GroupStatus {
                stopped: group.stop().map(|stop| stop.cause),
                stops: group.stops,
                fresh: share.fresh,
                powered: false,
            };
        }
        for (slot, status) in self.axes.iter().zip(&snapshot.axes) {
            if let Some(group) = snapshot.groups.get_mut(slot.group) {
                group.powered |= status.state.has_power();
            }
        }
        snapshot.events_lost = self.events_lost;
        snapshot.orders_taken = self.orders_taken;
        let number = self.stats.counters.cycles;
        let cycle =
            history::Cycle::new(number, self.next, lateness, &self.answer, self.phase_error);
        self.history.keep(cycle, snapshot.axes.iter());
        self.end.snapshots.publish();
    }

    /// A cycle that is already over is left out instead of sent in a burst.
    fn plan_next(&mut self, adjust: i64) {
        self.next = (self.next + self.timing.cycle_ns).saturating_add_signed(adjust);
        let now = clock::now();
        if now > self.next {
            let missed = (now - self.next) / self.timing.cycle_ns + 1;
            self.stats.counters.overruns += missed;
            self.jot(Note::Overrun(missed));
            self.next += missed * self.timing.cycle_ns;
        }
    }

    fn jot(&mut self, note: Note) {
        let cycle = self.stats.counters.cycles;
        self.stats.journal.note(cycle, self.next, note);
    }

    fn report(&mut self, event: Event) {
        self.jot(Note::Told(event));
        if self.end.events.push(event).is_err() {
            self.events_lost += 1;
        }
    }
}

/// The snapshot before the first cycle, with room for all there is.
#[must_use]
#[allow(
    clippy::disallowed_methods,
    clippy::disallowed_macros,
    reason = "prepares"
)]
pub fn first_snapshot(
    axes: &[AxisSlot],
    groups: usize,
    signals: &Signals,
    devices: usize,
) -> Snapshot {
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
        diagnoses: vec![Diagnosis::default(); devices],
        stopping: None,
        failure: None,
        stop_ended: false,
        groups: vec![GroupStatus::default(); groups],
        events_lost: 0,
        orders_taken: 0,
    }
}
