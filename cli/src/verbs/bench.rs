//! `ecaxis bench`: measures and compares the cycle on this computer.

use std::num::NonZeroU64;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::Clock;
use ecaxis_master::config::{self, Bus, ExchangeMode, Nic, duration};
use ecaxis_master::link::SocketKind;
use ecaxis_master::rt::spin::Spin;
use ecaxis_master::session::Observer;
use ecaxis_tools::bench::bus::{FaultInjection, ReplyDelay};
use ecaxis_tools::bench::plan::{Baseline, Plan, Target, exchange_name};
use ecaxis_tools::bench::run::{self, BenchError, BenchObserver, HostCheck};
use ecaxis_tools::bench::{document, fixture, host, veth};
use ecaxis_tools::doctor::{self, Measurements, RunProfile, Severity};
use ecaxis_tools::host::Host;

use crate::access::signals;
use crate::args::files::{Inputs, check_output, unwritable};
use crate::args::nic::NicArg;
use crate::hints::{self, Failure};
use crate::render::progress::ProgressPrinter;
use crate::render::{note, print_json, print_page};

/// The shortest cycle that is measured in ns; most drives support no faster SYNC0.
const SHORTEST: u64 = 20_000;
const LONGEST: u64 = 100_000_000;

const EXAMPLES: &str = "\
Examples:
  ecaxis bench                      8 axes at 1 ms over a pair of virtual
                                    interfaces; needs root
  ecaxis bench --cycle 250us --against cyclictest --html report.html
  ecaxis bench --cycle 125us --exchange pipelined --hold wire --axes 16
  ecaxis bench --sim --axes 100     the work of a cycle; no root, no exchange
  ecaxis bench --machine m.toml     the file's real bus, axes without power";

/// Measure the cycle on this computer and compare it with alternatives
///
/// The real cycle with moving axes runs on a pair of virtual interfaces. Simulated drives answer
/// from another CPU. The report shows wake-up latency, exchange time, CPU load and losses, for each
/// alternative as well.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Cycle time, such as 1ms or 62.5us [default: 1ms, or the machine file's]
    #[arg(long, value_name = "DURATION", value_parser = cycle)]
    cycle: Option<u64>,
    /// Number of axes, each with 12 bytes per direction
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u16).range(1..=fixture::MOST_AXES as i64))]
    axes: u16,
    /// Exchange mode: same-cycle, or pipelined (answers one cycle later)
    #[arg(long, value_name = "HOW", value_parser = exchange)]
    exchange: Option<ExchangeMode>,
    /// Link type: ring or packet
    #[arg(long, value_name = "HOW", value_parser = link)]
    link: Option<SocketKind>,
    /// Spin this long before each release; auto: as long as needed; 0us: sleep only
    #[arg(long, value_name = "DURATION", value_parser = spin)]
    spin: Option<Spin>,
    /// Delay of each reply: a duration, or `wire` for the time on 100 Mbit/s
    #[arg(long, value_name = "DURATION", default_value = "30us", value_parser = hold)]
    hold: ReplyDelay,
    /// Measure in process without an interface; with --machine: on its simulated bus
    #[arg(long)]
    sim: bool,
    /// Measure on the bus of this machine file; axes are not enabled
    #[arg(long, value_name = "FILE")]
    machine: Option<PathBuf>,
    /// Use this network interface instead of the file's; `IF,IF`: both ends of a ring
    #[arg(long, value_name = "IF", requires = "machine", conflicts_with = "sim")]
    nic: Option<NicArg>,
    /// Enable the axes and run the file's program: THE MACHINE MOVES
    #[arg(long, requires = "machine")]
    enable: bool,
    /// Compare with: cyclictest, sleep (no spinning), an exchange, a link, or the path of a
    /// program; may be repeated
    #[arg(long, value_name = "WHAT", value_parser = against)]
    against: Vec<Baseline>,
    /// Length of each measurement in seconds
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=86_400))]
    seconds: u32,
    /// Rounds; each round measures every alternative once [default: 1, or 3 with --against]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000))]
    rounds: Option<u32>,
    /// Load the other CPU with an ordinary program
    #[arg(long)]
    hog: bool,
    /// Keep the CPU of the cycle from idling in all measurements
    #[arg(long)]
    awake: bool,
    /// CPU of the cycle [default: an isolated one, or the last]
    #[arg(long, value_name = "N")]
    cpu: Option<usize>,
    /// SCHED_FIFO priority of the cycle
    #[arg(long, value_name = "N", default_value_t = 80, value_parser = clap::value_parser!(u8).range(1..=98))]
    priority: u8,
    /// Delay every N-th reply by two more cycles
    #[arg(long, value_name = "N")]
    late_every: Option<NonZeroU64>,
    /// Drop every N-th reply
    #[arg(long, value_name = "N")]
    drop_every: Option<NonZeroU64>,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
    /// Write the report with histograms to this file
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
    /// Write all figures as JSON to this file
    #[arg(long, value_name = "FILE")]
    save: Option<PathBuf>,
    /// Overwrite existing output files
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    pub verbosity: crate::args::Verbosity,
}

