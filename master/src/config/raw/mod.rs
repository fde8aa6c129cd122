//! The machine file as written. Types are checked; references are not resolved.

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use ecaxis_esi::Address;

use super::fields::{self, Fields};
use super::problem::{Problems, Span};
use super::sim::{self, RawSim};

/// Reads `$field` with one of the readers of [`fields`] if it is present.
macro_rules! optional {
    ($p:expr, $f:expr, $key:literal, $($reader:tt)+) => {
        match $f.get($key) {
            Some(v) => optional!(@ $p, v, $($reader)+),
            None => None,
        }
    };
    (@ $p:expr, $v:expr, integer($min:expr, $max:expr)) => { fields::integer($p, $v, $min, $max) };
    (@ $p:expr, $v:expr, $reader:ident) => { fields::$reader($p, $v) };
}

mod axis;
mod motion;
mod step;
mod stop;

pub(crate) use axis::{RawAxis, RawHoming, RawLimits, RawLoops};
pub(crate) use motion::RawProbe;
pub(crate) use step::{RawAction, RawCondition, RawSignal, RawStep, RawTarget};
pub(crate) use stop::{RawGroup, RawStop};

#[derive(Debug, Default)]
pub(crate) struct RawMachine {
    pub bus: RawBus,
    pub devices: Vec<RawDevice>,
    pub stop: RawStop,
    pub steps: Vec<RawStep>,
    pub repeat: Option<Spanned<u32>>,
    pub enable: Option<Spanned<bool>>,
}

#[derive(Debug, Default)]
pub(crate) struct RawBus {
    pub nic: Option<Spanned<String>>,
    pub cycle: Option<Spanned<u64>>,
    pub lost_frames: Option<Spanned<u32>>,
    pub cpu: Option<Spanned<u32>>,
    pub priority: Option<Spanned<u8>>,
    /// An inner `None` means `"auto"`.
    pub spin: Option<Spanned<Option<u64>>>,
    pub idle: Option<Spanned<String>>,
    pub op_timeout: Option<Spanned<u64>>,
    pub enable_timeout: Option<Spanned<u64>>,
    pub watchdog: Option<Spanned<u64>>,
    pub clock_window: Option<Spanned<u64>>,
    pub exchange: Option<Spanned<String>>,
    pub link: Option<Spanned<String>>,
    /// Keys that are present, each with its line.
    pub written: Vec<(&'static str, u32)>,
}

#[derive(Debug)]
pub(crate) struct RawDevice {
    pub span: Span,
    pub name: Option<Spanned<String>>,
    pub esi: Option<Spanned<String>>,
    /// `true` if a locator is present, valid or not.
    pub placed: bool,
    pub position: Option<Spanned<u16>>,
    pub alias: Option<Spanned<u16>>,
    pub id: Option<Spanned<u16>>,
    pub type_name: Option<Spanned<String>>,
    pub vendor: Option<Spanned<u32>>,
    pub product: Option<Spanned<u32>>,
    pub revision: Option<Spanned<u32>>,
    pub identity: Option<Spanned<String>>,
    pub serial: Option<Spanned<u32>>,
    pub mode: Option<Spanned<String>>,
    pub dc: Option<Spanned<String>>,
    pub modules: Option<Spanned<Vec<String>>>,
    pub assignment: Option<Spanned<String>>,
    pub rx: Option<Spanned<Vec<RawEntry>>>,
    pub tx: Option<Spanned<Vec<RawEntry>>>,
    pub sdo: Vec<RawSdo>,
    /// `startup`: the defaults for all start-up SDOs.
    pub startup: RawStartup,
    pub axis: Option<RawAxis>,
    pub sim: Option<RawSim>,
}

#[derive(Debug)]
pub(crate) struct RawEntry {
    pub span: Span,
    pub index: u16,
    pub sub: u8,
}

#[derive(Debug)]
pub(crate) struct RawSdo {
    pub span: Span,
    pub index: u16,
    pub sub: u8,
    pub value: Spanned<SdoValue>,
    pub type_name: Option<Spanned<String>>,
    pub startup: RawStartup,
}

/// What is done in addition to writing; `None`: not in the file.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RawStartup {
    pub verify: Option<bool>,
    pub skip_equal: Option<bool>,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) enum SdoValue {
    Integer(i64),
    Float(f64),
    Boolean(bool),
    Text(String),
    Bytes(Vec<u8>),
}

type Value<'d> = &'d Spanned<DeValue<'d>>;

/// Reports unknown tables and keys of the whole file.
pub(crate) fn names(document: &Spanned<DeTable<'_>>, p: &mut Problems<'_>) {
    let mut f = Fields::new(document.get_ref(), 0..0, "the machine file");
    for known in ["repeat", "enable", "bus", "device", "stop", "step"] {
        let _ = f.get(known);
    }
    f.done(p);
}

