//! The machine file: TOML as written ([`raw`](self)), then checked against the ESI files it names.
//!
//! | file | what lives there |
//! |---|---|
//! | `problem.rs` | a mistake with its place in the file; "did you mean" |
//! | `duration.rs` | `"250us"` |
//! | `fields.rs` | typed values out of TOML tables |
//! | `raw.rs` | the file as written |
//! | `check.rs` | raw → [`Machine`]: bus, names, places |
//! | `device.rs` | one device: its ESI file, mode, PDOs |
//! | `sdo.rs` | values of start-up SDOs as bytes |
//! | `startup.rs` | whether they are verified, or skipped where the device holds them |
//! | `axis.rs` | limits; units in `axis/scale.rs`, loops, guards and homing in `axis/control.rs` |
//! | `adopt.rs` | what the drive itself says of its units |
//! | `drive_limits.rs` | what the drive itself allows |
//! | `sim.rs` | what only the simulated bus needs: connections, clocks |
//! | `units.rs` | the names of units of positions |
//! | `gateway.rs` | the network behind a simulated gateway |
//! | `steps.rs` | the demonstration program; `[stop]` in `steps/stop.rs` |
//!
//! Every mistake is collected; a file with five of them is refused once, with five answers.

use std::path::{Path, PathBuf};
use std::sync::Arc;

mod adopt;
mod axis;
mod check;
mod describe;
mod device;
#[cfg(test)]
mod documented;
pub(crate) mod drive_limits;
pub mod duration;
mod fields;
mod gateway;
mod problem;
mod raw;
mod sdo;
mod signal;
pub mod sim;
mod startup;
pub(crate) mod steps;
mod syntax;
#[cfg(test)]
mod tests;
mod track;
mod units;

pub use adopt::{Adopted, UnitProblem};
pub(crate) use axis::is_maxon;
pub(crate) use device::further_axis;
pub use drive_limits::LimitConflict;
pub use problem::{ConfigError, Problem, nearest};
pub use signal::{AxisRef, InputRef, NameError, OutputRef};
pub use startup::{Startup, StartupWay};

pub use crate::rt::exchange::Mode as Exchange;

use ecaxis_axis::StopMethod;
use ecaxis_esi as esi;

use crate::file;
use crate::library::Match;
use crate::link::BackEnd;
use crate::rt::margin::Spin;

/// A machine: what the file says, with everything derived from the ESI files beside it.
#[derive(Debug, Clone)]
pub struct Machine {
    pub path: PathBuf,
    pub bus: Bus,
    /// In the order of the bus where every device is found by position, else as in the file.
    pub devices: Vec<DeviceConfig>,
    pub steps: Vec<Step>,
    /// What the steps read, and set.
    pub inputs: Vec<Signal>,
    pub outputs: Vec<Signal>,
    pub stop: StopSetup,
    /// Set-points by time that the steps play.
    pub tables: Vec<TableFile>,
    /// How often the steps are run, at least 1.
    pub repeat: u32,
    /// Axes get power; otherwise the bus goes to Op and no further.
    pub enable: bool,
}

/// Times in nanoseconds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Bus {
    pub nic: Nic,
    pub cycle_ns: u64,
    /// Consecutive cycles without a valid answer before the axes are stopped.
    pub lost_frames: u32,
    /// The CPU to pin the real-time thread to.
    pub cpu: Option<usize>,
    /// SCHED_FIFO priority of the real-time thread.
    pub priority: u8,
    /// How long before a cycle is due sleeping ends and spinning starts.
    pub spin: Spin,
    /// Whether `cpu` is kept from sleeping.
    pub awake: bool,
    /// How long the bus may take from SafeOp to Op.
    pub op_timeout_ns: u64,
    /// How long a drive may take to Operation enabled.
    pub enable_timeout_ns: u64,
    /// Of the process data of every SubDevice.
    pub watchdog_ns: u64,
    /// A SubDevice whose clock differs more from the reference (0x092C) is reported.
    pub clock_window_ns: u64,
    pub exchange: Exchange,
    /// How frames are taken from the network interface.
    pub link: BackEnd,
    /// Keys that the file has, each with its line; the others are defaults.
    pub written: Vec<(&'static str, u32)>,
}

impl Bus {
    /// Of register 0x0400: (2498 + 2) × 40 ns, so that watchdogs count in 100 µs.
    pub const WATCHDOG_DIVIDER: u16 = 2498;
    /// Of register 0x0410, in 100 µs: the reset value. Another MainDevice may have left another one.
    pub const PDI_WATCHDOG: u16 = 1000;

