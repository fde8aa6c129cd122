//! A user-defined controller in the cycle, supervised like other motion.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use ecaxis_axis::{Command, CommandError};
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::{self, Clock};
use ecaxis_master::config::{AxisRef, InputRef, Machine, OutputRef};
use ecaxis_master::rt::controller::{Controller, CycleContext};
use ecaxis_master::session::{Cause, Options, Outcome, run_with};
use ecaxis_test_support::{Heard, faults, load, virtual_time};

fn control(machine: Machine, controller: impl Controller + 'static) -> Outcome {
    control_with(virtual_time(), machine, controller)
}

fn control_with(
    options: Options,
    machine: Machine,
    controller: impl Controller + 'static,
) -> Outcome {
    let stop = Arc::<CancelToken>::default();
    let mut heard = Heard::default();
    run_with(machine, options, stop, &mut heard, Box::new(controller))
}

struct Closure<F>(F);

impl<F: FnMut(&mut CycleContext<'_>) + Send> Controller for Closure<F> {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        (self.0)(machine);
    }
}

#[derive(Clone, Copy)]
struct Names {
    x: AxisRef,
    y: AxisRef,
    lamp: OutputRef,
    seen: InputRef,
}

fn bench() -> (Machine, Names) {
    let mut machine = load("controller.toml");
    let names = Names {
        x: machine.axis("x").expect("an axis"),
        y: machine.axis("y").expect("an axis"),
        lamp: machine.output("io", "Output 1").expect("an output"),
        seen: machine.input("io", "0x6000:01").expect("an input"),
    };
    (machine, names)
}

#[test]
fn unknown_names_are_explained() {
    let (mut machine, _) = bench();
    let wrong = [
        machine.axis("z").map(|_| ()),
        machine.axis("io").map(|_| ()),
        machine.input("oi", "Input 1").map(|_| ()),
        machine.input("io", "Input 9").map(|_| ()),
        machine.output("x", "0x6040").map(|_| ()),
    ];
    let said: Vec<String> = wrong
        .into_iter()
        .map(|r| r.expect_err("means nothing").to_string())
        .collect();
    let expected = [
        "no axis is named `z`; axes: `x`, `y`",
        "no axis is named `io`; axes: `x`, `y`",
        "no device is named `oi`; devices: `x`, `y`, `io`",
        "`io` has no input \"Input 9\" in its process data; did you mean `Input 1`?",
        "`x.Controlword` is written by the axis `x` in line 7; a controller may not write it; give the axis \
         a command instead",
    ];
    assert_eq!(said, expected);
}

/// Covers set-points in each cycle, a command, an output, and the input that copies it.
#[test]
fn a_controller_moves_axes_and_reads_and_sets_signals() {
    let (machine, names) = bench();
    let reached = Arc::new(AtomicU64::new(0));
    let reported = Arc::clone(&reached);
    let mut elapsed = 0.0;
    let outcome = control(
        machine,
        Closure(move |machine: &mut CycleContext<'_>| {
            if machine.stopping() || !machine.axis(names.x).ready || !machine.axis(names.y).ready {
                return;
            }
            if elapsed == 0.0 {
                let to = Command::MoveTo {
                    position: -3.0,
                    speed: 1.0,
                    ramp: 1.0,
                };
                machine.command(names.y, to).expect("y is ready");
                machine.set(names.lamp, 1.0);
            }
            elapsed += machine.dt_s();
            let x = 5.0 - 5.0 * (elapsed * std::f64::consts::PI).cos();
            machine.set_point(names.x, x).expect("within the limits");
            if elapsed >= 1.0 && machine.axis(names.y).in_target {
                reported.store(machine.input(names.seen).to_bits(), Ordering::Relaxed);
                machine.finish();
            }
        }),
    );
    outcome.result.expect("runs");
    let axes = outcome.summary.expect("the cycle has run").axes;
    assert!(
        (axes[0].target_position - 10.0).abs() < 0.05,
        "{:?}",
        axes[0]
    );
    assert_eq!(axes[1].target_position, -3.0);
    assert_eq!(f64::from_bits(reached.load(Ordering::Relaxed)), 1.0);
}

/// A stalling computer skips cycles. The drives stop at their last targets, so motion must restart
/// from rest.
#[test]
fn motion_restarts_from_rest_after_skipped_cycles() {
    const SPEED: f64 = 50.0;
    const STALL: u64 = 40_000_000;
    let (machine, names) = bench();
    let seen = Arc::new(Mutex::new(Vec::new()));
    let reported = Arc::clone(&seen);
    let mut cycles = 0;
    let outcome = control(
        machine,
        Closure(move |machine: &mut CycleContext<'_>| {
            let status = machine.axis(names.x);
            if machine.stopping() || !status.ready {
                return;
            }
            cycles += 1;
            match cycles {
                1 => machine
                    .command(
                        names.x,
                        Command::Velocity {
                            velocity: SPEED,
                            ramp: 1.0,
                        },
                    )
                    .expect("x is ready"),
                100 => Clock::Virtual.relax(clock::now() + STALL),
                300 => machine.finish(),
                _ => {}
            }
            if cycles >= 100 {
                reported.lock().expect("no panic").push(status);
            }
        }),
    );
    outcome.result.expect("runs");
    let counters = outcome.summary.expect("the cycle has run").counters;
    assert!((38..=40).contains(&counters.overruns), "{counters:?}");
    let seen = seen.lock().expect("no panic");
    assert_eq!(seen[0].target_velocity, SPEED);
    let mut before = 0.0;
    for (n, status) in seen[1..].iter().enumerate() {
        let change = status.target_velocity - before;
        assert!(change <= 2.5 + 1e-6, "cycle {n}: {change} mm/s");
        let way = status.target_position - seen[n].target_position;
        // The first step returns to the last transmitted target.
        let most = status.target_velocity * 0.001 + 1e-6;
        assert!(way <= most, "cycle {n}: {way} mm");
        assert_eq!(status.trip, None);
        before = status.target_velocity;
    }
    assert_eq!(before, SPEED);
}

