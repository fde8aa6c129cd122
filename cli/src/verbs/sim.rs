//! `ecaxis sim`: serves the simulated bus of a machine file on a network interface, for any
//! MainDevice.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::{self, Machine};
use ecaxis_master::link::OpenError;
use ecaxis_master::link::SocketKind;
use ecaxis_master::link::lock::{NicInUse, NicLock};
use ecaxis_master::link::nic::NicLink;
use ecaxis_master::session;
use ecaxis_master::sys::rt_thread;
use ecaxis_sim::{SecondPort, Segment, ServeStats, Server};
use serde_json::{Value, json};

use ecaxis_master::text::pluralize;

use crate::access::{console, signals};
use crate::args::bus;
use crate::args::can_log::CanLog;
use crate::args::files::{Inputs, check_output, unwritable, write_new};
use crate::args::nic::NicArg;
use crate::args::trace::Trace;
use crate::hints::{self, Failure};
use crate::render::{note, result};

/// SCHED_FIFO priority of the simulated bus, below that of a master on the same computer.
const PRIORITY: u8 = 70;

const EXAMPLES: &str = "\
Examples:
  ecaxis sim m.toml --nic veth0             for a MainDevice at the other end
  ecaxis sim m.toml --nic veth0 --nic2 veth2
  ecaxis sim m.toml --nic veth0 --faults f.toml --sii eeproms
  ecaxis sim m.toml --nic veth0 --trace t.csv
  echo 'press start' | ecaxis sim m.toml --nic veth0

It reads lines such as `press start`, `release start`, `set io.Input 1 = 1`
from the standard input: inputs of simulated I/O devices.


`ip link add veth0 type veth peer name veth1` makes two interfaces that are
connected; needs root, or cap_net_raw.";