fn cycle(text: &str) -> Result<u64, String> {
    let nanos = duration::parse(text).map_err(|e| e.to_string())?;
    if (SHORTEST..=LONGEST).contains(&nanos) {
        return Ok(nanos);
    }
    Err(format!(
        "a cycle takes from {} to {}",
        duration::show(SHORTEST),
        duration::show(LONGEST)
    ))
}

fn exchange(text: &str) -> Result<ExchangeMode, String> {
    exchange_named(text).ok_or_else(|| "there are same-cycle and pipelined".to_owned())
}

fn exchange_named(text: &str) -> Option<ExchangeMode> {
    [ExchangeMode::SameCycle, ExchangeMode::Pipelined]
        .into_iter()
        .find(|exchange| exchange_name(*exchange) == text)
}

fn link_named(text: &str) -> Option<SocketKind> {
    SocketKind::ALL.iter().copied().find(|b| b.name() == text)
}

fn link(text: &str) -> Result<SocketKind, String> {
    let names: Vec<&str> = SocketKind::ALL.iter().map(|b| b.name()).collect();
    link_named(text).ok_or_else(|| format!("there are {}", names.join(" and ")))
}

fn spin(text: &str) -> Result<Spin, String> {
    if text == "auto" {
        return Ok(Spin::Auto);
    }
    duration::parse(text)
        .map(Spin::For)
        .map_err(|e| e.to_string())
}

fn hold(text: &str) -> Result<ReplyDelay, String> {
    if text == "wire" {
        return Ok(ReplyDelay::Wire);
    }
    match duration::parse(text) {
        Ok(nanos) if nanos <= LONGEST => Ok(ReplyDelay::Fixed(nanos)),
        Ok(_) => Err(format!(
            "a reply is held for {} at most",
            duration::show(LONGEST)
        )),
        Err(error) => Err(error.to_string()),
    }
}

fn against(text: &str) -> Result<Baseline, String> {
    let known = match text {
        "cyclictest" => Some(Baseline::Cyclictest),
        "sleep" => Some(Baseline::Sleep),
        _ => exchange_named(text)
            .map(Baseline::Exchange)
            .or_else(|| link_named(text).map(Baseline::Link)),
    };
    match known {
        Some(against) => Ok(against),
        None if Path::new(text).is_file() => Ok(Baseline::Program(PathBuf::from(text))),
        None => Err("not cyclictest, sleep, an exchange, a link, nor a program".to_owned()),
    }
}

impl Args {
    /// True if the axes are enabled.
    pub fn enables(&self) -> bool {
        self.enable
    }
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let plan = plan(args)?;
    if let Some(online) = host::without(plan.cpu) {
        let message = format!("there is no CPU {}; this computer has {online}", plan.cpu);
        return Err(Failure::new(hints::WRONG, message));
    }
    for (option, path) in [("--html", &args.html), ("--save", &args.save)] {
        let inputs = Inputs::default().with("the machine file", &args.machine);
        if let Some(path) = path {
            check_output(option, path, args.force, &inputs)?;
        }
    }
    if args.html.is_some() && args.html == args.save {
        let message = "--html and --save: one file cannot hold both";
        return Err(Failure::new(hints::WRONG, message));
    }
    for nic in veth::leftovers() {
        note(&format!(
            "note: `{nic}` was left by a program that was killed; `ip link del {nic}` removes it"
        ));
    }
    let stop = Arc::<CancelToken>::default();
    signals::stop_on_interrupt(&stop);
    let bus = Bus {
        cycle_ns: plan.cycle_ns,
        ..Bus::default()
    };
    let mut reported = BenchProgress(ProgressPrinter::new(
        Clock::Real,
        &bus,
        args.verbosity.plain(),
    ));
    let report = run::run(&plan, &stop, &mut reported, || check_host(&plan))
        .map_err(|e| failure(&e, &plan))?;
    drop(reported);
    let Some(report) = report else {
        return Err(Failure::new(
            hints::INTERRUPTED,
            "interrupted before anything was measured",
        ));
    };
    let document = document(&report);
    // Print the result even if it cannot be written to a file.
    let shown = match args.json {
        true => print_json(&report),
        false => print_page(&document),
    };
    if let Some(path) = &args.html {
        save(path, &document.html())?;
    }
    if let Some(path) = &args.save {
        // Serialization cannot fail: keys are text and numbers are finite.
        let json = serde_json::to_string_pretty(&report).unwrap_or_default();
        save(path, &(json + "\n"))?;
    }
    shown?;
    if stop.is_cancelled() {
        let message = "interrupted: this is what was measured so far";
        return Err(Failure::new(hints::INTERRUPTED, message));
    }
    Ok(())
}

