//! The segment on a real network interface, in real time, for any MainDevice.
//!
//! * `socket`: the raw socket
//! * `stats`: statistics
//!
//! ```no_run
//! use ecaxis_sim::{Segment, SegmentOptions, ServeStats, Server};
//!
//! let mut segment = Segment::new(Vec::new(), SegmentOptions::default());
//! let server = Server::open(&["eth1"])?;
//! let stop = || false;
//! let stats: ServeStats = server.serve(&mut segment, stop, |_segment, _now| {})?;
//! println!("{} frames", stats.frames);
//! # Ok::<(), ecaxis_sim::ServeError>(())
//! ```

mod socket;
mod stats;

use std::io;

use crate::frame::{self, Kind};
use crate::network::Nic;
use crate::{FrameOutcome, Nanos, Segment};
use socket::{RawSocket, Received, clock};
pub use stats::{Histogram, ServeStats};

const MAX_FRAME: usize = 1522;

/// A network interface cannot serve the segment. Contains its name.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// No interface has this name.
    #[error("the interface `{0}` does not exist")]
    NoSuchInterface(String),
    /// The interface does not carry Ethernet frames.
    #[error("the interface `{0}` is not an Ethernet interface")]
    NotEthernet(String),
    /// The interface disappeared or went down.
    #[error("the interface `{0}` is gone")]
    Gone(String),
    /// The process lacks the capability `CAP_NET_RAW`.
    #[error("opening a raw socket on `{0}` is not permitted")]
    NotPermitted(String),
    /// A system call failed.
    #[error("the interface `{nic}`: {what}: {source}")]
    Io {
        /// The interface.
        nic: String,
        /// The failed operation.
        what: &'static str,
        /// The error of the system call.
        source: io::Error,
    },
}

/// Maximum number of delayed replies. Further replies are dropped and counted as not sent.
const MOST_HELD: usize = 4096;
/// The maximum interval between two steps of the simulation in ns.
const IDLE_NS: Nanos = 1_000_000;
/// The number of idle rounds between two checks of the interface.
const CHECK: u64 = 100;
/// The period in ns at which the links of the interfaces are read.
const CARRIER_PERIOD_NS: Nanos = 10_000_000;
/// The minimum delay of a reply in ns. Timers are too coarse for shorter delays.
const HOLD_NS: Nanos = 100_000;

/// The network interfaces of a segment.
#[derive(Debug)]
pub struct Server {
    sockets: Vec<RawSocket>,
}

impl Server {
    /// Opens the interfaces. A second interface is the second port of the MainDevice, for a segment
    /// with a ring.
    pub fn open(nics: &[&str]) -> Result<Self, ServeError> {
        let sockets = nics.iter().map(|nic| RawSocket::open(nic));
        Ok(Self {
            sockets: sockets.collect::<Result<_, _>>()?,
        })
    }

    /// Answers every frame until `stop` returns true. A frame reaches the devices at the time of its
    /// arrival at the interface.
    ///
    /// The thread sleeps until a frame arrives. A spinning thread answers 1.5 times as fast at the
    /// median and uses ten times the CPU time; a MainDevice at 1 kHz would not notice.
    ///
    /// `between` is called with the time between frames, at least once per ms.
    pub fn serve(
        &self,
        segment: &mut Segment,
        stop: impl Fn() -> bool,
        mut between: impl FnMut(&mut Segment, Nanos),
    ) -> Result<ServeStats, ServeError> {
        let mut replies = Replies {
            sockets: &self.sockets,
            held: Vec::new(),
            stats: ServeStats::default(),
        };
        let mut buffer = [0_u8; MAX_FRAME];
        let mut idle = 0_u64;
        let mut carriers_due = 0;
        while !stop() {
            let now = clock(libc::CLOCK_MONOTONIC);
            if now >= carriers_due {
                carriers_due = now.saturating_add(CARRIER_PERIOD_NS);
                for (socket, nic) in self.sockets.iter().zip([Nic::Primary, Nic::Secondary]) {
                    segment.plug_main_device(nic, socket.has_carrier());
                }
            }
            replies.release(now);
            segment.advance(now);
            between(segment, now);
            if !socket::wait(&self.sockets, replies.time_to_next(now)) {
                idle += 1;
                if idle.is_multiple_of(CHECK) {
                    self.sockets.iter().try_for_each(RawSocket::check)?;
                }
                continue;
            }
            for (socket, nic) in self.sockets.iter().zip([Nic::Primary, Nic::Secondary]) {
                while let Some(received) = socket.receive(&mut buffer)? {
                    replies.answer(segment, nic, received, &mut buffer);
                    if stop() {
                        break;
                    }
                }
            }
        }
        Ok(replies.stats)
    }
}

