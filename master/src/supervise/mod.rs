//! Everything outside the cycle while the machine runs: the way to Op and back, enabling, the steps
//! of the program, and the error after a stop. MAY BLOCK AND ALLOCATE; communicates with the cycle
//! only through `rt::channel`.

use std::collections::{BTreeSet, VecDeque};
use std::convert::Infallible;
use std::future::poll_fn;
use std::pin::pin;
use std::sync::Arc;
use std::sync::mpsc::Sender;
use std::time::Duration;

use ecaxis_axis::CommandError;
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, IndexVec};
use ecaxis_ecat::registers;
use tokio::sync::{Mutex, watch};

use crate::acyclic::{AlState, DeviceRef, Transition, al};
use crate::bringup::{Bus, BusDevice, RingDelays, enable_op_only};
use crate::cancel::CancelToken;
use crate::clock::{self, Nanos};
use crate::config::Machine;
use crate::config::steps::enables;
use crate::datagram::{CyclicMailboxTransport, DatagramClient};
use crate::eoe::Ethernet;
use crate::link::sim::SimInputSender;
use crate::mailbox::worker::{MailboxWorker, run_with_workers};
use crate::mailbox::{DatagramError, MailboxTransport, Mailboxes};
use crate::mailbox_gateway::LivePublisher;
use crate::post_mortem::Witnessed;
use crate::report::events::{clock_off, common_time_jumped, reference_replaced};
use crate::report::{
    Cause, DeviceLog, EmergencyLog, Error, GroupStop, ProbeCapture, Progress, Status,
};
use crate::rt::bus_monitor::StopCause;
use crate::rt::channel::{COMMANDS_PER_CYCLE, Event, HostEndpoint, RtCommand, Snapshot};
use crate::rt::exchange::{BusStatus, DiagnosticRegister, SubDeviceDiagnostics};
use clock_tree::ClockTree;
use common_start::AlignmentWait;
pub(crate) use common_start::CommonStart;
pub use common_start::MAX_START_DELAY;
use failure_reader::InquiryPort;
use groups::{InquiredStop, StoppedGroup};
pub(crate) use limits::{MissedTargets, ReportedLimits};
pub(crate) use program::Buttons;
pub use program::ProgramControl;
use returns::ReturnPort;
pub(crate) use ring::RingWatch;
use sercos::ResetQueue;

mod clock_tree;
mod common_start;
mod coordinated;
pub(crate) mod diagnosis_history;
mod explain;
mod failure_reader;
mod groups;
mod limits;
pub mod operator;
mod program;
mod returns;
mod ring;
pub(crate) mod sercos;
mod shut_down;

/// The period at which the supervisor reads the cycle's snapshot.
const TICK: Duration = Duration::from_millis(1);
/// The number of cycles before Op is requested.
const FIRST_CYCLES: u64 = 20;
/// The maximum number of refused commands that wait for processing.
const REFUSALS: usize = 256;
/// The time in ns after which devices on their way to a state are read one by one.
const BROADCAST_WAIT: Nanos = 100_000_000;
const STATUS_PERIOD: Nanos = 200_000_000;

