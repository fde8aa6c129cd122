//! The machine file: parsed from TOML (`raw`), then checked against the ESI files it names.
//!
//! | file | contents |
//! |---|---|
//! | `problem.rs` | a mistake with its place in the file; "did you mean" |
//! | `duration.rs` | `"250us"` |
//! | `fields.rs` | `table!`: a table's keys, types, ranges and examples in one place |
//! | `raw/` | the file as written: its tables |
//! | `schema.rs` | the tables as a JSON schema, for editors |
//! | `check.rs` | raw → [`Machine`]: bus, names, positions |
//! | `position_output.rs` | outputs that follow the position of an axis |
//! | `cam.rs`, `path.rs`, `csv.rs` | cams, paths, and files with rows of numbers |
//! | `line_shaft.rs` | master axes on other machines |
//! | `compensation.rs` | backlash and pitch error of an axis |
//! | `second_encoder.rs` | the encoder at the load of an axis |
//! | `copy.rs` | inputs that are copied to outputs |
//! | `roles.rs` | the owner of each output bit, and what each input decides |
//! | `device.rs` | one device: its ESI file, mode, PDOs |
//! | `locator.rs` | how a device is located on the bus |
//! | `needed.rs` | objects that the file needs in the process data |
//! | `optional.rs` | devices that may be absent |
//! | `sdo.rs` | values of start-up SDOs as bytes |
//! | `startup.rs` | which start-up SDOs are verified or skipped |
//! | `axis_setup.rs` | what is known about an axis |
//! | `axis.rs` | limits; units in `axis/scale.rs`, loops and homing in `axis/control.rs` |
//! | `drive_units.rs` | the units that the drive itself reports |
//! | `drive_limits.rs` | the limits that the drive itself allows |
//! | `sim.rs` | settings of the simulated bus: connections, clocks |
//! | `sim_motor.rs` | the motor of a simulated axis |
//! | `sim_quirks.rs` | how a simulated drive differs from the standard |
//! | `travel.rs` | switches and ends along a simulated axis |
//! | `units.rs` | names of position units |
//! | `device_groups.rs` | groups that the machine goes on without |
//! | `ebus.rs` | the supply of terminals |
//! | `gantry.rs` | two axes that move as one |
//! | `gateway.rs` | the CAN network behind a gateway, its nodes and their axes |
//! | `mailbox_gateway.rs` | the mailbox gateway for other vendors' tools |
//! | `eoe.rs` | Ethernet over EtherCAT: the TAP interface, IP parameters |
//! | `steps.rs` | checks of the program; `[stop]` in `steps/stop.rs` |
//! | `program.rs` | the program, and its steps as text |
//!
//! All mistakes are collected, so that one check reports every mistake of a file.

use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

mod axis;
mod axis_setup;
mod cam;
mod check;
mod compensation;
mod copy;
mod csv;
pub(crate) mod cycle_objects;
mod device;
mod device_groups;
#[cfg(test)]
mod documented;
pub(crate) mod drive_limits;
mod drive_units;
pub mod duration;
mod ebus;
mod eoe;
#[macro_use]
mod fields;
mod gantry;
mod gateway;
mod line_shaft;
mod locator;
mod mailbox_gateway;
mod needed;
mod optional;
mod path;
mod position_output;
mod problem;
mod program;
mod raw;
pub(crate) mod roles;
pub mod schema;
mod sdo;
mod second_encoder;
mod signal;
pub mod sim;
mod sim_input;
mod sim_motor;
mod sim_quirks;
mod startup;
pub mod state_timeouts;
pub(crate) mod steps;
mod subprograms;
mod syntax;
#[cfg(test)]
mod tests;
mod travel;
mod units;

