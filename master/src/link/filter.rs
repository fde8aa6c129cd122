//! Selects the frames of an interface that belong to this program.

use serde::Serialize;

use super::MAX_FRAME;
use super::pdu_loop::ETHERCAT;
use super::redundant::MARK;

/// Ethernet header and EtherCAT header.
const HEADERS: usize = 16;

/// All frames of this program are broadcasts from this source address. The last two bytes of the
/// address distinguish them.
const TO_ALL: [u8; 6] = [0xff; 6];
pub(super) const SOURCE: [u8; 4] = [0x10; 4];

/// The first SubDevice sets this bit in the first byte of the source address.
const PROCESSED: u8 = 0x02;

/// A received frame with its metadata from the kernel.
#[derive(Debug, Clone, Copy)]
pub struct ReceivedFrame<'f> {
    pub frame: &'f [u8],
    /// The length on the wire; longer than `frame` if the frame was truncated.
    pub wire_len: usize,
    /// `tp_status`: `TP_STATUS_…`.
    pub status: u32,
    /// `sll_pkttype`: `PACKET_…`.
    pub packet_type: u8,
}

/// Why a frame is rejected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RejectReason {
    /// Sent by this host; not counted.
    Outgoing,
    /// It had a VLAN tag, which the kernel has removed. Frames of this program have none.
    Tagged,
    /// Another protocol.
    Foreign,
    /// EtherCAT, but from another source address.
    MainDevice,
    /// Shorter than its headers say, or longer than the maximum.
    Damaged,
}

/// Counters of frames that a link rejected or lost.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct LinkStats {
    /// Frames of other protocols or other MainDevices.
    pub foreign: u64,
    /// The EtherCAT frames among them: sent by another MainDevice.
    pub main_devices: u64,
    /// Frames with a VLAN tag.
    pub tagged: u64,
    /// Frames shorter than their headers say, or longer than the maximum.
    pub damaged: u64,
    /// Frames that the kernel dropped because its receive buffer was full.
    pub dropped: u64,
}

impl LinkStats {
    pub(super) fn count(&mut self, refused: RejectReason) {
        match refused {
            RejectReason::Outgoing => {}
            RejectReason::Tagged => self.tagged += 1,
            RejectReason::Foreign => self.foreign += 1,
            RejectReason::MainDevice => {
                self.foreign += 1;
                self.main_devices += 1;
            }
            RejectReason::Damaged => self.damaged += 1,
        }
    }

    /// True if any counter is not zero.
    /// Returns the sum of the counters of two interfaces.
    #[must_use]
    pub(super) fn plus(self, other: Self) -> Self {
        Self {
            foreign: self.foreign + other.foreign,
            main_devices: self.main_devices + other.main_devices,
            tagged: self.tagged + other.tagged,
            damaged: self.damaged + other.damaged,
            dropped: self.dropped + other.dropped,
        }
    }

    #[must_use]
    pub fn any(&self) -> bool {
        *self != Self::default()
    }
}

/// Checks that a frame may be an answer to this program: complete, untagged, EtherCAT, from its
/// source addresses. Padding after the EtherCAT part is ignored. RT: O(1).
///
/// # Errors
/// The reason for the rejection.
pub fn classify_frame(seen: &ReceivedFrame<'_>) -> Result<(), RejectReason> {
    if seen.packet_type == libc::PACKET_OUTGOING {
        return Err(RejectReason::Outgoing);
    }
    if seen.status & libc::TP_STATUS_VLAN_VALID != 0 {
        return Err(RejectReason::Tagged);
    }
    let frame = seen.frame;
    if frame.len() > MAX_FRAME || seen.wire_len > frame.len() {
        return Err(RejectReason::Damaged);
    }
    let Some(&[headers @ .., low, high]) = frame.first_chunk::<HEADERS>() else {
        return Err(RejectReason::Damaged);
    };
    let (to, rest) = headers.split_at(TO_ALL.len());
    if rest[6..] != ETHERCAT {
        return Err(RejectReason::Foreign);
    }
    if to != TO_ALL {
        return Err(RejectReason::MainDevice);
    }
    // The kernel reports a broadcast as PACKET_OTHERHOST only if its tag names a VLAN unknown to
    // this host. The kernel has then removed the tag.
    if seen.packet_type == libc::PACKET_OTHERHOST {
        return Err(RejectReason::Tagged);
    }
    let source = [rest[0] & !PROCESSED, rest[1], rest[2], rest[3] & !MARK];
    if source != SOURCE {
        return Err(RejectReason::MainDevice);
    }
    // ETG.1000.4, table 11: 11 bits length, one reserved bit, and the type; 1 means datagrams.
    let header = u16::from_le_bytes([low, high]);
    if header >> 12 != 1 {
        return Err(RejectReason::Foreign);
    }
    if HEADERS + usize::from(header & 0x07ff) > frame.len() {
        return Err(RejectReason::Damaged);
    }
    Ok(())
}

