//! Ethernet frames that carry EtherCAT datagrams, processed in place.
//!
//! ```
//! use ecaxis_sim::frame::{Command, FrameBuilder, Kind, kind, next};
//!
//! let frame = FrameBuilder::default()
//!     .datagram(5, 0x1001, 0x0120, &[2, 0])
//!     .logical(12, 0x0001_0000, &[0; 4])
//!     .build();
//! assert_eq!(kind(&frame), Kind::EtherCat);
//! let write = next(&frame, None).unwrap();
//! assert_eq!((write.command, write.adp(&frame)), (Command::Fpwr, 0x1001));
//! let exchange = next(&frame, Some(&write)).unwrap();
//! assert_eq!(exchange.logical(&frame), 0x0001_0000);
//! ```

use std::ops::Range;

/// EtherType of EtherCAT.
pub const ETHERTYPE: u16 = 0x88a4;
/// Bytes of destination, source and EtherType.
const ETHERNET_HEADER: usize = 14;
const ETHERCAT_HEADER: usize = 2;
const DATAGRAM_HEADER: usize = 10;
const WKC: usize = 2;

/// Datagram commands (ETG.1000.4).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// No operation.
    Nop,
    /// Auto increment read.
    Aprd,
    /// Auto increment write.
    Apwr,
    /// Auto increment read write.
    Aprw,
    /// Configured address read.
    Fprd,
    /// Configured address write.
    Fpwr,
    /// Configured address read write.
    Fprw,
    /// Broadcast read.
    Brd,
    /// Broadcast write.
    Bwr,
    /// Broadcast read write.
    Brw,
    /// Logical memory read.
    Lrd,
    /// Logical memory write.
    Lwr,
    /// Logical memory read write.
    Lrw,
    /// Auto increment read multiple write.
    Armw,
    /// Configured address read multiple write.
    Frmw,
    /// A command that SubDevices pass on unprocessed.
    Unknown(u8),
}

impl Command {
    #[must_use]
    pub(crate) fn from_code(code: u8) -> Self {
        match code {
            0 => Self::Nop,
            1 => Self::Aprd,
            2 => Self::Apwr,
            3 => Self::Aprw,
            4 => Self::Fprd,
            5 => Self::Fpwr,
            6 => Self::Fprw,
            7 => Self::Brd,
            8 => Self::Bwr,
            9 => Self::Brw,
            10 => Self::Lrd,
            11 => Self::Lwr,
            12 => Self::Lrw,
            13 => Self::Armw,
            14 => Self::Frmw,
            other => Self::Unknown(other),
        }
    }
}

/// One datagram inside a frame, stored as offsets. The frame remains the only copy of the data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Datagram {
    /// The command.
    pub command: Command,
    /// The offsets of the data in the frame.
    pub data: Range<usize>,
    header: usize,
}

impl Datagram {
    /// Returns the position or station address.
    #[must_use]
    pub fn adp(&self, frame: &[u8]) -> u16 {
        read_u16(frame, self.header + 2).unwrap_or(0)
    }

    /// Sets the position or station address.
    pub fn set_adp(&self, frame: &mut [u8], adp: u16) {
        write_u16(frame, self.header + 2, adp);
    }

    /// Returns the physical address inside the SubDevice.
    #[must_use]
    pub fn ado(&self, frame: &[u8]) -> u16 {
        read_u16(frame, self.header + 4).unwrap_or(0)
    }

    /// Returns the logical address of LRD, LWR and LRW.
    #[must_use]
    pub fn logical(&self, frame: &[u8]) -> u32 {
        u32::from(self.adp(frame)) | u32::from(self.ado(frame)) << 16
    }

    /// Returns the working counter.
    #[must_use]
    pub fn wkc(&self, frame: &[u8]) -> u16 {
        read_u16(frame, self.data.end).unwrap_or(0)
    }

    /// Adds to the working counter, which wraps around.
    pub fn add_wkc(&self, frame: &mut [u8], n: u16) {
        let wkc = self.wkc(frame).wrapping_add(n);
        write_u16(frame, self.data.end, wkc);
    }

