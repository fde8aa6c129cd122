//! `ecaxis run`: brings a machine up, runs its program, sums up.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use ecaxis::clock::Clock;
use ecaxis::config::{self, Machine, Nic, duration};
use ecaxis::session::{self, Options, Outcome};
use ecaxis_sim::FaultScript;
use serde_json::json;

use super::progress::Teller;
use super::{Failure, hints, report, result, signals};

/// Bring a machine up, run its program, and show what the bus and the axes did
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Machine file
    #[arg(value_name = "FILE", default_value = "configs/demo.toml")]
    file: PathBuf,
    /// Use this network interface instead of the file's
    #[arg(long, value_name = "IF", conflicts_with = "sim")]
    nic: Option<String>,
    /// Use the simulated bus instead of the file's interface
    #[arg(long)]
    sim: bool,
    /// Run in virtual time: as fast as possible, the same every time (simulated bus only)
    #[arg(long = "virtual")]
    virtual_time: bool,
    /// Repeat the program until this time is over, such as 10s or 1h
    #[arg(long = "for", value_name = "DURATION", value_parser = duration::parse)]
    time: Option<u64>,
    /// Run the program this often instead of the file's `repeat`
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    repeat: Option<u32>,
    /// Seed of the simulated bus
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Fault script for the simulated bus
    #[arg(long, value_name = "FILE")]
    faults: Option<PathBuf>,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
    /// Keep every frame in this pcapng file
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    #[command(flatten)]
    pub verbosity: super::Verbosity,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let machine = load(args).map_err(|failure| told(args, failure))?;
    let options = options(args, &machine).map_err(|failure| told(args, failure))?;
    let nic = machine.bus.nic.clone();
    let stop = Arc::new(AtomicBool::new(false));
    signals::stop_on_interrupt(&stop);
    let mut teller = Teller::new(options.clock, machine.bus.cycle_ns, args.verbosity.plain());
    let Outcome {
        summary,
        result: ended,
    } = session::run(machine, options, stop, &mut teller);
    drop(teller);

    let failure = ended.err().map(|error| hints::run(&error, &nic));
    if args.json {
        let report = json!({
            "ok": failure.is_none(),
            "error": failure.as_ref().map(|f| &f.message),
            "hints": failure.as_ref().map_or(&[][..], |f| &f.hints),
            "summary": summary,
        });
        result(&format!("{report:#}\n"));
    } else if let Some(summary) = &summary {
        result(&report::summary(summary));
    }
    failure.map_or(Ok(()), Err)
}

/// A script that asked for JSON gets it for a file that is wrong, too.
fn told(args: &Args, failure: Failure) -> Failure {
    if args.json {
        let report = json!({
            "ok": false, "error": failure.message, "hints": failure.hints, "summary": null,
        });
        result(&format!("{report:#}\n"));
    }
    failure
}

fn load(args: &Args) -> Result<Machine, Failure> {
    let mut machine = config::load(&args.file).map_err(|e| hints::config(&args.file, &e))?;
    if args.sim || args.nic.as_deref() == Some("sim") {
        machine.bus.nic = Nic::Sim;
    } else if let Some(nic) = &args.nic {
        machine.bus.nic = Nic::Interface(nic.clone());
    }
    Ok(machine)
}

fn options(args: &Args, machine: &Machine) -> Result<Options, Failure> {
    if let Nic::Interface(nic) = &machine.bus.nic {
        let needs_sim = [
            (args.virtual_time, "--virtual"),
            (args.faults.is_some(), "--faults"),
            (args.seed.is_some(), "--seed"),
        ];
        if let Some((_, option)) = needs_sim.iter().find(|(given, _)| *given) {
            let message = format!("{option} needs the simulated bus, the machine is on `{nic}`");
            return Err(Failure::new(hints::WRONG, message).hint("add --sim"));
        }
    }
    let faults = args.faults.as_deref().map(faults).transpose()?;
    let seed = args.seed.or(faults.as_ref().and_then(|f| f.seed));
    let defaults = Options::default();
    Ok(Options {
        clock: if args.virtual_time {
            Clock::Virtual
        } else {
            Clock::Real
        },
        limit: args.time,
        repeat: args.repeat,
        seed: seed.unwrap_or(defaults.seed),
        faults,
        record: args.record.clone(),
        ..defaults
    })
}

/// A fault script from its file.
pub(super) fn faults(path: &std::path::Path) -> Result<FaultScript, Failure> {
    let text = std::fs::read_to_string(path)
        .map_err(|e| Failure::new(hints::WRONG, format!("cannot read {}: {e}", path.display())))?;
    FaultScript::parse(&text)
        .map_err(|e| Failure::new(hints::WRONG, format!("{}: {e}", path.display())))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use ecaxis::session::{Observer, Progress};

    use super::*;

    struct Silent;

    impl Observer for Silent {
        fn progress(&mut self, _: &Progress) {}
    }

    fn printed(seed: u64) -> (String, String) {
        let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs");
        let machine = config::load(&configs.join("demo.toml")).unwrap();
        let options = Options {
            clock: Clock::Virtual,
            repeat: Some(1),
            seed,
            ..Options::default()
        };
        let outcome = session::run(machine, options, Arc::default(), &mut Silent);
        outcome.result.unwrap();
        let summary = outcome.summary.unwrap();
        (
            report::summary(&summary),
            serde_json::to_string(&summary).unwrap(),
        )
    }

    #[test]
    fn virtual_runs_print_the_same_bytes() {
        assert_eq!(printed(7), printed(7));
    }
}
