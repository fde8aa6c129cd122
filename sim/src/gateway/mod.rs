//! A CANopen gateway on EtherCAT, after the Anybus X-gateway CANopen – EtherCAT (manual
//! HMSI-168-81, rev. 2.10), with EPOS 24/1, 24/5 and 70/10 drives on its CANopen side.
//!
//! The EtherCAT side carries plain bytes: up to 512 in each direction, in four fixed PDOs of 128.
//! The first two bytes are the control and status word; the others are the data of CANopen PDOs.
//!
//! * `options`, `concise`: settings from commissioning, and the objects that follow from them
//! * `anybus`: the EtherCAT objects for the configured sizes; the CANopen dictionary
//! * `control`, `exchange`: control and status word; data exchange between the networks
//! * `master`: NMT master: boots, monitors and commands nodes
//! * `process`, `objects`: the gateway's own PDOs and its SDO server
//! * `node`: a drive as a CANopen node
//! * `can`, `sdo`, `pdo`, `nmt`, `lss`, `dictionary`: the bus and the parts that both ends share
//!
//! The secondary network runs in true time between the points at which the gateway forwards data.
//! The bus has no bit errors, so no controller goes bus-off. A gateway
//! that is not the NMT master obeys the one whose frames [`Gateway::inject`] sends.
//!
//! ```
//! use ecaxis_sim::DeviceOptions;
//! use ecaxis_sim::gateway::{Epos, GatewayOptions, NodeOptions};
//!
//! let gateway = GatewayOptions {
//!     bit_rate: 500_000,
//!     nodes: vec![NodeOptions::new(1, Epos::E24_5)],
//!     ..GatewayOptions::default()
//! };
//! let options = DeviceOptions { gateway: Some(gateway), ..DeviceOptions::default() };
//! assert!(options.gateway.is_some());
//! ```

mod anybus;
mod can;
mod concise;
mod control;
mod dictionary;
mod exchange;
mod fault;
mod lss;
mod master;
mod nmt;
mod node;
mod objects;
mod options;
mod pdo;
mod process;
mod sdo;
mod trace;

use std::collections::VecDeque;

pub use crate::coe::Abort;
pub use can::CanFrame;
pub use master::SdoResult;
pub use nmt::NmtState;
pub use node::{Epos, Node};
pub use options::{BIT_RATES, GatewayError, GatewayOptions, NodeOptions, PdoLink, Supervision};

pub use anybus::{default_sizes, is_gateway, with_sizes};
pub(crate) use fault::GatewayFault;
pub use trace::CanTrace;

use ecaxis_esi::model::Device;

use crate::Nanos;
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};
use anybus::BUFFER;
use can::CanBus;
use control::NO_OPERATION;
use dictionary::Dictionary;
use master::Master;
use sdo::Objects;

/// The period at which data passes between the two networks, in ns.
pub(crate) const FORWARD_NS: Nanos = 1_000_000;
/// The time from power-on or a reset until the CANopen side runs, in ns.
const INITIALISATION_NS: Nanos = 100_000_000;
const MS: u64 = 1_000_000;
/// The number of frames that [`Gateway::frames`] keeps.
const LOG: usize = 256;
/// The transmit error count at which a CAN controller becomes error passive, and the increment per
/// failure.
const ERROR_PASSIVE: u16 = 128;
const TRANSMIT_ERROR: u16 = 8;
/// CAN in error passive mode.
const PASSIVE_MODE: u16 = 0x8120;
/// The sender of injected frames, beyond all node numbers.
const OTHER: u8 = 0xff;

/// The application of a gateway: CANopen master, its nodes and the CAN bus between them.
#[derive(Debug, Clone)]
pub struct Gateway {
    esi: Box<Device>,
    serial: u32,
    options: GatewayOptions,
    d: Dictionary,
    /// The dictionary at start.
    stored: Dictionary,
    /// The input and output sizes in effect since power-on.
    sizes: (u16, u16),
    slots: [Vec<EntryHandle>; 2],
    inputs: [u8; BUFFER],
    outputs: [u8; BUFFER],
    bus: CanBus,
    nodes: Vec<Node>,
    nmt: NmtState,
    master: Master,
    receive: Vec<process::Receive>,
    transmit: Vec<process::Transmit>,
    server: sdo::Server,
    /// The toggle bit and the first byte of the status word.
    toggle: bool,
    status: u8,
    now: u64,
    ready: u64,
    sync: u64,
    heartbeat: u64,
    transmit_errors: u16,
    log: VecDeque<(Nanos, CanFrame)>,
    disturbance: fault::Disturbance,
    /// Slave mode: the control word permits OPERATIONAL.
    permitted: bool,
}

