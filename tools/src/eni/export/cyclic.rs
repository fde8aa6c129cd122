//! The cyclic frames and the process image.
//!
//! Offsets count from the first byte of process data, in both images. Behind the process data are
//! the time of the reference clock and the AL status of all devices.

use ecaxis_ecat::registers;
use ecaxis_esi::layout::Field;
use ecaxis_master::rt::image::{self, Access, DatagramPlan};

use super::super::command::{CommandTarget, code, with_target};
use super::super::xml::Element;
use super::device::object_name;
use super::{Network, PlacedDevice};

const TIME_LEN: usize = 8;
const STATUS_LEN: usize = 2;

const ALL_STATES: [&str; 4] = ["INIT", "PREOP", "SAFEOP", "OP"];
const PROCESS_DATA_STATES: [&str; 2] = ["SAFEOP", "OP"];

/// One datagram of a cyclic frame.
struct CyclicCommand<'s> {
    states: &'s [&'s str],
    comment: &'s str,
    command: u8,
    target: CommandTarget,
    len: usize,
    cnt: Option<u16>,
    offset: usize,
}

impl CyclicCommand<'_> {
    fn element(&self) -> Element {
        let mut element = Element::new("Cmd");
        for state in self.states {
            element = element.with("State", state);
        }
        element = element
            .with("Comment", self.comment)
            .with("Cmd", self.command);
        with_target(element, self.target)
            .with("DataLength", self.len)
            .with_some("Cnt", self.cnt)
            .with("InputOffs", self.offset)
            .with("OutputOffs", self.offset)
    }
}

impl Network<'_> {
    fn time_offset(&self) -> usize {
        self.image.len
    }

    fn status_offset(&self) -> usize {
        self.image.len + TIME_LEN
    }

    pub(super) fn cyclic(&self) -> Element {
        let frames = (0..self.image.frames()).map(|number| self.frame(number));
        Element::new("Cyclic")
            .with("CycleTime", self.machine.bus.cycle_ns / 1000)
            .with("Priority", self.machine.bus.priority)
            .with("TaskId", 1)
            .with_children(frames)
    }

    fn frame(&self, number: usize) -> Element {
        let mut frame = Element::new("Frame");
        if let Some(station) = self.reference.filter(|_| number == 0) {
            let distribute = CyclicCommand {
                states: &ALL_STATES,
                comment: "distribute the time of the reference clock",
                command: code::FRMW,
                target: CommandTarget::Physical(station, registers::DC_SYSTEM_TIME),
                len: TIME_LEN,
                cnt: None,
                offset: self.time_offset(),
            };
            frame = frame.child(distribute.element());
        }
        let datagrams = self.image.datagrams.iter();
        let datagrams = datagrams.filter(|datagram| datagram.frame == number);
        frame = frame.with_children(datagrams.flat_map(|datagram| self.datagram(datagram)));
        if number == 0 {
            let status = CyclicCommand {
                states: &ALL_STATES,
                comment: "AL status of all devices",
                command: code::BRD,
                target: CommandTarget::Physical(0, registers::AL_STATUS),
                len: STATUS_LEN,
                cnt: self.device_count(),
                offset: self.status_offset(),
            };
            frame = frame.child(status.element());
        }
        frame
    }

    /// Returns the commands of process data: one for both states, unless SafeOp lacks the data that
    /// is enabled in Op only.
    fn datagram(&self, datagram: &DatagramPlan) -> Vec<Element> {
        let copies = self.copies(datagram);
        let all = datagram.expected_wkc;
        let [safe_op, op] = [all - datagram.op_only_wkc, all];
        let each = match safe_op == op {
            true => vec![(&PROCESS_DATA_STATES[..], op)],
            false => vec![
                (&PROCESS_DATA_STATES[..1], safe_op),
                (&PROCESS_DATA_STATES[1..], op),
            ],
        };
        let element = |(states, cnt)| {
            let command = CyclicCommand {
                states,
                comment: "process data",
                command: match datagram.access {
                    Access::Both => code::LRW,
                    Access::Inputs => code::LRD,
                    Access::Outputs => code::LWR,
                },
                target: CommandTarget::Logical(datagram.logical),
                len: datagram.len,
                cnt: Some(cnt),
                offset: datagram.offset,
            };
            let mut element = command.element();
            element.children.extend(copies.clone());
            element
        };
        each.into_iter().map(element).collect()
    }

    /// Returns the copies whose inputs this datagram brings.
    fn copies(&self, datagram: &DatagramPlan) -> Option<Element> {
        if datagram.access == Access::Outputs {
            return None;
        }
        let bits = datagram.offset * 8..(datagram.offset + datagram.len) * 8;
        let own = self.image.copies.iter();
        let own = own.filter(|(_, copy)| bits.contains(&copy.from));
        let copies: Vec<_> = own
            .map(|(_, copy): &(_, image::BitCopy)| {
                Element::new("CopyInfo")
                    .with("SrcBitOffs", copy.from)
                    .with("DstBitOffs", copy.to)
                    .with("BitSize", copy.bits)
            })
            .collect();
        (!copies.is_empty()).then(|| Element::new("CopyInfos").with_children(copies))
    }

    pub(super) fn process_image(&self) -> Element {
        let size = self.status_offset() + STATUS_LEN;
        let area = |name: &str, inputs: bool| {
            let devices = self.devices.iter();
            let variables = devices.flat_map(|device| self.variables(device, inputs));
            Element::new(name)
                .with("ByteSize", size)
                .with_children(variables)
        };
        let mut inputs = area("Inputs", true);
        if self.reference.is_some() {
            let time = variable(
                "system time",
                "",
                "ULINT",
                TIME_LEN * 8,
                self.time_offset() * 8,
            );
            inputs = inputs.child(time);
        }
        let offset = self.status_offset() * 8;
        let status = variable("AL status", "", "UINT", STATUS_LEN * 8, offset);
        Element::new("ProcessImage")
            .child(inputs.child(status))
            .child(area("Outputs", false))
    }

    fn variables(&self, device: &PlacedDevice<'_>, inputs: bool) -> Vec<Element> {
        let region = self.image.regions.get(device.index);
        let Some(region) = region.and_then(Option::as_ref) else {
            return Vec::new();
        };
        let layout = &device.config.selection.layout;
        let fields = if inputs { &layout.tx } else { &layout.rx };
        let element = |field: &Field| {
            let object = object_name(&field.name, field.index, field.sub);
            let name = format!("{}.{object}", device.config.name);
            let comment = format!("object {}", ecaxis_esi::address(field.index, field.sub));
            let bit = region.offset * 8 + field.bit_offset as usize;
            variable(&name, &comment, &field.data_type, field.bit_len.into(), bit)
        };
        fields.iter().map(element).collect()
    }
}

fn variable(name: &str, comment: &str, data_type: &str, bits: usize, offset: usize) -> Element {
    Element::new("Variable")
        .with("Name", name)
        .with_some("Comment", Some(comment).filter(|c| !c.is_empty()))
        .with_some("DataType", Some(data_type).filter(|t| !t.is_empty()))
        .with("BitSize", bits)
        .with("BitOffs", offset)
}
