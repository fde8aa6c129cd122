//! Which device on which bus.

use std::path::{Path, PathBuf};

use ecaxis::clock::Clock;
use ecaxis::config::{self, DeviceConfig, Locator, Machine, Nic};
use ecaxis::firmware::Expected;
use ecaxis::service::Datagrams;
use ecaxis::service::station::Which;
use ecaxis::session::Options;

use crate::cli::bus::Bus;
use crate::cli::{Failure, hints, record, run};

#[derive(Debug, clap::Args)]
pub(super) struct Where {
    /// Network interface, in place of the machine file's or without one
    #[arg(long, value_name = "IF", conflicts_with = "sim")]
    nic: Option<String>,
    /// The device's position on the bus; the first one is 0
    #[arg(long, value_name = "N", conflicts_with = "alias")]
    position: Option<u16>,
    /// The device's alias
    #[arg(long, value_name = "N")]
    alias: Option<u16>,
    /// Use the machine file's bus, simulated
    #[arg(long)]
    sim: bool,
    /// In virtual time: as fast as possible (simulated bus only)
    #[arg(long = "virtual")]
    virtual_time: bool,
    /// Fault script for the simulated bus
    #[arg(long, value_name = "FILE")]
    faults: Option<PathBuf>,
    /// Keep every frame in this pcapng file
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
}

pub(super) struct Target {
    bus: Bus,
    pub which: Which,
    /// In the machine file; else what it was found by.
    pub name: String,
    /// By the machine file.
    pub expected: Expected,
}

impl Where {
    /// `words`: machine file and device, or nothing. `input` is a file that is read, too, and what it is.
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
            (Some(position), ..) => Which::Position(position),
            (None, Some(alias), _) => Which::Alias(alias),
            (None, None, Some(Locator::Position(position))) => Which::Position(position),
            (None, None, Some(Locator::Alias(alias))) => Which::Alias(alias),
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
            record::check_beside(path, machine.as_ref(), self.faults.as_deref(), input)?;
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
    /// Hints depend on it.
    pub fn nic(&self) -> Nic {
        self.bus.nic()
    }

    /// Nobody may drive a machine beside the work.
    pub fn alone(self) -> Self {
        let bus = self.bus.alone();
        Self { bus, ..self }
    }

    /// Does a piece of work on the bus; `work` is told how many frames of others came in before anything was sent.
    pub fn visit<T, W>(self, work: W) -> Result<T, Failure>
    where
        T: Send + 'static,
        W: AsyncFnOnce(Datagrams, u64) -> T + Send + 'static,
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