pub use crate::text::nearest;
pub use axis::TorqueLimit;
pub(crate) use axis::is_maxon;
pub use axis_setup::{AxisSetup, HomingSetup, TorqueSetup, TorqueUnit, UnitSource};
pub use cam::NamedCam;
pub use copy::{BitRange, CopySetup};
pub use device::keys_of_idn;
pub(crate) use device::unused_axis;
pub use drive_limits::LimitConflict;
pub use drive_units::{AdoptedUnits, UnitProblem};
pub use eoe::{EoeSetup, TapSetup};
pub use gateway::{GatewaySetup, NodeSetup};
pub use line_shaft::LineShaftSetup;
pub use locator::{Locator, SegmentHead};
pub use mailbox_gateway::MailboxGatewaySetup;
pub use position_output::PositionOutputSetup;
pub use problem::{ConfigError, Problem};
pub use program::{
    Action, AxisValue, Bound, NamedSignal, NumberPlace, ProgramInputs, Step, StopGroup, StopSetup,
    Subject, SwitchedInput, Test, Variable, VariableRef, VariableUse, When,
};
pub use roles::{
    InputRole, InputUse, OutputOwner, OwnedOutput, OwnerKind, ProcessDataRoles, ReturnRule,
};
pub use signal::{NameError, Signal};
pub use startup::{Startup, StartupOptions};
pub use state_timeouts::StateTimeouts;
pub use units::si_factor;

use ecaxis_ecat::index::{AxisIndex, DeviceIndex, GroupIndex, IndexVec, LineShaftIndex};
use ecaxis_esi as esi;

pub(crate) use fields::LARGEST;
use fields::Read;
use raw::RawMachine;

use crate::esi_library::{RevisionMatch, SiiImage};
use crate::file;
use crate::file_digest::{FileDigest, UsedFile};
use crate::link::SocketKind;
use crate::parameters::kept::KeptParameters;
pub use crate::rt::config::{Bounds, Condition, ExchangeMode, GroupStopScope};
use crate::rt::config::{GroupConfig, RtConfig};
pub use crate::rt::controller::{AxisRef, InputRef, OutputRef};
use crate::rt::gantry::GantryConfig;
use crate::rt::image::{OpOnly, ProcessData};
pub use crate::rt::overrides::{OverrideConfig, OverrideInput};
pub use crate::rt::spin::Spin;
use crate::signature::{SignaturePolicy, SignedKind};

/// The maximum number of SubDevices on a bus; a power of two, as ethercrab's group needs.
pub(crate) const MAX_SUBDEVICES: usize = 512;

/// A machine: the content of the machine file and everything derived from its ESI files.
#[derive(Debug, Clone)]
pub struct Machine {
    pub path: PathBuf,
    /// SHA-256 of this file and the files that it names.
    pub sha256: FileDigest,
    /// This file and the files that it names.
    pub files: Vec<UsedFile>,
    pub bus: Bus,
    /// The devices, in bus order if every device is located by position, otherwise in file order.
    pub devices: IndexVec<DeviceIndex, DeviceConfig>,
    /// The axes, device by device.
    pub axes: IndexVec<AxisIndex, AxisSetup>,
    pub gantries: Vec<GantryConfig>,
    /// The cams, by index in [`Action::Gear`].
    pub cams: Vec<NamedCam>,
    pub line_shafts: IndexVec<LineShaftIndex, LineShaftSetup>,
    pub steps: Vec<Step>,
    /// The signals that the steps read; `outputs` are those they set.
    pub inputs: Vec<Signal>,
    pub outputs: Vec<Signal>,
    /// The names of `[signals]`.
    pub signals: Vec<NamedSignal>,
    /// The variables of the program.
    pub variables: Vec<Variable>,
    /// The inputs that pause the program and step it.
    pub program: ProgramInputs,
    /// What the simulated bus does with its inputs.
    pub switched: Vec<SwitchedInput>,
    pub copies: Vec<CopySetup>,
    pub position_outputs: Vec<PositionOutputSetup>,
    /// The owners of the outputs, and what the inputs decide.
    pub roles: ProcessDataRoles,
    pub stop: StopSetup,
    pub overrides: OverrideConfig,
    /// The set-point tables that the steps play.
    pub tables: Vec<ecaxis_axis::setpoint::Table>,
    /// The number of program runs, at least 1.
    pub repeat: u32,
    /// `true` if the axes get power. Otherwise the bus goes to Op and the axes stay disabled.
    pub enable: bool,
    pub server: ServerSetup,
    /// The mailbox gateway; `None`: there is none.
    pub mailbox_gateway: Option<MailboxGatewaySetup>,
    /// The TAP interface of the devices with EoE; `None`: there is none.
    pub tap: Option<TapSetup>,
}