    /// ORs `irq` into the ECAT event request, as every SubDevice does.
    pub(crate) fn or_irq(&self, frame: &mut [u8], irq: u16) {
        let old = read_u16(frame, self.header + 8).unwrap_or(0);
        write_u16(frame, self.header + 8, old | irq);
    }

    /// True for commands that address exactly one station address.
    #[must_use]
    pub(crate) fn is_to_station(&self) -> bool {
        matches!(self.command, Command::Fprd | Command::Fpwr | Command::Fprw)
    }

    fn has_next(&self, frame: &[u8]) -> bool {
        read_u16(frame, self.header + 6).is_some_and(|len| len & 0x8000 != 0)
    }
}

fn read_u16(frame: &[u8], at: usize) -> Option<u16> {
    let bytes = frame.get(at..at + 2)?;
    Some(u16::from_le_bytes(bytes.try_into().ok()?))
}

fn write_u16(frame: &mut [u8], at: usize, value: u16) {
    if let Some(bytes) = frame.get_mut(at..at + 2) {
        bytes.copy_from_slice(&value.to_le_bytes());
    }
}

/// Returns the offset of the first datagram and the end of the last one. `None` unless this is a
/// type 1 EtherCAT frame whose datagrams all lie inside the frame.
fn bounds(frame: &[u8]) -> Option<(usize, usize)> {
    if frame.get(12..14)? != ETHERTYPE.to_be_bytes() {
        return None;
    }
    let header = read_u16(frame, ETHERNET_HEADER)?;
    let start = ETHERNET_HEADER + ETHERCAT_HEADER;
    let end = start + usize::from(header & 0x07ff);
    (header >> 12 == 1 && end <= frame.len()).then_some((start, end))
}

fn parse_one(frame: &[u8], at: usize, end: usize) -> Option<Datagram> {
    let len = usize::from(read_u16(frame, at + 6)? & 0x07ff);
    let start = at + DATAGRAM_HEADER;
    let datagram = Datagram {
        command: Command::from_code(*frame.get(at)?),
        data: start..start + len,
        header: at,
    };
    (start + len + WKC <= end).then_some(datagram)
}

/// The classification of a frame by a SubDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A well-formed EtherCAT frame of type 1.
    EtherCat,
    /// A frame with the EtherType of EtherCAT and inconsistent datagrams.
    Malformed,
    /// A frame of another protocol.
    Foreign,
}

/// Classifies a frame that starts with the Ethernet header.
#[must_use]
pub fn kind(frame: &[u8]) -> Kind {
    if frame.get(12..14) != Some(&ETHERTYPE.to_be_bytes()) {
        return Kind::Foreign;
    }
    let Some((mut at, end)) = bounds(frame) else {
        return Kind::Malformed;
    };
    loop {
        let Some(datagram) = parse_one(frame, at, end) else {
            return Kind::Malformed;
        };
        if !datagram.has_next(frame) {
            return Kind::EtherCat;
        }
        at = datagram.data.end + WKC;
    }
}

/// Sets the circulating bit (bit 14 of the length) in every datagram. Returns false if the first
/// datagram already has the bit.
pub(crate) fn circulate(frame: &mut [u8]) -> bool {
    const CIRCULATING: u16 = 0x4000;
    let mut datagram = next(frame, None);
    while let Some(d) = datagram {
        let len = read_u16(frame, d.header + 6).unwrap_or(0);
        if len & CIRCULATING != 0 {
            return false;
        }
        write_u16(frame, d.header + 6, len | CIRCULATING);
        datagram = next(frame, Some(&d));
    }
    true
}

/// Returns the datagram that starts a frame or follows `previous`.
#[must_use]
pub fn next(frame: &[u8], previous: Option<&Datagram>) -> Option<Datagram> {
    let (start, end) = bounds(frame)?;
    match previous {
        None => parse_one(frame, start, end),
        Some(p) if p.has_next(frame) => parse_one(frame, p.data.end + WKC, end),
        Some(_) => None,
    }
}

