//! The command sequences of the application notes, as machine files.

use ecaxis_axis::{Command, Mode};
use ecaxis_master::session::{AxisLine, Progress, Summary};
use ecaxis_test_support::script::{Act, move_to, perform_well, velocity};
use ecaxis_test_support::{Heard, load, run, virtual_time};

/// Runs one of the samples. Returns the summary, the reported lines (one per second), and the
/// started steps.
fn sample(name: &str) -> (Summary, Vec<AxisLine>, Vec<String>) {
    let (outcome, Heard(heard)) = run(load(&format!("samples/{name}.toml")), virtual_time());
    if let Err(error) = outcome.result {
        panic!("{name}: {error}");
    }
    let summary = outcome.summary.expect("the cycle has run");
    let axis = &summary.axes[0];
    assert_eq!((&axis.fault, &axis.trip), (&None, &None), "{name}");
    let mut lines = Vec::new();
    let mut steps = Vec::new();
    for progress in heard {
        match progress {
            Progress::Status(status) => lines.push(status.axes[0].clone()),
            Progress::Program { step, .. } => steps.push(step.number),
            _ => {}
        }
    }
    println!(
        "{name}: {:.2} s, {:?}",
        summary.machine_seconds, summary.axes[0]
    );
    (summary, lines, steps)
}

fn largest(lines: &[AxisLine], of: impl Fn(&AxisLine) -> f64) -> f64 {
    lines.iter().map(of).fold(f64::NEG_INFINITY, f64::max)
}

#[test]
fn csp_moves_ten_turns_and_back() {
    let (summary, _, steps) = sample("csp");
    let repeated = ["4.1", "4.2", "4.3", "4.4"];
    assert_eq!(steps, [&["1", "2", "3"][..], &repeated, &repeated].concat());
    let axis = &summary.axes[0];
    assert_eq!(axis.final_error_counts, Some(0), "{axis:?}");
    assert_eq!(axis.target_position, 0.0);
    // Ten turns at 25 turns/s and 150 turns/s² take 0.567 s: two moves there, two back, and 1.4 s
    // of dwell.
    assert!((summary.machine_seconds - 3.7).abs() < 1.5, "{summary:?}");
}

#[test]
fn homing_finds_the_switch_and_the_index_below_it() {
    let (summary, lines, _) = sample("homing");
    let axis = &summary.axes[0];
    assert_eq!(
        (axis.target_position, axis.final_error_counts),
        (0.0, Some(0))
    );
    // The switch starts at 4.0, and the index below it is at 3.1. This takes 2.4 s at 100 rpm, and
    // 5.4 s for 0.9 turns at 10 rpm.
    assert!(largest(&lines, |l| l.position) > 3.0, "{lines:?}");
}

#[test]
fn ppm_moves_absolutely_and_relatively() {
    let (summary, lines, steps) = sample("ppm");
    assert_eq!(steps, ["1", "2", "3", "4", "5"]);
    let axis = &summary.axes[0];
    assert_eq!(lines.last().map(|l| l.mode), Some(Mode::Pp));
    assert!(axis.final_position.abs() <= 0.0005, "{axis:?}");
    let furthest = largest(&lines, |l| l.position);
    let fastest = largest(&lines, |l| l.velocity.abs());
    assert!(furthest > 10.0 && furthest < 15.01, "{furthest}");
    assert!(fastest < 17.0, "{fastest}");
}

#[test]
fn pvm_reverses_and_halts() {
    let (_, lines, _) = sample("pvm");
    let velocities: Vec<f64> = lines.iter().map(|l| l.velocity).collect();
    for wanted in [16.667, -16.667] {
        assert!(
            velocities.iter().any(|v| (v - wanted).abs() < 0.2),
            "{wanted}: {velocities:?}"
        );
    }
    assert_eq!(lines.last().map(|l| l.mode), Some(Mode::Pv));
}

#[test]
fn csv_reverses_and_stops() {
    let (_, lines, _) = sample("csv");
    let velocities: Vec<f64> = lines.iter().map(|l| l.velocity).collect();
    for wanted in [16.667, -16.667] {
        assert!(
            velocities.iter().any(|v| (v - wanted).abs() < 0.2),
            "{wanted}: {velocities:?}"
        );
    }
}

#[test]
fn cst_accelerates_and_coasts() {
    let (_, lines, _) = sample("cst");
    assert!(
        lines.iter().any(|l| (l.torque - 10.0).abs() < 0.5),
        "{lines:?}"
    );
    assert!(largest(&lines, |l| l.velocity) > 20.0, "{lines:?}");
}

/// Halt stops the drive's own profiles half way.
#[test]
fn ppm_and_pvm_stop_by_halt() {
    let acts = [
        Act::Do(Command::SetMode(Mode::Pp)),
        Act::Begin(Command::MoveTo {
            position: 50.0,
            speed: 0.5,
            ramp: 1.0,
        }),
        Act::Above(5.0),
        Act::Do(Command::Stop),
        Act::Dwell(0.5),
        // The axis does not continue to the old target, but to a new one.
        move_to(1.0, 0.5),
    ];
    let trace = perform_well(load("samples/ppm.toml"), "x", &acts, virtual_time());
    let stood = trace.of(4);
    assert!((5.0..8.0).contains(&trace.at_end_of(4).position));
    let moved = trace.at_end_of(4).position - stood[200].position;
    assert!(moved.abs() < 0.001, "{moved}");
    assert!((trace.at_end_of(5).position - 1.0).abs() <= 0.0005);

    let acts = [
        Act::Do(Command::SetMode(Mode::Pv)),
        velocity(20.0),
        Act::Dwell(0.2),
        Act::Do(Command::Stop),
        Act::Dwell(0.5),
    ];
    let trace = perform_well(load("samples/pvm.toml"), "x", &acts, virtual_time());
    let stood = trace.of(4);
    let moved = trace.at_end_of(4).position - stood[200].position;
    assert!(moved.abs() < 0.001, "{moved}");
}
