//! Reads the devices after a stop, while they still answer, and explains it. The supervisor goes on
//! meanwhile: it serves the operator, and the axes of other groups move on.

use std::sync::Arc;
use std::time::Duration;

use ecaxis_axis::{State, Trip};
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, GroupIndex, IndexVec};
use tokio::sync::mpsc;

use super::{Supervisor, diagnosis_history, sercos};
use crate::acyclic::{DeviceRef, al};
use crate::clock::{self, Nanos};
use crate::config::{InputRef, LimitConflict, Machine};
use crate::datagram::DatagramClient;
use crate::mailbox::Mailboxes;
use crate::post_mortem::snapshot::{self, Depth};
use crate::post_mortem::{DeviceSnapshot, Witnessed};
use crate::report::{Cause, DriveReport, EmergencyLog, Error, SercosDiagnosis};
use crate::rt::bus_monitor::StopCause;
use crate::rt::channel::Snapshot;
use crate::rt::setpoint_generator::{GeneratorError, GeneratorState};

const ERROR_CODE: u16 = 0x603f;

/// The timeout of one mailbox read while a stop is explained. The device may hang or be busy with a
/// long transfer.
pub(super) const ASK_TIMEOUT: Duration = Duration::from_millis(500);
/// The time before a fault in ns within which a device's messages belong to the fault.
const BEFORE_A_FAULT: Nanos = 1_000_000_000;

/// Reads the devices after a stop. It owns what it needs, so that the supervisor can go on.
#[derive(Debug, Clone)]
pub(super) struct FailureReader {
    machine: Arc<Machine>,
    mailboxes: Mailboxes,
    wire: DatagramClient,
    log: EmergencyLog,
    devices: IndexVec<DeviceIndex, ReadDevice>,
    /// The station addresses in segment order.
    stations: Vec<u16>,
}

#[derive(Debug, Clone)]
struct ReadDevice {
    at: DeviceRef,
    limits: Vec<(AxisIndex, LimitConflict)>,
}

/// A stop to be explained.
#[derive(Debug)]
pub(super) struct StopDetails {
    pub cause: StopCause,
    /// The stopped group if the machine continues.
    pub group: Option<GroupIndex>,
    /// Groups whose stops are reported already.
    pub stopped: Vec<GroupIndex>,
    /// The error that stopped the group whose axis this one may have followed.
    pub followed: Option<Arc<Error>>,
}

/// The error of a stop, and the code that its drive reports.
#[derive(Debug)]
pub(super) struct Explanation {
    pub error: Error,
    pub error_code: Option<(AxisIndex, u16)>,
}

impl From<Error> for Explanation {
    fn from(error: Error) -> Self {
        Self {
            error,
            error_code: None,
        }
    }
}

/// The stop of a group, on its way to the task that reads the devices.
#[derive(Debug)]
pub(super) struct Inquiry {
    pub stop: StopDetails,
    pub snapshot: Snapshot,
}

/// The answer to an [`Inquiry`].
#[derive(Debug)]
pub(super) struct Findings {
    pub explanation: Explanation,
    pub witnessed: Witnessed,
}

/// The supervisor's end of the task that reads the devices of stopped groups, one group at a time.
#[derive(Debug)]
pub(crate) struct InquiryPort {
    pub(super) inquiries: mpsc::Sender<Inquiry>,
    pub(super) findings: mpsc::Receiver<Findings>,
}

/// The other end of an [`InquiryPort`].
pub(super) struct InquiryTask {
    reader: FailureReader,
    inquiries: mpsc::Receiver<Inquiry>,
    findings: mpsc::Sender<Findings>,
}

impl InquiryTask {
    pub(super) async fn run(mut self) {
        while let Some(Inquiry { stop, snapshot }) = self.inquiries.recv().await {
            let explanation = self.reader.explain(&stop, &snapshot).await;
            let witnessed = Witnessed {
                looks: self.reader.look(Depth::Brief, &snapshot).await,
                group: stop.group,
            };
            let findings = Findings {
                explanation,
                witnessed,
            };
            if self.findings.send(findings).await.is_err() {
                return;
            }
        }
    }
}

impl Supervisor {
    /// Opens the port for the stops of groups and returns the task that reads the devices.
    pub(super) fn open_inquiries(&mut self) -> InquiryTask {
        let (inquiries, taken) = mpsc::channel(1);
        let (found, findings) = mpsc::channel(1);
        self.inquiries = Some(InquiryPort {
            inquiries,
            findings,
        });
        InquiryTask {
            reader: self.failure_reader(),
            inquiries: taken,
            findings: found,
        }
    }

    pub(super) fn failure_reader(&self) -> FailureReader {
        let devices = self.bus.devices.iter().map(|device| ReadDevice {
            at: device.at.clone(),
            limits: device.limits.clone(),
        });
        FailureReader {
            machine: Arc::clone(&self.machine),
            mailboxes: self.mailboxes.clone(),
            wire: self.wire,
            log: self.log.clone(),
            devices: devices.collect(),
            stations: self.stations(),
        }
    }
}