impl Gateway {
    pub(crate) fn new(
        device: &Device,
        serial: u32,
        options: GatewayOptions,
    ) -> Result<Self, GatewayError> {
        options.check()?;
        let sizes = options.sizes(device);
        let configuration = options.configuration(sizes)?;
        let nodes = (1..).zip(&options.nodes).map(|(n, node)| {
            Node::new(node::Settings {
                id: node.id,
                drive: node.drive,
                plant: node.plant,
                serial: n,
                bit_rate: options.bit_rate,
                lss: node.lss,
            })
        });
        let mut gateway = Self {
            esi: Box::new(device.clone()),
            serial,
            d: Dictionary::default(),
            stored: Dictionary::default(),
            sizes,
            slots: [Vec::new(), Vec::new()],
            inputs: [0; BUFFER],
            outputs: [0; BUFFER],
            bus: CanBus::new(options.bit_rate),
            nodes: nodes.collect(),
            nmt: NmtState::Initialising,
            master: Master::default(),
            receive: Vec::new(),
            transmit: Vec::new(),
            server: sdo::Server::default(),
            toggle: false,
            status: NO_OPERATION << 4,
            now: 0,
            ready: 0,
            sync: u64::MAX,
            heartbeat: u64::MAX,
            transmit_errors: 0,
            log: VecDeque::with_capacity(LOG),
            disturbance: fault::Disturbance::default(),
            permitted: false,
            options,
        };
        gateway.d = gateway.factory();
        for (node, settings) in &configuration.nodes {
            let bytes = concise::emit(settings);
            gateway
                .d
                .add_bytes(0x1f22, *node, dictionary::Access::Rw, &bytes);
        }
        for (index, sub, data) in &configuration.gateway {
            gateway
                .write(*index, *sub, data)
                .map_err(|abort| GatewayError::Object {
                    index: *index,
                    sub: *sub,
                    code: abort.0,
                })?;
        }
        gateway.stored = gateway.d.clone();
        gateway.power_on(0);
        Ok(gateway)
    }

    /// Returns the ESI device with the present PDOs and bytes, and their objects.
    pub(crate) fn shaped(&self) -> Device {
        anybus::shape(&self.esi, self.sizes)
    }

    pub(crate) fn prepare(&self, store: &mut ObjectStore) {
        anybus::prepare(store, self.sizes, &self.esi.type_name);
    }

    /// Binds the gateway to the device's objects.
    pub(crate) fn bind(&mut self, store: &ObjectStore) {
        self.slots = anybus::slots(store, self.sizes);
    }

    /// Powers the gateway on. New data sizes take effect. True if they changed.
    pub(crate) fn power_on(&mut self, now: Nanos) -> bool {
        let size = |index| u16::try_from(self.stored.get(index, 0)).unwrap_or(anybus::MIN_SIZE);
        let sizes = (size(0x3000), size(0x3001));
        let changed = sizes != self.sizes;
        self.sizes = sizes;
        self.outputs = [0; BUFFER];
        (self.toggle, self.status) = (false, NO_OPERATION << 4);
        self.restart(true, now);
        changed
    }

    /// Starts the initialisation: all stored objects, or only the stored communication objects.
    fn restart(&mut self, everything: bool, now: u64) {
        if everything {
            self.d = self.stored.clone();
            self.inputs = [0; BUFFER];
        } else {
            self.d.restore(&self.stored, 0x1000..=0x1fff);
        }
        self.bus.forget(self.options.node_id);
        self.permitted = false;
        self.nmt = NmtState::Initialising;
        self.ready = now + INITIALISATION_NS;
        (self.sync, self.heartbeat) = (u64::MAX, u64::MAX);
        self.transmit_errors = 0;
        self.server.reset();
        self.master = Master::default();
        self.load_pdos();
    }

