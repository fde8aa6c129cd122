//! The way back from Op: standstill, then SafeOp, PreOp and Init.

use ecaxis_axis::Trip;
use ecaxis_ecat::index::{AxisIndex, DeviceIndex};
use ecaxis_ecat::registers;

use super::{BROADCAST_WAIT, Supervisor, TICK};
use crate::acyclic::{AlState, Transition, al};
use crate::bringup::{BusDevice, enable_op_only};
use crate::clock::{self, Nanos};
use crate::post_mortem::snapshot;
use crate::report::{Cause, Error, Progress};
use crate::rt::bus_monitor::StopCause;
use crate::rt::channel::{RtCommand, Snapshot};

/// The time within which a gateway acknowledges the end of the exchange, in ns.
const GATEWAY_END_NS: Nanos = 100_000_000;

impl Supervisor {
    /// Stops the axes, removes power and sets the segment back to Init, as far as it answers.
    /// `failed`: the run already has an error.
    pub(super) async fn shut_down(&mut self, failed: bool) -> Result<(), Error> {
        self.report(Progress::Stopping);
        self.send(RtCommand::Stop).await;
        let result = self.wait_for_standstill(failed).await;
        let stations = self.stations();
        if let Some(witnessed) = &mut self.witnessed {
            snapshot::retry_absent(&self.wire, &stations, &mut witnessed.looks).await;
        } else if let Err(error) = &result {
            self.witness(error).await;
        }
        self.pass_events_on();
        let mut lowered = Ok(());
        for state in [AlState::SafeOp, AlState::PreOp, AlState::Init] {
            if state == AlState::Init {
                self.end_sync().await;
            }
            let requested = clock::now();
            let changed = match self.lower_everywhere(state, requested).await {
                true => Ok(()),
                false => self.lower_each(state, requested).await,
            };
            match changed {
                Ok(()) => self.report(Progress::Step(crate::bringup::Step::State(state))),
                Err(error) => {
                    let silent = al::is_wire(&error);
                    self.report(Progress::Warning(error.to_string()));
                    if lowered.is_ok() {
                        lowered = Err(error);
                    }
                    if silent {
                        break;
                    }
                }
            }
            if state == AlState::SafeOp {
                self.disable_op_only().await;
            }
        }
        result.and(lowered)
    }

    /// Disables the SyncManagers that are enabled in Op only, as far as the devices answer.
    async fn disable_op_only(&self) {
        for device in self.bus.devices.iter() {
            if let Err(error) = enable_op_only(&self.wire, device, false).await {
                tracing::debug!("{error}");
            }
        }
    }

    /// Stops SYNC0 and SYNC1. PreOp does not need them, and in Init they would look like a running
    /// machine.
    async fn end_sync(&self) {
        let mut devices = self.machine.devices.iter();
        if !devices.any(|config| config.selection.dc.is_some()) {
            return;
        }
        let stop = self.wire.write_all(registers::DC_CYCLIC_CONTROL, &[0, 0]);
        // On an error, the segment still goes to Init.
        if let Err(error) = stop.await {
            tracing::debug!("SYNC0 goes on: {error}");
        }
    }

    /// Requests a lower state from all devices with one datagram. Returns true once the cycle's
    /// broadcast read of AL status finds all of them in it. Returns false if a device has an error, is
    /// missing or needs longer.
    async fn lower_everywhere(&mut self, wanted: AlState, requested: Nanos) -> bool {
        if self.request_everywhere(wanted).await.is_err() {
            return false;
        }
        while clock::now().saturating_sub(requested) <= BROADCAST_WAIT
            && !self.outer.commands.is_abandoned()
        {
            clock::delay(TICK).await;
            let snapshot = self.outer.snapshots.read().clone();
            if self.is_everywhere(wanted, &snapshot) {
                return true;
            }
            // Those that answer may all be there.
            let ended = |(status, _)| status == wanted.code() || AlState::has_error(status);
            if snapshot.al_status.is_some_and(ended) {
                return false;
            }
        }
        false
    }

