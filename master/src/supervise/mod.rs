//! Everything beside the cycle while the machine runs: the way to Op and back, enabling, the steps
//! of the program, and what to say when something stops it. MAY BLOCK AND ALLOCATE; talks to the
//! cycle through `rt::handover` alone.

use std::collections::VecDeque;
use std::future::{Future, poll_fn};
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::task::Poll;
use std::time::Duration;

use ecaxis_axis::{Command, Refused};

use crate::bringup::{AlState, Bus, DeviceRef, StateError, al, clocks};
use crate::clock::{self, Nanos};
use crate::config::steps::enables;
use crate::config::{Machine, Step};
use crate::mailbox::Mailboxes;
use crate::mailbox::desk::{Desk, beside};
use crate::rt::exchange::Probe;
use crate::rt::guard::StopCause;
use crate::rt::handover::{Event, ORDERS_A_CYCLE, Order, OuterEnd, Snapshot};
use crate::session::{Capture, GroupStop, Log, Progress, RunError, Status, clock_off};
use crate::story::{Witnessed, look};
use crate::wire::{BesideCycle, Datagrams};
use groups::StoppedGroup;

pub mod executor;
mod faults;
mod follow;
mod groups;
pub(crate) mod history;
pub mod manual;
mod program;

/// Cycles are looked at this often.
const TICK: Duration = Duration::from_millis(1);
/// How long the phase may take to lock.
const LOCK_TIMEOUT: Nanos = 5_000_000_000;
/// Cycles before Op is asked for.
const FIRST_CYCLES: u64 = 20;
/// A clock closer to the reference than this has settled.
const SETTLED_NS: u32 = 1_000;
/// Refusals that are kept until somebody looks.
const REFUSALS: usize = 256;
const STATUS_PERIOD: Nanos = 1_000_000_000;

/// Drives a machine from SafeOp through its program and back to Init.
#[derive(Debug)]
pub struct Supervisor {
    pub machine: Arc<Machine>,
    pub bus: Bus,
    pub wire: Datagrams,
    /// Transfers with devices; [`Supervisor::run`] looks after the desks that make them.
    pub mailboxes: Mailboxes,
    pub desks: Vec<Desk<BesideCycle>>,
    /// What devices have reported unasked.
    pub log: Log,
    pub outer: OuterEnd,
    pub stop: Arc<AtomicBool>,
    pub progress: Sender<Progress>,
    /// Runs of the program, where the time limit does not end it first.
    pub repeat: u32,
    /// Time limit of the program; it is repeated until then.
    pub limit: Option<Nanos>,
    pub enable: bool,
    /// A controller takes the program's place.
    pub controlled: bool,
    /// Somebody who takes the program's place.
    pub operator: Option<Box<dyn manual::Operator>>,
    /// Axes whose faults and trips they have seen.
    pub seen: Vec<usize>,
    /// Indices into the machine's devices, one an axis of the cycle.
    pub axes: Vec<usize>,
    /// Orders handed over so far.
    pub orders_given: u64,
    /// Commands that axes did not take, in order; of too many the first, and the last.
    pub refused: VecDeque<(usize, Refused)>,
    /// What probing has found, one for each step.
    pub captures: Vec<Capture>,
    /// Stops of groups that the machine went on through, in the order in which they were told.
    pub stopped: Vec<StoppedGroup>,
    /// Axes whose drive has reported an internal limit.
    pub limited: Vec<bool>,
    /// When the last status was told.
    pub last_status: Nanos,
    /// What was seen of the bus when it failed.
    pub witnessed: Option<Witnessed>,
}

/// How the machine's program ended.
#[derive(Debug, Clone, Default)]
pub struct Ended {
    /// Complete runs of the program.
    pub runs: u32,
    /// Stopped by the user before its end.
    pub interrupted: bool,
    /// What probing has found, one for each step.
    pub captures: Vec<Capture>,
    /// Groups that stopped while the machine went on.
    pub group_stops: Vec<GroupStop>,
    /// What was seen of the bus when it failed.
    pub witnessed: Option<Witnessed>,
    /// What stopped a group that was not reset, and what was seen of the bus then.
    pub left: Option<(Arc<RunError>, Witnessed)>,
}

