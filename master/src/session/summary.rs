//! What a run comes to, in numbers.

use ecaxis_axis::{AxisStatus, Mode, Scale};
use serde::Serialize;

use crate::clock::Clock;
use crate::config::Machine;
use crate::link::capture::RecordStats;
use crate::rt::slot::AxisSlot;
use crate::rt::stats::{Counters, Percentiles, Stats};
use crate::supervise::Ended;

/// The result of a run. In virtual time every figure depends on the file and the seed alone.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    pub machine: String,
    pub devices: usize,
    /// `"real"` or `"virtual"`.
    pub time: &'static str,
    pub cycle_ns: u64,
    /// Cycles and overruns times the cycle.
    pub machine_seconds: f64,
    /// Complete runs of the program.
    pub program_runs: u32,
    /// Ended by the user.
    pub interrupted: bool,
    pub counters: Counters,
    /// Wake-up after the planned release of a frame.
    pub wake_up_lateness: Percentiles,
    /// Planned release to the last answer.
    pub round_trip: Percentiles,
    /// Amount of the phase error against SYNC0, once locked; `None` without distributed clocks.
    pub dc_phase_error: Option<Percentiles>,
    /// Wake-up to the end of the cycle's work.
    pub work: Percentiles,
    pub axes: Vec<AxisSummary>,
    pub recorded_frames: Option<u64>,
    pub recorded_frames_dropped: Option<u64>,
}

/// One axis at the end, in user units. Positions are those of the last cycle in Operation enabled.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AxisSummary {
    pub name: String,
    pub unit: String,
    pub mode: String,
    /// Whether it ever was in Operation enabled.
    pub was_enabled: bool,
    pub final_position: f64,
    pub target_position: f64,
    /// Target minus final position in the drive's counts; CSP only.
    pub final_error_counts: Option<i64>,
    pub largest_following_error: f64,
    pub final_state: String,
    pub fault: Option<String>,
    pub trip: Option<String>,
}

fn error_counts(scale: &Scale, status: &AxisStatus) -> i64 {
    ((status.target_position - status.position) * scale.counts_per_unit()).round() as i64
}

impl Summary {
    pub(super) fn new(
        machine: &Machine,
        clock: Clock,
        axes: &[AxisSlot],
        stats: &Stats,
        ended: Ended,
        record: Option<RecordStats>,
    ) -> Self {
        let setups = machine
            .devices
            .iter()
            .filter_map(|d| Some((d, d.axis.as_ref()?)));
        let axes = setups
            .zip(axes)
            .map(|((device, setup), slot)| {
                let now = slot.axis.status();
                let last = slot.last_enabled.unwrap_or(now);
                AxisSummary {
                    name: device.name.clone(),
                    unit: setup.unit.clone(),
                    mode: setup.mode.to_string(),
                    was_enabled: slot.last_enabled.is_some(),
                    final_position: last.position,
                    target_position: last.target_position,
                    final_error_counts: (last.mode == Mode::Csp && slot.last_enabled.is_some())
                        .then(|| error_counts(&setup.config.scale, &last)),
                    largest_following_error: slot.largest_following_error,
                    final_state: now.state.to_string(),
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
            devices: machine.devices.len(),
            time: match clock {
                Clock::Real => "real",
                Clock::Virtual => "virtual",
            },
            cycle_ns,
            machine_seconds: turns as f64 * cycle_ns as f64 * 1e-9,
            program_runs: ended.runs,
            interrupted: ended.interrupted,
            counters: stats.counters,
            wake_up_lateness: stats.lateness.summary(),
            round_trip: stats.round_trip.summary(),
            dc_phase_error: (phase.count > 0).then_some(phase),
            work: stats.work.summary(),
            axes,
            recorded_frames: record.map(|r| r.written),
            recorded_frames_dropped: record.map(|r| r.dropped),
        }
    }
}
