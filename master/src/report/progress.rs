//! Progress reports of a run.

use std::net::SocketAddr;
use std::sync::Arc;

use ecaxis_axis::units::UserUnits;
use ecaxis_axis::{AxisStatus, Mode, State};
use ecaxis_ecat::index::{DeviceIndex, IndexVec};
use serde::Serialize;

use super::bring_up::{Step, StepTime};
use super::{DeviceRef, EmergencyReport, Error};
use crate::clock::Nanos;
use crate::config::{Machine, TapSetup, TorqueUnit};
use crate::link::NicWarning;
use crate::link::redundant::RingStatus;
use crate::mailbox::Mailboxes;
use crate::rt::channel::{PhaseStatus, Snapshot};
use crate::rt::stats::Counters;
use crate::sys::rt_thread::{RtSetupError, RtThrottlingRisk};
use crate::text::positive_zero;

/// Receives the progress of a run.
pub trait Observer {
    fn progress(&mut self, progress: &Progress);
}

/// Identifies a step of the machine file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StepRef {
    /// The step number: `2`, or `2.1` for the first step inside the second.
    pub number: String,
    pub line: u32,
}

impl std::fmt::Display for StepRef {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "step {} (line {})", self.number, self.line)
    }
}

/// One progress report.
#[derive(Debug, Clone)]
pub enum Progress {
    Step(Step),
    /// The operating system denied a real-time setting. The run continues.
    Denied(RtSetupError),
    /// The real-time thread used nearly all of its CPU.
    Overload(RtThrottlingRisk),
    Warning(String),
    /// A warning about the network interface.
    Concern(NicWarning),
    /// Frames leave in phase with SYNC0.
    PhaseLocked,
    /// Where the time of the bring-up went; after all devices have reached Op.
    BringUpTimes(Vec<StepTime>),
    Enabled {
        axes: usize,
    },
    /// A step of the program begins; runs count from 1.
    Program {
        run: u32,
        step: StepRef,
        /// The step in words.
        what: String,
    },
    /// A probing step has found its edge.
    Captured {
        run: u32,
        capture: ProbeCapture,
    },
    /// A device has sent an emergency message.
    Emergency(EmergencyReport),
    /// The places of the devices, in the order of the machine file; when the cycle begins.
    Topology(IndexVec<DeviceIndex, DevicePlace>),
    /// Mailbox access during operation, valid from now to the end of the run.
    Mailboxes(Mailboxes),
    /// The mailbox gateway answers clients at this address.
    MailboxGateway {
        address: SocketAddr,
        write: bool,
    },
    /// The TAP interface exists from now to the end of the run.
    Tap(TapSetup),
    /// A group of axes has begun to stop. The machine continues without it.
    GroupStopped {
        group: String,
        cause: Arc<Error>,
    },
    /// The optional devices of a group are absent. Its axes had no power.
    GroupWaits {
        group: String,
    },
    /// The stop of a group has ended: it was reset, or it has no axes and its devices are in Op.
    GroupReleased {
        group: String,
    },
    /// A device of a stopped group does not answer or is not in Op.
    DeviceLost {
        device: DeviceRef,
        /// The device and the port that lead to it.
        parent: Option<(String, u8)>,
    },
    /// A lost device is in Op again. Its axes have no power.
    DeviceReturned {
        device: DeviceRef,
        /// The time in ns since it was found lost.
        after_ns: Nanos,
        /// It had no power.
        restarted: bool,
        /// What that has made of the home of its axes.
        home: Option<Home>,
        /// It is optional and was absent until now.
        first: bool,
        /// Its group has axes, which must be reset.
        has_axes: bool,
    },
    /// The status of the ring of a machine with cable redundancy; when the cycle begins.
    RingStatus(&'static RingStatus),
    /// A cable of the ring is broken, or the ring is closed again.
    Ring {
        text: String,
        broken: bool,
    },
    /// A device that is not in the machine file has appeared.
    UnknownDevice(UnknownDevice),
    /// The status of the machine, five times a second of machine time.
    Status(Status),
    Stopping,
}

/// The home of the axes of a device that has restarted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Home {
    /// By absolute encoders.
    Kept,
    /// Of at least one axis.
    Lost,
}

