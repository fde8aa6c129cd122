//! The CANopen gateway from both sides, on a whole bus under virtual time.

mod commands;
mod ethercat;
mod lss;
mod nodes;
mod slave;
mod supervision;

use crate::common::*;
use crate::main_device::{Learned, Mailbox, bring_up, number};
use ecaxis_esi::model::EsiFile;
use ecaxis_sim::gateway::{
    CanFrame, Epos, Gateway, GatewayOptions, NmtState, Node, NodeOptions, PdoLink, Supervision,
};
use ecaxis_sim::{DeviceOptions, SimDevice};
use proptest::prelude::*;

const S: u16 = 0x1001;
const LOGICAL: u32 = 0x1001 << 16;
const MS: u64 = 1_000_000;

fn ours() -> EsiFile {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/esi/gateway.xml");
    ecaxis_esi::parse(&std::fs::read(path).unwrap()).unwrap()
}

fn build(name: &str, gateway: GatewayOptions) -> Result<SimDevice, String> {
    let file = ours();
    let device = file.devices.iter().find(|d| d.type_name == name).unwrap();
    let options = DeviceOptions {
        gateway: Some(gateway),
        ..DeviceOptions::default()
    };
    SimDevice::from_esi(device, &[], options).map_err(|error| error.to_string())
}

/// A MainDevice with one gateway in Op: process data each millisecond, commands in the control
/// word.
struct Line {
    bus: Bus,
    learned: Learned,
    outputs: Vec<u8>,
    inputs: Vec<u8>,
    toggle: bool,
}

impl Line {
    fn new(name: &str, options: GatewayOptions) -> Self {
        let mut line = Self::at_once(name, options);
        // The secondary network boots.
        line.cycles(300);
        line
    }

    fn at_once(name: &str, options: GatewayOptions) -> Self {
        let mut bus = Bus::new(vec![build(name, options).unwrap()]);
        bus.address_all();
        let (learned, mapped) = bring_up(&mut bus, S).unwrap();
        Self {
            bus,
            learned,
            outputs: vec![0; mapped.outputs],
            inputs: vec![0; mapped.inputs],
            toggle: false,
        }
    }

    fn cycle(&mut self) {
        let len = self.outputs.len().max(self.inputs.len());
        let mut data = self.outputs.clone();
        data.resize(len, 0);
        let (data, counter) = self.bus.logical(12, LOGICAL, &data);
        assert_eq!(counter, 3);
        let inputs = self.inputs.len();
        self.inputs.copy_from_slice(&data[..inputs]);
        self.bus.wait(MS);
    }

    fn cycles(&mut self, n: usize) {
        for _ in 0..n {
            self.cycle();
        }
    }

    fn status(&self) -> [u8; 2] {
        [self.inputs[0], self.inputs[1]]
    }

    /// Issues a command with the toggle bit inverted and waits. Returns the status word's first
    /// byte without toggle bit; `None` without an acknowledgement.
    fn command(&mut self, command: u8, node: u8) -> Option<u8> {
        self.toggle = !self.toggle;
        let toggle = u8::from(self.toggle) << 7;
        (self.outputs[0], self.outputs[1]) = (command | toggle, node);
        self.cycles(20);
        let acknowledged = self.inputs[0] & 0x80 == toggle;
        if !acknowledged {
            self.toggle = !self.toggle;
        }
        acknowledged.then_some(self.inputs[0] & 0x7f)
    }

    fn gateway(&self) -> &Gateway {
        self.bus.segment.device(0).unwrap().gateway().unwrap()
    }

    fn gateway_mut(&mut self) -> &mut Gateway {
        self.bus
            .segment
            .device_mut(0)
            .unwrap()
            .gateway_mut()
            .unwrap()
    }

    fn node(&self, id: u8) -> &Node {
        self.gateway().node(id).unwrap()
    }

    fn sdo(&mut self, node: u8, index: u16, sub: u8, data: Option<&[u8]>) -> Result<u64, u32> {
        let data = data.map(<[u8]>::to_vec);
        self.gateway_mut().request_sdo(node, index, sub, data);
        for _ in 0..1000 {
            self.cycle();
            if let Some(result) = self.gateway_mut().take_sdo_result() {
                assert_eq!((result.node, result.index, result.sub), (node, index, sub));
                return result
                    .data
                    .map(|data| number(&data))
                    .map_err(|abort| abort.0);
            }
        }
        panic!("no result");
    }

    fn input(&self, at: usize, len: usize) -> i64 {
        let raw = number(&self.inputs[at..at + len]);
        let shift = 64 - 8 * len;
        (raw << shift).cast_signed() >> shift
    }

    fn output(&mut self, at: usize, value: i64, len: usize) {
        self.outputs[at..at + len].copy_from_slice(&value.to_le_bytes()[..len]);
    }
}

fn link(pdo: u8, at: u16, contents: &[(u16, u8, u8)]) -> PdoLink {
    PdoLink {
        pdo,
        at,
        contents: contents.to_vec(),
        synchronous: true,
    }
}

/// Returns a node with ten bytes: Controlword, target position and mode out; Statusword, position
/// and mode in.
fn node(id: u8, drive: Epos, at: u16) -> NodeOptions {
    NodeOptions {
        outputs: vec![
            link(1, at, &[(0x6040, 0, 16), (0x607a, 0, 32)]),
            link(3, at + 6, &[]),
        ],
        inputs: vec![
            link(1, at, &[(0x6041, 0, 16), (0x6064, 0, 32)]),
            link(3, at + 6, &[]),
        ],
        ..NodeOptions::new(id, drive)
    }
}

fn three_drives() -> GatewayOptions {
    GatewayOptions {
        input_size: Some(64),
        output_size: Some(64),
        nodes: vec![
            node(1, Epos::E24_1, 2),
            node(2, Epos::E24_5, 12),
            node(100, Epos::E70_10, 22),
        ],
        ..GatewayOptions::default()
    }
}

fn sent(line: &Line, id: u16) -> Vec<CanFrame> {
    let frames = line.gateway().frames().map(|(_, frame)| frame);
    frames.filter(|frame| frame.id == id).collect()
}

/// Enables the drive at `at` through its static and mapped PDOs.
fn enable(line: &mut Line, at: usize, mode: i64) {
    for word in [0x06, 0x07, 0x0f] {
        line.output(at, word, 2);
        line.output(at + 6, word, 2);
        line.output(at + 8, mode, 1);
        line.cycles(60);
    }
}
