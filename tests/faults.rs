//! What goes wrong on a bus, and what the machine does and says then. Simulated, virtual time.

mod common;

use common::{axes, faults, machine, run_badly, run_well, virtual_time};
use ecaxis::session::Options;

/// The error must name every one of these.
#[track_caller]
fn says(text: &str, parts: &[&str]) {
    for part in parts {
        assert!(text.contains(part), "`{part}` is not in: {text}");
    }
}

#[test]
fn nobody_answers() {
    let (error, summary) = run_badly(machine(&axes(2)), faults("[[fault]]\nkind = \"silent\"\n"));
    says(&error, &["no SubDevice answers"]);
    assert!(summary.is_none());
}

#[test]
fn one_sub_device_too_few() {
    let (error, _) = run_badly(
        machine(&axes(2)),
        faults("[[fault]]\nkind = \"absent\"\ndevice = 1\n"),
    );
    says(&error, &["`a1`", "position 1", "missing"]);
}

#[test]
fn another_device_than_the_esi_describes() {
    let script = "[[fault]]\nkind = \"identity\"\ndevice = 1\nproduct = 0x1234\n";
    let (error, _) = run_badly(machine(&axes(2)), faults(script));
    says(
        &error,
        &["`a1`", "position 1", "identify", "0x00001234", "EPOS4.xml"],
    );
}

#[test]
fn a_start_up_sdo_is_aborted() {
    let script =
        "[[fault]]\nkind = \"sdo-abort\"\ndevice = 1\nindex = 0x6060\nsub = 0\ncode = 0x06090030\n";
    let (error, _) = run_badly(machine(&axes(2)), faults(script));
    says(&error, &["`a1`", "start-up SDO", "0x6060:00", "06090030"]);
}

#[test]
fn safe_op_is_refused() {
    let script =
        "[[fault]]\nkind = \"refuse-state\"\ndevice = 0\nstate = \"safeop\"\ncode = 0x001e\n";
    let (error, _) = run_badly(machine(&axes(2)), faults(script));
    says(&error, &["`a0`", "SafeOp", "0x001e"]);
}

#[test]
fn op_is_refused() {
    let script = "[[fault]]\nkind = \"refuse-state\"\ndevice = 1\nstate = \"op\"\ncode = 0x002c\n";
    let (error, _) = run_badly(machine(&axes(2)), faults(script));
    says(&error, &["`a1`", "Op", "0x002c"]);
}

#[test]
fn a_drive_never_reaches_operation_enabled() {
    let script = "[[fault]]\nkind = \"stuck\"\ndevice = 0\nstate = \"switch-on-disabled\"\n";
    let (error, summary) = run_badly(machine(&axes(2)), faults(script));
    says(
        &error,
        &["`a0`", "Operation enabled", "Switch on disabled", "5000 ms"],
    );
    let summary = summary.expect("the cycle ran");
    assert!(
        summary
            .axes
            .iter()
            .all(|axis| axis.final_state != "Operation enabled"),
        "{summary:?}"
    );
}

#[test]
fn a_drive_faults_in_motion_and_the_others_stop_within_their_limits() {
    let script = "[[fault]]\nkind = \"drive-fault\"\ndevice = 1\nat = \"1.5s\"\ncode = 0x8611\n";
    let (error, summary) = run_badly(machine(&axes(3)), faults(script));
    says(&error, &["`a1`", "drive fault", "0x8611"]);
    let summary = summary.expect("the cycle ran");
    for axis in [&summary.axes[0], &summary.axes[2]] {
        assert!(axis.was_enabled);
        // A ramp from 50 turns a second at 500 turns/s² takes 2.5 turns; following it to the end
        // leaves the axis on its set-point.
        assert!(
            axis.final_error_counts.is_none_or(|e| e.abs() < 200),
            "{axis:?}"
        );
        assert!(
            (axis.final_position - axis.target_position).abs() < 0.1,
            "{axis:?}"
        );
        assert_ne!(axis.final_state, "Operation enabled");
        assert_eq!(axis.trip, None);
    }
    assert!(
        summary.axes[1]
            .fault
            .as_deref()
            .is_some_and(|f| f.contains("0x8611")),
        "{summary:?}"
    );
}

#[test]
fn fewer_lost_frames_than_the_limit_change_nothing() {
    let script = "[[fault]]\nkind = \"frame-loss\"\nat = \"1.5s\"\ncount = 2\n";
    let summary = run_well(machine(&axes(2)), faults(script));
    assert!(summary.counters.lost_frames >= 1, "{:?}", summary.counters);
    assert!(
        summary
            .axes
            .iter()
            .all(|a| a.final_error_counts.is_some_and(|e| e.abs() <= 1))
    );
}

#[test]
fn a_lost_bus_stops_the_machine() {
    let script = "[[fault]]\nkind = \"frame-loss\"\nat = \"1.5s\"\nprobability = 1.0\n";
    let (error, summary) = run_badly(machine(&axes(2)), faults(script));
    says(
        &error,
        &["the bus is lost", "3 cycles", "without an answer"],
    );
    assert!(summary.expect("the cycle ran").counters.lost_frames >= 3);
}

#[test]
fn lost_frames_during_bring_up_are_repeated() {
    let script =
        "seed = 3\n[[fault]]\nkind = \"frame-loss\"\nprobability = 0.01\nfor = \"300ms\"\n";
    run_well(machine(&axes(2)), faults(script));
}

#[test]
fn a_move_that_the_machine_ends_early_is_still_a_controlled_stop() {
    let options = Options {
        limit: Some(300_000_000),
        ..virtual_time()
    };
    let summary = run_well(machine(&axes(1)), options);
    assert!(
        summary.axes[0]
            .final_error_counts
            .is_none_or(|e| e.abs() <= 50),
        "{summary:?}"
    );
}
