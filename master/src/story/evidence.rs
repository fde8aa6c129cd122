//! Everything that is known when a run has failed, as plain data.

use crate::bringup::DeviceRef;
use crate::clock::Nanos;
use crate::link::LinkStats;
use crate::rt::exchange::ErrorCounters;
use crate::rt::guard::StopCause;
use crate::rt::handover::Event;
use crate::rt::history::{AFTER, WINDOW};
use crate::rt::journal::{Entry, Note};
use crate::rt::stats::Counters;

use super::Look;

/// What a diagnosis is made from.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Evidence {
    pub cycle_ns: Nanos,
    /// What the cycle has noticed, oldest first. Empty where it never ran.
    pub notes: Vec<Entry>,
    /// When it stopped; `None` where no cycle ran.
    pub stop: Option<Stopped>,
    /// AL status of all SubDevices or-ed together and how many answered: the first answer from the stop on.
    pub al_status: Option<(u8, u16)>,
    pub counters: Counters,
    pub link: LinkStats,
    /// In the order of the segment. Empty where nobody could be asked.
    pub devices: Vec<DeviceEvidence>,
}

/// When a machine, or a group of its axes, began to stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stopped {
    pub cycle: u64,
    pub time: Nanos,
}

/// One SubDevice.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceEvidence {
    pub at: DeviceRef,
    /// The one that it is connected to, an index into [`Evidence::devices`], and at which port of it; `None`: the MainDevice.
    pub parent: Option<(usize, u8)>,
    /// Of its error counters since the cycle began; where it never ran, since they were last cleared.
    pub grown: ErrorCounters,
    /// Of them, shortly before the stop.
    pub recent: ErrorCounters,
    pub look: Look,
}

impl DeviceEvidence {
    /// Damaged frames that arrived at one of its ports, where they were first found damaged. What the PHY could not make out counts
    /// as an invalid frame, too, unless it came between two frames.
    #[must_use]
    pub fn damaged(&self, port: usize) -> u8 {
        let count = |counters: [u8; 4]| counters.get(port).copied().unwrap_or(0);
        count(self.recent.invalid_frames).max(count(self.recent.rx_errors))
    }

    /// Its name and place, and nothing of which only a program makes sense.
    #[must_use]
    pub fn place(&self) -> String {
        place(&self.at)
    }
}

/// As [`DeviceEvidence::place`].
#[must_use]
pub fn place(at: &DeviceRef) -> String {
    format!("`{}` (position {})", at.name, at.position)
}

/// What the host did to the cycle shortly before the stop.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Lateness {
    /// Cycles left out.
    pub missed: u64,
    /// The latest wake-up, or the longest time for which nothing was sent.
    pub longest: Nanos,
}

/// What led to a bad cycle lies so little before it, or fewer cycles.
const ADJACENT: Nanos = 50_000_000;
const ADJACENT_CYCLES: u64 = 20;

impl Evidence {
    /// Everybody was there and in Op when it stopped: what was missing later is a consequence, or chance.
    #[must_use]
    pub fn all_in_op(&self) -> bool {
        let all = u16::try_from(self.devices.len()).ok();
        self.al_status.is_some_and(|(status, answered)| {
            status == crate::rt::guard::OP && Some(answered) == all
        })
    }

    /// When the last of an entry's run was.
    fn end(&self, entry: &Entry) -> Nanos {
        let cycles = match entry.note {
            Note::Overrun(missed) => missed,
            _ => entry.last_cycle.saturating_sub(entry.first_cycle),
        };
        entry
            .time
            .saturating_add(cycles.saturating_mul(self.cycle_ns))
    }

    /// What began before the stop or at it, and was not over at `begin`; everything where nothing stopped.
    fn since(&self, begin: Nanos) -> impl Iterator<Item = &Entry> {
        self.notes.iter().filter(move |entry| match self.stop {
            // A stop is noted when the cycle has been left out that led to it.
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
                Note::WokeLate(late) => found.longest = found.longest.max(late),
                Note::Overrun(missed) => {
                    found.missed = found.missed.saturating_add(missed);
                    found.longest = found.longest.max(missed.saturating_mul(self.cycle_ns));
                }
                _ => {}
            }
        }
        found
    }

    /// Of the host, shortly before the stop.
    #[must_use]
    pub fn lateness(&self) -> Lateness {
        self.lateness_since(self.stop.map_or(0, |stop| stop.time.saturating_sub(WINDOW)))
    }

    /// Of the host, just before what stopped it began.
    #[must_use]
    pub fn lateness_at_stop(&self) -> Lateness {
        let adjacent = ADJACENT.max(ADJACENT_CYCLES.saturating_mul(self.cycle_ns));
        self.lateness_since(self.began().saturating_sub(adjacent))
    }