/// Returns the ns that the frame occupies a 100 Mbit/s wire, with preamble, padding, FCS and gap.
#[must_use]
pub fn wire_time(len: usize) -> u64 {
    (u64::try_from(len).unwrap_or(0).max(60) + 24) * 80
}

/// Builds frames for tests, tools and faults. The simulated devices do not use the builder.
#[derive(Debug, Clone)]
pub struct FrameBuilder {
    frame: Vec<u8>,
    last: Option<usize>,
}

impl Default for FrameBuilder {
    fn default() -> Self {
        Self::from_source([0x10; 6])
    }
}

impl FrameBuilder {
    /// Starts a frame with this source address.
    #[must_use]
    pub fn from_source(source: [u8; 6]) -> Self {
        let mut frame = vec![0xff; 6];
        frame.extend_from_slice(&source);
        frame.extend_from_slice(&ETHERTYPE.to_be_bytes());
        frame.extend_from_slice(&[0, 0x10]);
        Self { frame, last: None }
    }

    /// Appends a datagram with a working counter of 0.
    #[must_use]
    pub fn datagram(mut self, command: u8, adp: u16, ado: u16, data: &[u8]) -> Self {
        if let Some(high) = self.last.and_then(|last| self.frame.get_mut(last + 7)) {
            *high |= 0x80;
        }
        self.last = Some(self.frame.len());
        self.frame.extend_from_slice(&[command, 0]);
        self.frame.extend_from_slice(&adp.to_le_bytes());
        self.frame.extend_from_slice(&ado.to_le_bytes());
        let len = u16::try_from(data.len()).unwrap_or(0x07ff) & 0x07ff;
        self.frame.extend_from_slice(&len.to_le_bytes());
        self.frame.extend_from_slice(&[0, 0]);
        self.frame.extend_from_slice(data);
        self.frame.extend_from_slice(&[0, 0]);
        self
    }

    /// Appends a logical datagram.
    #[must_use]
    pub fn logical(self, command: u8, address: u32, data: &[u8]) -> Self {
        let [a, b, c, d] = address.to_le_bytes();
        self.datagram(
            command,
            u16::from_le_bytes([a, b]),
            u16::from_le_bytes([c, d]),
            data,
        )
    }

    /// Returns the frame without padding and FCS.
    #[must_use]
    pub fn build(mut self) -> Vec<u8> {
        let len = self.frame.len() - ETHERNET_HEADER - ETHERCAT_HEADER;
        let header = u16::try_from(len).unwrap_or(0) & 0x07ff | 0x1000;
        write_u16(&mut self.frame, ETHERNET_HEADER, header);
        self.frame
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn walks_the_datagrams() {
        let frame = FrameBuilder::default()
            .datagram(7, 0, 0x130, &[0, 0])
            .logical(12, 0x0001_0002, &[1, 2, 3])
            .build();
        assert_eq!(kind(&frame), Kind::EtherCat);
        let first = next(&frame, None).unwrap();
        assert_eq!((first.command, first.ado(&frame)), (Command::Brd, 0x130));
        let second = next(&frame, Some(&first)).unwrap();
        assert_eq!(second.logical(&frame), 0x0001_0002);
        assert_eq!(&frame[second.data.clone()], [1, 2, 3]);
        assert_eq!(next(&frame, Some(&second)), None);
    }

    #[test]
    fn a_length_beyond_the_frame_is_malformed() {
        let mut frame = FrameBuilder::default().datagram(7, 0, 0, &[0; 4]).build();
        frame[22] = 200;
        assert_eq!(kind(&frame), Kind::Malformed);
        assert_eq!(kind(&frame[..18]), Kind::Malformed);
        assert_eq!(kind(&frame[..12]), Kind::Foreign);
        assert_eq!(kind(&[]), Kind::Foreign);
    }

    #[test]
    fn a_minimal_frame_takes_84_byte_times() {
        assert_eq!(wire_time(30), 6_720);
    }
}
