//! Everything that was found, as it is printed, written as JSON or drawn.
//!
//! - `build`: devices, story and transfers of a segment; `cyclic`: cycle, clocks and axes;
//! - `trouble`: what of it wants looking at.

use serde::Serialize;

use crate::bringup::AlState;

mod build;
mod cyclic;
mod trouble;

pub(super) use build::report;

/// A recording in words and numbers.
#[derive(Debug, Serialize)]
pub struct Report {
    pub file: FileReport,
    /// What went wrong, the worst first.
    pub trouble: Vec<String>,
    /// Devices that answered a broadcast read, at most.
    pub answering: Option<u16>,
    pub devices: Vec<DeviceReport>,
    /// What happened, in order: changes of state, refusals, emergencies.
    pub story: Vec<Line>,
    /// Likewise, with every transfer.
    pub events: Vec<Line>,
    pub more_events: u64,
    pub transfers: Vec<TransferReport>,
    pub more_transfers: u64,
    pub cycle: Vec<CycleReport>,
    pub clocks: ClocksReport,
    pub axes: Vec<AxisReport>,
}

#[derive(Debug, Serialize)]
pub struct FileReport {
    pub packets: u64,
    pub ethercat_frames: u64,
    pub other_packets: u64,
    /// When the first EtherCAT frame passed, nanoseconds since 1970.
    pub began_ns: u64,
    pub seconds: f64,
    pub sent: u64,
    pub answered: u64,
    pub lost: u64,
    /// Answers whose request is not in the recording.
    pub without_request: u64,
    /// Requests that the recording's end cut off from their answer.
    pub open: u64,
    /// What is odd about the file itself.
    pub remarks: Vec<String>,
}

#[derive(Debug, Serialize)]
pub struct DeviceReport {
    pub position: Option<u16>,
    pub station: Option<u16>,
    pub alias: Option<u16>,
    /// By machine file, ESI, EEPROM or 0x1008, whatever there is first.
    pub name: Option<String>,
    pub vendor: Option<u32>,
    pub product: Option<u32>,
    pub revision: Option<u32>,
    pub serial: Option<u32>,
    /// States in the order in which they were reached.
    pub states: Vec<String>,
    /// The last one.
    pub state: Option<String>,
    pub al_error: bool,
    pub al_code: Option<u16>,
    /// Bytes of process data from and to the MainDevice.
    pub output_bytes: u32,
    pub input_bytes: u32,
    pub sync_managers: Vec<SyncManagerReport>,
    pub fmmus: usize,
    /// SYNC0's cycle where it is started, nanoseconds.
    pub sync0_ns: Option<u32>,
    pub eeprom_words: usize,
    /// Error counters that are not 0: what is counted and how often.
    pub errors: Vec<(String, u8)>,
    pub reads: u64,
    pub writes: u64,
    pub failed_transfers: u64,
    pub emergencies: u64,
    /// AL status codes of errors, and codes of emergencies, each once and in the order in which they came first.
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

/// One line of the story.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Line {
    /// Seconds since the first frame.
    pub at: f64,
    /// Empty: the bus.
    pub devices: Vec<usize>,
    pub text: String,
    pub trouble: bool,
    /// How often in a row.
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
    /// The interval that is usual.
    pub cycle_ns: u64,
    pub interval_min_ns: u64,
    pub interval_p1_ns: u64,
    pub interval_p99_ns: u64,
    pub interval_max_ns: u64,
    /// Intervals in which at least one cycle was left out: when they ended, and how long they were.
    pub gaps: Vec<(f64, u64)>,
    pub round_trip_p50_ns: Option<u64>,
    pub round_trip_max_ns: Option<u64>,
    pub usual_wkc: Option<u16>,
    /// How many answers had which working counter.
    pub wkc: Vec<(u16, u64)>,
    /// When it changed.
    pub runs: Vec<WkcRun>,
    pub more_runs: u64,
}

/// Cycles in a row with one working counter; none where there was no answer.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct WkcRun {
    pub at: f64,
    pub wkc: Option<u16>,
    pub cycles: u64,
}

#[derive(Debug, Serialize)]
pub struct ClocksReport {
    /// Station of the clock whose time is distributed.
    pub reference: Option<u16>,
    pub readings: u64,
    pub rate_ppm: Option<f64>,
    /// How much intervals of the reference clock differ from those of the recording.
    pub jitter_p50_ns: Option<u64>,
    pub jitter_p99_ns: Option<u64>,
    pub differences: Vec<ClockReport>,
}

/// System time differences of a device, without sign but for the last.
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
    /// When which CiA 402 state began.
    pub states: Vec<(f64, String)>,
    pub modes: Vec<(f64, String)>,
    pub error_code: Option<u16>,
    /// Of positions: counts, or the machine file's unit.
    pub unit: String,
    /// Greatest distance between target and actual position in CSP while Operation enabled.
    pub largest_following_error: Option<f64>,
    pub travelled: Option<(f64, f64)>,
    pub plots: Vec<Plot>,
}

/// Two curves that belong together: target and actual.
#[derive(Debug, Serialize)]
pub struct Plot {
    pub title: &'static str,
    pub unit: String,
    /// Seconds, least, greatest.
    pub target: Vec<(f64, f64, f64)>,
    pub actual: Vec<(f64, f64, f64)>,
}

/// How a device is called where there is no room for more.
#[must_use]
pub fn called(place: usize, device: &DeviceReport) -> String {
    device
        .name
        .clone()
        .unwrap_or_else(|| format!("device {place}"))
}

/// The highest of the states that a device reached.
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
