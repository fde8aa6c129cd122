//! The frames of a cycle: FRMW of the system time, LRW of the process data, one BRD of AL status
//! and one diagnostic read; built once, refilled every cycle, sent back to back.
//!
//! Ours and ethercrab's frames are told apart by the last byte of the source MAC, because
//! ethercrab uses all 256 datagram indices. The byte before it numbers the frames of a cycle, and
//! the datagram index numbers the cycle, so that late and repeated frames are recognised.

use super::image::ImagePlan;
use super::phase::ClockPlan;
use crate::link::port::ETHERCAT;
use crate::link::{Link, LinkError};

const MAC_TAIL: u8 = 0x20;
const ETHERNET_HEADER: usize = 14;
const FIRST_DATAGRAM: usize = 16;
const DATAGRAM_HEADER: usize = 10;
const WKC: usize = 2;

const FPRD: u8 = 4;
const BRD: u8 = 7;
const LRW: u8 = 12;
const FRMW: u8 = 14;

const SYSTEM_TIME: u16 = 0x0910;
const AL_STATUS: u16 = 0x0130;

/// Where a datagram lies in its frame.
#[derive(Debug, Clone, Copy)]
struct Place {
    frame: usize,
    /// Offset of the datagram's header.
    offset: usize,
    len: usize,
}

impl Place {
    fn data(self) -> std::ops::Range<usize> {
        let start = self.offset + DATAGRAM_HEADER;
        start..start + self.len
    }

    fn end(self) -> usize {
        self.offset + DATAGRAM_HEADER + self.len + WKC
    }

    fn wkc(self, frame: &[u8]) -> u16 {
        let at = self.offset + DATAGRAM_HEADER + self.len;
        match frame.get(at..at + WKC) {
            Some(&[low, high]) => u16::from_le_bytes([low, high]),
            _ => 0,
        }
    }
}

#[derive(Debug)]
struct Frame {
    /// As it will be sent.
    bytes: Vec<u8>,
    answered: bool,
}

#[derive(Debug, Clone, Copy)]
struct Lrw {
    place: Place,
    /// Offset in the image.
    image: usize,
    expected_wkc: u16,
    /// Working counter of this cycle's answer.
    wkc: Option<u16>,
}

/// What the diagnostic slot reads in turn of every SubDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Probe {
    /// AL status and AL status code, 0x0130–0x0135.
    AlStatus,
    /// System time difference, 0x092C.
    ClockDifference,
    /// Rx error counters of the four ports, 0x0300–0x0307.
    RxErrors,
}

impl Probe {
    const ALL: [Self; 3] = [Self::AlStatus, Self::ClockDifference, Self::RxErrors];

    fn register_and_len(self) -> (u16, usize) {
        match self {
            Self::AlStatus => (0x0130, 6),
            Self::ClockDifference => (0x092c, 4),
            Self::RxErrors => (0x0300, 8),
        }
    }
}

/// The last that the diagnostic slot has read of one SubDevice.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Diagnosis {
    pub al_status: u8,
    pub al_code: u16,
    /// Own clock minus reference, nanoseconds.
    pub clock_difference: i32,
    /// Invalid frames and physical errors per port, as the registers hold them.
    pub rx_errors: [u8; 8],
}

/// What a received frame turned out to be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Received {
    /// One of this cycle's frames.
    Current,
    /// One of ours, but of another cycle or a second time.
    Late,
    /// Not ours.
    Foreign,
}

/// The result of a cycle's exchange.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Answer {
    /// Every frame came back.
    pub complete: bool,
    /// Every working counter was as expected; the input image is this cycle's.
    pub inputs_fresh: bool,
    /// Sum of the working counters seen, of those expected.
    pub wkc: (u16, u16),
    /// System time of the reference clock as the frame passed it.
    pub system_time: Option<u64>,
    /// AL status of all SubDevices or-ed together, and how many answered.
    pub al_status: Option<(u8, u16)>,
}