/// Runs a future until it ends or the user wants everything to; `None` then.
pub async fn interruptible<F: Future>(stop: &AtomicBool, future: F) -> Option<F::Output> {
    let mut future = pin!(future);
    poll_fn(|context| {
        if stop.load(Ordering::Relaxed) {
            return Poll::Ready(None);
        }
        future.as_mut().poll(context).map(Some)
    })
    .await
}

impl Supervisor {
    /// The whole life beside the cycle. The cycle ends when this has ended.
    pub async fn run(mut self) -> (Ended, Result<(), RunError>) {
        let desks = std::mem::take(&mut self.desks);
        let heartbeat = self.outer.heartbeat.clone();
        let mut work = pin!(beside(desks, self.live()));
        poll_fn(|context| {
            heartbeat.beat();
            work.as_mut().poll(context)
        })
        .await
    }

    async fn live(mut self) -> (Ended, Result<(), RunError>) {
        let mut ended = Ended::default();
        let stop = Arc::clone(&self.stop);
        let worked = interruptible(&stop, self.work(&mut ended)).await;
        ended.interrupted = worked.is_none();
        ended.group_stops = self.group_stops();
        let mut result = worked.unwrap_or(Ok(()));
        if let Err(error) = &result {
            // The axes come to rest meanwhile.
            self.order(Order::Stop).await;
            self.witness(error).await;
        }
        let back = self.wind_down(result.is_err()).await;
        if result.is_ok() {
            result = back;
        }
        self.order(Order::Halt).await;
        ended.captures = std::mem::take(&mut self.captures);
        ended.witnessed = self.witnessed.take();
        let left = self.stopped.into_iter().find(|stop| !stop.released);
        ended.left = left.map(|stop| (stop.cause, stop.witnessed));
        (ended, result)
    }

    async fn work(&mut self, ended: &mut Ended) -> Result<(), RunError> {
        self.await_phase().await?;
        let devices = self.bus.addresses();
        let timeout = Duration::from_nanos(self.machine.bus.op_timeout_ns);
        al::change_state(&self.wire, &devices, AlState::Op, timeout)
            .await
            .map_err(RunError::State)?;
        self.tell(Progress::Step(crate::bringup::Step::State(AlState::Op)));
        self.order(Order::Guard).await;
        if !self.enable {
            return self.hold(clock::now()).await;
        }
        if self.controlled {
            return self.follow_controller(ended).await;
        }
        if let Some(mut operator) = self.operator.take() {
            return self.attend(operator.as_mut()).await;
        }
        if !enables(&self.machine.steps) {
            let all: Vec<usize> = (0..self.axes.len()).collect();
            self.enable_axes(None, &all).await?;
        }
        self.run_program(ended).await
    }

    /// Frames must be in phase with SYNC0, and the clocks together, before a device may leave
    /// SafeOp.
    async fn await_phase(&mut self) -> Result<(), RunError> {
        let start = clock::now();
        // Every clock is to be looked at, which takes long on a big bus with a long cycle.
        let looks = self.bus.devices.len() * Probe::ALL.len() * 2;
        let looks = u64::try_from(looks).unwrap_or(u64::MAX);
        let patience = LOCK_TIMEOUT.saturating_add(looks.saturating_mul(self.machine.bus.cycle_ns));
        loop {
            let snapshot = self.tick().await?;
            let looked_at_all =
                snapshot.counters.cycles > FIRST_CYCLES && self.clocks_read(&snapshot);
            let locked = snapshot.phase.is_none_or(|phase| phase.locked);
            let unsettled = self.unsettled_clock(&snapshot);
            if looked_at_all && snapshot.inputs_fresh && locked && unsettled.is_none() {
                if snapshot.phase.is_some() {
                    self.tell(Progress::PhaseLocked);
                }
                return Ok(());
            }
            if clock::now().saturating_sub(start) > patience {
                return Err(match (snapshot.phase, unsettled) {
                    _ if !snapshot.inputs_fresh => RunError::NoProcessData {
                        al_status: snapshot.al_status,
                    },
                    (Some(phase), None) => RunError::PhaseNotLocked {
                        error_ns: phase.error_ns,
                    },
                    (_, Some((device, difference_ns))) => RunError::ClockNotSettled {
                        device,
                        difference_ns,
                    },
                    (None, None) => RunError::NoProcessData {
                        al_status: snapshot.al_status,
                    },
                });
            }
        }
    }

