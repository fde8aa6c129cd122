//! Everything that is known after a failed run, as plain data.

use ecaxis_ecat::index::GroupIndex;

use crate::acyclic::DeviceRef;
use crate::clock::Nanos;
use crate::link::LinkStats;
use crate::rt::bus_monitor::StopCause;
use crate::rt::channel::Event;
use crate::rt::event_log::{Entry, LogEntryKind};
use crate::rt::exchange::ErrorCounters;
use crate::rt::flight_recorder::{AFTER, WINDOW};
use crate::rt::stats::Counters;

use super::DeviceSnapshot;

/// The input of a diagnosis.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Evidence {
    pub cycle_ns: Nanos,
    /// The events of the cycle, oldest first. Empty if no cycle ran.
    pub notes: Vec<Entry>,
    /// The stop; `None` if no cycle ran.
    pub stop: Option<Stopped>,
    /// The AL status of all SubDevices, ORed, and the number of answers: the first result from the
    /// stop on.
    pub al_status: Option<(u8, u16)>,
    pub counters: Counters,
    pub link: LinkStats,
    /// One entry per SubDevice in segment order. Empty if no device could be read.
    pub devices: Vec<DeviceEvidence>,
}

/// The time at which the machine, or a group of its axes, began to stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stopped {
    pub cycle: u64,
    pub time: Nanos,
}

/// One SubDevice.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceEvidence {
    pub at: DeviceRef,
    /// The upstream device, as an index into [`Evidence::devices`], and its port. `None`: the
    /// MainDevice.
    pub parent: Option<(usize, u8)>,
    /// The increase of its error counters since the cycle began. Without a cycle, since they were
    /// last cleared.
    pub grown: ErrorCounters,
    /// The increase shortly before the stop.
    pub recent: ErrorCounters,
    pub look: DeviceSnapshot,
}

impl DeviceEvidence {
    /// Returns the number of frames that were first found damaged at this port of the device. An RX
    /// error within a frame also counts as an invalid frame; one between frames does not.
    #[must_use]
    pub fn damaged(&self, port: usize) -> u8 {
        let count = |counters: [u8; 4]| counters.get(port).copied().unwrap_or(0);
        count(self.recent.invalid_frames).max(count(self.recent.rx_errors))
    }

    /// Returns the device's name and position without the address.
    #[must_use]
    pub fn place(&self) -> String {
        place(&self.at)
    }
}

/// Returns the same text as [`DeviceEvidence::place`].
#[must_use]
pub fn place(at: &DeviceRef) -> String {
    format!("`{}` (position {})", at.name, at.position)
}

/// Delays of the host shortly before the stop.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Lateness {
    /// The number of skipped cycles.
    pub missed: u64,
    /// The latest wake-up or the longest time without a transmission, in ns.
    pub longest: Nanos,
}

/// The maximum time from a cause to its bad cycle; for long cycles `ADJACENT_CYCLES` applies.
const ADJACENT: Nanos = 50_000_000;
const ADJACENT_CYCLES: u64 = 20;

impl Evidence {
    /// Returns `true` if all devices were in Op at the stop. Anything missing later is a
    /// consequence or coincidence.
    #[must_use]
    pub fn all_in_op(&self) -> bool {
        let all = u16::try_from(self.devices.len()).ok();
        self.al_status.is_some_and(|(status, answered)| {
            status == crate::rt::bus_monitor::OP && Some(answered) == all
        })
    }

    /// Returns the time of the last cycle of an entry.
    fn end(&self, entry: &Entry) -> Nanos {
        let cycles = match entry.note {
            LogEntryKind::Overrun(missed) => missed,
            _ => entry.last_cycle.saturating_sub(entry.first_cycle),
        };
        entry
            .time
            .saturating_add(cycles.saturating_mul(self.cycle_ns))
    }

    /// Returns the entries that began before or at the stop and lasted until `begin`; all entries
    /// without a stop.
    fn since(&self, begin: Nanos) -> impl Iterator<Item = &Entry> {
        self.notes.iter().filter(move |entry| match self.stop {
            // An overrun is logged before the stop to which it led.
            Some(stop) => entry.time <= stop.time && self.end(entry) >= begin,
            None => true,
        })
    }

    fn shortly_before_stop(&self) -> impl Iterator<Item = &Entry> {
        self.since(self.stop.map_or(0, |stop| stop.time.saturating_sub(WINDOW)))
    }

    fn lateness_since(&self, begin: Nanos) -> Lateness {
        let mut found = Lateness::default();
        for entry in self.since(begin) {
            match entry.note {
                LogEntryKind::WokeLate(late) => found.longest = found.longest.max(late),
                LogEntryKind::Overrun(missed) => {
                    found.missed = found.missed.saturating_add(missed);
                    found.longest = found.longest.max(missed.saturating_mul(self.cycle_ns));
                }
                _ => {}
            }
        }
        found
    }

    /// Returns the delays of the host shortly before the stop.
    #[must_use]
    pub fn lateness(&self) -> Lateness {
        self.lateness_since(self.stop.map_or(0, |stop| stop.time.saturating_sub(WINDOW)))
    }

    /// Returns the delays of the host just before the first bad cycle that led to the stop.
    #[must_use]
    pub fn lateness_at_stop(&self) -> Lateness {
        let adjacent = ADJACENT.max(ADJACENT_CYCLES.saturating_mul(self.cycle_ns));
        self.lateness_since(self.began().saturating_sub(adjacent))
    }

