//! The controller on the simulated bus in virtual time: seconds of the machine take milliseconds,
//! and every run gives the same result.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::Clock;
use ecaxis_master::config::{self, AxisRef, Machine, Nic};
use ecaxis_master::rt::controller::{Controller, CycleContext};
use ecaxis_master::session::{self, Observer, Options, Outcome, Progress};

use @NAME@::{AMPLITUDE, Pendulum};

struct Quiet;

impl Observer for Quiet {
    fn progress(&mut self, _: &Progress) {}
}

fn machine() -> Machine {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("machine.toml");
    let mut machine = config::load(&file).expect("a correct machine file");
    machine.bus.nic = Nic::Sim;
    machine
}

fn run(machine: Machine, controller: Box<dyn Controller>, stop: Arc<CancelToken>) -> Outcome {
    let options = Options {
        clock: Clock::Virtual,
        ..Options::default()
    };
    session::run_with(machine, options, stop, &mut Quiet, controller)
}

/// Records the extreme position of `x` while the controller runs, and cancels the run there.
struct Watch {
    pendulum: Pendulum,
    x: AxisRef,
    /// In micrometres.
    farthest: Arc<AtomicU64>,
    cancel_at: f64,
    stop: Arc<CancelToken>,
}

impl Controller for Watch {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        let way = machine.axis(self.x).position.abs();
        let micrometres = (way * 1000.0) as u64;
        self.farthest.fetch_max(micrometres, Ordering::Relaxed);
        if way >= self.cancel_at {
            self.stop.cancel();
        }
        self.pendulum.cycle(machine);
    }
}

fn watch(cancel_at: f64) -> (Outcome, f64) {
    let mut machine = machine();
    let (farthest, stop) = (Arc::default(), Arc::<CancelToken>::default());
    let watch = Watch {
        pendulum: Pendulum::new(&mut machine).expect("axes x and y"),
        x: machine.axis("x").expect("an axis"),
        farthest: Arc::clone(&farthest),
        cancel_at,
        stop: Arc::clone(&stop),
    };
    let outcome = run(machine, Box::new(watch), stop);
    (outcome, farthest.load(Ordering::Relaxed) as f64 / 1000.0)
}

#[test]
fn pendulum_swings_and_returns_to_its_start() {
    let (outcome, farthest) = watch(f64::INFINITY);
    outcome.result.expect("the run succeeds");
    let summary = outcome.summary.expect("the cycle ran");
    assert_eq!(summary.counters.lost_frames, 0);
    assert!((farthest - AMPLITUDE).abs() < 0.5, "{farthest}");
    for axis in &summary.axes {
        assert!(axis.final_position.abs() < 0.01, "{axis:?}");
    }
}

/// What Ctrl-C does: the axes come to rest within their limits, then lose power.
#[test]
fn interrupted_run_comes_to_rest() {
    let (outcome, _) = watch(10.0);
    outcome.result.expect("a stop is not a failure");
    let summary = outcome.summary.expect("the cycle ran");
    assert!(summary.interrupted);
    for axis in &summary.axes {
        assert!(axis.final_position.abs() > 1.0, "{axis:?}");
        assert!(axis.final_position.abs() < AMPLITUDE, "{axis:?}");
    }
}