    /// The diagnostic slot has come to every clock.
    fn clocks_read(&self, snapshot: &Snapshot) -> bool {
        let mut devices = self.bus.devices.iter().zip(&snapshot.diagnoses);
        devices.all(|(device, found)| !device.dc || found.has_read(Probe::ClockDifference))
    }

    fn unsettled_clock(&self, snapshot: &Snapshot) -> Option<(DeviceRef, i32)> {
        // The reference compares itself with nothing.
        let reference = self.bus.dc?.reference;
        let devices = self.bus.devices.iter().zip(&snapshot.diagnoses);
        devices
            .filter(|(device, _)| device.dc && device.at.station != reference)
            .find(|(_, found)| found.clock_difference.unsigned_abs() > SETTLED_NS)
            .map(|(device, found)| (device.at.clone(), found.clock_difference))
    }

    async fn enable_axes(&mut self, step: Option<&Step>, axes: &[usize]) -> Result<(), RunError> {
        let snapshot = self.tick().await?;
        let mut orders = Vec::with_capacity(2 * axes.len());
        self.none_stopped(step, axes)?;
        for &axis in axes {
            if snapshot.axes.get(axis).is_some_and(|s| s.fault.is_some()) {
                self.tell_of_old_fault(axis).await;
                let command = Command::ResetFault;
                orders.push(Order::Axis { axis, command });
            }
            let command = Command::Enable;
            orders.push(Order::Axis { axis, command });
        }
        self.orders(&orders).await;
        let start = clock::now();
        let timeout = self.machine.bus.enable_timeout_ns + self.longest_release(axes);
        loop {
            let snapshot = self.tick().await?;
            self.none_stopped(step, axes)?;
            if let Some((axis, reason)) = self.refused.pop_front() {
                return Err(RunError::EnableRefused {
                    device: self.device_of(axis),
                    reason: reason.to_string(),
                });
            }
            let status = |axis: usize| snapshot.axes.get(axis).copied();
            let late = axes
                .iter()
                .find_map(|&axis| Some((axis, status(axis)?)).filter(|(_, s)| !s.ready));
            let Some((waiting, status)) = late else {
                break;
            };
            let failed = status.reset_failed && snapshot.orders_taken >= self.orders_given;
            if failed || clock::now().saturating_sub(start) > timeout {
                return Err(self.not_enabled(waiting, status, timeout).await);
            }
        }
        self.confirm_modes(axes).await?;
        self.tell(Progress::Enabled { axes: axes.len() });
        Ok(())
    }

    /// From the full speed of the slowest axis to rest.
    fn longest_stop(&self) -> Nanos {
        let axes = self.machine.devices.iter().filter_map(|d| d.axis.as_ref());
        let times = axes.map(|axis| {
            let config = &axis.config;
            config.stop_time_s(config.mode, config.limits.velocity)
        });
        // At most an hour; the cast saturates.
        (times.fold(0.0, f64::max) * 1e9) as Nanos
    }

    /// Of the brakes of axes: the drive is enabled meanwhile.
    fn longest_release(&self, axes: &[usize]) -> Nanos {
        let devices = axes.iter().filter_map(|&axis| self.axes.get(axis));
        let brakes = devices.filter_map(|&device| {
            let axis = self.machine.devices.get(device)?.axis.as_ref()?;
            Some(axis.config.brake.release_s)
        });
        // Configured as whole nanoseconds; the cast saturates.
        (brakes.fold(0.0, f64::max) * 1e9) as Nanos
    }