    /// Returns the start of the bad cycles that led to the stop; without bad cycles the stop
    /// itself.
    fn began(&self) -> Nanos {
        let Some(stop) = self.stop else { return 0 };
        let mut began = stop;
        for entry in self.notes.iter().rev() {
            let bad = matches!(
                entry.note,
                LogEntryKind::Lost | LogEntryKind::WorkingCounter(..)
            );
            // Entries join if no good cycle lies between them.
            let joins = entry.last_cycle + 1 >= began.cycle && entry.first_cycle <= began.cycle;
            if bad && joins {
                began = Stopped {
                    cycle: entry.first_cycle,
                    time: entry.time,
                };
            }
        }
        began.time
    }

    /// Returns the number of consecutive cycles with lost frames up to and including the stop.
    #[must_use]
    pub fn lost_at_stop(&self) -> u64 {
        let Some(stop) = self.stop else { return 0 };
        let mut entries = self.notes.iter();
        let run = entries.find(|entry| {
            entry.note == LogEntryKind::Lost
                && entry.first_cycle <= stop.cycle
                && entry.last_cycle + 1 >= stop.cycle
        });
        run.map_or(0, |run| stop.cycle.saturating_sub(run.first_cycle) + 1)
    }

    /// Returns the number of cycles in which frames of an earlier cycle returned. The range starts
    /// at the first bad cycle and ends shortly after the stop.
    #[must_use]
    pub fn late_at_stop(&self) -> u64 {
        let Some(stop) = self.stop else { return 0 };
        let began = self.began();
        let end = stop.cycle.saturating_add(u64::from(AFTER));
        let late = self.notes.iter().filter(|entry| {
            entry.note == LogEntryKind::Late && entry.first_cycle <= end && self.end(entry) >= began
        });
        let cycles = late.map(|entry| entry.last_cycle.min(end) - entry.first_cycle + 1);
        cycles.sum()
    }

    /// Returns the number of refusals by the interface shortly before the stop.
    #[must_use]
    pub fn refused(&self) -> u64 {
        let errors = self
            .shortly_before_stop()
            .filter(|entry| entry.note == LogEntryKind::LinkError);
        errors
            .map(|entry| entry.last_cycle - entry.first_cycle + 1)
            .sum()
    }

    /// Returns the number of EtherCAT frames from other MainDevices shortly before the stop; all of
    /// them without a stop.
    #[must_use]
    pub fn other_frames(&self) -> u64 {
        if self.stop.is_none() {
            return self.link.main_devices;
        }
        let frames = self.shortly_before_stop().map(|entry| match entry.note {
            LogEntryKind::OtherMainDevice(frames) => frames,
            _ => 0,
        });
        frames.sum()
    }

    /// Returns the longest time in ns without any frame, shortly before the stop.
    #[must_use]
    pub fn silence(&self) -> Nanos {
        self.longest(|note| *note == LogEntryKind::Lost)
    }

    /// Returns the longest time in ns without complete process data, shortly before the stop.
    #[must_use]
    pub fn without_data(&self) -> Nanos {
        self.longest(|note| matches!(note, LogEntryKind::Lost | LogEntryKind::WorkingCounter(..)))
    }

    fn longest(&self, which: fn(&LogEntryKind) -> bool) -> Nanos {
        let bad = self
            .shortly_before_stop()
            .filter(|entry| which(&entry.note));
        let cycles = bad.map(|entry| entry.last_cycle - entry.first_cycle + 1);
        cycles.max().unwrap_or(0).saturating_mul(self.cycle_ns)
    }

    /// Returns the device with this name.
    #[must_use]
    pub fn named(&self, name: &str) -> Option<&DeviceEvidence> {
        self.devices.iter().find(|device| device.at.name == name)
    }

    /// Returns the upstream port of a device, for example port 1 of `a0`, or this computer.
    #[must_use]
    pub fn upstream(&self, device: &DeviceEvidence) -> String {
        let parent = device.parent;
        match parent.and_then(|(n, port)| Some((self.devices.get(n)?, port))) {
            Some((parent, port)) => format!("port {port} of `{}`", parent.at.name),
            None => "this computer".to_owned(),
        }
    }

    /// Returns the device connected to a port; at port 0 the upstream port.
    #[must_use]
    pub fn partner(&self, index: usize, port: u8) -> Option<String> {
        let device = self.devices.get(index)?;
        if port == 0 {
            return Some(self.upstream(device));
        }
        let child = self
            .devices
            .iter()
            .find(|other| other.parent == Some((index, port)))?;
        Some(format!("`{}`", child.at.name))
    }
}

impl Stopped {
    /// Returns the stop to which an error belongs. This is the stop of `group`, otherwise the
    /// machine's first one. With `by_cycle`, stops on request do not count.
    #[must_use]
    pub fn find(notes: &[Entry], group: Option<GroupIndex>, by_cycle: bool) -> Option<Self> {
        let cause = |entry: &Entry| match entry.note {
            LogEntryKind::Event(Event::Stopping { cause, .. }) => Some(cause),
            _ => None,
        };
        let machine = |for_a_reason: bool| {
            let wanted = move |cause| !for_a_reason || cause != StopCause::Requested;
            notes.iter().find(|entry| cause(entry).is_some_and(wanted))
        };
        let own = |entry: &&Entry| matches!(entry.note, LogEntryKind::Event(Event::GroupStopping { group: own, .. }) if Some(own) == group);
        let group = notes.iter().rev().find(own);
        let found = group.or_else(|| machine(by_cycle))?;
        Some(Self {
            cycle: found.first_cycle,
            time: found.time,
        })
    }
}
