//! Stops of a machine for every cause: the set-points that reach the drives, read from the
//! recording, and the final report of the run.

use std::path::Path;

use ecaxis_master::config::Machine;
use ecaxis_master::session::Options;
use ecaxis_test_support::recordings::{Frame, frames, process_images};
use ecaxis_test_support::{
    assert_contains, axes, faults, machine, recorded, run, run_badly, run_well, virtual_time,
};

/// Counts per turn. STEP is the largest set-point change in a cycle of 1 ms at 50 turns/s.
const COUNTS: i64 = 2000;
const STEP: i64 = 50 * COUNTS / 1000;
/// The same at the speed of [`patient`].
const SLOW_STEP: i64 = STEP * 2 / 5;
const OPERATION_ENABLED: u16 = 0x0f;

/// The data of one cycle that reached the drives: Controlword and target position of each axis.
type Outputs = Vec<(u16, i32)>;

/// Returns the sent process data of the cyclic frames that came back, which the drives received.
fn delivered_bytes(recording: &Path) -> Vec<Vec<u8>> {
    let images = process_images(recording).into_iter();
    images.map(|(sent, _)| sent).collect()
}

/// Returns Controlword and target position of every axis in CSP of the project's ESI: 12 bytes out,
/// 13 in.
fn delivered(recording: &Path, axes: usize) -> Vec<Outputs> {
    const REGION: usize = 13;
    let axis = |data: &[u8], i: usize| {
        let at = i * REGION;
        let word = u16::from_le_bytes([data[at], data[at + 1]]);
        let target = data[at + 2..at + 6].try_into().expect("four bytes");
        (word, i32::from_le_bytes(target))
    };
    delivered_bytes(recording)
        .iter()
        .map(|data| (0..axes).map(|i| axis(data, i)).collect())
        .collect()
}

/// Returns the largest change of an enabled axis' target between two frames that reached the drive.
fn largest_step(cycles: &[Outputs], axis: usize) -> i64 {
    cycles
        .windows(2)
        .filter(|pair| pair[0][axis].0 == OPERATION_ENABLED && pair[1][axis].0 == OPERATION_ENABLED)
        .map(|pair| (i64::from(pair[1][axis].1) - i64::from(pair[0][axis].1)).abs())
        .max()
        .expect("the axis was enabled")
}

/// Returns axes with a tolerance of 20 lost frames. They move at two fifths of their limit: a drive
/// that loses its targets at full speed overshoots, and its way back would trip the supervision.
fn patient(count: usize) -> Machine {
    let text = axes(count).replace("cycle =", "lost_frames = 20\ncycle =");
    machine(&text.replace("\nmove =", "\nspeed = 0.4\nmove ="))
}

#[test]
fn no_set_point_jumps_after_a_burst_of_lost_frames() {
    for count in [1, 2, 3, 10, 19] {
        let folder = tempfile::tempdir().expect("a folder");
        let script = format!("[[fault]]\nkind = \"frame-loss\"\nat = \"1.5s\"\ncount = {count}\n");
        let (options, path) = recorded(faults(&script), folder.path());
        let summary = run_well(patient(2), options);
        assert!(
            summary.counters.lost_frames >= count,
            "{:?}",
            summary.counters
        );
        let cycles = delivered(&path, 2);
        assert!(cycles.len() > 3000, "{} cycles", cycles.len());
        for axis in 0..2 {
            let step = largest_step(&cycles, axis);
            assert!(step >= SLOW_STEP - 1, "the axis reached its speed: {step}");
            assert!(
                step <= 3 * SLOW_STEP + 1,
                "{count} lost: a step of {step} counts"
            );
        }
        assert!(
            summary
                .axes
                .iter()
                .all(|a| a.final_error_counts.is_some_and(|e| e.abs() <= 1))
        );
    }
}