/// Settings of the server for clients that command the machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ServerSetup {
    /// The number of cycles without a new set-point of a real-time client, after which its axes
    /// stop.
    pub stale_cycles: u32,
    /// The longest silence of the owner of the motion in ns, unless it asks for another.
    pub lease_ns: u64,
}

/// Settings of the bus. Times are in ns.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Bus {
    pub nic: Nic,
    /// The interface at the other end of the ring, with cable redundancy.
    pub redundant: Option<String>,
    pub cycle_ns: u64,
    /// The number of consecutive cycles without a valid answer that stops the axes.
    pub lost_frames: u32,
    /// The CPU to pin the real-time thread to.
    pub cpu: Option<usize>,
    /// SCHED_FIFO priority of the real-time thread.
    pub priority: u8,
    /// The time before a cycle at which sleeping ends and spinning starts.
    pub spin: Spin,
    /// `true` if `cpu` is kept from sleep states.
    pub awake: bool,
    /// The timeout from SafeOp to Op; `None`: that of each device.
    pub op_timeout_ns: Option<u64>,
    /// The timeout of a drive to Operation enabled.
    pub enable_timeout_ns: u64,
    /// The process data watchdog of every SubDevice.
    pub watchdog_ns: u64,
    /// The clock difference (0x092C) above which a SubDevice is reported.
    pub clock_window_ns: u64,
    /// The clock difference (0x092C) within which every SubDevice with SYNC0 must be before Op.
    pub sync_window_ns: u64,
    /// The timeout for the clocks to settle and for frames to be in phase with SYNC0.
    pub sync_timeout_ns: u64,
    pub common_time: CommonTimeUse,
    pub exchange: ExchangeMode,
    /// The way frames are exchanged with the network interface.
    pub link: SocketKind,
    /// What happens to devices that are not in the file and appear during the run.
    pub unknown_devices: UnknownDeviceRule,
    /// Keys present in the file, each with its line; all others have defaults.
    pub written: Vec<(&'static str, u32)>,
}

impl Bus {
    /// The value of register 0x0400: (2498 + 2) × 40 ns, so that watchdogs count in 100 µs.
    pub const WATCHDOG_DIVIDER: u16 = 2498;
    /// The value of register 0x0410 in 100 µs. This is the reset value; another MainDevice may have
    /// changed it.
    pub const PDI_WATCHDOG: u16 = 1000;

    /// Returns the value of register 0x0420 in 100 µs.
    #[must_use]
    pub fn process_data_watchdog(&self) -> u16 {
        let ticks = u16::try_from(self.watchdog_ns / 100_000);
        ticks.unwrap_or(u16::MAX).max(1)
    }
}

impl Default for Bus {
    fn default() -> Self {
        Self {
            nic: Nic::Sim,
            redundant: None,
            cycle_ns: 1_000_000,
            lost_frames: 3,
            cpu: None,
            priority: 80,
            spin: Spin::Auto,
            awake: false,
            op_timeout_ns: None,
            enable_timeout_ns: 5_000_000_000,
            watchdog_ns: 100_000_000,
            clock_window_ns: 10_000,
            sync_window_ns: 1_000,
            sync_timeout_ns: 5_000_000_000,
            common_time: CommonTimeUse::default(),
            exchange: ExchangeMode::SameCycle,
            link: SocketKind::default(),
            unknown_devices: UnknownDeviceRule::default(),
            written: Vec::new(),
        }
    }
}