impl FailureReader {
    /// Returns the error for a stop.
    pub async fn explain(&self, stop: &StopDetails, snapshot: &Snapshot) -> Explanation {
        let StopDetails {
            cause,
            group,
            ref stopped,
            ref followed,
        } = *stop;
        let axis = cause.axis();
        let mut error_code = None;
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
                    cause: followed.clone(),
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
            StopCause::PowerLost { state, .. } => Cause::PowerLostWithoutCause { state },
            StopCause::DriveFault { axis } => {
                let since = clock::now().saturating_sub(BEFORE_A_FAULT);
                let code = match sercos::drive_of(&self.machine, axis) {
                    None => self.error_code(axis).await,
                    Some(_) => None,
                };
                error_code = code.map(|code| (axis, code));
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
                if answered && let Some(missing) = self.find_missing(group, stopped).await {
                    return missing.into();
                }
                Cause::BusLost {
                    group: group.map(|group| self.machine.group_name(group).to_owned()),
                    cycles,
                    wkc: last_wkc,
                    answered,
                }
            }
            StopCause::LeftOp { al_status } => match self.find_missing(group, stopped).await {
                Some(missing) => return missing.into(),
                None => Cause::LeftOpBriefly { al_status },
            },
        };
        let error = match axis {
            Some(axis) => cause.with_device(self.device_of(axis)),
            None => cause.into(),
        };
        Explanation { error, error_code }
    }

    /// Returns the first SubDevice of a group, or of all, that does not answer or is not in Op.
    /// Skips groups already stopped.
    async fn find_missing(
        &self,
        group: Option<GroupIndex>,
        stopped: &[GroupIndex],
    ) -> Option<Error> {
        for (index, device) in self.devices.enumerate() {
            let device = device.at.clone();
            let own = self.machine.group_of(index);
            if group.is_some_and(|group| group != own) || stopped.contains(&own) {
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

    /// Reads the error code (0x603F) over CoE.
    pub async fn error_code(&self, axis: AxisIndex) -> Option<u16> {
        match self.upload(axis, ERROR_CODE).await?.as_slice() {
            &[low, high] => Some(u16::from_le_bytes([low, high])),
            _ => None,
        }
    }

    /// Reads an object of an axis's device. Returns `None` after a timeout.
    async fn upload(&self, axis: AxisIndex, index: u16) -> Option<Vec<u8>> {
        // A gateway passes no SDO on to its nodes, and a Sercos drive has no objects.
        let setup = self
            .machine
            .axes
            .get(axis)
            .filter(|setup| setup.node.is_none())?;
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
    pub fn node_id(&self, axis: AxisIndex) -> Option<u8> {
        let setup = self.machine.axes.get(axis)?;
        let gateway = self.machine.devices.get(setup.device)?.gateway.as_ref()?;
        Some(gateway.nodes.get(setup.node?)?.id)
    }

    /// Returns the device of an axis, under the name of the axis.
    fn device_of(&self, axis: AxisIndex) -> DeviceRef {
        let setup = &self.machine.axes[axis];
        DeviceRef {
            name: setup.name.clone(),
            ..self.devices[setup.device].at.clone()
        }
    }

    /// Reads the failure data of all SubDevices, and the fault objects of drives with a fault.
    pub async fn look(&self, depth: Depth, snapshot: &Snapshot) -> Vec<DeviceSnapshot> {
        let mut looks = vec![DeviceSnapshot::default(); self.devices.len()];
        snapshot::read_registers(&self.wire, &self.stations, &mut looks, depth).await;
        let end = clock::now().saturating_add(snapshot::TIMEOUT);
        for (setup, status) in self.machine.axes.iter().zip(&snapshot.axes) {
            let device = setup.device;
            let following = matches!(status.trip, Some(Trip::FollowingError { .. }));
            let ask = snapshot::ObjectSelection {
                error_code: status.fault.is_some(),
                interpolation: status.fault.is_some() || following,
            };
            let (Some(mailbox), Some(found)) =
                (self.mailboxes.urgent(device), self.devices.get(device))
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
        let device = self.machine.axes.get(axis);
        let device = device.and_then(|setup| self.devices.get(setup.device));
        let limits = device.into_iter().flat_map(|device| &device.limits);
        let own = limits.filter(|(own, _)| *own == axis);
        own.map(|(_, conflict)| conflict.clone()).collect()
    }

    /// Returns the failed device's own report. Best effort: the machine stops meanwhile.
    async fn drive_report(&self, axis: AxisIndex, since: Nanos) -> Box<DriveReport> {
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
    pub async fn sercos_diagnosis(&self, axis: AxisIndex) -> Option<SercosDiagnosis> {
        let (device, drive) = sercos::drive_of(&self.machine, axis)?;
        let mailbox = self.mailboxes.urgent(device)?;
        Some(sercos::diagnose(&mailbox, drive, ASK_TIMEOUT).await)
    }
}
