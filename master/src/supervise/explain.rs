//! Explains what stopped the machine, by reading the devices while they still answer.

use std::sync::Arc;

use ecaxis_axis::AxisStatus;
use ecaxis_ecat::index::AxisIndex;

use super::failure_reader::{ASK_TIMEOUT, Explanation, StopDetails};
use super::{Supervisor, TICK, sercos};
use crate::clock::{self, Nanos};
use crate::config::Machine;
use crate::post_mortem::Witnessed;
use crate::post_mortem::snapshot::Depth;
use crate::report::{Cause, Error, Progress};
use crate::rt::bus_monitor::StopCause;
use crate::rt::channel::{RtCommand, Snapshot};
use crate::rt::gateway::NodeState;

const MODES_OF_OPERATION_DISPLAY: u16 = 0x6061;

impl Supervisor {
    /// Returns the error for a stop of the machine.
    pub(super) async fn explain_stop(&mut self, cause: StopCause, snapshot: &Snapshot) -> Error {
        let details = StopDetails {
            cause,
            group: None,
            stopped: self.stopped_groups(),
            followed: match cause {
                StopCause::FollowLost { axis } => self.cause_of_others(axis, snapshot).await,
                _ => None,
            },
        };
        let explanation = self.failure_reader().explain(&details, snapshot).await;
        self.note_error_code(&explanation).await;
        explanation.error
    }

    /// Passes the code of a drive's fault to the cycle.
    pub(super) async fn note_error_code(&mut self, explanation: &Explanation) {
        if let Some((axis, code)) = explanation.error_code {
            self.send(RtCommand::ErrorCode { axis, code }).await;
        }
    }

    /// Returns the error that stopped the group whose axis this one may have followed.
    async fn cause_of_others(
        &mut self,
        axis: AxisIndex,
        snapshot: &Snapshot,
    ) -> Option<Arc<Error>> {
        // The other group may have stopped in the same cycle, so its stop is reported first.
        while !self.report_stopped_groups(snapshot).await {
            clock::delay(TICK).await;
        }
        self.stop_of_others(axis)
    }

    pub(super) async fn not_enabled(
        &mut self,
        axis: AxisIndex,
        status: AxisStatus,
        timeout: Nanos,
    ) -> Error {
        let timeout_ms = timeout / 1_000_000;
        let node = self
            .outer
            .snapshots
            .read()
            .nodes
            .get(axis)
            .copied()
            .flatten();
        if let Some(state) = node.filter(|state| *state != NodeState::Operational) {
            return Cause::NodeNotOperational {
                id: self.failure_reader().node_id(axis).unwrap_or(0),
                state,
                timeout_ms,
            }
            .with_device(self.device_of(axis));
        }
        let code = self.error_code(axis).await.filter(|code| *code != 0);
        Cause::NotEnabled {
            state: status.state,
            statusword: status.statusword,
            waiting: status.waiting,
            code,
            timeout_ms,
        }
        .with_device(self.device_of(axis))
    }

    /// Reports a fault from before this run; enabling clears it.
    pub(super) async fn report_preexisting_fault(&mut self, axis: AxisIndex) {
        let name = self.axis_name(axis);
        if let Some(sercos) = self.failure_reader().sercos_diagnosis(axis).await {
            self.report(Progress::Warning(format!(
                "`{name}` had an error before this run; it is reset{sercos}"
            )));
            return;
        }
        let code = self.error_code(axis).await.unwrap_or(0);
        let text = ecaxis_axis::cia402::describe(code).text;
        self.report(Progress::Warning(format!(
            "`{name}` was in fault 0x{code:04x} ({text}) before this run; it is reset"
        )));
    }

    /// Reads the error code (0x603F) over CoE.
    async fn error_code(&mut self, axis: AxisIndex) -> Option<u16> {
        let reader = self.failure_reader();
        reader.error_code(axis).await
    }

    /// Returns the station addresses in segment order.
    pub(super) fn stations(&self) -> Vec<u16> {
        let mut devices = self.bus.addresses();
        devices.sort_by_key(|device| device.position);
        devices.iter().map(|device| device.station).collect()
    }

    /// Stores the state of the bus at a failure. Reads it now if no group's stop has stored it.
    pub(super) async fn witness(&mut self, error: &Error) {
        let group = error.shared_origin().and_then(|cause| {
            let mut stops = self.stopped.iter();
            stops.find(|stop| Arc::ptr_eq(&stop.cause, cause))
        });
        match group {
            Some(stop) => self.witnessed = Some(stop.witnessed.clone()),
            None => {
                if self.outer.commands.is_abandoned() {
                    self.witnessed = Some(Witnessed::default());
                    return;
                }
                let snapshot = self.outer.snapshots.read().clone();
                let reader = self.failure_reader();
                let looks = reader.look(Depth::Whole, &snapshot).await;
                self.witnessed = Some(Witnessed::of_machine(looks));
            }
        }
    }

    /// Checks the mode of each axis over CoE if its process data does not show it. Otherwise the
    /// cycle checks it.
    pub(super) async fn confirm_modes(&mut self, axes: &[AxisIndex]) -> Result<(), Error> {
        for &axis in axes {
            if let Some(reading) = self.mode_reading(axis) {
                let (_, display) = reading.await;
                self.check_mode(axis, display)?;
            }
        }
        Ok(())
    }

    /// Reads 0x6061 of an axis over CoE. Returns `None` if its process data shows the mode, or if
    /// nothing can be asked. The output is `None` after a time-out.
    pub(super) fn mode_reading(
        &self,
        axis: AxisIndex,
    ) -> Option<impl Future<Output = (AxisIndex, Option<i8>)> + Send + use<>> {
        let index = hidden_mode(&self.machine, axis)?;
        let mailbox = self.mailboxes.urgent(self.setup(axis)?.device)?;
        Some(async move {
            let read = clock::timeout(ASK_TIMEOUT, mailbox.upload(index, 0)).await;
            let display = match read.and_then(Result::ok).as_deref() {
                Some(&[display]) => Some(i8::from_le_bytes([display])),
                _ => None,
            };
            (axis, display)
        })
    }

    /// Fails if an axis shows another mode than that of the machine file.
    pub(super) fn check_mode(&self, axis: AxisIndex, display: Option<i8>) -> Result<(), Error> {
        let expected = self.machine.axes[axis].config.mode.code();
        match display {
            Some(display) if display != expected => {
                Err(Cause::WrongMode { expected, display }.with_device(self.device_of(axis)))
            }
            _ => Ok(()),
        }
    }
}

/// Returns the object that shows the mode of an axis, if it is readable but not in its process data.
pub(super) fn hidden_mode(machine: &Machine, axis: AxisIndex) -> Option<u16> {
    let setup = machine.axes.get(axis)?;
    // A gateway passes no SDO on to its nodes, and a Sercos drive has no objects.
    if setup.node.is_some() || sercos::drive_of(machine, axis).is_some() {
        return None;
    }
    let index = ecaxis_esi::axis::object(MODES_OF_OPERATION_DISPLAY, setup.number);
    let layout = &machine.devices.get(setup.device)?.selection.layout;
    layout.tx_field(index, 0).is_none().then_some(index)
}