/// Serve the machine's simulated bus on a network interface until Ctrl-C
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Machine file
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Network interface to answer on; `IF,IF`: as `--nic` and `--nic2`
    #[arg(long, value_name = "IF")]
    nic: NicArg,
    /// Second interface of a MainDevice with cable redundancy: closes the bus to a ring
    #[arg(long, value_name = "IF")]
    nic2: Option<String>,
    /// Fault script
    #[arg(long, value_name = "FILE")]
    faults: Option<PathBuf>,
    /// Start the fault script at SIGUSR1 instead of the first frame, and again at each further
    /// SIGUSR1
    #[arg(long, requires = "faults")]
    faults_on_signal: bool,
    /// Write the state of every device to this CSV file, once per millisecond: AL state and code,
    /// age of the outputs, Controlword, Statusword, velocity of the motor shaft in turns per
    /// second, last pulse of SYNC0; times are CLOCK_MONOTONIC
    #[arg(long, value_name = "FILE")]
    trace: Option<PathBuf>,
    /// Write the frames of the simulated CAN networks to this file, as candump does
    #[arg(long, value_name = "FILE")]
    can_log: Option<PathBuf>,
    /// Write every device's EEPROM image to this folder first: 0.bin, 1.bin …; never overwrites
    /// other files
    #[arg(long, value_name = "FOLDER")]
    sii: Option<PathBuf>,
    /// Overwrite an existing trace or log
    #[arg(long)]
    force: bool,
    /// Print the statistics as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    pub verbosity: crate::args::Verbosity,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let second = match (&args.nic.second, &args.nic2) {
        (Some(_), Some(_)) => {
            let message = "--nic names both ends of the ring, and --nic2 names one of them again";
            return Err(Failure::new(hints::WRONG, message).hint("omit `--nic2`"));
        }
        (second, nic2) => second.as_ref().or(nic2.as_ref()),
    };
    let nics: Vec<&str> = [Some(&args.nic.first), second]
        .into_iter()
        .flatten()
        .map(String::as_str)
        .collect();
    if nics.contains(&"sim") {
        let message = "`sim` is this bus itself; it needs a network interface to answer on";
        return Err(Failure::new(hints::WRONG, message)
            .hint("`ecaxis run FILE --sim` needs no interface; `ip link add veth0 type veth peer name veth1` makes two that are connected"));
    }
    let mut machine = config::load(&args.file).map_err(|e| hints::config(&args.file, &e))?;
    let devices = machine.devices.len();
    let inputs = Inputs::from_machine(&machine).with("the fault script", &args.faults);
    let can_log = args.can_log.as_deref();
    let mut can_log = can_log
        .map(|path| CanLog::create(&mut machine, path, args.force, &inputs))
        .transpose()?;
    let ring = second.map(|_| SecondPort::Listens);
    let faults = args.faults.as_deref();
    let faults = faults.map(|f| bus::faults(f, &machine, ring)).transpose()?;
    let seed = faults
        .as_ref()
        .and_then(|f| f.seed)
        .unwrap_or(session::Options::default().seed);
    let (at_once, on_signal) = match args.faults_on_signal {
        true => (None, faults),
        false => (faults, None),
    };
    let mut segment = session::simulated_bus(&machine, seed, at_once.as_ref(), ring)
        .map_err(|error| hints::failure(&error, &machine.bus.nic))?;

    let stop = Arc::<CancelToken>::default();
    signals::stop_on_interrupt(&stop);
    let signalled = Arc::new(AtomicBool::new(false));
    if on_signal.is_some() {
        signals::raise_on_usr1(&signalled)
            .map_err(|e| Failure::new(hints::FAILED, format!("cannot wait for SIGUSR1: {e}")))?;
    }
    // Report an interface that cannot be opened before announcing the bus.
    for nic in &nics {
        match NicLink::open(nic, SocketKind::Packet) {
            Ok(_) => {}
            Err(
                e @ (OpenError::Down { .. } | OpenError::NoCarrier { .. } | OpenError::Mtu { .. }),
            ) => {
                let warning = hints::interface(Failure::new(hints::FAILED, e.to_string()), &e);
                note(&format!("warning: {}", warning.message));
                for hint in &warning.hints {
                    note(&format!("  = help: {hint}"));
                }
            }
            Err(e) => {
                return Err(hints::interface(
                    Failure::new(hints::FAILED, e.to_string()),
                    &e,
                ));
            }
        }
    }
    let locks = nics
        .iter()
        .map(|nic| lock(nic))
        .collect::<Result<Vec<_>, _>>()?;
    let server = Server::open(&nics).map_err(|e| hints::serve(&e))?;
    if let Some(folder) = &args.sii {
        write_images(&segment, folder)?;
    }
    let trace = args.trace.as_deref();
    let mut trace = trace
        .map(|path| create_trace(path, args.force, &inputs))
        .transpose()?;
    if on_signal.is_some() {
        let pid = std::process::id();
        note(&format!("`kill -USR1 {pid}` begins the fault script"));
    }
    let answer = if devices == 1 { "answers" } else { "answer" };
    let (devices, nics) = (
        pluralize(devices, "simulated SubDevice"),
        nics.join("` and `"),
    );
    note(&format!("{devices} {answer} on `{nics}`; Ctrl-C ends it"));
    let lines = console::lines()?;
    // Real devices answer independently of the computer's load.
    for denied in rt_thread::become_realtime(PRIORITY, None) {
        note(&format!("warning: {denied}"));
    }
    let stats = server
        .serve(
            &mut segment,
            || stop.is_cancelled(),
            |segment, now| {
                while let Ok(line) = lines.try_recv() {
                    switch_input(segment, &machine, &line);
                }
                if let Some(script) = &on_signal
                    && signalled.swap(false, Ordering::Relaxed)
                {
                    segment.start_faults(script.clone(), now);
                }
                if let Some(log) = &mut can_log
                    && let Err(e) = log.write()
                {
                    note(&format!("warning: writing the CAN log: {e}; it ends here"));
                    can_log = None;
                }
                if let Some(to) = &mut trace
                    && let Err(e) = to.sample(segment, now)
                {
                    note(&format!("warning: writing the trace: {e}; it ends here"));
                    trace = None;
                }
            },
        )
        .map_err(|e| hints::serve(&e))?;
    drop(locks);
    let report = report(&stats, &segment);
    result(&if args.json {
        format!("{report:#}\n")
    } else {
        text(&report)
    })
}

/// Carries out a line of the console.
fn switch_input(segment: &mut Segment, machine: &Machine, line: &str) {
    if line.trim().is_empty() {
        return;
    }
    let help = "write `press start`, `release start`, or `set io.Input 1 = 1`";
    match machine.parse_input_line(line) {
        None => note(&format!("`{}`: not understood; {help}", line.trim())),
        Some(Err(why)) => note(&format!("`{}`: {why}", line.trim())),
        Some(Ok(input)) => {
            if let Some(device) = segment.device_mut(input.position) {
                device.set_input(input.index, input.sub, input.value);
            }
        }
    }
}