/// One frame in twenty is lost. The controller sees stale inputs exactly in these cycles.
#[test]
fn inputs_are_stale_exactly_in_cycles_with_lost_frames() {
    let script = "seed = 5\n[[fault]]\nkind = \"frame-loss\"\nprobability = 0.05\nat = \"2s\"\n";
    let (mut machine, names) = bench();
    machine.bus.lost_frames = 8;
    let seen = Arc::new(Mutex::new(Vec::new()));
    let reported = Arc::clone(&seen);
    let outcome = control_with(
        faults(script),
        machine,
        Closure(move |machine: &mut CycleContext<'_>| {
            let status = machine.axis(names.x);
            if machine.in_op() {
                let mut reported = reported.lock().expect("no panic");
                reported.push((machine.fresh(), status));
            }
            if status.ready && !machine.stopping() && status.target_velocity == 0.0 {
                let command = Command::Velocity {
                    velocity: 5.0,
                    ramp: 1.0,
                };
                machine.command(names.x, command).expect("x is ready");
            }
            if machine.number() == 6_000 {
                machine.finish();
            }
        }),
    );
    outcome.result.expect("nothing trips");
    let counters = outcome.summary.expect("the cycle has run").counters;
    let seen = seen.lock().expect("no panic");
    let stale = seen.iter().filter(|(fresh, _)| !fresh).count();
    assert!(stale > 150, "{counters:?}");
    assert_eq!(stale as u64, counters.lost_frames, "{counters:?}");
    let (mut moved, mut age) = (0, 0);
    for pair in seen.windows(2) {
        let [(_, before), (fresh, now)] = pair else {
            unreachable!("windows of two");
        };
        age = if *fresh { 0 } else { age + 1 };
        assert_eq!(now.stale_cycles, age);
        if *fresh {
            moved += usize::from(now.position != before.position);
        } else {
            assert_eq!(now.position, before.position);
        }
    }
    assert!(moved > 3_000, "it moves all the while: {moved}");
}

/// A set-point step never reaches the wire.
#[test]
fn a_set_point_jump_is_rejected_and_the_axis_brakes() {
    let (machine, names) = bench();
    let refused = Arc::new(AtomicU64::new(0));
    let reported = Arc::clone(&refused);
    let mut cycles = 0;
    let outcome = control(
        machine,
        Closure(move |machine: &mut CycleContext<'_>| {
            if cycles == 500 || !machine.axis(names.x).ready {
                return;
            }
            cycles += 1;
            for wrong in [30.0, f64::NAN, f64::INFINITY, -1e300] {
                if machine.set_point(names.x, wrong).is_err() {
                    reported.fetch_add(1, Ordering::Relaxed);
                }
            }
            if cycles == 500 {
                machine.finish();
            }
        }),
    );
    outcome.result.expect("runs");
    let x = &outcome.summary.expect("the cycle has run").axes[0];
    assert_eq!(refused.load(Ordering::Relaxed), 2000);
    assert!(x.final_position.abs() < 0.01, "{x:?}");
}

#[test]
fn a_controller_panic_stops_the_machine_within_its_limits() {
    let (machine, names) = bench();
    let mut moving = 0;
    let outcome = control(
        machine,
        Closure(move |machine: &mut CycleContext<'_>| {
            if !machine.axis(names.x).ready {
                return;
            }
            if moving == 0 {
                let to = Command::MoveTo {
                    position: 50.0,
                    speed: 1.0,
                    ramp: 1.0,
                };
                machine.command(names.x, to).expect("x is ready");
            }
            moving += 1;
            assert!(moving < 100, "on purpose");
        }),
    );
    let error = outcome.result.expect_err("it panicked");
    assert!(matches!(*error.cause, Cause::Controller), "{error:?}");
    let x = &outcome.summary.expect("the cycle has run").axes[0];
    // 0.1 s at 2500 mm/s², and the same time to rest: twice 12.5 mm.
    assert!((20.0..30.0).contains(&x.final_position), "{x:?}");
    assert_eq!((&x.fault, &x.trip), (&None, &None));
}

#[test]
fn a_stopping_machine_rejects_commands() {
    let (machine, names) = bench();
    let answer = Arc::new(AtomicU64::new(0));
    let reported = Arc::clone(&answer);
    let outcome = control(
        machine,
        Closure(move |machine: &mut CycleContext<'_>| {
            if machine.axis(names.x).ready {
                machine.finish();
            }
            if machine.stopping() {
                let refused = machine.command(names.x, Command::Enable)
                    == Err(CommandError::Stopping)
                    && machine.set_point(names.x, 0.0) == Err(CommandError::Stopping);
                reported.fetch_add(u64::from(refused), Ordering::Relaxed);
            }
        }),
    );
    outcome.result.expect("runs");
    assert!(answer.load(Ordering::Relaxed) > 0);
}