/// Returns the results of `ecaxis doctor`, which explain the figures.
fn check_host(plan: &Plan) -> HostCheck {
    let profile = RunProfile {
        nic: None,
        cpu: Some(plan.cpu),
        priority: plan.priority,
        cycle_ns: plan.cycle_ns,
        spin: plan.spin,
        program: std::env::current_exe().unwrap_or_default(),
    };
    let report = doctor::examine(&Host::here(), &profile, Measurements::default());
    let findings = report.findings.into_iter();
    let findings = findings.filter(|finding| finding.severity != Severity::Note);
    HostCheck {
        facts: report.facts,
        findings: findings.map(|finding| finding.found).collect(),
    }
}

fn save(path: &Path, text: &str) -> Result<(), Failure> {
    std::fs::write(path, text).map_err(|error| unwritable(path, &error))
}

fn plan(args: &Args) -> Result<Plan, Failure> {
    let wrong = |message: String| Failure::new(hints::WRONG, message);
    let target = match &args.machine {
        Some(file) => {
            let mut machine = config::load(file).map_err(|e| hints::config(file, &e))?;
            if args.sim {
                machine.bus.nic = Nic::Sim;
            } else if let Some(nic) = &args.nic {
                nic.replace(&mut machine.bus);
            }
            if let Some(cycle) = args.cycle
                && cycle != machine.bus.cycle_ns
            {
                return Err(wrong(format!(
                    "the machine's cycle is {}, and its drives are set to that",
                    duration::show(machine.bus.cycle_ns)
                ))
                .hint("change `cycle` in the machine file"));
            }
            machine.bus.exchange = args.exchange.unwrap_or(machine.bus.exchange);
            machine.bus.link = args.link.unwrap_or(machine.bus.link);
            Target::Machine {
                machine: Box::new(machine),
                enable: args.enable,
            }
        }
        None if args.sim => Target::InProcess,
        None => Target::Veth,
    };
    let bus = match &target {
        Target::Machine { machine, .. } => machine.bus.clone(),
        _ => Bus::default(),
    };
    let cycle_ns = args.cycle.unwrap_or(bus.cycle_ns);
    let spin = args.spin.unwrap_or(bus.spin);
    if let Spin::For(nanos) = spin
        && nanos > cycle_ns
    {
        return Err(wrong(
            "spinning longer than a cycle never sleeps: --spin must not exceed --cycle".to_owned(),
        ));
    }
    let veth = matches!(target, Target::Veth);
    if !veth
        && args
            .against
            .iter()
            .any(|a| matches!(a, Baseline::Program(_)))
    {
        return Err(wrong(
            "a program to compare with needs the pair of virtual interfaces".to_owned(),
        )
        .hint("leave --sim and --machine out"));
    }
    let first = host::cpus();
    let cpu = args.cpu.unwrap_or(first.0);
    let other_cpu = match first {
        (best, _) if best != cpu => Some(best),
        (_, other) => other,
    };
    let two_cycles = 2 * cycle_ns;
    Ok(Plan {
        target,
        axes: usize::from(args.axes),
        cycle_ns,
        exchange: args.exchange.unwrap_or(bus.exchange),
        link: args.link.unwrap_or(bus.link),
        spin,
        hold: args.hold,
        mischief: FaultInjection {
            drop_every: args.drop_every,
            late_every: args.late_every.map(|every| (every, two_cycles)),
        },
        priority: args.priority,
        cpu,
        other_cpu,
        time: Duration::from_secs(u64::from(args.seconds)),
        rounds: args
            .rounds
            .unwrap_or(if args.against.is_empty() { 1 } else { 3 }),
        hog: args.hog,
        awake: args.awake,
        against: args.against.clone(),
    })
}