/// What happens with the difference between common time and the time of the bus.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum CommonTimeUse {
    #[default]
    Measure,
    /// SYNC0 is kept on whole multiples of the cycle in common time.
    Align,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Nic {
    /// The simulated bus, with the same ESI files.
    Sim,
    /// The network interface with this name.
    Interface(String),
}

#[derive(Debug, Clone)]
pub struct DeviceConfig {
    /// `true` if the file names the modules in its slots. Otherwise the ESI defines them.
    pub modules_named: bool,
    pub name: String,
    pub at: Locator,
    /// The file that describes the device: its ESI file, or its EEPROM image without one.
    pub esi_path: PathBuf,
    pub esi: Arc<esi::EsiFile>,
    /// The EEPROM image that the file names.
    pub sii: Option<Arc<SiiImage>>,
    pub mailbox: MailboxSource,
    pub watchdog_trigger: WatchdogTrigger,
    pub device: Arc<esi::Device>,
    pub selection: esi::Selection,
    pub startup: Startup,
    /// The rule for revisions that differ from the ESI's.
    pub identity: RevisionMatch,
    /// The required serial number.
    pub serial: Option<u32>,
    /// The parameter file of the device that belongs here.
    pub parameters: Option<Arc<KeptParameters>>,
    /// `true` if the device may be absent.
    pub optional: bool,
    pub sim: sim::SimSetup,
    /// The CAN network behind a gateway with described nodes.
    pub gateway: Option<GatewaySetup>,
    /// The port at the virtual switch; `None`: EoE is not used.
    pub eoe: Option<EoeSetup>,
    /// The line of its `[[device]]` in the machine file.
    pub line: u32,
}

impl DeviceConfig {
    /// Returns the selection as that of a drive with this axis alone: the node of an axis behind a
    /// gateway, otherwise its part of the device.
    #[must_use]
    pub fn selection_of(&self, axis: &AxisSetup) -> Cow<'_, esi::Selection> {
        let node = axis.node.and_then(|n| self.gateway.as_ref()?.nodes.get(n));
        node.map_or_else(
            || self.selection.of_axis(axis.number),
            |node| Cow::Borrowed(&node.selection),
        )
    }

    /// Returns `true` if an ESI file describes the device, and not its EEPROM image alone.
    #[must_use]
    pub fn has_esi(&self) -> bool {
        let image = self.sii.as_ref();
        image.is_none_or(|image| image.path != self.esi_path)
    }

    /// Returns `true` if all these SyncManagers, or their FMMUs, are enabled in Op only.
    fn is_op_only(&self, sms: &[esi::layout::SmLayout]) -> bool {
        !sms.is_empty() && sms.iter().all(|sm| self.device.op_only(sm).fmmu)
    }
}

/// What happens to a device that is not in the machine file and appears during the run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum UnknownDeviceRule {
    /// It is reported, and the port that leads to it is closed.
    #[default]
    Close,
    /// It is reported only.
    Report,
}

/// The source of a device's mailbox addresses and sizes if its ESI and its EEPROM differ.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum MailboxSource {
    /// As configuration tools do (ETG.2100: an ENI has the mailboxes of the ESI).
    #[default]
    Esi,
    /// As SOEM, the IgH master and ethercrab do.
    Eeprom,
}

/// Whether outputs trigger the SyncManager watchdog of their device (bit 6 of the ControlByte).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum WatchdogTrigger {
    /// Those of an axis do; a device that refuses this gets the ControlByte of its ESI.
    #[default]
    Preferred,
    /// They do, or the bring-up fails.
    Required,
    /// As the ESI says.
    Esi,
}

