//! The events of the cycle, in order. The ring has a fixed size and keeps the events before a stop
//! for later analysis.

use super::bus_monitor::StopCause;
use super::channel::Event;
use crate::clock::Nanos;

/// Capacity in entries. Repetitions share one entry, so the ring covers hours of a quiet machine or
/// the worst seconds of a faulty one.
const KEPT: usize = 256;

/// An unusual event in one cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LogEntryKind {
    /// At least one frame did not come back before the deadline.
    Lost,
    /// The working counters were (seen, expected).
    WorkingCounter(u16, u16),
    /// AL status of all SubDevices, or-ed, and the number of answers; logged when it changes.
    AlStatus(u8, u16),
    /// Frames of an earlier cycle came back.
    Late,
    /// The thread woke up this late.
    WokeLate(Nanos),
    /// Cycles skipped because the thread was too late for them.
    Overrun(u64),
    /// The link failed to send or to receive.
    LinkError,
    /// EtherCAT frames of another MainDevice arrived.
    OtherMainDevice(u64),
    /// An event that was also reported to the supervisor.
    Event(Event),
}

impl LogEntryKind {
    /// True if both entries differ only in their numbers and may share one entry.
    fn coalesces_with(&self, other: &Self) -> bool {
        std::mem::discriminant(self) == std::mem::discriminant(other)
            && !matches!(self, Self::Event(_) | Self::AlStatus(..))
    }

    /// Merges two consecutive entries into the one to keep.
    fn merge(self, other: Self) -> Self {
        match (self, other) {
            (Self::WokeLate(a), Self::WokeLate(b)) => Self::WokeLate(a.max(b)),
            (Self::Overrun(a), Self::Overrun(b)) => Self::Overrun(a.saturating_add(b)),
            (Self::OtherMainDevice(a), Self::OtherMainDevice(b)) => {
                Self::OtherMainDevice(a.saturating_add(b))
            }
            (first, _) => first,
        }
    }
}

/// One kind of event in consecutive cycles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Entry {
    pub first_cycle: u64,
    pub last_cycle: u64,
    /// Time of the first occurrence.
    pub time: Nanos,
    pub note: LogEntryKind,
}

/// A ring of entries.
#[derive(Debug, Clone)]
pub struct EventLog {
    ring: Box<[Option<Entry>]>,
    /// The number of entries ever made.
    made: u64,
    /// The value of `made` at the first stop with a cause.
    stop: Option<u64>,
}

impl Default for EventLog {
    #[allow(
        clippy::disallowed_macros,
        clippy::disallowed_methods,
        reason = "runs before the loop"
    )]
    fn default() -> Self {
        Self {
            // Written here, so that no page of it faults in a cycle.
            ring: vec![None; KEPT].into_boxed_slice(),
            made: 0,
            stop: None,
        }
    }
}

/// Entries kept after the stop; more would overwrite the events before it.
const AFTER_STOP: u64 = KEPT as u64 / 2;

impl EventLog {
    fn place(&self, entry: u64) -> usize {
        (entry % KEPT as u64) as usize
    }

    /// Logs an event. RT: O(1).
    pub fn note(&mut self, cycle: u64, time: Nanos, note: LogEntryKind) {
        // A cycle may log several events; each one continues its own kind in the cycle before.
        const LOOK_BACK: u64 = 4;
        for back in 1..=self.made.min(LOOK_BACK) {
            let place = self.place(self.made - back);
            if let Some(Some(last)) = self.ring.get_mut(place)
                && last.note.coalesces_with(&note)
                && last.last_cycle + 1 >= cycle
            {
                last.last_cycle = cycle;
                last.note = last.note.merge(note);
                return;
            }
        }
        match note {
            LogEntryKind::Event(Event::Stopping { cause, .. }) if cause != StopCause::Requested => {
                self.stop.get_or_insert(self.made);
            }
            LogEntryKind::Event(_) => {}
            _ if self.stop.is_some_and(|stop| self.made - stop >= AFTER_STOP) => return,
            _ => {}
        }
        let place = self.place(self.made);
        if let Some(entry) = self.ring.get_mut(place) {
            *entry = Some(Entry {
                first_cycle: cycle,
                last_cycle: cycle,
                time,
                note,
            });
        }
        self.made += 1;
    }

    /// Returns the entries, oldest first.
    pub fn entries(&self) -> impl Iterator<Item = &Entry> {
        let kept = self.made.min(KEPT as u64);
        (self.made - kept..self.made).filter_map(|n| self.ring.get(self.place(n))?.as_ref())
    }

    /// Returns how many entries were overwritten.
    #[must_use]
    pub fn overwritten(&self) -> u64 {
        self.made.saturating_sub(KEPT as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn event_log_merges_repetitions() {
        let mut journal = EventLog::default();
        for cycle in 10..20 {
            journal.note(cycle, cycle * 1000, LogEntryKind::WokeLate(cycle));
            journal.note(cycle, cycle * 1000, LogEntryKind::Lost);
        }
        journal.note(21, 21_000, LogEntryKind::Lost);
        let entry = |first, last, time, note| Entry {
            first_cycle: first,
            last_cycle: last,
            time,
            note,
        };
        let entries: Vec<Entry> = journal.entries().copied().collect();
        assert_eq!(
            entries,
            [
                entry(10, 19, 10_000, LogEntryKind::WokeLate(19)),
                entry(10, 19, 10_000, LogEntryKind::Lost),
                entry(21, 21, 21_000, LogEntryKind::Lost),
            ]
        );
    }

    #[test]
    fn event_log_keeps_the_last_entries_in_order() {
        let mut journal = EventLog::default();
        for cycle in 0..1000 {
            // Every other cycle, so that no entry continues another.
            journal.note(2 * cycle, cycle, LogEntryKind::Overrun(cycle));
        }
        assert_eq!(journal.overwritten(), 1000 - KEPT as u64);
        let first: Vec<u64> = journal.entries().map(|e| e.first_cycle).collect();
        assert_eq!(first.len(), KEPT);
        assert_eq!((first[0], first[KEPT - 1]), (2 * (1000 - 256), 1998));
        assert!(first.is_sorted());
    }

    #[test]
    fn event_log_keeps_entries_before_a_stop() {
        let mut journal = EventLog::default();
        let cause = StopCause::LeftOp { al_status: 4 };
        journal.note(1, 1, LogEntryKind::Lost);
        journal.note(
            2,
            2,
            LogEntryKind::Event(Event::Stopping { cycle: 2, cause }),
        );
        for cycle in 2..2000 {
            journal.note(2 * cycle, 2 * cycle, LogEntryKind::LinkError);
        }
        let cycles: Vec<u64> = journal.entries().map(|e| e.first_cycle).collect();
        assert_eq!(cycles[..3], [1, 2, 4]);
        assert_eq!(cycles.len(), 1 + KEPT / 2);
    }

    #[test]
    fn event_log_never_merges_reported_events() {
        let mut journal = EventLog::default();
        for _ in 0..2 {
            journal.note(1, 1, LogEntryKind::Event(Event::PhaseLost { cycle: 1 }));
        }
        assert_eq!(journal.entries().count(), 2);
    }
}
