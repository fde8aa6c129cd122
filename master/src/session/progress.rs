//! What a run tells while it goes on.

use ecaxis_axis::units::UserUnits;
use ecaxis_axis::{Mode, State};

use crate::bringup::Step;
use crate::clock::Nanos;
use crate::config::{Machine, TorqueUnit};
use crate::rt::handover::{PhaseStatus, Snapshot};
use crate::rt::stats::Counters;
use crate::rt::thread::Denied;

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
    Warning(String),
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
    /// Once a second of the machine's time.
    Status(Status),
    Stopping,
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
