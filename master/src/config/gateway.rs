//! A CANopen gateway: its CAN network, the nodes on it and their axes. The same tables describe the
//! simulated network.
//!
//! The configuration tool of the gateway decides where the PDOs of a node lie in its process data.
//! The file repeats that: a node gets a process data layout of its own, with offsets in the
//! gateway's process data. Its axis is then an axis like any other.

use std::path::Path;

use ecaxis_esi as esi;
use ecaxis_esi::layout::{Field as ObjectField, Layout};
use ecaxis_sim::gateway::{BIT_RATES, Epos, GatewayOptions, NodeOptions, PdoLink, Supervision};
use toml::Spanned;

use super::device::CheckedAxis;
use super::duration::show;
use super::fields::{Domain, Field, Key, KeyExt, Ns, Read, Table, TableKey, Value, Written};
use super::problem::{Problems, Span, list};
use super::raw::{AxisTables, RawAxis, RawDevice, RawSdo};
use super::schema::{self, Schema};
use super::{AxisSetup, axis, sdo};

mod eds;
mod load;
mod mode;
mod values;

use eds::Eds;
use load::{MAX_LOAD, load};
pub(crate) use values::{Heartbeat, MappableObject};

const MS: Ns = 1_000_000;

table! { "[device.can]",
    table RawCan {
        /// Bit rate (bit/s; default 1,000,000)
        bit_rate: Key<u32>,
        /// Period of the gateway's SYNC, whole cycles; the axes step with it (time, 1 ms to 100 ms;
        /// default `"4ms"`)
        sync: Key<Ns> [MS..=100 * MS],
        /// Input data of the gateway with its status word, as in 0x3000 (bytes, 2 to 512; default as
        /// in the ESI)
        inputs: Key<u16> [2..=512],
        /// Output data of the gateway with its control word, as in 0x3001 (bytes, 2 to 512; default
        /// as in the ESI)
        outputs: Key<u16> [2..=512],
        /// Node-ID of the gateway (1 to 127; default 99)
        node_id: Key<u8> [1..=127],
        /// Period of the gateway's own heartbeat (time, 10 ms to 65 s, `"0ms"` for none; default `"0ms"`)
        heartbeat: Option<Heartbeat>,
        /// Start-up behaviour as in 0x1F80: bit 0 is the NMT master, bit 3 leaves the start of the
        /// nodes to ecaxis (0 to 127; default 1)
        start_up: Key<u8> [0..=127],
        /// Further objects of the simulated gateway, as `[[device.sdo]]` (list of tables; default
        /// none)
        objects: Vec<RawSdo>,
    }
}

table! { "[[device.node]]",
    row RawNode {
        /// CANopen node-ID (1 to 127)
        id: u8 [1..=127] = "1",
        /// Model of the drive (`"EPOS 24/1"`, `"EPOS 24/5"`, `"EPOS 70/10"`)
        drive: Spanned<Epos> = "\"EPOS 24/5\"",
        /// EDS file of the drive: contents of PDOs that the file does not list, and objects that a PDO
        /// can carry (path; default as in the vendor's application note)
        eds: Option<Spanned<String>>,
        /// Mode of operation of its axis (`"csp"`, `"pp"`; default `"csp"`)
        mode: Option<Spanned<String>>,
        /// Period of the heartbeat (time, 10 ms to 65 s, `"0ms"` for none; default `"50ms"`)
        heartbeat: Option<Heartbeat>,
        /// Period of node guarding, instead of a heartbeat (time, 10 ms to 65 s; default none)
        guarding: Option<Heartbeat>,
        /// Unanswered requests of node guarding until the node is missing (1 to 255; default 3)
        retries: Option<u8>,
        /// If true, the gateway starts its network with this node only (true, false; default false)
        mandatory: Option<bool>,
        /// If true, the gateway configures and starts the node when it comes back, as in 0x1F81 bit 2
        /// (true, false; default true)
        restart: Option<bool>,
        /// If true, the gateway resets the node to factory values first, as in 0x1F81 bit 7 (true,
        /// false; default false)
        factory: Option<bool>,
        /// If true, the drive has no number at its switches; the gateway assigns `id` by layer setting
        /// services (true, false; default false)
        lss: Option<bool>,
        /// Expected date and time of the node's configuration, as in 0x1F26 and 0x1F27 (two numbers;
        /// default none: always configured)
        configured: Option<[u32; 2]>,
        /// Further objects that the gateway writes to the node at boot, as `[[device.sdo]]` (list of
        /// tables; default none)
        objects: Vec<RawSdo>,
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
    /// The line of its `[[device.node]]` in the machine file.
    pub line: u32,
    /// The model of the drive.
    pub drive: &'static str,
    /// The gateway's selection with the process data of this node alone. Objects that do the work
    /// of an object of CiA 402 have its index.
    pub selection: esi::Selection,
    /// The PDOs: first byte in the gateway's process data, number, objects as mapped.
    pub outputs: Vec<PdoLink>,
    pub inputs: Vec<PdoLink>,
    /// The objects that the drive must hold: index, subindex, value. The configuration tool of the
    /// gateway writes them.
    pub objects: Vec<(u16, u8, Vec<u8>)>,
}

/// A gateway's network, checked, with the axes of its nodes.
pub(super) struct CheckedNetwork {
    pub setup: GatewaySetup,
    pub simulated: GatewayOptions,
    pub axes: Vec<CheckedAxis>,
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
    fn new(node: &NodeOptions, gateway: &esi::Selection, line: u32) -> Self {
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
            line,
            drive: node.drive.name(),
            selection,
            outputs,
            inputs,
            objects: Vec::new(),
        }
    }
}

