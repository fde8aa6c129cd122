//! What a run tells while it goes on.

use std::sync::Arc;

use ecaxis_axis::units::UserUnits;
use ecaxis_axis::{Mode, State};
use serde::Serialize;

use crate::bringup::Step;
use crate::clock::Nanos;
use crate::config::{Machine, TorqueUnit};
use crate::link::Concern;
use crate::mailbox::Mailboxes;
use crate::rt::handover::{PhaseStatus, Snapshot};
use crate::rt::stats::Counters;
use crate::rt::thread::{Denied, Overload};
use crate::session::{EmergencyReport, RunError};

/// Listens to a run.
pub trait Observer {
    fn progress(&mut self, progress: &Progress);
}

/// A step of the machine file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StepRef {
    /// `2`, or `2.1` for the first step inside the second.
    pub number: String,
    pub line: u32,
}

impl std::fmt::Display for StepRef {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "step {} (line {})", self.number, self.line)
    }
}

/// One thing that happened.
#[derive(Debug, Clone)]
pub enum Progress {
    Step(Step),
    /// Something the operating system did not permit; the run goes on.
    Denied(Denied),
    /// The real-time thread took nearly all of its CPU.
    Overload(Overload),
    Warning(String),
    /// Something about the network interface.
    Concern(Concern),
    /// Frames leave in phase with SYNC0.
    PhaseLocked,
    Enabled {
        axes: usize,
    },
    /// A step of the program begins; runs count from 1.
    Program {
        run: u32,
        step: StepRef,
        /// In words.
        what: String,
    },
    /// A probing step has found its edge.
    Captured {
        run: u32,
        capture: Capture,
    },
    /// A device has reported something unasked.
    Emergency(EmergencyReport),
    /// From here to the end of the run anybody may make transfers beside the cycle.
    Mailboxes(Mailboxes),
    /// A group of axes has begun to stop; the machine goes on without it.
    GroupStopped {
        group: String,
        cause: Arc<RunError>,
    },
    /// A stopped group has been reset and can be enabled again.
    GroupReleased {
        group: String,
    },
    /// Once a second of the machine's time.
    Status(Status),
    Stopping,
}

/// What a probing step has found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Capture {
    /// Number of the step.
    pub step: String,
    pub axis: String,
    /// Touch probe 1 or 2.
    pub input: u8,
    /// `"rising"` or `"falling"`.
    pub edge: &'static str,
    /// How often the step has found one so far; the rest is of the last.
    pub times: u32,
    /// Where the drive was at the edge, user units; on a modulo axis counted on over its turns.
    pub position: f64,
    /// On a modulo axis.
    pub place: Option<f64>,
    pub unit: String,
}

impl std::fmt::Display for Capture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let at = self.place.unwrap_or(self.position);
        write!(
            f,
            "`{}`: {} edge of input {} at {:.4} {}",
            self.axis,
            self.edge,
            self.input,
            positive_zero(at),
            self.unit
        )
    }
}

/// `-0.0000` reads like a mistake.
pub(crate) fn positive_zero(x: f64) -> f64 {
    if x.abs() < 0.000_05 { 0.0 } else { x }
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
    /// User units; on a modulo axis the place.
    pub position: f64,
    /// User units a second.
    pub velocity: f64,
    /// In `torque_unit`.
    pub torque: f64,
    pub torque_unit: TorqueUnit,
}

impl Status {
    #[must_use]
    pub fn new(machine: &Machine, axes: &[usize], snapshot: &Snapshot) -> Self {
        let axes = axes
            .iter()
            .zip(&snapshot.axes)
            .filter_map(|(&device, status)| {
                let device = machine.devices.get(device)?;
                let setup = device.axis.as_ref()?;
                let place = setup.config.scale.place(UserUnits(status.position));
                Some(AxisLine {
                    name: device.name.clone(),
                    unit: setup.unit.clone(),
                    mode: status.mode,
                    state: status.state,
                    position: place.0,
                    velocity: status.velocity,
                    torque: setup.torque.shown(status.torque),
                    torque_unit: setup.torque.unit,
                })
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
