//! `ecaxis-fleet`: machines of `ecaxis serve` as a fleet over Zenoh.

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    ecaxis_fleet::run(ecaxis_fleet::options::Options::parse())
}
