//! `ecaxis run`: brings a machine up, runs its program, sums up.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use ecaxis::clock::Clock;
use ecaxis::config::{self, ConfigError, Machine, Nic, duration};
use ecaxis::session::{self, Options, Outcome, Summary};
use ecaxis::story::Story;
use ecaxis_sim::FaultScript;
use serde_json::{Value, json};

use super::progress::Teller;
use super::story::{self, Keep};
use super::{Failure, check, files, hints, note, page, record, report, result, signals};

const EXAMPLES: &str = "\
Examples:
  ecaxis run                                the demonstration, simulated
  ecaxis run m.toml --sim --virtual         as fast as the computer can
  ecaxis run m.toml --nic enp3s0 --for 1h   for an hour on a real bus
  ecaxis run m.toml --record bus.pcapng     every frame kept for Wireshark
  ecaxis run m.toml --sim --faults f.toml   with things that go wrong
  ecaxis run m.toml --no-enable             to Op, axes without power
  ecaxis run m.toml --json                  the result for a script

Ctrl-C, SIGTERM, or a terminal that closes: the axes decelerate within their
limits, lose power, and the bus goes back to Init; the exit code is 130. Ctrl-Z
is ignored.";

/// Bring a machine up, run its program, and show what the bus and the axes did
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
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
    #[arg(long = "for", value_name = "DURATION", value_parser = duration::parse, allow_hyphen_values = true)]
    time: Option<u64>,
    /// Run the program this often instead of the file's `repeat`
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..), allow_hyphen_values = true)]
    repeat: Option<u32>,
    /// Seed of the simulated bus
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Fault script for the simulated bus
    #[arg(long, value_name = "FILE")]
    faults: Option<PathBuf>,
    /// Take the bus to Op and leave the axes without power, until Ctrl-C or `--for` is over
    #[arg(long, conflicts_with = "enable")]
    no_enable: bool,
    /// Enable the axes although the file says `enable = false`
    #[arg(long)]
    enable: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
    /// Keep every frame in this pcapng file
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Of a recording: keep its beginning and the newest frames, in parts, within this size, such as 100MB
    #[arg(long, value_name = "SIZE", requires = "record", value_parser = record::size)]
    record_limit: Option<u64>,
    /// Answer from this recording of a `--virtual` run in the place of a bus, and tell where this run deviates from it
    #[arg(long, value_name = "FILE", conflicts_with_all = ["nic", "seed", "faults"])]
    replay: Option<PathBuf>,
    /// When the run fails, write its story here, and as JSON beside it; without this it goes to
    /// ecaxis-stop-TIME.txt in the current folder, on a real bus
    #[arg(long, value_name = "FILE")]
    story: Option<PathBuf>,
    /// Keep no story
    #[arg(long, conflicts_with = "story")]
    no_story: bool,
    #[command(flatten)]
    pub verbosity: super::Verbosity,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let sim = args.sim || args.replay.is_some();
    let machine = match load(&args.file, args.nic.as_deref(), sim) {
        Ok(machine) => Machine {
            enable: args.enable || machine.enable && !args.no_enable,
            ..machine
        },
        Err(error) => {
            let short = check::in_short(&args.file, &error);
            let failure = hints::config(&args.file, &error);
            tell(args, &short, &failure.hints, check::problems(&error));
            return Err(failure);
        }
    };
    let options =
        options(args, &machine).inspect_err(|f| tell(args, &f.message, &f.hints, json!([])))?;
    if !machine.enable && !args.no_enable {
        note(
            "note: the file says `enable = false`: the axes get no power; `--enable` gives it to them",
        );
    }
    let (nic, devices) = (machine.bus.nic.clone(), machine.devices.len());
    let stop = Arc::new(AtomicBool::new(false));
    signals::stop_on_interrupt(&stop);
    let mut teller = Teller::new(options.clock, &machine.bus, args.verbosity.plain());
    let Outcome {
        summary,
        result: ended,
        story,
        ..
    } = session::run(machine, options, stop, &mut teller);
    drop(teller);

    let mut failure = ended.err().map(|error| {
        let mut failure = hints::run(&error, &nic);
        if args.replay.is_some()
            && let Some(hint) = hints::replayed(&error, devices)
        {
            failure.hints = vec![hint];
        }
        failure
    });
    failure = failure.or_else(|| summary.as_ref().and_then(unfinished));
    if let (Some(story), Some(failure)) = (&story, &mut failure) {
        tell_story(args, story, failure, &nic);
    }
    let text = if args.json {
        let report = json!({
            "ok": failure.is_none(),
            "error": failure.as_ref().map(|f| &f.message),
            "hints": failure.as_ref().map_or(&[][..], |f| &f.hints),
            "problems": [],
            "summary": summary,
            "story": story,
        });
        format!("{report:#}\n")
    } else {
        summary.as_ref().map(report::summary).unwrap_or_default()
    };
    let written = if args.json {
        result(&text)
    } else {
        page(&text)
    };
    failure.map_or(written, Err)
}

