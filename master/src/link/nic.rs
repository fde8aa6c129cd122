//! An interface through an AF_PACKET socket.
//!
//! With [`SocketKind::Ring`], received frames are stored in mapped memory: polling for a frame
//! costs a memory read instead of a system call. The ring has version 2 (TPACKET_V2), which
//! releases each frame at once. Version 3 releases whole blocks of frames, when they are full or
//! after a timer of at least one millisecond. Frames are sent one by one: a transmit ring would
//! need a system call each as well.

use super::filter::{LinkStats, ReceivedFrame, RejectReason, classify_frame};
use super::interface::{self, OpenError};
use super::{Link, LinkError, MAX_FRAME, SocketKind};
use crate::sys::packet::PacketSocket;
use crate::sys::ring::Ring;

/// A slot holds header, address and a whole frame: 66 bytes in front, then 1514 bytes.
const SLOT: usize = 2048;

/// Capacity between two polls: 16 ms at 8 kHz with two frames per cycle.
const SLOTS: usize = 256;

/// The maximum of foreign frames skipped per call; the rest waits for the next call.
const PASSED_OVER: usize = 32;

/// One interface, receiving EtherCAT frames only.
#[derive(Debug)]
pub struct NicLink {
    nic: String,
    // Declared before the socket, so that it is dropped first.
    ring: Option<Ring>,
    socket: PacketSocket,
    stats: LinkStats,
}

impl NicLink {
    /// Opens the interface. Blocks and allocates.
    ///
    /// # Errors
    /// [`OpenError::NoRing`] if the kernel provides no ring; [`SocketKind::Packet`] may still work.
    pub fn open(nic: &str, kind: SocketKind) -> Result<Self, OpenError> {
        interface::check(nic)?;
        Self::open_unchecked(nic, kind)
    }

    /// Like [`NicLink::open`], also without a link to a device. Blocks and allocates.
    ///
    /// # Errors
    /// As [`NicLink::open`].
    pub(super) fn open_unchecked(nic: &str, kind: SocketKind) -> Result<Self, OpenError> {
        let index = interface::index(nic)?;
        let socket = interface::socket(nic)?;
        let ring = match kind {
            SocketKind::Ring => {
                let ring = socket.receive_ring(SLOTS, SLOT);
                Some(ring.map_err(|source| OpenError::NoRing {
                    nic: nic.to_owned(),
                    source,
                })?)
            }
            SocketKind::Packet => {
                // VLAN tags are visible only with this option, which all current kernels support.
                let _ = socket.set(libc::PACKET_AUXDATA, 1);
                None
            }
        };
        interface::bind(nic, &socket, index)?;
        Ok(Self {
            nic: nic.to_owned(),
            ring,
            socket,
            stats: LinkStats::default(),
        })
    }
}