impl Machine {
    /// Returns the group's name in the machine file; empty for group 0, which has no name.
    #[must_use]
    pub fn group_name(&self, group: GroupIndex) -> &str {
        let named = group.0.checked_sub(1);
        let named = named.and_then(|index| self.stop.groups.get(index));
        named.map_or("", |group| &group.name)
    }

    /// Returns the axes of a device.
    pub fn axes_of(&self, device: DeviceIndex) -> impl Iterator<Item = (AxisIndex, &AxisSetup)> {
        let all = self.axes.enumerate();
        all.filter(move |(_, axis)| axis.device == device)
    }

    /// Returns the group of a device. The first group has no name; the others are those of
    /// [`StopSetup::groups`].
    #[must_use]
    pub fn group_of(&self, device: DeviceIndex) -> GroupIndex {
        let mut groups = self.stop.groups.iter();
        let named = groups.position(|group| group.devices.contains(&device));
        named.map_or(GroupIndex::MACHINE, |index| GroupIndex(index + 1))
    }

    /// Returns true if all devices of a group are optional.
    #[must_use]
    pub fn is_optional(&self, group: GroupIndex) -> bool {
        let mut own = self
            .devices
            .enumerate()
            .filter(|(d, _)| self.group_of(*d) == group);
        group != GroupIndex::MACHINE && own.all(|(_, device)| device.optional)
    }

    /// Returns true if an axis is in the group.
    #[must_use]
    pub fn has_axes(&self, group: GroupIndex) -> bool {
        let mut axes = self.axes.iter();
        axes.any(|axis| self.group_of(axis.device) == group)
    }

    /// Returns the group of an axis: that of its device.
    #[must_use]
    pub fn group_of_axis(&self, axis: AxisIndex) -> GroupIndex {
        let axis = self.axes.get(axis);
        axis.map_or(GroupIndex::MACHINE, |axis| self.group_of(axis.device))
    }

    /// Returns the time-out of the way to PreOp. ethercrab has one for all devices: the longest.
    #[must_use]
    pub fn pre_op_timeout(&self) -> Duration {
        let all = self.devices.iter().map(|device| {
            let timeouts = StateTimeouts::new(&device.device.info);
            timeouts.pre_op.max(timeouts.back_to_init)
        });
        all.max().unwrap_or(StateTimeouts::DEFAULT.back_to_init)
    }

    /// Returns the settings of the cycle.
    #[must_use]
    pub fn rt_config(&self) -> RtConfig {
        let (bus, stop) = (&self.bus, &self.stop);
        let devices = self.devices.enumerate().map(|(index, device)| {
            let layout = &device.selection.layout;
            ProcessData {
                out_len: layout.rx_bytes(),
                in_len: layout.tx_bytes(),
                group: self.group_of(index),
                lrw: !device.device.use_lrd_lwr,
                mailbox: device.device.mailbox_status_fmmu().is_some(),
                op_only: OpOnly {
                    outputs: device.is_op_only(&layout.outputs),
                    inputs: device.is_op_only(&layout.inputs),
                },
            }
        });
        let rest = GroupConfig::machine(stop.others);
        let named = stop.groups.iter().map(|group| GroupConfig {
            others: group.others,
            outside: group.outside,
        });
        RtConfig {
            cycle_ns: bus.cycle_ns,
            clock_window_ns: bus.clock_window_ns,
            align: bus.common_time == CommonTimeUse::Align,
            spin: bus.spin,
            exchange: bus.exchange,
            lost_frames: bus.lost_frames,
            devices: devices.collect(),
            groups: std::iter::once(rest).chain(named).collect(),
            bus_lost: stop.bus_lost,
            emergency: stop.emergency.clone(),
            overrides: self.overrides.clone(),
            gantries: self.gantries.clone(),
            cams: self.cams.iter().map(|named| named.cam.clone()).collect(),
            line_shafts: self.line_shafts.iter().map(|setup| setup.shaft).collect(),
            copies: self.copies.iter().map(CopySetup::rt).collect(),
            output_locks: self.roles.output_locks(),
            repeats: device::repeats(&self.devices),
        }
    }
}