/// Returns the device with the data sizes of the file.
pub(super) fn with_sizes(raw: &RawDevice, device: &esi::Device) -> Option<esi::Device> {
    let (inputs, outputs) = (raw.can.inputs.value(), raw.can.outputs.value());
    if inputs.or(outputs).is_none() || !ecaxis_sim::gateway::is_gateway(device) {
        return None;
    }
    let known = ecaxis_sim::gateway::default_sizes(device);
    let (inputs, outputs) = (inputs.unwrap_or(known.0), outputs.unwrap_or(known.1));
    Some(ecaxis_sim::gateway::with_sizes(device, inputs, outputs))
}

/// Returns objects that the configuration tool writes.
fn objects(raw: &[RawSdo], p: &mut Problems<'_>) -> Vec<(u16, u8, Vec<u8>)> {
    let mut objects = Vec::new();
    for raw in raw {
        let name = raw.type_name.as_ref().map(|name| name.get_ref().as_str());
        match sdo::encode(raw.value.get_ref(), name, None) {
            Ok(data) => objects.push((raw.index, raw.sub.unwrap_or(0), data)),
            Err((message, hint)) => {
                let hint = hint.unwrap_or("give its type: `type = \"u32\"`".to_owned());
                p.add_hint(raw.value.span(), message, hint);
            }
        }
    }
    objects
}

