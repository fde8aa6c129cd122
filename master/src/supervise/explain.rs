//! Explains what stopped the machine, by reading the devices while they still answer.

use std::sync::Arc;
use std::time::Duration;

use ecaxis_axis::{AxisStatus, State, Trip};
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, GroupIndex};

use super::sercos;
use super::{Supervisor, diagnosis_history};
use crate::acyclic::al;
use crate::clock::{self, Nanos};
use crate::config::{InputRef, LimitConflict};
use crate::post_mortem::snapshot::{self, Depth};
use crate::post_mortem::{DeviceSnapshot, Witnessed};
use crate::report::{Cause, DriveReport, Error, Progress, SercosDiagnosis};
use crate::rt::bus_monitor::StopCause;
use crate::rt::channel::{RtCommand, Snapshot};
use crate::rt::setpoint_generator::{GeneratorError, GeneratorState};

const ERROR_CODE: u16 = 0x603f;
pub(super) const MODES_OF_OPERATION_DISPLAY: u16 = 0x6061;

/// The timeout of one mailbox read while a stop is explained. The device may hang or be busy with a
/// long transfer.
const ASK_TIMEOUT: Duration = Duration::from_millis(500);
/// The time before a fault in ns within which a device's messages belong to the fault.
const BEFORE_A_FAULT: Nanos = 1_000_000_000;

impl Supervisor {
    /// Returns the error for a stop. `group` is the stopped group if the machine continues.
    pub(super) async fn explain_stop(
        &mut self,
        cause: StopCause,
        group: Option<GroupIndex>,
        snapshot: &Snapshot,
    ) -> Error {
        let axis = cause.axis();
        let cause = match cause {
            // Not reached for requested stops: callers pass only failures.
            StopCause::Requested => Cause::Interrupted,
            StopCause::EmergencyStop => {
                let value =
                    |input: InputRef| snapshot.inputs.get(input.0).copied().unwrap_or(f64::NAN);
                let all = &self.machine.stop.emergency;
                let pressed = all
                    .iter()
                    .find(|c| c.bounds.holds(value(c.input)))
                    .or(all.first());
                Cause::EmergencyStop {
                    condition: pressed.map_or(String::new(), |c| self.machine.condition(c)),
                }
            }
            StopCause::FollowLost { axis } => match snapshot.generators.get(axis) {
                Some(GeneratorState::Failed(GeneratorError::LineShaft { shaft, end })) => {
                    let name = self.machine.line_shaft_name(*shaft).to_owned();
                    Cause::LineShaftEnded { name, end: *end }
                }
                state => Cause::FollowLost {
                    reason: match state {
                        Some(GeneratorState::Failed(error)) => Some(*error),
                        _ => None,
                    },
                    cause: self.cause_of_others(axis, group, snapshot).await,
                },
            },
            StopCause::Absent => Cause::Absent,
            StopCause::NodeLost { axis, state } => Cause::NodeLost {
                id: self.node_id(axis).unwrap_or(0),
                state,
            },
            StopCause::Controller => Cause::Controller,
            StopCause::Panicked => Cause::Panicked("the cycle".to_owned()),
            StopCause::Unsupervised => Cause::Unsupervised,
            StopCause::Powered { axis } => Cause::NotDisabled {
                state: snapshot
                    .axes
                    .get(axis)
                    .map_or(State::OperationEnabled, |s| s.state),
            },
            StopCause::DriveFault { axis } => {
                let since = clock::now().saturating_sub(BEFORE_A_FAULT);
                let code = match sercos::drive_of(&self.machine, axis) {
                    None => self.error_code(axis).await,
                    Some(_) => None,
                };
                if let Some(code) = code {
                    self.send(RtCommand::ErrorCode { axis, code }).await;
                }
                Cause::DriveFault {
                    code,
                    statusword: snapshot
                        .axes
                        .get(axis)
                        .and_then(|s| s.fault)
                        .map_or(0, |fault| fault.statusword),
                    report: self.drive_report(axis, since).await,
                }
            }
            StopCause::Trip { axis, trip } => Cause::Trip {
                trip,
                limits: self.exceeded_limits(axis),
            },
            StopCause::BusLost {
                cycles,
                last_wkc,
                answered,
            } => {
                if answered && let Some(missing) = self.find_missing(group).await {
                    return missing;
                }
                Cause::BusLost {
                    group: group.map(|group| self.group_name(group)),
                    cycles,
                    wkc: last_wkc,
                    answered,
                }
            }
            StopCause::LeftOp { al_status } => match self.find_missing(group).await {
                Some(missing) => return missing,
                None => Cause::LeftOpBriefly { al_status },
            },
        };
        match axis {
            Some(axis) => cause.with_device(self.device_of(axis)),
            None => cause.into(),
        }
    }

