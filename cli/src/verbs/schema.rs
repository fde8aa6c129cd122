//! `ecaxis schema`: the JSON schema of the machine file.

use ecaxis_master::config::schema;

use crate::hints::Failure;
use crate::render::print_json;

const EXAMPLES: &str = "\
Examples:
  ecaxis schema > ecaxis.schema.json

A machine file whose first line is `#:schema ./ecaxis.schema.json` is completed
and checked by editors with taplo (Even Better TOML). `init` and `scan --write`
write both.";

/// Print the JSON schema of the machine file, for editors
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {}

pub(crate) fn run(_: &Args) -> Result<(), Failure> {
    print_json(&schema::machine_file())
}
