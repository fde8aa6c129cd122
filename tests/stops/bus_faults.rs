//! Bus faults, and the machine's reactions and messages. Simulated, virtual time.

use ecaxis_master::session::Options;
use ecaxis_test_support::{
    assert_contains, axes, faults, machine, run, run_badly, run_well, virtual_time,
};

#[test]
fn a_silent_bus_is_reported() {
    let (error, summary) = run_badly(machine(&axes(2)), faults("[[fault]]\nkind = \"silent\"\n"));
    assert_contains(&error, &["no SubDevice answers"]);
    assert!(summary.is_none());
}

/// A device without a processor copies AL control to AL status, including the acknowledge bit of
/// the MainDevice.
#[test]
fn a_temporarily_silent_bus_is_not_reported_as_a_rejected_state() {
    let io = "[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 0\n";
    let text = axes(1).replace("position = 0\n", "position = 1\n");
    let text = text.replacen("[[device]]", &format!("{io}[[device]]"), 1);
    let mut failed = 0;
    for at in [2, 5, 8, 11, 14, 17, 20] {
        let script = format!("[[fault]]\nkind = \"silent\"\nat = \"{at}ms\"\nfor = \"300ms\"\n");
        let (outcome, _) = run(machine(&text), faults(&script));
        // Before ethercrab's scan, lost frames are sent again until the bus answers.
        let Err(error) = outcome.result else { continue };
        let error = error.to_string();
        assert!(!error.contains("refused"), "{at} ms: {error}");
        assert!(error.contains("timeout"), "{at} ms: {error}");
        failed += 1;
    }
    assert!(failed > 3, "{failed}");
}

#[test]
fn a_missing_sub_device_is_reported() {
    let (error, _) = run_badly(
        machine(&axes(2)),
        faults("[[fault]]\nkind = \"absent\"\ndevice = 1\n"),
    );
    assert_contains(&error, &["`a1`", "position 1", "missing"]);
}

#[test]
fn a_device_that_differs_from_the_esi_is_rejected() {
    let script = "[[fault]]\nkind = \"identity\"\ndevice = 1\nproduct = 0x1234\n";
    let (error, _) = run_badly(machine(&axes(2)), faults(script));
    assert_contains(
        &error,
        &["`a1`", "position 1", "identify", "0x00001234", "EPOS4.xml"],
    );
}

#[test]
fn an_aborted_startup_sdo_stops_bring_up() {
    let script =
        "[[fault]]\nkind = \"sdo-abort\"\ndevice = 1\nindex = 0x6060\nsub = 0\ncode = 0x06090030\n";
    let (error, _) = run_badly(machine(&axes(2)), faults(script));
    assert_contains(&error, &["`a1`", "start-up SDO", "0x6060:00", "06090030"]);
}

#[test]
fn a_rejected_safe_op_stops_bring_up() {
    let script =
        "[[fault]]\nkind = \"refuse-state\"\ndevice = 0\nstate = \"safeop\"\ncode = 0x001e\n";
    let (error, _) = run_badly(machine(&axes(2)), faults(script));
    assert_contains(&error, &["`a0`", "SafeOp", "0x001e"]);
}

#[test]
fn a_rejected_op_stops_bring_up() {
    let script = "[[fault]]\nkind = \"refuse-state\"\ndevice = 1\nstate = \"op\"\ncode = 0x002c\n";
    let (error, _) = run_badly(machine(&axes(2)), faults(script));
    assert_contains(&error, &["`a1`", "Op", "0x002c"]);
}

