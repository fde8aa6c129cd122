//! Homing on the simulated bus: every method on a track, failures, and the return to cyclic
//! set-points.

use ecaxis_axis::status::HomingStatus;
use ecaxis_axis::{AxisStatus, Command, HomingError, Mode};
use ecaxis_ecat::index::DeviceIndex;
use ecaxis_master::config::Machine;
use ecaxis_master::session::Options;
use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::script::{Act, Trace, home, move_to, perform, perform_well};
use ecaxis_test_support::{
    assert_contains, load, machine, root, run_badly, run_well, virtual_time,
};

/// The position of home.
const HOME: f64 = 3.0;

/// Returns a machine with one axis that homes with `homing` on `track`.
fn bench(esi: &str, encoder: u32, homing: &str, track: &str) -> Machine {
    machine(&format!(
        r#"
[bus]
nic = "sim"
cycle = "1ms"
[[device]]
name = "x"
esi = "esi/{esi}.xml"
position = 0
mode = "csp"
pdo.rx = ["0x6040", "0x6060", "0x607A"]
pdo.tx = ["0x6041", "0x6061", "0x6064", "0x606C"]
[device.axis]
unit = "turn"
encoder = {encoder}
limits = {{ velocity = 50.0, acceleration = 500.0, following_error = 0.5 }}
homing = {{ {homing}, search = 5.0, zero = 0.5, acceleration = 100.0, position = {HOME:.1} }}
[device.sim]
track = {{ {track} }}
"#
    ))
}

/// Returns the change of the axis position that is not motion: the offset of the new origin, in
/// turns.
fn shift(cycles: &[AxisStatus], dt_s: f64) -> f64 {
    let moved = |w: &[AxisStatus]| w[1].position - w[0].position - w[1].velocity * dt_s;
    let jumps = cycles.windows(2).map(moved);
    jumps
        .max_by(|a, b| a.abs().total_cmp(&b.abs()))
        .unwrap_or(0.0)
}

fn homing_of(trace: &Trace, act: usize) -> HomingStatus {
    trace.at_end_of(act).homing
}

#[test]
fn every_homing_method_finds_its_position_and_returns_to_csp() {
    // Limit switches at ±6 turns, home from 2 to 2.5, index at 0.25 of each turn; or mechanical
    // stops at ±8 turns.
    const SWITCHES: &str =
        "negative_limit = -6.0, positive_limit = 6.0, home = [2.0, 2.5], index = 0.25";
    const ENDS: &str = "ends = [-8.0, 8.0], index = 0.25";
    let rows = [
        (1, SWITCHES, -5.75),
        (2, SWITCHES, 5.25),
        (7, SWITCHES, 1.25),
        (11, SWITCHES, 3.25),
        (17, SWITCHES, -6.0),
        (18, SWITCHES, 6.0),
        (23, SWITCHES, 2.0),
        (27, SWITCHES, 2.5),
        (33, SWITCHES, -0.75),
        (34, SWITCHES, 0.25),
        (35, SWITCHES, 0.0),
        (37, SWITCHES, 0.0),
        (-1, ENDS, 7.25),
        (-2, ENDS, -7.75),
        (-3, ENDS, 8.0),
        (-4, ENDS, -8.0),
    ];
    let known = ecaxis_axis::homing::METHODS.iter().map(|m| m.code);
    for (esi, encoder) in [("EPOS4", 2000), ("IDX", 4096)] {
        for (method, track, place) in rows {
            assert!(known.clone().any(|code| code == method));
            let threshold = if method < 0 { ", threshold = 1500" } else { "" };
            let machine = bench(
                esi,
                encoder,
                &format!("method = {method}{threshold}"),
                track,
            );
            // Moves away from the switch or stop that was found.
            let away = if place > 0.0 { HOME - 2.0 } else { HOME + 2.0 };
            let acts = [
                home(30.0),
                Act::Dwell(0.2),
                move_to(away, 0.5),
                Act::Dwell(0.3),
            ];
            let trace = perform_well(machine, "x", &acts, virtual_time());
            let count = 1.0 / f64::from(encoder);
            assert_eq!(
                homing_of(&trace, 0),
                HomingStatus::Attained,
                "{esi} {method}"
            );
            let found = HOME - shift(trace.of(0), trace.dt_s);
            // After the return to CSP, commanded and reported positions stay unchanged.
            let back = trace.of(0).iter().rposition(|s| s.mode == Mode::Hm);
            let since =
                &trace.cycles[trace.began[0] + back.expect("it was homing") + 1..trace.began[2]];
            let off = |s: &AxisStatus| {
                (s.position - HOME)
                    .abs()
                    .max((s.target_position - HOME).abs())
            };
            let worst = since.iter().map(off).fold(0.0, f64::max);
            let end = trace.at_end_of(3);
            println!(
                "{esi} {method}: {:.2} s, home at {found:.4} ({place}), within {:.1} counts in {} cycles of CSP, then {:.1} counts off 2 turns away",
                trace.of(0).len() as f64 * trace.dt_s,
                worst / count,
                since.len(),
                (end.position - away) / count
            );
            assert!(since.len() >= 190, "{esi} {method}");
            assert!((found - place).abs() < 0.006, "{esi} {method}: {found}");
            assert!(worst <= 3.0 * count, "{esi} {method}: {worst}");
            assert!(
                (end.position - away).abs() < 1.5 * count,
                "{esi} {method}: {end:?}"
            );
        }
    }
}

