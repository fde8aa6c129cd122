//! A story as data: for a file, for a script, for whoever lays it out.

use ecaxis_axis::cia402::describe;
use serde::Serialize;

use super::evidence::Evidence;
use super::look::{SyncLook, WatchdogLook};
use super::{Cause, ports};
use crate::al_status::al_status_text;
use crate::bringup::AlState;
use crate::clock::Nanos;
use crate::link::LinkStats;
use crate::rt::exchange::ErrorCounters;
use crate::rt::history::{AxisCycle, Cycle};
use crate::rt::stats::Counters;
use crate::session::EventLine;

/// What happened when a run failed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Story {
    /// One line: device and cause.
    pub headline: String,
    pub cause: Cause,
    /// What else was seen.
    pub also: Vec<Cause>,
    /// The error that ended the run.
    pub error: String,
    pub machine: String,
    /// `"real"` or `"virtual"`.
    pub time: &'static str,
    /// Seconds since 1970; `None` in virtual time.
    pub unix_time: Option<u64>,
    pub cycle_ns: Nanos,
    /// The stop, where a cycle ran.
    pub stop: Option<Stop>,
    pub counters: Counters,
    pub link: LinkStats,
    /// What the cycle noticed, oldest first.
    pub events: Vec<EventLine>,
    /// In the order of the segment.
    pub devices: Vec<DevicePage>,
    pub axes: Vec<AxisPage>,
    /// The last cycles around the stop.
    pub cycles: Vec<CyclePage>,
}

/// When the machine began to stop.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Stop {
    pub cycle: u64,
    /// From the first cycle on.
    pub at_s: f64,
}

/// One SubDevice after the stop.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DevicePage {
    pub name: String,
    pub position: u16,
    /// The one that it is connected to, and at which port of it.
    pub upstream: String,
    pub answers: bool,
    pub came_back: bool,
    pub station: Option<u16>,
    /// In words, where it answered.
    pub state: Option<String>,
    pub al_code: Option<u16>,
    pub al_text: Option<&'static str>,
    /// Ports that have a link.
    pub links: Option<Vec<u8>>,
    /// What the error counters have grown by.
    pub errors: ErrorCounters,
    pub watchdog: Option<WatchdogLook>,
    pub sync: Option<SyncLook>,
    /// 0x0502 tells of an error.
    pub eeprom_error: Option<bool>,
    pub error_code: Option<u16>,
    pub error_text: Option<&'static str>,
    pub interpolation_ns: Option<u64>,
}

/// One axis after the stop.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AxisPage {
    pub name: String,
    pub unit: String,
    pub state: String,
    pub fault: Option<String>,
    pub trip: Option<String>,
}

/// One cycle.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CyclePage {
    /// From the first cycle on.
    pub at_s: f64,
    #[serde(flatten)]
    pub cycle: Cycle,
    /// In the order of [`Story::axes`].
    pub axes: Vec<AxisCycle>,
}

impl CyclePage {
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

/// 0x0502: checksum, device information or acknowledge errors (bits 11 to 14).
const EEPROM_ERRORS: u16 = 0x7800;

impl DevicePage {
    pub(crate) fn all(evidence: &Evidence) -> Vec<Self> {
        let devices = evidence.devices.iter();
        let page = |device: &super::DeviceEvidence| {
            let look = &device.look;
            let links = |status| {
                (0..4)
                    .filter(|port| ports::has_link(status, *port))
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
                eeprom_error: look.eeprom.map(|status| status & EEPROM_ERRORS != 0),
                error_code: look.error_code,
                error_text: look.error_code.map(|code| describe(code).text),
                interpolation_ns: look.interpolation_ns,
            }
        };
        devices.map(page).collect()
    }
}
