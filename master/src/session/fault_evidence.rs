//! Collects the evidence after a failed run and builds the fault report.

use std::time::{SystemTime, UNIX_EPOCH};

use super::events::EventLine;
use super::{Cause, Error, Options};
use crate::acyclic::DeviceRef;
use crate::acyclic::topology::{self, ParentPort};
use crate::bringup::{Bus, name_at};
use crate::clock::{Clock, Nanos};
use crate::config::Machine;
use crate::link::LinkStats;
use crate::post_mortem::evidence::Stopped;
use crate::post_mortem::report::{AxisSection, CycleRecord, DeviceSection, Stop};
use crate::post_mortem::{
    DeviceEvidence, DeviceSnapshot, Evidence, FaultReport, Witnessed, diagnose,
};
use crate::rt::axis::RtAxis;
use crate::rt::exchange::{ErrorCounters, SubDeviceDiagnostics, Window};
use crate::rt::flight_recorder::FlightRecorder;
use crate::rt::stats::Stats;

/// The evidence of a failed bring-up.
#[derive(Debug, Default)]
pub(super) struct BringUpEvidence {
    /// One snapshot per SubDevice in segment order; empty if no device could be read.
    pub looks: Vec<DeviceSnapshot>,
    pub link: LinkStats,
    /// `true` if a link was open.
    pub on_the_bus: bool,
}

/// The state of a SubDevice when the cycle began.
#[derive(Debug)]
pub(super) struct InitialDeviceState {
    at: DeviceRef,
    dl_status: u16,
}

/// Returns the initial state of all devices in the order of the machine file.
pub(super) fn places(bus: &Bus) -> Vec<InitialDeviceState> {
    let devices = bus.devices.iter();
    let place = |device: &crate::bringup::BusDevice| InitialDeviceState {
        at: device.at.clone(),
        dl_status: device.dl_status,
    };
    devices.map(place).collect()
}

/// The data of the cycle that a fault report needs.
#[derive(Debug)]
pub(super) struct RunEvidence<'a> {
    pub places: Vec<InitialDeviceState>,
    pub witnessed: Witnessed,
    pub diagnoses: &'a [SubDeviceDiagnostics],
    pub windows: &'a [Window],
    pub stats: &'a Stats,
    pub axes: &'a [RtAxis],
    pub history: &'a FlightRecorder,
    pub started: Nanos,
    pub link: LinkStats,
    pub events: &'a [EventLine],
}

/// Returns the fault report of a failed bring-up. `None` if the failure does not involve a bus.
pub(super) fn of_bring_up(
    machine: &Machine,
    options: &Options,
    error: &Error,
    seen: BringUpEvidence,
) -> Option<Box<FaultReport>> {
    if !seen.on_the_bus || error.is_interruption() {
        return None;
    }
    let parents = parents(seen.looks.iter().map(|look| look.dl_status.unwrap_or(0)));
    let devices = seen.looks.into_iter().zip(parents).zip(0u16..);
    let devices = devices.map(|((look, parent), position)| DeviceEvidence {
        at: DeviceRef {
            name: name_at(machine, position),
            position,
            station: 0,
        },
        // Assumes that a device without an answer follows the last one that answered.
        parent: parent.or_else(|| Some((usize::from(position.checked_sub(1)?), 1))),
        grown: ErrorCounters {
            // Plugging in a cable counts as a lost link, so this counter says nothing here.
            lost_links: [0; 4],
            ..look.errors.unwrap_or_default()
        },
        recent: ErrorCounters {
            lost_links: [0; 4],
            ..look.errors.unwrap_or_default()
        },
        look,
    });
    let evidence = Evidence {
        cycle_ns: machine.bus.cycle_ns,
        link: seen.link,
        devices: devices.collect(),
        ..Evidence::default()
    };
    Some(build_report(machine, options, error, &evidence))
}

/// Returns the upstream device and its port for each SubDevice in segment order.
fn parents(dl_status: impl Iterator<Item = u16>) -> Vec<Option<(usize, u8)>> {
    let parents = topology::parents(dl_status).into_iter();
    let place = |parent: ParentPort| (usize::from(parent.device), parent.port);
    parents.map(|parent| parent.map(place)).collect()
}