/// Drives a machine from SafeOp through its program and back to Init.
#[derive(Debug)]
pub struct Supervisor {
    pub machine: Arc<Machine>,
    pub bus: Bus,
    pub wire: DatagramClient,
    /// Mailbox access to the devices. [`Supervisor::run`] runs the workers that perform the
    /// transfers.
    pub mailboxes: Mailboxes,
    pub workers: Vec<MailboxWorker<CyclicMailboxTransport>>,
    /// The emergencies of the devices.
    pub log: EmergencyLog,
    pub outer: HostEndpoint,
    pub stop: Arc<CancelToken>,
    pub progress: Sender<Progress>,
    /// The number of program runs, unless the time limit ends the program first.
    pub repeat: u32,
    /// The time limit of the program. The program repeats until then.
    pub limit: Option<Nanos>,
    pub enable: bool,
    /// `true` if a controller replaces the program.
    pub controlled: bool,
    /// Switches inputs of the simulated bus. `None`: the bus is real.
    pub sim_inputs: Option<SimInputSender>,
    /// Pauses the program from outside the run.
    pub control: Arc<ProgramControl>,
    /// The inputs of `[program]`.
    pub(crate) buttons: Buttons,
    /// The instant at which the program starts, until it has.
    pub(crate) start: Option<CommonStart>,
    /// The values of the program's variables.
    pub variables: Vec<f64>,
    /// The operator that replaces the program.
    pub operator: Option<Box<dyn operator::Operator>>,
    /// The operator at work.
    pub(crate) attendance: Option<Box<operator::Attendance>>,
    /// Axes whose faults and trips the operator has seen.
    pub seen: Vec<AxisIndex>,
    /// The number of commands sent to the cycle so far.
    pub commands_sent: u64,
    /// Commands that axes refused, in order. If too many, the first ones and the last one.
    pub refused: VecDeque<(AxisIndex, CommandError)>,
    /// The probing results, one per step.
    pub captures: Vec<ProbeCapture>,
    /// The stops of groups during which the machine continued, in the order of their reports.
    pub stopped: Vec<StoppedGroup>,
    /// What has been reported of the internal limits of each axis.
    pub limited: IndexVec<AxisIndex, ReportedLimits>,
    /// The frames that did not bring a target in time.
    pub missed: MissedTargets,
    /// The time of the last status report.
    pub last_status: Nanos,
    /// The state of the bus at the failure.
    pub witnessed: Option<Witnessed>,
    /// What the delays depend on, for the task that measures them again.
    pub(crate) clock_tree: Option<watch::Sender<ClockTree>>,
    /// What the cycle shows to other threads.
    pub bus_status: Arc<BusStatus>,
    /// The devices that were lost, returned or appeared.
    pub device_log: DeviceLog,
    /// The end of the task that brings devices back.
    pub(crate) returns: Option<ReturnPort>,
    /// What was reported of the ring, with cable redundancy.
    pub(crate) ring: RingWatch,
    /// What clients of the mailbox gateway see of the cycle.
    pub(crate) mailbox_gateway: Option<LivePublisher>,
    /// The resets of Sercos drives.
    pub(crate) resets: Option<ResetQueue>,
    /// The task that reads the devices of stopped groups, and the stop that it explains.
    pub(crate) inquiries: Option<InquiryPort>,
    pub(crate) inquired: Option<InquiredStop>,
    /// The virtual switch between devices with EoE and an interface of this computer.
    pub ethernet: Ethernet,
    /// The propagation delays in the closed ring, with cable redundancy.
    pub(crate) ring_delays: Option<Arc<std::sync::Mutex<RingDelays>>>,
}

/// The result of the machine's program.
#[derive(Debug, Clone, Default)]
pub struct ProgramOutcome {
    /// The number of completed program runs.
    pub runs: u32,
    /// `true` if the user stopped the program before its end.
    pub interrupted: bool,
    /// The probing results, one per step.
    pub captures: Vec<ProbeCapture>,
    /// Groups that stopped while the machine continued.
    pub group_stops: Vec<GroupStop>,
    /// The state of the bus at the failure.
    pub witnessed: Option<Witnessed>,
    /// The error of a group that was not reset, and the state of the bus at that stop.
    pub left: Option<(Arc<Error>, Witnessed)>,
}

impl Supervisor {
    /// Runs everything outside the cycle. The cycle ends when this future ends.
    pub async fn run(mut self) -> (ProgramOutcome, Result<(), Error>) {
        let workers = std::mem::take(&mut self.workers);
        let heartbeat = self.outer.heartbeat.clone();
        let latch = Arc::<Mutex<()>>::default();
        let ethernet = self.ethernet.serve();
        // The futures are large, and nothing needs them on the stack.
        let (delays, offset, returns, resets, inquiries) = (
            Box::pin(self.keep_delays(Arc::clone(&latch))),
            Box::pin(self.keep_offset()),
            Box::pin(self.return_devices(latch)),
            Box::pin(self.open_resets().run()),
            Box::pin(self.open_inquiries().run()),
        );
        let work = async {
            let aside = async {
                tokio::join!(delays, offset, returns, resets, inquiries, ethernet);
                std::future::pending::<Infallible>().await
            };
            tokio::select! {
                // A random order would number datagrams at random.
                biased;
                done = Box::pin(self.run_inner()) => done,
                never = aside => match never {},
            }
        };
        let mut work = pin!(run_with_workers(workers, work));
        poll_fn(|context| {
            heartbeat.beat();
            work.as_mut().poll(context)
        })
        .await
    }

