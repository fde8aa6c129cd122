//! Replies that are held until they are due, in the order in which they are due. Never grows.

use crate::clock::Nanos;
use crate::link::MAX_FRAME;

/// Replies held at a time.
const HELD: usize = 32;

pub(super) struct Slot {
    pub len: usize,
    /// How much later than it came the frame was looked at, at most.
    pub unseen: Nanos,
    pub bytes: [u8; MAX_FRAME],
}

pub(super) struct Held {
    slots: Vec<Slot>,
    free: Vec<usize>,
    /// When each is due, the next one last.
    waiting: Vec<(Nanos, usize)>,
}

impl std::fmt::Debug for Held {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Held").field(&self.waiting).finish()
    }
}

impl Held {
    pub fn new() -> Self {
        let empty = || Slot {
            len: 0,
            unseen: 0,
            bytes: [0; MAX_FRAME],
        };
        Self {
            slots: (0..HELD).map(|_| empty()).collect(),
            free: (0..HELD).collect(),
            waiting: Vec::with_capacity(HELD),
        }
    }

    /// A place for the next reply; it is held only when [`Held::hold`] says so.
    pub fn place(&mut self) -> Option<&mut Slot> {
        let slot = *self.free.last()?;
        self.slots.get_mut(slot)
    }

    /// Holds what is in the last [`Held::place`].
    pub fn hold(&mut self, due: Nanos) {
        if let Some(slot) = self.free.pop() {
            let at = self.waiting.partition_point(|(other, _)| *other > due);
            self.waiting.insert(at, (due, slot));
        }
    }

    pub fn next_due(&self) -> Option<Nanos> {
        self.waiting.last().map(|(due, _)| *due)
    }

    /// The next reply if it is due, and when it was; it is no longer held.
    pub fn take_due(&mut self, now: Nanos) -> Option<(Nanos, &Slot)> {
        let (due, slot) = self.waiting.pop_if(|(due, _)| *due <= now)?;
        self.free.push(slot);
        Some((due, &self.slots[slot]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn replies_leave_when_they_are_due_and_places_come_back() {
        let mut held = Held::new();
        for (n, due) in [(1, 30), (2, 10), (3, 20)] {
            let slot = held.place().expect("room");
            slot.len = n;
            held.hold(due);
        }
        assert_eq!(held.next_due(), Some(10));
        assert!(held.take_due(9).is_none());
        let mut taken = Vec::new();
        while let Some((due, slot)) = held.take_due(30) {
            taken.push((due, slot.len));
        }
        assert_eq!(taken, [(10, 2), (20, 3), (30, 1)]);
        for _ in 0..HELD {
            assert!(held.place().is_some());
            held.hold(5);
        }
        assert!(held.place().is_none());
        held.hold(6);
        assert_eq!(
            std::iter::from_fn(|| held.take_due(9).map(|(due, _)| due)).count(),
            HELD
        );
    }
}