    /// Of register 0x0420, in 100 µs.
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
            cycle_ns: 1_000_000,
            lost_frames: 3,
            cpu: None,
            priority: 80,
            spin: Spin::Auto,
            awake: false,
            op_timeout_ns: 10_000_000_000,
            enable_timeout_ns: 5_000_000_000,
            watchdog_ns: 100_000_000,
            clock_window_ns: 10_000,
            exchange: Exchange::SameCycle,
            link: BackEnd::default(),
            written: Vec::new(),
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Nic {
    /// The simulated bus, from the same ESI files.
    Sim,
    /// A network interface by name.
    Interface(String),
}

#[derive(Debug, Clone)]
pub struct DeviceConfig {
    /// The file names the modules in its slots; otherwise they are what the ESI makes of the choice.
    pub modules_named: bool,
    pub name: String,
    pub at: Locator,
    pub esi_path: PathBuf,
    pub esi: Arc<esi::EsiFile>,
    pub device: Arc<esi::Device>,
    pub selection: esi::Selection,
    pub startup: Startup,
    /// Which revisions may stand for the ESI's.
    pub identity: Match,
    /// The one device that it must be.
    pub serial: Option<u32>,
    pub axis: Option<AxisSetup>,
    pub sim: sim::SimSetup,
    /// Of its `[[device]]` in the machine file.
    pub line: u32,
}

/// How a device is found on the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Locator {
    /// 0 is the first behind the MainDevice.
    Position(u16),
    /// Configured station alias (register 0x0012).
    Alias(u16),
    /// Explicit device identification (requested through AL control, or ID switch).
    Id(u16),
}

impl std::fmt::Display for Locator {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Position(n) => write!(f, "position {n}"),
            Self::Alias(n) => write!(f, "alias {n}"),
            Self::Id(n) => write!(f, "id {n}"),
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct AxisSetup {
    pub config: ecaxis_axis::AxisConfig,
    /// The user's name for the unit of positions, `mm`.
    pub unit: String,
    pub mode: esi::Mode,
    pub velocity_unit_from: UnitFrom,
    pub acceleration_unit_from: UnitFrom,
    pub torque: TorqueSetup,
    /// Which way a modulo axis moves.
    pub way: ecaxis_axis::scale::Way,
    pub homing: Option<HomingSetup>,
    /// The output that opens its brake, of one bit.
    pub brake_output: Option<Signal>,
}

/// How an axis finds home.
#[derive(Debug, Clone, PartialEq)]
pub struct HomingSetup {
    pub homing: ecaxis_axis::homing::Homing,
    /// The same as SDOs.
    pub startup: Vec<esi::StartupSdo>,
    /// For the whole search.
    pub timeout_ns: u64,
}

impl HomingSetup {
    /// With the others before SafeOp, after what the ESI asks for.
    fn add_to(&self, startup: &mut Vec<esi::StartupSdo>) {
        let at = startup
            .iter()
            .position(|sdo| sdo.transition == "SO")
            .unwrap_or(startup.len());
        startup.splice(at..at, self.startup.iter().cloned());
    }
}

/// The unit of an axis' torques, and what is known of its motor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TorqueSetup {
    pub unit: TorqueUnit,
    /// Rated torque, Nm. `None`: only the drive knows it.
    pub rated: Option<f64>,
    pub rated_from: UnitFrom,
    /// Torque constant, Nm/A.
    pub constant: Option<f64>,
    pub constant_from: UnitFrom,
    /// Of 0x6076.
    pub counts_per_newton_metre: f64,
    /// Percent of rated torque that one of the unit is. Where the rated torque is not known: percent of the limit.
    percent_per_unit: f64,
    /// Otherwise the limit is the rated torque, whatever that is.
    limit_said: bool,
}

/// `torque_unit`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum TorqueUnit {
    /// Of the motor's rated torque.
    #[default]
    Percent,
    /// Of the motor, before any gear.
    NewtonMetres,
    Amperes,
}

impl TorqueUnit {
    #[must_use]
    pub const fn sign(self) -> &'static str {
        match self {
            Self::Percent => "%",
            Self::NewtonMetres => "Nm",
            Self::Amperes => "A",
        }
    }
}

impl std::fmt::Display for TorqueUnit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.sign())
    }
}

/// What says how the drive counts something.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnitFrom {
    /// A key of [device.axis].
    File,
    /// A start-up SDO of the machine file.
    Sdo,
    /// The default in the ESI file.
    Esi,
    /// The drive itself.
    Drive,
    /// It is assumed.
    Nothing,
}

