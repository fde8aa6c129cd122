//! The result of an analysis for text, JSON and HTML.
//!
//! - `build`: devices, events and transfers of a segment;
//! - `process_data`: cycle, clocks and axes;
//! - `problems`: the problems, worst first.

use std::collections::BTreeMap;

use serde::Serialize;

use ecaxis_master::acyclic::AlState;

mod build;
mod problems;
mod process_data;

pub(super) use build::report;

/// The result of an analysis.
#[derive(Debug, Serialize)]
pub struct Report {
    pub file: FileReport,
    /// The first problem that has a time.
    pub cause: Option<String>,
    /// The problems, worst first.
    pub trouble: Vec<String>,
    /// The maximum number of devices that answered a broadcast read.
    pub answering: Option<u16>,
    /// When fewer devices answered than before.
    pub absences: Vec<Absence>,
    pub devices: Vec<DeviceReport>,
    /// The main events in order: state changes, refusals, emergencies.
    pub story: Vec<Line>,
    /// All events, including every transfer.
    pub events: Vec<Line>,
    pub more_events: u64,
    pub transfers: Vec<TransferReport>,
    pub more_transfers: u64,
    pub cycle: Vec<CycleReport>,
    pub clocks: ClocksReport,
    pub axes: Vec<AxisReport>,
}

/// The title of the plot of the following error.
pub(super) const FOLLOWING_ERROR: &str = "Following error";
/// The begin of the name of a port's counter.
const LINKS_LOST: &str = "links lost at port ";

/// A time in which devices did not answer.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Absence {
    /// The time in s since the first frame.
    pub at: f64,
    /// The most devices that were absent at once.
    pub absent: u16,
    /// The devices before.
    pub of: u16,
    /// The time at which all answered again.
    pub until: Option<f64>,
}

#[derive(Debug, Serialize)]
pub struct FileReport {
    pub packets: u64,
    pub ethercat_frames: u64,
    pub other_packets: u64,
    /// The time of the first EtherCAT frame in ns since 1970.
    pub began_ns: u64,
    pub seconds: f64,
    pub sent: u64,
    pub answered: u64,
    pub lost: u64,
    /// The number of answers whose request is not in the recording.
    pub without_request: u64,
    /// The number of requests whose answer is behind the end of the recording.
    pub open: u64,
    /// Problems of the file itself.
    pub remarks: Vec<String>,
}

#[derive(Debug, Serialize)]
pub struct DeviceReport {
    pub position: Option<u16>,
    pub station: Option<u16>,
    pub alias: Option<u16>,
    /// The name from machine file, ESI, EEPROM or 0x1008, in this order.
    pub name: Option<String>,
    pub vendor: Option<u32>,
    pub vendor_name: Option<&'static str>,
    pub product: Option<u32>,
    pub revision: Option<u32>,
    pub serial: Option<u32>,
    /// The states in order.
    pub states: Vec<String>,
    /// The last state.
    pub state: Option<String>,
    pub al_error: bool,
    pub al_code: Option<u16>,
    /// The process data from the MainDevice in bytes.
    pub output_bytes: u32,
    pub input_bytes: u32,
    pub sync_managers: Vec<SyncManagerReport>,
    pub fmmus: usize,
    /// The SYNC0 cycle in ns, if started.
    pub sync0_ns: Option<u32>,
    pub eeprom_words: usize,
    /// Error counters other than 0: name and count.
    pub errors: Vec<(String, u8)>,
    pub reads: u64,
    pub writes: u64,
    pub failed_transfers: u64,
    pub emergencies: u64,
    /// The number of mailbox messages in both directions, by protocol.
    pub mailbox_messages: BTreeMap<&'static str, u64>,
    /// The AL status codes, each once in order of first occurrence.
    pub al_errors: Vec<u16>,
    pub emergency_codes: Vec<u16>,
}

#[derive(Debug, Serialize)]
pub struct SyncManagerReport {
    pub number: u8,
    pub start: u16,
    pub len: u16,
    /// `mailbox out`, `mailbox in`, `outputs` or `inputs`.
    pub usage: &'static str,
}

