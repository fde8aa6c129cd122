//! `ecaxis sdo compare`.

use std::path::Path;

use ecaxis_master::parameters::class::CopyRule;

use super::dump::taken;
use super::{Common, as_json, load, print_differences};
use crate::access::device::Open;
use crate::hints::{self, Failure};
use crate::render::print_json;

const EXAMPLES: &str = "\
Examples:
  ecaxis sdo compare machine.toml x x.toml
  ecaxis sdo compare x.toml y.toml
  ecaxis sdo compare machine.toml x x.toml --all    actual values too";

/// Compare a parameter file with a device or with another file
///
/// Only settings are compared: writable objects of the classes `machine` and `tuned`; of one device
/// also those of the class `unit`. Prints nothing and exits with 0 if all are equal, else with 1.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, override_usage = "ecaxis sdo compare FILE DEVICE DUMP.toml\n       \
    ecaxis sdo compare --nic IF --position N DUMP.toml\n       \
    ecaxis sdo compare DUMP.toml DUMP.toml")]
pub(super) struct Args {
    /// Machine file, device, and a file from `sdo dump`; or two files from `sdo dump`
    #[arg(required = true, value_name = "WORD")]
    words: Vec<String>,
    /// Compare actual values, commands and read-only objects as well
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
            let (target, rest) = args.common.take(words, "a file of `sdo dump`")?;
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
    let found = ecaxis_master::acyclic::parameters::compare::compare(
        &left.parameters,
        &right.parameters,
        CopyRule::between(&left.device, &right.device),
        args.all,
    );
    let [first, second] = &names;
    match args.common.json {
        true => print_json(&as_json(&found))?,
        false => print_differences([first, second], &found)?,
    }
    if found.is_empty() {
        return Ok(());
    }
    let what = if args.all { "values" } else { "settings" };
    Err(Failure::new(
        hints::FAILED,
        format!("{} {what} differ", found.len()),
    ))
}
