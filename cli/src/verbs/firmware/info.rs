//! `ecaxis firmware info`: identity, running software and update methods of a device.

use ecaxis_tools::firmware;

use super::{TargetArgs, show};
use crate::access::bus;
use crate::access::device::{self, Target};
use crate::hints::{self, Failure};
use crate::render::{print, print_json};

const EXAMPLES: &str = "\
Examples:
  ecaxis firmware info m.toml x
  ecaxis firmware info --nic enp3s0 --position 0 --json";

const USAGE: &str = "\
ecaxis firmware info [OPTIONS] <MACHINE> <DEVICE>
       ecaxis firmware info [OPTIONS] --nic <IF> --position <N>";

/// Show the software of a device and its update methods; changes nothing
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, override_usage = USAGE)]
pub(crate) struct Args {
    /// Machine file and the device's name in it, or neither
    #[arg(value_names = ["MACHINE", "DEVICE"], num_args = 0..=2)]
    words: Vec<String>,
    #[command(flatten)]
    at: TargetArgs,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let (target, rest) = args.at.device.take(&args.words, "nothing")?;
    device::no_more(rest)?;
    let Target {
        bus, at, config, ..
    } = args.at.set_up(target, None)?;
    let nic = bus.nic();
    let found = bus.visit(async move |wire, others| {
        bus::warn_foreign_frames(others);
        let name = config.as_ref().map(|config| config.name.as_str());
        firmware::examine(&wire, at, name).await
    })?;
    let examined = found.map_err(|error| hints::failure(&error, &nic))?;
    match args.json {
        true => print_json(&show::as_json(&examined)),
        false => print(&show::info(&examined)),
    }
}
