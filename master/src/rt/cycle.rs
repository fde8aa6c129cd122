//! One cycle: wake, send, receive, check, step, publish.

use std::panic::AssertUnwindSafe;

use ecaxis_axis::setpoint::Table;
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, GroupIndex, IndexVec, LineShaftIndex};

use super::axis::RtAxis;
use super::bus_monitor::{BusMonitor, StopCause};
use super::channel::{Event, PhaseStatus, RtEndpoint, Snapshot};
use super::common_time::{CommonTime, CommonTimeStatus};
use super::config::{Condition, RtConfig};
use super::controller::{self, Controller};
use super::event_log::LogEntryKind;
use super::exchange::{CycleResult, DeviceAnswer, Exchange, SubDeviceDiagnostics, Window};
use super::flight_recorder::{self, FlightRecorder};
use super::gantry::Gantry;
use super::gateway::{Gateway, NodeState};
use super::heartbeat;
use super::image::SignalBits;
use super::line_shaft::{self, AxisSetpoints, LineShaftStatus, RtLineShaft};
use super::overrides::Overrides;
use super::phase::Phase;
use super::position_output::PositionOutput;
use super::reaction_group::{GroupStatus, ReactionGroup};
use super::samples::{CycleSample, SampleWriter, flags};
use super::setpoint_cell::SetpointCells;
use super::setpoint_generator::GeneratorState;
use super::spin::SpinWindow;
use super::stats::Stats;

mod axes;
mod commands;
mod io;
mod panic;
mod rates;
mod start;

use panic::Plain;
use start::DeferredCommands;
pub use start::{DropCause, StartState};

use crate::clock::{self, Clock, Nanos};
use crate::link::pdu_loop::PduLoop;
use crate::link::{Link, MAX_FRAME};

/// The process data that the program reads and sets.
#[derive(Debug, Clone, Default)]
pub struct Signals {
    pub inputs: Vec<SignalBits>,
    pub outputs: Vec<SignalBits>,
    pub positions: Vec<PositionOutput>,
}

/// The state of the cycle.
#[derive(Debug)]
pub struct Engine {
    clock: Clock,
    config: RtConfig,
    link: Box<dyn Link>,
    port: PduLoop,
    /// Answers that ethercrab rejected before the cycle started: the bring-up has repeated them.
    refused_before: u64,
    exchange: Exchange,
    axes: IndexVec<AxisIndex, RtAxis>,
    gateways: Box<[Gateway]>,
    gantries: Box<[Gantry]>,
    /// The first group is the machine's: all axes without a group.
    groups: IndexVec<GroupIndex, ReactionGroup>,
    overrides: Overrides,
    signals: Signals,
    /// Each value is from the last cycle in which its group was fresh.
    inputs: Vec<f64>,
    controller: Option<Box<dyn Controller>>,
    /// The controller panicked and is no longer called.
    panicked: bool,
    tables: Box<[Table]>,
    line_shafts: IndexVec<LineShaftIndex, RtLineShaft>,
    /// The set-points of the axes for other machines; empty: none need them.
    setpoints: Box<[AxisSetpoints]>,
    /// The common time at which the set-points of this cycle take effect, if it is locked.
    effect_at: Option<u64>,
    finished: bool,
    phase: Option<Phase>,
    common: CommonTime,
    deferred: DeferredCommands,
    phase_error: i64,
    /// The reference clock as last reported.
    reference: Option<DeviceIndex>,
    /// The AL status as last logged.
    al_status: Option<(u8, u16)>,
    /// For each SubDevice, true while its clock is reported as off.
    clocks_off: IndexVec<DeviceIndex, bool>,
    guard: BusMonitor,
    guarding: bool,
    /// Wake-ups later than a quarter of the cycle.
    late_wake_ups: u64,
    supervisor: heartbeat::Watch,
    stats: Stats,
    history: FlightRecorder,
    end: RtEndpoint,
    next: Nanos,
    /// The time at which the last frames were sent; `None` before the first.
    woke: Option<Nanos>,
    started: Nanos,
    margin: SpinWindow,
    plain: Plain,
    samples: Option<SampleWriter>,
    answer: CycleResult,
    /// The time from the planned release to the last answer of this cycle.
    round_trip: Option<Nanos>,
    /// The duration of the last cycle's work.
    work: Nanos,
    events_lost: u64,
    commands_taken: u64,
    /// Frames of other MainDevices so far.
    main_devices: u64,
    /// The start of the next window of the error counters.
    window: Nanos,
    halted: bool,
    buf: [u8; MAX_FRAME],
}

