//! Stops of single groups: `[[stop.group]]` over a whole run.

mod cycles;

use ecaxis_axis::State;
use ecaxis_master::config::Machine;
use ecaxis_master::session::Progress;
use ecaxis_test_support::program::{self, Ran};
use ecaxis_test_support::{
    assert_contains, faults, load, machine, run, run_badly, run_well, virtual_time, with_our_esi,
};

/// `z` is first on the bus, so a cable break behind `z` affects only the gantry of `x` and `y`.
const AXES: [&str; 3] = ["z", "x", "y"];
const GANTRY: &str = "\n[[stop.group]]\nname = \"gantry\"\naxes = [\"x\", \"y\"]\n";
const ALONE: &str = "outside = \"continue\"\n";
/// Before the first fault, `x` and `y` turn, and `z` is moving.
const TURN: &str = "\n[[step]]\nenable = true\n\n[[step]]\nvelocity = { x = 10.0, y = 10.0 }\n\n[[step]]\nmove = { z = 80.0 }\n";
const BACK: &str = "\n[[step]]\nmove = { z = 0.0 }\n";
const FAULT: &str = "[[fault]]\nkind = \"drive-fault\"\ndevice = 1\nat = \"1.5s\"\ncode = 0x8611\n";
const BREAK: &str = "[[fault]]\nkind = \"link-break\"\ndevice = 1\nport = 0\nat = \"1.5s\"\n";

/// Returns the machine with `keys` added to the named axis.
fn bench(keys: &[(&str, &str)], rest: &str) -> String {
    let mut text = String::from("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n");
    for (position, name) in AXES.iter().enumerate() {
        let acceleration = keys
            .iter()
            .any(|(axis, key)| axis == name && key.starts_with("limits"));
        let limits = "limits = { position = [-100.0, 100.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }";
        text += &format!(
            "\n[[device]]\nname = \"{name}\"\nesi = \"esi/EPOS4.xml\"\nposition = {position}\nmode = \"csp\"\n\
             [device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 2000\n{}\n",
            if acceleration { "" } else { limits },
        );
        for (_, key) in keys.iter().filter(|(axis, _)| axis == name) {
            text += key;
            text += "\n";
        }
    }
    text + rest
}

fn alone(steps: &str) -> Machine {
    machine(&bench(&[], &format!("{GANTRY}{ALONE}{steps}")))
}

const CAUSE: [&str; 4] = ["`x`", "group `gantry`", "drive fault", "0x8611"];

#[test]
fn a_fault_in_a_group_stops_only_that_group() {
    let (outcome, heard) = run(alone(&format!("{TURN}{BACK}")), faults(FAULT));
    outcome.result.expect("the rest goes on");
    let summary = outcome.summary.expect("the cycle has run");
    assert_eq!(summary.program_runs, 1);
    let [z, x, y] = &summary.axes[..] else {
        panic!("three axes")
    };
    assert!(z.final_error_counts.is_some_and(|e| e.abs() <= 1), "{z:?}");
    assert!(
        x.fault.as_deref().is_some_and(|f| f.contains("0x8611")),
        "{x:?}"
    );
    assert_eq!((&y.fault, &y.trip), (&None, &None));
    // An axis that completes its ramp stays at its set-point.
    assert!((y.final_position - y.target_position).abs() < 0.1, "{y:?}");
    assert_eq!(y.final_state, State::SwitchOnDisabled.to_string());
    let [stop] = &summary.group_stops[..] else {
        panic!("{:?}", summary.group_stops)
    };
    assert_eq!((stop.group.as_str(), stop.released), ("gantry", false));
    assert_contains(&stop.cause, &["`x`", "drive fault", "0x8611"]);
    let reported = heard
        .0
        .iter()
        .filter(|p| matches!(p, Progress::GroupStopped { .. }));
    assert_eq!(reported.count(), 1);
}

/// A script must not treat a run without one of its groups as successful.
#[test]
fn a_run_that_ends_without_one_of_its_groups_fails() {
    let folder = tempfile::tempdir().expect("a folder");
    let fault = folder.path().join("fault.toml");
    std::fs::write(&fault, FAULT).expect("written");
    let again = "\n[[step]]\nreset = [\"x\", \"y\"]\n";
    for (last, code) in [("", 1), (again, 0)] {
        let steps = format!("{TURN}{BACK}{last}");
        let text = bench(&[], &format!("{GANTRY}{ALONE}{steps}"));
        let file = folder.path().join("machine.toml");
        std::fs::write(&file, with_our_esi(&text)).expect("written");
        let mut command = program::command();
        command.args(["run", "--sim", "--virtual", "--json", "--faults"]);
        let ran = Ran::new(command.args([&fault, &file])).exits(code);
        assert_eq!(ran.json()["ok"], code == 0);
        let error = "error: the group `gantry` has stopped and was not reset: `x`";
        assert_eq!(ran.err.contains(error), code == 1, "{}", ran.err);
    }
}