/// The exchange of process data.
#[derive(Debug)]
pub struct Exchange {
    frames: Vec<Frame>,
    clock: Option<Place>,
    /// Working counter of the FRMW if every clock is there.
    clock_wkc: u16,
    /// What a clock is set to if the reference before it does not answer: its own time, nearly.
    expected_time: u64,
    cycle_ns: u64,
    lrws: Vec<Lrw>,
    al_status: Place,
    probe_at: usize,
    stations: Vec<u16>,
    diagnoses: Vec<Diagnosis>,
    /// Which device and probe the staged diagnostic datagram reads.
    probe: (usize, usize),
    cycle: u8,
    outputs: Vec<u8>,
    inputs: Vec<u8>,
    system_time: Option<u64>,
    al: Option<(u8, u16)>,
}

impl Exchange {
    /// Builds the frames. `stations` in the order in which devices are reported.
    #[must_use]
    #[allow(
        clippy::disallowed_methods,
        clippy::disallowed_macros,
        reason = "prepares"
    )]
    pub fn new(plan: &ImagePlan, clock: Option<&ClockPlan>, stations: &[u16]) -> Self {
        let mut frames = vec![new_frame(0)];
        let place = clock.map(|clock| {
            push(
                &mut frames[0],
                0,
                FRMW,
                u32::from(SYSTEM_TIME) << 16 | u32::from(clock.reference),
                8,
            )
        });
        let mut lrws: Vec<Lrw> = Vec::with_capacity(plan.datagrams.len());
        for (i, datagram) in plan.datagrams.iter().enumerate() {
            if i > 0 {
                frames.push(new_frame(u8::try_from(i).unwrap_or(u8::MAX)));
            }
            lrws.push(Lrw {
                place: push(&mut frames[i], i, LRW, datagram.logical, datagram.len),
                image: datagram.offset,
                expected_wkc: datagram.expected_wkc,
                wkc: None,
            });
        }
        let al_status = push(&mut frames[0], 0, BRD, u32::from(AL_STATUS) << 16, 2);
        let probe_at = frames[0].bytes.len();
        let mut exchange = Self {
            frames,
            clock: place,
            clock_wkc: clock.map_or(0, |clock| clock.clocks),
            expected_time: 0,
            cycle_ns: clock.map_or(0, |clock| clock.cycle_ns),
            lrws,
            al_status,
            probe_at,
            stations: stations.to_vec(),
            diagnoses: vec![Diagnosis::default(); stations.len()],
            probe: (0, 0),
            cycle: 0,
            outputs: vec![0; plan.len],
            inputs: vec![0; plan.len],
            system_time: None,
            al: None,
        };
        // Room for the longest probe, so that staging never grows the buffer.
        exchange.frames[0]
            .bytes
            .reserve_exact(DATAGRAM_HEADER + 8 + WKC);
        exchange.stage();
        exchange
    }

    /// Outputs of the next cycle.
    pub fn outputs_mut(&mut self) -> &mut [u8] {
        &mut self.outputs
    }

    /// Inputs of the last cycle whose working counters were right.
    #[must_use]
    pub fn inputs(&self) -> &[u8] {
        &self.inputs
    }

    /// What the diagnostic slot has found, in the order of `stations`.
    #[must_use]
    pub fn diagnoses(&self) -> &[Diagnosis] {
        &self.diagnoses
    }

    /// Fills the frames of the next cycle. RT: O(image).
    pub fn stage(&mut self) {
        self.cycle = self.cycle.wrapping_add(1);
        for lrw in &mut self.lrws {
            lrw.wkc = None;
            let frame = &mut self.frames[lrw.place.frame].bytes;
            let data = &mut frame[lrw.place.data()];
            data.copy_from_slice(&self.outputs[lrw.image..lrw.image + lrw.place.len]);
            clear_wkc(frame, lrw.place);
        }
        self.stage_probe();
        self.expected_time = self
            .system_time
            .unwrap_or(self.expected_time)
            .wrapping_add(self.cycle_ns);
        let first = &mut self.frames[0].bytes;
        if let Some(place) = self.clock {
            first[place.data()].copy_from_slice(&self.expected_time.to_le_bytes());
            clear_wkc(first, place);
        }
        first[self.al_status.data()].fill(0);
        clear_wkc(first, self.al_status);
        self.system_time = None;
        self.al = None;
        for frame in &mut self.frames {
            frame.answered = false;
            number(&mut frame.bytes, self.cycle);
        }
    }

    /// The diagnostic datagram is the last of the first frame, so its length may change.
    fn stage_probe(&mut self) {
        let Some(&station) = self.stations.get(self.probe.0) else {
            return;
        };
        let (register, len) = Probe::ALL[self.probe.1].register_and_len();
        let frame = &mut self.frames[0].bytes;
        frame.truncate(self.probe_at);
        // Within the capacity that `new` has reserved.
        frame.resize(self.probe_at + DATAGRAM_HEADER + len + WKC, 0);
        let address = u32::from(register) << 16 | u32::from(station);
        write_header(frame, self.probe_at, FPRD, address, len);
    }

    /// Sends all frames of the cycle back to back. RT: blocks on the wire only.
    pub fn send(&self, link: &mut dyn Link) -> Result<(), LinkError> {
        for frame in &self.frames {
            link.send(&frame.bytes)?;
        }
        Ok(())
    }

    /// Takes an answer in. RT: O(frame).
    pub fn receive(&mut self, frame: &[u8]) -> Received {
        if frame.get(12..14) != Some(&ETHERCAT[..]) || frame.get(11) != Some(&MAC_TAIL) {
            return Received::Foreign;
        }
        let number = frame.get(10).map_or(usize::MAX, |n| usize::from(*n));
        let Some(sent) = self.frames.get_mut(number) else {
            return Received::Foreign;
        };
        if sent.answered
            || frame.get(FIRST_DATAGRAM + 1) != Some(&self.cycle)
            || !same_headers(&sent.bytes, frame)
        {
            return Received::Late;
        }
        sent.answered = true;
        for lrw in self.lrws.iter_mut().filter(|lrw| lrw.place.frame == number) {
            let wkc = lrw.place.wkc(frame);
            lrw.wkc = Some(wkc);
            if wkc == lrw.expected_wkc
                && let Some(data) = frame.get(lrw.place.data())
            {
                self.inputs[lrw.image..lrw.image + data.len()].copy_from_slice(data);
            }
        }
        if number == 0 {
            let clock = self.clock.filter(|p| p.wkc(frame) == self.clock_wkc);
            self.system_time = clock.and_then(|place| {
                Some(u64::from_le_bytes(
                    frame.get(place.data())?.try_into().ok()?,
                ))
            });
            self.al = frame
                .get(self.al_status.data())
                .and_then(|data| Some((*data.first()?, self.al_status.wkc(frame))));
            self.take_probe(frame);
        }
        Received::Current
    }

    fn take_probe(&mut self, frame: &[u8]) {
        let (device, probe) = self.probe;
        if device >= self.stations.len() {
            return;
        }
        let len = Probe::ALL[probe].register_and_len().1;
        let place = Place {
            frame: 0,
            offset: self.probe_at,
            len,
        };
        if let (1, Some(data), Some(to)) = (
            place.wkc(frame),
            frame.get(place.data()),
            self.diagnoses.get_mut(device),
        ) {
            match (Probe::ALL[probe], data) {
                (Probe::AlStatus, &[status, _, _, _, low, high]) => {
                    to.al_status = status;
                    to.al_code = u16::from_le_bytes([low, high]);
                }
                (Probe::ClockDifference, &[a, b, c, d]) => {
                    to.clock_difference = sign_magnitude(u32::from_le_bytes([a, b, c, d]));
                }
                (Probe::RxErrors, errors) => {
                    if let Ok(errors) = errors.try_into() {
                        to.rx_errors = errors;
                    }
                }
                _ => {}
            }
        }
        let next = device + 1;
        self.probe = if next < self.stations.len() {
            (next, probe)
        } else {
            (0, (probe + 1) % Probe::ALL.len())
        };
    }

    /// Whether every frame of the cycle has come back.
    #[must_use]
    pub fn complete(&self) -> bool {
        self.frames.iter().all(|frame| frame.answered)
    }

    /// Sums the cycle up. RT.
    #[must_use]
    pub fn answer(&self) -> Answer {
        let complete = self.complete();
        let seen = self
            .lrws
            .iter()
            .filter_map(|lrw| lrw.wkc)
            .fold(0, u16::saturating_add);
        let expected = self.lrws.iter().map(|lrw| lrw.expected_wkc).sum();
        Answer {
            complete,
            inputs_fresh: self
                .lrws
                .iter()
                .all(|lrw| lrw.wkc == Some(lrw.expected_wkc)),
            wkc: (seen, expected),
            system_time: self.system_time,
            al_status: self.al,
        }
    }

    /// Bytes of each frame as staged, without FCS.
    pub fn frame_lengths(&self) -> impl Iterator<Item = usize> + '_ {
        self.frames.iter().map(|frame| frame.bytes.len())
    }
}

