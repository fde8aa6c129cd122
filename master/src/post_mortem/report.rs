//! A fault report as data, for files, scripts and renderers.

use ecaxis_axis::cia402::{Controlword, Statusword, describe};
use serde::{Serialize, Serializer};

use super::DiagnosedCause;
use super::evidence::Evidence;
use super::snapshot::{SyncSnapshot, WatchdogSnapshot};
use crate::acyclic::AlState;
use crate::acyclic::topology;
use crate::clock::Nanos;
use crate::link::LinkStats;
use crate::report::EventLine;
use crate::rt::exchange::ErrorCounters;
use crate::rt::flight_recorder::{AxisCycle, Cycle};
use crate::rt::stats::Counters;
use ecaxis_ecat::al_status_code::al_status_text;
use ecaxis_ecat::sii::control;

/// The report of a failed run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FaultReport {
    /// One line: device and cause.
    pub headline: String,
    pub cause: DiagnosedCause,
    /// Other observations.
    pub also: Vec<DiagnosedCause>,
    /// The error that ended the run.
    pub error: String,
    pub machine: String,
    /// SHA-256 of the machine file and the files that it names.
    pub machine_sha256: String,
    /// The version of ecaxis.
    pub version: &'static str,
    /// `"real"` or `"virtual"`.
    pub time: &'static str,
    /// The time in s since 1970; `None` in virtual time.
    pub unix_time: Option<u64>,
    pub cycle_ns: Nanos,
    /// The stop, if a cycle ran.
    pub stop: Option<Stop>,
    pub counters: Counters,
    pub link: LinkStats,
    /// The events of the cycle, oldest first.
    pub events: Vec<EventLine>,
    /// One section per SubDevice in segment order.
    pub devices: Vec<DeviceSection>,
    pub axes: Vec<AxisSection>,
    /// The last cycles around the stop.
    pub cycles: Vec<CycleRecord>,
}

/// The time at which the machine began to stop.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Stop {
    pub cycle: u64,
    /// The time since the first cycle in s.
    pub at_s: f64,
}

/// One SubDevice after the stop.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DeviceSection {
    pub name: String,
    pub position: u16,
    /// The upstream device and its port.
    pub upstream: String,
    pub answers: bool,
    pub came_back: bool,
    pub station: Option<u16>,
    /// The state in words, if the device answered.
    pub state: Option<String>,
    pub al_code: Option<u16>,
    pub al_text: Option<&'static str>,
    /// The ports that have a link.
    pub links: Option<Vec<u8>>,
    /// The increase of the error counters.
    pub errors: ErrorCounters,
    pub watchdog: Option<WatchdogSnapshot>,
    pub sync: Option<SyncSnapshot>,
    /// `true` if 0x0502 reports an error.
    pub eeprom_error: Option<bool>,
    pub error_code: Option<u16>,
    pub error_text: Option<&'static str>,
    pub interpolation_ns: Option<u64>,
}

/// One axis after the stop.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AxisSection {
    pub name: String,
    pub unit: String,
    pub state: String,
    pub fault: Option<String>,
    pub trip: Option<String>,
}

/// One cycle.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CycleRecord {
    /// The time since the first cycle in s.
    pub at_s: f64,
    #[serde(flatten)]
    pub cycle: Cycle,
    /// In the order of [`FaultReport::axes`].
    #[serde(serialize_with = "with_texts")]
    pub axes: Vec<AxisCycle>,
}

/// An axis with the texts of its words.
#[derive(Serialize)]
struct DecodedAxis<'a> {
    #[serde(flatten)]
    axis: &'a AxisCycle,
    statusword_text: String,
    controlword_text: String,
}

fn with_texts<S: Serializer>(axes: &[AxisCycle], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(axes.iter().map(|axis| DecodedAxis {
        axis,
        statusword_text: Statusword::from_bits_retain(axis.statusword).to_string(),
        controlword_text: Controlword::from_bits_retain(axis.controlword).to_string(),
    }))
}

impl CycleRecord {
    pub(crate) fn new(cycle: &Cycle, axes: &[AxisCycle], started: Nanos) -> Self {
        Self {
            at_s: since(cycle.time, started),
            cycle: *cycle,
            axes: axes.to_vec(),
        }
    }
}

pub(crate) fn since(time: Nanos, started: Nanos) -> f64 {
    time.saturating_sub(started) as f64 * 1e-9
}

impl Stop {
    pub(crate) fn of(evidence: &Evidence, started: Nanos) -> Option<Self> {
        let stop = evidence.stop?;
        Some(Self {
            cycle: stop.cycle,
            at_s: since(stop.time, started),
        })
    }
}

impl DeviceSection {
    pub(crate) fn all(evidence: &Evidence) -> Vec<Self> {
        let devices = evidence.devices.iter();
        let page = |device: &super::DeviceEvidence| {
            let look = &device.look;
            let links = |status| {
                (0..4)
                    .filter(|port| topology::has_link(status, *port))
                    .collect()
            };
            Self {
                name: device.at.name.clone(),
                position: device.at.position,
                upstream: evidence.upstream(device),
                answers: look.answers,
                came_back: look.came_back,
                station: look.station,
                state: look
                    .al_status
                    .map(|status| AlState::from_status(status).to_string()),
                al_code: look.al_code,
                al_text: look.al_code.map(al_status_text),
                links: look.dl_status.map(links),
                errors: device.grown,
                watchdog: look.watchdog,
                sync: look.sync,
                eeprom_error: look.eeprom.map(|status| status & control::ERRORS != 0),
                error_code: look.error_code,
                error_text: look.error_code.map(|code| describe(code).text),
                interpolation_ns: look.interpolation_ns,
            }
        };
        devices.map(page).collect()
    }
}
