//! A capture as pairs of request and answer.

use std::collections::HashMap;

use pcap_file::pcapng::blocks::interface_description::InterfaceDescriptionOption;
use pcap_file::pcapng::{Block, PcapNgReader};

/// One datagram of a frame, with every header field as on the wire.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Datagram {
    pub command: u8,
    pub index: u8,
    pub adp: u16,
    pub ado: u16,
    /// Length, circulating and more-follows bits.
    pub len: u16,
    pub irq: u16,
    pub data: Vec<u8>,
    pub wkc: u16,
}

pub const FPRD: u8 = 4;
pub const FPWR: u8 = 5;

impl Datagram {
    /// True if two requests are equal except for their index.
    pub fn same_request(&self, other: &Self) -> bool {
        let key = |d: &Self| (d.command, d.adp, d.ado, d.len);
        key(self) == key(other)
    }
}

pub fn datagrams(frame: &[u8]) -> Vec<Datagram> {
    let mut found = Vec::new();
    let mut rest = frame.get(16..).unwrap_or_default();
    while let Some((head, after)) = rest.split_at_checked(10) {
        let word = |at: usize| u16::from_le_bytes([head[at], head[at + 1]]);
        let len = word(6);
        let Some((data, after)) = after.split_at_checked(usize::from(len & 0x07ff)) else {
            break;
        };
        let Some((wkc, after)) = after.split_at_checked(2) else {
            break;
        };
        found.push(Datagram {
            command: head[0],
            index: head[1],
            adp: word(2),
            ado: word(4),
            len,
            irq: word(8),
            data: data.to_vec(),
            wkc: u16::from_le_bytes([wkc[0], wkc[1]]),
        });
        if len & 0x8000 == 0 {
            break;
        }
        rest = after;
    }
    found
}

#[derive(Debug, Clone)]
pub struct Exchange {
    /// The time since the first frame, in ns.
    pub at: u64,
    pub request: Vec<u8>,
    pub answer: Option<Vec<u8>>,
}

#[derive(Debug)]
pub struct Recording {
    pub frames: usize,
    pub exchanges: Vec<Exchange>,
}

impl Recording {
    /// Reads a capture and pairs every request with the first answer that carries the same commands
    /// and indices. SubDevices set a bit in the source address, which distinguishes answers from
    /// requests.
    pub fn read(bytes: &[u8]) -> Self {
        let frames = frames(bytes);
        let mut exchanges: Vec<Exchange> = Vec::new();
        let epoch = frames.first().map_or(0, |(at, _)| *at);
        let key = |frame: &[u8]| -> Vec<_> {
            let datagrams = datagrams(frame);
            let key = datagrams.iter().map(|d| (d.command, d.index, d.len));
            key.collect()
        };
        let count = frames.len();
        for (at, frame) in frames {
            assert_eq!(frame.get(12..14), Some(&[0x88, 0xa4][..]));
            if frame[6] & 0x02 == 0 {
                exchanges.push(Exchange {
                    at: at - epoch,
                    request: frame,
                    answer: None,
                });
                continue;
            }
            let waiting = exchanges
                .iter_mut()
                .find(|x| x.answer.is_none() && key(&x.request) == key(&frame));
            waiting.expect("an answer has its request").answer = Some(frame);
        }
        Self {
            frames: count,
            exchanges,
        }
    }

    /// Returns every answered datagram: send time, request, answer.
    pub fn answered(&self) -> impl Iterator<Item = (u64, Datagram, Datagram)> + '_ {
        self.exchanges.iter().flat_map(|x| {
            let answer = x.answer.as_deref().map(datagrams).unwrap_or_default();
            let pairs = datagrams(&x.request).into_iter().zip(answer);
            pairs.map(|(sent, back)| (x.at, sent, back))
        })
    }
}

/// Returns (nanoseconds, bytes) of every packet.
fn frames(bytes: &[u8]) -> Vec<(u64, Vec<u8>)> {
    let mut reader = PcapNgReader::new(bytes).expect("pcapng");
    let mut units: HashMap<u32, u64> = HashMap::new();
    let mut found = Vec::new();
    while let Some(block) = reader.next_block() {
        match block.expect("a sound block") {
            Block::SectionHeader(_) => units.clear(),
            Block::InterfaceDescription(interface) => {
                let resolution = interface.options.iter().find_map(|option| match option {
                    InterfaceDescriptionOption::IfTsResol(digits) => Some(*digits),
                    _ => None,
                });
                let digits = resolution.unwrap_or(6);
                assert!(digits <= 9, "decimal time stamps of at most nanoseconds");
                let number = u32::try_from(units.len()).unwrap();
                units.insert(number, 10_u64.pow(9 - u32::from(digits)));
            }
            Block::EnhancedPacket(packet) => {
                // The reader interprets every count as nanoseconds.
                let count = u64::try_from(packet.timestamp.as_nanos()).unwrap();
                found.push((count * units[&packet.interface_id], packet.data.to_vec()));
            }
            _ => {}
        }
    }
    found
}
