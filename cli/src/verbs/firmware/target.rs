//! Selects device and bus.

use std::path::{Path, PathBuf};

use ecaxis_master::acyclic::DatagramClient;
use ecaxis_master::acyclic::enumerate::DeviceSelector;
use ecaxis_master::clock::Clock;
use ecaxis_master::config::{self, DeviceConfig, Locator, Machine, Nic};
use ecaxis_master::session::Options;
use ecaxis_tools::firmware::Expected;

use crate::args::bus::Bus;
use crate::args::record;
use crate::hints;
use crate::hints::Failure;
use crate::verbs::run;

#[derive(Debug, clap::Args)]
pub(super) struct DeviceArgs {
    /// Use this network interface instead of the file's, or without a machine file
    #[arg(long, value_name = "IF", conflicts_with = "sim")]
    nic: Option<String>,
    /// Position of the device on the bus, counted from 0
    #[arg(long, value_name = "N", conflicts_with = "alias")]
    position: Option<u16>,
    /// Station alias of the device
    #[arg(long, value_name = "N")]
    alias: Option<u16>,
    /// Use the simulated bus of the machine file
    #[arg(long)]
    sim: bool,
    /// Use virtual time: as fast as possible (simulated bus only)
    #[arg(long = "virtual")]
    virtual_time: bool,
    /// Fault script for the simulated bus
    #[arg(long, value_name = "FILE")]
    faults: Option<PathBuf>,
    /// Record all frames to this pcapng file
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Overwrite existing output files
    #[arg(long)]
    force: bool,
}

pub(super) struct Target {
    bus: Bus,
    pub which: DeviceSelector,
    /// The name in the machine file, else the position or alias.
    pub name: String,
    /// The identity from the machine file.
    pub expected: Expected,
}

impl DeviceArgs {
    /// Returns the target. `words`: machine file and device, or nothing. `input`: a file that is
    /// read, with its description.
    pub fn target(
        &self,
        words: &[String],
        input: Option<(&Path, &str)>,
    ) -> Result<Target, Failure> {
        let mut machine = match words {
            [] => None,
            [file, _] => {
                let file = Path::new(file);
                Some(config::load(file).map_err(|e| hints::config(file, &e))?)
            }
            _ => return Err(wrong("a machine file and a device's name belong together")),
        };
        let device = match (&machine, words) {
            (Some(machine), [file, name]) => Some(named(machine, Path::new(file), name)?.clone()),
            _ => None,
        };
        let device = device.as_ref();
        let which = match (self.position, self.alias, device.map(|device| device.at)) {
            (Some(position), ..) => DeviceSelector::Position(position),
            (None, Some(alias), _) => DeviceSelector::Alias(alias),
            (None, None, Some(Locator::Position(position))) => DeviceSelector::Position(position),
            (None, None, Some(Locator::Alias(alias))) => DeviceSelector::Alias(alias),
            (None, None, Some(Locator::Id(_))) => {
                return Err(wrong("a device with `id` is not searched for here")
                    .hint("say where it is with `--position`"));
            }
            (None, None, None) => {
                return Err(wrong("which device is meant?")
                    .hint("name a machine file and a device, or `--nic` and `--position`"));
            }
        };
        let nic = match (&self.nic, &machine) {
            (Some(nic), _) => Nic::Interface(nic.clone()),
            (None, Some(_)) if self.sim => Nic::Sim,
            (None, Some(machine)) => machine.bus.nic.clone(),
            (None, None) => {
                return Err(wrong("which bus is meant?")
                    .hint("name the network interface with `--nic`, or a machine file"));
            }
        };
        let is_sim = nic == Nic::Sim;
        if !is_sim && (self.virtual_time || self.faults.is_some()) {
            return Err(wrong(
                "virtual time and faults are for the simulated bus only",
            ));
        }
        let faults = match (&self.faults, &machine) {
            (Some(file), Some(machine)) => Some(run::faults(file, machine)?),
            _ => None,
        };
        if let Some(path) = &self.record {
            record::check_distinct(
                path,
                self.force,
                machine.as_ref(),
                self.faults.as_deref(),
                input,
            )?;
        }
        let mut options = Options {
            clock: if self.virtual_time {
                Clock::Virtual
            } else {
                Clock::Real
            },
            faults,
            record: self.record.clone(),
            ..Options::default()
        };
        if let Some(seed) = options.faults.as_ref().and_then(|faults| faults.seed) {
            options.seed = seed;
        }
        let bus = match (&mut machine, nic) {
            (Some(machine), nic) => {
                machine.bus.nic = nic;
                Bus::of(machine)
            }
            (None, Nic::Interface(nic)) => Bus::interface(&nic),
            (None, Nic::Sim) => return Err(wrong("the simulated bus is a machine file's")),
        };
        let identity = device.map(|device| device.device.identity);
        Ok(Target {
            name: device.map_or_else(|| which.to_string(), |device| device.name.clone()),
            expected: Expected {
                vendor: identity.map(|identity| identity.vendor),
                product: identity.map(|identity| identity.product),
            },
            bus: bus.with(options),
            which,
        })
    }
}

impl Target {
    /// The interface; hints depend on it.
    pub fn nic(&self) -> Nic {
        self.bus.nic()
    }

    /// Requires that no other program drives the interface.
    pub fn alone(self) -> Self {
        let bus = self.bus.alone();
        Self { bus, ..self }
    }

    /// Runs `work` on the bus. `work` receives the number of foreign frames seen before the first
    /// transmission.
    pub fn visit<T, W>(self, work: W) -> Result<T, Failure>
    where
        T: Send + 'static,
        W: AsyncFnOnce(DatagramClient, u64) -> T + Send + 'static,
    {
        self.bus.visit(work)
    }
}

pub(super) fn named<'a>(
    machine: &'a Machine,
    file: &Path,
    name: &str,
) -> Result<&'a DeviceConfig, Failure> {
    machine
        .devices
        .iter()
        .find(|device| device.name == name)
        .ok_or_else(|| {
            let names: Vec<&str> = machine.devices.iter().map(|d| d.name.as_str()).collect();
            wrong(&format!("{} has no device `{name}`", file.display()))
                .hint(format!("it has `{}`", names.join("`, `")))
        })
}

pub(super) fn wrong(message: &str) -> Failure {
    Failure::new(hints::WRONG, message)
}
