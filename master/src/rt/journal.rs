//! What the cycle has noticed, in order: a ring of fixed size, so that what led to a stop is still there when somebody looks.

use super::guard::StopCause;
use super::handover::Event;
use crate::clock::Nanos;

/// Entries that are kept; with a run of the same in one entry, hours of a quiet machine or the worst seconds of a bad one.
const KEPT: usize = 256;

/// Something out of the ordinary in one cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Note {
    /// Frames did not all come back before the deadline.
    Lost,
    /// The working counters were (seen, expected).
    WorkingCounter(u16, u16),
    /// AL status of all SubDevices or-ed together, and how many answered; noted when it changes.
    AlStatus(u8, u16),
    /// Frames of an earlier cycle came back.
    Late,
    /// The thread woke up this late.
    WokeLate(Nanos),
    /// Cycles left out, because the thread was too late for them.
    Overrun(u64),
    /// The link refused to send or to receive.
    LinkError,
    /// EtherCAT frames of another MainDevice came.
    OtherMainDevice(u64),
    /// What the supervisor is told as well.
    Told(Event),
}

impl Note {
    /// Whether both are the same but for their figures.
    fn is_like(&self, other: &Self) -> bool {
        std::mem::discriminant(self) == std::mem::discriminant(other)
            && !matches!(self, Self::Told(_) | Self::AlStatus(..))
    }

    /// Of two in a row, the one to tell.
    fn graver(self, other: Self) -> Self {
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

/// The same, cycle after cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Entry {
    pub first_cycle: u64,
    pub last_cycle: u64,
    /// When it was first.
    pub time: Nanos,
    pub note: Note,
}

/// A ring of entries.
#[derive(Debug, Clone)]
pub struct Journal {
    ring: Box<[Option<Entry>]>,
    /// Entries ever made.
    made: u64,
    /// Of them when the machine stopped for a reason.
    stop: Option<u64>,
}

impl Default for Journal {
    #[allow(
        clippy::disallowed_macros,
        clippy::disallowed_methods,
        reason = "prepares"
    )]
    fn default() -> Self {
        Self {
            // Written to, so that no page of it is met for the first time in a cycle.
            ring: vec![None; KEPT].into_boxed_slice(),
            made: 0,
            stop: None,
        }
    }
}

/// Entries after the stop; with more, what led to it would be overwritten.
const AFTER_STOP: u64 = KEPT as u64 / 2;

impl Journal {
    fn place(&self, entry: u64) -> usize {
        (entry % KEPT as u64) as usize
    }

    /// RT: O(1).
    pub fn note(&mut self, cycle: u64, time: Nanos, note: Note) {
        // A cycle may bring several: each continues its own like of the cycle before.
        const LOOK_BACK: u64 = 4;
        for back in 1..=self.made.min(LOOK_BACK) {
            let place = self.place(self.made - back);
            if let Some(Some(last)) = self.ring.get_mut(place)
                && last.note.is_like(&note)
                && last.last_cycle + 1 >= cycle
            {
                last.last_cycle = cycle;
                last.note = last.note.graver(note);
                return;
            }
        }
        match note {
            Note::Told(Event::Stopping { cause, .. }) if cause != StopCause::Requested => {
                self.stop.get_or_insert(self.made);
            }
            Note::Told(_) => {}
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

    /// Those kept, oldest first.
    pub fn entries(&self) -> impl Iterator<Item = &Entry> {
        let kept = self.made.min(KEPT as u64);
        (self.made - kept..self.made).filter_map(|n| self.ring.get(self.place(n))?.as_ref())
    }

    /// How many have been overwritten.
    #[must_use]
    pub fn overwritten(&self) -> u64 {
        self.made.saturating_sub(KEPT as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_of_the_same_is_one_entry() {
        let mut journal = Journal::default();
        for cycle in 10..20 {
            journal.note(cycle, cycle * 1000, Note::WokeLate(cycle));
            journal.note(cycle, cycle * 1000, Note::Lost);
        }
        journal.note(21, 21_000, Note::Lost);
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
                entry(10, 19, 10_000, Note::WokeLate(19)),
                entry(10, 19, 10_000, Note::Lost),
                entry(21, 21, 21_000, Note::Lost),
            ]
        );
    }

    #[test]
    fn the_last_ones_are_kept_in_order() {
        let mut journal = Journal::default();
        for cycle in 0..1000 {
            // Every other cycle, so that none continues another.
            journal.note(2 * cycle, cycle, Note::Overrun(cycle));
        }
        assert_eq!(journal.overwritten(), 1000 - KEPT as u64);
        let first: Vec<u64> = journal.entries().map(|e| e.first_cycle).collect();
        assert_eq!(first.len(), KEPT);
        assert_eq!((first[0], first[KEPT - 1]), (2 * (1000 - 256), 1998));
        assert!(first.is_sorted());
    }

    #[test]
    fn what_led_to_a_stop_is_kept() {
        let mut journal = Journal::default();
        let cause = StopCause::LeftOp { al_status: 4 };
        journal.note(1, 1, Note::Lost);
        journal.note(2, 2, Note::Told(Event::Stopping { cycle: 2, cause }));
        for cycle in 2..2000 {
            journal.note(2 * cycle, 2 * cycle, Note::LinkError);
        }
        let cycles: Vec<u64> = journal.entries().map(|e| e.first_cycle).collect();
        assert_eq!(cycles[..3], [1, 2, 4]);
        assert_eq!(cycles.len(), 1 + KEPT / 2);
    }

    #[test]
    fn what_is_told_is_kept_each_time() {
        let mut journal = Journal::default();
        for _ in 0..2 {
            journal.note(1, 1, Note::Told(Event::PhaseLost { cycle: 1 }));
        }
        assert_eq!(journal.entries().count(), 2);
    }
}