struct BenchProgress(ProgressPrinter);

impl BenchObserver for BenchProgress {
    fn round(&mut self, round: u32, of: u32, variant: &str) {
        note(&format!("round {round} of {of}: {variant}"));
    }

    fn machine(&mut self) -> &mut dyn Observer {
        &mut self.0
    }

    fn warning(&mut self, text: &str) {
        note(&format!("warning: {text}"));
    }
}

fn failure(error: &BenchError, plan: &Plan) -> Failure {
    let failed = Failure::new(hints::FAILED, error.to_string());
    match error {
        BenchError::Veth(_) => failed.hint(
            "run it as root; `--sim` measures the work of a cycle without an interface and without root",
        ),
        BenchError::Cyclictest(_) => {
            failed.hint("cyclictest comes with the package rt-tests")
        }
        BenchError::Program(_) => {
            failed.hint("`benches/ethercrab` shows what such a program takes and prints")
        }
        BenchError::Open(open) => hints::interface(failed, open),
        BenchError::Run(error) => match &plan.target {
            Target::Machine { machine, .. } => hints::failure(error, &machine.bus.nic),
            _ => failed,
        },
        BenchError::Turn(_) | BenchError::Rig(_) => {
            failed.hint("a longer --cycle, or fewer --axes, leaves more time")
        }
        BenchError::Bus(_) | BenchError::Thread(_) => failed,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, clap::Parser)]
    struct Line {
        #[command(flatten)]
        args: Args,
    }

    fn parsed(line: &str) -> Result<Args, clap::Error> {
        let words = ["bench"].into_iter().chain(line.split_whitespace());
        <Line as clap::Parser>::try_parse_from(words).map(|line| line.args)
    }

    #[test]
    fn command_lines() {
        for (line, good) in [
            ("", true),
            ("--cycle 62.5us --axes 100 --hold wire --spin auto", true),
            (
                "--against cyclictest --against sleep --against packet --rounds 2",
                true,
            ),
            ("--cycle 1", false),
            ("--cycle 1us", false),
            ("--cycle 2s", false),
            ("--axes 0", false),
            ("--axes 1001", false),
            ("--hold 1min", false),
            ("--against nothing-of-the-kind", false),
            ("--exchange sometimes", false),
            ("--link carrier-pigeon", false),
            ("--nic eth0", false),
            ("--enable", false),
            ("--machine m.toml --sim --nic eth0", false),
            ("--priority 99", false),
            ("--late-every 0", false),
            ("--seconds 0", false),
        ] {
            assert_eq!(parsed(line).is_ok(), good, "{line}");
        }
    }

    #[test]
    fn a_plan_follows_the_command_line() {
        let made = plan(&parsed("--cycle 250us --against sleep --cpu 7 --late-every 5").unwrap());
        let made = made.unwrap();
        assert_eq!((made.cycle_ns, made.rounds, made.cpu), (250_000, 3, 7));
        assert_ne!(made.other_cpu, Some(7));
        assert_eq!(made.mischief.late_every.unwrap().1, 500_000);
        assert_eq!(plan(&parsed("").unwrap()).unwrap().rounds, 1);
        let failure = plan(&parsed("--cycle 1ms --spin 2ms").unwrap()).unwrap_err();
        assert_eq!(failure.code, hints::WRONG);
        let failure = plan(&parsed("--machine nowhere.toml").unwrap()).unwrap_err();
        assert_eq!(failure.code, hints::WRONG);
    }

    #[test]
    fn a_machine_keeps_its_cycle() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/demo.toml");
        let line = format!("--machine {} --sim", file.display());
        let made = plan(&parsed(&line).unwrap()).unwrap();
        let Target::Machine { machine, enable } = &made.target else {
            panic!("{made:?}");
        };
        assert!(!enable);
        assert_eq!(made.cycle_ns, machine.bus.cycle_ns);
        let other = format!("{line} --cycle 123us");
        assert_eq!(
            plan(&parsed(&other).unwrap()).unwrap_err().code,
            hints::WRONG
        );
    }
}