/// Locks an interface: two simulated buses would both answer each frame. Returns `None` if the
/// system has no locks.
fn lock(nic: &str) -> Result<Option<NicLock>, Failure> {
    NicLock::take(nic).map_err(|NicInUse { pid }| {
        let pid = pid.map_or_else(String::new, |pid| format!(" (pid {pid})"));
        let message = format!("another ecaxis{pid} uses `{nic}`, as a simulated bus or a master");
        Failure::new(hints::FAILED, message)
            .hint("end that one with Ctrl-C, or answer on another interface")
    })
}

fn create_trace(path: &Path, force: bool, inputs: &Inputs) -> Result<Trace, Failure> {
    check_output("--trace", path, force, inputs)?;
    let file = std::fs::File::create(path).and_then(Trace::new);
    file.map_err(|error| unwritable(path, &error))
}

fn write_images(segment: &Segment, folder: &Path) -> Result<(), Failure> {
    std::fs::create_dir_all(folder).map_err(|error| unwritable(folder, &error))?;
    for (position, device) in devices(segment) {
        let path = folder.join(format!("{position}.bin"));
        // Keep an identical image from an earlier start.
        if std::fs::read(&path).is_ok_and(|there| there == device.sii()) {
            continue;
        }
        write_new(&path, device.sii())?;
    }
    Ok(())
}

fn devices(segment: &Segment) -> impl Iterator<Item = (usize, &ecaxis_sim::SimDevice)> {
    (0..segment.len()).filter_map(|n| Some((n, segment.device(n)?)))
}

fn report(stats: &ServeStats, segment: &Segment) -> Value {
    let turnaround = &stats.turnaround;
    let us = |share| turnaround.quantile(share).map(|ns| ns as f64 / 1e3);
    let devices: Vec<Value> = devices(segment)
        .map(|(position, device)| {
            json!({
                "position": position,
                "type": device.name(),
                "state": device.al_state().to_string(),
                "al_status_code": device.al_status_code(),
            })
        })
        .collect();
    let faults: Vec<Value> = segment
        .fault_progress()
        .map(|fault| {
            json!({
                "line": fault.line,
                "kind": fault.name,
                "began": fault.began,
                "ended": fault.ended,
                "frames": fault.frames,
            })
        })
        .collect();
    json!({
        "frames": stats.frames,
        "answered": stats.answered,
        "lost": stats.lost,
        "duplicated": stats.duplicated,
        "delayed": stats.delayed,
        "malformed": stats.malformed,
        "not_ethercat": stats.foreign,
        "not_sent": stats.send_errors,
        "turnaround_us": { "p50": us(0.5), "p99": us(0.99), "max": us(1.0) },
        "devices": devices,
        "faults": faults,
    })
}

fn text(report: &Value) -> String {
    let mut text = format!(
        "{} frames received, {} replies sent, {} lost, {} duplicated, {} delayed\n{} malformed, {} not EtherCAT, {} not sent\n",
        report["frames"],
        report["answered"],
        report["lost"],
        report["duplicated"],
        report["delayed"],
        report["malformed"],
        report["not_ethercat"],
        report["not_sent"],
    );
    let turnaround = |share| report["turnaround_us"][share].as_f64();
    if let (Some(p50), Some(p99), Some(max)) =
        (turnaround("p50"), turnaround("p99"), turnaround("max"))
    {
        text += &format!("turnaround: p50 {p50:.1} µs, p99 {p99:.1} µs, max {max:.1} µs\n");
    }
    for device in report["devices"].as_array().into_iter().flatten() {
        let name = |key| device[key].as_str().unwrap_or_default();
        text += &format!(
            "  {:>3}  {:<24} {}",
            device["position"],
            name("type"),
            name("state"),
        );
        match device["al_status_code"].as_u64() {
            None | Some(0) => {}
            Some(code) => text += &format!(", error {code:#06x}"),
        }
        text.push('\n');
    }
    for fault in report["faults"].as_array().into_iter().flatten() {
        let name = fault["kind"].as_str().unwrap_or_default();
        text += &format!("  fault of line {}, {name}: ", fault["line"]);
        text += match (fault["began"].as_bool(), fault["ended"].as_bool()) {
            (Some(false), _) => "did not begin",
            (_, Some(false)) => "lasts",
            _ => "over",
        };
        if let Some(frames) = fault["frames"].as_u64() {
            text += &format!(", {frames} frames");
        }
        text.push('\n');
    }
    text
}
