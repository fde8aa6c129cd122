//! The segment on a real network interface, in real time: other MainDevices may judge it.
//!
//! * `socket`: the raw socket
//! * `stats`: what is counted

mod socket;
mod stats;

use std::io;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::frame::{self, Kind};
use crate::network::Nic;
use crate::{Nanos, Segment, Transit};
use socket::{RawSocket, Received, clock};
pub use stats::{Histogram, ServeStats};

const MAX_FRAME: usize = 1522;

#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    #[error("the interface `{0}` does not exist")]
    NoSuchInterface(String),
    #[error("the interface `{0}` is not an Ethernet interface")]
    NotEthernet(String),
    #[error("the interface `{0}` is gone")]
    Gone(String),
    #[error("opening a raw socket on `{0}` is not permitted")]
    NotPermitted(String),
    #[error("the interface `{nic}`: {what}: {source}")]
    Io {
        nic: String,
        what: &'static str,
        source: io::Error,
    },
}

/// Replies held back at once; more are lost, and counted as not sent.
const MOST_HELD: usize = 4096;
/// The simulation's own time passes at least this often.
const IDLE_NS: Nanos = 1_000_000;
/// Idle rounds after which to see whether the interface is still there.
const CHECK: u64 = 100;
/// A reply that a wire would bring this much later is held back; for less, timers are too coarse.
const HOLD_NS: Nanos = 100_000;

/// Interfaces on which a segment answers.
#[derive(Debug)]
pub struct Server {
    sockets: Vec<RawSocket>,
}

impl Server {
    /// Opens an interface; a second one is the MainDevice's second port, for a segment whose ring ends there.
    pub fn open(nics: &[&str]) -> Result<Self, ServeError> {
        let sockets = nics.iter().map(|nic| RawSocket::open(nic));
        Ok(Self {
            sockets: sockets.collect::<Result<_, _>>()?,
        })
    }

    /// Answers every frame until `stop` is set. A frame reaches the devices at the time it reached the
    /// interface.
    ///
    /// The thread sleeps until a frame comes. One that spins answers 1.5 times as fast at the median and takes
    /// ten times the processor's time; a MainDevice at 1 kHz would not notice.
    ///
    /// `between` is called between frames, once a millisecond at least, with the time.
    pub fn serve(
        &self,
        segment: &mut Segment,
        stop: &AtomicBool,
        mut between: impl FnMut(&mut Segment, Nanos),
    ) -> Result<ServeStats, ServeError> {
        let mut replies = Replies {
            sockets: &self.sockets,
            held: Vec::new(),
            stats: ServeStats::default(),
        };
        let mut buffer = [0_u8; MAX_FRAME];
        let mut idle = 0_u64;
        while !stop.load(Ordering::Relaxed) {
            let now = clock(libc::CLOCK_MONOTONIC);
            replies.release(now);
            segment.advance(now);
            between(segment, now);
            if !socket::wait(&self.sockets, replies.patience(now)) {
                idle += 1;
                if idle.is_multiple_of(CHECK) {
                    self.sockets.iter().try_for_each(RawSocket::check)?;
                }
                continue;
            }
            for (socket, nic) in self.sockets.iter().zip([Nic::Primary, Nic::Secondary]) {
                while let Some(received) = socket.receive(&mut buffer)? {
                    replies.answer(segment, nic, received, &mut buffer);
                    if stop.load(Ordering::Relaxed) {
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
    /// Those whose time has not come.
    held: Vec<Held>,
    stats: ServeStats,
}

struct Held {
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
            Transit::Lost => stats.lost += u64::from(!foreign),
            Transit::Back { at, nic, again } => {
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

    /// How long to wait for a frame.
    fn patience(&self, now: Nanos) -> Nanos {
        let due = self.held.iter().map(|held| held.at).min();
        due.map_or(IDLE_NS, |due| due.saturating_sub(now).min(IDLE_NS))
    }

    /// Sends a reply, or holds it back until it would arrive.
    fn back(&mut self, nic: Nic, at: Nanos, bytes: &[u8]) {
        if at < clock(libc::CLOCK_MONOTONIC).saturating_add(HOLD_NS) {
            self.send(nic, bytes);
        } else if self.held.len() < MOST_HELD {
            self.stats.delayed += 1;
            let bytes = bytes.to_vec();
            self.held.push(Held { at, nic, bytes });
        } else {
            self.stats.send_errors += 1;
        }
    }

    /// Sends what is due, in the order of its time.
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
        // Where nobody listens at a ring's end, the segment sends nothing there.
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
    fn a_missing_interface_is_named() {
        let error = Server::open(&["no-such-nic"]).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the interface `no-such-nic` does not exist"
        );
    }
}
