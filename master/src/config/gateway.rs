//! A CANopen gateway: its CAN network, the nodes on it and their axes. The same tables describe the
//! simulated network.
//!
//! The configuration tool of the gateway decides where the PDOs of a node lie in its process data.
//! The file repeats that: a node gets a process data layout of its own, with offsets in the
//! gateway's process data. Its axis is then an axis like any other.

use ecaxis_esi as esi;
use ecaxis_esi::layout::{Field as ObjectField, Layout};
use ecaxis_sim::gateway::{BIT_RATES, Epos, GatewayOptions, NodeOptions, PdoLink, Supervision};
use toml::Spanned;

use super::device::CheckedAxis;
use super::duration::show;
use super::fields::{Domain, Field, Key, KeyExt, Ns, Read, Table, TableKey, Value, Written};
use super::problem::{Problems, Span, list, suggestion};
use super::raw::{AxisTables, RawAxis, RawDevice, RawEntry};
use super::schema::{self, Schema};
use super::{AxisSetup, axis};

const MS: Ns = 1_000_000;

table! { "[device.can]",
    table RawCan {
        /// Bit rate (bit/s; default 1,000,000)
        bit_rate: Key<u32>,
        /// Period of the gateway's SYNC, whole cycles; the axes step with it (time, 1 ms to 100 ms;
        /// default `"4ms"`)
        sync: Key<Ns> [MS..=100 * MS],
    }
}

table! { "[[device.node]]",
    row RawNode {
        /// CANopen node-ID (1 to 127)
        id: u8 [1..=127] = "1",
        /// Model of the drive (`"EPOS 24/1"`, `"EPOS 24/5"`, `"EPOS 70/10"`)
        drive: Spanned<Epos> = "\"EPOS 24/5\"",
        /// Period of the heartbeat (time, 10 ms to 65 s; default `"50ms"`)
        heartbeat: Option<Heartbeat>,
        /// If true, the gateway starts its network with this node only (true, false; default false)
        mandatory: Option<bool>,
        /// PDOs from the node to the gateway (list of tables; default none)
        inputs: Vec<RawLink>,
        /// PDOs from the gateway to the node (list of tables; default none)
        outputs: Vec<RawLink>,
        /// Axis of the drive, as `[device.axis]`; it needs a `name` (table; default none: no axis)
        axes: AxisTables as "axis",
    }
}

/// The CAN network behind a gateway.
#[derive(Debug, Clone)]
pub struct GatewaySetup {
    /// The bit rate in bit/s.
    pub bit_rate: u32,
    /// The SYNC period; a multiple of the cycle if a node has an axis.
    pub sync_ns: u64,
    pub nodes: Vec<NodeSetup>,
    /// The share of time for which frames occupy the network, from 0 to 1, with most stuff bits.
    pub load: f64,
}

/// A node behind a gateway.
#[derive(Debug, Clone)]
pub struct NodeSetup {
    /// The node-ID.
    pub id: u8,
    /// The model of the drive.
    pub drive: &'static str,
    /// The gateway's selection with the process data of this node alone. Objects that do the work
    /// of an object of CiA 402 have its index.
    pub selection: esi::Selection,
    /// The PDOs: first byte in the gateway's process data, number, objects as mapped.
    pub outputs: Vec<PdoLink>,
    pub inputs: Vec<PdoLink>,
}

/// A gateway's network, checked, with the axes of its nodes.
pub(super) struct CheckedNetwork {
    pub setup: GatewaySetup,
    pub simulated: GatewayOptions,
    pub axes: Vec<CheckedAxis>,
}

impl Read for Epos {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let name = String::read(value, key, p)?;
        let found = Self::from_name(&name);
        if found.is_none() {
            let names = Self::ALL.iter().map(|drive| drive.name());
            let hint = suggestion(&name, names, "drives");
            p.add_hint(value.span(), format!("unknown drive `{name}`"), hint);
        }
        found
    }
}

impl Schema for Epos {
    fn schema() -> serde_json::Value {
        schema::words(Self::ALL.map(Self::name))
    }
}

/// A period in ms.
#[derive(Debug)]
pub(crate) struct Heartbeat(u16);

impl Read for Heartbeat {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let ms = u16::try_from(Ns::read(value, key, p)? / MS).ok();
        let ms = ms.filter(|ms| *ms >= 10);
        if ms.is_none() {
            p.add(value.span(), "a heartbeat takes 10 ms to 65 s");
        }
        ms.map(Self)
    }
}