#[cfg(test)]
pub(super) mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Returns a frame of this program as it comes back, with `len` bytes of datagrams.
    pub(in crate::link) fn answer(len: u16) -> Vec<u8> {
        let mut frame = vec![0xff; 6];
        frame.extend([0x12, 0x10, 0x10, 0x10, 0x00, 0x20]);
        frame.extend(ETHERCAT);
        frame.extend((0x1000 | len).to_le_bytes());
        frame.resize(frame.len() + usize::from(len), 0x5a);
        frame
    }

    fn seen(frame: &[u8]) -> ReceivedFrame<'_> {
        ReceivedFrame {
            frame,
            wire_len: frame.len(),
            status: libc::TP_STATUS_USER,
            packet_type: libc::PACKET_BROADCAST,
        }
    }

    fn judged(change: impl FnOnce(&mut Vec<u8>)) -> Result<(), RejectReason> {
        let mut frame = answer(44);
        change(&mut frame);
        classify_frame(&seen(&frame))
    }

    #[test]
    fn classify_frame_accepts_answers_with_and_without_padding() {
        assert_eq!(judged(|_| {}), Ok(()));
        assert_eq!(judged(|f| f.truncate(60)), Ok(()));
        assert_eq!(judged(|f| f.resize(MAX_FRAME, 0)), Ok(()), "padding");
        assert_eq!(judged(|f| *f = answer(12)), Ok(()), "a runt");
        assert_eq!(judged(|f| f[10..12].copy_from_slice(&[0x10, 0x10])), Ok(()));
        assert_eq!(judged(|f| f[6] = 0x10), Ok(()), "nothing has processed it");
        assert_eq!(
            judged(|f| f[9] = 0x90),
            Ok(()),
            "from the other end of a ring"
        );
    }

    #[test]
    fn classify_frame_rejects_other_frames() {
        use RejectReason::{Damaged, Foreign, MainDevice};
        assert_eq!(judged(|f| f[12] = 0x08), Err(Foreign), "EtherType");
        assert_eq!(judged(|f| f[0] = 0x01), Err(MainDevice), "destination");
        assert_eq!(judged(|f| f[6] = 0x52), Err(MainDevice), "source");
        assert_eq!(judged(|f| f[9] = 0x11), Err(MainDevice), "source");
        assert_eq!(judged(|f| f[15] = 0x40), Err(Foreign), "network variables");
        assert_eq!(
            judged(|f| f.truncate(59)),
            Err(Damaged),
            "shorter than it says"
        );
        assert_eq!(judged(|f| f.truncate(15)), Err(Damaged), "no header");
        assert_eq!(judged(Vec::clear), Err(Damaged));
        assert_eq!(judged(|f| f.resize(MAX_FRAME + 1, 0)), Err(Damaged));
        let frame = answer(44);
        let cut = ReceivedFrame {
            wire_len: 2000,
            ..seen(&frame)
        };
        assert_eq!(classify_frame(&cut), Err(Damaged));
    }

    #[test]
    fn classify_frame_detects_vlan_tags_removed_by_the_kernel() {
        let frame = answer(44);
        let in_status = ReceivedFrame {
            status: libc::TP_STATUS_USER | libc::TP_STATUS_VLAN_VALID,
            ..seen(&frame)
        };
        assert_eq!(classify_frame(&in_status), Err(RejectReason::Tagged));
        let for_another = ReceivedFrame {
            packet_type: libc::PACKET_OTHERHOST,
            ..seen(&frame)
        };
        assert_eq!(classify_frame(&for_another), Err(RejectReason::Tagged));
        let sent = ReceivedFrame {
            packet_type: libc::PACKET_OUTGOING,
            ..seen(&frame)
        };
        assert_eq!(classify_frame(&sent), Err(RejectReason::Outgoing));
    }

    proptest! {
        #[test]
        fn classify_frame_accepts_only_complete_own_frames(
            mut frame in prop::collection::vec(any::<u8>(), 0..1600),
            pieces in any::<[bool; 4]>(), more in 0_usize..3, status: u32, packet_type in 0_u8..8,
        ) {
            // Random bytes alone never resemble an answer.
            let ours = answer(0);
            for (piece, at) in pieces.into_iter().zip([0..6, 6..10, 12..14, 15..16]) {
                if piece && frame.len() >= ours.len() {
                    frame[at.clone()].copy_from_slice(&ours[at]);
                }
            }
            let seen = ReceivedFrame { frame: &frame, wire_len: frame.len() + more, status, packet_type };
            if classify_frame(&seen).is_ok() {
                prop_assert_eq!(more, 0);
                prop_assert_eq!(&frame[..6], &ours[..6]);
                prop_assert_eq!(&frame[7..9], &ours[7..9]);
                prop_assert_eq!(frame[9] & !MARK, ours[9]);
                prop_assert_eq!(&frame[12..14], &ours[12..14]);
                let len = usize::from(u16::from_le_bytes([frame[14], frame[15]]) & 0x07ff);
                prop_assert!(16 + len <= frame.len() && frame.len() <= MAX_FRAME);
            }
        }
    }
}