    /// Waits for the next look at the cycle, and asks the devices what there is to be asked; fails if the cycle has stopped the machine.
    async fn tick(&mut self) -> Result<Snapshot, RunError> {
        let snapshot = self.glance().await?;
        self.ask_devices(&snapshot).await;
        Ok(snapshot)
    }

    /// Waits for the next look at the cycle, and for no device; fails if the cycle has stopped the machine.
    async fn glance(&mut self) -> Result<Snapshot, RunError> {
        clock::delay(TICK).await;
        if self.outer.orders.is_abandoned() {
            return Err(RunError::Thread("the cycle has ended by itself".to_owned()));
        }
        let snapshot = self.outer.snapshots.read().clone();
        self.pass_events_on();
        self.report_limits(&snapshot);
        if clock::now().saturating_sub(self.last_status) >= STATUS_PERIOD {
            self.last_status = clock::now();
            self.tell(Progress::Status(Status::new(
                &self.machine,
                &self.axes,
                &snapshot,
            )));
        }
        if let Some(cause) = snapshot.stopping
            && cause != StopCause::Requested
        {
            return Err(self.explain_stop(cause, None, &snapshot).await);
        }
        Ok(snapshot)
    }

    /// Statusword bit 11, once for each axis.
    fn report_limits(&mut self, snapshot: &Snapshot) {
        self.limited.resize(snapshot.axes.len(), false);
        for (axis, status) in snapshot.axes.iter().enumerate() {
            if status.internal_limit && status.enabled && !self.limited[axis] {
                self.limited[axis] = true;
                let device = self.device_of(axis);
                self.tell(Progress::Warning(format!(
                    "{device}: the drive limits what it is commanded (Statusword bit 11, internal limit active)"
                )));
            }
        }
    }

    /// What has stopped groups. Takes as long as the devices take to answer.
    async fn ask_devices(&mut self, snapshot: &Snapshot) {
        self.tell_of_groups(snapshot).await;
    }

    fn pass_events_on(&mut self) {
        while let Ok(event) = self.outer.events.pop() {
            tracing::debug!(?event);
            match event {
                Event::PhaseLost { cycle } => self.tell(Progress::Warning(format!(
                    "cycle {cycle}: the release of frames has lost its phase to SYNC0"
                ))),
                Event::ClockOff {
                    device,
                    difference_ns,
                    ..
                } => {
                    let devices = &self.machine.devices;
                    let name = devices.get(device).map_or("?", |d| d.name.as_str());
                    self.tell(Progress::Warning(clock_off(name, difference_ns)));
                }
                Event::Refused { axis, reason, .. } => {
                    self.refused.truncate(REFUSALS - 1);
                    self.refused.push_back((axis, reason));
                }
                // The snapshot tells of stops, and cannot be lost.
                Event::Stopping { .. }
                | Event::GroupStopping { .. }
                | Event::GroupReleased { .. }
                | Event::PhaseLocked { .. } => {}
            }
        }
    }

    /// Axes to rest, power off, and the segment back to Init, as far as it still answers. `failed`: the run has an error already.
    async fn wind_down(&mut self, failed: bool) -> Result<(), RunError> {
        self.tell(Progress::Stopping);
        self.order(Order::Stop).await;
        let result = self.await_rest(failed).await;
        let stations = self.stations();
        if let Some(witnessed) = &mut self.witnessed {
            look::again(&self.wire, &stations, &mut witnessed.looks).await;
        } else if let Err(error) = &result {
            self.witness(error).await;
        }
        self.pass_events_on();
        let stopped = |device: usize| self.is_stopped(self.machine.group_of(device));
        let devices = self.bus.addresses().into_iter().enumerate();
        let (stopped, others): (Vec<_>, Vec<_>) = devices.partition(|(device, _)| stopped(*device));
        let addresses = |devices: Vec<(usize, DeviceRef)>| -> Vec<DeviceRef> {
            devices.into_iter().map(|(_, at)| at).collect()
        };
        let (stopped, others) = (addresses(stopped), addresses(others));
        let mut lowered = Ok(());
        for state in [AlState::SafeOp, AlState::PreOp, AlState::Init] {
            if state == AlState::Init {
                self.end_sync().await;
            }
            match al::lower_state(&self.wire, &others, state, al::BACK_TIMEOUT).await {
                Ok(()) => self.tell(Progress::Step(crate::bringup::Step::State(state))),
                Err(error) => {
                    let silent = matches!(error, StateError::Wire { .. });
                    self.tell(Progress::Warning(error.to_string()));
                    if lowered.is_ok() {
                        lowered = Err(RunError::State(error));
                    }
                    if silent {
                        break;
                    }
                }
            }
            // The machine has gone on without them; they go along as far as they still can.
            if let Err(error) = al::lower_state(&self.wire, &stopped, state, al::BACK_TIMEOUT).await
            {
                tracing::debug!("{error}");
            }
        }
        result.and(lowered)
    }