    async fn run_inner(mut self) -> (ProgramOutcome, Result<(), Error>) {
        let mut ended = ProgramOutcome::default();
        let stop = Arc::clone(&self.stop);
        let worked = stop.run_until_requested(self.run_to_end(&mut ended)).await;
        ended.interrupted = worked.is_none();
        ended.group_stops = self.group_stops();
        let mut result = worked.unwrap_or(Ok(()));
        // From here on devices leave Op on purpose, and none may return. No other program delays it.
        self.mailbox_gateway = None;
        (self.clock_tree, self.returns) = (None, None);
        if let Err(error) = &result {
            // The axes stop while the bus is read.
            self.send(RtCommand::Stop).await;
            self.witness(error).await;
        }
        let back = self.shut_down(result.is_err()).await;
        if result.is_ok() {
            result = back;
        }
        self.send(RtCommand::Halt).await;
        ended.captures = std::mem::take(&mut self.captures);
        ended.witnessed = self.witnessed.take();
        let left = self
            .stopped
            .into_iter()
            .find(|stop| !stop.released && !stop.idle);
        ended.left = left.map(|stop| (stop.cause, stop.witnessed));
        (ended, result)
    }

    async fn run_to_end(&mut self, ended: &mut ProgramOutcome) -> Result<(), Error> {
        let waited = clock::now();
        self.await_phase().await?;
        self.bus.times.add("phase lock", None, waited, clock::now());
        self.send(RtCommand::EnterOp).await;
        let requested = clock::now();
        for device in self.bus.devices.iter().filter(|device| device.present) {
            enable_op_only(&self.wire, device, true).await?;
        }
        self.change_to_op().await?;
        self.bus.times.add("Op", None, requested, clock::now());
        self.report(Progress::BringUpTimes(self.bus.times.steps()));
        self.report(Progress::Step(crate::bringup::Step::State(AlState::Op)));
        self.send(RtCommand::StartBusMonitor).await;
        let devices = self.bus.devices.enumerate();
        let absent = devices.filter(|(_, device)| !device.present);
        let absent: BTreeSet<_> = absent.map(|(d, _)| self.machine.group_of(d)).collect();
        for group in absent {
            self.send(RtCommand::Absent { group }).await;
        }
        if !self.enable {
            return self.hold(clock::now()).await;
        }
        if let Some(operator) = self.operator.take() {
            return self.run_operator(operator, ended).await;
        }
        if self.controlled {
            return self.follow_controller(ended).await;
        }
        if !enables(&self.machine.steps) {
            let steady = self.steady_axes();
            self.enable_axes(None, &steady).await?;
        }
        self.run_program(None, ended).await
    }

    /// Returns the axes of the devices that are always there.
    fn steady_axes(&self) -> Vec<AxisIndex> {
        let machine = &self.machine;
        let steady = |axis: &AxisIndex| !machine.devices[machine.axes[*axis].device].optional;
        machine.axes.indices().filter(steady).collect()
    }

    /// Requests Op from all devices with one datagram, and waits while the cycle's broadcast read of
    /// AL status shows no error. Otherwise, the devices are read one by one.
    async fn change_to_op(&mut self) -> Result<(), Error> {
        let op = AlState::Op;
        if let Some(gateway) = &mut self.mailbox_gateway {
            gateway.set_requested(op);
        }
        let requested = clock::now();
        let snapshot = self.poll_and_query().await?;
        // A device with an error needs an acknowledgement first.
        let broadcast = self.is_everywhere(AlState::SafeOp, &snapshot)
            && self.request_everywhere(op).await
                == Ok(snapshot.al_status.map_or(0, |(_, devices)| devices));
        if !broadcast {
            return al::change_states(&self.wire, &self.transitions_to_op(), op).await;
        }
        while clock::now().saturating_sub(requested) <= BROADCAST_WAIT {
            let snapshot = self.poll_and_query().await?;
            if self.is_everywhere(op, &snapshot) {
                return Ok(());
            }
            let failed = |(status, _)| AlState::has_error(status);
            if snapshot.al_status.is_some_and(failed) {
                break;
            }
        }
        al::wait_state_since(&self.wire, &self.transitions_to_op(), op, requested).await
    }