#[test]
fn a_drive_without_operation_enabled_is_reported() {
    let script = "[[fault]]\nkind = \"stuck\"\ndevice = 0\nstate = \"switch-on-disabled\"\n";
    let (error, summary) = run_badly(machine(&axes(2)), faults(script));
    assert_contains(
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
fn a_drive_fault_in_motion_stops_the_others_within_their_limits() {
    let script = "[[fault]]\nkind = \"drive-fault\"\ndevice = 1\nat = \"1.5s\"\ncode = 0x8611\n";
    let (error, summary) = run_badly(machine(&axes(3)), faults(script));
    assert_contains(&error, &["`a1`", "drive fault", "0x8611"]);
    let summary = summary.expect("the cycle ran");
    for axis in [&summary.axes[0], &summary.axes[2]] {
        assert!(axis.was_enabled);
        // A ramp from 50 turns/s at 500 turns/s² takes 2.5 turns. An axis on its ramp stays at its
        // set-point.
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
    assert_contains(
        &error,
        &["the bus is lost", "3 cycles", "without an answer"],
    );
    assert!(summary.expect("the cycle ran").counters.lost_frames >= 3);
}

#[test]
fn lost_frames_during_bring_up_are_retried() {
    let script =
        "seed = 3\n[[fault]]\nkind = \"frame-loss\"\nprobability = 0.01\nfor = \"300ms\"\n";
    run_well(machine(&axes(2)), faults(script));
}

#[test]
fn a_time_limit_during_a_move_causes_a_controlled_stop() {
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

/// One frame in twenty is lost. No supervision trips below `lost_frames`, and every loss is
/// counted.
#[test]
fn a_bus_with_continuous_frame_loss_moves_its_axes() {
    for seed in 1..=8 {
        let script =
            format!("seed = {seed}\n[[fault]]\nkind = \"frame-loss\"\nprobability = 0.05\n");
        let text = axes(3).replace("cycle =", "lost_frames = 8\ncycle =");
        // The speed is two fifths of the limit, because a delayed axis needs reserve to catch up.
        let text = text.replace("\nmove =", "\nspeed = 0.4\nmove =");
        let options = Options {
            repeat: Some(2),
            ..faults(&script)
        };
        let (outcome, heard) = run(machine(&text), options);
        if let Err(error) = outcome.result {
            panic!("seed {seed}: {error}; {:?}", heard.warnings());
        }
        let summary = outcome.summary.expect("the cycle ran");
        let counters = summary.counters;
        let lost = counters.lost_frames as f64 / counters.cycles as f64;
        assert!((0.03..0.07).contains(&lost), "seed {seed}: {lost}");
        for axis in &summary.axes {
            assert!(
                axis.final_error_counts.is_some_and(|e| e.abs() <= 1),
                "seed {seed}: {axis:?}"
            );
            assert!(
                axis.trip.is_none() && axis.fault.is_none(),
                "seed {seed}: {axis:?}"
            );
        }
    }
}

/// A pipelined exchange delays data by a cycle; all else is equal.
#[test]
fn a_pipelined_exchange_moves_axes() {
    let text = axes(2).replace("cycle =", "exchange = \"pipelined\"\ncycle =");
    let summary = run_well(machine(&text), virtual_time());
    for axis in &summary.axes {
        assert!(
            axis.final_error_counts.is_some_and(|e| e.abs() <= 1),
            "{axis:?}"
        );
    }
    let counters = summary.counters;
    assert_eq!((counters.lost_frames, counters.late_frames), (0, 0));
    assert_eq!(summary.round_trip.count, 0, "no waiting");

    // A reply delay of more than one cycle but less than two is in time. A longer delay is late,
    // but causes no stop.
    for (delay, late) in [("900us", false), ("2500us", true)] {
        let script = format!(
            "[[fault]]\nkind = \"frame-delay\"\nat = \"1.5s\"\ncount = 2\ndelay = \"{delay}\"\n"
        );
        let summary = run_well(machine(&text), faults(&script));
        assert_eq!(
            summary.counters.late_frames > 0,
            late,
            "{delay}: {:?}",
            summary.counters
        );
        assert_eq!(
            summary.counters.lost_frames > 0,
            late,
            "{delay}: {:?}",
            summary.counters
        );
    }

    let script = "[[fault]]\nkind = \"frame-loss\"\nat = \"1.5s\"\nprobability = 1.0\n";
    let (error, _) = run_badly(machine(&text), faults(script));
    assert_contains(
        &error,
        &["the bus is lost", "3 cycles", "without an answer"],
    );
}

/// Events before the stop are reported in order; repeated events share one line.
#[test]
fn the_cycle_records_the_events_before_a_stop() {
    let script = "[[fault]]\nkind = \"frame-loss\"\nat = \"1.5s\"\nprobability = 1.0\n";
    let (_, summary) = run_badly(machine(&axes(2)), faults(script));
    let events = summary.expect("the cycle ran").events;
    let at = |what: &str| {
        let found = events.iter().position(|e| e.what.contains(what));
        found.unwrap_or_else(|| panic!("{what}: {events:#?}"))
    };
    assert!(at("in phase with SYNC0") < at("AL status 0x08 of 2 SubDevices"));
    let lost = at("not back before the deadline");
    let stop = at("stop: 3 cycles in a row");
    assert!(lost < stop && events[stop].failure && !events[lost].failure);
    let (lost, stop) = (&events[lost], &events[stop]);
    assert_eq!(stop.first_cycle, lost.first_cycle + 2);
    assert!(lost.last_cycle > stop.first_cycle, "they go on being lost");
    assert!((1.0..2.0).contains(&stop.at_s), "{stop:?}");
}

#[test]
fn errors_are_counted_at_the_port_that_sees_them() {
    let script =
        "[[fault]]\nkind = \"frame-corrupt\"\nat = \"1.5s\"\ncount = 2\ndevice = 1\nport = 0\n";
    let summary = run_well(machine(&axes(3)), faults(script));
    let seen = summary.errors.iter().find(|found| found.name == "a1");
    assert_eq!(seen.map(|found| found.invalid_frames), Some([2, 0, 0, 0]));
    let others = summary.errors.iter().filter(|found| found.name != "a1");
    assert!(others.clone().count() > 0);
    for other in others {
        assert_eq!(other.invalid_frames, [0; 4], "it was bad before: {other:?}");
        assert!(other.forwarded != [0; 4], "{other:?}");
    }
    assert!(
        run_well(machine(&axes(3)), virtual_time())
            .errors
            .is_empty()
    );
}

#[test]
fn a_clock_outside_its_window_causes_a_warning() {
    let text = axes(2).replace("\n[[step]]", "[device.sim]\njitter = \"400ns\"\n\n[[step]]");
    let text = text.replacen("[device.sim]\njitter = \"400ns\"\n", "", 1);
    let warned = |window: &str| {
        let text = text.replace("cycle =", &format!("clock_window = \"{window}\"\ncycle ="));
        let (outcome, heard) = run(machine(&text), virtual_time());
        outcome.result.expect("a clock that is off stops nothing");
        let of_clocks = heard
            .warnings()
            .into_iter()
            .filter(|w| w.contains("the clock of"));
        of_clocks.collect::<Vec<_>>()
    };
    assert_eq!(warned("10us"), [""; 0]);
    let warnings = warned("100ns");
    assert!(
        warnings
            .first()
            .is_some_and(|w| w.contains("`a1`") && w.contains("the reference clock")),
        "{warnings:?}"
    );
}