    /// Returns the first SubDevice of a group, or of all, that does not answer or is not in Op.
    /// Skips groups already stopped.
    async fn find_missing(&mut self, group: Option<GroupIndex>) -> Option<Error> {
        for (index, device) in (0..).map(DeviceIndex).zip(self.bus.addresses()) {
            let own = self.machine.group_of(index);
            if group.is_some_and(|group| group != own) || self.is_stopped(own) {
                continue;
            }
            match al::read_status(&self.wire, device.station).await {
                Ok(Some((status, code))) if status != 8 => {
                    let state = al::AlState::from_status(status);
                    return Some(Cause::LeftOp { state, code }.with_device(device));
                }
                Ok(None) => return Some(Cause::Gone.with_device(device)),
                _ => {}
            }
        }
        None
    }

    /// Returns the error that stopped the group whose axis this one may have followed.
    async fn cause_of_others(
        &mut self,
        axis: AxisIndex,
        group: Option<GroupIndex>,
        snapshot: &Snapshot,
    ) -> Option<Arc<Error>> {
        // The other group may have stopped in the same cycle, so its stop is reported first. Boxed
        // because of the recursion.
        if group.is_none() {
            Box::pin(self.report_stopped_groups(snapshot)).await;
        }
        let own = self.group_of(axis);
        let mut others = self.stopped.iter().rev();
        let last = others.find(|stop| !stop.released && stop.group != own)?;
        Some(Arc::clone(&last.cause))
    }

    pub(super) async fn not_enabled(
        &mut self,
        axis: AxisIndex,
        status: AxisStatus,
        timeout: Nanos,
    ) -> Error {
        let code = self.error_code(axis).await.filter(|code| *code != 0);
        Cause::NotEnabled {
            state: status.state,
            statusword: status.statusword,
            mode_confirmed: status.mode_confirmed,
            code,
            timeout_ms: timeout / 1_000_000,
        }
        .with_device(self.device_of(axis))
    }

