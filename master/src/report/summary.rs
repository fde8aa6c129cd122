//! The result of a run in numbers.

use ecaxis_axis::units::UserUnits;
use ecaxis_axis::{AxisStatus, Mode, Scale};
use ecaxis_ecat::index::{GroupIndex, IndexVec};
use serde::Serialize;

use crate::clock::{Clock, Nanos};
use crate::config::Machine;
use crate::eoe::EthernetCounters;
use crate::link::LinkStats;
use crate::link::capture::RecordStats;
use crate::rt::axis::RtAxis;
use crate::rt::exchange::{ErrorCounters, SubDeviceDiagnostics};
use crate::rt::gateway::Gateway;
use crate::rt::stats::{Counters, Percentiles, Stats};
use crate::sys::process::ThreadUsage;

use super::ProbeCapture;
use super::emergencies::EmergencyLine;
use super::events::EventLine;

/// The result of a run. In virtual time all values depend only on the machine file and the seed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    pub machine: String,
    /// SHA-256 of the machine file and the files that it names.
    pub machine_sha256: String,
    /// The version of ecaxis.
    pub version: &'static str,
    pub devices: usize,
    /// `"real"` or `"virtual"`.
    pub time: &'static str,
    pub cycle_ns: u64,
    /// The number of cycles and overruns, multiplied by the cycle time in s.
    pub machine_seconds: f64,
    /// The number of completed program runs.
    pub program_runs: u32,
    /// `true` if the user ended the run.
    pub interrupted: bool,
    pub counters: Counters,
    /// Received traffic other than answers.
    pub link: LinkStats,
    /// The delay from the planned release of a frame to the wake-up.
    pub wake_up_lateness: Percentiles,
    /// The time from planned release to the last answer.
    pub round_trip: Percentiles,
    /// The absolute phase error against SYNC0 after lock; `None` without distributed clocks.
    pub dc_phase_error: Option<Percentiles>,
    /// The time from wake-up to the end of the cycle's work.
    pub work: Percentiles,
    /// The real-time thread; `None` in virtual time.
    pub thread: Option<ThreadSummary>,
    pub axes: Vec<AxisSummary>,
    /// The probing results, one per step.
    pub probes: Vec<ProbeCapture>,
    /// SubDevices whose error counters have grown.
    pub errors: Vec<DeviceErrors>,
    /// The CANopen gateways and the nodes behind them, in the order of the file.
    pub gateways: Vec<GatewaySummary>,
    /// The ports of the virtual switch: devices with EoE in the order of the file, then the interface.
    pub ethernet: Vec<EthernetCounters>,
    /// The last events of the cycle, oldest first.
    pub events: Vec<EventLine>,
    /// The emergencies of the devices, oldest first, up to a fixed number.
    pub emergencies: Vec<EmergencyLine>,
    /// The number of emergencies not in the list: not kept, or lost because a device's queue was
    /// full.
    pub more_emergencies: u64,
    /// The stops of groups during which the machine continued.
    pub group_stops: Vec<GroupStop>,
    pub recorded_frames: Option<u64>,
    pub recorded_frames_dropped: Option<u64>,
}

/// The increase of a SubDevice's error counters (0x0300–0x0313) since the cycle began. 255 means
/// 255 or more. Four ports each.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct DeviceErrors {
    pub name: String,
    pub invalid_frames: [u8; 4],
    pub rx_errors: [u8; 4],
    pub forwarded: [u8; 4],
    pub lost_links: [u8; 4],
    pub processing_unit: u8,
    pub pdi: u8,
}

/// Returns the devices whose counters have grown.
pub(crate) fn device_errors(
    machine: &Machine,
    diagnoses: &[SubDeviceDiagnostics],
) -> Vec<DeviceErrors> {
    let devices = machine.devices.iter().zip(diagnoses);
    let grown = devices.map(|(device, found)| (device, found.grown()));
    grown
        .filter(|(_, grown)| *grown != ErrorCounters::default())
        .map(|(device, grown)| DeviceErrors {
            name: device.name.clone(),
            invalid_frames: grown.invalid_frames,
            rx_errors: grown.rx_errors,
            forwarded: grown.forwarded,
            lost_links: grown.lost_links,
            processing_unit: grown.processing,
            pdi: grown.pdi,
        })
        .collect()
}