    /// When the bad cycles began that led to the stop; the stop itself without such.
    fn began(&self) -> Nanos {
        let Some(stop) = self.stop else { return 0 };
        let mut began = stop;
        for entry in self.notes.iter().rev() {
            let bad = matches!(entry.note, Note::Lost | Note::WorkingCounter(..));
            // Between two bad cycles there is none that was good.
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

    /// Cycles in a row in which frames were lost, up to the stop and on from it.
    #[must_use]
    pub fn lost_at_stop(&self) -> u64 {
        let Some(stop) = self.stop else { return 0 };
        let mut entries = self.notes.iter();
        let run = entries.find(|entry| {
            entry.note == Note::Lost
                && entry.first_cycle <= stop.cycle
                && entry.last_cycle + 1 >= stop.cycle
        });
        run.map_or(0, |run| stop.cycle.saturating_sub(run.first_cycle) + 1)
    }

    /// Cycles in which frames of an earlier cycle came back, from the first bad cycle before the stop to shortly after it.
    #[must_use]
    pub fn late_at_stop(&self) -> u64 {
        let Some(stop) = self.stop else { return 0 };
        let began = self.began();
        let end = stop.cycle.saturating_add(u64::from(AFTER));
        let late = self.notes.iter().filter(|entry| {
            entry.note == Note::Late && entry.first_cycle <= end && self.end(entry) >= began
        });
        let cycles = late.map(|entry| entry.last_cycle.min(end) - entry.first_cycle + 1);
        cycles.sum()
    }

    /// How often the interface refused, shortly before the stop.
    #[must_use]
    pub fn refused(&self) -> u64 {
        let errors = self
            .shortly_before_stop()
            .filter(|entry| entry.note == Note::LinkError);
        errors
            .map(|entry| entry.last_cycle - entry.first_cycle + 1)
            .sum()
    }

    /// EtherCAT frames of other MainDevices, shortly before the stop; all of them where nothing stopped.
    #[must_use]
    pub fn other_frames(&self) -> u64 {
        if self.stop.is_none() {
            return self.link.main_devices;
        }
        let frames = self.shortly_before_stop().map(|entry| match entry.note {
            Note::OtherMainDevice(frames) => frames,
            _ => 0,
        });
        frames.sum()
    }

    /// The longest time for which no frame came back, shortly before the stop.
    #[must_use]
    pub fn silence(&self) -> Nanos {
        self.longest(|note| *note == Note::Lost)
    }

    /// The longest time without all of the process data, shortly before the stop.
    #[must_use]
    pub fn without_data(&self) -> Nanos {
        self.longest(|note| matches!(note, Note::Lost | Note::WorkingCounter(..)))
    }

    fn longest(&self, which: fn(&Note) -> bool) -> Nanos {
        let bad = self
            .shortly_before_stop()
            .filter(|entry| which(&entry.note));
        let cycles = bad.map(|entry| entry.last_cycle - entry.first_cycle + 1);
        cycles.max().unwrap_or(0).saturating_mul(self.cycle_ns)
    }

    /// A device by its name.
    #[must_use]
    pub fn named(&self, name: &str) -> Option<&DeviceEvidence> {
        self.devices.iter().find(|device| device.at.name == name)
    }

    /// What a device is connected to: `port 1 of `a0``, or the MainDevice's own port.
    #[must_use]
    pub fn upstream(&self, device: &DeviceEvidence) -> String {
        let parent = device.parent;
        match parent.and_then(|(n, port)| Some((self.devices.get(n)?, port))) {
            Some((parent, port)) => format!("port {port} of `{}`", parent.at.name),
            None => "this computer".to_owned(),
        }
    }

    /// What is at a port of a device: the device connected there, the one before it at port 0.
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
    /// The stop that an error is about: the named group's; otherwise the machine's first, for a reason where the cycle found one.
    #[must_use]
    pub fn find(notes: &[Entry], group: Option<usize>, by_cycle: bool) -> Option<Self> {
        let cause = |entry: &Entry| match entry.note {
            Note::Told(Event::Stopping { cause, .. }) => Some(cause),
            _ => None,
        };
        let machine = |for_a_reason: bool| {
            let wanted = move |cause| !for_a_reason || cause != StopCause::Requested;
            notes.iter().find(|entry| cause(entry).is_some_and(wanted))
        };
        let own = |entry: &&Entry| matches!(entry.note, Note::Told(Event::GroupStopping { group: own, .. }) if Some(own) == group);
        let group = notes.iter().rev().find(own);
        let found = group.or_else(|| machine(by_cycle))?;
        Some(Self {
            cycle: found.first_cycle,
            time: found.time,
        })
    }
}