/// What a run that ended without an error has not done. What failed goes before an interruption.
pub(super) fn unfinished(summary: &Summary) -> Option<Failure> {
    let interrupted = summary.interrupted.then(Failure::interrupted);
    stopped_since(summary).or(interrupted)
}

/// A machine that went on without a group of its axes has not done all that it should.
fn stopped_since(summary: &Summary) -> Option<Failure> {
    let mut stopped = summary.group_stops.iter().filter(|stop| !stop.released);
    let stop = stopped.next()?;
    let others = match stopped.count() {
        0 => String::new(),
        n => format!(" (and {n} more)"),
    };
    let message = format!(
        "the group `{}` has stopped and was not reset{others}: {}",
        stop.group, stop.cause
    );
    let hint = "mend the cause and run again; in a program, the steps `reset` and `enable` bring a group back";
    Some(Failure::new(hints::FAILED, message).hint(hint))
}

/// In short on stderr, whole in a file. Where it knows the cause, its advice takes the place of that for the error.
fn tell_story(args: &Args, story: &Story, failure: &mut Failure, nic: &Nic) {
    let advice = hints::cause(&story.cause);
    // A bus that was recorded is not to be mended.
    if !advice.is_empty() && args.replay.is_none() {
        failure.hints = advice;
    }
    let short = story::short(story);
    if !short.is_empty() {
        note(short.trim_end());
    }
    let keep = match (&args.story, nic) {
        _ if args.no_story => Keep::No,
        (Some(path), _) => Keep::File(path.clone()),
        (None, Nic::Interface(_)) => Keep::Folder(PathBuf::new()),
        // It can be run again.
        (None, Nic::Sim) => Keep::No,
    };
    match story::keep(story, &failure.hints, &keep) {
        Ok(Some(path)) => {
            failure.after = Some(format!(
                "  the whole story: {}, and as JSON beside it",
                path.display()
            ))
        }
        Ok(None) => {}
        Err(trouble) => note(&format!("  warning: {}", trouble.message)),
    }
}

/// A script that asked for JSON gets it for a file that is wrong, too.
fn tell(args: &Args, error: &str, hints: &[String], problems: Value) {
    if args.json {
        let report = json!({
            "ok": false, "error": error, "hints": hints, "problems": problems, "summary": null,
        });
        // What is wrong with the file goes to stderr as well, and decides the exit code.
        let _ = result(&format!("{report:#}\n"));
    }
}

