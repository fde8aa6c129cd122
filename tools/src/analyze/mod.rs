//! Analysis of a recording: devices, bring-up, mailbox transfers, cycle regularity and axes. It
//! reads recordings of any MainDevice and sends nothing. Memory is bounded for recordings of any
//! length.
//!
//! - `match_frames`: matches answers with requests;
//! - `segment`: the devices and the evaluation of each datagram; `registers`, `eeprom`, `mailbox`,
//!   `objects`: parts of a device;
//! - `cycle`, `clocks`, `axes`: process data, distributed clocks, CiA 402;
//! - `rows`: process data as the samples of a machine;
//! - `context`: machine file and ESI files;
//! - `events`, `values`: events as text;
//! - `report`: the [`Report`]; [`document`](fn@document): the report for readers.

use std::io::Read;

use ecaxis_master::config::Machine;
use ecaxis_master::recording::frame::{Content, Encapsulation, content};
use ecaxis_master::recording::{Packet, Reader};

mod axes;
mod clocks;
mod context;
mod cycle;
mod document;
mod eeprom;
mod events;
mod mailbox;
mod match_frames;
mod objects;
mod registers;
mod report;
mod rows;
mod segment;
mod soe;
mod values;

pub use context::{Context, library};
pub use document::document;
pub use report::{
    AxisReport, ClockReport, ClocksReport, CycleReport, DeviceReport, FileReport, Line, Report,
    SyncManagerReport, TransferReport, WkcRun, called,
};

use match_frames::Pairing;
use rows::Rows;
use segment::RecordedSegment;

/// The maximum number of distinguished VLANs.
const CARRIERS: usize = 16;

/// The packets of a recording by content.
#[derive(Debug, Default)]
struct PacketCounts {
    packets: u64,
    frames: u64,
    /// EtherCAT frames without datagrams.
    other_ethercat: u64,
    /// Packets other than EtherCAT.
    other: u64,
    /// EtherCAT frames with missing datagrams.
    cut: u64,
    /// The time of the first EtherCAT frame in ns since 1970.
    first: Option<u64>,
    last: u64,
    /// Frames with an earlier time than the frame before.
    back: u64,
    interfaces: Vec<u32>,
    carriers: Vec<Encapsulation>,
}

/// Analyzes one file, or its parts in order. Never fails: problems of the files are part of the
/// report. With `interface`, only its packets are used.
pub fn analyze<R: Read>(parts: Vec<Reader<R>>, interface: Option<u32>, known: Context) -> Report {
    analyze_rows(parts, interface, known, None)
}

/// Takes each cycle of a recording of a machine.
pub struct RowSink<'s> {
    pub machine: &'s Machine,
    /// Takes a row of samples with time in ns since 1970, and the number of cycles without an
    /// answer before it.
    pub take: &'s mut dyn FnMut(&[u64], u64),
}

impl std::fmt::Debug for RowSink<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RowSink").finish_non_exhaustive()
    }
}

/// Like [`analyze`]; the values of each cycle go to `sink`, which needs a context with its machine.
pub fn analyze_rows<R: Read>(
    parts: Vec<Reader<R>>,
    interface: Option<u32>,
    known: Context,
    mut sink: Option<RowSink<'_>>,
) -> Report {
    let mut counted = PacketCounts::default();
    let mut pairing = Pairing::default();
    let mut segment = RecordedSegment::new(known);
    segment.rows = sink.as_ref().map(|sink| Rows::new(sink.machine));
    let mut remarks = Vec::new();
    let several = parts.len() > 1;
    for (number, mut reader) in (1..).zip(parts) {
        // Frames may be missing between two parts.
        let next = reader.peek().and_then(|packet| packet.at);
        if next.is_some_and(|at| at > counted.last.saturating_add(match_frames::TIMEOUT_NS)) {
            pairing.end();
            drain(&mut pairing, &mut segment, &mut sink);
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
            drain(&mut pairing, &mut segment, &mut sink);
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
    drain(&mut pairing, &mut segment, &mut sink);
    segment.end();
    take_rows(&mut segment, &mut sink);
    report::report(remarks, &counted, segment)
}

fn drain(pairing: &mut Pairing, segment: &mut RecordedSegment, sink: &mut Option<RowSink<'_>>) {
    while let Some(exchange) = pairing.next() {
        segment.exchange(&exchange);
        take_rows(segment, sink);
    }
}

fn take_rows(segment: &mut RecordedSegment, sink: &mut Option<RowSink<'_>>) {
    if let (Some(rows), Some(sink)) = (&mut segment.rows, sink) {
        for (row, missed) in rows.drain() {
            (sink.take)(&row, missed);
        }
    }
}

impl PacketCounts {
    fn frame(&mut self, packet: Packet) -> Option<ecaxis_master::recording::frame::Frame> {
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
