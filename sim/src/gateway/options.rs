//! The settings that a configuration tool writes to a gateway and its nodes: objects from a short
//! description.

use ecaxis_esi::model::Device;

use super::anybus::{BYTES_AN_OBJECT, MAX_SIZE, MIN_SIZE};
use super::node::{Epos, RECEIVABLE, RECEIVE_COBS, TRANSMIT_COBS, TRANSMITTABLE};
use super::pdo::{INVALID, mapping};
use super::trace::CanTrace;
use crate::drive::PlantParams;

/// A value for one subindex.
pub(super) type Setting = (u16, u8, Vec<u8>);

/// The time in ms by which a heartbeat may be late.
const HEARTBEAT_MARGIN_MS: u32 = 20;

/// The time after which the gateway looks for nodes without a number.
const BOOT_TIME_MS: u32 = 500;

/// The bit rates of the gateway's rotary switch, in bit/s.
pub const BIT_RATES: [u32; 7] = [
    20_000, 50_000, 125_000, 250_000, 500_000, 800_000, 1_000_000,
];

/// The settings of a commissioned gateway.
#[derive(Debug, Clone)]
pub struct GatewayOptions {
    /// The gateway's node number on the secondary network.
    pub node_id: u8,
    /// The bit rate in bit/s, one of [`BIT_RATES`].
    pub bit_rate: u32,
    /// The bytes to and from EtherCAT (0x3000, 0x3001), 2 to 512 each, including control and status
    /// word. `None`: the default mapping of the ESI.
    pub input_size: Option<u16>,
    /// The bytes from EtherCAT to the gateway (0x3001); see [`Self::input_size`].
    pub output_size: Option<u16>,
    /// 0x1006, in µs. 0: no SYNC.
    pub sync_period_us: u32,
    /// 0x1017, in ms. 0: the gateway sends no heartbeat.
    pub heartbeat_ms: u16,
    /// 0x1F80. Bit 0: NMT master; bit 3: the MainDevice starts the nodes one by one.
    pub start_up: u32,
    /// The drives behind the gateway.
    pub nodes: Vec<NodeOptions>,
    /// Further objects of the gateway's CANopen dictionary, written last.
    pub objects: Vec<(u16, u8, Vec<u8>)>,
    /// Collects every frame of the network.
    pub trace: Option<CanTrace>,
}

impl Default for GatewayOptions {
    fn default() -> Self {
        Self {
            node_id: 99,
            bit_rate: 1_000_000,
            input_size: None,
            output_size: None,
            sync_period_us: 4000,
            heartbeat_ms: 0,
            start_up: 1,
            nodes: Vec::new(),
            objects: Vec::new(),
            trace: None,
        }
    }
}

/// The error control of a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Supervision {
    /// No error control.
    None,
    /// The node sends a heartbeat with this period, in ms. It may be late by 20 ms.
    Heartbeat {
        /// The period in ms.
        period_ms: u16,
    },
    /// The gateway requests the state with this period, in ms. The node fails after this number of
    /// unanswered requests.
    Guarding {
        /// The period in ms.
        period_ms: u16,
        /// The number of unanswered requests.
        retries: u8,
    },
}

/// A drive behind the gateway.
#[derive(Debug, Clone)]
pub struct NodeOptions {
    /// The node number, as at the DIP switch of the drive.
    pub id: u8,
    /// The model.
    pub drive: Epos,
    /// Motor, load and travel.
    pub plant: PlantParams,
    /// The error control.
    pub supervision: Supervision,
    /// The network must not start without this node.
    pub mandatory: bool,
    /// The node is configured and started again when it comes back.
    pub restart: bool,
    /// The node is reset to factory values before its configuration (0x1F81 bit 7).
    pub factory: bool,
    /// The DIP switches of the drive are at 0: the gateway assigns the number by layer setting
    /// services (manual §6.3).
    pub lss: bool,
    /// The expected date and time of the configuration (0x1F26, 0x1F27). A node with these values
    /// in 0x1020 is not configured again. 0: not compared.
    pub configured: [u32; 2],
    /// Its transmit PDOs, mapped to the input data.
    pub inputs: Vec<PdoLink>,
    /// Its receive PDOs, mapped to the output data.
    pub outputs: Vec<PdoLink>,
    /// Further objects written at each boot.
    pub objects: Vec<(u16, u8, Vec<u8>)>,
}

