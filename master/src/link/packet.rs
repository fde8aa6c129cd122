//! An interface through a plain AF_PACKET socket: one system call per frame and per poll.

use super::filter::{LinkStats, ReceivedFrame, classify_frame};
use super::interface::{self, OpenError};
use super::{Link, LinkError, MAX_FRAME};
use crate::sys::packet::PacketSocket;

/// The maximum of foreign frames skipped per call; the rest waits for the next call.
const PASSED_OVER: usize = 32;

/// One interface, receiving EtherCAT frames only.
#[derive(Debug)]
pub struct PacketLink {
    socket: PacketSocket,
    stats: LinkStats,
}

impl PacketLink {
    /// Opens the interface. Blocks and allocates.
    ///
    /// # Errors
    /// The reason why the interface cannot be used.
    pub fn open(nic: &str) -> Result<Self, OpenError> {
        let index = interface::check(nic)?;
        let socket = interface::socket(nic)?;
        // VLAN tags are visible only with this option, which all current kernels support.
        let _ = socket.set(libc::PACKET_AUXDATA, 1);
        interface::bind(nic, &socket, index)?;
        Ok(Self {
            socket,
            stats: LinkStats::default(),
        })
    }
}

impl Link for PacketLink {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        if frame.len() > MAX_FRAME {
            return Err(LinkError::TooLong(frame.len()));
        }
        self.socket.send(frame).map_err(LinkError::Send)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        for _ in 0..PASSED_OVER {
            let received = self.socket.receive(&mut buf[..]);
            let Some(received) = received.map_err(LinkError::Receive)? else {
                return Ok(None);
            };
            let seen = ReceivedFrame {
                frame: &buf[..received.len],
                wire_len: received.wire_len,
                status: received.status,
                packet_type: received.packet_type,
            };
            match classify_frame(&seen) {
                Ok(()) => return Ok(Some(received.len)),
                Err(refused) => self.stats.count(refused),
            }
        }
        Ok(None)
    }

    fn main_devices(&self) -> u64 {
        self.stats.main_devices
    }

    fn stats(&mut self) -> LinkStats {
        interface::add_drops(&self.socket, &mut self.stats);
        self.stats
    }
}
