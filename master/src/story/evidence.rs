//! Everything that is known when a run has failed, as plain data.

use crate::bringup::DeviceRef;
use crate::clock::Nanos;
use crate::link::LinkStats;
use crate::rt::exchange::ErrorCounters;
use crate::rt::journal::{Entry, Note};
use crate::rt::stats::Counters;

use super::Look;

/// What a diagnosis is made from.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Evidence {
    pub cycle_ns: Nanos,
    /// What the cycle has noticed, oldest first. Empty where it never ran.
    pub notes: Vec<Entry>,
    pub counters: Counters,
    pub link: LinkStats,
    /// In the order of the segment. Empty where nobody could be asked.
    pub devices: Vec<DeviceEvidence>,
}

/// One SubDevice.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceEvidence {
    pub at: DeviceRef,
    /// The one that it is connected to, an index into [`Evidence::devices`], and at which port of it; `None`: the MainDevice.
    pub parent: Option<(usize, u8)>,
    /// Of its error counters since the cycle began; where it never ran, since they were last cleared.
    pub grown: ErrorCounters,
    pub look: Look,
}

impl DeviceEvidence {
    /// Damaged frames that arrived at one of its ports, where they were first found damaged. What the PHY could not make out counts
    /// as an invalid frame, too, unless it came between two frames.
    #[must_use]
    pub fn damaged(&self, port: usize) -> u8 {
        let count = |counters: [u8; 4]| counters.get(port).copied().unwrap_or(0);
        count(self.grown.invalid_frames).max(count(self.grown.rx_errors))
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

/// Looks back so far from the stop.
const BEFORE_STOP: Nanos = 1_000_000_000;

impl Evidence {
    /// When the machine, or the first group of it, began to stop for a reason.
    #[must_use]
    pub fn stop(&self) -> Option<&Entry> {
        self.notes.iter().find(|entry| is_failure(&entry.note))
    }

    fn shortly_before_stop(&self) -> impl Iterator<Item = &Entry> {
        let stop = self.stop().map(|entry| entry.time);
        self.notes.iter().filter(move |entry| {
            let stop = stop.unwrap_or(Nanos::MAX);
            // A stop is noted when the cycle has been left out that led to it.
            entry.time <= stop && (stop == Nanos::MAX || stop - entry.time <= BEFORE_STOP)
        })
    }

    /// Of the host, shortly before the stop.
    #[must_use]
    pub fn lateness(&self) -> Lateness {
        let mut found = Lateness::default();
        for entry in self.shortly_before_stop() {
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

    /// The longest time for which no frame came back, shortly before the stop.
    #[must_use]
    pub fn silence(&self) -> Nanos {
        let lost = self
            .shortly_before_stop()
            .filter(|entry| entry.note == Note::Lost);
        let cycles = lost.map(|entry| entry.last_cycle - entry.first_cycle + 1);
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

/// The machine, or a part of it, stops for it.
#[must_use]
pub fn is_failure(note: &Note) -> bool {
    use crate::rt::guard::StopCause;
    use crate::rt::handover::Event;
    matches!(
        note,
        Note::Told(Event::Stopping { cause, .. } | Event::GroupStopping { cause, .. })
            if *cause != StopCause::Requested
    )
}
