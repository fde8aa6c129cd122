//! Which of an interface's frames are ours.

use serde::Serialize;

use super::MAX_FRAME;
use super::port::ETHERCAT;

/// Ethernet header and EtherCAT header.
const HEADERS: usize = 16;

/// Every MainDevice frame of this program goes to all, from this address; the last two bytes tell its frames apart.
const TO_ALL: [u8; 6] = [0xff; 6];
const SOURCE: [u8; 4] = [0x10; 4];

/// The first SubDevice sets it in the first byte of the source address.
const PROCESSED: u8 = 0x02;

/// A received frame with what the kernel knows of it.
#[derive(Debug, Clone, Copy)]
pub struct Seen<'f> {
    pub frame: &'f [u8],
    /// Bytes that arrived; more than `frame` where it was cut.
    pub wire_len: usize,
    /// `tp_status`: `TP_STATUS_…`.
    pub status: u32,
    /// `sll_pkttype`: `PACKET_…`.
    pub packet_type: u8,
}

/// Why a frame is not handed on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refused {
    /// Sent by this computer; not worth counting.
    Outgoing,
    /// It had a VLAN tag, which the kernel has taken out. Ours have none.
    Tagged,
    /// Another protocol.
    Foreign,
    /// EtherCAT, but not from our addresses.
    MainDevice,
    /// Shorter than its headers say, or longer than a frame may be.
    Damaged,
}

/// What a link has seen beside what it was opened for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct LinkStats {
    /// Frames of other protocols or other MainDevices.
    pub foreign: u64,
    /// Those of them that are EtherCAT: another MainDevice's.
    pub main_devices: u64,
    /// Frames with a VLAN tag.
    pub tagged: u64,
    /// Frames too short for what they say, or too long.
    pub damaged: u64,
    /// Frames that the kernel had no room for: nobody looked for long.
    pub dropped: u64,
}

impl LinkStats {
    pub(super) fn count(&mut self, refused: Refused) {
        match refused {
            Refused::Outgoing => {}
            Refused::Tagged => self.tagged += 1,
            Refused::Foreign => self.foreign += 1,
            Refused::MainDevice => {
                self.foreign += 1;
                self.main_devices += 1;
            }
            Refused::Damaged => self.damaged += 1,
        }
    }

    /// Whether there is anything to tell.
    #[must_use]
    pub fn any(&self) -> bool {
        *self != Self::default()
    }
}

/// Whether a frame may be an answer to one of ours: whole, untagged, EtherCAT, from our addresses. Padding behind the
/// EtherCAT part is as good as none. RT: O(1).
///
/// # Errors
/// Why it is not.
pub fn sift(seen: &Seen<'_>) -> Result<(), Refused> {
    if seen.packet_type == libc::PACKET_OUTGOING {
        return Err(Refused::Outgoing);
    }
    if seen.status & libc::TP_STATUS_VLAN_VALID != 0 {
        return Err(Refused::Tagged);
    }
    let frame = seen.frame;
    if frame.len() > MAX_FRAME || seen.wire_len > frame.len() {
        return Err(Refused::Damaged);
    }
    let Some(&[headers @ .., low, high]) = frame.first_chunk::<HEADERS>() else {
        return Err(Refused::Damaged);
    };
    let (to, rest) = headers.split_at(TO_ALL.len());
    if rest[6..] != ETHERCAT {
        return Err(Refused::Foreign);
    }
    if to != TO_ALL {
        return Err(Refused::MainDevice);
    }
    // A frame to everybody is for this host, except where its tag named a VLAN that this host is not in: then the kernel
    // has taken the tag out and says nothing else of it.
    if seen.packet_type == libc::PACKET_OTHERHOST {
        return Err(Refused::Tagged);
    }
    if rest[0] & !PROCESSED != SOURCE[0] || rest[1..4] != SOURCE[1..] {
        return Err(Refused::MainDevice);
    }
    // ETG.1000.4, table 11: 11 bits of length, a reserved one, and the type, 1 for datagrams.
    let header = u16::from_le_bytes([low, high]);
    if header >> 12 != 1 {
        return Err(Refused::Foreign);
    }
    if HEADERS + usize::from(header & 0x07ff) > frame.len() {
        return Err(Refused::Damaged);
    }
    Ok(())
}

