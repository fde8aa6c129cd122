//! The EtherCAT datagrams of a packet (ETG.1000.4, clause 5): in Ethernet, after VLAN tags, or in
//! UDP.

use std::ops::Range;

use ecaxis_ecat::datagram::{Command, ETHERTYPE, HEADER, Header, WORKING_COUNTER};

use super::{Direction, Packet};

const VLAN: [u16; 3] = [0x8100, 0x88a8, 0x9100];
const IPV4: u16 = 0x0800;
const UDP: u8 = 17;
/// The UDP port of EtherCAT.
const UDP_PORT: u16 = 0x88a4;

const LINK_ETHERNET: u16 = 1;
/// Linux cooked capture, as recorded on interface `any`, and its second version.
const LINK_SLL: u16 = 113;
const LINK_SLL2: u16 = 276;

/// The type of an EtherCAT frame with datagrams.
const DLPDUS: u8 = 1;

/// The encapsulation of an EtherCAT frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Encapsulation {
    Ethernet,
    /// At least one tag; the VLAN ID of the innermost.
    Vlan(u16),
    Udp,
}

/// One datagram; its data are in the frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Datagram {
    pub command: Command,
    pub index: u8,
    /// Low half: position or station address; high half: register. One number for logical commands.
    pub address: u32,
    /// The range of the data in [`Frame::bytes`].
    pub data: Range<usize>,
    pub wkc: u16,
}

impl Datagram {
    /// Returns the position (counted down from 0) or station address.
    #[must_use]
    pub const fn adp(&self) -> u16 {
        (self.address & 0xffff) as u16
    }

    /// Returns the register or memory address in the SubDevice.
    #[must_use]
    pub const fn ado(&self) -> u16 {
        (self.address >> 16) as u16
    }
}

/// An EtherCAT frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    pub number: u64,
    /// The time in ns since 1970.
    pub at: u64,
    pub source: [u8; 6],
    pub direction: Option<Direction>,
    pub interface: u32,
    pub carrier: Encapsulation,
    pub datagrams: Vec<Datagram>,
    /// The packet as recorded.
    pub bytes: Vec<u8>,
    /// True if the datagrams do not match the length of the frame.
    pub cut: bool,
}

impl Frame {
    #[must_use]
    pub fn data(&self, datagram: &Datagram) -> &[u8] {
        self.bytes.get(datagram.data.clone()).unwrap_or_default()
    }
}

/// The content of a packet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Content {
    Frame(Frame),
    /// EtherCAT without datagrams: network variables, mailbox gateway; the type.
    OtherEthercat(u8),
    /// Not EtherCAT.
    Other,
}

/// Reads big-endian, as in all headers before EtherCAT.
fn be16(bytes: &[u8], at: usize) -> Option<u16> {
    let two = bytes.get(at..)?.first_chunk()?;
    Some(u16::from_be_bytes(*two))
}

/// Parses a packet.
#[must_use]
pub fn content(packet: Packet) -> Content {
    match find(&packet.data, packet.link_type) {
        Some(found) => found.read(packet),
        None => Content::Other,
    }
}

/// The start of the EtherCAT payload.
struct EthercatPayload {
    at: usize,
    source: [u8; 6],
    carrier: Encapsulation,
    sent: Option<Direction>,
}

fn find(bytes: &[u8], link_type: u16) -> Option<EthercatPayload> {
    let (mut at, source, sent) = match link_type {
        LINK_ETHERNET => (12, 6, None),
        LINK_SLL => (14, 6, Some(be16(bytes, 0)?)),
        LINK_SLL2 => (0, 12, Some(u16::from(*bytes.get(10)?))),
        _ => return None,
    };
    let source = *bytes.get(source..)?.first_chunk::<6>()?;
    // 4: sent by the recording computer.
    let sent = sent.map(|kind| {
        if kind == 4 {
            Direction::Out
        } else {
            Direction::In
        }
    });
    let mut kind = be16(bytes, at)?;
    // In the second version the protocol comes first; its header precedes the rest.
    at = if link_type == LINK_SLL2 { 20 } else { at + 2 };
    let mut carrier = Encapsulation::Ethernet;
    while VLAN.contains(&kind) {
        carrier = Encapsulation::Vlan(be16(bytes, at)? & 0x0fff);
        kind = be16(bytes, at + 2)?;
        at += 4;
    }
    if kind == IPV4 {
        at = udp(bytes, at)?;
        carrier = Encapsulation::Udp;
    } else if kind != ETHERTYPE {
        return None;
    }
    Some(EthercatPayload {
        at,
        source,
        carrier,
        sent,
    })
}

/// Returns the payload offset of a UDP packet to or from EtherCAT's port.
fn udp(bytes: &[u8], at: usize) -> Option<usize> {
    let first = *bytes.get(at)?;
    let head = usize::from(first & 0x0f) * 4;
    // Later fragments have no UDP header.
    let fragment = be16(bytes, at + 6)? & 0x1fff;
    if first >> 4 != 4 || head < 20 || fragment != 0 || *bytes.get(at + 9)? != UDP {
        return None;
    }
    let udp = at + head;
    let ours = be16(bytes, udp + 2)? == UDP_PORT || be16(bytes, udp)? == UDP_PORT;
    ours.then_some(udp + 8)
}

impl EthercatPayload {
    fn read(self, packet: Packet) -> Content {
        let bytes = packet.data;
        let Some(head) = bytes.get(self.at..).and_then(<[u8]>::first_chunk::<2>) else {
            return Content::Other;
        };
        let head = u16::from_le_bytes(*head);
        let kind = (head >> 12) as u8;
        if kind != DLPDUS {
            return Content::OtherEthercat(kind);
        }
        let start = self.at + 2;
        let end = start + usize::from(head & 0x07ff);
        let (datagrams, cut) = datagrams(&bytes, start, end.min(bytes.len()));
        Content::Frame(Frame {
            number: packet.number,
            at: packet.at.unwrap_or(0),
            source: self.source,
            direction: packet.direction.or(self.sent),
            interface: packet.interface,
            carrier: self.carrier,
            datagrams,
            cut: cut || end > bytes.len(),
            bytes,
        })
    }
}

/// Returns the complete datagrams, and true if data are missing.
fn datagrams(bytes: &[u8], start: usize, end: usize) -> (Vec<Datagram>, bool) {
    let mut found = Vec::new();
    let mut at = start;
    loop {
        let head = bytes.get(at..end).and_then(<[u8]>::first_chunk::<HEADER>);
        let Some(head) = head.map(Header::parse) else {
            return (found, true);
        };
        let data = at + HEADER..at + HEADER + usize::from(head.len);
        let wkc = bytes.get(data.end..end).and_then(<[u8]>::first_chunk);
        let Some(wkc) = wkc else {
            return (found, true);
        };
        at = data.end + WORKING_COUNTER;
        found.push(Datagram {
            command: head.command,
            index: head.index,
            address: head.address,
            data,
            wkc: u16::from_le_bytes(*wkc),
        });
        if !head.more {
            return (found, false);
        }
    }
}