    /// Runs the secondary network up to this time.
    fn advance(&mut self, to: Nanos) {
        loop {
            let due = self.due();
            if due > to {
                break;
            }
            self.now = self.now.max(due);
            self.step(self.now);
        }
        self.now = self.now.max(to);
    }

    fn due(&self) -> u64 {
        let ready = if self.nmt == NmtState::Initialising {
            self.ready
        } else {
            self.master.due()
        };
        let nodes = self.nodes.iter().map(Node::due);
        let own = ready.min(self.sync).min(self.heartbeat);
        nodes.fold(own, u64::min).min(self.bus.due())
    }

    fn step(&mut self, now: u64) {
        for node in &mut self.nodes {
            if node.due() <= now {
                node.step(now, &mut self.bus);
            }
        }
        if self.nmt == NmtState::Initialising {
            if self.ready <= now {
                self.nmt = NmtState::PreOperational;
                self.send(0x700 + u16::from(self.options.node_id), &[0], now);
                self.restart_sync();
                self.restart_heartbeat();
                self.start_network(now);
            }
        } else {
            self.step_master(now);
        }
        if self.sync <= now {
            self.sync += self.sync_period().max(1);
            let cob = (self.d.get(0x1005, 0) & 0x7ff) as u16;
            self.send(cob, &[], now);
        }
        if self.heartbeat <= now {
            let state = self.nmt.code();
            self.restart_heartbeat();
            self.send(0x700 + u16::from(self.options.node_id), &[state], now);
        }
        if self.bus.due() <= now {
            self.step_bus(now);
        }
    }

    fn step_bus(&mut self, now: u64) {
        let (own, rate) = (self.options.node_id, self.options.bit_rate);
        let connected = !self.disturbance.open;
        let listens = connected && self.nmt != NmtState::Initialising;
        let nodes = &self.nodes;
        let sent = self.bus.step(|from| {
            (listens && from != own)
                || ((from != own || connected)
                    && nodes
                        .iter()
                        .any(|node| node.id() != from && node.is_on_bus(rate)))
        });
        let Some(sent) = sent else { return };
        if sent.from == own {
            self.count_errors(sent.failed, now);
        }
        if sent.failed {
            return;
        }
        if self.log.len() >= LOG {
            self.log.pop_front();
        }
        self.log.push_back((now, sent.frame));
        if let Some(trace) = &self.options.trace {
            trace.push(now, sent.frame);
        }
        for node in &mut self.nodes {
            if node.id() != sent.from && node.is_on_bus(rate) {
                node.receive(&sent.frame, now, &mut self.bus);
            }
        }
        if sent.from != own && listens {
            self.hear(&sent.frame, now);
        } else if sent.from == own && i64::from(sent.frame.id) == self.d.get(0x1005, 0) & 0x7ff {
            self.synchronise(now);
        }
    }

    fn count_errors(&mut self, failed: bool, now: u64) {
        let before = self.transmit_errors;
        self.transmit_errors = if failed {
            (before + TRANSMIT_ERROR).min(ERROR_PASSIVE)
        } else {
            before.saturating_sub(1)
        };
        // The counter reaches the limit from below only once. A single success and failure at the
        // limit do not count as a new event.
        if self.transmit_errors == ERROR_PASSIVE && before + TRANSMIT_ERROR == ERROR_PASSIVE {
            self.emergency(PASSIVE_MODE, 0, now);
        }
    }

    /// Handles a node's frame.
    fn hear(&mut self, frame: &CanFrame, now: u64) {
        let node = (frame.id & 0x7f) as u8;
        match (frame.id, frame.data()) {
            (0, &[specifier, node]) => self.nmt_service(specifier, node, now),
            (0x581..0x600, _) => self.sdo_response(node, frame, now),
            (lss::SLAVE, _) => self.lss_answer(frame, now),
            (0x701..0x780, [byte]) => self.heard(node, *byte, now),
            _ => self.take_pdo(frame, now),
        }
    }

    fn send(&mut self, id: u16, data: &[u8], now: u64) {
        self.bus
            .send(self.options.node_id, CanFrame::new(id, data), now);
    }

