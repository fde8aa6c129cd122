//! `ecaxis doctor`: host settings that disturb the cycle, each with the command that fixes it.

use std::path::PathBuf;

use ecaxis_master::config::{self, Nic, duration};
use ecaxis_master::link::OpenError;
use ecaxis_master::rt::spin::Spin;
use ecaxis_tools::doctor::{self, Measurements, RunProfile, Severity, ethtool, wakeup};
use ecaxis_tools::host::Host;

use crate::hints::{self, Failure};
use crate::render::{note, print_json, print_page, stderr_is_terminal};

const EXAMPLES: &str = "\
Examples:
  sudo ecaxis doctor enp3s0              the computer and the network card
  ecaxis doctor --machine m.toml         with the settings of the machine file
  ecaxis doctor enp3s0 --cpu 3           for CPU 3
  ecaxis doctor --seconds 600            wake-ups for ten minutes
  ecaxis doctor --seconds 0 --json       no measurement, for a script

Nothing is changed. Without sudo it examines what this user may do; sudo sees
more, such as the preemption model. Exit code: 0 nothing is bad (there may be
warnings), 1 something is, 2 the command line or the file is wrong.";

/// Find host and network card settings that disturb the cycle, each with its fix
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Network interface of the bus
    #[arg(value_name = "NIC")]
    nic: Option<String>,
    /// Take interface, CPU, priority, cycle and spin from this machine file
    #[arg(long, value_name = "FILE")]
    machine: Option<PathBuf>,
    /// CPU of the real-time thread [default: the file's, or the first isolated one]
    #[arg(long, value_name = "N")]
    cpu: Option<usize>,
    /// SCHED_FIFO priority of the real-time thread [default: the file's, or 80]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=99))]
    priority: Option<u8>,
    /// Cycle time, such as 250us [default: the file's, or 1ms]
    #[arg(long, value_name = "DURATION", value_parser = cycle)]
    cycle: Option<u64>,
    /// Measure wake-ups for this many seconds; 0 skips it
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = seconds)]
    seconds: u32,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

fn seconds(text: &str) -> Result<u32, String> {
    let seconds = text.parse().ok().filter(|seconds| *seconds <= 86_400);
    seconds.ok_or_else(|| "whole seconds, such as 10, up to 86400".to_owned())
}

fn cycle(text: &str) -> Result<u64, String> {
    match duration::parse(text).map_err(|e| e.to_string())? {
        ns @ 50_000..=100_000_000 => Ok(ns),
        _ => Err("a cycle takes 50 µs to 100 ms".to_owned()),
    }
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let intent = intent(args)?;
    let host = Host::here();
    if let Some(nic) = &intent.nic
        && !host.interfaces().contains(nic)
    {
        let error = OpenError::NoSuchInterface { nic: nic.clone() };
        let failure = Failure::new(hints::WRONG, error.to_string());
        return Err(hints::interface(failure, &error));
    }
    let tried = Measurements {
        nic: intent.nic.as_deref().map(ethtool::ask),
        wake_up: measure(args.seconds, &host, &intent)?,
    };
    let report = doctor::examine(&host, &intent, tried);
    match args.json {
        true => print_json(&report)?,
        false => print_page(&report.document())?,
    }
    match report.count(Severity::Bad) {
        0 => Ok(()),
        1 => Err(Failure::new(hints::FAILED, "one finding is bad")),
        n => Err(Failure::new(hints::FAILED, format!("{n} findings are bad"))),
    }
}

fn intent(args: &Args) -> Result<RunProfile, Failure> {
    let program = std::env::current_exe().unwrap_or_else(|_| "ecaxis".into());
    let mut intent = RunProfile::new(program);
    if let Some(file) = &args.machine {
        let machine = config::load(file).map_err(|e| hints::config(file, &e))?;
        let bus = machine.bus;
        intent.nic = match bus.nic {
            Nic::Interface(nic) => Some(nic),
            Nic::Sim => None,
        };
        intent.cpu = bus.cpu;
        intent.priority = bus.priority;
        intent.cycle_ns = bus.cycle_ns;
        intent.spin = bus.spin;
    }
    intent.nic = args.nic.clone().or(intent.nic);
    intent.cpu = args.cpu.or(intent.cpu);
    intent.priority = args.priority.unwrap_or(intent.priority);
    if let Some(cycle) = args.cycle {
        intent.cycle_ns = cycle;
        if let Spin::For(ns) = intent.spin {
            intent.spin = Spin::For(ns.min(cycle / 4));
        }
    }
    Ok(intent)
}

fn measure(
    seconds: u32,
    host: &Host,
    intent: &RunProfile,
) -> Result<Option<wakeup::WakeUp>, Failure> {
    if seconds == 0 {
        return Ok(None);
    }
    if stderr_is_terminal() {
        note(&format!("measuring wake-ups for {seconds} s …"));
    }
    let setup = wakeup::Setup {
        seconds,
        cpu: doctor::cycle_cpu(host, intent),
        priority: intent.priority,
        cycle_ns: intent.cycle_ns,
        spin: intent.spin,
    };
    let measured = wakeup::measure(setup);
    let failed = |e| Failure::new(hints::FAILED, format!("cannot measure wake-ups: {e}"));
    measured.map(Some).map_err(failed)
}