/// One step of the program.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// As people count: `2`, or `2.1` for the first step inside the second.
    pub number: String,
    /// Of the machine file.
    pub line: u32,
    pub action: Action,
}

/// What a step does. Axes are indices into [`Machine::devices`], targets pairs of such an index and a value in
/// user units.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    Enable {
        axes: Vec<usize>,
    },
    /// Decelerate, then take the power away.
    Disable {
        axes: Vec<usize>,
    },
    /// Acknowledge trips and reset drive faults.
    Reset {
        axes: Vec<usize>,
    },
    /// Homing by the drive.
    Home {
        axes: Vec<usize>,
    },
    /// Decelerate and hold.
    Stop {
        axes: Vec<usize>,
    },
    /// Move and wait until every axis is in its target.
    Move {
        /// From where the axes are when the step begins.
        relative: bool,
        targets: Vec<(usize, f64)>,
        /// Fraction of each axis' velocity limit.
        speed: f64,
        /// Fraction of each axis' acceleration limit.
        ramp: f64,
        /// Jerk-limited, from rest, and all arrive in the same cycle.
        together: bool,
    },
    /// Move until an edge comes at the input of a touch probe; without one the step fails.
    Probe {
        axis: usize,
        probe: ecaxis_axis::Probe,
        edge: ecaxis_axis::Edge,
        /// How far: a position, or a way from where the axis is.
        relative: bool,
        target: f64,
        /// Fractions, as in a move.
        speed: f64,
        ramp: f64,
    },
    /// A straight line through the positions of all its axes, jerk-limited; they arrive in the same cycle.
    Line {
        relative: bool,
        targets: Vec<(usize, f64)>,
        /// Fraction of each axis' velocity limit.
        speed: f64,
        /// Fraction of each axis' acceleration and jerk limits.
        ramp: f64,
    },
    /// About where the axis stands.
    Wave {
        axis: usize,
        wave: ecaxis_axis::setpoint::Wave,
    },
    /// To the table's first position, then along it.
    Table {
        axis: usize,
        /// Index into [`Machine::tables`].
        table: usize,
        /// On the way to the first position, as in a move.
        speed: f64,
        ramp: f64,
    },
    /// One axis follows another from now on; until it is told something else.
    Gear {
        axis: usize,
        master: usize,
        /// What the master reports instead of its set-point.
        actual: bool,
        /// The follower's units per master's unit.
        ratio: f64,
        /// The follower's position when the master's is 0; `None`: as it is when the step begins.
        offset: Option<f64>,
        smoothing_ns: u64,
    },
    /// Reach the velocities and go on turning.
    Velocity {
        targets: Vec<(usize, f64)>,
        /// Fraction of each axis' acceleration limit.
        ramp: f64,
    },
    /// Apply torques, percent of rated torque.
    Torque {
        targets: Vec<(usize, f64)>,
        /// From the present torque to the new one.
        ramp_ns: u64,
    },
    /// Switch modes of operation, also in motion.
    Mode {
        targets: Vec<(usize, ecaxis_axis::Mode)>,
    },
    Dwell {
        ns: u64,
    },
    /// Until all conditions hold in the same cycle.
    Wait {
        conditions: Vec<Condition>,
        timeout_ns: u64,
    },
    /// Indices into [`Machine::outputs`], and values.
    Set {
        values: Vec<(usize, f64)>,
    },
    Repeat {
        times: u32,
        steps: Vec<Step>,
    },
}

/// How the machine stops.
#[derive(Debug, Clone, PartialEq)]
pub struct StopSetup {
    /// Of the other axes when one faults or trips, where its group does not say otherwise.
    pub others: StopMethod,
    /// Of axes whose inputs no longer arrive; those that still answer stop by set-points.
    pub bus_lost: StopMethod,
    /// One of them is enough for an emergency stop.
    pub emergency: Vec<Condition>,
    /// SubDevices that stop together; those in none are one more group.
    pub groups: Vec<StopGroup>,
}

impl Default for StopSetup {
    fn default() -> Self {
        Self {
            others: StopMethod::Ramp,
            bus_lost: StopMethod::QuickStop,
            emergency: Vec::new(),
            groups: Vec::new(),
        }
    }
}

/// SubDevices that stop together.
#[derive(Debug, Clone, PartialEq)]
pub struct StopGroup {
    pub name: String,
    /// Indices into [`Machine::devices`], with and without an axis; in no other group.
    pub devices: Vec<usize>,
    /// Of its other axes when one faults or trips.
    pub others: StopMethod,
    pub outside: Outside,
}

/// What the machine does when a group stops.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Outside {
    /// It stops, too: within the limits of its axes.
    #[default]
    Stop,
    Continue,
}

