//! `ecaxis run`: brings a machine up, runs its program and prints a summary.

use std::io::IsTerminal;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ecaxis_master::bringup::Step;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::Clock;
use ecaxis_master::config::{Machine, Nic, duration};
use ecaxis_master::session::{
    self, Attachments, Cause, Error, Observer, Options, Outcome, Progress, RetryDelay, Summary,
};
use ecaxis_master::supervise::ProgramControl;
use serde_json::{Value, json};

use crate::access::{console, rights, signals};
use crate::args::LogArgs;
use crate::args::bus::BusArgs;
use crate::args::can_log::CanLog;
use crate::args::files::{Inputs, check_output};
use crate::args::record;
use crate::args::report::ReportArgs;
use crate::hints::{self, Failure};
use crate::render::fault_report;
use crate::render::progress::ProgressPrinter;
use crate::render::{note, print, print_json, report};
use crate::starter;
use crate::verbs::check;

const EXAMPLES: &str = "\
Examples:
  ecaxis run                                the demonstration, simulated
  ecaxis run m.toml --sim --virtual         in virtual time
  ecaxis run m.toml --nic enp3s0 --for 1h   for an hour on a real bus
  ecaxis run m.toml --record bus.pcapng     record all frames for Wireshark
  ecaxis run m.toml --sim --faults f.toml   with a fault script
  ecaxis run m.toml --no-enable             to Op, axes without power
  ecaxis run m.toml --wait                  wait for devices without power
  ecaxis run m.toml --json                  the result as JSON

During the run, the lines `p` (pause), `s` (one step), `c` (continue) and, on
the simulated bus, `press INPUT` and `release INPUT` control the program.

Ctrl-C, SIGTERM, or a terminal that closes: the axes decelerate within their
limits, lose power, and the bus goes back to Init; the exit code is 130. Ctrl-Z
is ignored.";

