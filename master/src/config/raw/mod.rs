//! The machine file as written. Types and ranges are checked; references are not resolved.

use toml::Spanned;
use toml::de::DeValue;

use ecaxis_axis::StopMethod;
use ecaxis_axis::setpoint::CamLaw;
use ecaxis_ecat::mailbox::soe::Idn;
use ecaxis_esi::Address;

use super::fields::{Domain, Field, Key, Ns, Read, Table, TableKey, Value, Written, unquoted};
use super::gateway::{RawCan, RawNode};
use super::problem::{Problems, Span};
use super::schema::{self, Schema, any_of};
use super::sim_motor::RawMotor;
use super::sim_quirks::RawQuirks;
use super::subprograms::RawSub;
use super::travel::RawTrack;
use super::{
    CommonTimeUse, ExchangeMode, GroupStopScope, MailboxSource, SocketKind, Spin,
    UnknownDeviceRule, WatchdogTrigger,
};

mod axis;
mod condition;
mod eoe;
mod line_shaft;
mod number;
mod path;
mod server;
mod startup;
mod step;

pub(crate) use axis::{
    AxisTables, RawAxis, RawCompensation, RawHoming, RawLimits, RawSecondEncoder,
};
pub(crate) use condition::{Conditions, Levels, NamedValues, RawCondition, RawSignal, RawWhen};
pub(crate) use eoe::{RawDeviceEoe, RawEoe};
pub(crate) use line_shaft::RawLineShaft;
pub(crate) use number::{RawNumber, RawVariable};
pub(crate) use path::{RawPath, RawPoint};
pub(crate) use server::{RawMailboxGateway, RawServer};
pub(crate) use startup::{RawIdn, RawStartup};
pub(crate) use step::{Named, RawAction, RawAxes, RawGear, RawProbe, RawStep, RawWave, TimeLimit};

table! { "the machine file",
    table RawMachine {
        /// Number of runs of the program (1 to 1,000,000; default 1)
        repeat: Key<u32> [1..=1_000_000],
        /// If false, the axes get no power, and the bus stays in Op; `ecaxis run --enable`
        /// overrides it (true, false; default true)
        enable: Key<bool>,
        /// Network interface and cycle
        bus: RawBus = "[bus]\ncycle = \"1ms\"",
        /// A SubDevice: position, ESI file, mode, process data, start-up SDOs
        devices: Vec<RawDevice> as "device" = "[[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"",
        /// Two axes that move as one
        gantries: Vec<RawGantry> as "gantry",
        /// Cams that steps `gear` name
        cams: Vec<RawCam> as "cam",
        /// Master axes on other machines that steps `gear` name
        line_shafts: Vec<RawLineShaft> as "line_shaft",
        /// Lines and arcs of several axes that steps `path` name
        paths: Vec<RawPath> as "path",
        /// Outputs that are on at positions of an axis
        position_outputs: Vec<RawPositionOutput> as "position_output",
        /// Inputs of one device that become outputs of another
        copies: Vec<RawCopy> as "copy",
        /// How the machine stops
        stop: RawStop,
        /// Speed of all motions, and their hold
        overrides: RawOverride as "override",
        /// Clients of `ecaxis serve`
        server: RawServer,
        /// Mailboxes for other vendors' tools
        mailbox_gateway: Option<RawMailboxGateway>,
        /// Ethernet of the devices (EoE) as a network interface of this computer
        eoe: Option<RawEoe>,
        /// The simulated bus: inputs that are switched by time
        sim: RawSimulation,
        /// Names of inputs and outputs, `start = "io.Input 1"`
        signals: NamedValues<String>,
        /// Variables of the program with their values at its start, `parts = 0`
        variables: NamedValues<RawVariable>,
        /// Inputs that pause the program
        program: RawProgram,
        /// Steps with a name and parameters
        subs: Vec<RawSub> as "sub",
        /// The program: one verb for each step
        steps: Vec<RawStep> as "step",
    }
}

table! { "[program]",
    table RawProgram {
        /// Condition while which no step begins, `{ hold = true }` (table; default none)
        pause: Key<RawWhen>,
        /// Condition that lets one step of the paused program begin when it becomes true (table; default none)
        step: Key<RawWhen>,
    }
}

