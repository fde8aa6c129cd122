//! `ecaxis firmware`: shows and updates the firmware of a device.
//!
//! - `target`: selects device and bus;
//! - `info`, `update`, `sample`: one file per subcommand;
//! - `show`: formats a device.

use clap::Subcommand;

use crate::hints::Failure;

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

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match &args.what {
        FirmwareCommand::Info(info) => info::run(info),
        FirmwareCommand::Update(update) => update::run(update, args.verbosity.plain()),
        FirmwareCommand::Sample(sample) => sample::run(sample),
    }
}