/// The maximum length of a machine file in bytes.
const MAX_BYTES: u64 = 16 << 20;

/// Reads and checks a machine file and the ESI files it names, with the policy of the environment
/// for their signatures.
///
/// # Errors
/// Fails like [`load_with`], and with [`ConfigError::Policy`].
pub fn load(path: &Path) -> Result<Machine, ConfigError> {
    load_with(path, &SignaturePolicy::of_environment()?)
}

/// Reads and checks a machine file and the ESI files it names.
///
/// # Errors
/// [`ConfigError::Io`] if the file cannot be read, [`ConfigError::Signature`] if the policy refuses
/// it, [`ConfigError::NotText`] if it is not text, otherwise all mistakes in it.
pub fn load_with(path: &Path, policy: &SignaturePolicy) -> Result<Machine, ConfigError> {
    let bytes = file::read(path, MAX_BYTES).map_err(|source| ConfigError::Io {
        path: path.to_owned(),
        source,
    })?;
    let file = policy.verify(SignedKind::Machine, path, &bytes)?;
    let text = String::from_utf8(bytes).map_err(|e| ConfigError::NotText {
        path: path.to_owned(),
        source: e.utf8_error(),
    })?;
    parse_file(file, &text, policy)
}

/// The maximum number of TOML syntax errors reported.
const MOST_SYNTAX_ERRORS: usize = 10;

/// Checks a machine file's text. `path` is the base of relative ESI file names. No signature is
/// looked at.
///
/// # Errors
/// All mistakes in the file.
pub fn parse(path: &Path, text: &str) -> Result<Machine, ConfigError> {
    let file = UsedFile::new(path, text.as_bytes());
    parse_file(file, text, &SignaturePolicy::default())
}

fn parse_file(
    file: UsedFile,
    text: &str,
    policy: &SignaturePolicy,
) -> Result<Machine, ConfigError> {
    let path = &*file.path;
    let mut problems = problem::Problems::new(path, text, policy);
    let start = text.trim_start_matches('\u{feff}').trim_start();
    if start.starts_with('<') {
        let at = text.len() - start.len();
        let hint = format!("`ecaxis esi check {}` looks at ESI files", path.display());
        problems.add_hint(at..at + 1, "this is XML, not a machine file", hint);
        return Err(problems.into_error());
    }
    let (document, mut errors) = toml::de::DeTable::parse_recoverable(text);
    let mut root = toml::Spanned::new(0..0, toml::de::DeValue::Table(document.into_inner()));
    // Checks after a syntax error would only report consequences of it.
    if !errors.is_empty() {
        // A malformed table would make its subtables look incomplete.
        RawMachine::check_keys(&root, &mut problems);
        if !problems.is_empty() {
            errors.retain(|error| !error.message().starts_with("duplicate key"));
        }
        errors.sort_by_key(|error| error.span().map_or(0, |span| span.start));
        let more = errors.split_off(errors.len().min(MOST_SYNTAX_ERRORS));
        for error in &errors {
            syntax::report(text, error, &mut problems);
        }
        if let Some(next) = more.first() {
            let message = format!("… and {} more mistakes from here on", more.len());
            problems.add(next.span().unwrap_or(0..0), message);
        }
        return Err(problems.into_error());
    }
    if let toml::de::DeValue::Table(table) = root.get_mut() {
        subprograms::expand(table, &mut problems);
    }
    let raw = RawMachine::read(&root, "", &mut problems);
    match raw.and_then(|raw| check::machine(&file, raw, &mut problems)) {
        Some(machine) if problems.is_empty() => Ok(machine),
        _ => Err(problems.into_error()),
    }
}