impl Schema for Heartbeat {
    fn schema() -> serde_json::Value {
        Ns::schema()
    }
}

table! { "a PDO of a node",
    row RawLink {
        /// Number of the PDO (1 to 3)
        pdo: u8 [1..=3] = "1",
        /// First byte in the gateway's data (2 to 511)
        at: u16 [2..=511] = "2",
        /// Mapped objects (default the drive's own)
        objects: Vec<MappableObject>,
        /// If true, the PDO waits for the SYNC (default: inputs true, outputs false)
        synchronous: Option<bool>,
    }
}

/// Index, subindex and bits of an object.
#[derive(Debug)]
pub(crate) struct MappableObject(u16, u8, u8);

impl Read for MappableObject {
    const LIST: &'static str = RawEntry::LIST;

    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let RawEntry { index, sub, .. } = RawEntry::read(value, key, p)?;
        let bits = Epos::mappable_bits(index, sub);
        if bits.is_none() {
            let message = format!("{} cannot be mapped", esi::address(index, sub));
            p.add(value.span(), message);
        }
        bits.map(|bits| Self(index, sub, bits))
    }
}

impl Schema for MappableObject {
    fn schema() -> serde_json::Value {
        RawEntry::schema()
    }
}

/// Objects of these drives that do the work of an object of CiA 402. In position mode (−1) the
/// set-point without a profile is 0x2062.
const ALIASES: [(u16, u16); 1] = [(0x2062, 0x607a)];

/// The contents of a PDO that the file does not list, as the drive has them at delivery.
fn default_contents(pdo: u8, word: u16, position: u16, mode: u16) -> Vec<(u16, u8, u8)> {
    match pdo {
        1 => vec![(word, 0, 16)],
        2 => vec![(word, 0, 16), (position, 0, 32)],
        _ => vec![(word, 0, 16), (mode, 0, 8)],
    }
}

fn link(raw: &RawLink, synchronous: bool) -> PdoLink {
    let contents = raw.objects.iter();
    PdoLink {
        pdo: raw.pdo,
        at: raw.at,
        contents: contents
            .map(|&MappableObject(index, sub, bits)| (index, sub, bits))
            .collect(),
        synchronous: raw.synchronous.unwrap_or(synchronous),
    }
}

/// Returns the link with its contents: those of the file, or the drive's own.
fn explicit(link: &PdoLink, defaults: [u16; 3]) -> PdoLink {
    let mut link = link.clone();
    if link.contents.is_empty() {
        let [word, position, mode] = defaults;
        link.contents = default_contents(link.pdo, word, position, mode);
    }
    link
}

const OUTPUTS: [u16; 3] = [0x6040, 0x607a, 0x6060];
const INPUTS: [u16; 3] = [0x6041, 0x6064, 0x6061];

fn fields(links: &[PdoLink], first_pdo: u16) -> Vec<ObjectField> {
    let mut fields = Vec::new();
    for link in links {
        let mut bit_offset = u32::from(link.at) * 8;
        for &(index, sub, bits) in &link.contents {
            let alias = ALIASES.iter().find(|(own, _)| *own == index);
            fields.push(ObjectField {
                pdo: first_pdo + u16::from(link.pdo).saturating_sub(1),
                index: alias.map_or(index, |(_, standard)| *standard),
                sub,
                bit_offset,
                bit_len: bits.into(),
                name: String::new(),
                data_type: String::new(),
            });
            bit_offset += u32::from(bits);
        }
    }
    fields
}

/// Returns the length of a PDO in bytes.
fn bytes(link: &PdoLink) -> u16 {
    link.contents.iter().map(|c| u16::from(c.2) / 8).sum()
}

/// Returns the PDOs of a node in one direction.
type Links = fn(&NodeSetup) -> &[PdoLink];

/// Outputs, then inputs.
const LINKS: [Links; 2] = [|node| &node.outputs, |node| &node.inputs];

