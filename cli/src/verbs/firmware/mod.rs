//! `ecaxis firmware`: shows and updates the firmware of a device.
//!
//! - here: the options of device and bus;
//! - `info`, `update`, `sample`: one file per subcommand;
//! - `show`: formats a device.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use ecaxis_master::clock::Clock;
use ecaxis_master::config::Nic;
use ecaxis_master::session::Options;

use crate::access::device::{DeviceArgs, Target};
use crate::args::bus;
use crate::args::files::{Inputs, check_output};
use crate::hints::{Failure, WRONG};

mod info;
mod sample;
mod show;
mod update;

const EXAMPLES: &str = "\
Examples:
  ecaxis firmware info m.toml x                     what runs in the device `x`
  ecaxis firmware info --nic enp3s0 --position 0    without a machine file
  ecaxis firmware update m.toml x new.msdc --dry-run
  ecaxis firmware update m.toml x new.msdc --yes
  ecaxis firmware update --nic enp3s0 --position 0 new.bin --via foe --yes
  ecaxis firmware sample m.toml x -o new.bin        for the simulated bus

An interrupted update leaves the device with its boot loader; the same
command tries again. No other program may drive the bus during the update.";

/// Show and update the firmware of a device
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    #[command(subcommand)]
    what: FirmwareCommand,
    #[command(flatten)]
    pub verbosity: crate::args::Verbosity,
}

#[derive(Debug, Subcommand)]
enum FirmwareCommand {
    Info(info::Args),
    Update(update::Args),
    Sample(sample::Args),
}

/// Options of the device and its bus
#[derive(Debug, clap::Args)]
struct TargetArgs {
    #[command(flatten)]
    device: DeviceArgs,
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

impl TargetArgs {
    /// Sets clock, faults and recording of the target's bus. `input`: a file that is read, with its
    /// description.
    fn set_up(&self, target: Target, input: Option<&Path>) -> Result<Target, Failure> {
        let machine = target.machine.as_deref();
        let is_sim = target.bus.nic() == Nic::Sim;
        if !is_sim && (self.virtual_time || self.faults.is_some()) {
            return Err(wrong(
                "virtual time and faults are for the simulated bus only",
            ));
        }
        let faults = match (&self.faults, machine) {
            (Some(file), Some(machine)) => Some(bus::faults(file, machine, None)?),
            _ => None,
        };
        if let Some(path) = &self.record {
            let inputs = machine.map(Inputs::from_machine).unwrap_or_default();
            let inputs = inputs.with("the fault script", &self.faults);
            let inputs = inputs.with("the firmware file", input);
            check_output("--record", path, self.force, &inputs)?;
        }
        let mut options = Options {
            clock: match self.virtual_time {
                true => Clock::Virtual,
                false => Clock::Real,
            },
            faults,
            record: self.record.clone(),
            ..Options::default()
        };
        if let Some(seed) = options.faults.as_ref().and_then(|faults| faults.seed) {
            options.seed = seed;
        }
        let bus = target.bus.with(options);
        Ok(Target { bus, ..target })
    }
}

fn wrong(message: &str) -> Failure {
    Failure::new(WRONG, message)
}

impl Args {
    /// True if the subcommand may change a device.
    pub fn changes(&self) -> bool {
        matches!(self.what, FirmwareCommand::Update(_))
    }
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match &args.what {
        FirmwareCommand::Info(info) => info::run(info),
        FirmwareCommand::Update(update) => update::run(update, args.verbosity.plain()),
        FirmwareCommand::Sample(sample) => sample::run(sample),
    }
}