#[cfg(test)]
pub(super) mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A frame of ours as it comes back, with so many bytes of datagrams.
    pub(in crate::link) fn answer(len: u16) -> Vec<u8> {
        let mut frame = vec![0xff; 6];
        frame.extend([0x12, 0x10, 0x10, 0x10, 0x00, 0x20]);
        frame.extend(ETHERCAT);
        frame.extend((0x1000 | len).to_le_bytes());
        frame.resize(frame.len() + usize::from(len), 0x5a);
        frame
    }

    fn seen(frame: &[u8]) -> Seen<'_> {
        Seen {
            frame,
            wire_len: frame.len(),
            status: libc::TP_STATUS_USER,
            packet_type: libc::PACKET_BROADCAST,
        }
    }

    fn judged(change: impl FnOnce(&mut Vec<u8>)) -> Result<(), Refused> {
        let mut frame = answer(44);
        change(&mut frame);
        sift(&seen(&frame))
    }

    #[test]
    fn answers_pass_padded_or_not() {
        assert_eq!(judged(|_| {}), Ok(()));
        assert_eq!(judged(|f| f.truncate(60)), Ok(()));
        assert_eq!(judged(|f| f.resize(MAX_FRAME, 0)), Ok(()), "padding");
        assert_eq!(judged(|f| *f = answer(12)), Ok(()), "a runt");
        assert_eq!(judged(|f| f[10..12].copy_from_slice(&[0x10, 0x10])), Ok(()));
        assert_eq!(judged(|f| f[6] = 0x10), Ok(()), "nothing has processed it");
    }

    #[test]
    fn others_do_not() {
        use Refused::{Damaged, Foreign, MainDevice};
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
        let cut = Seen {
            wire_len: 2000,
            ..seen(&frame)
        };
        assert_eq!(sift(&cut), Err(Damaged));
    }

    #[test]
    fn tags_that_the_kernel_took_out_show() {
        let frame = answer(44);
        let in_status = Seen {
            status: libc::TP_STATUS_USER | libc::TP_STATUS_VLAN_VALID,
            ..seen(&frame)
        };
        assert_eq!(sift(&in_status), Err(Refused::Tagged));
        let for_another = Seen {
            packet_type: libc::PACKET_OTHERHOST,
            ..seen(&frame)
        };
        assert_eq!(sift(&for_another), Err(Refused::Tagged));
        let sent = Seen {
            packet_type: libc::PACKET_OUTGOING,
            ..seen(&frame)
        };
        assert_eq!(sift(&sent), Err(Refused::Outgoing));
    }

    proptest! {
        #[test]
        fn what_passes_is_ours_and_whole(
            mut frame in prop::collection::vec(any::<u8>(), 0..1600),
            pieces in any::<[bool; 4]>(), more in 0_usize..3, status: u32, packet_type in 0_u8..8,
        ) {
            // Random bytes alone never come near an answer.
            let ours = answer(0);
            for (piece, at) in pieces.into_iter().zip([0..6, 6..10, 12..14, 15..16]) {
                if piece && frame.len() >= ours.len() {
                    frame[at.clone()].copy_from_slice(&ours[at]);
                }
            }
            let seen = Seen { frame: &frame, wire_len: frame.len() + more, status, packet_type };
            if sift(&seen).is_ok() {
                prop_assert_eq!(more, 0);
                prop_assert_eq!(&frame[..6], &ours[..6]);
                prop_assert_eq!(&frame[7..10], &ours[7..10]);
                prop_assert_eq!(&frame[12..14], &ours[12..14]);
                let len = usize::from(u16::from_le_bytes([frame[14], frame[15]]) & 0x07ff);
                prop_assert!(16 + len <= frame.len() && frame.len() <= MAX_FRAME);
            }
        }
    }
}