/// The parts of an engine.
#[derive(Debug)]
pub struct EngineConfig {
    pub clock: Clock,
    pub config: RtConfig,
    pub link: Box<dyn Link>,
    pub port: PduLoop,
    pub exchange: Exchange,
    pub axes: IndexVec<AxisIndex, RtAxis>,
    pub gateways: Box<[Gateway]>,
    pub signals: Signals,
    pub controller: Option<Box<dyn Controller>>,
    pub samples: Option<SampleWriter>,
    pub tables: Box<[Table]>,
    pub setpoints: SetpointCells,
    pub phase: Option<Phase>,
    pub common: CommonTime,
    pub end: RtEndpoint,
}

/// The results after the end of the loop.
#[derive(Debug)]
pub struct EngineReport {
    pub link: Box<dyn Link>,
    pub port: PduLoop,
    pub axes: IndexVec<AxisIndex, RtAxis>,
    pub gateways: Box<[Gateway]>,
    pub stats: Stats,
    /// The spin time before a release, at the end of the run.
    pub spin_ns: Nanos,
    /// The results of the diagnostic slot.
    pub diagnoses: IndexVec<DeviceIndex, SubDeviceDiagnostics>,
    /// The error counters of the members around the stop.
    pub windows: IndexVec<DeviceIndex, Window>,
    /// Due time of the first cycle.
    pub started: Nanos,
    /// The cycles around the stop.
    pub history: FlightRecorder,
    /// For each group, the time since which it has been stopping.
    pub stops: IndexVec<GroupIndex, Option<Nanos>>,
}

