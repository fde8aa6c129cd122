//! Events of the cycle as text.

use ecaxis_ecat::index::AxisIndex;
use serde::Serialize;

use crate::clock::{COMMON_CLOCK, Nanos};
use crate::config::{Machine, duration};
use crate::rt::bus_monitor::StopCause;
use crate::rt::channel::Event;
use crate::rt::event_log::{Entry, EventLog, LogEntryKind};
use crate::text::pluralize;

/// One event of the cycle, or the same event in consecutive cycles.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EventLine {
    /// The time since the first cycle in s.
    pub at_s: f64,
    pub first_cycle: u64,
    pub last_cycle: u64,
    pub what: String,
    /// `true` if the machine or one of its groups stops because of this event.
    pub failure: bool,
}

/// Returns all events that the log has kept.
pub(crate) fn lines(journal: &EventLog, started: Nanos, machine: &Machine) -> Vec<EventLine> {
    let line = |entry: &Entry| EventLine {
        at_s: entry.time.saturating_sub(started) as f64 * 1e-9,
        first_cycle: entry.first_cycle,
        last_cycle: entry.last_cycle,
        what: describe_note(&entry.note, machine),
        failure: matches!(
            entry.note,
            LogEntryKind::Event(Event::Stopping { cause, .. } | Event::GroupStopping { cause, .. })
                if cause != StopCause::Requested
        ),
    };
    journal.entries().map(line).collect()
}

fn describe_note(note: &LogEntryKind, machine: &Machine) -> String {
    match *note {
        LogEntryKind::Lost => "frames were not back before the deadline".to_owned(),
        LogEntryKind::WorkingCounter(seen, expected) => {
            format!("the working counter was {seen} instead of {expected}")
        }
        LogEntryKind::AlStatus(status, answered) => {
            format!("AL status 0x{status:02x} of {answered} SubDevices together")
        }
        LogEntryKind::Late => "frames of an earlier cycle came back".to_owned(),
        LogEntryKind::WokeLate(late) => format!("the thread woke up {} late", duration::show(late)),
        LogEntryKind::Overrun(1) => "1 cycle was left out".to_owned(),
        LogEntryKind::Overrun(missed) => format!("{missed} cycles were left out"),
        LogEntryKind::OtherMainDevice(frames) => {
            let frames = usize::try_from(frames).unwrap_or(usize::MAX);
            format!(
                "{} of another MainDevice came",
                pluralize(frames, "EtherCAT frame")
            )
        }
        LogEntryKind::LinkError => "the interface refused to send or to receive".to_owned(),
        LogEntryKind::Event(event) => describe_event(event, machine),
    }
}

fn describe_event(event: Event, machine: &Machine) -> String {
    let axis = |axis: AxisIndex| {
        let axis = machine.axes.get(axis);
        axis.map_or("?", |axis| axis.name.as_str())
    };
    match event {
        Event::Refused {
            axis: at, reason, ..
        } => {
            format!("`{}` refused a command: {reason}", axis(at))
        }
        Event::ResetDrive { axis: at, .. } => {
            format!("`{}` clears the errors of its drive (S-0-0099)", axis(at))
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
        Event::ReferenceReplaced { device, .. } => {
            let name = machine.devices.get(device).map_or("?", |d| d.name.as_str());
            reference_replaced(name)
        }
        Event::CommonTimeJumped { by_ns, .. } => common_time_jumped(by_ns),
        Event::Stopping { cause, .. } => describe_cause(cause, &axis),
        Event::GroupStopping { group, cause, .. } => {
            format!(
                "group `{}`: {}",
                machine.group_name(group),
                describe_cause(cause, &axis)
            )
        }
        Event::GroupReleased { group, .. } => {
            format!("group `{}` has been reset", machine.group_name(group))
        }
    }
}

/// Returns why the machine or a group stopped, in words.
#[must_use]
pub fn describe_stop(cause: StopCause, machine: &Machine) -> String {
    describe_cause(cause, &|axis: AxisIndex| {
        let axis = machine.axes.get(axis);
        axis.map_or("?", |axis| axis.name.as_str())
    })
}

fn describe_cause<'m>(cause: StopCause, axis: &impl Fn(AxisIndex) -> &'m str) -> String {
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
        StopCause::NodeLost { axis: at, state } => {
            format!("stop: the node of `{}` is {state}", axis(at))
        }
        StopCause::Controller => "stop: the controller panicked".to_owned(),
        StopCause::Panicked => "stop: the cycle panicked".to_owned(),
        StopCause::Unsupervised => "stop: the supervisor thread does not run".to_owned(),
        StopCause::Absent => "an optional device is absent".to_owned(),
        StopCause::LeftOp { al_status } => {
            format!("stop: a SubDevice has left Op, AL status 0x{al_status:02x}")
        }
        StopCause::PowerLost { axis: at, state } => {
            format!(
                "stop: the drive of `{}` is in {state} without a cause",
                axis(at)
            )
        }
        StopCause::Powered { axis: at } => {
            format!("stop: the drive of `{}` keeps its power", axis(at))
        }
    }
}

/// Returns a text with the deviation of a clock from the reference clock.
pub(crate) fn reference_replaced(name: &str) -> String {
    format!("the reference clock does not answer; the clock of `{name}` replaces it")
}

pub(crate) fn common_time_jumped(by_ns: i64) -> String {
    let by = duration::show(by_ns.unsigned_abs());
    let to = if by_ns > 0 { "forward" } else { "back" };
    format!("common time ({COMMON_CLOCK}) has jumped {to} by {by}; the motion goes on")
}

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
