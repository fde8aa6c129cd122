//! `ecaxis sim`: the machine file's bus, simulated, on a network interface for any MainDevice.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use ecaxis::config;
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
    let machine = config::load(&args.file).map_err(|e| hints::config(&args.file, &e))?;
    let faults = args.faults.as_deref().map(run::faults).transpose()?;
    let seed = faults
        .as_ref()
        .and_then(|f| f.seed)
        .unwrap_or(session::Options::default().seed);
    let segment = session::simulated_bus(&machine, seed, faults.as_ref())
        .map_err(|error| hints::run(&error, &machine.bus.nic))?;

    let stop = Arc::new(AtomicBool::new(false));
    signals::stop_on_interrupt(&stop);
    let (count, nic) = (machine.devices.len(), &args.nic);
    note(&format!(
        "{count} simulated SubDevices answer on `{nic}`; Ctrl-C ends it"
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
    ));
    Ok(())
}