impl Machine {
    /// As the machine file names it; empty for the first, which it does not.
    #[must_use]
    pub fn group_name(&self, group: usize) -> &str {
        let named = group
            .checked_sub(1)
            .and_then(|index| self.stop.groups.get(index));
        named.map_or("", |group| &group.name)
    }

    /// The group of a device: 0 where none names it, else one more than the index into [`StopSetup::groups`].
    #[must_use]
    pub fn group_of(&self, device: usize) -> usize {
        let mut groups = self.stop.groups.iter();
        let named = groups.position(|group| group.devices.contains(&device));
        named.map_or(0, |index| index + 1)
    }
}

/// A table of set-points and the file it comes from.
#[derive(Debug, Clone, PartialEq)]
pub struct TableFile {
    pub path: PathBuf,
    pub table: ecaxis_axis::setpoint::Table,
}

/// An input and what it must be; every bound that is given holds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Condition {
    /// Index into [`Machine::inputs`].
    pub input: usize,
    pub equal: Option<f64>,
    pub above: Option<f64>,
    pub below: Option<f64>,
}

impl Condition {
    #[must_use]
    pub fn holds(&self, value: f64) -> bool {
        self.equal.is_none_or(|n| value == n)
            && self.above.is_none_or(|n| value > n)
            && self.below.is_none_or(|n| value < n)
    }
}

/// A piece of process data that the program reads or sets.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    /// Index into [`Machine::devices`].
    pub device: usize,
    /// With its device's: `io.Input 3`.
    pub name: String,
    pub field: esi::layout::Field,
}

/// How a signal's bits are a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Unsigned,
    Signed,
    /// IEEE 754, 32 bits.
    Real,
}

impl Signal {
    #[must_use]
    pub fn kind(&self) -> Kind {
        match self.field.data_type.as_str() {
            "REAL" if self.field.bit_len == 32 => Kind::Real,
            "SINT" | "INT" | "INT24" | "DINT" | "INT40" | "INT48" | "INT56" | "LINT"
            | "INTEGER8" | "INTEGER16" | "INTEGER32" | "INTEGER64" => Kind::Signed,
            _ => Kind::Unsigned,
        }
    }

    /// Lowest and highest value, and whether only whole ones.
    fn range(&self) -> (f64, f64, bool) {
        let steps = f64::from(self.field.bit_len).exp2();
        match self.kind() {
            Kind::Real => (f64::from(f32::MIN), f64::from(f32::MAX), false),
            Kind::Signed => (-steps / 2.0, steps / 2.0 - 1.0, true),
            Kind::Unsigned => (0.0, steps - 1.0, true),
        }
    }
}

/// No machine file is longer.
const MAX_BYTES: u64 = 16 << 20;

/// Reads and checks a machine file and the ESI files it names.
///
/// # Errors
/// [`ConfigError::Io`] where the file cannot be read, [`ConfigError::NotText`] where it is no text, else
/// everything that is wrong with it.
pub fn load(path: &Path) -> Result<Machine, ConfigError> {
    let bytes = file::read(path, MAX_BYTES).map_err(|source| ConfigError::Io {
        path: path.to_owned(),
        source,
    })?;
    let text = String::from_utf8(bytes).map_err(|e| ConfigError::NotText {
        path: path.to_owned(),
        source: e.utf8_error(),
    })?;
    parse(path, &text)
}

/// Of a text that is no TOML, as many are told.
const MOST_SYNTAX_ERRORS: usize = 10;

/// Checks a machine file's text; `path` is what its ESI files are relative to.
///
/// # Errors
/// Everything that is wrong with it.
pub fn parse(path: &Path, text: &str) -> Result<Machine, ConfigError> {
    let mut problems = problem::Problems::new(path, text);
    let start = text.trim_start_matches('\u{feff}').trim_start();
    if start.starts_with('<') {
        let at = text.len() - start.len();
        let hint = format!("`ecaxis esi check {}` looks at ESI files", path.display());
        problems.add_hint(at..at + 1, "this is XML, not a machine file", hint);
        return Err(problems.into_error());
    }
    let (document, mut errors) = toml::de::DeTable::parse_recoverable(text);
    // What follows would be guesses about text that has not been understood.
    if !errors.is_empty() {
        // A table that is written wrong leaves those below it without one, which is then said of each of them.
        raw::names(&document, &mut problems);
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
    let raw = raw::read(&document, &mut problems);
    match check::machine(path, raw, &mut problems) {
        Some(machine) if problems.is_empty() => Ok(machine),
        _ => Err(problems.into_error()),
    }
}
