//! An interface through an AF_XDP socket: frames are taken before the network stack sees them, into memory shared with the
//! kernel. Copy mode and generic XDP, which every interface has; drivers with more would save a copy.
//!
//! Frames are taken from the first receive queue of the interface. That is where those without IP go.

use super::interface::{self, ETHERTYPE, OpenError};
use super::sift::{LinkStats, Seen, sift};
use super::{Link, LinkError, MAX_FRAME};
use crate::os::bpf::Program;
use crate::os::xdp::XdpSocket;

const QUEUE: u32 = 0;

/// Foreign frames passed over at once; the rest waits for the next look.
const PASSED_OVER: usize = 32;

/// One interface, from which EtherCAT frames are taken.
#[derive(Debug)]
pub struct XdpLink {
    // No frame is led to a socket that is gone.
    _program: Program,
    socket: XdpSocket,
    stats: LinkStats,
}

impl XdpLink {
    /// Opens the interface. Blocks and allocates.
    ///
    /// # Errors
    /// Why it cannot be used; among them a program that is on the interface already.
    pub fn open(nic: &str) -> Result<Self, OpenError> {
        let index = interface::check(nic)?;
        let failed = |what| {
            move |source: std::io::Error| match source.kind() {
                std::io::ErrorKind::PermissionDenied => OpenError::NotPermitted {
                    nic: nic.to_owned(),
                },
                _ => OpenError::Io {
                    nic: nic.to_owned(),
                    what,
                    source,
                },
            }
        };
        let socket = XdpSocket::new(index, QUEUE).map_err(failed("opening an AF_XDP socket"))?;
        let program = Program::attach(index, QUEUE, ETHERTYPE, &socket)
            .map_err(failed("attaching an XDP program"))?;
        Ok(Self {
            _program: program,
            socket,
            stats: LinkStats::default(),
        })
    }
}

impl Link for XdpLink {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        if frame.len() > MAX_FRAME {
            return Err(LinkError::TooLong(frame.len()));
        }
        self.socket.send(frame).map_err(LinkError::Send)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        for _ in 0..PASSED_OVER {
            let Some(frame) = self.socket.front() else {
                return Ok(None);
            };
            let seen = Seen {
                frame,
                wire_len: frame.len(),
                status: 0,
                packet_type: libc::PACKET_BROADCAST,
            };
            let taken = sift(&seen).map(|()| {
                // `sift` lets nothing longer pass.
                let len = frame.len().min(buf.len());
                buf[..len].copy_from_slice(&frame[..len]);
                len
            });
            self.socket.release();
            match taken {
                Ok(len) => return Ok(Some(len)),
                Err(refused) => self.stats.count(refused),
            }
        }
        Ok(None)
    }

    fn main_devices(&self) -> u64 {
        self.stats.main_devices
    }

    fn stats(&mut self) -> LinkStats {
        self.stats.dropped = self.socket.dropped().unwrap_or(self.stats.dropped);
        self.stats
    }
}