/// A frame that comes back without the answer of one device brings the others their targets: they
/// decelerate within their limits, also if frames are lost as the device goes.
#[test]
fn a_lost_device_makes_no_other_set_point_step() {
    let exchanges = ["same-cycle", "pipelined"];
    for (at_us, exchange) in (0..10).flat_map(|n| exchanges.map(|of| (1_500_000 + n * 100, of))) {
        let folder = tempfile::tempdir().expect("a folder");
        let script = format!("[[fault]]\nkind = \"power-off\"\nat = \"{at_us}us\"\ndevice = 1\n");
        let (options, path) = recorded(faults(&script), folder.path());
        let keys = format!("lost_frames = 3\nexchange = \"{exchange}\"\ncycle =");
        let text = axes(2).replacen("cycle =", &keys, 1);
        let (error, _) = run_badly(machine(&text), options);
        assert_contains(&error, &["`a1`", "no longer answers"]);
        let sent = frames(&path).into_iter().filter(|frame| frame.sent);
        let images: Vec<Vec<u8>> = sent.filter_map(|frame| frame.image()).collect();
        let targets: Vec<i64> = images
            .iter()
            .filter(|data| data[0] == OPERATION_ENABLED as u8)
            .map(|data| i64::from(i32::from_le_bytes([data[2], data[3], data[4], data[5]])))
            .collect();
        assert!(targets.len() > 500, "{} cycles", targets.len());
        for (cycle, three) in targets.windows(3).enumerate() {
            let change = three[2] - 2 * three[1] + three[0];
            assert!(
                change.abs() <= 2,
                "{exchange}, {at_us} µs: cycle {cycle} of {}, {three:?}",
                targets.len()
            );
        }
    }
}

#[test]
fn a_device_that_drops_out_is_not_enabled_when_it_returns() {
    let folder = tempfile::tempdir().expect("a folder");
    let script = "[[fault]]\nkind = \"absent\"\ndevice = 1\nat = \"1.5s\"\n";
    let (options, path) = recorded(faults(script), folder.path());
    let (error, summary) = run_badly(machine(&axes(2)), options);
    assert!(
        error.contains("`a1`") && error.contains("no longer answers"),
        "{error}"
    );
    let cycles = delivered(&path, 2);
    let last_enabled = cycles
        .iter()
        .rposition(|c| c[0].0 == OPERATION_ENABLED)
        .expect("enabled");
    let first_enabled = cycles
        .iter()
        .position(|c| c[0].0 == OPERATION_ENABLED)
        .expect("enabled");
    assert!(
        last_enabled > first_enabled + 500,
        "it moved before the fault"
    );
    assert!(
        last_enabled < 1_750,
        "the healthy axis decelerates at once, until cycle {last_enabled}"
    );
    let last = cycles.last().expect("cycles");
    assert_eq!(
        last[0].0 & 0x0008,
        0,
        "the last Controlword takes power away: {last:?}"
    );
    assert!(summary.expect("ran").machine_seconds < 8.0);
}

#[test]
fn a_returning_bus_enables_no_axis() {
    let folder = tempfile::tempdir().expect("a folder");
    let script = "[[fault]]\nkind = \"frame-loss\"\nat = \"1.5s\"\ncount = 40\n";
    let (options, path) = recorded(faults(script), folder.path());
    let (error, summary) = run_badly(patient(2), options);
    assert!(error.contains("the bus is lost"), "{error}");
    let cycles = delivered(&path, 2);
    for axis in 0..2 {
        assert!(largest_step(&cycles, axis) <= 3 * STEP + 1);
        assert_eq!(cycles.last().expect("cycles")[axis].0 & 0x0008, 0);
    }
    for axis in summary.expect("ran").axes {
        assert_ne!(axis.final_state, "Operation enabled");
    }
}

