//! The simulated segment as a link, in the same thread and on the same clock.

use ecaxis_sim::{Segment, Transit};

use super::{Link, LinkError, MAX_FRAME, Nanos};
use crate::clock;

/// Frames that may be under way at once.
const IN_FLIGHT: usize = 64;

#[derive(Debug)]
struct Slot {
    at: Nanos,
    len: usize,
    frame: [u8; MAX_FRAME],
}

/// Carries frames through a [`Segment`] and hands them back when they would have arrived.
#[derive(Debug)]
pub struct SimLink {
    segment: Segment,
    /// The clock's time at the segment's time zero.
    start: Nanos,
    /// Ring of frames on their way back, in order of arrival.
    ring: Vec<Slot>,
    head: usize,
    count: usize,
}

impl SimLink {
    /// The segment's time starts now.
    #[must_use]
    pub fn new(segment: Segment) -> Self {
        let ring = (0..IN_FLIGHT)
            .map(|_| Slot {
                at: 0,
                len: 0,
                frame: [0; MAX_FRAME],
            })
            .collect();
        Self {
            segment,
            start: clock::now(),
            ring,
            head: 0,
            count: 0,
        }
    }

    #[must_use]
    pub fn segment(&self) -> &Segment {
        &self.segment
    }
}

impl Link for SimLink {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        if frame.len() > MAX_FRAME {
            return Err(LinkError::TooLong(frame.len()));
        }
        if self.count == IN_FLIGHT {
            return Err(LinkError::Send(rustix::io::Errno::NOBUFS));
        }
        let now = clock::now().saturating_sub(self.start);
        let slot = &mut self.ring[(self.head + self.count) % IN_FLIGHT];
        slot.frame[..frame.len()].copy_from_slice(frame);
        if let Transit::Back { at, .. } = self.segment.transit(&mut slot.frame[..frame.len()], now)
        {
            slot.at = at + self.start;
            slot.len = frame.len();
            self.count += 1;
        }
        Ok(())
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        if self.count == 0 {
            return Ok(None);
        }
        let slot = &self.ring[self.head];
        if slot.at > clock::now() {
            return Ok(None);
        }
        buf[..slot.len].copy_from_slice(&slot.frame[..slot.len]);
        let len = slot.len;
        self.head = (self.head + 1) % IN_FLIGHT;
        self.count -= 1;
        Ok(Some(len))
    }

    fn next_arrival(&self) -> Option<Nanos> {
        (self.count > 0).then(|| self.ring[self.head].at)
    }
}