/// Checks the gateway's network. Returns `None` without one, or if it is invalid and reported.
/// `cycle`: the bus cycle and its place.
pub(super) fn check(
    raw: &RawDevice,
    device: Option<&esi::Device>,
    selection: Option<&mut esi::Selection>,
    cycle: Option<&(u64, Span)>,
    folder: &Path,
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
    (simulated.input_size, simulated.output_size) =
        (raw.can.inputs.value(), raw.can.outputs.value());
    simulated.node_id = raw.can.node_id.value().unwrap_or(simulated.node_id);
    simulated.heartbeat_ms = raw.can.heartbeat.as_ref().map_or(0, |period| period.0);
    simulated.start_up = raw.can.start_up.value().map_or(1, u32::from);
    simulated.objects = objects(&raw.can.objects, p);
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
        node.supervision = match &raw.guarding {
            Some(Heartbeat(0)) => Supervision::None,
            Some(Heartbeat(period_ms)) => Supervision::Guarding {
                period_ms: *period_ms,
                retries: raw.retries.unwrap_or(3).max(1),
            },
            None if period_ms == 0 => Supervision::None,
            None => Supervision::Heartbeat { period_ms },
        };
        if let (Some(_), Some(_)) = (&raw.guarding, &raw.heartbeat) {
            let message = "a node has either a heartbeat or node guarding";
            p.add_hint(
                raw.span.clone(),
                message,
                "leave `heartbeat` or `guarding` out",
            );
        }
        node.mandatory = raw.mandatory.unwrap_or(false);
        node.restart = raw.restart.unwrap_or(true);
        node.factory = raw.factory.unwrap_or(false);
        node.lss = raw.lss.unwrap_or(false);
        node.configured = raw.configured.unwrap_or_default();
        node.objects = objects(&raw.objects, p);
        node.inputs = raw.inputs.iter().map(|raw| link(raw, true)).collect();
        node.outputs = raw.outputs.iter().map(|raw| link(raw, false)).collect();
        complete(&mut node, raw, folder, p)?;
        let setup = NodeSetup::new(&node, selection, p.line(&raw.span));
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

/// Completes the PDOs of a node by its EDS.
fn complete(
    node: &mut NodeOptions,
    raw: &RawNode,
    folder: &Path,
    p: &mut Problems<'_>,
) -> Option<()> {
    let Some(name) = &raw.eds else {
        return Some(());
    };
    let path = folder.join(name.get_ref());
    let eds = Eds::read(&path, &mut p.files);
    let eds = eds.map_err(|(message, hint)| p.add_hint(name.span(), message, hint));
    let eds = eds.ok()?;
    let outputs = node.outputs.iter_mut().zip(&raw.outputs);
    let inputs = node.inputs.iter_mut().zip(&raw.inputs);
    let links = outputs.map(|pair| (pair, 0x1600));
    for ((link, raw), first) in links.chain(inputs.map(|pair| (pair, 0x1a00))) {
        if let Err(error) = eds.complete(link, first) {
            let message = format!("{}: {error}", path.display());
            let hint = "compare with the PDO mapping in the drive's documents";
            p.add_hint(raw.span.clone(), message, hint);
            return None;
        }
    }
    Some(())
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
        if self.simulated.start_up & 1 == 0 {
            let at = device.can.start_up.place().unwrap_or(raw.span.clone());
            let message = "an axis behind a gateway needs the gateway as the NMT master";
            p.add_hint(at, message, "set bit 0: `start_up = 1`");
            return;
        }
        let simulated = self.simulated.nodes.get(n);
        if simulated.is_some_and(|node| node.supervision == Supervision::None) {
            let message = "an axis behind a gateway needs error control of its node";
            let hint = "without it, nothing reports a lost node: write `heartbeat = \"50ms\"`";
            p.add_hint(raw.span.clone(), message, hint);
            return;
        }
        let Some(mode) = mode::start(raw, node, p) else {
            return;
        };
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
        let cycle_ns = cycle.map_or(MS, |(cycle, _)| *cycle);
        let setup = self.axis(n, axis, mode, cycle_ns, p);
        self.axes.push(CheckedAxis {
            setup: setup.map(|setup| AxisSetup {
                name: name.get_ref().clone(),
                ..setup
            }),
            name: name.get_ref().clone(),
            brake_output: axis.brake.output.clone(),
            compensation: axis.compensation.clone(),
            second_encoder: axis.second_encoder.clone(),
        });
    }

    fn axis(
        &mut self,
        n: usize,
        raw: &RawAxis,
        mode: esi::Mode,
        cycle_ns: u64,
        p: &mut Problems<'_>,
    ) -> Option<AxisSetup> {
        let node = self.setup.nodes.get(n)?;
        let mut setup = axis::setup(raw, &[], mode, Some(&node.selection), p)?;
        setup.node = Some(n);
        mode::adopt_units(&mut setup);
        setup.config.modes = mode::modes(node, setup.config.mode);
        setup.config.profile_fixed = true;
        // These drives do not serve Statusword bit 12 in position mode.
        setup.config.follows_bit = raw.follows_bit.value().unwrap_or(false);
        if raw.dead_time.is_none() {
            setup.config.dead_time_s = self.setup.dead_time_ns(cycle_ns) as f64 * 1e-9;
        }
        let objects = mode::objects(&setup);
        self.setup.nodes.get_mut(n)?.objects.clone_from(&objects);
        let simulated = self.simulated.nodes.get_mut(n)?;
        simulated.plant.counts_per_turn = setup.config.scale.counts_per_turn().round() as u32;
        // The gateway writes these objects when the node boots.
        simulated.objects.extend(objects);
        Some(setup)
    }
}

#[cfg(test)]
#[path = "gateway_tests.rs"]
mod tests;