table! { "[sim]",
    table RawSimulation {
        /// Inputs that are switched, `{ at = "2s", set = { start = true } }` (list of tables; default none)
        inputs: Vec<RawInput>,
    }
}

table! { "an input of [sim]",
    table RawInput {
        /// Time since the bus got its power (time; default 0)
        at: Key<Ns>,
        /// Time after which the inputs are 0 again (time; default never)
        duration: Key<Ns> as "for",
        /// Inputs and their values, as in a step `set`
        set: Levels,
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
const COMMON_TIMES: [(&str, CommonTimeUse); 2] = [
    ("measure", CommonTimeUse::Measure),
    ("align", CommonTimeUse::Align),
];
const LINKS: [(&str, SocketKind); 2] = [
    (SocketKind::Ring.name(), SocketKind::Ring),
    (SocketKind::Packet.name(), SocketKind::Packet),
];
const UNKNOWN_DEVICES: [(&str, UnknownDeviceRule); 2] = [
    ("close", UnknownDeviceRule::Close),
    ("report", UnknownDeviceRule::Report),
];

const TRIGGERS: [(&str, WatchdogTrigger); 2] = [
    ("required", WatchdogTrigger::Required),
    ("esi", WatchdogTrigger::Esi),
];

const MAILBOXES: [(&str, MailboxSource); 2] = [
    ("esi", MailboxSource::Esi),
    ("eeprom", MailboxSource::Eeprom),
];

table! { "[bus]",
    table RawBus {
        /// Network interface, or `"sim"` for the simulated bus (text; default `"sim"`)
        nic: Key<String>,
        /// Cable redundancy: the interface at the other end of the ring; any other name on the simulated
        /// bus (text; default none)
        redundant: Key<String>,
        /// Time from frame to frame; also 0x60C2 and SYNC0 (time, 50 µs to 100 ms)
        cycle: Key<Ns> [50_000..=100 * MS] = "\"1ms\"",
        /// Consecutive cycles without a valid answer that stop the axes, see below (1 to 1000;
        /// default 3)
        lost_frames: Key<u32> [1..=1000],
        /// CPU of the real-time thread (0 to 1023; default any)
        cpu: Key<u32> [0..=1023],
        /// SCHED_FIFO priority of the real-time thread (1 to 99; default 80)
        priority: Key<u8> [1..=99],
        /// Time before each cycle in which the thread spins (`"auto"`, time up to a cycle, or 0;
        /// default `"auto"`)
        spin: Key<Spin>,
        /// `"awake"` keeps `cpu` from idling between cycles; costs power (`"sleep"`, `"awake"`;
        /// default `"sleep"`)
        idle: Key<bool> [IDLE_MODES],
        /// From SafeOp to Op (time, 1 ms to 10 min; default see below)
        op_timeout: Key<Ns> [MS..=600 * S],
        /// To Operation enabled; also for steps that wait for a state (time, 1 ms to 10 min;
        /// default `"5s"`)
        enable_timeout: Key<Ns> [MS..=600 * S],
        // The watchdog registers count 100 µs in 16 bits.
        /// A SubDevice without outputs for this time leaves Op by itself (time, 1 ms to 6.5535 s;
        /// default `"100ms"`)
        watchdog: Key<Ns> [MS..=6553 * MS + MS / 2],
        /// A larger offset from the reference clock (0x092C) is a warning (time, 100 ns to 1 s;
        /// default `"10us"`)
        clock_window: Key<Ns> [100..=S],
        /// Before Op, every device with SYNC0 is as close to the reference clock (0x092C) (time,
        /// 100 ns to 1 s; default `"1us"`)
        sync_window: Key<Ns> [100..=S],
        /// Until the clocks are in `sync_window` and frames are in phase with SYNC0 (time, 1 ms to
        /// 10 min; default `"5s"`)
        sync_timeout: Key<Ns> [MS..=600 * S],
        /// `"align"` keeps SYNC0 on whole multiples of the cycle in the time that computers have in
        /// common, see [common-time.md](common-time.md) (`"measure"`, `"align"`; default
        /// `"measure"`)
        common_time: Key<CommonTimeUse> [COMMON_TIMES],
        /// Cycle in which answers are processed (`"same-cycle"`, `"pipelined"`; default
        /// `"same-cycle"`)
        exchange: Key<ExchangeMode> [EXCHANGES],
        /// How frames are read from the interface (`"ring"`, `"packet"`; default `"ring"`)
        link: Key<SocketKind> [LINKS],
        /// What happens to a device that is not in the file and appears during the run, see below
        /// (`"close"`, `"report"`; default `"close"`)
        unknown_devices: Key<UnknownDeviceRule> [UNKNOWN_DEVICES],
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

impl Schema for Spin {
    fn schema() -> serde_json::Value {
        any_of([serde_json::json!({ "enum": ["auto", 0] }), Ns::schema()])
    }
}

const MODES: [&str; 5] = ["csp", "csv", "cst", "pp", "pv"];

const IDENTITIES: [&str; 6] = ["equal", ">=", "newer", "high-word", "low-word", "ignore"];

table! { "[[device]]",
    table RawDevice {
        /// Unique name (text)
        name: Key<String> = "\"x\"",
        /// ESI file, or a folder of ESI files (path; default this, `sii` or both)
        esi: Key<String>,
        /// EEPROM image (SII); it describes a device without `esi` (path)
        sii: Key<String>,
        /// Source of the mailboxes if both differ (`"esi"`, `"eeprom"`; default `"esi"`)
        mailbox: Key<MailboxSource> [MAILBOXES],
        /// Whether outputs trigger the SyncManager watchdog (`"required"`, `"esi"`; default those of
        /// an axis do if the device accepts it)
        watchdog_trigger: Key<WatchdogTrigger> [TRIGGERS],
        /// Position on the bus, from 0 (0 to 65535; default one of these four)
        position: Key<u16>,
        /// Configured station alias (0x0012) (1 to 65535)
        alias: Key<u16> [1..=u16::MAX],
        /// Explicit device identification (1 to 65535)
        id: Key<u16> [1..=u16::MAX],
        /// Name of the optional device that is the head of its segment: it is the next device behind the
        /// head and the devices before it with this key (text)
        behind: Key<String>,
        /// The device may be absent, and appear during the run at any port; needs `alias` or `id`
        /// (`true`, `false`; default `false`)
        optional: Key<bool>,
        /// Type or name, if the ESI describes several devices (text)
        type_name: Key<String> as "type",
        /// Selects a device likewise; only with a folder (number)
        vendor: Key<u32>,
        /// Selects a device likewise (number)
        product: Key<u32>,
        /// Selects a device likewise (number; default the newest)
        revision: Key<u32>,
        /// Revisions that are accepted (`"equal"`, `">="`, `"high-word"`, `"low-word"`, `"ignore"`;
        /// default `"equal"`)
        identity: Key<String> [IDENTITIES],
        /// Serial number that the device must have (number; default any)
        serial: Key<u32>,
        /// Parameter file (`ecaxis sdo dump`) of the device; its settings are written to a device with
        /// another serial number (path; default none)
        parameters: Key<String>,
        /// Selects module or PDO set, 0x6060 and start-up SDOs (`"csp"`, `"csv"`, `"cst"`, `"pp"`,
        /// `"pv"`; default none: no axis)
        mode: Key<String> [MODES],
        /// OpMode by name; `"off"`: no distributed clock (text; default the ESI's first OpMode)
        dc: Key<String>,
        /// Module names, slot by slot; `"-"` for an empty slot. Slots after the end of the list are
        /// empty (list of text; default by `mode`, else the ESI's)
        modules: Key<Vec<String>>,
        /// `AlternativeSmMapping` by name (text; default the ESI's default)
        assignment: Key<String>,
        /// Process data: `rx` are outputs, `tx` are inputs (table; default the ESI's)
        pdo: RawPdos,
        /// Start-up SDOs, sent in order after those of the ESI (list of tables; default none)
        sdo: Vec<RawSdo>,
        /// Start-up IDNs of a Sercos drive (SoE), sent in order after those of the ESI (list of
        /// tables; default none)
        idn: Vec<RawIdn>,
        /// `verify = true` and `skip_equal = true` for all start-up SDOs (table; default neither)
        startup: RawStartup,
        /// Units, limits, loops, supervision and homing of a drive's axis; as `[[device.axis]]` for
        /// each axis of a drive with several
        axes: AxisTables as "axis",
        /// CAN network behind a CANopen gateway (table; default see below)
        can: RawCan,
        /// Drives behind a CANopen gateway (tables, `[[device.node]]`; default none)
        node: Vec<RawNode>,
        /// Port at the virtual switch (EoE) and IP parameters, see below (table; default none)
        eoe: Option<RawDeviceEoe>,
        /// Settings of the simulated bus
        sim: Option<RawSim>,
    }
}

table! { "`pdo`",
    table RawPdos {
        /// Objects of the outputs, such as "0x607A" or "0x60C1:01"
        rx: Key<Vec<RawEntry>>,
        /// Objects of the inputs, such as "0x6041"
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
        /// Index of the object
        index: u16 [1..=u16::MAX] = "0x607A",
        /// Subindex of the object (default 0)
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
        if let Ok(idn) = text.parse::<Idn>() {
            let (index, sub) = (idn.0, 0);
            return Some(Self { span, index, sub });
        }
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

impl Schema for RawEntry {
    fn schema() -> serde_json::Value {
        any_of([String::schema(), EntryTable::schema()])
    }
}

table! { "`sdo`",
    row RawSdo {
        /// Index of the object
        index: u16 [1..=u16::MAX] = "0x6065",
        /// Subindex of the object (default 0)
        sub: Option<u8>,
        /// Value: a number, a text, true or false, or a list of bytes
        value: Spanned<SdoValue> = "2000",
        /// Data type, such as "u16", "i32", "f32", "text" or "UINT" (default what the ESI says)
        type_name: Key<String> as "type",
        /// If true, the object is read back and compared (default that of `startup`)
        verify: Option<bool>,
        /// If true, an object that holds the value is not written (default that of `startup`)
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

impl SdoValue {
    /// Returns the value of an object of up to 8 bytes; `None` if it is not an integer.
    pub fn integer(&self) -> Option<i64> {
        match self {
            Self::Integer(n) => Some(*n),
            Self::Boolean(b) => Some(i64::from(*b)),
            Self::Text(text) => unquoted(text),
            Self::Bytes(bytes) if bytes.len() <= 8 => {
                let mut all = [0; 8];
                all[..bytes.len()].copy_from_slice(bytes);
                Some(i64::from_le_bytes(all))
            }
            Self::Float(_) | Self::Bytes(_) => None,
        }
    }
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

impl Schema for SdoValue {
    fn schema() -> serde_json::Value {
        let one = serde_json::json!({ "type": ["integer", "number", "boolean", "string"] });
        any_of([one, Vec::<u8>::schema()])
    }
}

table! { "[device.sim]",
    table RawSim {
        /// Device that this one is connected to (name; default by order of positions)
        after: Key<String>,
        /// Port of that device (1 to 3; default the first free)
        port: Key<u8> [1..=3],
        /// Propagation delay of the cable to this device, one way (time, up to 1 ms; default 25 ns,
        /// E-bus 5 ns)
        cable: Key<Ns> [0..=MS],
        /// The cables at IN (port 0) and OUT of this device are swapped (`true`, `false`; default
        /// `false`)
        reversed: Key<bool>,
        /// Clock error; positive is too fast (−1000 to 1000; default a few, by position)
        drift_ppm: Key<f64>,
        /// Clock value at power-on (time; default 0)
        offset: Key<Ns>,
        /// Error of clock readings, up to this much (time, up to 1 ms; default 0)
        jitter: Key<Ns> [0..=MS],
        /// From a request in AL control to the answer in AL status (time, up to 60 s; default 200
        /// µs)
        state_change: Key<Ns> [0..=60 * S],
        /// Modules in the slots, slot by slot, if they differ from those of the device (list of
        /// text; default those of the device)
        modules: Key<Vec<String>>,
        /// Switches and ends along a simulated axis (table; default no switches or ends)
        track: Option<RawTrack>,
        /// Motor and load of a simulated axis (table; default a motor of 70 W)
        motor: Option<RawMotor>,
        /// How a simulated drive differs from the standard, see [drive.md](drive.md#quirks) (table;
        /// default none)
        quirks: Option<RawQuirks>,
    }
}

table! { "[[gantry]]",
    table RawGantry {
        /// First and second half; the program names the first (two names)
        axes: Option<Names> = "[\"x1\", \"x2\"]",
        /// Largest difference of their positions (unit)
        max_skew: Key<f64> = "0.5",
        /// Largest difference of their ways during homing (unit; default `max_skew`)
        max_homing_skew: Key<f64>,
    }
}

table! { "[[position_output]]",
    table RawPositionOutput {
        /// Output of one bit (signal)
        output: Key<String> = "\"io.Output 1\"",
        /// Axis that switches it (name)
        axis: Key<String> = "\"x\"",
        /// Ranges of positions in which it is on (list of [from, to], unit)
        ranges: Key<Vec<[f64; 2]>> = "[[10.0, 20.0]]",
        /// The ranges repeat after this way (unit; default never)
        period: Key<f64>,
        /// Time by which the output switches before the axis is there (time, up to 1 s; default 0)
        lead: Key<Ns> [0..=S],
        /// If true, the reported position counts instead of the set-point (`true`, `false`; default
        /// `false`)
        actual: Key<bool>,
    }
}

table! { "[[cam]]",
    table RawCam {
        /// Name for steps (text)
        name: Key<String> = "\"seal\"",
        /// Points (list of [master, follower] or [master, follower, slope], unit; default this or
        /// `file`)
        points: Key<Vec<Vec<f64>>>,
        /// CSV file with the same columns (path)
        file: Key<String>,
        /// Polynomial between points (`"poly5"`, `"poly7"`; default `"poly5"`)
        law: Key<CamLaw> [CAM_LAWS],
        /// If true, the cam repeats beyond its ends (`true`, `false`; default `false`)
        repeat: Key<bool>,
    }
}

const CAM_LAWS: [(&str, CamLaw); 2] = [("poly5", CamLaw::Poly5), ("poly7", CamLaw::Poly7)];

table! { "[[copy]]",
    table RawCopy {
        /// Inputs of a device (text)
        from: Key<String> = "\"io1.Input 1\"",
        /// Outputs of the same length (text)
        to: Key<String> = "\"io2.Output 1\"",
        /// Frames of a safety connection, which also pass to a device that has returned (`true`,
        /// `false`; default whether the ESI names an entry of either end after FSoE)
        fsoe: Key<bool>,
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
        /// How the other axes stop when one faults or trips (`"ramp"`, `"quick-stop"`,
        /// `"no-power"`; default `"ramp"`)
        others: Key<StopMethod> [STOP_METHODS],
        /// What the drive of a missing device receives (`"quick-stop"`, `"no-power"`; default
        /// `"quick-stop"`)
        bus_lost: Key<StopMethod> [STOPS_BY_DRIVE],
        /// Each condition alone causes an emergency stop (conditions as in `wait`; default none)
        emergency: Option<Conditions>,
        /// Axes and devices that stop together (tables, `[[stop.group]]`; default none)
        groups: Vec<RawGroup> as "group",
    }
}

table! { "[override]",
    table RawOverride {
        /// Override at the start (%, 0 to 120; default 100)
        initial: Key<f64>,
        /// Each condition alone holds the machine (conditions as in `wait`; default none)
        hold: Option<Conditions>,
        /// Input that multiplies the override (signal; default none)
        input: Key<String>,
        /// Value of the input at 0 % (number; default 0)
        zero: Key<f64>,
        /// Value of the input at 100 % (number, required with `input`)
        full: Key<f64>,
    }
}

table! { "[[stop.group]]",
    table RawGroup {
        /// (text)
        name: Key<String> = "\"gantry\"",
        /// An axis is in one group at most, with all axes of its drive (names; default none, if
        /// there are `devices`)
        axes: Option<Names>,
        /// SubDevices without an axis, lost and stopped with the group (names; default none)
        devices: Option<Names>,
        /// How the other axes of the group stop when one faults or trips (as above; default that of
        /// `[stop]`)
        others: Key<StopMethod> [STOP_METHODS],
        /// The rest of the machine stops within its limits, or continues (`"stop"`, `"continue"`;
        /// default `"stop"`)
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

impl Schema for Names {
    fn schema() -> serde_json::Value {
        let mut schema = Vec::<String>::schema();
        schema["minItems"] = 1.into();
        schema
    }
}