/// The machine stops as without groups, unless `outside` is `continue`.
#[test]
fn a_group_whose_outside_stops_stops_the_machine() {
    for groups in ["", GANTRY] {
        let text = bench(&[], &format!("{groups}{TURN}{BACK}"));
        let (error, summary) = run_badly(machine(&text), faults(FAULT));
        assert_contains(&error, &["`x`", "drive fault", "0x8611"]);
        let summary = summary.expect("the cycle has run");
        assert!(summary.machine_seconds < 3.0, "{}", summary.machine_seconds);
        for axis in &summary.axes {
            assert_ne!(axis.final_state, "Operation enabled");
            assert_eq!(axis.trip, None);
        }
        assert!(summary.group_stops.is_empty());
    }
}

#[test]
fn a_step_for_a_stopped_axis_fails_with_the_cause_of_the_stop() {
    for (step, device) in [
        ("move = { x = 0.0 }", "`x`"),
        ("move = { z = 0.0, y = 0.0 }", "`y`"),
        ("enable = [\"x\", \"y\"]", "`x`"),
        ("gear = { z = { to = \"y\" } }", "`y`"),
        ("stop = [\"y\"]", "`y`"),
    ] {
        let (error, summary) =
            run_badly(alone(&format!("{TURN}\n[[step]]\n{step}\n")), faults(FAULT));
        assert_contains(&error, &CAUSE);
        assert_contains(&error, &["step 4", &format!("{device} (position")]);
        for axis in summary.expect("the cycle has run").axes {
            assert_ne!(axis.final_state, "Operation enabled");
        }
    }
    // The stop occurs during the step.
    let (error, _) = run_badly(
        alone("\n[[step]]\nmove = { z = 80.0, x = 80.0 }\n"),
        faults(FAULT),
    );
    assert_contains(&error, &CAUSE);
}

#[test]
fn reset_and_enable_bring_a_group_back() {
    let back = "\n[[step]]\nreset = [\"x\"]\n\n[[step]]\nenable = [\"x\", \"y\"]\n\n[[step]]\nmove = { x = 1.0, y = -1.0, z = 1.0 }\n";
    let (outcome, heard) = run(alone(&format!("{TURN}{back}")), faults(FAULT));
    outcome.result.expect("all of it goes on");
    let summary = outcome.summary.expect("the cycle has run");
    for (axis, target) in summary.axes.iter().zip([1.0, 1.0, -1.0]) {
        assert_eq!(axis.target_position, target);
        assert!(
            axis.final_error_counts.is_some_and(|e| e.abs() <= 1),
            "{axis:?}"
        );
    }
    assert!(summary.group_stops[0].released);
    let reported = heard
        .0
        .iter()
        .filter(|p| matches!(p, Progress::GroupReleased { .. }));
    assert_eq!(reported.count(), 1);
    // Without a reset, an axis is not enabled, even if others are.
    let early = back.replace("[\"x\"]", "[\"y\"]");
    let (error, _) = run_badly(alone(&format!("{TURN}{early}")), faults(FAULT));
    assert_contains(&error, &CAUSE);
}

/// A drive fault with automatic reset needs no reset step, but power needs an enable step.
#[test]
fn an_automatic_reset_leaves_the_power_to_the_program() {
    let steps = format!(
        "{GANTRY}{ALONE}{TURN}\n[[step]]\ndwell = \"1s\"\n\n[[step]]\nenable = [\"x\", \"y\"]\n\n[[step]]\nmove = {{ x = 1.0, y = 1.0 }}\n"
    );
    let keys = [("x", "fault_reset = { tries = 3, delay = \"200ms\" }")];
    let summary = run_well(machine(&bench(&keys, &steps)), faults(FAULT));
    assert!(summary.group_stops[0].released);
    assert!(
        summary.axes[1]
            .final_error_counts
            .is_some_and(|e| e.abs() <= 1)
    );
    // Without the dwell and the step, the axis stays without power.
    let summary = run_well(
        machine(&bench(&keys, &format!("{GANTRY}{ALONE}{TURN}{BACK}"))),
        faults(FAULT),
    );
    assert_eq!(
        summary.axes[1].final_state,
        State::SwitchOnDisabled.to_string()
    );
    assert_eq!(summary.axes[1].fault, None);
}