#[test]
fn a_fault_while_the_machine_stops_fails_the_run() {
    let text = axes(2).replace("acceleration = 500.0", "acceleration = 25.0");
    // With a ramp of two seconds, the axes move at 1.2 s and stop at 1.6 s.
    let options = Options {
        limit: Some(1_000_000_000),
        ..faults("[[fault]]\nkind = \"drive-fault\"\ndevice = 1\nat = \"1.6s\"\ncode = 0x7305\n")
    };
    let (error, _) = run_badly(machine(&text), options);
    assert!(
        error.contains("`a1`") && error.contains("0x7305"),
        "{error}"
    );
}

#[test]
fn a_drive_that_stays_enabled_fails_the_run() {
    let script =
        "[[fault]]\nkind = \"stuck\"\ndevice = 1\nat = \"1.5s\"\nstate = \"operation-enabled\"\n";
    let (error, summary) = run_badly(machine(&axes(2)), faults(script));
    assert!(
        error.contains("`a1`") && error.contains("disabled"),
        "{error}"
    );
    assert!(summary.expect("ran").machine_seconds < 12.0, "bounded");
}

#[test]
fn a_machine_with_a_long_ramp_completes_its_stop() {
    // From 40 turns/s at 5 turns/s²: 8 s, longer than any fixed time-out.
    let text = axes(1)
        .replace("acceleration = 500.0", "acceleration = 5.0")
        .replace("[-100.0, 100.0]", "[-2000.0, 2000.0]")
        .replace("a0 = 80", "a0 = 1500");
    let options = Options {
        limit: Some(9_000_000_000),
        ..virtual_time()
    };
    let summary = run_well(machine(&text), options);
    let axis = &summary.axes[0];
    assert_eq!((&axis.fault, &axis.trip), (&None, &None), "{axis:?}");
    assert!(
        axis.final_error_counts.is_some_and(|e| e.abs() <= 1),
        "{axis:?}"
    );
    assert!(
        summary.machine_seconds > 15.0,
        "it took its ramp: {summary:?}"
    );
}

#[test]
fn a_fault_from_before_the_run_is_reset_once() {
    let script = "[[fault]]\nkind = \"drive-fault\"\ndevice = 0\nat = \"60ms\"\ncode = 0x3210\n";
    let (outcome, heard) = run(machine(&axes(2)), faults(script));
    outcome.result.expect("the fault is gone after its reset");
    let warnings = heard.warnings().join("\n");
    assert!(
        warnings.contains("`a0`") && warnings.contains("0x3210"),
        "{warnings}"
    );
}

#[test]
fn an_emergency_in_motion_is_reported_and_stops_nothing() {
    let script = "[[fault]]\nkind = \"emergency\"\ndevice = 1\nat = \"1.5s\"\ncode = 0x5000\n";
    let (outcome, heard) = run(machine(&axes(2)), faults(script));
    outcome.result.expect("an emergency alone is not a fault");
    let warnings = heard.warnings();
    let reported = warnings
        .iter()
        .filter(|w| w.contains("`a1`") && w.contains("0x5000"))
        .count();
    assert_eq!(reported, 1, "{warnings:?}");
}

#[test]
fn a_torque_limit_without_an_axis_keeps_the_value_of_the_drive() {
    let folder = tempfile::tempdir().expect("a folder");
    let options = Options {
        limit: Some(100_000_000),
        ..virtual_time()
    };
    let (options, path) = recorded(options, folder.path());
    let pdo = "mode = \"csp\"\npdo.rx = [\"0x6040:00\", \"0x607A:00\", \"0x6072:00\"]";
    run_well(machine(&axes(1).replace("mode = \"csp\"", pdo)), options);
    let cycles = delivered_bytes(&path);
    assert!(cycles.len() > 100);
    for data in cycles {
        assert_ne!(
            data[6..8],
            [0, 0],
            "a maximal torque of zero would hold the axis fast"
        );
    }
}

