//! Settings of a simulated gateway in `[device.sim]`: its network and its nodes.

use ecaxis_esi as esi;
use ecaxis_sim::gateway::{BIT_RATES, Epos, GatewayOptions, NodeOptions, PdoLink, Supervision};
use toml::Spanned;

use super::fields::{Domain, Field, Ns, Read, Table, TableKey, Value, Written};
use super::problem::{Problems, Span, list, suggestion};
use super::raw::{RawEntry, RawSim};
use super::schema::{self, Schema};

const MS: Ns = 1_000_000;

table! { "[[device.sim.node]]",
    row RawNode {
        /// CANopen node-ID (1 to 127)
        id: u8 [1..=127] = "1",
        /// Drive, such as "EPOS 24/5"
        drive: Spanned<Epos> = "\"EPOS 24/5\"",
        /// Period of the heartbeat (time, 10 ms to 65 s)
        heartbeat: Option<Heartbeat>,
        /// If true, the gateway needs the node (default false)
        mandatory: Option<bool>,
        /// PDOs from the node to the gateway
        inputs: Vec<RawLink>,
        /// PDOs from the gateway to the node
        outputs: Vec<RawLink>,
    }
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
        /// If true, the SYNC triggers the PDO (default true)
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

fn node(raw: &RawNode) -> NodeOptions {
    let mut node = NodeOptions::new(raw.id, *raw.drive.get_ref());
    if let Some(Heartbeat(period_ms)) = raw.heartbeat {
        node.supervision = Supervision::Heartbeat { period_ms };
    }
    node.mandatory = raw.mandatory.unwrap_or(false);
    let links = |links: &[RawLink]| links.iter().map(link).collect();
    (node.inputs, node.outputs) = (links(&raw.inputs), links(&raw.outputs));
    node
}

fn link(raw: &RawLink) -> PdoLink {
    let contents = raw.objects.iter();
    PdoLink {
        pdo: raw.pdo,
        at: raw.at,
        contents: contents
            .map(|&MappableObject(index, sub, bits)| (index, sub, bits))
            .collect(),
        synchronous: raw.synchronous.unwrap_or(true),
    }
}

/// Checks the gateway against its device and returns its options; `None` without gateway keys.
pub(crate) fn setup(
    raw: &RawSim,
    device: Option<&esi::Device>,
    p: &mut Problems<'_>,
) -> Option<GatewayOptions> {
    let keys = ["bit_rate", "sync", "node"];
    if !keys.iter().any(|key| raw.written.has(key)) {
        return None;
    }
    let mut options = GatewayOptions::default();
    if let Some(rate) = &raw.bit_rate {
        if BIT_RATES.contains(rate.get_ref()) {
            options.bit_rate = *rate.get_ref();
        } else {
            let rates = BIT_RATES.map(|rate| rate.to_string()).join(", ");
            let hint = format!("bits a second: {rates}");
            p.add_hint(rate.span(), "no such bit rate", hint);
        }
    }
    if let Some(ns) = &raw.sync {
        options.sync_period_us = u32::try_from(ns.get_ref() / 1000).unwrap_or(u32::MAX);
    }
    let device = device?;
    if !ecaxis_sim::gateway::is_gateway(device) {
        let message = format!("`{}` is not a CANopen gateway", device.type_name);
        let hint = format!("a gateway carries bytes of {}", list(["0x2100", "0x2000"]));
        p.add_hint(raw.span.clone(), message, hint);
        return None;
    }
    for raw in &raw.node {
        options.nodes.push(node(raw));
        // Validated after each node, so that the error marks the right one.
        if let Err(error) = options.validate(device) {
            p.add(raw.span.clone(), error.to_string());
            return None;
        }
    }
    Some(options)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::super::{ConfigError, parse};

    /// Returns the problems of the example gateway machine with one text replaced.
    fn broken(from: &str, to: &str) -> Vec<(String, String)> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/gateway.toml");
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains(from), "{from}");
        match parse(&path, &text.replacen(from, to, 1)) {
            Err(ConfigError::Problems(problems)) => problems
                .into_iter()
                .map(|problem| (problem.message, problem.hint.unwrap_or_default()))
                .collect(),
            other => panic!("{from} → {to}: {other:?}"),
        }
    }

    #[test]
    #[rustfmt::skip] // one row per mistake
    fn gateway_rejects_invalid_settings() {
        for (from, to, message, hint) in [
            ("\"EPOS 24/1\"", "\"EPOS 24/2\"", "unknown drive `EPOS 24/2`", "did you mean `EPOS 24/1`?"),
            ("id      = 1", "id = 16", "takes node numbers up to 15", ""),
            ("id      = 1", "id = 128", "a whole number from 1 to 127", ""),
            ("id        = 2", "id = 1", "node 1 is there twice", ""),
            ("drive   = \"EPOS 24/1\"\n", "", "`drive` is missing in [[device.sim.node]]", "EPOS 24/5"),
            ("at = 8", "at = 600", "a whole number from 2 to 511", ""),
            ("pdo = 2, at = 24", "pdo = 2, at = 60", "6 bytes at 60 do not lie", ""),
            ("pdo = 3, at = 18", "pdo = 4, at = 18", "a whole number from 1 to 3", ""),
            ("\"0x6041\", \"0x6064\"", "\"0x6042\"", "0x6042:00 cannot be mapped", ""),
            ("\"0x6041\", \"0x6064\"", "\"0x6040\"", "0x6040:00 with 16 bits cannot be mapped", ""),
            ("bit_rate = 1_000_000", "bit_rate = 9600", "no such bit rate", "500000"),
            ("heartbeat = \"50ms\"", "heartbeat = \"1ms\"", "10 ms to 65 s", ""),
            ("mandatory =", "mandatry =", "unknown key `mandatry`", "did you mean `mandatory`?"),
            ("[device.axis]", "[device.sim]\nbit_rate = 1_000_000\n[device.axis]", "`EPOS4` is not a CANopen gateway", "0x2100"),
        ] {
            let found = broken(from, to);
            let [(said, hinted)] = found.as_slice() else {
                panic!("{from} → {to}: {found:?}")
            };
            assert!(said.contains(message) && hinted.contains(hint), "{said}: {hinted}");
        }
    }
}
