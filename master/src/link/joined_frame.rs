//! Joins frames with one datagram each into one Ethernet frame, and takes the answer apart again.

use ecaxis_ecat::datagram::{Command, HEADER, Header, WORKING_COUNTER};
use ecaxis_ecat::registers;

use super::{Link, LinkError, MAX_FRAME};

/// The bytes in front of the first datagram: Ethernet header and EtherCAT header.
pub(super) const FRAME_HEADER: usize = 16;
/// The EtherCAT header: the length of the datagrams in bits 0 to 10, and type 1 in bits 12 to 15.
const LENGTH: u16 = 0x07ff;
const TYPE: u16 = 0x1000;
/// Length and flags in a datagram's header: the high byte, and the flag of another datagram.
const FLAGS: usize = 7;
const MORE: u8 = 0x80;
/// The bit of AL control that acknowledges an error.
const ACKNOWLEDGE: u8 = 0x10;

/// A frame that collects the datagrams of others.
#[derive(Debug)]
pub(super) struct JoinedFrame {
    bytes: Box<[u8; MAX_FRAME]>,
    len: usize,
    /// The start of the last datagram.
    last: usize,
}

impl Default for JoinedFrame {
    fn default() -> Self {
        Self {
            bytes: Box::new([0; MAX_FRAME]),
            len: 0,
            last: 0,
        }
    }
}

impl JoinedFrame {
    /// Appends the only datagram of a frame. Returns false if it does not fit.
    pub fn append(&mut self, frame: &[u8]) -> bool {
        let datagram = frame.get(FRAME_HEADER..).unwrap_or_default();
        let start = self.len.max(FRAME_HEADER);
        let end = start + datagram.len();
        let Some(place) = self.bytes.get_mut(start..end) else {
            return false;
        };
        place.copy_from_slice(datagram);
        clear_broadcast_acknowledgement(place);
        if self.len == 0 {
            self.bytes[..FRAME_HEADER].copy_from_slice(&frame[..FRAME_HEADER]);
        } else {
            self.bytes[self.last + FLAGS] |= MORE;
        }
        (self.last, self.len) = (start, end);
        true
    }

    /// Sends the frame unless it is empty.
    pub fn flush(&mut self, link: &mut dyn Link) -> Result<(), LinkError> {
        let len = std::mem::take(&mut self.len);
        if len == 0 {
            return Ok(());
        }
        let datagrams = u16::try_from(len - FRAME_HEADER).unwrap_or(0) & LENGTH;
        self.bytes[FRAME_HEADER - 2..FRAME_HEADER]
            .copy_from_slice(&(TYPE | datagrams).to_le_bytes());
        link.send(&self.bytes[..len])
    }
}

/// Clears the acknowledge bit of a broadcast to AL control. ethercrab starts its scan with one, but a
/// device that emulates its states must not receive the bit (ETG.1500, feature 103).
/// `acyclic::al::acknowledge_errors_in_init` acknowledges the errors of all other devices before.
fn clear_broadcast_acknowledgement(datagram: &mut [u8]) {
    let Some((header, [control, ..])) = datagram.split_first_chunk_mut::<HEADER>() else {
        return;
    };
    let Header {
        command, address, ..
    } = Header::parse(header);
    if command == Command::BWR && address >> 16 == u32::from(registers::AL_CONTROL) {
        *control &= !ACKNOWLEDGE;
    }
}

/// One datagram in a frame of its own.
#[derive(Debug)]
pub(super) struct SingleFrame {
    bytes: [u8; MAX_FRAME],
    len: usize,
}

