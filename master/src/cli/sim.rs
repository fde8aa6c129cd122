//! `ecaxis sim`: the machine file's bus, simulated, on a network interface for any MainDevice.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use ecaxis::config;
use ecaxis::link::packet::{OpenError, PacketLink};
use ecaxis::rt::thread;
use ecaxis::session;

use super::{Failure, hints, note, result, run, signals};

/// SCHED_FIFO priority of the simulated bus; below that of a master on the same computer.
const PRIORITY: u8 = 70;

/// Serve the machine's bus, simulated, on a network interface until Ctrl-C
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Machine file
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Network interface to answer on
    #[arg(long, value_name = "IF")]
    nic: String,
    /// Fault script
    #[arg(long, value_name = "FILE")]
    faults: Option<PathBuf>,
    #[command(flatten)]
    pub verbosity: super::Verbosity,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    if args.nic == "sim" {
        let message = "`sim` is this bus itself; it needs a network interface to answer on";
        return Err(Failure::new(hints::WRONG, message)
            .hint("`ecaxis run FILE --sim` needs no interface; `ip link add veth0 type veth peer name veth1` makes two that are connected"));
    }
    let machine = config::load(&args.file).map_err(|e| hints::config(&args.file, &e))?;
    let devices = machine.devices.len();
    let faults = args.faults.as_deref();
    let faults = faults.map(|f| run::faults(f, devices)).transpose()?;
    let seed = faults
        .as_ref()
        .and_then(|f| f.seed)
        .unwrap_or(session::Options::default().seed);
    let segment = session::simulated_bus(&machine, seed, faults.as_ref())
        .map_err(|error| hints::run(&error, &machine.bus.nic))?;

    let stop = Arc::new(AtomicBool::new(false));
    signals::stop_on_interrupt(&stop);
    let nic = &args.nic;
    // What cannot be opened is told before anything is said to answer.
    match PacketLink::open(nic) {
        Ok(_) => {}
        Err(e @ (OpenError::Down { .. } | OpenError::NoCarrier { .. } | OpenError::Mtu { .. })) => {
            note(&format!("warning: {e}"));
        }
        Err(e) => {
            return Err(hints::interface(
                Failure::new(hints::FAILED, e.to_string()),
                &e,
            ));
        }
    }
    note(&format!(
        "{devices} simulated SubDevice{} answer{} on `{nic}`; Ctrl-C ends it",
        if devices == 1 { "" } else { "s" },
        if devices == 1 { "s" } else { "" },
    ));
    // Devices of silicon answer whatever else the computer does.
    for denied in thread::prepare(PRIORITY, None) {
        note(&format!("warning: {denied}"));
    }
    let stats = ecaxis_sim::serve(segment, nic, &stop).map_err(|e| hints::serve(&e))?;
    result(&format!(
        "{} frames answered, {} lost on purpose, {} not sent\n",
        stats.frames.saturating_sub(stats.lost + stats.send_errors),
        stats.lost,
        stats.send_errors,
    ))
}