/// A CANopen gateway at the end.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct GatewaySummary {
    pub name: String,
    /// The errors that its general status has reported in this run.
    pub errors: Vec<&'static str>,
    pub nodes: Vec<NodeSummary>,
}

/// A node behind a gateway at the end.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct NodeSummary {
    pub id: u8,
    pub drive: &'static str,
    /// The last state that the gateway has reported, before the end of the run if it ended in order.
    pub state: String,
    /// The number of times that the node was lost.
    pub losses: u32,
}

pub(crate) fn gateways(machine: &Machine, gateways: &[Gateway]) -> Vec<GatewaySummary> {
    let summaries = gateways.iter().filter_map(|gateway| {
        let device = machine.devices.get(gateway.device())?;
        let drive = |id: u8| {
            let mut nodes = device.gateway.iter().flat_map(|gateway| &gateway.nodes);
            nodes
                .find(|node| node.id == id)
                .map_or("?", |node| node.drive)
        };
        let nodes = gateway.nodes().map(|(id, state, losses)| NodeSummary {
            id,
            drive: drive(id),
            state: state.to_string(),
            losses,
        });
        Some(GatewaySummary {
            name: device.name.clone(),
            errors: gateway.general_seen().texts().collect(),
            nodes: nodes.collect(),
        })
    });
    summaries.collect()
}

/// The real-time thread from the first to the last cycle.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ThreadSummary {
    #[serde(flatten)]
    pub used: ThreadUsage,
    /// The CPU load in percent.
    pub load_percent: f64,
    /// The delay of wake-ups from sleep, before any spinning. `count` is 0 if the thread never
    /// slept.
    pub sleep_lateness: Percentiles,
    /// The spin time before a release at the end of the run, in ns.
    pub spin_ns: u64,
}

impl ThreadSummary {
    pub(crate) fn new(used: ThreadUsage, wall_ns: u64, spin_ns: u64, stats: &Stats) -> Self {
        Self {
            used,
            load_percent: used.load_percent(wall_ns),
            sleep_lateness: stats.slept.summary(),
            spin_ns,
        }
    }
}

/// The inputs of the summary that the cycle does not provide.
pub(crate) struct SummaryInputs {
    pub program_runs: u32,
    pub interrupted: bool,
    /// The probing results, one per step.
    pub captures: Vec<ProbeCapture>,
    pub group_stops: Vec<GroupStop>,
    pub link: LinkStats,
    pub thread: Option<ThreadSummary>,
    pub record: Option<RecordStats>,
    pub errors: Vec<DeviceErrors>,
    pub gateways: Vec<GatewaySummary>,
    pub ethernet: Vec<EthernetCounters>,
    pub events: Vec<EventLine>,
    /// The kept emergencies and the number of further ones.
    pub emergencies: (Vec<EmergencyLine>, u64),
    /// The time at which the first cycle was due.
    pub started: Nanos,
    /// The time at which each group of axes began to stop.
    pub stops: IndexVec<GroupIndex, Option<Nanos>>,
}

/// A group of axes that stopped while the machine continued.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct GroupStop {
    pub group: String,
    pub cause: String,
    /// `true` if the group has been reset since.
    pub released: bool,
}

/// One axis at the end, in user units. Positions are those of the last cycle in Operation enabled.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AxisSummary {
    pub name: String,
    pub unit: String,
    /// The last mode in which the axis had power, as the machine file writes it.
    pub mode: String,
    /// `true` if the axis was ever in Operation enabled.
    pub was_enabled: bool,
    pub final_position: f64,
    pub target_position: f64,
    /// The position within one turn; modulo axes only. `final_position` counts on over several
    /// turns.
    pub final_place: Option<f64>,
    pub target_place: Option<f64>,
    /// Target minus final position in the drive's counts; CSP only.
    pub final_error_counts: Option<i64>,
    pub largest_following_error: f64,
    pub final_state: String,
    /// The time in s from the first cycle to the drive's last answer, if that was before the axis
    /// began to stop. Position and state are of that time.
    pub last_heard_s: Option<f64>,
    pub fault: Option<String>,
    pub trip: Option<String>,
}

