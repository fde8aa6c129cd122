//! The segment on the thread of the cycle, without an interface: measures the work of a cycle, but
//! no exchange.

use super::bus::ReplyDelay;
use super::reply_queue::ReplyQueue;
use super::segment::{Seen, Segment};
use ecaxis_master::clock::{self, Nanos};
use ecaxis_master::link::{Link, LinkError, MAX_FRAME};

/// A link to a [`Segment`].
#[derive(Debug)]
pub struct InProcess {
    segment: Segment,
    hold: ReplyDelay,
    held: ReplyQueue,
}

impl InProcess {
    #[must_use]
    pub fn new(segment: Segment, hold: ReplyDelay) -> Self {
        Self {
            segment,
            hold,
            held: ReplyQueue::new(),
        }
    }
}

impl Link for InProcess {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        let now = clock::now();
        let due = now
            + match self.hold {
                ReplyDelay::Fixed(hold) => hold,
                ReplyDelay::Wire => self.segment.wire_ns(frame.len()),
            };
        let slot = self
            .held
            .place()
            .ok_or(LinkError::Send(rustix::io::Errno::NOBUFS))?;
        let to = slot
            .bytes
            .get_mut(..frame.len())
            .ok_or(LinkError::TooLong(frame.len()))?;
        to.copy_from_slice(frame);
        slot.len = frame.len();
        if self.segment.answer(to, now) == Seen::Answered {
            self.held.hold(due);
        }
        Ok(())
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        let Some((_, slot)) = self.held.take_due(clock::now()) else {
            return Ok(None);
        };
        buf[..slot.len].copy_from_slice(&slot.bytes[..slot.len]);
        Ok(Some(slot.len))
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.held.next_due()
    }
}