/// One event line.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Line {
    /// The time in s since the first frame.
    pub at: f64,
    /// The devices; empty: the bus.
    pub devices: Vec<usize>,
    pub text: String,
    pub trouble: bool,
    /// The number of consecutive occurrences.
    pub times: u32,
}

#[derive(Debug, Serialize)]
pub struct TransferReport {
    pub at: f64,
    pub device: usize,
    pub took_ns: u64,
    pub write: bool,
    pub index: u16,
    pub sub: u8,
    pub complete: bool,
    pub name: Option<String>,
    pub bytes: usize,
    pub segments: u32,
    pub value: String,
    /// `done`, `aborted`, `refused` or `no answer`.
    pub ended: &'static str,
    pub code: Option<u32>,
}

/// One datagram of the cycle.
#[derive(Debug, Serialize)]
pub struct CycleReport {
    pub command: &'static str,
    pub logical_address: u32,
    pub bytes: usize,
    pub count: u64,
    pub lost: u64,
    /// The usual interval in ns.
    pub cycle_ns: u64,
    pub interval_min_ns: u64,
    pub interval_p1_ns: u64,
    pub interval_p99_ns: u64,
    pub interval_max_ns: u64,
    /// Intervals with at least one skipped cycle: end and length.
    pub gaps: Vec<(f64, u64)>,
    pub round_trip_p50_ns: Option<u64>,
    pub round_trip_max_ns: Option<u64>,
    pub usual_wkc: Option<u16>,
    /// Working counters and their number of answers.
    pub wkc: Vec<(u16, u64)>,
    /// The changes of the working counter.
    pub runs: Vec<WkcRun>,
    pub more_runs: u64,
}

/// Consecutive cycles with one working counter; `None`: no answer.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct WkcRun {
    pub at: f64,
    pub wkc: Option<u16>,
    pub cycles: u64,
}

#[derive(Debug, Serialize)]
pub struct ClocksReport {
    /// The station address of the reference clock.
    pub reference: Option<u16>,
    pub readings: u64,
    pub rate_ppm: Option<f64>,
    /// The median difference between intervals of the reference clock and of the recording.
    pub jitter_p50_ns: Option<u64>,
    pub jitter_p99_ns: Option<u64>,
    pub differences: Vec<ClockReport>,
}

/// The system time differences of a device. Absolute values, except the last.
#[derive(Debug, Serialize)]
pub struct ClockReport {
    pub station: u16,
    pub readings: u64,
    pub p50_ns: u64,
    pub p99_ns: u64,
    pub max_ns: u64,
    pub last_ns: i64,
}

#[derive(Debug, Serialize)]
pub struct AxisReport {
    pub device: usize,
    pub name: String,
    pub cycles: u64,
    /// True if the operation was enabled. Other axes have no plots.
    pub commanded: bool,
    /// The CiA 402 states and their start times.
    pub states: Vec<(f64, String)>,
    pub modes: Vec<(f64, String)>,
    pub error_code: Option<u16>,
    /// The unit of positions: counts, or that of the machine file.
    pub unit: String,
    /// The largest difference between target and actual position in CSP while Operation enabled.
    pub largest_following_error: Option<f64>,
    pub travelled: Option<(f64, f64)>,
    pub plots: Vec<Plot>,
}

/// The curves of a target and an actual value.
#[derive(Debug, Serialize)]
pub struct Plot {
    pub title: &'static str,
    pub unit: String,
    /// Time in s, minimum, maximum.
    pub target: Vec<(f64, f64, f64)>,
    pub actual: Vec<(f64, f64, f64)>,
}

/// Returns a short name of a device.
#[must_use]
pub fn called(place: usize, device: &DeviceReport) -> String {
    device
        .name
        .clone()
        .unwrap_or_else(|| format!("device {place}"))
}

/// Returns the highest state that a device reached.
#[must_use]
pub fn highest(device: &DeviceReport) -> Option<&str> {
    let rank = |name: &&String| {
        [
            AlState::Init,
            AlState::Bootstrap,
            AlState::PreOp,
            AlState::SafeOp,
            AlState::Op,
        ]
        .iter()
        .position(|state| state.to_string() == **name)
    };
    device.states.iter().max_by_key(rank).map(String::as_str)
}
