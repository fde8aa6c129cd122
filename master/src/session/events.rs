//! What the cycle has noticed, in words.

use serde::Serialize;

use crate::clock::Nanos;
use crate::config::{Machine, duration};
use crate::rt::guard::StopCause;
use crate::rt::handover::Event;
use crate::rt::journal::{Entry, Journal, Note};
use crate::words::counted;

/// One thing that the cycle has noticed, or a run of the same in cycles that follow each other.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EventLine {
    /// From the first cycle on.
    pub at_s: f64,
    pub first_cycle: u64,
    pub last_cycle: u64,
    pub what: String,
    /// The machine, or a part of it, stops for it.
    pub failure: bool,
}

/// All that the journal has kept.
pub(super) fn lines(journal: &Journal, started: Nanos, machine: &Machine) -> Vec<EventLine> {
    let line = |entry: &Entry| EventLine {
        at_s: entry.time.saturating_sub(started) as f64 * 1e-9,
        first_cycle: entry.first_cycle,
        last_cycle: entry.last_cycle,
        what: told(&entry.note, machine),
        failure: matches!(
            entry.note,
            Note::Told(Event::Stopping { cause, .. } | Event::GroupStopping { cause, .. })
                if cause != StopCause::Requested
        ),
    };
    journal.entries().map(line).collect()
}

fn told(note: &Note, machine: &Machine) -> String {
    match *note {
        Note::Lost => "frames were not back before the deadline".to_owned(),
        Note::WorkingCounter(seen, expected) => {
            format!("the working counter was {seen} instead of {expected}")
        }
        Note::AlStatus(status, answered) => {
            format!("AL status 0x{status:02x} of {answered} SubDevices together")
        }
        Note::Late => "frames of an earlier cycle came back".to_owned(),
        Note::WokeLate(late) => format!("the thread woke up {} late", duration::show(late)),
        Note::Overrun(1) => "1 cycle was left out".to_owned(),
        Note::Overrun(missed) => format!("{missed} cycles were left out"),
        Note::OtherMainDevice(frames) => {
            let frames = usize::try_from(frames).unwrap_or(usize::MAX);
            format!(
                "{} of another MainDevice came",
                counted(frames, "EtherCAT frame")
            )
        }
        Note::LinkError => "the interface refused to send or to receive".to_owned(),
        Note::Told(event) => event_told(event, machine),
    }
}

fn event_told(event: Event, machine: &Machine) -> String {
    let axis = |axis: usize| {
        let mut axes = machine
            .devices
            .iter()
            .filter(|device| device.axis.is_some());
        axes.nth(axis).map_or("?", |device| device.name.as_str())
    };
    match event {
        Event::Refused {
            axis: at, reason, ..
        } => {
            format!("`{}` refused a command: {reason}", axis(at))
        }
        Event::PhaseLocked { .. } => "frames are in phase with SYNC0".to_owned(),
        Event::PhaseLost { .. } => "frames have lost their phase to SYNC0".to_owned(),
        Event::ClockOff {
            device,
            difference_ns,
            ..
        } => {
            let name = machine.devices.get(device).map_or("?", |d| d.name.as_str());
            clock_off(name, difference_ns)
        }
        Event::Stopping { cause, .. } => cause_told(cause, &axis),
        Event::GroupStopping { group, cause, .. } => {
            format!(
                "group `{}`: {}",
                machine.group_name(group),
                cause_told(cause, &axis)
            )
        }
        Event::GroupReleased { group, .. } => {
            format!("group `{}` has been reset", machine.group_name(group))
        }
    }
}

fn cause_told<'m>(cause: StopCause, axis: &impl Fn(usize) -> &'m str) -> String {
    match cause {
        StopCause::Requested => "stop: asked for".to_owned(),
        StopCause::DriveFault { axis: at } => {
            format!("stop: the drive of `{}` reports a fault", axis(at))
        }
        StopCause::Trip { axis: at, trip } => format!("stop: `{}`: {trip}", axis(at)),
        StopCause::BusLost { cycles, .. } => {
            format!("stop: {cycles} cycles in a row without a valid answer")
        }
        StopCause::EmergencyStop => "emergency stop".to_owned(),
        StopCause::FollowLost { axis: at } => {
            format!("stop: `{}` can follow no longer", axis(at))
        }
        StopCause::Controller => "stop: the controller panicked".to_owned(),
        StopCause::Panicked => "stop: the cycle panicked".to_owned(),
        StopCause::Unsupervised => "stop: the thread beside the cycle does not run".to_owned(),
        StopCause::LeftOp { al_status } => {
            format!("stop: a SubDevice has left Op, AL status 0x{al_status:02x}")
        }
        StopCause::Powered { axis: at } => {
            format!("stop: the drive of `{}` keeps its power", axis(at))
        }
    }
}

/// How far a clock is from the reference's.
pub(crate) fn clock_off(name: &str, difference_ns: i32) -> String {
    format!(
        "the clock of `{name}` is {} {} the reference clock",
        duration::show(u64::from(difference_ns.unsigned_abs())),
        if difference_ns > 0 {
            "ahead of"
        } else {
            "behind"
        },
    )
}
