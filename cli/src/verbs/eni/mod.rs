//! `ecaxis eni`: a machine as an ENI file for other MainDevices, and an ENI file as a machine.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use ecaxis_master::config;
use ecaxis_tools::eni;

use crate::args::files::{Inputs, check_output, replace};
use crate::hints::{self, Failure};
use crate::render::{note, result};

mod import;

pub(crate) use import::{expected, machine_of};

const EXAMPLES: &str = "\
Examples:
  ecaxis eni machine.toml -o bus.xml        for another MainDevice
  ecaxis eni import bus.xml -o machine.toml --esi esi

The file has what ecaxis sends to reach Op, and the frames of a cycle. What an
ENI cannot say is printed. Limits and stops of the axes are not part of it.";

/// Write a machine as an ENI file (ETG.2100), or read one
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub(crate) struct Args {
    #[command(subcommand)]
    verb: Option<Verb>,
    /// Machine file
    #[arg(value_name = "FILE", required = true)]
    file: Option<PathBuf>,
    /// Write to this file instead of stdout
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Overwrite the output file
    #[arg(long, requires = "output")]
    force: bool,
}

#[derive(Debug, Subcommand)]
enum Verb {
    Import(import::Args),
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match (&args.verb, &args.file) {
        (Some(Verb::Import(args)), _) => import::run(args),
        (None, Some(file)) => export(file, args.output.as_deref(), args.force),
        (None, None) => Err(Failure::new(hints::WRONG, "name a machine file")),
    }
}

fn export(file: &Path, output: Option<&Path>, force: bool) -> Result<(), Failure> {
    let machine = config::load(file).map_err(|error| hints::config(file, &error))?;
    if let Some(output) = output {
        check_output("--output", output, force, &Inputs::from_machine(&machine))?;
    }
    let exported = eni::export(&machine).map_err(|error| {
        let failure = Failure::new(hints::WRONG, format!("{}: {error}", file.display()));
        match error {
            eni::ExportError::Cycle(_) => failure.hint("set `bus.cycle` to whole microseconds"),
            _ => failure.hint("map fewer objects, or leave the device out"),
        }
    })?;
    for text in &exported.notes {
        note(&format!("note: {text}"));
    }
    match output {
        Some(output) => replace(output, exported.text.as_bytes()),
        None => result(&exported.text),
    }
}