impl NodeSetup {
    fn new(node: &NodeOptions, gateway: &esi::Selection) -> Self {
        let each = |links: &[PdoLink], defaults| -> Vec<PdoLink> {
            links.iter().map(|link| explicit(link, defaults)).collect()
        };
        let (outputs, inputs) = (each(&node.outputs, OUTPUTS), each(&node.inputs, INPUTS));
        let mut selection = gateway.clone();
        selection.dictionary = esi::Dictionary::default();
        selection.startup.clear();
        selection.notes.clear();
        selection.layout = Layout {
            rx: fields(&outputs, 0x1600),
            tx: fields(&inputs, 0x1a00),
            rx_pdos: Vec::new(),
            tx_pdos: Vec::new(),
            ..gateway.layout.clone()
        };
        Self {
            id: node.id,
            drive: node.drive.name(),
            selection,
            outputs,
            inputs,
        }
    }
}

/// Returns the bits of a frame with this number of data bytes and most stuff bits, gap included.
const fn frame_bits(bytes: u64) -> u64 {
    47 + 8 * bytes + (34 + 8 * bytes - 1) / 4
}

/// The highest load of a CAN network: above it, frames with high identifiers wait for others.
const MAX_LOAD: f64 = 0.6;

/// Returns the share of time for which frames occupy the network. Each PDO passes once per SYNC.
fn load(setup: &GatewaySetup, simulated: &GatewayOptions, sync_ns: u64) -> f64 {
    let links = setup
        .nodes
        .iter()
        .flat_map(|n| n.outputs.iter().chain(&n.inputs));
    let pdos: u64 = links.map(|link| frame_bits(bytes(link).into())).sum();
    let per_sync = frame_bits(0) + pdos;
    let heartbeats = simulated.nodes.iter().map(|node| match node.supervision {
        Supervision::Heartbeat { period_ms } => {
            frame_bits(1) as f64 * 1e3 / f64::from(period_ms.max(1))
        }
        _ => 0.0,
    });
    let rate = per_sync as f64 * 1e9 / sync_ns as f64 + heartbeats.sum::<f64>();
    rate / f64::from(setup.bit_rate)
}

impl GatewaySetup {
    /// Returns the time from a set-point to the report of its position: it is held for one SYNC
    /// period; the cycle that carries it, the gateway's exchange, the longest PDO and SYNC add to
    /// that.
    #[must_use]
    pub fn dead_time_ns(&self, cycle_ns: u64) -> u64 {
        const EXCHANGE_NS: u64 = MS;
        let links = self
            .nodes
            .iter()
            .flat_map(|n| n.outputs.iter().chain(&n.inputs));
        let longest = links.map(|link| frame_bits(bytes(link).into())).max();
        let bits = frame_bits(0) + longest.unwrap_or(0);
        let frames = bits * 1_000_000_000 / u64::from(self.bit_rate.max(1));
        self.sync_ns + cycle_ns + EXCHANGE_NS + frames
    }
}

/// Checks the gateway's network. Returns `None` without one, or if it is invalid and reported.
/// `cycle`: the bus cycle and its place.
pub(super) fn check(
    raw: &RawDevice,
    device: Option<&esi::Device>,
    selection: Option<&mut esi::Selection>,
    cycle: Option<&(u64, Span)>,
    p: &mut Problems<'_>,
) -> Option<CheckedNetwork> {
    if !raw.written.has("can") && raw.node.is_empty() {
        return None;
    }
    let mut simulated = GatewayOptions::default();
    if let Some(rate) = &raw.can.bit_rate {
        if BIT_RATES.contains(rate.get_ref()) {
            simulated.bit_rate = *rate.get_ref();
        } else {
            let rates = BIT_RATES.map(|rate| rate.to_string()).join(", ");
            let hint = format!("bits a second: {rates}");
            p.add_hint(rate.span(), "no such bit rate", hint);
        }
    }
    let sync_ns = raw.can.sync.value().unwrap_or(4 * MS);
    simulated.sync_period_us = u32::try_from(sync_ns / 1000).unwrap_or(u32::MAX);
    let (device, selection) = (device?, selection?);
    if !ecaxis_sim::gateway::is_gateway(device) {
        let at = raw.node.first().map(|node| node.span.clone());
        let at = at.unwrap_or(raw.can.span.clone());
        let message = format!("`{}` is not a CANopen gateway", device.type_name);
        let hint = format!("a gateway carries bytes of {}", list(["0x2100", "0x2000"]));
        p.add_hint(at, message, hint);
        return None;
    }
    let mut network = CheckedNetwork {
        setup: GatewaySetup {
            bit_rate: simulated.bit_rate,
            sync_ns,
            nodes: Vec::new(),
            load: 0.0,
        },
        simulated,
        axes: Vec::new(),
    };
    for raw in &raw.node {
        let mut node = NodeOptions::new(raw.id, *raw.drive.get_ref());
        let period_ms = raw.heartbeat.as_ref().map_or(50, |heartbeat| heartbeat.0);
        node.supervision = Supervision::Heartbeat { period_ms };
        node.mandatory = raw.mandatory.unwrap_or(false);
        node.inputs = raw.inputs.iter().map(|raw| link(raw, true)).collect();
        node.outputs = raw.outputs.iter().map(|raw| link(raw, false)).collect();
        let setup = NodeSetup::new(&node, selection);
        network.simulated.nodes.push(node);
        // Validated after each node, so that the error marks the right one.
        if let Err(error) = network.simulated.validate(device) {
            p.add(raw.span.clone(), error.to_string());
            return None;
        }
        network.overlaps(raw, &setup, p);
        network.setup.nodes.push(setup);
    }
    network.setup.load = load(&network.setup, &network.simulated, sync_ns);
    network.unused_bytes(&mut selection.notes);
    network.check_load(raw, cycle.map_or(MS, |(cycle, _)| *cycle), p);
    for (n, node) in raw.node.iter().enumerate() {
        network.check_axis(n, node, raw, cycle, p);
    }
    Some(network)
}

