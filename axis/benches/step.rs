//! What an axis costs: 100 of them, each with its state machine, set-point, limits, supervision and
//! status, as the cycle does it.
//!
//! `cargo bench -p ecaxis-axis` prints the median of many short slices for every case.
//! `-- CASE CYCLES` does that many cycles of one case and nothing else, for counting instructions
//! from outside: take two counts and divide their difference.

#![allow(clippy::print_stdout, reason = "a benchmark's report")]

use std::hint::black_box;
use std::time::Instant;

use ecaxis_axis::{
    Axis, AxisConfig, Command, FeedForward, Inputs, Limits, Loops, Mode, Modes, Outputs,
    PositionPid, Scale, VelocityLoop,
};

const AXES: usize = 100;
const DT: f64 = 0.001;
const SLICES: usize = 1000;
const CYCLES: usize = 20;

const LIMITS: Limits = Limits {
    position: Some([-1e5, 1e5]),
    velocity: 50.0,
    acceleration: 500.0,
    jerk: None,
    torque: 100.0,
    following_error: Some(10.0),
};

/// The state machine, a trapezoid and the limits, nothing else; then with loops and offsets.
fn plain(mode: Mode) -> AxisConfig {
    let scale = Scale::new(2000.0, 1.0).expect("a valid scale");
    AxisConfig::new(mode, scale, LIMITS)
}

fn looped(mode: Mode) -> AxisConfig {
    AxisConfig {
        modes: Modes::only(Mode::Csp).with(Mode::Csv).with(Mode::Cst),
        loops: Loops {
            csp: FeedForward {
                velocity: 1.0,
                acceleration: 0.01,
            },
            csv: Some(VelocityLoop {
                kv: 10.0,
                feed_forward: 1.0,
            }),
            cst: Some(PositionPid {
                kp: 10.0,
                tn_s: Some(0.1),
                tv_s: 0.01,
                acceleration: 0.01,
            }),
        },
        dead_time_s: 0.003,
        ..plain(mode)
    }
}

/// One axis and a drive that follows each command at once.
struct Rig {
    axis: Axis,
    inputs: Inputs,
    target: f64,
}

impl Rig {
    fn new(config: AxisConfig) -> Self {
        let mode = config.mode;
        let mut rig = Self {
            axis: Axis::new(config).expect("a valid axis"),
            inputs: Inputs {
                statusword: 0x0240,
                position: Some(0),
                velocity: Some(0),
                torque: Some(0),
                mode_display: Some(mode.code()),
                fresh: true,
                ..Inputs::default()
            },
            target: 0.0,
        };
        rig.axis.step(&rig.inputs, DT);
        rig.axis.command(Command::Enable).expect("enables");
        for statusword in [0x0231, 0x0233, 0x1237] {
            rig.inputs.statusword = statusword;
            rig.axis.step(&rig.inputs, DT);
        }
        rig
    }

    fn step(&mut self) {
        let out: Outputs = self.axis.step(black_box(&self.inputs), DT);
        // What the drive makes of it.
        if out.mode == Mode::Csp.code() {
            let before = self.inputs.position.unwrap_or_default();
            let moved = out.target_position.wrapping_sub(before);
            self.inputs.position = Some(out.target_position);
            self.inputs.velocity = Some(moved.wrapping_mul(1000));
        } else {
            let status = self.axis.status();
            self.inputs.position = Some((status.target_position * 2000.0) as i32);
            self.inputs.velocity = Some((status.target_velocity * 2000.0) as i32);
        }
        black_box(out);
    }

    /// There and back, 40 turns, so that half of the time is ramps.
    fn order(&mut self) {
        self.target = if self.target > 0.0 { -20.0 } else { 20.0 };
        self.axis
            .command(Command::MoveTo {
                position: self.target,
                speed: 1.0,
                ramp: 0.5,
            })
            .expect("moves");
    }
}

type Case = (&'static str, AxisConfig, fn(&mut Rig, usize));

/// What a snapshot takes besides.
fn status(rig: &mut Rig, cycle: usize) {
    trapezoid(rig, cycle);
    black_box(rig.axis.status());
}

fn hold(rig: &mut Rig, _: usize) {
    rig.step();
}

fn trapezoid(rig: &mut Rig, cycle: usize) {
    if cycle.is_multiple_of(1000) {
        rig.order();
    }
    rig.step();
}

fn cases() -> Vec<Case> {
    vec![
        ("hold", plain(Mode::Csp), hold),
        ("trapezoid", plain(Mode::Csp), trapezoid),
        ("trapezoid_and_status", plain(Mode::Csp), status),
        ("trapezoid_offsets", looped(Mode::Csp), trapezoid),
        ("trapezoid_csv_loop", looped(Mode::Csv), trapezoid),
        ("trapezoid_cst_pid", looped(Mode::Cst), trapezoid),
        (
            "jerk_limited",
            AxisConfig {
                jerk_limited: true,
                ..plain(Mode::Csp)
            },
            trapezoid,
        ),
    ]
}

/// Nanoseconds per axis and cycle, of each of `slices`. A slice is shorter than a scheduler's, so
/// that the least of them was not interrupted.
fn run(case: &Case, slices: usize, cycles: usize) -> Vec<f64> {
    let mut rigs: Vec<Rig> = (0..AXES).map(|_| Rig::new(case.1)).collect();
    let mut times = Vec::with_capacity(slices);
    for slice in 0..slices {
        let start = Instant::now();
        for cycle in slice * cycles..(slice + 1) * cycles {
            for rig in &mut rigs {
                (case.2)(rig, cycle);
            }
        }
        times.push(start.elapsed().as_nanos() as f64 / (cycles * AXES) as f64);
    }
    for rig in &rigs {
        let status = rig.axis.status();
        assert!(status.ready && status.guarded_cycles == 0, "{status:?}");
    }
    times
}

fn main() {
    let mut args = std::env::args()
        .skip(1)
        .filter(|arg| !arg.starts_with("--"));
    if let (Some(name), Some(cycles)) = (args.next(), args.next()) {
        let cycles = cycles.parse().expect("a number of cycles");
        for case in cases().iter().filter(|case| case.0 == name) {
            black_box(run(case, 1, cycles));
        }
        return;
    }
    for case in &cases() {
        let mut times = run(case, SLICES, CYCLES);
        times.sort_by(f64::total_cmp);
        println!(
            "{:20} {:6.1} ns per axis and cycle (median of {SLICES}; least {:.1}, most {:.1})",
            case.0,
            times[SLICES / 2],
            times[0],
            times[SLICES - 1]
        );
    }
}
