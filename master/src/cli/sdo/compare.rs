//! `ecaxis sdo compare`.

use std::path::Path;

use super::super::device::Open;
use super::super::{Failure, hints, result};
use super::dump::taken;
use super::{Common, as_json, differences, load};

const EXAMPLES: &str = "\
Examples:
  ecaxis sdo compare machine.toml x x.toml
  ecaxis sdo compare x.toml y.toml
  ecaxis sdo compare machine.toml x x.toml --all    actual values too";

/// Compare a file of parameters with a device, or with another file
///
/// Settings are compared: what can be written and commands nothing. Prints nothing and ends with 0 where they are equal; with 1 where
/// they are not.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, override_usage = "ecaxis sdo compare FILE DEVICE DUMP.toml\n       \
    ecaxis sdo compare --nic IF --position N DUMP.toml\n       \
    ecaxis sdo compare DUMP.toml DUMP.toml")]
pub(super) struct Args {
    /// Machine file, device, and a file of `sdo dump`; or two files of `sdo dump`
    #[arg(required = true, value_name = "WORD")]
    words: Vec<String>,
    /// Also what is no setting: actual values, commands, what cannot be written
    #[arg(long)]
    all: bool,
    #[command(flatten)]
    common: Common,
}

pub(super) fn run(args: &Args) -> Result<(), Failure> {
    let (left, right, names) = match args.words.as_slice() {
        [left, right] => (
            load(Path::new(left))?,
            load(Path::new(right))?,
            [left.clone(), right.clone()],
        ),
        words => {
            let (target, rest) = args.common.place.take(words, "a file of `sdo dump`")?;
            let [file] = rest else {
                return Err(Failure::new(hints::WRONG, "one file of `sdo dump`"));
            };
            let left = load(Path::new(file))?;
            let ask = args.common.ask;
            let taken = target.open(
                "reading its parameters",
                async move |open: &mut Open<'_>| {
                    let (there, _) = taken(open, ask).await?;
                    Ok((there, open.at.device.name.clone()))
                },
            );
            let (there, name) = taken?;
            (left, there, [file.clone(), name])
        }
    };
    let found = ecaxis::parameters::compare::compare(&left.parameters, &right.parameters, args.all);
    let [first, second] = &names;
    result(&match args.common.json {
        true => format!("{:#}\n", as_json(&found)),
        false => differences([first, second], &found),
    })?;
    if found.is_empty() {
        return Ok(());
    }
    let what = if args.all { "values" } else { "settings" };
    Err(Failure::new(
        hints::FAILED,
        format!("{} {what} differ", found.len()),
    ))
}
