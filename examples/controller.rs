//! A user-defined control loop in the cycle: `x` swings like a pendulum, `y` mirrors `x`, and a
//! lamp is on while `x` is right of the middle. After five swings, the machine comes to rest.
//!
//! ```sh
//! cargo run --example controller                      # on the simulated bus
//! cargo run --example controller -- machine.toml      # with axes x and y and an output
//! ```
//!
//! The controller gives set-points and reads actual values. Enabling, limits, supervision, lost
//! frames and the stop work as in every other run.

#![allow(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a program of its own"
)]

use std::error::Error;
use std::f64::consts::TAU;
use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::Arc;

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::{self, AxisRef, OutputRef};
use ecaxis_master::rt::controller::{Controller, CycleContext};
use ecaxis_master::session::{self, Observer, Options, Progress, SignalReport};

/// In user units; the other constants are in seconds and swings.
const AMPLITUDE: f64 = 20.0;
const PERIOD_S: f64 = 1.0;
const SWINGS: f64 = 5.0;

struct Pendulum {
    x: AxisRef,
    y: AxisRef,
    lamp: OutputRef,
    /// The start positions of both axes, once the swinging has started.
    start: Option<[f64; 2]>,
    elapsed_s: f64,
}

impl Controller for Pendulum {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        let (x, y) = (machine.axis(self.x), machine.axis(self.y));
        if machine.stopping() || !(x.ready && y.ready) {
            return;
        }
        let [x_start, y_start] = *self
            .start
            .get_or_insert([x.target_position, y.target_position]);
        self.elapsed_s += machine.dt_s();
        let turns = self.elapsed_s / PERIOD_S;
        // The motion starts and ends at rest: the swing grows in its first period and decays in its
        // last.
        let swell = turns.min(SWINGS - turns).clamp(0.0, 1.0);
        let swell = swell * swell * (3.0 - 2.0 * swell);
        let to_x = x_start + AMPLITUDE * swell * (TAU * turns).sin();
        let to_y = y_start - (to_x - x_start);
        // A set-point beyond the limits is rejected, and its axis brakes.
        let refused =
            machine.set_point(self.x, to_x).is_err() || machine.set_point(self.y, to_y).is_err();
        machine.set(self.lamp, f64::from(u8::from(x.position > x_start)));
        if refused || turns >= SWINGS {
            machine.finish();
        }
    }
}

struct Print;

impl Observer for Print {
    fn progress(&mut self, progress: &Progress) {
        say(&format!("{progress:?}"));
    }
}

/// Prints a line; unlike `eprintln!`, does not panic if stderr is closed.
fn say(text: &str) {
    let _ = writeln!(io::stderr(), "{text}");
}

fn main() -> Result<(), Box<dyn Error>> {
    let file = std::env::args_os().nth(1).map_or_else(
        || {
            PathBuf::from(concat!(
                env!("CARGO_MANIFEST_DIR"),
                "/../configs/controller.toml"
            ))
        },
        PathBuf::from,
    );
    let mut machine = config::load(&file)?;
    let pendulum = Pendulum {
        x: machine.axis("x")?,
        y: machine.axis("y")?,
        lamp: machine.output("io", "Output 1")?,
        start: None,
        elapsed_s: 0.0,
    };
    let stop = Arc::<CancelToken>::default();
    // Ctrl-C, SIGTERM and a closing terminal bring the axes to rest.
    session::stop_on_signals(Arc::clone(&stop), |report| match report {
        SignalReport::StopRepeated => std::process::exit(1),
        report => say(&report.to_string()),
    })?;
    let outcome = session::run_with(
        machine,
        Options::default(),
        stop,
        &mut Print,
        Box::new(pendulum),
    );
    outcome.result?;
    if outcome.summary.as_ref().is_some_and(|s| s.interrupted) {
        std::process::exit(130);
    }
    if let Some(summary) = outcome.summary {
        println!("{} cycles", summary.counters.cycles);
        for axis in summary.axes {
            println!("{}: {:.3} {}", axis.name, axis.final_position, axis.unit);
        }
    }
    Ok(())
}
