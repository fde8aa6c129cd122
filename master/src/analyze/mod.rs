//! What a recording tells: who is on the bus, how it came up, what was said in mailboxes, how regular the cycle is, and what the
//! axes did. Reads recordings of any MainDevice; sends nothing. Everything that is kept is bounded, however long a recording is.
//!
//! - `pair`: which answer belongs to which request;
//! - `segment`: the devices, and what each datagram says of them; `registers`, `eeprom`, `mailbox`, `objects`: parts of a device;
//! - `cycle`, `clocks`, `axes`: process data, distributed clocks, CiA 402;
//! - `known`: machine file and ESI files, for what a recording does not carry;
//! - `events`, `values`: what happened, in words;
//! - `report`: [`Report`], from all of it; `html`, `plot`: as a page with pictures.

use std::io::Read;

use crate::recording::frame::{Carrier, Content, content};
use crate::recording::{Packet, Reader};

mod axes;
mod clocks;
mod cycle;
mod eeprom;
mod events;
mod html;
mod known;
mod mailbox;
mod objects;
mod pair;
mod plot;
mod registers;
mod report;
mod segment;
mod values;

pub use html::html;
pub use known::{Known, library};
pub use report::{
    AxisReport, ClockReport, ClocksReport, CycleReport, DeviceReport, FileReport, Line, Report,
    SyncManagerReport, TransferReport, WkcRun, called, highest,
};

pub use crate::page::time;

use pair::Pairing;
use segment::Segment;

/// VLANs of a recording that are told apart.
const CARRIERS: usize = 16;

/// Packets of a recording by what they are.
#[derive(Debug, Default)]
struct Counted {
    packets: u64,
    frames: u64,
    /// EtherCAT that carries no datagrams.
    other_ethercat: u64,
    /// Not EtherCAT.
    other: u64,
    /// EtherCAT frames of which datagrams are missing.
    cut: u64,
    /// Of EtherCAT frames, nanoseconds since 1970.
    first: Option<u64>,
    last: u64,
    /// A frame's time lies before that of the one in front of it.
    back: u64,
    interfaces: Vec<u32>,
    carriers: Vec<Carrier>,
}

/// Reads a recording to its end: one file, or its parts in their order. Never fails: what is wrong with them is among the
/// report's remarks. With `interface` only the packets of that one count.
pub fn analyze<R: Read>(parts: Vec<Reader<R>>, interface: Option<u32>, known: Known) -> Report {
    let mut counted = Counted::default();
    let mut pairing = Pairing::default();
    let mut segment = Segment::new(known);
    let mut remarks = Vec::new();
    let several = parts.len() > 1;
    for (number, mut reader) in (1..).zip(parts) {
        // Something may lie between this part and the one before.
        let next = reader.peek().and_then(|packet| packet.at);
        if next.is_some_and(|at| at > counted.last.saturating_add(pair::PATIENCE_NS)) {
            pairing.end();
            drain(&mut pairing, &mut segment);
            segment.cycle.pause();
        }
        while let Some(packet) = reader.next() {
            counted.packets += 1;
            if interface.is_some_and(|wanted| wanted != packet.interface) {
                continue;
            }
            if let Some(frame) = counted.frame(packet) {
                pairing.push(frame);
            }
            drain(&mut pairing, &mut segment);
        }
        let which = if several {
            format!("file {number}: ")
        } else {
            String::new()
        };
        remarks.extend(
            reader
                .remarks()
                .iter()
                .map(|remark| format!("{which}{remark}")),
        );
        if reader.more_remarks() > 0 {
            remarks.push(format!(
                "{which}{} further places are damaged",
                reader.more_remarks()
            ));
        }
    }
    pairing.end();
    drain(&mut pairing, &mut segment);
    segment.end();
    report::report(remarks, &counted, segment)
}

fn drain(pairing: &mut Pairing, segment: &mut Segment) {
    while let Some(exchange) = pairing.next() {
        segment.exchange(&exchange);
    }
}

impl Counted {
    fn frame(&mut self, packet: Packet) -> Option<crate::recording::frame::Frame> {
        match content(packet) {
            Content::Frame(frame) => {
                self.frames += 1;
                self.cut += u64::from(frame.cut);
                self.first = Some(self.first.map_or(frame.at, |first| first.min(frame.at)));
                self.back += u64::from(frame.at < self.last);
                self.last = self.last.max(frame.at);
                if !self.interfaces.contains(&frame.interface) && self.interfaces.len() < CARRIERS {
                    self.interfaces.push(frame.interface);
                }
                if !self.carriers.contains(&frame.carrier) && self.carriers.len() < CARRIERS {
                    self.carriers.push(frame.carrier);
                }
                Some(frame)
            }
            Content::OtherEthercat(_) => {
                self.other_ethercat += 1;
                None
            }
            Content::Other => {
                self.other += 1;
                None
            }
        }
    }
}
