//! Transports for Ethernet frames. Nothing here knows EtherCAT beyond its frame header.
//!
//! - [`interface`]: the requirements on a network interface;
//! - [`nic`]: a network interface, through mapped memory or a plain socket;
//! - [`lock`]: one program per interface;
//! - [`filter`]: selects the frames of an interface that belong to this program;
//! - [`sim`]: the simulated bus in this process, with its frames in a [`FrameQueue`];
//! - [`source_address`]: a separate source address, for use while a machine runs on the same
//!   interface;
//! - [`capture`]: records the frames of any link;
//! - [`replay`]: a recording in place of a bus;
//! - [`second_end`]: finds the second interface of a ring that only one interface names;
//! - [`redundant`]: cable redundancy, two interfaces as one link;
//! - [`scan_answers`]: answers ethercrab's scan from what was found before;
//! - [`pdu_loop`]: connects ethercrab to a link.

use std::fmt;
use std::time::{Duration, Instant};

pub mod capture;
pub mod filter;
mod frame_queue;
pub mod interface;
mod joined_frame;
pub mod lock;
pub mod nic;
pub mod pdu_loop;
pub mod redundant;
pub mod replay;
pub mod scan_answers;
pub mod second_end;
pub mod sim;
mod socket_kind;
pub mod source_address;

pub use crate::clock::Nanos;
pub use filter::LinkStats;
pub use frame_queue::FrameQueue;
pub use interface::{NicWarning, OpenError};
pub use lock::{open_end_exclusive, open_exclusive};
use nic::NicLink;
pub use socket_kind::SocketKind;

/// Largest frame without FCS.
pub const MAX_FRAME: usize = 1514;
/// The data bytes of the only datagram in such a frame: the frame without Ethernet header (14
/// bytes), EtherCAT header (2), datagram header (10) and working counter (2).
pub const MAX_DATA: u16 = 1486;

/// Sends and receives frames. RT: no method blocks or allocates, unless stated otherwise.
pub trait Link: fmt::Debug + Send {
    /// Sends one whole Ethernet frame (without FCS).
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError>;

    /// Copies the next received frame to the front of `buf` and returns its length; `None` if none
    /// has arrived.
    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError>;

    /// Returns the arrival time of the next frame, if a simulated link knows it. Virtual time can
    /// then jump instead of spinning.
    fn next_arrival(&self) -> Option<Nanos> {
        None
    }

    /// Returns the number of EtherCAT frames of other MainDevices received so far. RT.
    fn main_devices(&self) -> u64 {
        0
    }

    /// Returns the counters of rejected and dropped frames. Not for the cycle: may call the kernel.
    fn stats(&mut self) -> LinkStats {
        LinkStats::default()
    }

    /// Returns further notices for the end of a run. Not for the cycle.
    fn notices(&mut self) -> Vec<String> {
        Vec::new()
    }

    /// Returns the state of the ring, if the link has both ends of one.
    fn ring(&self) -> Option<&'static redundant::RingStatus> {
        None
    }

    /// Returns the network interface, if the link has exactly one. Not for the cycle.
    fn nic(&self) -> Option<&str> {
        None
    }

    /// Returns the sender of input values, once, if the link has a simulated bus.
    fn take_sim_inputs(&mut self) -> Option<sim::SimInputSender> {
        None
    }

    /// Returns why no more frames can arrive, if the link knows it. Not for the cycle.
    fn exhausted_reason(&self) -> Option<&'static str> {
        None
    }

    /// Ends the recording in this link, if there is one. Blocks.
    fn finish(self: Box<Self>) -> std::io::Result<Option<capture::RecordStats>> {
        Ok(None)
    }
}

/// Opens a network interface and returns warnings about settings that disturb the cycle. If no ring
/// is available, a plain socket is used, with a warning. Blocks and allocates.
///
/// # Errors
/// The reason why the interface cannot be used.
pub fn open(
    nic: &str,
    back_end: SocketKind,
) -> Result<(Box<dyn Link>, Vec<NicWarning>), OpenError> {
    open_with(nic, back_end, NicLink::open)
}

/// Like [`open`], for one end of a ring: an interface without a link is a warning.
///
/// # Errors
/// As [`open`].
pub fn open_end(
    nic: &str,
    back_end: SocketKind,
) -> Result<(Box<dyn Link>, Vec<NicWarning>), OpenError> {
    match interface::check(nic) {
        Err(OpenError::NoCarrier { .. } | OpenError::Down { .. }) => {
            let (link, mut concerns) = open_with(nic, back_end, NicLink::open_unchecked)?;
            let nic = nic.to_owned();
            concerns.push(NicWarning::NoLink { nic });
            Ok((link, concerns))
        }
        _ => open(nic, back_end),
    }
}

fn open_with(
    nic: &str,
    back_end: SocketKind,
    open: impl Fn(&str, SocketKind) -> Result<NicLink, OpenError>,
) -> Result<(Box<dyn Link>, Vec<NicWarning>), OpenError> {
    let mut concerns = interface::concerns(nic);
    let link = open(nic, back_end).or_else(|error| match error {
        OpenError::NoRing { nic, source } => {
            let link = open(&nic, SocketKind::Packet);
            let reason = source.to_string();
            concerns.push(NicWarning::NoRing { nic, reason });
            link
        }
        error => Err(error),
    })?;
    Ok((Box::new(link), concerns))
}

/// The listening time before anything is sent. The slowest cycles take some tens of milliseconds.
pub const LISTEN: Duration = Duration::from_millis(100);

/// Returns the EtherCAT frames received within [`LISTEN`] from `start` without sending: frames of
/// another MainDevice. Blocks, on the monotonic clock. The link must have been open since `start`.
///
/// # Errors
/// Errors of the link.
pub fn sniff_foreign_frames(link: &mut dyn Link, start: Instant) -> Result<u64, LinkError> {
    let mut buf = [0; MAX_FRAME];
    let mut frames = 0;
    let end = start + LISTEN;
    while Instant::now() < end {
        while link.recv(&mut buf)?.is_some() {
            // A program that only accesses a running segment is not a MainDevice.
            frames += u64::from(!source_address::is_acyclic_client_frame(&buf));
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    Ok(frames + link.stats().main_devices)
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum LinkError {
    #[error("sending failed: {0}")]
    Send(#[source] rustix::io::Errno),
    #[error("receiving failed: {0}")]
    Receive(#[source] rustix::io::Errno),
    #[error("a frame of {0} bytes exceeds what the link carries")]
    TooLong(usize),
}
