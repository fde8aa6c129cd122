//! Settings of a simulated gateway in `[device.sim]`: its network and its nodes.

use ecaxis_esi as esi;
use ecaxis_sim::gateway::{BIT_RATES, Epos, GatewayOptions, NodeOptions, PdoLink, Supervision};
use toml::Spanned;
use toml::de::DeValue;

use super::fields::{self, Fields};
use super::problem::{Problems, Span, list, suggestion};
use super::raw;

type Value<'d> = &'d Spanned<DeValue<'d>>;

const MS: u64 = 1_000_000;

/// The gateway as written. Each node has its place in the file.
#[derive(Debug)]
pub(crate) struct RawGateway {
    span: Span,
    options: GatewayOptions,
    nodes: Vec<(NodeOptions, Span)>,
    /// `true` if a mistake has been reported.
    wrong: bool,
}

/// Returns `None` if the table has no gateway keys.
pub(crate) fn read(f: &mut Fields<'_>, span: Span, p: &mut Problems<'_>) -> Option<RawGateway> {
    let mentioned = ["bit_rate", "sync", "node"]
        .into_iter()
        .any(|key| f.get(key).is_some());
    let before = p.count();
    let mut options = GatewayOptions::default();
    if let Some(rate) = f
        .get("bit_rate")
        .and_then(|v| fields::integer(p, v, 1, u32::MAX))
    {
        if !BIT_RATES.contains(rate.get_ref()) {
            let rates = BIT_RATES.iter().map(ToString::to_string);
            let hint = format!("bits a second: {}", rates.collect::<Vec<_>>().join(", "));
            p.add_hint(rate.span(), "no such bit rate", hint);
        }
        options.bit_rate = rate.into_inner();
    }
    if let Some(ns) = f.get("sync").and_then(|v| fields::duration(p, v)) {
        options.sync_period_us = u32::try_from(ns.into_inner() / 1000).unwrap_or(u32::MAX);
    }
    let nodes = f.get("node");
    let nodes = nodes.and_then(|v| fields::array(p, v, "[[device.sim.node]] with two brackets"));
    let mut read = Vec::new();
    for value in nodes.unwrap_or_default() {
        let table = fields::table(p, value, "[[device.sim.node]]");
        let node = table.and_then(|f| node(f, p));
        read.extend(node.map(|node| (node, value.span())));
    }
    mentioned.then(|| RawGateway {
        span,
        options,
        nodes: read,
        wrong: p.count() > before,
    })
}

fn node(mut f: Fields<'_>, p: &mut Problems<'_>) -> Option<NodeOptions> {
    let id = f.need("id", "id = 1");
    let id = id.and_then(|v| fields::integer(p, v, 1u8, 127));
    let drive = f.need("drive", "drive = \"EPOS 24/5\"");
    let drive = drive.and_then(|v| {
        let name = fields::string(p, v)?;
        let found = Epos::from_name(name.get_ref());
        if found.is_none() {
            let names = || Epos::ALL.iter().map(|drive| drive.name());
            let hint = suggestion(name.get_ref(), names(), "drives");
            p.add_hint(
                name.span(),
                format!("unknown drive `{}`", name.get_ref()),
                hint,
            );
        }
        found
    });
    let heartbeat = f.get("heartbeat").and_then(|v| milliseconds(p, v));
    let mandatory = f.get("mandatory").and_then(|v| fields::boolean(p, v));
    let inputs = links(&mut f, "inputs", p);
    let outputs = links(&mut f, "outputs", p);
    f.done(p);
    let mut node = NodeOptions::new(id?.into_inner(), drive?);
    if let Some(period_ms) = heartbeat {
        node.supervision = Supervision::Heartbeat { period_ms };
    }
    node.mandatory = mandatory.is_some_and(Spanned::into_inner);
    (node.inputs, node.outputs) = (inputs, outputs);
    Some(node)
}

fn milliseconds(p: &mut Problems<'_>, value: Value<'_>) -> Option<u16> {
    let ns = fields::duration(p, value)?;
    let ms = u16::try_from(ns.get_ref() / MS).ok().filter(|ms| *ms >= 10);
    if ms.is_none() {
        p.add(ns.span(), "a heartbeat takes 10 ms to 65 s");
    }
    ms
}

fn links(f: &mut Fields<'_>, key: &'static str, p: &mut Problems<'_>) -> Vec<PdoLink> {
    let values = f.get(key);
    let values = values.and_then(|v| fields::array(p, v, "a list of PDOs"));
    let mut links = Vec::new();
    for value in values.unwrap_or_default() {
        if let Some(f) = fields::table(p, value, "a PDO of a node") {
            links.extend(link(f, p));
        }
    }
    links
}

fn link(mut f: Fields<'_>, p: &mut Problems<'_>) -> Option<PdoLink> {
    let pdo = f.need("pdo", "pdo = 1");
    let pdo = pdo.and_then(|v| fields::integer(p, v, 1u8, 3));
    let at = f.need("at", "at = 2");
    let at = at.and_then(|v| fields::integer(p, v, 2u16, 511));
    let mut contents = Vec::new();
    if let Some(objects) = f.get("objects").and_then(|v| raw::read_entries(v, p)) {
        for entry in objects.into_inner() {
            match Epos::mappable_bits(entry.index, entry.sub) {
                Some(bits) => contents.push((entry.index, entry.sub, bits)),
                None => p.add(
                    entry.span,
                    format!("{} cannot be mapped", esi::address(entry.index, entry.sub)),
                ),
            }
        }
    }
    let synchronous = f.get("synchronous").and_then(|v| fields::boolean(p, v));
    f.done(p);
    Some(PdoLink {
        pdo: pdo?.into_inner(),
        at: at?.into_inner(),
        contents,
        synchronous: synchronous.is_none_or(Spanned::into_inner),
    })
}

/// Checks the gateway against its device, if known, and returns its options.
pub(crate) fn setup(
    raw: RawGateway,
    device: Option<&esi::Device>,
    p: &mut Problems<'_>,
) -> Option<GatewayOptions> {
    let mut options = raw.options;
    let mut wrong = raw.wrong;
    let device = device?;
    for (node, span) in raw.nodes {
        options.nodes.push(node);
        // Validated after each node, so that the error marks the right one.
        if !wrong && let Err(error) = options.validate(device) {
            p.add(span, error.to_string());
            wrong = true;
        }
    }
    if !ecaxis_sim::gateway::is_gateway(device) {
        let message = format!("`{}` is not a CANopen gateway", device.type_name);
        let hint = format!("a gateway carries bytes of {}", list(["0x2100", "0x2000"]));
        p.add_hint(raw.span, message, hint);
        return None;
    }
    (!wrong).then_some(options)
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
