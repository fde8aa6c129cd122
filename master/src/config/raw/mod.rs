//! The machine file as written. Types and ranges are checked; references are not resolved.

use toml::Spanned;
use toml::de::DeValue;

use ecaxis_axis::StopMethod;
use ecaxis_esi::Address;

use super::fields::{Domain, Field, Key, Ns, Read, Table, TableKey, Value, Written, unquoted};
use super::gateway::RawNode;
use super::problem::{Problems, Span};
use super::travel::RawTrack;
use super::{ExchangeMode, GroupStopScope, MailboxSource, SocketKind, Spin};

mod axis;
mod step;

pub(crate) use axis::{AxisTables, RawAxis, RawHoming, RawLimits};
pub(crate) use step::{
    Conditions, Named, RawAction, RawAxes, RawCondition, RawGear, RawProbe, RawSignal, RawStep,
    RawWave,
};

table! { "the machine file",
    table RawMachine {
        repeat: Key<u32> [1..=1_000_000],
        enable: Key<bool>,
        bus: RawBus = "[bus]\ncycle = \"1ms\"",
        devices: Vec<RawDevice> as "device" = "[[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"",
        copies: Vec<RawCopy> as "copy",
        stop: RawStop,
        server: RawServer,
        steps: Vec<RawStep> as "step",
    }
}

impl RawMachine {
    /// Reports unknown keys and tables of the top level only.
    pub fn check_keys(root: Value<'_>, p: &mut Problems<'_>) {
        let keys: Vec<TableKey> = Self::KEYS.iter().map(|(key, _)| (*key, None)).collect();
        if let Some(table) = Table::of(root, "the machine file", &keys, p) {
            table.done(p);
        }
    }
}

const MS: Ns = 1_000_000;
const S: Ns = 1000 * MS;

const IDLE_MODES: [(&str, bool); 2] = [("sleep", false), ("awake", true)];
const EXCHANGES: [(&str, ExchangeMode); 2] = [
    ("same-cycle", ExchangeMode::SameCycle),
    ("pipelined", ExchangeMode::Pipelined),
];
const LINKS: [(&str, SocketKind); 2] = [
    (SocketKind::Ring.name(), SocketKind::Ring),
    (SocketKind::Packet.name(), SocketKind::Packet),
];

const MAILBOXES: [(&str, MailboxSource); 2] = [
    ("esi", MailboxSource::Esi),
    ("eeprom", MailboxSource::Eeprom),
];

table! { "[bus]",
    table RawBus {
        nic: Key<String>,
        cycle: Key<Ns> [50_000..=100 * MS] = "\"1ms\"",
        lost_frames: Key<u32> [1..=1000],
        cpu: Key<u32> [0..=1023],
        priority: Key<u8> [1..=99],
        spin: Key<Spin>,
        /// `true` if `cpu` is kept awake.
        idle: Key<bool> [IDLE_MODES],
        op_timeout: Key<Ns> [MS..=600 * S],
        enable_timeout: Key<Ns> [MS..=600 * S],
        // The watchdog registers count 100 µs in 16 bits.
        watchdog: Key<Ns> [MS..=6553 * S + 500 * MS],
        clock_window: Key<Ns> [100..=S],
        sync_window: Key<Ns> [100..=S],
        sync_timeout: Key<Ns> [MS..=600 * S],
        exchange: Key<ExchangeMode> [EXCHANGES],
        link: Key<SocketKind> [LINKS],
    }
}

/// `"auto"`, a duration, or a plain 0.
impl Read for Spin {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        match value.get_ref() {
            DeValue::String(s) if s == "auto" => Some(Self::Auto),
            DeValue::Integer(i) if i.as_str() == "0" => Some(Self::For(0)),
            _ => Ns::read(value, key, p).map(Self::For),
        }
    }
}

table! { "[[device]]",
    table RawDevice {
        name: Key<String> = "\"x\"",
        esi: Key<String>,
        sii: Key<String>,
        mailbox: Key<MailboxSource> [MAILBOXES],
        position: Key<u16>,
        alias: Key<u16> [1..=u16::MAX],
        id: Key<u16> [1..=u16::MAX],
        type_name: Key<String> as "type",
        vendor: Key<u32>,
        product: Key<u32>,
        revision: Key<u32>,
        identity: Key<String>,
        serial: Key<u32>,
        mode: Key<String>,
        dc: Key<String>,
        /// A name for each slot, `-` for none.
        modules: Key<Vec<String>>,
        assignment: Key<String>,
        pdo: RawPdos,
        sdo: Vec<RawSdo>,
        /// The defaults for all start-up SDOs.
        startup: RawStartup,
        axes: AxisTables as "axis",
        sim: Option<RawSim>,
    }
}

table! { "`pdo`",
    table RawPdos {
        rx: Key<Vec<RawEntry>>,
        tx: Key<Vec<RawEntry>>,
    }
}

/// An object: `"0x607A:00"`, `"0x607A"` or `{ index = 0x607A, sub = 0 }`.
#[derive(Debug)]
pub(crate) struct RawEntry {
    pub span: Span,
    pub index: u16,
    pub sub: u8,
}

table! { "a PDO entry",
    row EntryTable {
        index: u16 [1..=u16::MAX] = "0x607A",
        sub: Option<u8>,
    }
}