impl CheckedNetwork {
    /// Reports PDOs that lie on those of earlier nodes or on each other.
    fn overlaps(&self, raw: &RawNode, node: &NodeSetup, p: &mut Problems<'_>) {
        let nodes = || self.setup.nodes.iter().chain([node]);
        for (all, raw) in LINKS.into_iter().zip([&raw.outputs, &raw.inputs]) {
            let own = all(node);
            for (n, (raw, link)) in raw.iter().zip(own).enumerate() {
                let earlier = nodes().flat_map(|other| {
                    let count = if other.id == node.id { n } else { usize::MAX };
                    all(other).iter().take(count).map(|link| (other.id, link))
                });
                let end = link.at + bytes(link);
                let mut hit = earlier.filter(|(_, o)| o.at < end && link.at < o.at + bytes(o));
                let Some((id, other)) = hit.next() else {
                    continue;
                };
                let taken = other.at + bytes(other);
                let message = format!(
                    "bytes {} to {} overlap PDO {} of node {id} at {} to {}",
                    link.at,
                    end - 1,
                    other.pdo,
                    other.at,
                    taken - 1
                );
                let hint = format!("write `at = {taken}`, as in the gateway's configuration");
                p.add_hint(raw.span.clone(), message, hint);
            }
        }
    }

    /// Notes bytes between PDOs that belong to no PDO.
    fn unused_bytes(&self, notes: &mut Vec<String>) {
        for (word, links) in ["outputs", "inputs"].into_iter().zip(LINKS) {
            let links = self.setup.nodes.iter().flat_map(links);
            let mut spans: Vec<_> = links.map(|l| (l.at, l.at + bytes(l))).collect();
            spans.sort_unstable();
            let mut next = 2;
            for (at, end) in spans {
                if at > next {
                    let message =
                        format!("the {word} from byte {next} to {} are in no PDO", at - 1);
                    notes.push(message);
                }
                next = next.max(end);
            }
        }
    }

    fn check_load(&self, raw: &RawDevice, cycle_ns: u64, p: &mut Problems<'_>) {
        if self.setup.load <= MAX_LOAD {
            return;
        }
        let mut cycles =
            (cycle_ns..=100 * MS).step_by(usize::try_from(cycle_ns).unwrap_or(1).max(1));
        let fits = cycles.find(|sync| load(&self.setup, &self.simulated, *sync) <= MAX_LOAD);
        let hint = match fits {
            Some(sync) => {
                let sync = show(sync).replace(' ', "");
                format!("write `sync = \"{sync}\"`, or map less")
            }
            None => "raise `bit_rate`, map less, or use a second gateway".to_owned(),
        };
        let message = format!(
            "the CAN network would be occupied for {:.0} % of the time, more than {:.0} %",
            self.setup.load * 100.0,
            MAX_LOAD * 100.0
        );
        let node = raw.node.first().map(|node| node.span.clone());
        let at = raw.can.sync.place().or(node).unwrap_or(raw.span.clone());
        p.add_hint(at, message, hint);
    }