impl NodeOptions {
    /// Returns a node with the plant of the model, a heartbeat every 100 ms and no PDO.
    #[must_use]
    pub fn new(id: u8, drive: Epos) -> Self {
        Self {
            id,
            drive,
            plant: drive.plant(),
            supervision: Supervision::Heartbeat { period_ms: 100 },
            mandatory: false,
            restart: true,
            factory: false,
            lss: false,
            configured: [0; 2],
            inputs: Vec::new(),
            outputs: Vec::new(),
            objects: Vec::new(),
        }
    }
}

/// One PDO of a node and its place in the EtherCAT process data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PdoLink {
    /// The PDO number, 1 to 3.
    pub pdo: u8,
    /// The offset in the process data. Bytes 0 and 1 are control and status word.
    pub at: u16,
    /// The mapped objects: (index, subindex, bits). Empty: the default mapping.
    pub contents: Vec<(u16, u8, u8)>,
    /// True to send with each SYNC. EPOS drives of this generation send asynchronous PDOs on
    /// request only.
    pub synchronous: bool,
}

/// The settings of a gateway are invalid.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum GatewayError {
    /// A setting of the gateway is out of range.
    #[error("gateway: {what} {value} is not possible: {choices}")]
    Setting {
        /// The setting.
        what: &'static str,
        /// The rejected value.
        value: u32,
        /// The permitted values.
        choices: &'static str,
    },
    /// Two nodes have the same number.
    #[error("gateway: node {id} is there twice")]
    Twice {
        /// The node number, as at the DIP switch of the drive.
        id: u8,
    },
    /// The DIP switch of the drive cannot show the number.
    #[error("gateway: node {id}: a {drive} takes node numbers up to {most}")]
    NodeId {
        /// The node number, as at the DIP switch of the drive.
        id: u8,
        /// The model.
        drive: &'static str,
        /// The highest number of this model.
        most: u8,
    },
    /// The gateway rejects an object.
    #[error("gateway: object 0x{index:04x}:{sub:02x} is refused with 0x{code:08x}")]
    Object {
        /// The index.
        index: u16,
        /// The subindex.
        sub: u8,
        /// The SDO abort code.
        code: u32,
    },
    /// A PDO cannot be linked.
    #[error("gateway: node {id}, PDO {pdo}: {problem}")]
    Pdo {
        /// The node number, as at the DIP switch of the drive.
        id: u8,
        /// The PDO number.
        pdo: u8,
        /// The problem as text.
        problem: String,
    },
}

/// The objects of the gateway, and those that each node receives at boot.
#[derive(Debug, Clone, Default)]
pub(super) struct Configuration {
    pub(super) gateway: Vec<Setting>,
    pub(super) nodes: Vec<(u8, Vec<Setting>)>,
}

fn u8_(index: u16, sub: u8, value: u8) -> Setting {
    (index, sub, vec![value])
}

fn u16_(index: u16, sub: u8, value: u16) -> Setting {
    (index, sub, value.to_le_bytes().to_vec())
}

fn u32_(index: u16, sub: u8, value: u32) -> Setting {
    (index, sub, value.to_le_bytes().to_vec())
}

/// Adds a PDO mapping: cleared, filled, then enabled by its count.
fn contents(out: &mut Vec<Setting>, index: u16, entries: &[(u16, u8, u8)]) {
    out.push(u8_(index, 0, 0));
    for (sub, (object, object_sub, bits)) in (1..).zip(entries) {
        out.push(u32_(
            index,
            sub,
            mapping(*object, *object_sub, *bits) as u32,
        ));
    }
    out.push(u8_(index, 0, entries.len() as u8));
}

/// The direction of a link, seen from the gateway.
#[derive(Clone, Copy)]
struct PdoDirection {
    /// The communication and mapping parameters at the gateway and at the node.
    gateway: (u16, u16),
    node: (u16, u16),
    buffer: u16,
    cobs: [i64; 3],
    mappable: &'static [(u16, u8, u8)],
    defaults: [u16; 3],
}