pub(crate) fn read(document: &Spanned<DeTable<'_>>, p: &mut Problems<'_>) -> RawMachine {
    let mut f = Fields::new(document.get_ref(), 0..0, "the machine file");
    let mut machine = RawMachine {
        repeat: optional!(p, f, "repeat", integer(1, 1_000_000)),
        enable: optional!(p, f, "enable", boolean),
        ..RawMachine::default()
    };
    let bus = f.need("bus", "[bus]\ncycle = \"1ms\"");
    if let Some(bus) = bus.and_then(|v| fields::table(p, v, "[bus]")) {
        machine.bus = read_bus(bus, p);
    }
    let devices = f.need(
        "device",
        "[[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"",
    );
    for (value, span) in tables(p, devices, "[[device]]") {
        let Some(fields) = fields::table(p, value, "[[device]]") else {
            continue;
        };
        machine.devices.push(read_device(fields, span, p));
    }
    if let Some(value) = f.get("stop")
        && let Some(fields) = fields::table(p, value, "[stop]")
    {
        machine.stop = stop::read(fields, p);
    }
    let steps = f.get("step");
    for (value, span) in tables(p, steps, "[[step]]") {
        let Some(fields) = fields::table(p, value, "[[step]]") else {
            continue;
        };
        machine.steps.extend(step::read(fields, span, p));
    }
    f.done(p);
    machine
}

/// Returns the tables of an array of tables.
fn tables<'d>(
    p: &mut Problems<'_>,
    value: Option<Value<'d>>,
    wanted: &str,
) -> Vec<(Value<'d>, Span)> {
    let elements = value.and_then(|v| fields::array(p, v, &format!("{wanted} with two brackets")));
    elements
        .unwrap_or_default()
        .into_iter()
        .map(|v| (v, v.span()))
        .collect()
}

fn read_bus(mut f: Fields<'_>, p: &mut Problems<'_>) -> RawBus {
    let cycle = f.need("cycle", "cycle = \"1ms\"");
    let mut bus = RawBus {
        nic: optional!(p, f, "nic", string),
        cycle: cycle.and_then(|v| fields::duration(p, v)),
        lost_frames: optional!(p, f, "lost_frames", integer(1, 1000)),
        cpu: optional!(p, f, "cpu", integer(0, 1023)),
        priority: optional!(p, f, "priority", integer(1, 99)),
        spin: f.get("spin").and_then(|v| spin(p, v)),
        idle: optional!(p, f, "idle", string),
        op_timeout: optional!(p, f, "op_timeout", duration),
        enable_timeout: optional!(p, f, "enable_timeout", duration),
        watchdog: optional!(p, f, "watchdog", duration),
        clock_window: optional!(p, f, "clock_window", duration),
        exchange: optional!(p, f, "exchange", string),
        link: optional!(p, f, "link", string),
        written: Vec::new(),
    };
    bus.written = f.written(p);
    f.done(p);
    bus
}

/// Reads `"auto"`, a duration, or a plain 0.
fn spin(p: &mut Problems<'_>, value: Value<'_>) -> Option<Spanned<Option<u64>>> {
    match value.get_ref() {
        DeValue::String(s) if s == "auto" => Some(Spanned::new(value.span(), None)),
        DeValue::Integer(i) if i.as_str() == "0" => Some(Spanned::new(value.span(), Some(0))),
        _ => {
            let time = fields::duration(p, value)?;
            Some(Spanned::new(time.span(), Some(time.into_inner())))
        }
    }
}

fn read_device(mut f: Fields<'_>, span: Span, p: &mut Problems<'_>) -> RawDevice {
    let name = f.need("name", "name = \"x\"");
    let esi = f.need("esi", "esi = \"esi/EPOS4.xml\"");
    let placed = ["position", "alias", "id"]
        .into_iter()
        .any(|key| f.get(key).is_some());
    let mut device = RawDevice {
        span,
        placed,
        name: name.and_then(|v| fields::string(p, v)),
        esi: esi.and_then(|v| fields::string(p, v)),
        position: optional!(p, f, "position", integer(0, u16::MAX)),
        alias: optional!(p, f, "alias", integer(1, u16::MAX)),
        id: optional!(p, f, "id", integer(1, u16::MAX)),
        type_name: optional!(p, f, "type", string),
        vendor: optional!(p, f, "vendor", integer(0, u32::MAX)),
        product: optional!(p, f, "product", integer(0, u32::MAX)),
        revision: optional!(p, f, "revision", integer(0, u32::MAX)),
        identity: optional!(p, f, "identity", string),
        serial: optional!(p, f, "serial", integer(0, u32::MAX)),
        mode: optional!(p, f, "mode", string),
        dc: optional!(p, f, "dc", string),
        modules: f.get("modules").and_then(|v| read_modules(v, p)),
        assignment: optional!(p, f, "assignment", string),
        rx: None,
        tx: None,
        sdo: Vec::new(),
        startup: RawStartup::default(),
        axis: None,
        sim: None,
    };
    if let Some(mut pdo) = f.get("pdo").and_then(|v| fields::table(p, v, "`pdo`")) {
        device.rx = pdo.get("rx").and_then(|v| read_entries(v, p));
        device.tx = pdo.get("tx").and_then(|v| read_entries(v, p));
        pdo.done(p);
    }
    if let Some(value) = f.get("startup")
        && let Some(mut startup) = fields::table(p, value, "`startup`")
    {
        device.startup = read_startup(&mut startup, p);
        startup.done(p);
    }
    let sdos = f
        .get("sdo")
        .and_then(|v| fields::array(p, v, "a list of SDOs"));
    for value in sdos.unwrap_or_default() {
        let Some(fields) = fields::table(p, value, "`sdo`") else {
            continue;
        };
        device.sdo.extend(read_sdo(fields, value.span(), p));
    }
    if let Some(value) = f.get("axis") {
        let fields = fields::table(p, value, "[device.axis]");
        device.axis = fields.map(|f| axis::read(f, value.span(), p));
    }
    if let Some(value) = f.get("sim") {
        let fields = fields::table(p, value, "[device.sim]");
        device.sim = fields.map(|f| sim::read(f, value.span(), p));
    }
    f.done(p);
    device
}