    /// Reports a fault from before this run; enabling clears it.
    pub(super) async fn report_preexisting_fault(&mut self, axis: AxisIndex) {
        let name = self.axis_name(axis);
        if let Some(sercos) = self.sercos_diagnosis(axis).await {
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
        match self.upload(axis, ERROR_CODE).await?.as_slice() {
            &[low, high] => Some(u16::from_le_bytes([low, high])),
            _ => None,
        }
    }

    /// Reads an object of an axis's device. Returns `None` after a timeout.
    async fn upload(&mut self, axis: AxisIndex, index: u16) -> Option<Vec<u8>> {
        // A gateway passes no SDO on to its nodes, and a Sercos drive has no objects.
        let setup = self.setup(axis).filter(|setup| setup.node.is_none())?;
        if sercos::drive_of(&self.machine, axis).is_some() {
            return None;
        }
        let index = ecaxis_esi::axis::object(index, setup.number);
        let mailbox = self.mailboxes.urgent(setup.device)?;
        clock::timeout(ASK_TIMEOUT, mailbox.upload(index, 0))
            .await?
            .ok()
    }

    /// Returns the node-ID of an axis behind a gateway.
    fn node_id(&self, axis: AxisIndex) -> Option<u8> {
        let setup = self.setup(axis)?;
        let gateway = self.machine.devices.get(setup.device)?.gateway.as_ref()?;
        Some(gateway.nodes.get(setup.node?)?.id)
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
                let looks = self.look(Depth::Whole).await;
                self.witnessed = Some(Witnessed::of_machine(looks));
            }
        }
    }

    /// Reads the failure data of all SubDevices, and the fault objects of drives with a fault.
    pub(super) async fn look(&mut self, depth: Depth) -> Vec<DeviceSnapshot> {
        if self.outer.commands.is_abandoned() {
            return Vec::new();
        }
        let mut looks = vec![DeviceSnapshot::default(); self.bus.devices.len()];
        snapshot::read_registers(&self.wire, &self.stations(), &mut looks, depth).await;
        let snapshot = self.outer.snapshots.read().clone();
        let end = clock::now().saturating_add(snapshot::TIMEOUT);
        for (setup, status) in self.machine.axes.iter().zip(&snapshot.axes) {
            let device = setup.device;
            let following = matches!(status.trip, Some(Trip::FollowingError { .. }));
            let ask = snapshot::ObjectSelection {
                error_code: status.fault.is_some(),
                interpolation: status.fault.is_some() || following,
            };
            let (Some(mailbox), Some(found)) =
                (self.mailboxes.urgent(device), self.bus.devices.get(device))
            else {
                continue;
            };
            let sercos_free = self
                .machine
                .devices
                .get(device)
                .is_some_and(|config| config.device.soe_only().is_none());
            let Some(look) = looks.get_mut(usize::from(found.at.position)) else {
                continue;
            };
            let objects = sercos_free && look.answers;
            if objects && ask != snapshot::ObjectSelection::default() && clock::now() < end {
                snapshot::read_objects(&mailbox, setup.number, ask, look).await;
            }
        }
        looks
    }

    /// Returns the limits of an axis's drive that the machine file exceeds.
    fn exceeded_limits(&self, axis: AxisIndex) -> Vec<LimitConflict> {
        let device = self.setup(axis);
        let device = device.and_then(|setup| self.bus.devices.get(setup.device));
        let limits = device.into_iter().flat_map(|device| &device.limits);
        let own = limits.filter(|(own, _)| *own == axis);
        own.map(|(_, conflict)| conflict.clone()).collect()
    }

    /// Returns the failed device's own report. Best effort: the machine stops meanwhile.
    async fn drive_report(&mut self, axis: AxisIndex, since: Nanos) -> Box<DriveReport> {
        let mut history = Vec::new();
        let device = self.machine.axes[axis].device;
        let config = &self.machine.devices[device];
        if let Some(mailbox) = self.mailboxes.urgent(device)
            && let Some(Ok(messages)) =
                clock::timeout(ASK_TIMEOUT, diagnosis_history::read(&mailbox, config)).await
        {
            history = messages;
        }
        Box::new(DriveReport {
            emergencies: self.log.last_of(&config.name, since),
            history,
            limits: self.exceeded_limits(axis),
            sercos: self.sercos_diagnosis(axis).await,
        })
    }

    /// Returns what a Sercos drive says about its failure.
    async fn sercos_diagnosis(&mut self, axis: AxisIndex) -> Option<SercosDiagnosis> {
        let (device, drive) = sercos::drive_of(&self.machine, axis)?;
        let mailbox = self.mailboxes.urgent(device)?;
        Some(sercos::diagnose(&mailbox, drive, ASK_TIMEOUT).await)
    }

    /// Checks the mode of each axis over CoE if 0x6061 is not in its process data. Otherwise the
    /// cycle checks it.
    pub(super) async fn confirm_modes(&mut self, axes: &[AxisIndex]) -> Result<(), Error> {
        for &axis in axes {
            let setup = &self.machine.axes[axis];
            let device = &self.machine.devices[setup.device];
            let expected = setup.config.mode.code();
            let display = ecaxis_esi::axis::object(MODES_OF_OPERATION_DISPLAY, setup.number);
            let layout = &device.selection.layout;
            if setup.node.is_some() || layout.tx_field(display, 0).is_some() {
                continue;
            }
            if let Some(&[display]) = self
                .upload(axis, MODES_OF_OPERATION_DISPLAY)
                .await
                .as_deref()
                && i8::from_le_bytes([display]) != expected
            {
                return Err(Cause::WrongMode {
                    expected,
                    display: i8::from_le_bytes([display]),
                }
                .with_device(self.device_of(axis)));
            }
        }
        Ok(())
    }
}