fn error_counts(scale: &Scale, status: &AxisStatus) -> i64 {
    ((status.target_position - status.position) * scale.counts_per_unit()).round() as i64
}

/// Returns `None` if the drive still answered when the stop began.
fn last_fresh_age(slot: &RtAxis, aside: &SummaryInputs) -> Option<f64> {
    let stop = aside.stops.get(slot.group).copied().flatten()?;
    let heard = slot.heard.unwrap_or(aside.started);
    (heard < stop).then(|| heard.saturating_sub(aside.started) as f64 * 1e-9)
}

/// Returns the mode as the machine file writes it, for example `csp`.
fn name_of(mode: Mode) -> String {
    let known = ecaxis_esi::Mode::ALL.into_iter();
    let mut known = known.filter(|known| known.code() == mode.code());
    known
        .next()
        .map_or_else(|| mode.to_string(), |known| known.name().to_owned())
}

impl Summary {
    pub(crate) fn new(
        machine: &Machine,
        clock: Clock,
        axes: &[RtAxis],
        stats: &Stats,
        aside: SummaryInputs,
    ) -> Self {
        let setups = machine.axes.iter();
        let axes = setups
            .zip(axes)
            .map(|(setup, slot)| {
                let now = slot.axis.status();
                let last = slot.last_enabled.unwrap_or(now);
                let scale = &setup.config.scale;
                let turns = scale.modulo().is_some();
                let place = |position| turns.then(|| scale.place(UserUnits(position)).0);
                AxisSummary {
                    name: setup.name.clone(),
                    unit: setup.unit.clone(),
                    mode: name_of(last.mode),
                    was_enabled: slot.last_enabled.is_some(),
                    final_position: last.position,
                    target_position: last.target_position,
                    final_place: place(last.position),
                    target_place: place(last.target_position),
                    final_error_counts: (last.mode == Mode::Csp && slot.last_enabled.is_some())
                        .then(|| error_counts(&setup.config.scale, &last)),
                    largest_following_error: slot.largest_following_error,
                    final_state: now.state.to_string(),
                    last_heard_s: last_fresh_age(slot, &aside),
                    fault: now.fault.map(|fault| fault.to_string()),
                    trip: now.trip.map(|trip| trip.to_string()),
                }
            })
            .collect();
        let cycle_ns = machine.bus.cycle_ns;
        let turns = stats.counters.cycles + stats.counters.overruns;
        let phase = stats.phase.summary();
        Self {
            machine: machine.path.display().to_string(),
            machine_sha256: machine.sha256.to_string(),
            version: crate::VERSION,
            devices: machine.devices.len(),
            time: match clock {
                Clock::Real => "real",
                Clock::Virtual => "virtual",
            },
            cycle_ns,
            machine_seconds: turns as f64 * cycle_ns as f64 * 1e-9,
            program_runs: aside.program_runs,
            interrupted: aside.interrupted,
            counters: stats.counters,
            link: aside.link,
            wake_up_lateness: stats.lateness.summary(),
            round_trip: stats.round_trip.summary(),
            dc_phase_error: (phase.count > 0).then_some(phase),
            work: stats.work.summary(),
            thread: aside.thread,
            axes,
            probes: aside.captures,
            errors: aside.errors,
            gateways: aside.gateways,
            ethernet: aside.ethernet,
            events: aside.events,
            emergencies: aside.emergencies.0,
            more_emergencies: aside.emergencies.1,
            group_stops: aside.group_stops,
            recorded_frames: aside.record.map(|r| r.written),
            recorded_frames_dropped: aside.record.map(|r| r.dropped),
        }
    }
}
