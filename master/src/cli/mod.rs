//! The command line: one file a verb, each with its arguments and `run`.
//!
//! Results go to stdout, progress and complaints to stderr. [`hints`] is the one place that turns
//! failures into advice; [`report`] turns a run into a table.

use std::io::{self, IsTerminal, Write};
use std::process::ExitCode;

use clap::{Parser, Subcommand};

mod check;
mod explain;
mod hints;
mod report;

pub(crate) use hints::Failure;

/// An EtherCAT master for CiA 402 drives in the cyclic synchronous modes.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, Subcommand)]
enum Verb {
    Check(check::Args),
    Explain(explain::Args),
}

/// Exit codes: 0 done, 1 the machine or the bus failed, 2 the file or the command line is wrong.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let done = match cli.verb {
        Verb::Check(args) => check::run(&args),
        Verb::Explain(args) => explain::run(&args),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            failure.print();
            ExitCode::from(failure.code)
        }
    }
}

/// A result on stdout. A reader that has gone (`| head`) is no failure.
pub(crate) fn result(text: &str) {
    let mut out = io::stdout().lock();
    let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
}

/// A line on stderr.
pub(crate) fn note(text: &str) {
    let mut err = io::stderr().lock();
    let _ = writeln!(err, "{text}");
}

pub(crate) fn stderr_is_terminal() -> bool {
    io::stderr().is_terminal()
}