/// 0x092C, received − own time: bit 31 is the sign (own clock ahead), the rest the amount.
fn sign_magnitude(raw: u32) -> i32 {
    let amount = i32::try_from(raw & 0x7fff_ffff).unwrap_or(i32::MAX);
    if raw & 0x8000_0000 == 0 {
        amount
    } else {
        -amount
    }
}

#[allow(clippy::disallowed_methods, reason = "prepares")]
fn new_frame(number: u8) -> Frame {
    let mut bytes = Vec::with_capacity(crate::link::MAX_FRAME);
    bytes.extend_from_slice(&[0xff; 6]);
    bytes.extend_from_slice(&[0x10, 0x10, 0x10, 0x10, number, MAC_TAIL]);
    bytes.extend_from_slice(&ETHERCAT);
    bytes.extend_from_slice(&[0, 0]);
    Frame {
        bytes,
        answered: false,
    }
}

/// Appends a datagram with room for `len` bytes.
fn push(frame: &mut Frame, number: usize, command: u8, address: u32, len: usize) -> Place {
    let place = Place {
        frame: number,
        offset: frame.bytes.len(),
        len,
    };
    frame.bytes.resize(place.end(), 0);
    write_header(&mut frame.bytes, place.offset, command, address, len);
    place
}

fn write_header(frame: &mut [u8], offset: usize, command: u8, address: u32, len: usize) {
    let [a0, a1, a2, a3] = address.to_le_bytes();
    let [l0, l1] = u16::try_from(len).unwrap_or(0).to_le_bytes();
    if let Some(header) = frame.get_mut(offset..offset + DATAGRAM_HEADER) {
        header.copy_from_slice(&[command, 0, a0, a1, a2, a3, l0, l1, 0, 0]);
    }
}