/// The search covers 100 turns.
#[test]
fn homing_finds_a_limit_switch_a_hundred_turns_away() {
    for (esi, encoder) in [("EPOS4", 2000), ("IDX", 4096)] {
        let machine = bench(esi, encoder, "method = 17", "negative_limit = -100.0");
        let trace = perform_well(machine, "x", &[home(30.0), Act::Dwell(0.2)], virtual_time());
        let found = HOME - shift(trace.of(0), trace.dt_s);
        let off = (found + 100.0) * f64::from(encoder);
        let end = ((trace.at_end_of(1).position - HOME) * f64::from(encoder)).round();
        println!(
            "{esi}: {:.1} s, home {off:.1} counts from the switch's edge, the axis {end:.1} counts from home",
            trace.of(0).len() as f64 * trace.dt_s
        );
        assert!(off.abs() < 5.0 && end.abs() <= 3.0, "{esi}: {off} {end}");
    }
}

/// Checks 0x607A in each cycle from before homing to after it.
#[test]
fn the_target_on_the_wire_follows_homing_without_a_jump() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let record = folder.path().join("homing.pcapng");
    let options = Options {
        record: Some(record.clone()),
        ..virtual_time()
    };
    let machine = bench("EPOS4", 2000, "method = 23", "home = [2.0, 2.5]");
    let acts = [
        home(30.0),
        Act::Dwell(0.2),
        move_to(HOME + 2.0, 0.5),
        Act::Dwell(0.3),
    ];
    perform_well(machine, "x", &acts, options);
    let images = process_images(&record);
    let int = |bytes: &[u8], at: usize| {
        i32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
    };
    let (mut homed, mut commanded, mut worst, mut step) = (false, 0, 0, 0);
    let mut before: Option<(i32, i32)> = None;
    for (sent, came) in &images {
        let (target, actual) = (int(sent, 3), int(came, 3));
        let (asked, shown) = (sent[2], came[2]);
        homed |= shown == 6;
        // The target of CSP counts if CSP is requested or active.
        if let Some((last, known)) = before.filter(|_| homed && (asked == 8 || shown == 8)) {
            commanded += 1;
            step = step.max((target - last).abs());
            if asked == 8 && shown == 6 {
                worst = worst.max((target - known).abs());
            }
        }
        if asked == 6 {
            before = None;
        } else {
            before = Some((target, actual));
        }
    }
    println!(
        "{} cycles, {commanded} of them commanded after homing: first {worst} counts from where the axis was, then {step} a cycle",
        images.len()
    );
    assert!(homed && commanded > 400);
    assert!(worst <= 2, "{worst}");
    // The limit of 50 turns/s gives 100 counts per millisecond.
    assert!(step <= 100, "{step}");
}

