//! Everything beside the cycle while the machine runs: the way to Op and back, enabling, the steps
//! of the program, and what to say when something stops it. MAY BLOCK AND ALLOCATE; talks to the
//! cycle through `rt::handover` alone.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::time::Duration;

use ecaxis_axis::{Command, Refused};

use crate::bringup::{AlState, Bus, DeviceRef, al};
use crate::clock::{self, Nanos};
use crate::config::Machine;
use crate::rt::guard::StopCause;
use crate::rt::handover::{Event, Order, OuterEnd, Snapshot};
use crate::session::{Progress, RunError, Status};
use crate::wire::Datagrams;

pub mod executor;
mod faults;
mod program;

/// Cycles are looked at this often.
const TICK: Duration = Duration::from_millis(1);
/// How long the phase may take to lock.
const LOCK_TIMEOUT: Nanos = 5_000_000_000;
/// Good cycles before Op is asked for.
const GOOD_CYCLES: u64 = 20;
/// After this the stop is taken for done whatever the drives say; longer than the cycle's patience.
const STOP_TIMEOUT: Nanos = 8_000_000_000;
/// On a lost bus nobody can report that it stands.
const LOST_BUS_TIMEOUT: Nanos = 1_000_000_000;
const STATUS_PERIOD: Nanos = 1_000_000_000;

/// Drives a machine from SafeOp through its program and back to Init.
#[derive(Debug)]
pub struct Supervisor {
    pub machine: Arc<Machine>,
    pub bus: Bus,
    pub wire: Datagrams,
    pub outer: OuterEnd,
    pub stop: Arc<AtomicBool>,
    pub progress: Sender<Progress>,
    /// Runs of the program, where the time limit does not end it first.
    pub repeat: u32,
    /// Time limit of the program; it is repeated until then.
    pub limit: Option<Nanos>,
    pub enable: bool,
    /// Indices into the machine's devices, one an axis of the cycle.
    pub axes: Vec<usize>,
    /// Orders handed over so far.
    pub orders_given: u64,
    /// The last command that an axis did not take.
    pub refused: Option<(usize, Refused)>,
}

/// How the machine's program ended.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Ended {
    /// Complete runs of the program.
    pub runs: u32,
    /// Stopped by the user before its end.
    pub interrupted: bool,
}

/// What ends the program before its last step.
enum Break {
    /// The user, or the time limit.
    Interrupted,
    Failed(RunError),
}

impl From<RunError> for Break {
    fn from(error: RunError) -> Self {
        Self::Failed(error)
    }
}

impl Supervisor {
    /// The whole life beside the cycle. The cycle ends when this has ended.
    pub async fn run(mut self) -> (Ended, Result<(), RunError>) {
        let mut ended = Ended::default();
        let mut last_status = clock::now();
        let mut result = match self.work(&mut ended, &mut last_status).await {
            Ok(()) => Ok(()),
            Err(Break::Interrupted) => {
                ended.interrupted = true;
                Ok(())
            }
            Err(Break::Failed(error)) => Err(error),
        };
        let back = self.wind_down(result.is_ok()).await;
        if result.is_ok() {
            result = back;
        }
        self.order(Order::Halt).await;
        (ended, result)
    }

    async fn work(&mut self, ended: &mut Ended, last_status: &mut Nanos) -> Result<(), Break> {
        self.await_phase(last_status).await?;
        let devices = self.bus.addresses();
        let timeout = Duration::from_nanos(self.machine.bus.op_timeout_ns);
        al::change_state(&self.wire, &devices, AlState::Op, timeout)
            .await
            .map_err(RunError::State)?;
        self.tell(Progress::Step(crate::bringup::Step::State(AlState::Op)));
        self.order(Order::Guard).await;
        if !self.enable {
            return self.idle(last_status).await;
        }
        self.enable_axes(last_status).await?;
        self.run_program(ended, last_status).await
    }

    /// Frames must be in phase with SYNC0 before a device may leave SafeOp.
    async fn await_phase(&mut self, last_status: &mut Nanos) -> Result<(), Break> {
        let start = clock::now();
        let mut good = 0;
        loop {
            let snapshot = self.tick(last_status).await?;
            let cycles = snapshot.counters.cycles;
            let locked = snapshot.phase.is_none_or(|phase| phase.locked);
            let fresh = snapshot.inputs_fresh;
            good = if fresh { good.max(1) } else { 0 };
            if locked && fresh && cycles > GOOD_CYCLES {
                if snapshot.phase.is_some() {
                    self.tell(Progress::PhaseLocked);
                }
                return Ok(());
            }
            if clock::now().saturating_sub(start) > LOCK_TIMEOUT {
                return Err(Break::Failed(if good == 0 {
                    RunError::NoProcessData {
                        al_status: snapshot.al_status,
                    }
                } else {
                    RunError::PhaseNotLocked {
                        error_ns: snapshot.phase.map_or(0, |p| p.error_ns),
                    }
                }));
            }
        }
    }