const INPUTS: PdoDirection = PdoDirection {
    gateway: super::pdo::RECEIVE,
    node: super::pdo::TRANSMIT,
    buffer: super::anybus::RECEIVE_BUFFER,
    cobs: TRANSMIT_COBS,
    mappable: &TRANSMITTABLE,
    defaults: [2, 6, 3],
};
const OUTPUTS: PdoDirection = PdoDirection {
    gateway: super::pdo::TRANSMIT,
    node: super::pdo::RECEIVE,
    buffer: super::anybus::TRANSMIT_BUFFER,
    cobs: RECEIVE_COBS,
    mappable: &RECEIVABLE,
    defaults: [2, 6, 3],
};

impl GatewayOptions {
    /// Checks the settings against a device.
    pub fn validate(&self, device: &Device) -> Result<(), GatewayError> {
        self.check()?;
        self.configuration(self.sizes(device)).map(drop)
    }

    /// Returns the input and output sizes.
    pub(super) fn sizes(&self, device: &Device) -> (u16, u16) {
        let (inputs, outputs) = super::anybus::default_sizes(device);
        let input_size = self.input_size.unwrap_or(inputs);
        (input_size, self.output_size.unwrap_or(outputs))
    }

    pub(super) fn check(&self) -> Result<(), GatewayError> {
        let setting = |what, value: u32, choices| GatewayError::Setting {
            what,
            value,
            choices,
        };
        if !(1..=127).contains(&self.node_id) {
            return Err(setting("node number", self.node_id.into(), "1 to 127"));
        }
        if !BIT_RATES.contains(&self.bit_rate) {
            let choices = "20, 50, 125, 250, 500, 800 or 1000 kbit/s";
            return Err(setting("bit rate", self.bit_rate, choices));
        }
        for size in [self.input_size, self.output_size].into_iter().flatten() {
            if !(MIN_SIZE..=MAX_SIZE).contains(&size) {
                return Err(setting("data size", size.into(), "2 to 512 bytes"));
            }
        }
        for (n, node) in self.nodes.iter().enumerate() {
            let ids = node.drive.node_ids();
            if !ids.contains(&node.id) {
                return Err(GatewayError::NodeId {
                    id: node.id,
                    drive: node.drive.name(),
                    most: *ids.end(),
                });
            }
            let others = self.nodes.iter().take(n).map(|other| other.id);
            if others.chain([self.node_id]).any(|id| id == node.id) {
                return Err(GatewayError::Twice { id: node.id });
            }
        }
        Ok(())
    }

    /// Returns the objects for these sizes of input and output data.
    pub(super) fn configuration(
        &self,
        (input_size, output_size): (u16, u16),
    ) -> Result<Configuration, GatewayError> {
        let mut out = Configuration::default();
        let gateway = &mut out.gateway;
        gateway.push(u16_(0x3000, 0, input_size));
        gateway.push(u16_(0x3001, 0, output_size));
        gateway.push(u32_(0x1005, 0, 0x4000_0080));
        gateway.push(u32_(0x1006, 0, self.sync_period_us));
        gateway.push(u16_(0x1017, 0, self.heartbeat_ms));
        gateway.push(u32_(0x1f80, 0, self.start_up));
        for n in 0..4 {
            for communication in [0x1400, 0x1800] {
                gateway.push(u32_(communication + n, 1, INVALID));
            }
        }
        let (mut inputs, mut outputs) = (0, 0);
        for (n, node) in (1..).zip(&self.nodes) {
            let mut dcf = Vec::new();
            let mut assignment = 1
                | u32::from(node.restart) << 2
                | u32::from(node.mandatory) << 3
                | u32::from(node.factory) << 7;
            let expected = [0x1f26, 0x1f27].into_iter().zip(node.configured);
            gateway.extend(expected.map(|(index, value)| u32_(index, node.id, value)));
            match node.supervision {
                Supervision::None => {}
                Supervision::Heartbeat { period_ms } => {
                    let timeout_ms = u32::from(period_ms) + HEARTBEAT_MARGIN_MS;
                    let consumer = u32::from(node.id) << 16 | timeout_ms.min(0xffff);
                    gateway.push(u32_(0x1016, n, consumer));
                    dcf.push(u16_(0x1017, 0, period_ms));
                }
                Supervision::Guarding { period_ms, retries } => {
                    assignment |= u32::from(retries) << 8 | u32::from(period_ms) << 16;
                }
            }
            gateway.push(u32_(0x1f81, node.id, assignment));
            if node.lss {
                let identity = node.drive.identity(u32::from(n));
                let expected = (0x1f85..).zip(identity);
                gateway.extend(expected.map(|(index, part)| u32_(index, node.id, part)));
                gateway.push(u32_(0x1f89, 0, BOOT_TIME_MS));
            }
            for (links, way, used, size) in [
                (&node.inputs, &INPUTS, &mut inputs, input_size),
                (&node.outputs, &OUTPUTS, &mut outputs, output_size),
            ] {
                for link in links {
                    link.configure(node.id, way, *used, size, gateway, &mut dcf)?;
                    if way.gateway == super::pdo::TRANSMIT && !link.synchronous {
                        // A node that starts later, or a lost frame, must not miss a value.
                        let ms = self.sync_period_us.saturating_mul(2).div_ceil(1000);
                        let event_timer = u16::try_from(ms).unwrap_or(u16::MAX);
                        gateway.push(u16_(way.gateway.0 + *used, 5, event_timer));
                    }
                    *used += 1;
                }
            }
            dcf.extend(node.objects.iter().cloned());
            out.nodes.push((node.id, dcf));
        }
        out.gateway.extend(self.objects.iter().cloned());
        Ok(out)
    }
}