/// A machine on the bus that the command line says, or its file.
pub(super) fn load(file: &Path, nic: Option<&str>, sim: bool) -> Result<Machine, ConfigError> {
    let mut machine = config::load(file)?;
    if sim || nic == Some("sim") {
        machine.bus.nic = Nic::Sim;
    } else if let Some(nic) = nic {
        machine.bus.nic = Nic::Interface(nic.to_owned());
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
    let virtual_time = args.virtual_time || args.replay.is_some();
    let ends = machine.enable && !machine.steps.is_empty();
    if virtual_time && !ends && args.time.is_none() {
        let message = "--virtual without a program would never end";
        return Err(Failure::new(hints::WRONG, message).hint("add `--for 10s` or a [[step]]"));
    }
    let script = args.faults.as_deref();
    let faults = script.map(|path| faults(path, machine)).transpose()?;
    if let Some(path) = &args.record {
        record::check(path, machine, script)?;
        if args.record_limit.is_some() {
            record::check_parts(path)?;
        }
    }
    if let Some(path) = &args.story {
        let data = path.with_extension("json");
        if data == *path {
            let message = format!("--story: {} is where the data go", path.display());
            return Err(Failure::new(hints::WRONG, message)
                .hint("name the page, such as `story.txt`; the data go beside it"));
        }
        files::may_replace("--story", path, &files::STORY, [])?;
        files::may_replace("--story", &data, &files::STORY_DATA, [])?;
    }
    let seed = args.seed.or(faults.as_ref().and_then(|f| f.seed));
    let defaults = Options::default();
    Ok(Options {
        clock: if virtual_time {
            Clock::Virtual
        } else {
            Clock::Real
        },
        limit: args.time,
        repeat: args.repeat,
        seed: seed.unwrap_or(defaults.seed),
        faults,
        record: args.record.clone(),
        record_limit: args.record_limit,
        replay: args.replay.clone(),
        enable: machine.enable,
    })
}

/// No fault script is longer.
const MAX_BYTES: u64 = 16 << 20;

/// A fault script from its file, for the machine's simulated bus.
pub(super) fn faults(path: &Path, machine: &Machine) -> Result<FaultScript, Failure> {
    let text = ecaxis::file::read_text(path, MAX_BYTES)
        .map_err(|e| Failure::new(hints::WRONG, format!("cannot read {}: {e}", path.display())))?;
    let bus = session::topology(machine).map_err(|e| hints::run(&e, &machine.bus.nic))?;
    let script = FaultScript::parse(&text).and_then(|script| {
        script.check(&bus)?;
        Ok(script)
    });
    script.map_err(|e| Failure::new(hints::WRONG, format!("{}: {e}", path.display())))
}

#[cfg(test)]
mod tests {
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

    fn refused(options: &[&str], machine: &str) -> Failure {
        #[derive(clap::Parser)]
        struct Line {
            #[command(flatten)]
            args: Args,
        }
        let line = ["run", "m.toml"].iter().chain(options);
        let args = <Line as clap::Parser>::parse_from(line).args;
        let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs");
        let demo = std::fs::read_to_string(configs.join("demo.toml")).unwrap();
        let (head, _) = demo.split_once("[[step]]").unwrap();
        let text = if machine == "demo" { &demo } else { head };
        let machine = config::parse(&configs.join("demo.toml"), text).unwrap();
        super::options(&args, &machine).unwrap_err()
    }

    #[test]
    fn virtual_time_needs_an_end() {
        let failure = refused(&["--virtual", "--repeat", "3"], "no steps");
        assert_eq!(failure.code, hints::WRONG);
        assert!(failure.hints[0].contains("--for 10s"));
    }

    #[test]
    fn a_fault_of_a_device_that_is_not_there() {
        let folder = tempfile::tempdir().unwrap();
        let script = folder.path().join("f.toml");
        std::fs::write(&script, "\n[[fault]]\nkind = \"absent\"\ndevice = 2\n").unwrap();
        let failure = refused(&["--faults", script.to_str().unwrap()], "demo");
        assert_eq!(failure.code, hints::WRONG);
        assert!(failure.message.contains("line 3"), "{failure:?}");
        assert!(failure.message.contains("device 2"), "{failure:?}");
    }

    #[test]
    fn virtual_runs_print_the_same_bytes() {
        assert_eq!(printed(7), printed(7));
    }
}
