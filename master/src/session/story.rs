//! Puts together what is known when a run has failed, and has it told.

use std::time::{SystemTime, UNIX_EPOCH};

use super::events::EventLine;
use super::{Options, RunError};
use crate::bringup::{Bus, DeviceRef};
use crate::clock::{Clock, Nanos};
use crate::config::{Locator, Machine};
use crate::link::LinkStats;
use crate::rt::exchange::{Diagnosis, ErrorCounters, Window};
use crate::rt::history::History;
use crate::rt::slot::AxisSlot;
use crate::rt::stats::Stats;
use crate::story::evidence::Stopped;
use crate::story::page::{AxisPage, CyclePage, DevicePage, Stop};
use crate::story::{DeviceEvidence, Evidence, Look, Story, Witnessed, diagnose, ports};

/// What was seen on a bus that did not come up.
#[derive(Debug, Default)]
pub(super) struct Seen {
    /// In the order of the segment; empty where nobody was asked.
    pub looks: Vec<Look>,
    pub link: LinkStats,
    /// A link was open.
    pub on_the_bus: bool,
}

/// A SubDevice as it was when the cycle began.
#[derive(Debug)]
pub(super) struct Place {
    at: DeviceRef,
    dl_status: u16,
}

/// In the order of the machine file.
pub(super) fn places(bus: &Bus) -> Vec<Place> {
    let devices = bus.devices.iter();
    let place = |device: &crate::bringup::BusDevice| Place {
        at: device.at.clone(),
        dl_status: device.dl_status,
    };
    devices.map(place).collect()
}

/// What the cycle leaves behind, as far as a story is concerned.
#[derive(Debug)]
pub(super) struct Left<'a> {
    pub places: Vec<Place>,
    pub witnessed: Witnessed,
    pub diagnoses: &'a [Diagnosis],
    pub windows: &'a [Window],
    pub stats: &'a Stats,
    pub axes: &'a [AxisSlot],
    pub history: &'a History,
    pub started: Nanos,
    pub link: LinkStats,
    pub events: &'a [EventLine],
}

/// `None` where the failure has nothing to do with a bus.
pub(super) fn of_bring_up(
    machine: &Machine,
    options: &Options,
    error: &RunError,
    seen: Seen,
) -> Option<Box<Story>> {
    if !seen.on_the_bus || matches!(error, RunError::Interrupted) {
        return None;
    }
    let status: Vec<u16> = seen
        .looks
        .iter()
        .map(|l| l.dl_status.unwrap_or(0))
        .collect();
    let parents = ports::parents(&status);
    let devices = seen.looks.into_iter().zip(parents).zip(0u16..);
    let devices = devices.map(|((look, parent), position)| DeviceEvidence {
        at: expected_at(machine, position),
        // The last one that answered is at least in front of one that does not.
        parent: parent.or_else(|| Some((usize::from(position.checked_sub(1)?), 1))),
        grown: ErrorCounters {
            // A cable that is plugged in is a link that was lost before.
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
    Some(told(machine, options, error, &evidence))
}

/// Where a machine file says which device is where; otherwise nobody has found out.
fn expected_at(machine: &Machine, position: u16) -> DeviceRef {
    let mut devices = machine.devices.iter();
    let named = devices.find(|device| device.at == Locator::Position(position));
    DeviceRef {
        name: named.map_or_else(
            || format!("device {position}"),
            |device| device.name.clone(),
        ),
        position,
        station: 0,
    }
}

/// `None` where somebody only interrupted it.
pub(super) fn of_run(
    machine: &Machine,
    options: &Options,
    error: &RunError,
    left: Left<'_>,
) -> Option<Box<Story>> {
    if matches!(error, RunError::Interrupted | RunError::Record(_)) {
        return None;
    }
    let group = left.witnessed.group;
    let diagnoses = left.diagnoses.iter().zip(left.windows);
    let mut places: Vec<_> = left.places.into_iter().zip(diagnoses).collect();
    places.sort_by_key(|(place, _)| place.at.position);
    let status: Vec<u16> = places.iter().map(|(place, _)| place.dl_status).collect();
    let parents = ports::parents(&status);
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
            recent: window.grown(&diagnosis.latest(look.errors.as_ref())),
            look,
        }
    });
    let notes: Vec<_> = left.stats.journal.entries().copied().collect();
    let cause = error.cause().unwrap_or(error);
    // On the way to Op whatever was seen may be what keeps it from there.
    let stop =
        Stopped::find(&notes, group, cause.is_of_cycle()).filter(|_| !cause.is_on_the_way_to_op());
    let from = stop.map_or(u64::MAX, |stop| stop.cycle);
    let mut cycles = left.history.cycles().map(|(cycle, _)| cycle);
    let first = cycles.next().map_or(u64::MAX, |cycle| cycle.number);
    // What was kept is of another stop where it began later.
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
    let mut story = told(machine, options, error, &evidence);
    story.stop = Stop::of(&evidence, left.started);
    story.events = left.events.to_vec();
    let setups = machine
        .devices
        .iter()
        .filter_map(|device| Some((device, device.axis.as_ref()?)));
    story.axes = setups
        .zip(left.axes)
        .map(|((device, setup), slot)| {
            let status = slot.axis.status();
            AxisPage {
                name: device.name.clone(),
                unit: setup.unit.clone(),
                state: status.state.to_string(),
                fault: status.fault.map(|fault| fault.to_string()),
                trip: status.trip.map(|trip| trip.to_string()),
            }
        })
        .collect();
    let cycles = left.history.cycles();
    story.cycles = cycles
        .map(|(cycle, axes)| CyclePage::new(cycle, axes, left.started))
        .collect();
    Some(story)
}

fn told(machine: &Machine, options: &Options, error: &RunError, evidence: &Evidence) -> Box<Story> {
    let diagnosis = diagnose(error, evidence);
    Box::new(Story {
        headline: diagnosis.cause.to_string(),
        cause: diagnosis.cause,
        also: diagnosis.also,
        error: error.to_string(),
        machine: machine.path.display().to_string(),
        time: match options.clock {
            Clock::Real => "real",
            Clock::Virtual => "virtual",
        },
        unix_time: match options.clock {
            Clock::Real => seconds_since_1970(),
            // The same run tells the same story.
            Clock::Virtual => None,
        },
        cycle_ns: machine.bus.cycle_ns,
        stop: None,
        counters: evidence.counters,
        link: evidence.link,
        events: Vec::new(),
        devices: DevicePage::all(evidence),
        axes: Vec::new(),
        cycles: Vec::new(),
    })
}

fn seconds_since_1970() -> Option<u64> {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).ok()?;
    Some(since.as_secs())
}
