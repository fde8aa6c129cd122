//! Reads the frames of a recording, independently of the program.

use std::path::Path;

use pcap_file::pcapng::{Block, PcapNgReader};

pub const APWR: u8 = 2;
pub const FPRD: u8 = 4;
pub const FPWR: u8 = 5;
pub const BWR: u8 = 8;
pub const BRD: u8 = 7;
pub const LRD: u8 = 10;
pub const LWR: u8 = 11;
pub const LRW: u8 = 12;
pub const FRMW: u8 = 14;

#[derive(Debug, Clone)]
pub struct Datagram {
    /// True in a sent frame, false in a received one.
    pub sent: bool,
    pub command: u8,
    /// The logical address, or the register above the station address.
    pub address: u32,
    pub data: Vec<u8>,
    pub working_counter: u16,
}

impl Datagram {
    pub fn station(&self) -> u16 {
        (self.address & 0xffff) as u16
    }

    pub fn register(&self) -> u16 {
        (self.address >> 16) as u16
    }
}

#[derive(Debug, Clone)]
pub struct Frame {
    /// True for a sent frame, false for a received one.
    pub sent: bool,
    /// True for a frame of the cycle, false for acyclic services.
    pub cyclic: bool,
    pub len: usize,
    pub datagrams: Vec<Datagram>,
}

impl Frame {
    /// Parses an Ethernet frame.
    pub fn parse(frame: &[u8]) -> Self {
        let word = |at: usize| u16::from_le_bytes([frame[at], frame[at + 1]]);
        // SubDevices set this bit of the source address.
        let sent = frame[6] & 0x02 == 0;
        let mut datagrams = Vec::new();
        let mut at = 16;
        // Command, index, address, length with "more" in bit 15, interrupt; data; working counter.
        while at + 12 <= frame.len() {
            let length = word(at + 6);
            let end = at + 10 + usize::from(length & 0x7ff);
            datagrams.push(Datagram {
                sent,
                command: frame[at],
                address: u32::from(word(at + 4)) << 16 | u32::from(word(at + 2)),
                data: frame[at + 10..end].to_vec(),
                working_counter: word(end),
            });
            if length & 0x8000 == 0 {
                break;
            }
            at = end + 2;
        }
        Self {
            sent,
            cyclic: frame[11] == 0x20,
            len: frame.len(),
            datagrams,
        }
    }

    /// Returns the data of all LRW datagrams, or `None` without one.
    pub fn image(&self) -> Option<Vec<u8>> {
        let logical = self.datagrams.iter().filter(|d| d.command == LRW);
        let data: Vec<&[u8]> = logical.map(|d| &d.data[..]).collect();
        (!data.is_empty()).then(|| data.concat())
    }
}

/// Returns every frame of a recording.
pub fn frames(recording: &Path) -> Vec<Frame> {
    let bytes = std::fs::read(recording).expect("the recording");
    let mut reader = PcapNgReader::new(bytes.as_slice()).expect("pcapng");
    let mut frames = Vec::new();
    while let Some(block) = reader.next_block() {
        if let Block::EnhancedPacket(packet) = block.expect("a block") {
            frames.push(Frame::parse(&packet.data));
        }
    }
    frames
}

/// Returns the datagrams of every frame of a recording.
pub fn datagrams(recording: &Path) -> Vec<Datagram> {
    let frames = frames(recording).into_iter();
    frames.flat_map(|frame| frame.datagrams).collect()
}

/// Returns the process image of each cycle that came back, as sent and as received.
pub fn process_images(recording: &Path) -> Vec<(Vec<u8>, Vec<u8>)> {
    let mut images = Vec::new();
    let mut sent = None;
    for frame in frames(recording) {
        let Some(image) = frame.image() else { continue };
        if frame.sent {
            sent = Some(image);
        } else if let Some(sent) = sent.take() {
            images.push((sent, image));
        }
    }
    images
}

/// Checks the first axis of a recording, a drive of `configs/esi` in CSP. The axis moved, and no
/// set-point changed by more than `step` counts per cycle. It stood before its Controlword removed
/// the power, and the power was off at the end.
#[track_caller]
pub fn comes_to_rest(recording: &Path, step: i32) {
    const POWERED: u16 = 0x000f;
    let word = |data: &[u8]| u16::from_le_bytes([data[0], data[1]]);
    let place = |data: &[u8]| i32::from_le_bytes([data[2], data[3], data[4], data[5]]);
    let cycles: Vec<_> = process_images(recording)
        .iter()
        .filter(|(sent, back)| sent.len() > 6 && back.len() > 6)
        .map(|(sent, back)| (word(sent), place(sent), place(back)))
        .collect();
    let powered = |cycle: &(u16, i32, i32)| cycle.0 == POWERED;
    let first = cycles.iter().position(powered).expect("it had power");
    let last = cycles.iter().rposition(powered).expect("it had power");
    let moved = cycles[first..=last]
        .windows(2)
        .map(|pair| (pair[1].1 - pair[0].1).abs())
        .max();
    let moved = moved.unwrap_or_default();
    assert!(moved > 1, "it moved: {moved} counts a cycle");
    assert!(moved <= step, "a set-point changed by {moved} counts");
    let end = &cycles[last.saturating_sub(10)..=last];
    let turned = end.iter().map(|cycle| cycle.2);
    let turned = turned.clone().max().unwrap_or(0) - turned.min().unwrap_or(0);
    assert!(
        turned <= 4,
        "it turned by {turned} counts when it lost its power"
    );
    let over = cycles.last().map_or(0, |cycle| cycle.0);
    assert_eq!(over & 0x0008, 0, "the last Controlword is {over:#06x}");
}