impl Read for RawEntry {
    const LIST: &'static str = "a list of objects";

    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let span = value.span();
        let DeValue::String(text) = value.get_ref() else {
            let EntryTable { index, sub, .. } = EntryTable::read(value, key, p)?;
            let sub = sub.unwrap_or(0);
            return Some(Self { span, index, sub });
        };
        let (index, sub) = text.split_once(':').unwrap_or((text, "0"));
        let index = unquoted(index).and_then(|i| u16::try_from(i).ok());
        let (Some(index @ 1..), Some(sub)) = (index, Address::sub_of(sub)) else {
            let hint = "write index and subindex as \"0x607A:00\"";
            p.add_hint(span, "not an object", hint);
            return None;
        };
        Some(Self { span, index, sub })
    }
}

table! { "`sdo`",
    row RawSdo {
        index: u16 [1..=u16::MAX] = "0x6065",
        sub: Option<u8>,
        value: Spanned<SdoValue> = "2000",
        type_name: Key<String> as "type",
        verify: Option<bool>,
        skip_equal: Option<bool>,
    }
}

impl RawSdo {
    /// Returns the SDO as a drive with this axis alone has it; `None`: it belongs to another axis.
    pub fn of_axis(&self, axis: u16) -> Option<Self> {
        let index = match ecaxis_esi::axis::of(self.index) {
            Some((own, same)) => (own == axis).then_some(same)?,
            None => self.index,
        };
        Some(Self {
            index,
            span: self.span.clone(),
            written: Written::default(),
            sub: self.sub,
            value: self.value.clone(),
            type_name: self.type_name.clone(),
            verify: self.verify,
            skip_equal: self.skip_equal,
        })
    }

    pub fn address(&self) -> (u16, u8) {
        (self.index, self.sub.unwrap_or(0))
    }
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) enum SdoValue {
    Integer(i64),
    Float(f64),
    Boolean(bool),
    Text(String),
    Bytes(Vec<u8>),
}

impl Read for SdoValue {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        Some(match value.get_ref() {
            DeValue::Integer(_) => Self::Integer(i64::read(value, key, p)?),
            DeValue::Float(_) => Self::Float(f64::read(value, key, p)?),
            DeValue::Boolean(b) => Self::Boolean(*b),
            DeValue::Array(_) => Self::Bytes(Vec::read(value, key, p)?),
            _ => Self::Text(String::read(value, key, p)?),
        })
    }
}

table! { "`startup`",
    table RawStartup {
        verify: Option<bool>,
        skip_equal: Option<bool>,
    }
}

table! { "[device.sim]",
    table RawSim {
        after: Key<String>,
        port: Key<u8> [1..=3],
        cable: Key<Ns> [0..=MS],
        reversed: Key<bool>,
        drift_ppm: Key<f64>,
        offset: Key<Ns>,
        jitter: Key<Ns> [0..=MS],
        state_change: Key<Ns> [0..=60 * S],
        bit_rate: Key<u32>,
        sync: Key<Ns>,
        node: Vec<RawNode>,
        track: Option<RawTrack>,
    }
}

table! { "[[copy]]",
    table RawCopy {
        from: Key<String> = "\"io1.Input 1\"",
        to: Key<String> = "\"io2.Output 1\"",
    }
}

/// The stop methods of an axis.
pub(crate) const STOP_METHODS: [(&str, StopMethod); 3] = [
    ("quick-stop", StopMethod::QuickStop),
    ("ramp", StopMethod::Ramp),
    ("no-power", StopMethod::DisableVoltage),
];

/// The stop methods that a drive carries out by itself.
pub(crate) const STOPS_BY_DRIVE: [(&str, StopMethod); 2] = [
    ("quick-stop", StopMethod::QuickStop),
    ("no-power", StopMethod::DisableVoltage),
];

const OUTSIDE: [(&str, GroupStopScope); 2] = [
    ("stop", GroupStopScope::Stop),
    ("continue", GroupStopScope::Continue),
];

table! { "[stop]",
    table RawStop {
        others: Key<StopMethod> [STOP_METHODS],
        bus_lost: Key<StopMethod> [STOPS_BY_DRIVE],
        emergency: Option<Conditions>,
        groups: Vec<RawGroup> as "group",
    }
}

table! { "[server]",
    table RawServer {
        stale_cycles: Key<u32> [1..=1000],
        lease: Key<Ns> [100 * MS..=60 * S],
    }
}

table! { "[[stop.group]]",
    table RawGroup {
        name: Key<String> = "\"gantry\"",
        axes: Option<Names> = "[\"x\", \"y\"]",
        devices: Option<Names>,
        others: Key<StopMethod> [STOP_METHODS],
        outside: Key<GroupStopScope> [OUTSIDE],
    }
}

/// Names of devices, at least one.
#[derive(Debug)]
pub(crate) struct Names(pub Vec<Spanned<String>>);

impl Read for Names {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let names = Vec::read(value, key, p)?;
        if names.is_empty() {
            let hint = "write a list such as [\"x\", \"y\"]";
            p.add_hint(value.span(), "nothing is named here", hint);
        }
        Some(Self(names))
    }
}
