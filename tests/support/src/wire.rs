//! A simulated bus as a link that a test watches and changes between frames.

use std::fmt;

use ecaxis_master::clock::Nanos;
use ecaxis_master::config::Machine;
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::link::{Link, LinkError, MAX_FRAME};
use ecaxis_master::session::{Options, simulated_bus};
use ecaxis_sim::Segment;

use crate::recordings::LRW;

/// What a test does at the cyclic frames of a bus with one frame per cycle.
pub trait Watcher: Send {
    /// A cyclic frame is about to be sent.
    fn before(&mut self, _segment: &mut Segment) {}

    /// The frame has passed all devices; its answer is on its way.
    fn after(&mut self, _segment: &mut Segment) {}

    /// The answer has arrived. Returns false if it is lost.
    fn answer(&mut self, _frame: &mut [u8]) -> bool {
        true
    }
}

/// The simulated bus with its watcher.
pub struct WatchedBus<W> {
    bus: SimLink,
    watcher: W,
}

impl<W> fmt::Debug for WatchedBus<W> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("WatchedBus")
    }
}

impl<W: Watcher> WatchedBus<W> {
    /// Builds the bus of a machine. Call it on the thread and the clock of the run.
    pub fn new(machine: &Machine, options: &Options, watcher: W) -> Self {
        options.clock.enter();
        let faults = options.faults.as_ref();
        let segment = simulated_bus(machine, options.seed, faults, None).expect("a bus");
        Self {
            bus: SimLink::new(segment),
            watcher,
        }
    }
}

fn is_cyclic(frame: &[u8]) -> bool {
    frame[11] == 0x20
}

impl<W: Watcher> Link for WatchedBus<W> {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        if !is_cyclic(frame) {
            return self.bus.send(frame);
        }
        self.watcher.before(self.bus.segment_mut());
        let sent = self.bus.send(frame);
        self.watcher.after(self.bus.segment_mut());
        sent
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        while let Some(len) = self.bus.recv(buf)? {
            if !is_cyclic(buf) || self.watcher.answer(&mut buf[..len]) {
                return Ok(Some(len));
            }
        }
        Ok(None)
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.bus.next_arrival()
    }
}

/// Subtracts 1 from the working counter of an LRW datagram, counted from 0. Returns the number of
/// LRW datagrams in the frame.
pub fn miss_working_counter(frame: &mut [u8], number: usize) -> usize {
    let mut found = 0;
    let mut at = 16;
    loop {
        let length = u16::from_le_bytes([frame[at + 6], frame[at + 7]]);
        let counter = at + 10 + usize::from(length & 0x7ff);
        if frame[at] == LRW {
            frame[counter] -= u8::from(found == number);
            found += 1;
        }
        if length & 0x8000 == 0 {
            return found;
        }
        at = counter + 2;
    }
}