impl PdoLink {
    /// Configures a link. `n` is the number of the gateway's PDO.
    fn configure(
        &self,
        id: u8,
        way: &PdoDirection,
        n: u16,
        size: u16,
        gateway: &mut Vec<Setting>,
        dcf: &mut Vec<Setting>,
    ) -> Result<(), GatewayError> {
        let fail = |problem: String| GatewayError::Pdo {
            id,
            pdo: self.pdo,
            problem,
        };
        let place = usize::from(self.pdo).wrapping_sub(1);
        let (Some(cob), Some(default)) = (way.cobs.get(place), way.defaults.get(place)) else {
            return Err(fail("there are PDOs 1 to 3".into()));
        };
        if n >= 128 {
            return Err(fail("the gateway has 128 PDOs each way".into()));
        }
        if self.pdo == 3 && !self.contents.is_empty() {
            return Err(fail("its contents are static".into()));
        }
        if self.contents.len() > 4 {
            return Err(fail("it takes at most 4 objects".into()));
        }
        let unknown = self.contents.iter().find(|c| !way.mappable.contains(c));
        if let Some((index, sub, bits)) = unknown {
            let object = format!("0x{index:04x}:{sub:02x} with {bits} bits cannot be mapped");
            return Err(fail(object));
        }
        let mapped: u16 = self.contents.iter().map(|c| u16::from(c.2) / 8).sum();
        let len = if mapped > 0 { mapped } else { *default };
        if len > 8 {
            return Err(fail(format!("{len} bytes are more than 8")));
        }
        if self.at < 2 || self.at.checked_add(len).is_none_or(|end| end > size) {
            let at = self.at;
            return Err(fail(format!(
                "{len} bytes at {at} do not lie between the first word and byte {size}"
            )));
        }
        let kind = if self.synchronous { 1 } else { 255 };
        let node = place as u16;
        dcf.push(u8_(way.node.0 + node, 2, kind));
        if !self.contents.is_empty() {
            contents(dcf, way.node.1 + node, &self.contents);
        }
        let bytes: Vec<_> = (self.at - 2..self.at - 2 + len)
            .map(|byte| {
                let (object, sub) = (byte / BYTES_AN_OBJECT, byte % BYTES_AN_OBJECT);
                (way.buffer + object, sub as u8 + 1, 8)
            })
            .collect();
        let cob = u32::try_from(*cob).unwrap_or(0) + u32::from(id);
        // Received data is passed on at once, whenever it was sent.
        let own = if way.gateway == super::pdo::RECEIVE {
            255
        } else {
            kind
        };
        gateway.push(u8_(way.gateway.0 + n, 2, own));
        contents(gateway, way.gateway.1 + n, &bytes);
        gateway.push(u32_(way.gateway.0 + n, 1, cob));
        Ok(())
    }
}

#[cfg(test)]
#[path = "options_tests.rs"]
mod tests;