/// Returns the fault report of a failed run. `None` if the user interrupted the run or the
/// recording failed.
pub(super) fn of_run(
    machine: &Machine,
    options: &Options,
    error: &Error,
    left: RunEvidence<'_>,
) -> Option<Box<FaultReport>> {
    if matches!(*error.cause, Cause::Interrupted | Cause::Record(_)) {
        return None;
    }
    let group = left.witnessed.group;
    let diagnoses = left.diagnoses.iter().zip(left.windows);
    let mut places: Vec<_> = left.places.into_iter().zip(diagnoses).collect();
    places.sort_by_key(|(place, _)| place.at.position);
    let parents = parents(places.iter().map(|(place, _)| place.dl_status));
    let mut looks = left.witnessed.looks.into_iter();
    let devices = places.into_iter().zip(parents);
    let devices = devices.map(|((place, (diagnosis, window)), parent)| {
        let look = looks.next().unwrap_or_default();
        DeviceEvidence {
            at: place.at,
            parent,
            grown: match &look.errors {
                Some(errors) => diagnosis.grown_to(errors),
                None => diagnosis.grown(),
            },
            recent: window.increments(&diagnosis.latest(look.errors.as_ref())),
            look,
        }
    });
    let notes: Vec<_> = left.stats.journal.entries().copied().collect();
    let cause = error.origin().unwrap_or(error);
    // Before Op, every event since the start may be the cause, so no stop limits the search.
    let stop =
        Stopped::find(&notes, group, cause.is_of_cycle()).filter(|_| !cause.is_on_the_way_to_op());
    let from = stop.map_or(u64::MAX, |stop| stop.cycle);
    let mut cycles = left.history.cycles().map(|(cycle, _)| cycle);
    let first = cycles.next().map_or(u64::MAX, |cycle| cycle.number);
    // The recorder may hold the cycles of a later stop. Those are not used.
    let mut cycles = cycles.filter(|cycle| first <= from && cycle.number >= from);
    let evidence = Evidence {
        cycle_ns: machine.bus.cycle_ns,
        stop,
        al_status: cycles.find_map(|cycle| cycle.al_status),
        notes,
        counters: left.stats.counters,
        link: left.link,
        devices: devices.collect(),
    };
    let mut fault_report = build_report(machine, options, error, &evidence);
    fault_report.stop = Stop::of(&evidence, left.started);
    fault_report.events = left.events.to_vec();
    let setups = machine.axes.iter();
    fault_report.axes = setups
        .zip(left.axes)
        .map(|(setup, slot)| {
            let status = slot.axis.status();
            AxisSection {
                name: setup.name.clone(),
                unit: setup.unit.clone(),
                state: status.state.to_string(),
                fault: status.fault.map(|fault| fault.to_string()),
                trip: status.trip.map(|trip| trip.to_string()),
            }
        })
        .collect();
    let cycles = left.history.cycles();
    fault_report.cycles = cycles
        .map(|(cycle, axes)| CycleRecord::new(cycle, axes, left.started))
        .collect();
    Some(fault_report)
}

fn build_report(
    machine: &Machine,
    options: &Options,
    error: &Error,
    evidence: &Evidence,
) -> Box<FaultReport> {
    let diagnosis = diagnose(error, evidence);
    Box::new(FaultReport {
        headline: diagnosis.cause.to_string(),
        cause: diagnosis.cause,
        also: diagnosis.also,
        error: error.to_string(),
        machine: machine.path.display().to_string(),
        machine_sha256: machine.sha256.to_string(),
        version: crate::VERSION,
        time: match options.clock {
            Clock::Real => "real",
            Clock::Virtual => "virtual",
        },
        unix_time: match options.clock {
            Clock::Real => seconds_since_1970(),
            // A repeated run in virtual time gives the same fault report.
            Clock::Virtual => None,
        },
        cycle_ns: machine.bus.cycle_ns,
        stop: None,
        counters: evidence.counters,
        link: evidence.link,
        events: Vec::new(),
        devices: DeviceSection::all(evidence),
        axes: Vec::new(),
        cycles: Vec::new(),
    })
}

fn seconds_since_1970() -> Option<u64> {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).ok()?;
    Some(since.as_secs())
}
