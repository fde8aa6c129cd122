//! A bounded queue of frames under way, in the order of their arrival.

use super::{LinkError, MAX_FRAME, Nanos};

#[derive(Debug, Clone)]
pub struct QueuedFrame {
    pub len: usize,
    /// The maximum time in ns that the frame waited before it was read.
    pub unseen: Nanos,
    pub bytes: [u8; MAX_FRAME],
}

impl QueuedFrame {
    pub fn frame(&mut self) -> &mut [u8] {
        &mut self.bytes[..self.len]
    }
}

/// Frames with the times at which they arrive. Allocates when created only.
#[derive(Debug)]
pub struct FrameQueue {
    slots: Vec<QueuedFrame>,
    free: Vec<usize>,
    /// The arrival times and slots; the next one is last.
    waiting: Vec<(Nanos, usize)>,
}

impl FrameQueue {
    #[must_use]
    pub fn new(capacity: usize) -> Self {
        let empty = QueuedFrame {
            len: 0,
            unseen: 0,
            bytes: [0; MAX_FRAME],
        };
        Self {
            slots: vec![empty; capacity],
            free: (0..capacity).collect(),
            waiting: Vec::with_capacity(capacity),
        }
    }

    /// Returns a free slot for the next frame; [`FrameQueue::push`] queues it.
    pub fn vacant(&mut self) -> Option<&mut QueuedFrame> {
        let slot = *self.free.last()?;
        self.slots.get_mut(slot)
    }

    /// Copies a frame to a free slot; [`FrameQueue::push`] queues it.
    ///
    /// # Errors
    /// Fails if no slot is free or the frame is too long.
    pub fn store(&mut self, frame: &[u8]) -> Result<&mut QueuedFrame, LinkError> {
        let too_long = LinkError::TooLong(frame.len());
        let full = LinkError::Send(rustix::io::Errno::NOBUFS);
        let slot = self.vacant().ok_or(full)?;
        slot.len = frame.len();
        let bytes = slot.bytes.get_mut(..frame.len()).ok_or(too_long)?;
        bytes.copy_from_slice(frame);
        Ok(slot)
    }

    /// Queues the slot of the last [`FrameQueue::vacant`] or [`FrameQueue::store`].
    pub fn push(&mut self, due: Nanos) {
        if let Some(slot) = self.free.pop() {
            let at = self.waiting.partition_point(|(other, _)| *other > due);
            self.waiting.insert(at, (due, slot));
        }
    }

    #[must_use]
    pub fn next_due(&self) -> Option<Nanos> {
        self.waiting.last().map(|(due, _)| *due)
    }

    /// Removes and returns the next frame with its arrival time, if it is due.
    pub fn pop_due(&mut self, now: Nanos) -> Option<(Nanos, &QueuedFrame)> {
        let (due, slot) = self.waiting.pop_if(|(due, _)| *due <= now)?;
        self.free.push(slot);
        Some((due, &self.slots[slot]))
    }

    /// Copies the next frame that is due to `buf` and returns its length.
    pub fn receive(&mut self, now: Nanos, buf: &mut [u8; MAX_FRAME]) -> Option<usize> {
        let (_, frame) = self.pop_due(now)?;
        buf[..frame.len].copy_from_slice(&frame.bytes[..frame.len]);
        Some(frame.len)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn queue_returns_due_frames_and_frees_slots() {
        let mut queue = FrameQueue::new(32);
        for (n, due) in [(1, 30), (2, 10), (3, 20)] {
            queue.store(&[0; MAX_FRAME][..n]).expect("room");
            queue.push(due);
        }
        assert_eq!(queue.next_due(), Some(10));
        assert!(queue.pop_due(9).is_none());
        let mut taken = Vec::new();
        while let Some((due, frame)) = queue.pop_due(30) {
            taken.push((due, frame.len));
        }
        assert_eq!(taken, [(10, 2), (20, 3), (30, 1)]);
        let too_long = queue.store(&[0; MAX_FRAME + 1]).err();
        assert_eq!(too_long, Some(LinkError::TooLong(MAX_FRAME + 1)));
        while queue.vacant().is_some() {
            queue.push(5);
        }
        queue.push(6);
        assert_eq!(
            std::iter::from_fn(|| queue.pop_due(9).map(|_| ())).count(),
            32
        );
    }
}