/// Bring a machine up, run its program, and show what the bus and the axes did
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Machine file [default: the demonstration, on its simulated bus]
    #[arg(value_name = "FILE")]
    file: Option<PathBuf>,
    #[command(flatten)]
    bus: BusArgs,
    /// Run in virtual time: as fast as possible, the same every time (simulated bus only)
    #[arg(long = "virtual")]
    virtual_time: bool,
    /// Wait until all devices answer, and start then; report what is missing
    #[arg(long, conflicts_with_all = ["virtual_time", "replay"])]
    wait: bool,
    /// Repeat the program for this time, such as 10s or 1h
    #[arg(long = "for", value_name = "DURATION", value_parser = duration::parse, allow_hyphen_values = true)]
    time: Option<u64>,
    /// Run the program this many times instead of the file's `repeat`
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..), allow_hyphen_values = true)]
    repeat: Option<u32>,
    /// Seed of the simulated bus
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Bring the bus to Op without enabling the axes, until Ctrl-C or the end of `--for`
    #[arg(long, conflicts_with = "enable")]
    no_enable: bool,
    /// Enable the axes even if the file has `enable = false`
    #[arg(long)]
    enable: bool,
    /// Read `pause`, `continue`, `step` and `press INPUT` from the standard input also without a
    /// terminal
    #[arg(long, conflicts_with = "virtual_time")]
    console: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
    /// Record all frames to this pcapng file
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Write the frames of the simulated CAN networks to this file at the end, as candump does
    #[arg(long, value_name = "FILE", conflicts_with_all = ["nic", "replay"])]
    can_log: Option<PathBuf>,
    /// Limit the recording to this size, such as 100MB; keep the beginning and the newest frames,
    /// in parts
    #[arg(long, value_name = "SIZE", requires = "record", value_parser = record::size)]
    record_limit: Option<u64>,
    /// Replay this recording of a `--virtual` run instead of a bus, and report where this run
    /// deviates
    #[arg(long, value_name = "FILE", conflicts_with_all = ["nic", "seed", "faults"])]
    replay: Option<PathBuf>,
    #[command(flatten)]
    report: ReportArgs,
    /// Overwrite existing output files
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    pub log: LogArgs,
    #[command(flatten)]
    pub verbosity: crate::args::Verbosity,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let mut machine = match &args.file {
        None => demonstration(args)
            .inspect_err(|f| print_failure(args, &f.message, &f.hints, json!([])))?,
        Some(file) => args.bus.load(file).map_err(|error| {
            let failure = hints::config(file, &error);
            let short = check::in_short(file, &error);
            print_failure(args, &short, &failure.hints, check::problems(&error));
            failure
        })?,
    };
    machine.enable = args.enable || machine.enable && !args.no_enable;
    if args.replay.is_some() {
        machine.bus.nic = Nic::Sim;
    }
    let options = options(args, &machine)
        .inspect_err(|f| print_failure(args, &f.message, &f.hints, json!([])))?;
    if !machine.enable && !args.no_enable {
        note(
            "note: the file says `enable = false`: the axes get no power; `--enable` gives it to them",
        );
    }
    let inputs = Inputs::from_machine(&machine).with("the fault script", &args.bus.faults);
    let can_log = args.can_log.as_deref();
    let mut can_log = can_log
        .map(|path| CanLog::create(&mut machine, path, args.force, &inputs))
        .transpose()
        .inspect_err(|f| print_failure(args, &f.message, &f.hints, json!([])))?;
    let needed = rights::of_machine(&machine);
    let outputs = args.report.files(&machine.bus.nic);
    let mut needed = rights::with_outputs(needed, args.record.iter().chain(&outputs));
    needed.read.extend(args.replay.clone());
    needed.one_bring_up = !args.wait;
    rights::limit(&needed).inspect_err(|f| print_failure(args, &f.message, &f.hints, json!([])))?;
    let (nic, devices) = (machine.bus.nic.clone(), machine.devices.len());
    let stop = Arc::<CancelToken>::default();
    signals::stop_on_interrupt(&stop);
    let attachments = Attachments::default();
    if options.clock == Clock::Real && (args.console || std::io::stdin().is_terminal()) {
        console::control(&machine, Arc::clone(&attachments.control))?;
    }
    let mut teller = ProgressPrinter::new(options.clock, &machine.bus, args.verbosity.plain());
    let Outcome {
        summary,
        result: ended,
        fault_report,
        ..
    } = match args.wait {
        true => run_when_present(&machine, &options, &stop, &mut teller, &attachments.control),
        false => session::run_attached(machine, options, stop, &mut teller, attachments),
    };
    drop(teller);
    if let Some(error) = can_log.as_mut().and_then(|log| log.write().err()) {
        note(&format!("warning: writing the CAN log: {error}"));
    }

    let mut failure = ended.err().map(|error| {
        let mut failure = hints::failure(&error, &nic);
        if args.replay.is_some()
            && let Some(hint) = hints::replayed(&error, devices)
        {
            failure.hints = vec![hint];
        }
        failure
    });
    failure = failure.or_else(|| summary.as_ref().and_then(unfinished));
    if let (Some(fault_report), Some(failure)) = (&fault_report, &mut failure) {
        let keep = args.report.destination(&nic);
        // The recorded bus cannot be fixed during a replay.
        let advise = args.replay.is_none();
        failure.after = fault_report::print(fault_report, &mut failure.hints, &keep, advise);
    }
    let written = if args.json {
        print_json(&json!({
            "ok": failure.is_none(),
            "error": failure.as_ref().map(|f| &f.message),
            "hints": failure.as_ref().map_or(&[][..], |f| &f.hints),
            "problems": [],
            "summary": summary,
            "fault_report": fault_report,
        }))
    } else {
        summary
            .as_ref()
            .map_or(Ok(()), |summary| print(&report::summary(summary)))
    };
    failure.map_or(written, Err)
}

/// Runs the machine like [`session::run_attached`], once its devices are present: as long as some are
/// absent, the bring-up is tried again.
fn run_when_present(
    machine: &Machine,
    options: &Options,
    stop: &Arc<CancelToken>,
    printer: &mut ProgressPrinter,
    control: &Arc<ProgramControl>,
) -> Outcome {
    /// How soon Ctrl-C ends the waiting.
    const TURN: Duration = Duration::from_millis(50);
    let mut delay = RetryDelay::default();
    let (mut reported, mut printed) = (None, Vec::new());
    let mut confirmed = false;
    loop {
        let attachments = Attachments {
            control: Arc::clone(control),
            ..Attachments::default()
        };
        let mut observer = AttemptObserver {
            printer,
            printed: &mut printed,
        };
        let (stop_run, options) = (Arc::clone(stop), options.clone());
        let outcome = session::run_attached(
            machine.clone(),
            options,
            stop_run,
            &mut observer,
            attachments,
        );
        // A machine that has run does not start again: its program would begin again.
        let has_run = outcome.summary.is_some();
        let Some(error) = outcome.result.as_ref().err().filter(|_| !has_run) else {
            return outcome;
        };
        // A device that loses its power during bring-up fails in any step. The next attempt shows
        // whether it is absent.
        let of_device = error.is_in_bring_up() && error.device().is_some();
        if !error.is_absence() && (confirmed || !of_device) {
            return outcome;
        }
        confirmed = !error.is_absence();
        let failure = hints::failure(error, &machine.bus.nic);
        if confirmed {
            note(&format!("{}; bring-up begins once more", failure.message));
        } else if reported.as_ref() != Some(&failure.message) {
            note(&format!("waiting (Ctrl-C ends it): {}", failure.message));
            for hint in &failure.hints {
                note(&format!("  = help: {hint}"));
            }
            reported = Some(failure.message);
        }
        let end = Instant::now() + delay.after_failure(None);
        while Instant::now() < end && !stop.is_cancelled() {
            std::thread::sleep(TURN);
        }
        if stop.is_cancelled() {
            return Error::from(Cause::Interrupted).into();
        }
    }
}