fn clear_wkc(frame: &mut [u8], place: Place) {
    if let Some(wkc) = frame.get_mut(place.data().end..place.end()) {
        wkc.fill(0);
    }
}

/// Writes the EtherCAT header, the cycle's index and the "more follows" flags of all datagrams.
fn number(frame: &mut [u8], cycle: u8) {
    let [low, high] = u16::try_from(frame.len() - FIRST_DATAGRAM)
        .unwrap_or(0)
        .to_le_bytes();
    frame[ETHERNET_HEADER] = low;
    frame[ETHERNET_HEADER + 1] = high & 0x07 | 0x10;
    let mut at = FIRST_DATAGRAM;
    while at + DATAGRAM_HEADER <= frame.len() {
        frame[at + 1] = cycle;
        let len = usize::from(u16::from_le_bytes([frame[at + 6], frame[at + 7] & 0x07]));
        let next = at + DATAGRAM_HEADER + len + WKC;
        frame[at + 7] = frame[at + 7] & 0x07 | if next < frame.len() { 0x80 } else { 0 };
        at = next;
    }
}

/// Whether an answer has our datagrams in our places. SubDevices change addresses (APRD, BRD),
/// data, working counters and the circulating bit, nothing else.
fn same_headers(sent: &[u8], answer: &[u8]) -> bool {
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

#[cfg(test)]
#[path = "exchange_tests.rs"]
mod tests;