#[test]
fn a_broken_cable_stops_only_its_group() {
    for way in ["quick-stop", "no-power"] {
        let text = bench(
            &[],
            &format!("\n[stop]\nbus_lost = \"{way}\"\n{GANTRY}{ALONE}{TURN}{BACK}"),
        );
        let (outcome, heard) = run(machine(&text), faults(BREAK));
        outcome.result.expect("the rest goes on");
        let summary = outcome.summary.expect("the cycle has run");
        assert!(
            summary.axes[0]
                .final_error_counts
                .is_some_and(|e| e.abs() <= 1)
        );
        assert!(summary.counters.wkc_errors > 1000, "{:?}", summary.counters);
        assert_eq!(summary.counters.lost_frames, 0);
        assert_contains(&summary.group_stops[0].cause, &["`x`", "no longer answers"]);
        assert!(heard.warnings().is_empty(), "{:?}", heard.warnings());
    }
}

/// The break is shorter than the drives' watchdogs, so they stay in Op.
#[test]
fn a_lost_group_returns_when_it_answers_again() {
    let back = "\n[[step]]\nreset = [\"x\", \"y\"]\n\n[[step]]\nenable = [\"x\", \"y\"]\n\n[[step]]\nmove = { x = 1.0, y = 1.0 }\n";
    let short = BREAK.replace("at =", "for = \"20ms\"\nat =");
    let summary = run_well(alone(&format!("{TURN}{back}")), faults(&short));
    assert!(summary.group_stops[0].released);
    assert!(
        summary
            .axes
            .iter()
            .all(|a| a.final_error_counts.is_some_and(|e| e.abs() <= 1))
    );
    // While the group is lost, the step fails.
    let (error, _) = run_badly(alone(&format!("{TURN}{back}")), faults(BREAK));
    assert_contains(&error, &["step 5", "group `gantry`", "no longer answers"]);
}

#[test]
fn a_lost_bus_stops_all_groups() {
    let silent = "[[fault]]\nkind = \"silent\"\nat = \"1.5s\"\n";
    let (error, summary) = run_badly(alone(&format!("{TURN}{BACK}")), faults(silent));
    assert_contains(&error, &["the bus is lost", "without an answer"]);
    let summary = summary.expect("the cycle has run");
    assert!(summary.group_stops.is_empty(), "{:?}", summary.group_stops);
}

#[test]
fn devices_without_an_axis_belong_to_the_machine_unless_a_group_lists_them() {
    let io = "\n[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 3\n";
    let gone = "[[fault]]\nkind = \"power-off\"\ndevice = 3\nat = \"1.5s\"\n";
    let text = bench(&[], &format!("{io}{GANTRY}{ALONE}{TURN}{BACK}"));
    let (error, _) = run_badly(machine(&text), faults(gone));
    assert_contains(&error, &["`io`", "no longer answers"]);
    let text = bench(
        &[],
        &format!("{io}{GANTRY}devices = [\"io\"]\n{ALONE}{TURN}{BACK}"),
    );
    let summary = run_well(machine(&text), faults(gone));
    assert_contains(
        &summary.group_stops[0].cause,
        &["`io`", "no longer answers"],
    );
}

#[test]
fn an_emergency_and_the_end_stop_every_group() {
    let stop = "\n[stop]\nemergency = { z.\"0x6064\" = { above = 100000 } }\n";
    let text = bench(&[], &format!("{stop}{GANTRY}{ALONE}{TURN}{BACK}"));
    let (error, summary) = run_badly(machine(&text), virtual_time());
    assert_contains(&error, &["emergency stop"]);
    for axis in summary.expect("the cycle has run").axes {
        assert_ne!(axis.final_state, "Operation enabled");
        assert!(axis.trip.is_some(), "{axis:?}");
    }
    let summary = run_well(alone(TURN), virtual_time());
    for axis in summary.axes {
        assert_eq!(axis.final_state, State::SwitchOnDisabled.to_string());
        assert_eq!((&axis.fault, &axis.trip), (&None, &None));
    }
}