/// A device that is not in the machine file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnknownDevice {
    /// Its identity with its name; `None` if it was not read.
    pub identity: Option<String>,
    pub serial: Option<u32>,
    /// The device and the port that lead to it; `None`: it is in front of the first device.
    pub parent: Option<(String, u8)>,
    /// That port is closed.
    pub closed: bool,
}

impl std::fmt::Display for UnknownDevice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.parent {
            Some((device, port)) => write!(f, "a device at port {port} of `{device}`")?,
            None => f.write_str("a device in front of the first one")?,
        }
        f.write_str(" is not in the machine file: ")?;
        match (&self.identity, self.serial) {
            (Some(identity), Some(serial)) => write!(f, "{identity}, serial number {serial}")?,
            _ => f.write_str("its identity cannot be read")?,
        }
        f.write_str(match self.closed {
            true => ". The port is closed until it has left",
            false => ". It is not used",
        })
    }
}

/// The place of a device in the segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DevicePlace {
    /// Counted from 0 in the order of the frame.
    pub position: u16,
    /// The device and the port that lead to it; `None` for the first device, and if the ports
    /// contradict each other.
    pub parent: Option<(DeviceIndex, u8)>,
}

/// The result of a probing step.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ProbeCapture {
    /// The step number.
    pub step: String,
    pub axis: String,
    /// Touch probe 1 or 2.
    pub input: u8,
    /// `"rising"` or `"falling"`.
    pub edge: &'static str,
    /// The number of edges found so far. The other fields belong to the last edge.
    pub times: u32,
    /// The position at the edge in user units. On a modulo axis it counts on over several turns.
    pub position: f64,
    /// The position within one turn; modulo axes only.
    pub place: Option<f64>,
    pub unit: String,
}

impl std::fmt::Display for ProbeCapture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let at = self.place.unwrap_or(self.position);
        write!(
            f,
            "`{}`: {} edge of input {} at {:.4} {}",
            self.axis,
            self.edge,
            self.input,
            positive_zero(at, 4),
            self.unit
        )
    }
}

/// The machine at one moment.
#[derive(Debug, Clone)]
pub struct Status {
    pub time: Nanos,
    pub counters: Counters,
    pub phase: Option<PhaseStatus>,
    pub axes: Vec<AxisLine>,
}

/// One axis at one moment.
#[derive(Debug, Clone)]
pub struct AxisLine {
    pub name: String,
    pub unit: String,
    pub mode: Mode,
    pub state: State,
    /// The position in user units; on a modulo axis the position within one turn.
    pub position: f64,
    /// The velocity in user units per second.
    pub velocity: f64,
    /// The torque in `torque_unit`.
    pub torque: f64,
    pub torque_unit: TorqueUnit,
    /// The set-points, in the units of the actual values.
    pub target_position: f64,
    pub target_velocity: f64,
    pub target_torque: f64,
    pub following_error: f64,
    /// The fault, the trip, or what enabling waits for.
    pub trouble: Option<String>,
}

fn trouble(status: &AxisStatus) -> Option<String> {
    let trip = status.trip.map(|trip| trip.to_string());
    let fault = || status.fault.map(|fault| fault.to_string());
    let waiting = || status.waiting.map(|waiting| waiting.to_string());
    trip.or_else(fault).or_else(waiting)
}

impl Status {
    #[must_use]
    pub fn new(machine: &Machine, snapshot: &Snapshot) -> Self {
        let axes = machine
            .axes
            .iter()
            .zip(&snapshot.axes)
            .map(|(setup, status)| {
                let place = setup.config.scale.place(UserUnits(status.position));
                AxisLine {
                    name: setup.name.clone(),
                    unit: setup.unit.clone(),
                    mode: status.mode,
                    state: status.state,
                    position: place.0,
                    velocity: status.velocity,
                    torque: setup.torque.shown(status.torque),
                    torque_unit: setup.torque.unit,
                    target_position: setup
                        .config
                        .scale
                        .place(UserUnits(status.target_position))
                        .0,
                    target_velocity: status.target_velocity,
                    target_torque: setup.torque.shown(status.target_torque),
                    following_error: status.following_error,
                    trouble: trouble(status),
                }
            })
            .collect();
        Self {
            time: snapshot.time,
            counters: snapshot.counters,
            phase: snapshot.phase,
            axes,
        }
    }
}