impl SingleFrame {
    pub fn frame(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

/// Returns the datagrams of an EtherCAT frame, each in a frame of its own. Ends at the first one that
/// exceeds the frame. RT.
pub(super) fn datagrams(frame: &[u8]) -> impl Iterator<Item = SingleFrame> {
    let mut start = FRAME_HEADER;
    let mut more = true;
    std::iter::from_fn(move || {
        if !std::mem::take(&mut more) {
            return None;
        }
        let header = Header::parse(frame.get(start..)?.first_chunk::<HEADER>()?);
        let len = HEADER + usize::from(header.len) + WORKING_COUNTER;
        let datagram = frame.get(start..start + len)?;
        let mut single = SingleFrame {
            bytes: [0; MAX_FRAME],
            len: FRAME_HEADER + len,
        };
        let (head, data) = single.bytes.split_at_mut(FRAME_HEADER);
        head.copy_from_slice(&frame[..FRAME_HEADER]);
        let length = u16::try_from(len).unwrap_or(0) & LENGTH;
        head[FRAME_HEADER - 2..].copy_from_slice(&(TYPE | length).to_le_bytes());
        data.get_mut(..len)?.copy_from_slice(datagram);
        data[FLAGS] &= !MORE;
        start += len;
        more = header.more;
        Some(single)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::Nanos;

    /// A link that keeps what it sends.
    #[derive(Debug, Default)]
    struct Kept(Vec<Vec<u8>>);

    impl Link for Kept {
        fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
            self.0.push(frame.to_vec());
            Ok(())
        }

        fn recv(&mut self, _: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
            Ok(None)
        }

        fn next_arrival(&self) -> Option<Nanos> {
            None
        }
    }

    /// Returns a frame with one FPRD of `data` bytes.
    fn single(index: u8, data: usize) -> Vec<u8> {
        let len = u8::try_from(data & 0xff).expect("a byte");
        let high = u8::try_from(data >> 8).expect("a byte");
        let total = u16::try_from(data + 12).expect("fits");
        let mut frame = vec![0xff; 12];
        frame.extend([0x88, 0xa4]);
        frame.extend((0x1000 | total).to_le_bytes());
        frame.extend([4, index, 0x00, 0x10, 0x30, 0x01, len, high, 0, 0]);
        frame.extend(vec![index; data]);
        frame.extend([0, 0]);
        frame
    }

    fn join(frames: &[Vec<u8>]) -> Vec<Vec<u8>> {
        let (mut joined, mut link) = (JoinedFrame::default(), Kept::default());
        for frame in frames {
            if !joined.append(frame) {
                joined.flush(&mut link).expect("kept");
                assert!(joined.append(frame));
            }
        }
        joined.flush(&mut link).expect("kept");
        link.0
    }

    /// ETG.1000.4, 5.3: the EtherCAT header holds the length of all datagrams; bit 15 of a datagram's
    /// length is set if another datagram follows.
    #[test]
    fn joined_datagrams_have_one_header_and_come_apart_again() {
        let frames = [single(1, 2), single(2, 6), single(3, 300)];
        let sent = join(&frames);
        let [sent] = &sent[..] else {
            panic!("{} frames", sent.len())
        };
        assert_eq!(sent.len(), 16 + 14 + 18 + 312);
        assert_eq!(sent[14..16], (0x1000_u16 | 344).to_le_bytes());
        let more = [16 + 7, 30 + 7, 48 + 7].map(|at| sent[at] & 0x80 != 0);
        assert_eq!(more, [true, true, false]);
        let apart: Vec<Vec<u8>> = datagrams(sent).map(|d| d.frame().to_vec()).collect();
        assert_eq!(apart, frames);
    }

    /// IEEE 802.3: 1514 bytes without FCS are the longest frame.
    #[test]
    fn joined_frame_never_exceeds_the_longest_frame() {
        let frames: Vec<_> = (0..200).map(|n| single(n, usize::from(n))).collect();
        let sent = join(&frames);
        assert!(sent.iter().all(|frame| frame.len() <= MAX_FRAME));
        let apart: Vec<_> = sent
            .iter()
            .flat_map(|frame| {
                datagrams(frame)
                    .map(|d| d.frame().to_vec())
                    .collect::<Vec<_>>()
            })
            .collect();
        assert_eq!(apart, frames);
        let longest = single(7, 1486);
        assert_eq!(join(&[longest.clone(), single(8, 1)]).len(), 2);
        assert_eq!(longest.len(), MAX_FRAME);
    }

    #[test]
    fn damaged_frames_end_at_the_first_datagram_that_does_not_fit() {
        let frame = &join(&[single(1, 2), single(2, 6)])[0];
        assert_eq!(datagrams(frame).count(), 2);
        for len in 0..frame.len() {
            let count = datagrams(&frame[..len]).count();
            assert_eq!(count, usize::from(len >= 30), "{len} bytes");
        }
    }
}
