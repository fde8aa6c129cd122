//! The machine of a machine file on its own bus. A normal session brings the bus up and down.

use std::sync::Arc;

use super::measure::Measured;
use super::plan::Plan;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::Machine;
use ecaxis_master::rt::spin::Spin;
use ecaxis_master::session::{self, Error, Observer, Options, Outcome};

/// Runs the machine for the plan's time. Without `enable` it stays in Op without power. Returns
/// `None` if it was interrupted before the first cycle.
///
/// # Errors
/// Fails like a run of this machine.
pub fn run(
    machine: &Machine,
    enable: bool,
    plan: &Plan,
    spin: Spin,
    stop: &Arc<CancelToken>,
    observer: &mut dyn Observer,
) -> Result<Option<Measured>, Error> {
    let mut machine = machine.clone();
    machine.bus.spin = spin;
    machine.bus.cpu = Some(plan.cpu);
    machine.bus.priority = plan.priority;
    let options = Options {
        limit: u64::try_from(plan.time.as_nanos()).ok(),
        enable,
        ..Options::default()
    };
    let outcome = session::run(machine, options, Arc::clone(stop), observer);
    let Outcome {
        summary,
        result,
        stats,
        ..
    } = outcome;
    match result {
        Ok(()) => {}
        Err(error) if error.is_interruption() && stats.is_none() => return Ok(None),
        Err(error) if error.is_interruption() => {}
        Err(error) => return Err(error),
    }
    let (Some(stats), Some(summary)) = (stats, summary) else {
        return Ok(None);
    };
    let mut measured = Measured {
        stats: *stats,
        ..Measured::default()
    };
    if let Some(thread) = summary.thread {
        measured.used = thread.used;
        measured.spin_ns = thread.spin_ns;
    }
    let turns = summary.counters.cycles + summary.counters.overruns;
    measured.wall_ns = turns * summary.cycle_ns;
    Ok(Some(measured))
}