struct Replies<'a> {
    sockets: &'a [RawSocket],
    /// Replies that wait for their time.
    held: Vec<DelayedReply>,
    stats: ServeStats,
}

struct DelayedReply {
    at: Nanos,
    nic: Nic,
    bytes: Vec<u8>,
}

impl Replies<'_> {
    fn answer(&mut self, segment: &mut Segment, nic: Nic, received: Received, buffer: &mut [u8]) {
        let stats = &mut self.stats;
        if received.cut {
            stats.malformed += 1;
            return;
        }
        let Some(bytes) = buffer.get_mut(..received.len) else {
            return;
        };
        let foreign = match frame::kind(bytes) {
            Kind::EtherCat => false,
            Kind::Malformed => {
                stats.malformed += 1;
                false
            }
            Kind::Foreign => {
                stats.foreign += 1;
                true
            }
        };
        stats.frames += u64::from(!foreign);
        match segment.transit_from(nic, bytes, received.at) {
            FrameOutcome::Lost => stats.lost += u64::from(!foreign),
            FrameOutcome::Back { at, nic, again } => {
                self.back(nic, at, bytes);
                if let Some(again) = again {
                    self.stats.duplicated += 1;
                    self.back(nic, again, bytes);
                }
                let sent = clock(libc::CLOCK_MONOTONIC);
                let turnaround = sent.saturating_sub(received.at);
                self.stats.turnaround.add(turnaround);
                self.release(sent);
            }
        }
    }

    /// Returns the time to wait for a frame in ns.
    fn time_to_next(&self, now: Nanos) -> Nanos {
        let due = self.held.iter().map(|held| held.at).min();
        due.map_or(IDLE_NS, |due| due.saturating_sub(now).min(IDLE_NS))
    }

    /// Sends a reply, or delays it until its arrival time.
    fn back(&mut self, nic: Nic, at: Nanos, bytes: &[u8]) {
        if at < clock(libc::CLOCK_MONOTONIC).saturating_add(HOLD_NS) {
            self.send(nic, bytes);
        } else if self.held.len() < MOST_HELD {
            self.stats.delayed += 1;
            let bytes = bytes.to_vec();
            self.held.push(DelayedReply { at, nic, bytes });
        } else {
            self.stats.send_errors += 1;
        }
    }

    /// Sends the due replies in the order of their times.
    fn release(&mut self, now: Nanos) {
        while let Some((n, held)) = self.held.iter().enumerate().min_by_key(|(_, held)| held.at) {
            if held.at > now {
                return;
            }
            let held = self.held.swap_remove(n);
            self.send(held.nic, &held.bytes);
        }
    }

    fn send(&mut self, nic: Nic, bytes: &[u8]) {
        // If the end of a ring has no receiver, the segment sends no frames there.
        let socket = self.sockets.get(nic as usize);
        if socket.is_some_and(|socket| socket.send(bytes)) {
            self.stats.answered += 1;
        } else {
            self.stats.send_errors += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn open_names_a_missing_interface() {
        let error = Server::open(&["no-such-nic"]).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the interface `no-such-nic` does not exist"
        );
    }
}
