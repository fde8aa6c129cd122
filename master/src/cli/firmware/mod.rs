//! `ecaxis firmware`: what runs in a device, and another program for it.
//!
//! - `target`: which device on which bus;
//! - `info`, `update`, `sample`: one file a subcommand;
//! - `show`: what is printed of a device.

use clap::Subcommand;

use super::Failure;

mod info;
mod sample;
mod show;
mod target;
mod update;

const EXAMPLES: &str = "\
Examples:
  ecaxis firmware info m.toml x                     what runs in the device `x`
  ecaxis firmware info --nic enp3s0 --position 0    without a machine file
  ecaxis firmware update m.toml x new.msdc --dry-run
  ecaxis firmware update m.toml x new.msdc --yes
  ecaxis firmware update --nic enp3s0 --position 0 new.bin --via foe --yes
  ecaxis firmware sample m.toml x -o new.bin        for the simulated bus

An update that breaks off leaves the device with its boot loader; the same
command tries again. Nobody may drive the bus meanwhile.";

/// Show and update the firmware of a device
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    #[command(subcommand)]
    what: What,
    #[command(flatten)]
    pub verbosity: super::Verbosity,
}

#[derive(Debug, Subcommand)]
enum What {
    Info(info::Args),
    Update(update::Args),
    Sample(sample::Args),
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match &args.what {
        What::Info(info) => info::run(info),
        What::Update(update) => update::run(update, args.verbosity.plain()),
        What::Sample(sample) => sample::run(sample),
    }
}