/// A gear's leader is in a stopped group, so the follower stops with its own group.
#[test]
fn a_follower_of_a_stopped_group_stops_with_its_own_group() {
    let steps = "\n[[step]]\ngear = { z = { to = \"x\" } }\n\n[[step]]\nvelocity = { x = 10.0, y = 10.0 }\n\n[[step]]\ndwell = \"2s\"\n";
    let (error, _) = run_badly(alone(steps), faults(FAULT));
    assert_contains(&error, &["`z`", "no longer follows"]);
    let line = "\n[[step]]\nline = { x = 80.0, z = 80.0 }\n";
    let (_, summary) = run_badly(alone(line), faults(FAULT));
    let summary = summary.expect("the cycle has run");
    // It does not continue alone to the end of the line.
    assert!(
        summary.axes[0].final_position < 75.0,
        "{:?}",
        summary.axes[0]
    );
    let feeder = format!("\n[[stop.group]]\nname = \"feeder\"\naxes = [\"z\"]\n{ALONE}");
    let text = bench(&[], &format!("{GANTRY}{ALONE}{feeder}{steps}"));
    let summary = run_well(machine(&text), faults(FAULT));
    let stops: Vec<_> = summary
        .group_stops
        .iter()
        .map(|s| s.group.as_str())
        .collect();
    assert_eq!(stops, ["gantry", "feeder"]);
    assert_contains(&summary.group_stops[1].cause, &["`z`", "no longer follows"]);
}

/// A ramp takes its own time, independent of other groups.
#[test]
fn a_slow_axis_of_the_group_completes_its_ramp() {
    let limits = "limits = { position = [-1000.0, 1000.0], velocity = 40.0, acceleration = 5.0, torque = 100.0, following_error = 1.0 }";
    let steps = "\n[[step]]\nvelocity = { y = 40.0 }\n\n[[step]]\nmove = { z = 80.0 }\n\n[[step]]\ndwell = \"10s\"\n";
    let text = bench(&[("y", limits)], &format!("{GANTRY}{ALONE}{steps}"));
    let fault = FAULT.replace("1.5s", "9.5s");
    let summary = run_well(machine(&text), faults(&fault));
    let y = &summary.axes[2];
    assert_eq!((&y.fault, &y.trip), (&None, &None));
    assert!(y.final_error_counts.is_some_and(|e| e.abs() <= 1), "{y:?}");
    assert!(y.final_position > 300.0, "{y:?}");
    assert_eq!(summary.group_stops.len(), 1);
}

/// The machine must not continue if a group cannot be stopped.
#[test]
fn a_group_drive_that_stays_enabled_stops_the_machine() {
    let stuck =
        "[[fault]]\nkind = \"stuck\"\ndevice = 2\nat = \"1.4s\"\nstate = \"operation-enabled\"\n";
    let steps = format!("{TURN}\n[[step]]\ndwell = \"1min\"\n");
    let (error, summary) = run_badly(alone(&steps), faults(&format!("{FAULT}{stuck}")));
    assert_contains(
        &error,
        &["`y`", "could not be brought to rest and disabled"],
    );
    let summary = summary.expect("the cycle has run");
    assert!(
        summary.machine_seconds < 20.0,
        "{}",
        summary.machine_seconds
    );
}

/// A trip is acknowledged at once, so a step after the reset finds the group ready.
#[test]
fn a_trip_is_reset_like_a_fault() {
    let blocked = "[[fault]]\nkind = \"blocked\"\ndevice = 1\nat = \"1.5s\"\nfor = \"200ms\"\n";
    let back = "\n[[step]]\nreset = [\"x\"]\n\n[[step]]\nenable = [\"x\", \"y\"]\n\n[[step]]\nmove = { x = 1.0, y = 1.0 }\n";
    let summary = run_well(alone(&format!("{TURN}{back}")), faults(blocked));
    assert_contains(&summary.group_stops[0].cause, &["`x`", "following error"]);
    assert!(summary.group_stops[0].released);
    // The step waits while the group still stops.
    let steps = "\n[[step]]\nenable = true\n\n[[step]]\nvelocity = { x = 10.0, y = 10.0 }\n\n[[step]]\ndwell = \"1.3s\"\n";
    let mut well = 0;
    for ms in (1000..1700).step_by(50) {
        let blocked = blocked.replace("1.5s", &format!("{ms}ms"));
        let (outcome, _) = run(alone(&format!("{steps}{back}")), faults(&blocked));
        match outcome.result {
            Ok(()) => well += 1,
            // The trip occurred after the reset.
            Err(error) => {
                assert_contains(&error.to_string(), &["group `gantry`", "following error"])
            }
        }
    }
    assert!(well >= 5, "{well}");
}

#[test]
fn the_sample_continues_without_its_gantry() {
    let summary = run_well(load("groups.toml"), virtual_time());
    assert!(summary.group_stops.is_empty());
    let summary = run_well(load("groups.toml"), faults(FAULT));
    let [stop] = &summary.group_stops[..] else {
        panic!("{:?}", summary.group_stops)
    };
    assert!(stop.released, "{stop:?}");
}
