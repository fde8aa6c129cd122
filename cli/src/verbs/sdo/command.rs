//! `ecaxis sdo store`, `ecaxis sdo defaults`.

use ecaxis_master::acyclic::parameters::command::Command;
use ecaxis_master::mailbox::MailboxTransport;
use serde_json::json;

use crate::access::device::{DeviceArgs, Open, no_more};
use crate::hints::{self, Failure};
use crate::render::{note, print_json};

const STORE_EXAMPLES: &str = "\
Examples:
  ecaxis sdo store machine.toml x
  ecaxis sdo store --nic enp3s0 --position 0";

const DEFAULTS_EXAMPLES: &str = "\
Examples:
  ecaxis sdo dump machine.toml x x.toml       back up the present ones
  ecaxis sdo defaults machine.toml x --yes
  ecaxis sdo defaults --nic enp3s0 --position 0 --yes";

/// Store the parameters in non-volatile memory (0x1010 `save`)
#[derive(Debug, clap::Args)]
#[command(after_help = STORE_EXAMPLES)]
pub(super) struct StoreArgs {
    #[command(flatten)]
    which: Which,
}

/// Restore default parameters at the next power-up (0x1011 `load`)
#[derive(Debug, clap::Args)]
#[command(after_help = DEFAULTS_EXAMPLES)]
pub(super) struct DefaultsArgs {
    /// Confirm the loss of the present parameters
    #[arg(long)]
    yes: bool,
    #[command(flatten)]
    which: Which,
}

#[derive(Debug, clap::Args)]
struct Which {
    /// Machine file and device
    #[arg(value_name = "WORD")]
    words: Vec<String>,
    #[command(flatten)]
    place: DeviceArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

pub(super) fn store(args: &StoreArgs) -> Result<(), Failure> {
    give(&args.which, Command::Store)
}

pub(super) fn defaults(args: &DefaultsArgs) -> Result<(), Failure> {
    if !args.yes {
        let failure = Failure::new(hints::WRONG, "nothing was written: add `--yes`");
        return Err(failure.hint("`ecaxis sdo dump` keeps the present parameters in a file first"));
    }
    give(&args.which, Command::Defaults)
}

fn give(which: &Which, command: Command) -> Result<(), Failure> {
    let (target, rest) = which.place.take(&which.words, "nothing")?;
    no_more(rest)?;
    let (step, what) = match command {
        Command::Store => ("storing its parameters", "parameters are stored"),
        Command::Defaults => ("resetting its parameters", "parameters are reset"),
    };
    let device = target.open(step, async move |open: &mut Open<'_>| {
        let at = open.at;
        at.at_rest(what)?;
        // The device completes the command even after a cancellation.
        let given = at
            .wire
            .stop()
            .shield(command.give(open.coe, &at.wire, &at.device));
        at.map_error(given.await)?;
        Ok(at.device.clone())
    })?;
    if which.json {
        let report = json!({ "ok": true, "device": device.name, "position": device.position });
        return print_json(&report);
    }
    note(&match command {
        Command::Store => format!("{device}: the parameters are kept over power cycles"),
        Command::Defaults => {
            format!("{device}: default parameters take effect after the next power-up")
        }
    });
    Ok(())
}
