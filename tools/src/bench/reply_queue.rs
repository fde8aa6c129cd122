//! A bounded queue of delayed replies, in the order of their due times.

use ecaxis_master::clock::Nanos;
use ecaxis_master::link::MAX_FRAME;

/// The capacity of the queue.
const HELD: usize = 32;

pub(super) struct Slot {
    pub len: usize,
    /// The maximum time in ns that the frame waited before it was read.
    pub unseen: Nanos,
    pub bytes: [u8; MAX_FRAME],
}

pub(super) struct ReplyQueue {
    slots: Vec<Slot>,
    free: Vec<usize>,
    /// The due times and slots; the next one is last.
    waiting: Vec<(Nanos, usize)>,
}

impl std::fmt::Debug for ReplyQueue {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Held").field(&self.waiting).finish()
    }
}

impl ReplyQueue {
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

    /// Returns a free slot for the next reply; [`ReplyQueue::hold`] queues it.
    pub fn place(&mut self) -> Option<&mut Slot> {
        let slot = *self.free.last()?;
        self.slots.get_mut(slot)
    }

    /// Queues the slot of the last [`ReplyQueue::place`].
    pub fn hold(&mut self, due: Nanos) {
        if let Some(slot) = self.free.pop() {
            let at = self.waiting.partition_point(|(other, _)| *other > due);
            self.waiting.insert(at, (due, slot));
        }
    }

    pub fn next_due(&self) -> Option<Nanos> {
        self.waiting.last().map(|(due, _)| *due)
    }

    /// Removes and returns the next reply with its due time, if it is due.
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
    fn queue_returns_due_replies_and_frees_slots() {
        let mut held = ReplyQueue::new();
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