    /// In PreOp nobody wants SYNC0 any more, and in Init it would look as if a machine ran.
    async fn end_sync(&self) {
        let devices = self.machine.devices.iter().zip(&self.bus.devices);
        let pulsed = devices.filter(|(config, _)| config.selection.dc.is_some());
        clocks::stop(&self.wire, pulsed.map(|(_, device)| device.at.station)).await;
    }

    /// Until nothing more can be done to stop any axis. Each axis sees to it in bounded time.
    async fn await_rest(&mut self, failed: bool) -> Result<(), RunError> {
        loop {
            clock::delay(TICK).await;
            let snapshot = self.outer.snapshots.read();
            let ended = snapshot.stopping.is_some() && snapshot.stop_ended;
            if ended || self.outer.orders.is_abandoned() {
                break;
            }
        }
        // What the cycle finds up to here is a failure of this run.
        self.order(Order::Unguard).await;
        while self.outer.snapshots.read().orders_taken < self.orders_given
            && !self.outer.orders.is_abandoned()
        {
            clock::delay(TICK).await;
        }
        let snapshot = self.outer.snapshots.read().clone();
        // The machine may have stopped by itself when it was asked to.
        let unsaid = snapshot.stopping.filter(|_| !failed);
        let mut causes = snapshot.failure.into_iter().chain(unsaid);
        if let Some(failure) = causes.find(StopCause::is_failure) {
            return Err(self.explain_stop(failure, None, &snapshot).await);
        }
        // What has not answered for long has been reported if its group was stopped.
        let mut axes = snapshot.axes.iter().enumerate();
        let powered = axes.find(|(axis, status)| {
            status.state.has_power() && !self.is_stopped(self.group_of(*axis))
        });
        match powered {
            Some((axis, status)) => Err(RunError::NotDisabled {
                device: self.device_of(axis),
                state: status.state,
            }),
            None => Ok(()),
        }
    }

    async fn order(&mut self, order: Order) {
        self.orders(&[order]).await;
    }

    /// Hands orders over, all at once as far as a batch holds them: the cycle takes them in one turn.
    async fn orders(&mut self, orders: &[Order]) {
        for batch in orders.chunks(ORDERS_A_CYCLE) {
            while !self.outer.orders.is_abandoned() {
                if let Ok(room) = self.outer.orders.write_chunk_uninit(batch.len()) {
                    room.fill_from_iter(batch.iter().copied());
                    break;
                }
                clock::delay(TICK).await;
            }
            self.orders_given += batch.len() as u64;
        }
    }

    fn tell(&self, progress: Progress) {
        // Nobody listening is no reason to stop a machine.
        let _ = self.progress.send(progress);
    }

    fn device_of(&self, axis: usize) -> DeviceRef {
        self.axes
            .get(axis)
            .and_then(|&device| self.bus.devices.get(device))
            .map_or_else(
                || DeviceRef {
                    name: format!("axis {axis}"),
                    position: 0,
                    station: 0,
                },
                |device| device.at.clone(),
            )
    }

    fn axis_name(&self, axis: usize) -> String {
        self.device_of(axis).name
    }
}
