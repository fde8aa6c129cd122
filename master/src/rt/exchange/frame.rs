//! The bytes of the cycle's frames: Ethernet header, then the datagrams.

use ecaxis_ecat::datagram::{Command, Header};
pub(super) use ecaxis_ecat::datagram::{HEADER as DATAGRAM_HEADER, WORKING_COUNTER as WKC};

use crate::link::pdu_loop::ETHERCAT;

pub(super) const MAC_TAIL: u8 = 0x20;
const ETHERNET_HEADER: usize = 14;
pub(super) const FIRST_DATAGRAM: usize = 16;

/// The position of a datagram in its frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct DatagramSlot {
    pub frame: usize,
    /// Offset of the datagram's header.
    pub offset: usize,
    pub len: usize,
}

impl DatagramSlot {
    pub fn data(self) -> std::ops::Range<usize> {
        let start = self.offset + DATAGRAM_HEADER;
        start..start + self.len
    }

    fn end(self) -> usize {
        self.offset + DATAGRAM_HEADER + self.len + WKC
    }

    pub fn wkc(self, frame: &[u8]) -> u16 {
        let at = self.offset + DATAGRAM_HEADER + self.len;
        match frame.get(at..at + WKC) {
            Some(&[low, high]) => u16::from_le_bytes([low, high]),
            _ => 0,
        }
    }
}

#[derive(Debug)]
pub(super) struct Frame {
    /// The frame as it will be sent.
    pub bytes: Vec<u8>,
    /// The frame as it came back, if `answered`. It is as long as the sent frame.
    pub answer: Box<[u8]>,
    pub answered: bool,
}

#[allow(
    clippy::disallowed_methods,
    clippy::disallowed_macros,
    reason = "runs before the loop"
)]
pub(super) fn new_frames(count: usize) -> Vec<Frame> {
    (0..count).map(|_| new_frame()).collect()
}

#[allow(
    clippy::disallowed_methods,
    clippy::disallowed_macros,
    reason = "runs before the loop"
)]
fn new_frame() -> Frame {
    let mut bytes = Vec::with_capacity(crate::link::MAX_FRAME);
    bytes.extend_from_slice(&[0xff; 6]);
    bytes.extend_from_slice(&[0x10, 0x10, 0x10, 0x10, 0, MAC_TAIL]);
    bytes.extend_from_slice(&ETHERCAT);
    bytes.extend_from_slice(&[0, 0]);
    Frame {
        bytes,
        answer: vec![0; crate::link::MAX_FRAME].into_boxed_slice(),
        answered: false,
    }
}

/// Appends a datagram with room for `len` bytes.
pub(super) fn push(
    frame: &mut Frame,
    number: usize,
    command: Command,
    address: u32,
    len: usize,
) -> DatagramSlot {
    let slot = DatagramSlot {
        frame: number,
        offset: frame.bytes.len(),
        len,
    };
    frame.bytes.resize(slot.end(), 0);
    write_header(&mut frame.bytes, slot.offset, command, address, len);
    slot
}

pub(super) fn write_header(
    frame: &mut [u8],
    offset: usize,
    command: Command,
    address: u32,
    len: usize,
) {
    let header = Header {
        command,
        index: 0,
        address,
        len: u16::try_from(len).unwrap_or(0),
        more: false,
    };
    if let Some(slot) = frame.get_mut(offset..offset + DATAGRAM_HEADER) {
        slot.copy_from_slice(&header.emit());
    }
}

/// Changes the station of a datagram.
pub(super) fn write_station(frame: &mut [u8], slot: DatagramSlot, station: u16) {
    if let Some(place) = frame.get_mut(slot.offset + 2..slot.offset + 4) {
        place.copy_from_slice(&station.to_le_bytes());
    }
}

pub(super) fn clear_wkc(frame: &mut [u8], slot: DatagramSlot) {
    if let Some(wkc) = frame.get_mut(slot.data().end..slot.end()) {
        wkc.fill(0);
    }
}

/// Returns the number of tag bits that hold the frame number of `count` frames.
fn number_bits(count: usize) -> u32 {
    count.next_power_of_two().trailing_zeros().min(8)
}

/// Returns the byte of the source address that distinguishes the frames of a cycle. It holds the
/// frame number. Above it are the bits of the cycle number that follow the lowest eight.
pub(super) fn frame_tag(number: usize, count: usize, cycle: u32) -> u8 {
    let bits = number_bits(count);
    (number as u32 | (cycle >> 8) << bits) as u8
}

/// Returns the frame number in a tag.
pub(super) fn frame_number(tag: u8, count: usize) -> usize {
    usize::from(tag) & ((1 << number_bits(count)) - 1)
}

/// Writes the tag, the EtherCAT header, the cycle's index and the "more follows" flags of all
/// datagrams.
pub(super) fn number(frame: &mut [u8], tag: u8, cycle: u32) {
    frame[10] = tag;
    let [low, high] = u16::try_from(frame.len() - FIRST_DATAGRAM)
        .unwrap_or(0)
        .to_le_bytes();
    frame[ETHERNET_HEADER] = low;
    frame[ETHERNET_HEADER + 1] = high & 0x07 | 0x10;
    let mut at = FIRST_DATAGRAM;
    while at + DATAGRAM_HEADER <= frame.len() {
        frame[at + 1] = cycle as u8;
        let len = usize::from(u16::from_le_bytes([frame[at + 6], frame[at + 7] & 0x07]));
        let next = at + DATAGRAM_HEADER + len + WKC;
        frame[at + 7] = frame[at + 7] & 0x07 | if next < frame.len() { 0x80 } else { 0 };
        at = next;
    }
}

/// True if an answer contains the datagram that was sent in this position, regardless of the cycle.
pub(super) fn same_datagram(sent: &[u8], answer: &[u8], slot: DatagramSlot) -> bool {
    let header = |frame: &[u8]| {
        let header = frame.get(slot.offset..slot.offset + 8)?;
        let mut header: [u8; 8] = header.try_into().ok()?;
        (header[1], header[7]) = (0, header[7] & 0x07);
        Some(header)
    };
    answer.len() >= slot.end() && header(sent).is_some() && header(sent) == header(answer)
}

/// True if an answer contains all sent datagrams in their positions. SubDevices change only
/// addresses (APRD, BRD), data, working counters and the circulating bit.
pub(super) fn same_headers(sent: &[u8], answer: &[u8]) -> bool {
    if answer.len() < sent.len() {
        return false;
    }
    let mut at = FIRST_DATAGRAM;
    while at + DATAGRAM_HEADER <= sent.len() {
        let same = sent[at..at + 2] == answer[at..at + 2]
            && sent[at + 6] == answer[at + 6]
            && (sent[at + 7] ^ answer[at + 7]) & 0x87 == 0;
        if !same {
            return false;
        }
        let len = usize::from(u16::from_le_bytes([sent[at + 6], sent[at + 7] & 0x07]));
        at += DATAGRAM_HEADER + len + WKC;
    }
    true
}
