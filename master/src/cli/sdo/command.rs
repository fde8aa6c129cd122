//! `ecaxis sdo store`, `ecaxis sdo defaults`.

use ecaxis::parameters::command::Command;
use serde_json::json;

use super::super::device::{Open, Place};
use super::super::{Failure, hints, note, result};

const EXAMPLES: &str = "\
Examples:
  ecaxis sdo store machine.toml x
  ecaxis sdo defaults --nic enp3s0 --position 0";

/// Which device
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// Machine file and device
    #[arg(value_name = "WORD")]
    words: Vec<String>,
    #[command(flatten)]
    place: Place,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args, command: Command) -> Result<(), Failure> {
    let (target, rest) = args.place.take(&args.words, "nothing")?;
    if let Some(word) = rest.first() {
        return Err(Failure::new(
            hints::WRONG,
            format!("`{word}` is one word too many"),
        ));
    }
    let device = target.open(async move |open: &mut Open<'_>| {
        let at = open.at;
        at.told(command.give(open.coe, &at.wire, &at.device).await)?;
        Ok(at.device.clone())
    })?;
    if args.json {
        let report = json!({ "ok": true, "device": device.name, "position": device.position });
        return result(&format!("{report:#}\n"));
    }
    note(&match command {
        Command::Store => format!("{device}: the parameters are kept over power cycles"),
        Command::Defaults => {
            format!("{device}: the maker's parameters count when it is switched on again")
        }
    });
    Ok(())
}