/// An input of the machine file stops all axes by the shortest method.
#[test]
fn an_emergency_input_stops_all_axes() {
    let text = axes(2)
        + r#"
[[device]]
name = "io"
esi = "esi/IO8.xml"
position = 2
[stop]
emergency = { io."Input 2" = true }
"#;
    let text = text.replacen(
        "[[step]]",
        "[[step]]\nset = { io.\"Output 2\" = true }\n[[step]]\ndwell = \"1s\"\n[[step]]",
        1,
    );
    let (error, summary) = run_badly(machine(&text), virtual_time());
    assert!(error.contains("emergency stop: io.Input 2 = 1"), "{error}");
    let summary = summary.expect("the cycle has run");
    assert!(summary.machine_seconds < 1.0, "{}", summary.machine_seconds);
    for axis in &summary.axes {
        assert!(
            axis.was_enabled && axis.final_state != "Operation enabled",
            "{axis:?}"
        );
    }
}

#[test]
fn the_other_axes_stop_by_the_configured_method() {
    let fault = "[[fault]]\nkind = \"drive-fault\"\ndevice = 0\nat = \"1s\"\ncode = 0x2310\n";
    let mut ways = Vec::new();
    for way in ["ramp", "quick-stop", "no-power"] {
        let text = format!("{}\n[stop]\nothers = \"{way}\"\n", axes(2));
        let (_, summary) = run_badly(machine(&text), faults(fault));
        let summary = summary.expect("the cycle has run");
        ways.push(summary.axes[1].final_position);
        assert_ne!(summary.axes[1].final_state, "Operation enabled");
    }
    // A ramp ends with power on, so its last position with power is the farthest.
    assert!(ways[0] > ways[2] && ways[1] > ways[2] - 1e-9, "{ways:?}");
}

/// An emergency shortens a stop that is already in progress.
#[test]
fn an_emergency_shortens_a_stop_in_progress() {
    let slow = axes(1).replacen("acceleration = 500.0", "acceleration = 10.0", 1)
        + "\n[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 1\n";
    // At the time limit the axis moves fast. The input is on since the first step, but counts as an
    // emergency only late.
    let stop = "\n[stop]\nemergency = { a0.\"0x6064\" = { above = 20000 } }\n";
    let mut options = virtual_time();
    options.limit = Some(1_900_000_000);
    let (outcome, _) = run(machine(&slow), options.clone());
    let without = outcome.summary.expect("the cycle has run");
    let (outcome, _) = run(machine(&(slow + stop)), options);
    let with = outcome.summary.expect("the cycle has run");
    assert!(
        without.axes[0].final_position > 12.0,
        "{:?}",
        without.axes[0]
    );
    assert!(
        with.axes[0].final_position < without.axes[0].final_position - 5.0,
        "{:?} {:?}",
        with.axes[0],
        without.axes[0]
    );
}

/// Only replies are lost, so the drives still receive frames. The quick stop is sent `lost_frames`
/// + 1 cycles after the last answer.
#[test]
fn a_lost_bus_causes_a_stop_within_a_cycle_of_the_limit() {
    const QUICK_STOP: u16 = 0x0004;
    for limit in [1_usize, 2, 3, 7] {
        let folder = tempfile::tempdir().expect("a folder");
        let script = "[[fault]]\nkind = \"frame-loss\"\nat = \"1.5s\"\nprobability = 1.0\n";
        let (options, path) = recorded(faults(script), folder.path());
        let text = axes(2).replace("cycle =", &format!("lost_frames = {limit}\ncycle ="));
        let (error, _) = run_badly(machine(&text), options);
        assert!(error.contains("the bus is lost"), "{error}");
        let frames = frames(&path).into_iter().filter(|frame| frame.cyclic);
        let frames: Vec<Frame> = frames.collect();
        let last_answer = frames.iter().rposition(|frame| !frame.sent);
        let unanswered: Vec<bool> = frames[last_answer.expect("answers before") + 1..]
            .iter()
            .map(|frame| frame.image().expect("outputs"))
            .map(|data| u16::from_le_bytes([data[0], data[1]]) & QUICK_STOP == 0)
            .collect();
        let stop = unanswered.iter().position(|stops| *stops);
        assert_eq!(stop, Some(limit), "of {}", unanswered.len());
    }
}