    /// Requests a state from all devices with one datagram, without an acknowledgement. Returns the
    /// number of devices that take it.
    async fn request_everywhere(&self, wanted: AlState) -> Result<u16, DatagramError> {
        let control = [wanted.code(), 0];
        self.wire.write_all(registers::AL_CONTROL, &control).await
    }

    fn transitions_to_op(&self) -> Vec<Transition<'_>> {
        let timeout = self.machine.bus.op_timeout_ns.map(Duration::from_nanos);
        let present = self.bus.devices.iter().filter(|device| device.present);
        let transitions = present.map(|device| {
            let own = device.transition(AlState::Op, false);
            Transition {
                timeout: timeout.unwrap_or(own.timeout),
                ..own
            }
        });
        transitions.collect()
    }

    /// True if the last broadcast read found every device in this state, without an error.
    fn is_everywhere(&self, state: AlState, snapshot: &Snapshot) -> bool {
        let lost = self.bus_status.lost().count();
        snapshot.al_status.is_some_and(|(status, devices)| {
            usize::from(devices) == self.bus.devices.len() - lost && status == state.code()
        })
    }

    /// Waits until frames are in phase with SYNC0 and all clocks are synchronized. A device may
    /// leave SafeOp only then.
    async fn await_phase(&mut self) -> Result<(), Error> {
        let start = clock::now();
        // Reading every clock takes long on a large bus with a long cycle.
        let looks = self.bus.devices.len() * DiagnosticRegister::ALL.len() * 2;
        let looks = u64::try_from(looks).unwrap_or(u64::MAX);
        let bus = &self.machine.bus;
        let looks = looks.saturating_mul(bus.cycle_ns);
        let timeout = bus.sync_timeout_ns.saturating_add(looks);
        let timeout = timeout.saturating_add(AlignmentWait::timeout(self.bus.dc.as_ref()));
        let mut alignment = AlignmentWait::new();
        loop {
            let snapshot = self.poll_and_query().await?;
            let clocks_known = self.bus.clocks_settled || self.clocks_read(&snapshot);
            let inputs_fresh = self.inputs_fresh(&snapshot);
            let looked_at_all = snapshot.counters.cycles > FIRST_CYCLES && clocks_known;
            let locked = snapshot.phase.is_none_or(|phase| phase.locked);
            let unsettled = self.unsettled_clock(&snapshot);
            let aligned = alignment.is_over(&snapshot.common_time);
            if looked_at_all && inputs_fresh && locked && aligned && unsettled.is_none() {
                if let Some(text) = AlignmentWait::warning(&snapshot.common_time) {
                    self.report(Progress::Warning(text));
                }
                if snapshot.phase.is_some() {
                    self.report(Progress::PhaseLocked);
                }
                return Ok(());
            }
            if clock::now().saturating_sub(start) > timeout {
                let cause = match (snapshot.phase, unsettled) {
                    (_, Some((device, difference_ns))) if inputs_fresh => {
                        return Err(Cause::ClockNotSettled { difference_ns }.with_device(device));
                    }
                    (Some(phase), None) if inputs_fresh => Cause::PhaseNotLocked {
                        error_ns: phase.error_ns,
                    },
                    _ => match self.unfilled_inputs().await {
                        Some(error) => return Err(error),
                        None => Cause::NoProcessData {
                            al_status: snapshot.al_status,
                        },
                    },
                };
                return Err(cause.into());
            }
        }
    }

    /// Returns the error of the first device in SafeOp with inputs that do not answer a read. In a lower
    /// state, no SyncManager of process data does.
    async fn unfilled_inputs(&self) -> Option<Error> {
        let devices = self.machine.devices.iter().zip(&self.bus.devices);
        for (config, device) in devices.filter(|(_, device)| device.present) {
            if !self.serves_inputs(device.at.station).await {
                continue;
            }
            let inputs = config.selection.layout.inputs.iter();
            for sm in inputs.filter(|sm| !config.device.op_only(sm).sync_manager) {
                let mut area = vec![0; sm.len.into()];
                let (station, start) = (device.at.station, sm.start_address);
                if let Ok(0) = self.wire.read(station, start, &mut area).await {
                    let cause = Cause::NoInputs {
                        sm: sm.sm,
                        start,
                        len: sm.len,
                    };
                    return Some(cause.with_device(&device.at));
                }
            }
        }
        None
    }

    async fn serves_inputs(&self, station: u16) -> bool {
        let read = al::read_status(&self.wire, station).await;
        let state = read
            .ok()
            .flatten()
            .map(|(status, _)| AlState::from_status(status));
        matches!(state, Some(AlState::SafeOp | AlState::Op))
    }

    /// True if the process data of all groups is fresh, except those with an absent device.
    fn inputs_fresh(&self, snapshot: &Snapshot) -> bool {
        let absent = |group| {
            let mut devices = self.bus.devices.enumerate();
            devices.any(|(d, device)| !device.present && self.machine.group_of(d) == group)
        };
        let mut groups = snapshot.groups.enumerate();
        groups.all(|(group, status)| status.fresh || absent(group))
    }

    /// Returns the devices that must follow the reference clock before Op, because they use
    /// SYNC0 or SYNC1.
    fn synchronized<'a>(
        &'a self,
        snapshot: &'a Snapshot,
    ) -> impl Iterator<Item = (&'a BusDevice, &'a SubDeviceDiagnostics)> {
        // The reference clock has no difference to itself.
        let reference = snapshot.phase.and_then(|phase| phase.reference);
        let devices = self.machine.devices.iter().zip(&self.bus.devices);
        let devices = (0..).map(DeviceIndex).zip(devices.zip(&snapshot.diagnoses));
        devices.filter_map(move |(index, ((config, device), found))| {
            let uses =
                config.selection.activates_sync() && device.present && Some(index) != reference;
            uses.then_some((device, found))
        })
    }

    /// Returns `true` if every clock difference that matters has been read.
    fn clocks_read(&self, snapshot: &Snapshot) -> bool {
        self.synchronized(snapshot)
            .all(|(_, found)| found.has_read(DiagnosticRegister::ClockDifference))
    }

    fn unsettled_clock(&self, snapshot: &Snapshot) -> Option<(DeviceRef, i32)> {
        let window = self.machine.bus.sync_window_ns;
        self.synchronized(snapshot)
            .find(|(_, found)| u64::from(found.clock_difference.unsigned_abs()) > window)
            .map(|(device, found)| (device.at.clone(), found.clock_difference))
    }

    /// Returns the longest time in ns that an axis needs to stop from full speed.
    fn longest_stop(&self) -> Nanos {
        let times = self.machine.axes.iter().map(|axis| {
            let config = &axis.config;
            config.stop_time_s(config.mode, config.limits.velocity)
        });
        // At most an hour; the cast saturates.
        (times.fold(0.0, f64::max) * 1e9) as Nanos
    }

    /// Returns the longest brake release time in ns; the drive is enabled during this time.
    fn longest_release(&self, axes: &[AxisIndex]) -> Nanos {
        let axes = axes.iter().filter_map(|&axis| self.machine.axes.get(axis));
        let brakes = axes.map(|axis| axis.config.brake.release_s);
        // Configured as whole nanoseconds; the cast saturates.
        (brakes.fold(0.0, f64::max) * 1e9) as Nanos
    }

    /// Waits for the next snapshot and reports stopped groups. While their devices are read, it waits
    /// for later snapshots.
    /// Fails if the cycle has stopped the machine.
    async fn poll_and_query(&mut self) -> Result<Snapshot, Error> {
        loop {
            let snapshot = self.poll_snapshot().await?;
            if self.report_stopped_groups(&snapshot).await {
                return Ok(snapshot);
            }
        }
    }

    /// Waits for the next snapshot without any device access. Fails if the cycle has stopped the
    /// machine.
    async fn poll_snapshot(&mut self) -> Result<Snapshot, Error> {
        clock::delay(TICK).await;
        self.take_snapshot().await
    }

    /// Returns the newest snapshot, after everything that depends on it.
    async fn take_snapshot(&mut self) -> Result<Snapshot, Error> {
        if self.outer.commands.is_abandoned() {
            return Err(Cause::Thread("the cycle has ended by itself".to_owned()).into());
        }
        let snapshot = self.outer.snapshots.read().clone();
        self.pass_events_on();
        self.report_limits(&snapshot);
        self.follow_clock_tree(&snapshot);
        self.follow_ring();
        if let Some(gateway) = &mut self.mailbox_gateway {
            gateway.publish(&snapshot);
        }
        if self
            .machine
            .devices
            .iter()
            .any(|device| device.eoe.is_some())
        {
            let common = snapshot.phase.map(|_| &snapshot.common_time);
            let common = common.filter(|common| common.locked);
            let offset = common.map(|common| common.host_offset_ns.wrapping_sub(common.offset_ns));
            let network = &self.ethernet.network;
            network.set_system_offset(offset.map(i64::cast_unsigned));
        }
        if clock::now().saturating_sub(self.last_status) >= STATUS_PERIOD {
            self.last_status = clock::now();
            self.report(Progress::Status(Status::new(&self.machine, &snapshot)));
        }
        if let Some(cause) = snapshot.stopping
            && cause != StopCause::Requested
        {
            return Err(self.explain_stop(cause, &snapshot).await);
        }
        self.follow_start(&snapshot)?;
        self.watch_buttons(&snapshot);
        self.attend(&snapshot).await?;
        Ok(snapshot)
    }

    fn pass_events_on(&mut self) {
        while let Ok(event) = self.outer.events.pop() {
            tracing::debug!(?event);
            match event {
                Event::PhaseLost { cycle } => self.report(Progress::Warning(format!(
                    "cycle {cycle}: the release of frames has lost its phase to SYNC0"
                ))),
                Event::ClockOff {
                    device,
                    difference_ns,
                    ..
                } => {
                    let devices = &self.machine.devices;
                    let name = devices.get(device).map_or("?", |d| d.name.as_str());
                    self.report(Progress::Warning(clock_off(name, difference_ns)));
                }
                Event::ReferenceReplaced { device, .. } => {
                    let devices = &self.machine.devices;
                    let name = devices.get(device).map_or("?", |d| d.name.as_str());
                    self.report(Progress::Warning(reference_replaced(name)));
                }
                Event::CommonTimeJumped { by_ns, .. } => {
                    self.report(Progress::Warning(common_time_jumped(by_ns)));
                }
                Event::Refused { axis, reason, .. } => {
                    self.refused.truncate(REFUSALS - 1);
                    self.refused.push_back((axis, reason));
                }
                Event::ResetDrive { axis, .. } => self.request_reset(axis),
                // Stops are taken from the snapshot, where they cannot be lost.
                Event::Stopping { .. }
                | Event::GroupStopping { .. }
                | Event::GroupReleased { .. }
                | Event::PhaseLocked { .. } => {}
            }
        }
    }

    async fn send(&mut self, command: RtCommand) {
        self.send_now(&[command]).await;
    }

    /// Sends commands to the cycle. The cycle takes a batch in one cycle. The commands of a program
    /// wait for the instant of its start.
    async fn send_all(&mut self, commands: &[RtCommand]) {
        let Some(start) = self.start else {
            return self.send_now(commands).await;
        };
        for part in start.defer(commands) {
            self.send_now(&part).await;
        }
    }

    /// Sends commands that wait for no instant.
    async fn send_now(&mut self, commands: &[RtCommand]) {
        for batch in commands.chunks(COMMANDS_PER_CYCLE) {
            while !self.outer.commands.is_abandoned() {
                if let Ok(room) = self.outer.commands.write_chunk_uninit(batch.len()) {
                    room.fill_from_iter(batch.iter().copied());
                    break;
                }
                clock::delay(TICK).await;
            }
            self.commands_sent += batch.len() as u64;
        }
    }

    fn report(&self, progress: Progress) {
        // A closed channel does not stop the machine.
        let _ = self.progress.send(progress);
    }

    /// Returns the device of an axis, under the name of the axis.
    fn device_of(&self, axis: AxisIndex) -> DeviceRef {
        let setup = &self.machine.axes[axis];
        DeviceRef {
            name: setup.name.clone(),
            ..self.bus.devices[setup.device].at.clone()
        }
    }

    fn axis_name(&self, axis: AxisIndex) -> String {
        self.machine.axes[axis].name.clone()
    }
}