    async fn enable_axes(&mut self, last_status: &mut Nanos) -> Result<(), Break> {
        for axis in 0..self.axes.len() {
            self.order(Order::Axis {
                axis,
                command: Command::Enable,
            })
            .await;
        }
        let start = clock::now();
        let timeout = self.machine.bus.enable_timeout_ns;
        loop {
            let snapshot = self.tick(last_status).await?;
            let Some(waiting) = snapshot.axes.iter().position(|axis| !axis.ready) else {
                break;
            };
            if clock::now().saturating_sub(start) > timeout {
                let status = snapshot.axes[waiting];
                return Err(Break::Failed(
                    self.not_enabled(waiting, status, timeout).await,
                ));
            }
        }
        self.confirm_modes().await?;
        self.tell(Progress::Enabled {
            axes: self.axes.len(),
        });
        Ok(())
    }

    /// Op without power until the user or the time limit ends it.
    async fn idle(&mut self, last_status: &mut Nanos) -> Result<(), Break> {
        let start = clock::now();
        loop {
            self.tick(last_status).await?;
            if self
                .limit
                .is_some_and(|limit| clock::now().saturating_sub(start) >= limit)
            {
                return Ok(());
            }
        }
    }

    /// Waits for the next look at the cycle; ends the program if the user or the cycle has.
    async fn tick(&mut self, last_status: &mut Nanos) -> Result<Snapshot, Break> {
        clock::delay(TICK).await;
        let snapshot = self.outer.snapshots.read().clone();
        self.pass_events_on();
        if clock::now().saturating_sub(*last_status) >= STATUS_PERIOD {
            *last_status = clock::now();
            self.tell(Progress::Status(Status::new(
                &self.machine,
                &self.axes,
                &snapshot,
            )));
        }
        if let Some(cause) = snapshot.stopping
            && cause != StopCause::Requested
        {
            return Err(Break::Failed(self.explain_stop(cause, &snapshot).await));
        }
        if self.stop.load(Ordering::Relaxed) {
            return Err(Break::Interrupted);
        }
        Ok(snapshot)
    }

    fn pass_events_on(&mut self) {
        while let Ok(event) = self.outer.events.pop() {
            match event {
                Event::PhaseLost { cycle } => self.tell(Progress::Warning(format!(
                    "cycle {cycle}: the release of frames has lost its phase to SYNC0"
                ))),
                Event::Refused { axis, reason, .. } => self.refused = Some((axis, reason)),
                Event::Stopping { .. } | Event::PhaseLocked { .. } => {}
            }
        }
    }

    /// Axes to rest, power off, and the segment back to Init, as far as it still answers.
    async fn wind_down(&mut self, well: bool) -> Result<(), RunError> {
        self.tell(Progress::Stopping);
        let lost = matches!(
            self.outer.snapshots.read().stopping,
            Some(StopCause::BusLost { .. })
        );
        self.order(Order::Stop).await;
        let start = clock::now();
        let patience = if lost { LOST_BUS_TIMEOUT } else { STOP_TIMEOUT };
        while !self.outer.snapshots.read().stopped {
            if clock::now().saturating_sub(start) > patience {
                self.tell(Progress::Warning(
                    "not every axis has confirmed that it is disabled".to_owned(),
                ));
                break;
            }
            clock::delay(TICK).await;
        }
        self.pass_events_on();
        self.order(Order::Unguard).await;
        if lost {
            return Ok(());
        }
        let devices = self.bus.addresses();
        for state in [AlState::SafeOp, AlState::PreOp, AlState::Init] {
            match al::change_state(&self.wire, &devices, state, al::BACK_TIMEOUT).await {
                Ok(()) => self.tell(Progress::Step(crate::bringup::Step::State(state))),
                Err(error) if well => return Err(RunError::State(error)),
                // The first error is the one to report.
                Err(error) => self.tell(Progress::Warning(error.to_string())),
            }
        }
        Ok(())
    }

    /// Hands an order over; the queue is longer than what one wait can fill.
    async fn order(&mut self, order: Order) {
        while self.outer.orders.push(order).is_err() {
            if self.outer.orders.is_abandoned() {
                return;
            }
            clock::delay(TICK).await;
        }
        self.orders_given += 1;
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
