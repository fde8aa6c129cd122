//! What carries Ethernet frames. Nothing here knows EtherCAT beyond its frame header.
//!
//! - [`interface`]: what a network interface must be;
//! - [`ring`], [`packet`]: a network interface, through mapped memory or a plain socket;
//! - [`claim`]: one program an interface;
//! - [`sift`]: which of an interface's frames are ours;
//! - [`sim`]: the simulated bus in this process;
//! - [`apart`]: an address of one's own, beside a machine that runs on the same interface;
//! - [`recorded`], [`capture`]: a recording around any of them;
//! - [`replay`]: a recording in the place of a bus;
//! - [`port`]: ethercrab's two ends.

use std::fmt;
use std::time::{Duration, Instant};

pub mod apart;
pub mod capture;
pub mod claim;
pub mod interface;
pub mod packet;
pub mod port;
pub mod recorded;
pub mod replay;
pub mod ring;
pub mod sift;
pub mod sim;

pub use crate::clock::Nanos;
pub use claim::open_alone;
pub use interface::{Concern, OpenError};
pub use sift::LinkStats;

/// Largest frame without FCS.
pub const MAX_FRAME: usize = 1514;
/// Data of the only datagram in such a frame: behind the Ethernet header (14 bytes), the frame's own (2) and the datagram's (10), before
/// its working counter (2).
pub const MAX_DATA: u16 = 1486;

/// A place to send frames to and receive them from. RT: no method blocks or allocates.
pub trait Link: fmt::Debug + Send {
    /// Hands one whole Ethernet frame (without FCS) to the wire.
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError>;

    /// The next frame that has arrived, copied to the front of `buf`; `None` where there is none.
    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError>;

    /// When the next frame will arrive, where the link can know it (it simulates). Lets virtual
    /// time jump instead of spin.
    fn next_arrival(&self) -> Option<Nanos> {
        None
    }

    /// EtherCAT frames of other MainDevices that came so far. RT.
    fn main_devices(&self) -> u64 {
        0
    }

    /// What has been seen beside the frames that were handed on. Not for the cycle: may ask the kernel.
    fn stats(&mut self) -> LinkStats {
        LinkStats::default()
    }

    /// What else there is to say at the end, in words. Not for the cycle.
    fn remarks(&mut self) -> Vec<String> {
        Vec::new()
    }

    /// Why nothing more can come, where the link knows it. Not for the cycle.
    fn lacks(&self) -> Option<&'static str> {
        None
    }

    /// Ends a recording that goes on in this link, if there is one. Blocks.
    fn finish(self: Box<Self>) -> std::io::Result<Option<capture::RecordStats>> {
        Ok(None)
    }
}

/// How frames are taken from a network interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum BackEnd {
    /// From mapped memory: [`ring::RingLink`].
    #[default]
    Ring,
    /// By system calls: [`packet::PacketLink`].
    Packet,
}

impl BackEnd {
    pub const ALL: &[Self] = &[Self::Ring, Self::Packet];

    /// As the machine file has it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Ring => "ring",
            Self::Packet => "packet",
        }
    }
}

impl fmt::Display for BackEnd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Opens a network interface, and tells what about it will disturb the cycle. Without a ring a plain socket takes its place,
/// which is told. Blocks and allocates.
///
/// # Errors
/// Why the interface cannot be used.
pub fn open(nic: &str, back_end: BackEnd) -> Result<(Box<dyn Link>, Vec<Concern>), OpenError> {
    let mut concerns = interface::concerns(nic);
    let link: Box<dyn Link> = match back_end {
        BackEnd::Ring => match ring::RingLink::open(nic) {
            Ok(link) => Box::new(link),
            Err(OpenError::NoRing { nic, source }) => {
                let link = packet::PacketLink::open(&nic)?;
                let reason = source.to_string();
                concerns.push(Concern::NoRing { nic, reason });
                Box::new(link)
            }
            Err(error) => return Err(error),
        },
        BackEnd::Packet => Box::new(packet::PacketLink::open(nic)?),
    };
    Ok((link, concerns))
}

/// How long is listened before anything is sent; the slowest cycles are of a few tens of milliseconds.
pub const LISTEN: Duration = Duration::from_millis(100);

/// EtherCAT frames that come in within [`LISTEN`], in which nothing is sent: another MainDevice's. Blocks, on the monotonic clock.
///
/// # Errors
/// Of the link.
pub fn heard(link: &mut dyn Link) -> Result<u64, LinkError> {
    let mut buf = [0; MAX_FRAME];
    let mut frames = 0;
    let end = Instant::now() + LISTEN;
    while Instant::now() < end {
        while link.recv(&mut buf)?.is_some() {
            // Who only looks beside a machine leads nothing.
            frames += u64::from(!apart::is_beside(&buf));
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    Ok(frames + link.stats().main_devices)
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum LinkError {
    #[error("sending failed: {0}")]
    Send(rustix::io::Errno),
    #[error("receiving failed: {0}")]
    Receive(rustix::io::Errno),
    #[error("a frame of {0} bytes exceeds what the link carries")]
    TooLong(usize),
}