#[test]
fn a_missing_home_switch_is_reported_with_step_device_and_hint() {
    let text = "homing = { method = 23, search = 5.0, timeout = \"2s\" }\n[[step]]\ndwell = \"10ms\"\n[[step]]\nhome = [\"x\"]\n";
    let head = r#"
[bus]
nic = "sim"
cycle = "1ms"
[[device]]
name = "x"
esi = "esi/EPOS4.xml"
position = 0
mode = "csp"
pdo.rx = ["0x6040", "0x6060", "0x607A"]
pdo.tx = ["0x6041", "0x6061", "0x6064", "0x606C"]
[device.axis]
unit = "turn"
encoder = 2000
limits = { velocity = 50.0, acceleration = 500.0, following_error = 0.5 }
"#;
    let (error, summary) = run_badly(machine(&format!("{head}{text}")), virtual_time());
    for part in [
        "step 2 (line ",
        "`x`",
        "home was not found within 2 s",
        "by method 23 (home switch upwards",
    ] {
        assert!(error.contains(part), "`{part}` is not in: {error}");
    }
    let axis = &summary.expect("the cycle has run").axes[0];
    assert_eq!((&axis.fault, &axis.trip), (&None, &None), "{axis:?}");
}

#[test]
fn homing_fails_without_its_switch_or_index() {
    let limits = "negative_limit = -3.0, positive_limit = 3.0";
    let rows = [
        // No home switch exists between the limit switches, so the drive stops after the second
        // limit switch.
        ("method = 23", limits, HomingError::Drive),
        // The wrong switch comes first.
        (
            "method = 17",
            "negative_limit = -90.0",
            HomingError::Timeout { timeout_s: 5.0 },
        ),
        // No index pulse occurs within two turns.
        ("method = 34", "index = false", HomingError::Drive),
    ];
    for (homing, track, expected) in rows {
        let machine = bench("EPOS4", 2000, homing, track);
        let acts = [
            home(5.0),
            Act::Dwell(0.2),
            move_to(0.0, 0.2),
            Act::Dwell(0.3),
        ];
        let (outcome, trace) = perform(machine, "x", &acts, virtual_time());
        assert_eq!(
            homing_of(&trace, 0),
            HomingStatus::Failed(expected),
            "{homing}"
        );
        outcome.result.expect("the axis is as usable as before");
        assert!(trace.at_end_of(3).position.abs() < 0.001, "{homing}");
    }
}

/// The stop uses Halt, as in the application notes.
#[test]
fn a_stop_ends_homing() {
    let machine = bench("EPOS4", 2000, "method = 17", "negative_limit = -90.0");
    let acts = [
        Act::Begin(Command::Home { timeout_s: 30.0 }),
        Act::Dwell(1.0),
        Act::Do(Command::Stop),
        Act::Dwell(0.5),
    ];
    let trace = perform_well(machine, "x", &acts, virtual_time());
    assert_eq!(
        homing_of(&trace, 3),
        HomingStatus::Failed(HomingError::Aborted)
    );
    let (stopped, end) = (trace.at_end_of(3), trace.of(3));
    assert_eq!(stopped.mode, Mode::Csp);
    assert!(stopped.position < -3.0, "{stopped:?}");
    let moved = end.last().expect("a cycle").position - end[100].position;
    assert!(moved.abs() < 0.001, "{moved}");
}

#[test]
fn the_example_homes_to_the_index() {
    let summary = run_well(load("profiles.toml"), virtual_time());
    assert_eq!(summary.axes[0].final_error_counts, Some(0), "{summary:?}");
}

/// Errors that are detectable without the bus are reported with their position in the file.
#[test]
fn an_impossible_homing_is_rejected_with_the_file() {
    let mapped = "pdo.rx = [\"0x6040\", \"0x6060\", \"0x607A\"]\npdo.tx = [\"0x6041\", \"0x6061\", \"0x6064\"]";
    let no_display =
        "pdo.rx = [\"0x6040\", \"0x6060\", \"0x607A\"]\npdo.tx = [\"0x6041\", \"0x6064\"]";
    let no_position =
        "pdo.rx = [\"0x6040\", \"0x6060\", \"0x60FF\"]\npdo.tx = [\"0x6041\", \"0x6061\"]";
    let rows = [
        (
            mapped,
            "homing = { method = 40 }",
            "method 40 is none of CiA 402",
        ),
        (mapped, "homing = { method = -3 }", "needs the current"),
        (
            mapped,
            "homing = { method = 37, timeout = \"0ms\" }",
            "before it begins",
        ),
        (
            no_display,
            "homing = { method = 37 }",
            "their display (0x6060, 0x6061)",
        ),
        (
            no_position,
            "csv = { kv = 20.0 }",
            "needs the position (0x6064)",
        ),
    ];
    for (pdo, axis, expected) in rows {
        let text = format!(
            "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\nmode = \"{}\"\n{pdo}\n\
             [device.axis]\nencoder = 2000\nlimits = {{ velocity = 50.0, acceleration = 500.0 }}\n{axis}\n",
            if pdo == no_position { "csv" } else { "csp" },
        );
        let path = root().join("configs/test.toml");
        let error = ecaxis_master::config::parse(&path, &text)
            .expect_err(axis)
            .to_string();
        assert!(error.contains(expected), "{axis}: {error}");
    }
}

