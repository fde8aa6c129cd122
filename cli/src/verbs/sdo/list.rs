//! `ecaxis sdo list`.

use super::Common;
use crate::access::device::{Open, no_more};
use crate::hints::Failure;
use crate::verbs::esi::objects;

const EXAMPLES: &str = "\
Examples:
  ecaxis sdo list machine.toml x
  ecaxis sdo list machine.toml x --ask    read from the device
  ecaxis sdo list --nic enp3s0 --position 0 --json";

/// List the objects of a device: types, access, PDO mapping, names
///
/// The list comes from the ESI file. Without one, or with --ask, it comes from the device (SDO
/// Information).
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, override_usage = "ecaxis sdo list FILE DEVICE\n       \
    ecaxis sdo list --nic IF --position N")]
pub(super) struct Args {
    /// Machine file and device
    #[arg(value_name = "WORD")]
    words: Vec<String>,
    #[command(flatten)]
    common: Common,
}

pub(super) fn run(args: &Args) -> Result<(), Failure> {
    let (target, rest) = args.common.take(&args.words, "nothing")?;
    no_more(rest)?;
    let ask = args.common.ask;
    let dictionary = target.open(
        "asking for its objects",
        async move |open: &mut Open<'_>| open.dictionary(ask).await,
    )?;
    objects::list(&dictionary, args.common.json)
}