/// Reads one name per slot.
fn read_modules(value: Value<'_>, p: &mut Problems<'_>) -> Option<Spanned<Vec<String>>> {
    let names = fields::array(p, value, "a list of modules, one a slot, \"-\" for none")?;
    let names = names.into_iter().map(|v| fields::string(p, v));
    let names: Option<Vec<_>> = names.map(|name| name.map(Spanned::into_inner)).collect();
    Some(Spanned::new(value.span(), names?))
}

/// Reads objects as `"0x607A:00"`, `"0x607A"` or `{ index = 0x607A, sub = 0 }`.
pub(crate) fn read_entries(
    value: Value<'_>,
    p: &mut Problems<'_>,
) -> Option<Spanned<Vec<RawEntry>>> {
    let all = value.span();
    let mut entries = Vec::new();
    for value in fields::array(p, value, "a list of objects")? {
        let span = value.span();
        let DeValue::String(text) = value.get_ref() else {
            let Some(mut f) = fields::table(p, value, "a PDO entry") else {
                continue;
            };
            let index = f.need("index", "index = 0x607A");
            let index = index.and_then(|v| fields::integer(p, v, 1, u16::MAX));
            let sub = optional!(p, f, "sub", integer(0, u8::MAX));
            f.done(p);
            if let Some(index) = index {
                let sub = sub.map_or(0, Spanned::into_inner);
                entries.push(RawEntry {
                    span,
                    index: index.into_inner(),
                    sub,
                });
            }
            continue;
        };
        let (index, sub) = text.split_once(':').unwrap_or((text, "0"));
        let sub = Address::sub_of(sub);
        let index = fields::unquoted(index)
            .and_then(|i| u16::try_from(i).ok())
            .filter(|i| *i > 0);
        match (index, sub) {
            (Some(index), Some(sub)) => entries.push(RawEntry { span, index, sub }),
            _ => p.add_hint(
                span,
                "not an object",
                "write index and subindex as \"0x607A:00\"",
            ),
        }
    }
    Some(Spanned::new(all, entries))
}

fn read_startup(f: &mut Fields<'_>, p: &mut Problems<'_>) -> RawStartup {
    RawStartup {
        verify: optional!(p, f, "verify", boolean).map(Spanned::into_inner),
        skip_equal: optional!(p, f, "skip_equal", boolean).map(Spanned::into_inner),
    }
}

fn read_sdo(mut f: Fields<'_>, span: Span, p: &mut Problems<'_>) -> Option<RawSdo> {
    let index = f.need("index", "index = 0x6065");
    let index = index.and_then(|v| fields::integer(p, v, 1, u16::MAX));
    let sub = optional!(p, f, "sub", integer(0, u8::MAX));
    let type_name = optional!(p, f, "type", string);
    let startup = read_startup(&mut f, p);
    let value = f.need("value", "value = 2000").and_then(|v| {
        let read = match v.get_ref() {
            DeValue::Integer(_) => {
                SdoValue::Integer(fields::integer(p, v, i64::MIN, i64::MAX)?.into_inner())
            }
            DeValue::Float(_) => SdoValue::Float(fields::number(p, v)?.into_inner()),
            DeValue::Boolean(b) => SdoValue::Boolean(*b),
            DeValue::Array(_) => {
                let bytes = fields::array(p, v, "a list of bytes")?;
                let bytes = bytes.into_iter().map(|b| fields::integer(p, b, 0, u8::MAX));
                SdoValue::Bytes(
                    bytes
                        .map(|b| b.map(Spanned::into_inner))
                        .collect::<Option<_>>()?,
                )
            }
            _ => SdoValue::Text(fields::string(p, v)?.into_inner()),
        };
        Some(Spanned::new(v.span(), read))
    });
    f.done(p);
    let sub = sub.map_or(0, Spanned::into_inner);
    Some(RawSdo {
        span,
        index: index?.into_inner(),
        sub,
        value: value?,
        type_name,
        startup,
    })
}