    /// Checks the axis of a node.
    fn check_axis(
        &mut self,
        n: usize,
        raw: &RawNode,
        device: &RawDevice,
        cycle: Option<&(u64, Span)>,
        p: &mut Problems<'_>,
    ) {
        let (Some(axis), Some(node)) = (raw.axes.0.first(), self.setup.nodes.get(n)) else {
            return;
        };
        if let Some(second) = raw.axes.0.get(1) {
            let message = format!("a {} has one axis", node.drive);
            p.add_hint(
                second.span.clone(),
                message,
                "write `[device.node.axis]` once",
            );
        }
        let Some(name) = &axis.name else {
            let message = "the axis of a node needs a `name`";
            p.add_hint(axis.span.clone(), message, "name it: `name = \"x\"`");
            return;
        };
        let layout = &node.selection.layout;
        let lacks = |output: bool, index| match output {
            true => layout.rx_field(index, 0).is_none(),
            false => layout.tx_field(index, 0).is_none(),
        };
        // The index in the file, its alias, and what it is.
        let needed = [
            (true, 0x6040, 0x6040, "Controlword"),
            (true, 0x607a, 0x2062, "position mode setting value"),
            (true, 0x6060, 0x6060, "modes of operation, in PDO 3"),
            (false, 0x6041, 0x6041, "Statusword"),
            (false, 0x6064, 0x6064, "position actual value"),
            (
                false,
                0x6061,
                0x6061,
                "modes of operation display, in PDO 3",
            ),
        ];
        let mapped = |index: u16| {
            let links = &node.outputs;
            links
                .iter()
                .any(|l| l.contents.iter().any(|c| c.0 == index))
        };
        for (output, index, own, what) in needed {
            if lacks(output, index) || output && !mapped(own) {
                let way = if output { "outputs" } else { "inputs" };
                let message = format!(
                    "an axis behind a gateway needs {} ({what}) in the `{way}` of its node",
                    esi::address(own, 0)
                );
                let hint =
                    "its mode is \"csp\": PDO 1 with Controlword and 0x2062, PDO 3 for the mode";
                p.add_hint(raw.span.clone(), message, hint);
                return;
            }
        }
        if let Some((cycle_ns, place)) = cycle
            && !self.setup.sync_ns.is_multiple_of(*cycle_ns)
        {
            let message = format!(
                "`sync` of {} is not a multiple of the cycle of {}",
                show(self.setup.sync_ns),
                show(*cycle_ns)
            );
            let at = device.can.sync.place().unwrap_or(place.clone());
            let hint = "axes behind a gateway step in every n-th cycle: change `sync` or `cycle`";
            p.add_hint(at, message, hint);
            return;
        }
        let setup = self.axis(n, axis, cycle.map_or(MS, |(cycle, _)| *cycle), p);
        self.axes.push(CheckedAxis {
            setup: setup.map(|setup| AxisSetup {
                name: name.get_ref().clone(),
                ..setup
            }),
            name: name.get_ref().clone(),
            brake_output: axis.brake.output.clone(),
        });
    }

    fn axis(
        &mut self,
        n: usize,
        raw: &RawAxis,
        cycle_ns: u64,
        p: &mut Problems<'_>,
    ) -> Option<AxisSetup> {
        let node = self.setup.nodes.get(n)?;
        let mut setup = axis::setup(raw, &[], esi::Mode::Csp, Some(&node.selection), p)?;
        setup.node = Some(n);
        // These drives do not serve Statusword bit 12 in position mode.
        setup.config.follows_bit = raw.follows_bit.value().unwrap_or(false);
        if raw.dead_time.is_none() {
            setup.config.dead_time_s = self.setup.dead_time_ns(cycle_ns) as f64 * 1e-9;
        }
        let simulated = self.simulated.nodes.get_mut(n)?;
        simulated.plant.counts_per_turn = setup.config.scale.counts_per_turn().round() as u32;
        // The gateway writes these objects when the node boots.
        let homing = setup.homing.iter().flat_map(|homing| &homing.startup);
        let objects = homing.map(|sdo| (sdo.index, sdo.sub, sdo.data.clone()));
        simulated.objects.extend(objects);
        Some(setup)
    }
}

#[cfg(test)]
#[path = "gateway_tests.rs"]
mod tests;