    /// Records an error and sends an emergency on the secondary network.
    fn emergency(&mut self, code: u16, additional: u16, now: u64) {
        for sub in (1..16).rev() {
            let older = self.d.get(0x1003, sub);
            self.d.set(0x1003, sub + 1, older);
        }
        let entry = u32::from(additional) << 16 | u32::from(code);
        self.d.set(0x1003, 1, i64::from(entry));
        let count = (self.d.get(0x1003, 0) + 1).min(16);
        self.d.set(0x1003, 0, count);
        let register = if code >> 8 == 0x81 { 0x11 } else { 0x01 };
        self.d.set(0x1001, 0, register);
        let [c0, c1, a0, a1] = entry.to_le_bytes();
        let data = [c0, c1, register as u8, a0, a1, 0, 0, 0];
        self.send(0x80 + u16::from(self.options.node_id), &data, now);
    }

    /// Returns the SYNC period, 0 without SYNC. The CAN bit rate limits it.
    fn sync_period(&self) -> u64 {
        match self.d.get(0x1006, 0).cast_unsigned() * 1000 {
            0 => 0,
            period => period.max(50_000_000_000 / u64::from(self.options.bit_rate)),
        }
    }

    fn restart_sync(&mut self) {
        let producer = self.d.get(0x1005, 0) & 0x4000_0000 != 0;
        self.sync = match self.sync_period() {
            period if producer && period > 0 && self.nmt != NmtState::Initialising => {
                self.now + period
            }
            _ => u64::MAX,
        };
    }

    fn restart_heartbeat(&mut self) {
        let period = self.d.get(0x1017, 0).cast_unsigned() * MS;
        let runs = period > 0 && self.nmt != NmtState::Initialising;
        self.heartbeat = if runs { self.now + period } else { u64::MAX };
    }

    /// Returns the NMT state of the gateway itself.
    #[must_use]
    pub fn nmt_state(&self) -> NmtState {
        self.nmt
    }

    /// Returns the node with this number.
    #[must_use]
    pub fn node(&self, id: u8) -> Option<&Node> {
        self.nodes.iter().find(|node| node.id() == id)
    }

    /// Returns the node with this number to change it.
    pub fn node_mut(&mut self, id: u8) -> Option<&mut Node> {
        self.nodes.iter_mut().find(|node| node.id() == id)
    }

    /// Writes an object of the CANopen dictionary, as a configuration tool does.
    pub fn configure(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<(), Abort> {
        self.write(index, sub, data)
    }

    /// Reads an object of the CANopen dictionary.
    pub fn configuration(&self, index: u16, sub: u8) -> Result<Vec<u8>, Abort> {
        self.read(index, sub)
    }

    /// Handles one request to the SDO server on the secondary network. Request and answer are the
    /// eight bytes of a frame.
    pub fn serve_sdo(&mut self, request: &[u8; 8]) -> Option<[u8; 8]> {
        let mut server = std::mem::take(&mut self.server);
        let response = server.request(self, request);
        self.server = server;
        response
    }

    /// Returns the next finished transfer of [`Self::request_sdo`].
    pub fn take_sdo_result(&mut self) -> Option<SdoResult> {
        self.master.results.pop_front()
    }

    /// Returns the number of frames that found the transmit queue full.
    #[must_use]
    pub fn lost_frames(&self) -> u64 {
        self.bus.lost
    }

    /// Returns the last frames of the secondary network, oldest first, with the true time of their
    /// end.
    pub fn frames(&self) -> impl Iterator<Item = (Nanos, CanFrame)> + '_ {
        self.log.iter().copied()
    }

    /// Puts a frame of another participant on the secondary network, such as another NMT master.
    pub fn inject(&mut self, frame: CanFrame) {
        self.bus.send(OTHER, frame, self.now);
    }

    /// Switches a node's power off or on. A node that gets power boots.
    pub fn set_node_silent(&mut self, id: u8, silent: bool) {
        let now = self.now;
        let Some(node) = self.nodes.iter_mut().find(|node| node.id() == id) else {
            return;
        };
        if silent {
            node.power_off(&mut self.bus);
        } else {
            node.power_on(now);
        }
    }
}