impl Link for NicLink {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        if frame.len() > MAX_FRAME {
            return Err(LinkError::TooLong(frame.len()));
        }
        self.socket.send(frame).map_err(LinkError::Send)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        for _ in 0..PASSED_OVER {
            let taken = match &mut self.ring {
                Some(ring) => from_ring(ring, buf),
                None => from_socket(&self.socket, buf).map_err(LinkError::Receive)?,
            };
            match taken {
                Some(Ok(len)) => return Ok(Some(len)),
                Some(Err(refused)) => self.stats.count(refused),
                None => return Ok(None),
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

    fn nic(&self) -> Option<&str> {
        Some(&self.nic)
    }
}

/// Copies the frame in the next slot. RT: no system call.
fn from_ring(ring: &mut Ring, buf: &mut [u8; MAX_FRAME]) -> Option<Result<usize, RejectReason>> {
    let seen = header::parse(ring.front()?);
    let judged = seen.and_then(|seen| classify_frame(&seen).map(|()| seen.frame));
    let taken = judged.map(|frame| {
        // `classify_frame` rejects longer frames.
        let len = frame.len().min(buf.len());
        buf[..len].copy_from_slice(&frame[..len]);
        len
    });
    ring.release();
    Some(taken)
}

/// Receives the next frame with one system call.
fn from_socket(
    socket: &PacketSocket,
    buf: &mut [u8; MAX_FRAME],
) -> rustix::io::Result<Option<Result<usize, RejectReason>>> {
    let received = socket.receive(&mut buf[..])?;
    Ok(received.map(|received| {
        classify_frame(&ReceivedFrame {
            frame: &buf[..received.len],
            wire_len: received.wire_len,
            status: received.status,
            packet_type: received.packet_type,
        })
        .map(|()| received.len)
    }))
}

/// The header of a slot: `tpacket2_hdr`, then `sockaddr_ll`, aligned to 16 bytes
/// (linux/if_packet.h).
mod header {
    use std::mem::offset_of;

    use libc::{sockaddr_ll, tpacket2_hdr};

    use super::super::filter::{ReceivedFrame, RejectReason};

    const ADDRESS: usize = size_of::<tpacket2_hdr>().next_multiple_of(16);
    pub(super) const STATUS: usize = offset_of!(tpacket2_hdr, tp_status);
    pub(super) const LEN: usize = offset_of!(tpacket2_hdr, tp_len);
    pub(super) const SNAPLEN: usize = offset_of!(tpacket2_hdr, tp_snaplen);
    pub(super) const MAC: usize = offset_of!(tpacket2_hdr, tp_mac);
    pub(super) const PACKET_TYPE: usize = ADDRESS + offset_of!(sockaddr_ll, sll_pkttype);
    #[cfg(test)]
    pub(super) const HEAD: usize = ADDRESS + size_of::<sockaddr_ll>();

    /// Returns the frame in a slot. RT.
    ///
    /// # Errors
    /// [`RejectReason::Damaged`] if the frame would extend beyond the slot.
    pub(super) fn parse(slot: &[u8]) -> Result<ReceivedFrame<'_>, RejectReason> {
        let word = |at: usize| {
            let bytes = slot.get(at..)?.first_chunk()?;
            Some(u32::from_ne_bytes(*bytes))
        };
        let fields = || {
            let mac = u16::from_ne_bytes(*slot.get(MAC..)?.first_chunk()?);
            let start = usize::from(mac);
            let end = start.checked_add(usize::try_from(word(SNAPLEN)?).ok()?)?;
            Some(ReceivedFrame {
                frame: slot.get(start..end)?,
                wire_len: usize::try_from(word(LEN)?).ok()?,
                status: word(STATUS)?,
                packet_type: *slot.get(PACKET_TYPE)?,
            })
        };
        fields().ok_or(RejectReason::Damaged)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::filter::tests::answer;
    use super::*;

    /// Returns a slot as the kernel fills it.
    fn slot(frame: &[u8], status: u32, packet_type: u8) -> Vec<u8> {
        let mac = header::HEAD.next_multiple_of(16) + 2;
        let mut slot = vec![0xa5; SLOT];
        let len = u32::try_from(frame.len()).unwrap();
        slot[header::STATUS..][..4].copy_from_slice(&status.to_ne_bytes());
        slot[header::LEN..][..4].copy_from_slice(&len.to_ne_bytes());
        slot[header::SNAPLEN..][..4].copy_from_slice(&len.to_ne_bytes());
        slot[header::MAC..][..2].copy_from_slice(&u16::try_from(mac).unwrap().to_ne_bytes());
        slot[header::PACKET_TYPE] = packet_type;
        slot[mac..mac + frame.len()].copy_from_slice(frame);
        slot
    }

    #[test]
    fn parse_finds_the_frame_by_its_slot_header() {
        let frame = answer(100);
        let slot = slot(&frame, libc::TP_STATUS_USER, libc::PACKET_BROADCAST);
        let seen = header::parse(&slot).unwrap();
        assert_eq!(seen.frame, frame);
        assert_eq!(seen.wire_len, frame.len());
        assert_eq!(seen.packet_type, libc::PACKET_BROADCAST);
        assert_eq!(classify_frame(&seen), Ok(()));
    }

    #[test]
    fn a_frame_that_would_reach_beyond_its_slot_is_damaged() {
        let mut slot = slot(&answer(100), libc::TP_STATUS_USER, 1);
        slot[header::SNAPLEN..][..4].copy_from_slice(&u32::MAX.to_ne_bytes());
        assert_eq!(header::parse(&slot).err(), Some(RejectReason::Damaged));
        slot[header::SNAPLEN..][..4].copy_from_slice(&100_u32.to_ne_bytes());
        slot[header::MAC..][..2].copy_from_slice(&u16::MAX.to_ne_bytes());
        assert_eq!(header::parse(&slot).err(), Some(RejectReason::Damaged));
    }

    proptest! {
        #[test]
        fn parse_returns_the_frame_in_the_slot(len in 0_u16..1499, status: u32, packet_type: u8) {
            let frame = answer(len);
            let slot = slot(&frame, status, packet_type);
            let seen = header::parse(&slot).unwrap();
            prop_assert_eq!(seen.frame, frame.as_slice());
            prop_assert_eq!((seen.status, seen.packet_type), (status, packet_type));
        }

        #[test]
        fn parse_never_panics(slot in prop::collection::vec(any::<u8>(), 0..300), head: [u8; 16]) {
            let mut slot = slot;
            // Small numbers in the header, so that some frames do lie within the slot.
            for (byte, from) in slot.iter_mut().zip(head) {
                *byte = from & if from % 3 == 0 { 0xff } else { 0x01 };
            }
            if let Ok(seen) = header::parse(&slot) {
                prop_assert!(seen.frame.len() <= slot.len());
                let _ = classify_frame(&seen);
            }
        }
    }
}