/// Prints the begin of the scan, and each warning about the interface, in one attempt only.
struct AttemptObserver<'p> {
    printer: &'p mut ProgressPrinter,
    printed: &'p mut Vec<String>,
}

impl Observer for AttemptObserver<'_> {
    fn progress(&mut self, progress: &Progress) {
        let line = match progress {
            Progress::Step(step @ Step::Scan) => step.to_string(),
            Progress::Concern(concern) => concern.to_string(),
            _ => return self.printer.progress(progress),
        };
        if !self.printed.contains(&line) {
            self.printed.push(line);
            self.printer.progress(progress);
        }
    }
}

/// Returns what a run that ended without an error did not complete. A stopped group takes
/// precedence over an interruption.
pub(crate) fn unfinished(summary: &Summary) -> Option<Failure> {
    let interrupted = summary.interrupted.then(Failure::interrupted);
    stopped_since(summary).or(interrupted)
}

/// Returns a failure if an axis group stopped and was not reset.
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
    let hint =
        "fix the cause and run again; in a program, the steps `reset` and `enable` restart a group";
    Some(Failure::new(hints::FAILED, message).hint(hint))
}

/// Prints the failure as JSON if `--json` was given.
fn print_failure(args: &Args, error: &str, hints: &[String], problems: Value) {
    if args.json {
        // Ignored: the caller prints the failure on stderr and sets the exit code.
        let _ = print_json(&json!({
            "ok": false, "error": error, "hints": hints, "problems": problems, "summary": null,
        }));
    }
}

/// Returns the demonstration, which no interface replaces: real drives need a file of their own.
fn demonstration(args: &Args) -> Result<Machine, Failure> {
    if args.bus.nic.is_some() {
        return Err(Failure::new(hints::WRONG, "--nic: which machine file?")
            .hint("`ecaxis scan IF --write FILE` writes one for the devices on an interface"));
    }
    starter::demonstration()
}

fn options(args: &Args, machine: &Machine) -> Result<Options, Failure> {
    let needs_sim = [
        (args.virtual_time, "--virtual"),
        (args.seed.is_some(), "--seed"),
    ];
    let faults = args.bus.script(machine, &needs_sim)?;
    let virtual_time = args.virtual_time || args.replay.is_some();
    let ends = machine.enable && !machine.steps.is_empty();
    if virtual_time && !ends && args.time.is_none() {
        let message = "--virtual without a program would never end";
        return Err(Failure::new(hints::WRONG, message).hint("add `--for 10s` or a [[step]]"));
    }
    let inputs = Inputs::from_machine(machine)
        .with("the fault script", &args.bus.faults)
        .with("the recording to replay", &args.replay);
    if let Some(path) = &args.record {
        check_output("--record", path, args.force, &inputs)?;
        if args.record_limit.is_some() {
            record::check_parts(path, args.force, &inputs)?;
        }
    }
    args.report.check(args.force, &inputs)?;
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

#[cfg(test)]
mod tests {
    use std::path::Path;

    use ecaxis_master::config;
    use ecaxis_master::session::{Observer, Progress};
    use ecaxis_sim::SecondPort;

    use super::*;
    use crate::args::bus::faults;

    struct QuietObserver;

    impl Observer for QuietObserver {
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
        let outcome = session::run(machine, options, Arc::default(), &mut QuietObserver);
        outcome.result.unwrap();
        let summary = outcome.summary.unwrap();
        (
            report::summary(&summary).text(None),
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
    fn fault_script_may_break_the_closing_cable_of_a_ring() {
        let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs");
        let machine = config::load(&configs.join("demo.toml")).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("f.toml");
        let last = machine.devices.len() - 1;
        let script = format!("[[fault]]\nkind = 'link-break'\ndevice = {last}\nport = 1\n");
        std::fs::write(&path, script).unwrap();
        assert!(faults(&path, &machine, None).is_err());
        assert!(faults(&path, &machine, Some(SecondPort::Listens)).is_ok());
    }

    #[test]
    fn virtual_time_needs_a_program_or_a_limit() {
        let failure = refused(&["--virtual", "--repeat", "3"], "no steps");
        assert_eq!(failure.code, hints::WRONG);
        assert!(failure.hints[0].contains("--for 10s"));
    }

    #[test]
    fn faults_rejects_an_unknown_device() {
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