/// Homing, modes and probes add their objects to the process data of a file without `pdo` keys.
#[test]
fn a_file_without_pdo_keys_homes_probes_and_switches_modes() {
    let text = "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n\
        [[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\nmode = \"csp\"\n\
        [device.axis]\nencoder = 2000\nlimits = { velocity = 20.0, acceleration = 500.0, position = [-50.0, 50.0] }\n\
        homing = { method = 37 }\n[device.sim]\ntrack = { probe2 = [3.0, 4.0] }\n\
        [[step]]\nhome = true\n[[step]]\nprobe = { x = { by = 10.0, input = 2 } }\n\
        [[step]]\nrepeat = 2\nstep = [{ mode = { x = \"pp\" } }, { move = { x = 5.0 } }, { mode = { x = \"csp\" } }, { move = { x = 0.0 } }]\n\
        [[step]]\nmode = { x = \"cst\" }\n[[step]]\ntorque = { x = 1.0 }\n";
    let machine = machine(text);
    let layout = &machine.devices[DeviceIndex(0)].selection.layout;
    let added = [0x6060, 0x60b8, 0x6071, 0x6081, 0x6083, 0x6084];
    assert!(
        added
            .iter()
            .all(|index| layout.rx_field(*index, 0).is_some())
    );
    let summary = run_well(machine, virtual_time());
    assert_eq!(summary.program_runs, 1);
}

/// Against an end stop, a velocity profile of the drive never reaches its target. The step does not
/// wait for ever.
#[test]
fn a_velocity_profile_at_an_end_stop_ends_its_step() {
    let text = "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\n\
        mode = \"pv\"\n[device.axis]\nencoder = 2000\nlimits = { velocity = 20.0, acceleration = 200.0 }\n\
        [device.sim]\ntrack = { ends = [-5.0, 5.0] }\n\
        [[step]]\nvelocity = { x = 5.0 }\n[[step]]\ndwell = \"3s\"\n[[step]]\nvelocity = { x = 8.0 }\n";
    let (error, _) = run_badly(machine(text), virtual_time());
    assert_contains(&error, &["`x`", "step 3", "8"]);
}

/// After a move, the loop overshoots, stands for tens of ms, and creeps back at about the standstill
/// velocity. The next search for home waits for it.
#[test]
fn homing_after_a_move_waits_for_the_end_of_the_overshoot() {
    for target in 1..=24 {
        let to = f64::from(target) * 0.1 + 0.5;
        let text = format!(
            "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\n\
             mode = \"csp\"\npdo.rx = [\"0x6040\", \"0x6060\", \"0x607A\", \"0x60FF\"]\n\
             pdo.tx = [\"0x6041\", \"0x6061\", \"0x6064\", \"0x606C\"]\n[device.axis]\nencoder = 2000\n\
             limits = {{ velocity = 20.0, acceleration = 500.0, following_error = 0.9 }}\n\
             homing = {{ method = 17, search = 5.0, zero = 1.0, timeout = \"5s\" }}\n\
             [device.sim]\ntrack = {{ start = 0.5, negative_limit = 0.0 }}\n\
             [[step]]\nhome = [\"x\"]\n[[step]]\nmove = {{ x = {to:.1} }}\n[[step]]\nhome = [\"x\"]\n"
        );
        run_well(machine(&text), virtual_time());
    }
}