    /// Requests a lower state from each device that is not in it.
    async fn lower_each(&mut self, wanted: AlState, requested: Nanos) -> Result<(), Error> {
        let is_stopped = |device: DeviceIndex| self.is_stopped(self.machine.group_of(device));
        let devices = self.bus.devices.enumerate();
        let (stopped, others): (Vec<_>, Vec<_>) =
            devices.partition(|(device, _)| is_stopped(*device));
        let changed =
            al::lower_state(&self.wire, &transitions(&others, wanted), wanted, requested).await;
        if changed.as_ref().is_err_and(al::is_wire) {
            return changed;
        }
        // Stopped groups follow as far as they can; their errors do not count.
        let stopped = transitions(&stopped, wanted);
        if let Err(error) = al::lower_state(&self.wire, &stopped, wanted, requested).await {
            tracing::debug!("{error}");
        }
        changed
    }

    /// Leads the nodes behind gateways out of OPERATIONAL. Their drives have no power any more.
    async fn end_gateways(&mut self) {
        let mut devices = self.machine.devices.iter();
        if !devices.any(|device| device.gateway.is_some()) {
            return;
        }
        self.send(RtCommand::EndGateways).await;
        let asked = clock::now();
        while !self.outer.snapshots.read().gateways_ended && !self.outer.commands.is_abandoned() {
            if clock::now().saturating_sub(asked) > GATEWAY_END_NS {
                let text = "a gateway does not acknowledge the end: its nodes stay OPERATIONAL";
                self.report(Progress::Warning(text.to_owned()));
                return;
            }
            clock::delay(TICK).await;
        }
    }

    /// Reports the axes that lost their power before they were at rest. The error of the run names the
    /// first cause alone.
    fn report_axes_without_rest(&mut self, snapshot: &Snapshot) {
        let groups = snapshot.groups.iter().filter_map(|group| group.stopped);
        let causes = groups.chain(snapshot.failure).chain(snapshot.stopping);
        let reported: Vec<AxisIndex> = causes.filter_map(|cause| cause.axis()).collect();
        for (axis, status) in snapshot.axes.enumerate() {
            if let Some(trip @ Trip::NotStopped { .. }) = status.trip
                && !reported.contains(&axis)
            {
                let at = self.device_of(axis);
                self.report(Progress::Warning(format!("{at}: {trip}")));
            }
        }
    }

    /// Waits until nothing more can stop any axis. Each axis ends its stop in bounded time.
    async fn wait_for_standstill(&mut self, failed: bool) -> Result<(), Error> {
        loop {
            clock::delay(TICK).await;
            let snapshot = self.outer.snapshots.read();
            let ended = snapshot.stopping.is_some() && snapshot.stop_ended;
            if ended || self.outer.commands.is_abandoned() {
                break;
            }
        }
        self.end_gateways().await;
        // Until this point, anything the cycle finds is a failure of this run.
        self.send(RtCommand::StopBusMonitor).await;
        while self.outer.snapshots.read().commands_taken < self.commands_sent
            && !self.outer.commands.is_abandoned()
        {
            clock::delay(TICK).await;
        }
        let snapshot = self.outer.snapshots.read().clone();
        self.report_axes_without_rest(&snapshot);
        // The machine may have failed at the same time as the requested stop.
        let unsaid = snapshot.stopping.filter(|_| !failed);
        let mut causes = snapshot.failure.into_iter().chain(unsaid);
        if let Some(failure) = causes.find(StopCause::is_failure) {
            return Err(self.explain_stop(failure, &snapshot).await);
        }
        // Axes of a stopped group may not answer; their group's stop has been reported.
        let mut axes = snapshot.axes.enumerate();
        let powered = axes.find(|(axis, status)| {
            status.state.has_power() && !self.is_stopped(self.group_of(*axis))
        });
        match powered {
            Some((axis, status)) => Err(Cause::NotDisabled {
                state: status.state,
            }
            .with_device(self.device_of(axis))),
            None => Ok(()),
        }
    }
}

/// Returns the changes of these devices back to a state.
fn transitions<'d>(
    devices: &[(DeviceIndex, &'d BusDevice)],
    state: AlState,
) -> Vec<Transition<'d>> {
    let devices = devices.iter();
    devices.map(|(_, d)| d.transition(state, true)).collect()
}