impl Engine {
    /// Creates an engine. The first cycle is due one cycle from now.
    #[must_use]
    #[allow(
        clippy::disallowed_methods,
        clippy::disallowed_macros,
        reason = "runs before the loop"
    )]
    pub fn new(parts: EngineConfig) -> Self {
        let config = parts.config;
        let started = clock::now() + config.cycle_ns;
        let groups: Vec<_> = config.devices.iter().map(|device| device.group).collect();
        let clocks_off = vec![false; parts.exchange.diagnoses().len()].into();
        let mode = parts.exchange.mode();
        let history = FlightRecorder::new(parts.axes.len());
        let slowest_s = { parts.axes.iter() }
            .map(|slot| slot.dt_s(config.cycle_ns))
            .fold(0.0, f64::max);
        Self {
            plain: Plain::new(&parts.axes),
            clock: parts.clock,
            main_devices: parts.link.main_devices(),
            window: started + flight_recorder::COUNTER_WINDOW,
            link: parts.link,
            refused_before: parts.port.refused,
            port: parts.port,
            axes: parts.axes,
            gateways: parts.gateways,
            gantries: config.gantries.iter().copied().map(Gantry::new).collect(),
            groups: config
                .groups
                .iter()
                .copied()
                .map(ReactionGroup::new)
                .collect(),
            inputs: vec![0.0; parts.signals.inputs.len()],
            signals: parts.signals,
            controller: parts.controller,
            panicked: false,
            tables: parts.tables,
            line_shafts: line_shaft::shafts(&config.line_shafts, &parts.setpoints, slowest_s),
            setpoints: line_shaft::axis_setpoints(&parts.setpoints),
            effect_at: None,
            finished: false,
            phase: parts.phase,
            common: parts.common,
            deferred: DeferredCommands::new(),
            phase_error: 0,
            reference: parts.exchange.reference(),
            exchange: parts.exchange,
            al_status: None,
            clocks_off,
            guard: BusMonitor::new(config.lost_frames, &groups),
            guarding: false,
            overrides: Overrides::new(config.overrides.clone(), config.groups.len()),
            late_wake_ups: 0,
            supervisor: heartbeat::Watch::default(),
            stats: Stats::default(),
            history,
            end: parts.end,
            next: started,
            woke: None,
            started,
            margin: SpinWindow::new(config.spin, config.cycle_ns, mode),
            config,
            samples: parts.samples,
            answer: CycleResult::default(),
            round_trip: None,
            work: 0,
            events_lost: 0,
            commands_taken: 0,
            halted: false,
            buf: [0; MAX_FRAME],
        }
    }

    /// True once [`RtCommand::Halt`](super::channel::RtCommand::Halt) was processed.
    #[must_use]
    pub fn halted(&self) -> bool {
        self.halted
    }

    /// Restarts the statistics. The time that this takes is not counted as an overrun.
    pub fn reset_statistics(&mut self) {
        self.stats.clear();
        let now = clock::now();
        while self.next <= now {
            self.next += self.config.cycle_ns;
        }
    }

    #[must_use]
    #[allow(clippy::disallowed_methods, reason = "the loop has ended")]
    pub fn finish(self) -> EngineReport {
        EngineReport {
            link: self.link,
            port: self.port,
            axes: self.axes,
            gateways: self.gateways,
            stats: self.stats,
            spin_ns: self.margin.get(),
            diagnoses: self.exchange.diagnoses().clone(),
            windows: self.exchange.windows().clone(),
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
        let is_late = lateness > self.config.cycle_ns / 4;
        self.late_wake_ups += u64::from(is_late);
        if self.guarding && is_late {
            self.log(LogEntryKind::WokeLate(lateness));
        }

        self.handle_skipped_cycles(woke);
        self.send(lateness);
        self.margin.record_wakeup(slept);
        if let Some(late) = slept {
            self.stats.slept.record(late);
        }
        self.receive(woke);
        self.answer = self.exchange.evaluate();
        self.update_counters();
        let adjust = self.follow_clock();
        self.follow_common_time();
        if self.guarding {
            self.watch_bus();
            let heartbeat = &self.end.heartbeat;
            if self.supervisor.is_silent(heartbeat, self.config.cycle_ns) {
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
        self.schedule_next_cycle(adjust);
        self.work = clock::now().saturating_sub(woke);
        self.stats.work.record(self.work);
    }

    fn watch_bus(&mut self) {
        let (groups, devices) = (
            self.exchange.group_results(),
            self.exchange.device_answers(),
        );
        // A requested stop excuses no device.
        let stopped =
            |group: &ReactionGroup| group.stop().is_some_and(|stop| stop.cause.is_failure());
        let any_stopped = self.groups.iter().any(stopped);
        if let Some((device, answered)) = self.exchange.al_status_read() {
            self.guard.take_read(device, answered);
        }
        self.guard
            .update(&self.answer, groups, devices, any_stopped);
        let each = self.guard.judges_each();
        if each {
            let groups = &self.groups;
            self.guard.update_each(
                |group| groups.get(group).is_some_and(stopped),
                (self.exchange.diagnoses().iter()).map(SubDeviceDiagnostics::current_al_status),
            );
        }
        self.exchange.poll_al_status(self.guard.al_status_polls());
        let groups = &self.groups;
        if let Some((_, answering)) = self.answer.al_status {
            self.exchange
                .publish_presence(answering, |group| groups.get(group).is_some_and(stopped));
        }
        if any_stopped {
            self.take_restarts();
        }
        for group in self.groups.indices() {
            if let Some(cause) = self.guard.lost(group) {
                self.stop(Some(group), cause);
            }
        }
        if let Some(cause) = self.guard.left_op() {
            self.stop(None, cause);
        }
        self.lock_outputs();
    }

    /// Locks the outputs of the devices that are lost, until the reset of their group. RT: O(devices)
    /// while a group is stopped.
    fn lock_outputs(&mut self) {
        for (index, group) in self.groups.enumerate() {
            if group.stop().is_none() {
                continue;
            }
            let group_lost = self.guard.lost(index).is_some();
            for device in self.guard.devices_of(index) {
                let fresh =
                    self.exchange.device_answers().get(device) == Some(&DeviceAnswer::Fresh);
                if self.guard.device_lost(device) || group_lost && !fresh {
                    self.exchange.lock_outputs(device);
                }
            }
        }
    }

    fn observe(&mut self) {
        self.observe_gateways();
        let image = self.exchange.inputs();
        for slot in &mut self.axes {
            let answer = self.exchange.device_answers().get(slot.device);
            let (due, reachable) = slot.node.map_or((true, true), |at| {
                let gateway = self.gateways.get(at.gateway);
                gateway.map_or((true, false), |gateway| {
                    let state = gateway.state(at.node);
                    let exchanges = state == NodeState::Operational || gateway.has_ended();
                    (gateway.is_due(), exchanges)
                })
            });
            // A gateway that restarts has no data of its nodes yet.
            let reported = slot.node.is_none() || slot.bits.statusword.get(image) != 0;
            let fresh = reachable && answer == Some(&DeviceAnswer::Fresh);
            if fresh {
                slot.heard = Some(self.next);
            }
            slot.arrived.0 |= fresh;
            slot.arrived.1 = slot.arrived.1.max(self.exchange.delivery(slot.device));
            slot.acted = !due;
            if due {
                let (fresh, delivery) = std::mem::take(&mut slot.arrived);
                let mut inputs = slot.read(image, fresh && reported, delivery);
                inputs.second_position = slot.second_encoder.and_then(|(bits, device)| {
                    let answer = self.exchange.device_answers().get(device);
                    let fresh = answer == Some(&DeviceAnswer::Fresh);
                    fresh.then(|| bits.get(image) as i64 as i32)
                });
                slot.axis.observe(&inputs, slot.dt_s(self.config.cycle_ns));
            }
        }
        for (to, signal) in self.inputs.iter_mut().zip(&self.signals.inputs) {
            *to = signal.get(image);
        }
        if self.guarding {
            self.overrides.read(&self.inputs);
        }
        let inputs = &self.inputs;
        // A missing or NaN input counts as an active emergency stop.
        let pressed = |c: &Condition| {
            inputs
                .get(c.input.0)
                .is_none_or(|n| n.is_nan() || c.bounds.holds(*n))
        };
        if self.guarding && self.config.emergency.iter().any(pressed) {
            self.stop(None, StopCause::EmergencyStop);
        }
    }

    /// Calls the user's controller. Its commands before a panic stay in force: the axes supervise
    /// themselves.
    fn call_controller(&mut self) {
        let Some(controller) = self.controller.as_mut().filter(|_| !self.panicked) else {
            return;
        };
        let mut view = controller::CycleContext {
            number: self.stats.counters.cycles,
            dt_s: self.config.cycle_ns as f64 * 1e-9,
            fresh: self.answer.inputs_fresh,
            guarded: self.guarding,
            axes: &mut self.axes,
            gantries: &mut self.gantries,
            groups: &mut self.groups,
            overrides: &self.overrides,
            inputs: &self.inputs,
            signals: &self.signals,
            outputs: self.exchange.outputs_mut(),
            finished: &mut self.finished,
        };
        let call = AssertUnwindSafe(|| controller.cycle(&mut view));
        if std::panic::catch_unwind(call).is_err() {
            // Dropped after the loop: the drop may free memory and panic again.
            self.panicked = true;
            self.stop(None, StopCause::Controller);
        }
    }

    /// Publishes the snapshot to the other threads and records the cycle.
    fn publish(&mut self, woke: Nanos, lateness: Nanos) {
        if self.next >= self.window {
            self.window = self.next + flight_recorder::COUNTER_WINDOW;
            self.exchange.begin_windows();
        }
        self.publish_setpoints();
        let stopping = self.stopping();
        let stop_ended = stopping.is_some() && self.stop_ended();
        let mut stops = self.groups.iter().filter_map(ReactionGroup::stop);
        let failure = stops.find_map(|stop| stop.failure);
        let snapshot = self.end.snapshots.input_buffer_mut();
        snapshot.time = woke;
        snapshot.counters = self.stats.counters;
        snapshot.phase = self.phase.as_ref().map(|phase| PhaseStatus {
            reference: self.exchange.reference(),
            locked: phase.locked(),
            error_ns: self.phase_error,
            drift_ppm: phase.drift_ppm(),
        });
        snapshot.common_time = self.common.status();
        snapshot.start = self.deferred.state;
        snapshot.inputs_fresh = self.answer.inputs_fresh;
        snapshot.al_status = self.answer.al_status;
        for (to, slot) in snapshot.axes.iter_mut().zip(&self.axes) {
            *to = slot.axis.status();
        }
        for gantry in &self.gantries {
            gantry.publish(&mut snapshot.axes);
        }
        for (to, slot) in snapshot.nodes.iter_mut().zip(&self.axes) {
            let node = slot
                .node
                .and_then(|at| Some((self.gateways.get(at.gateway)?, at.node)));
            *to = node.map(|(gateway, node)| gateway.state(node));
        }
        for (to, slot) in snapshot.generators.iter_mut().zip(&self.axes) {
            *to = slot.generator.state();
        }
        for (to, slot) in snapshot.line_shafts.iter_mut().zip(&self.line_shafts) {
            *to = LineShaftStatus::new(&slot.shaft, self.effect_at);
        }
        snapshot.late_wake_ups = self.late_wake_ups;
        snapshot.finished = self.finished;
        snapshot.inputs.copy_from_slice(&self.inputs);
        let locked = self.exchange.locked().iter();
        for (to, locked) in snapshot.locked_outputs.iter_mut().zip(locked) {
            *to = *locked;
        }
        for (to, diagnosis) in snapshot.diagnoses.iter_mut().zip(self.exchange.diagnoses()) {
            *to = *diagnosis;
        }
        snapshot.stopping = stopping.map(|stop| stop.cause);
        snapshot.failure = failure;
        snapshot.stop_ended = stop_ended;
        let groups = self.groups.iter().zip(self.exchange.group_results());
        for (to, (group, result)) in snapshot.groups.iter_mut().zip(groups) {
            *to = GroupStatus {
                stopped: group.stop().map(|stop| stop.cause),
                stops: group.stops,
                fresh: result.fresh,
                powered: false,
                rate: Default::default(),
            };
        }
        for (group, to) in snapshot.groups.enumerate_mut() {
            to.rate = self.overrides.of(group);
        }
        for (slot, status) in self.axes.iter().zip(&snapshot.axes) {
            if let Some(group) = snapshot.groups.get_mut(slot.group) {
                group.powered |= status.state.has_power();
            }
        }
        snapshot.events_lost = self.events_lost;
        snapshot.gateways_ended = self.gateways.iter().all(Gateway::has_ended);
        snapshot.commands_taken = self.commands_taken;
        let number = self.stats.counters.cycles;
        let cycle = flight_recorder::Cycle::new(
            number,
            self.next,
            lateness,
            &self.answer,
            self.phase_error,
        );
        self.history.keep(cycle, snapshot.axes.iter());
        if let Some(samples) = &mut self.samples {
            let locked = snapshot.phase.is_some_and(|phase| phase.locked);
            let bits = [
                (flags::FRESH, snapshot.inputs_fresh),
                (flags::IN_OP, self.guarding),
                (flags::STOPPING, snapshot.stopping.is_some()),
                (flags::PHASE_LOCKED, locked),
            ];
            let sample = CycleSample {
                time: woke,
                number,
                flags: bits.iter().map(|(bit, set)| bit * u64::from(*set)).sum(),
                wake_up: lateness,
                exchange: self.round_trip,
                phase_error: snapshot.phase.map(|phase| phase.error_ns),
                work: self.work,
                next: self.next + self.config.cycle_ns,
            };
            let (axes, inputs) = (&snapshot.axes, &snapshot.inputs);
            samples.write(&sample, axes, inputs, &snapshot.line_shafts);
        }
        self.end.snapshots.publish();
    }

    /// Schedules the next cycle. Cycles already over are skipped, not sent in a burst.
    fn schedule_next_cycle(&mut self, adjust: i64) {
        self.next = (self.next + self.config.cycle_ns).saturating_add_signed(adjust);
        let now = clock::now();
        if now > self.next {
            let missed = (now - self.next) / self.config.cycle_ns + 1;
            self.stats.counters.overruns += missed;
            self.log(LogEntryKind::Overrun(missed));
            let drift = self.phase.as_ref().map_or(0, Phase::holdover);
            self.next += missed * self.config.cycle_ns.saturating_add_signed(drift);
        }
    }

    fn log(&mut self, note: LogEntryKind) {
        let cycle = self.stats.counters.cycles;
        self.stats.journal.note(cycle, self.next, note);
    }

    fn report(&mut self, event: Event) {
        self.log(LogEntryKind::Event(event));
        if self.end.events.push(event).is_err() {
            self.events_lost += 1;
        }
    }
}

/// Returns the snapshot before the first cycle, with capacity for all values.
#[must_use]
#[allow(
    clippy::disallowed_methods,
    clippy::disallowed_macros,
    reason = "runs before the loop"
)]
pub fn first_snapshot(
    axes: &[RtAxis],
    (groups, line_shafts): (usize, usize),
    signals: &Signals,
    devices: usize,
) -> Snapshot {
    Snapshot {
        time: clock::now(),
        counters: super::stats::Counters::default(),
        phase: None,
        common_time: CommonTimeStatus::default(),
        start: StartState::None,
        inputs_fresh: false,
        al_status: None,
        axes: axes.iter().map(|slot| slot.axis.status()).collect(),
        nodes: vec![None; axes.len()].into(),
        generators: vec![GeneratorState::None; axes.len()].into(),
        line_shafts: vec![LineShaftStatus::default(); line_shafts].into(),
        inputs: vec![0.0; signals.inputs.len()],
        late_wake_ups: 0,
        finished: false,
        diagnoses: vec![SubDeviceDiagnostics::default(); devices].into(),
        locked_outputs: vec![false; devices].into(),
        stopping: None,
        failure: None,
        stop_ended: false,
        groups: vec![GroupStatus::default(); groups].into(),
        events_lost: 0,
        gateways_ended: false,
        commands_taken: 0,
    }
}
