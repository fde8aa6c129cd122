//! The program's steps on the simulated bus: power, inputs and outputs, repetition, and error
//! messages of failed steps.

use ecaxis_master::session::{Error, Progress};
use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::{Heard, faults, load, machine, root, run, run_well, virtual_time};

const HEAD: &str = r#"
[bus]
nic = "sim"
cycle = "1ms"

[[device]]
name = "x"
esi = "esi/EPOS4.xml"
position = 0
mode = "csp"

[device.axis]
unit = "mm"
per_turn = 5.0
encoder = 2000
limits = { position = [-60.0, 60.0], velocity = 250.0, acceleration = 2500.0, following_error = 2.0 }

[[device]]
name = "y"
esi = "esi/EPOS4.xml"
position = 1
mode = "csp"

[device.axis]
unit = "mm"
per_turn = 5.0
encoder = 2000
limits = { position = [-60.0, 60.0], velocity = 250.0, acceleration = 2500.0, following_error = 2.0 }

[[device]]
name = "io"
esi = "esi/IO8.xml"
position = 2
"#;

fn steps(heard: &Heard) -> Vec<String> {
    let reported = heard.0.iter();
    reported
        .filter_map(|progress| match progress {
            Progress::Program { step, .. } => Some(step.number.clone()),
            _ => None,
        })
        .collect()
}

/// Runs the steps. Returns the result, the numbers of the started steps, and the summary.
fn program(
    text: &str,
) -> (
    Result<(), Error>,
    Vec<String>,
    ecaxis_master::session::Summary,
) {
    let (outcome, heard) = run(machine(&format!("{HEAD}{text}")), virtual_time());
    let summary = outcome.summary.expect("the cycle has run");
    (outcome.result, steps(&heard), summary)
}

/// An axis at constant velocity never stands, so a mode switch must not wait for standstill.
#[test]
fn a_mode_step_at_constant_velocity_does_not_wait() {
    let endless = HEAD.replace("position = [-60.0, 60.0], ", "").replace(
        "mode = \"csp\"\n",
        "mode = \"csp\"\npdo.rx = [\"0x6040\", \"0x6060\", \"0x607A\", \"0x60FF\", \"0x6083\", \"0x6084\"]\n\
         pdo.tx = [\"0x6041\", \"0x6061\", \"0x6064\", \"0x606C\"]\n",
    );
    let text = |modes: &str| {
        let mut text = endless.clone() + "[[step]]\nvelocity = { x = 50.0 }\n";
        for mode in modes.split_whitespace() {
            text += &format!("[[step]]\nmode = {{ x = \"{mode}\" }}\n[[step]]\ndwell = \"10ms\"\n");
        }
        text + "[[step]]\nstop = [\"x\"]\n"
    };
    let cycles = |modes: &str| {
        let (outcome, _) = run(machine(&text(modes)), virtual_time());
        outcome
            .result
            .unwrap_or_else(|error| panic!("{modes}: {error}"));
        outcome.summary.expect("a summary").counters.cycles
    };
    let without = cycles("");
    for modes in ["csv", "csv csp", "pv csp", "csv pv csp"] {
        // A mode switch takes a few cycles, far less than a second of simulated time.
        assert!(cycles(modes) < without + 1000, "{modes}");
    }
}

/// The drive samples its position in its own loop, 2.5 times per cycle.
#[test]
fn a_gear_follows_a_reported_position_up_to_the_velocity_limit() {
    for speed in [0.3, 0.5, 0.7, 0.9] {
        let text = format!(
            "[[step]]\ngear = {{ y = {{ to = \"x\", actual = true }} }}\n\
             [[step]]\nmove = {{ x = 55.0 }}\nspeed = {speed}\nramp = 0.5\n\
             [[step]]\nmove = {{ x = -55.0 }}\nspeed = {speed}\nramp = 0.5\n"
        );
        let (result, ..) = program(&text);
        result.unwrap_or_else(|error| panic!("{speed}: {error}"));
    }
}

#[test]
fn the_example_runs_all_steps_in_order() {
    let (outcome, heard) = run(load("program.toml"), virtual_time());
    outcome.result.expect("runs");
    assert_eq!(
        steps(&heard),
        [
            "1", "2", "3", "4", "5.1", "5.2", "5.1", "5.2", "5.1", "5.2", "6", "7", "8", "9"
        ]
    );
    let enabled_at = heard
        .0
        .iter()
        .position(|p| matches!(p, Progress::Enabled { axes: 1 }));
    let third = heard
        .0
        .iter()
        .position(|p| matches!(p, Progress::Program { step, .. } if step.number == "3"));
    assert!(enabled_at > third, "not before the step that says so");
    let summary = outcome.summary.expect("the cycle has run");
    let moved = &summary.axes[0];
    assert!(moved.final_position.abs() < 0.2, "{moved:?}");
    assert!(
        moved.largest_following_error > 0.1,
        "it has moved: {moved:?}"
    );
}

#[test]
fn relative_moves_add_up_without_drift() {
    let (result, ran, summary) = program(
        r#"
[[step]]
repeat = 12
[[step.step]]
move_by = { x = 0.1, y = -0.1 }
[[step]]
dwell = "300ms"
"#,
    );
    result.expect("runs");
    assert_eq!(ran.len(), 13);
    for (axis, expected) in summary.axes.iter().zip([1.2, -1.2]) {
        assert!((axis.target_position - expected).abs() < 1e-9, "{axis:?}");
        assert!(
            axis.final_error_counts.is_some_and(|e| e.abs() <= 1),
            "{axis:?}"
        );
    }
}

#[test]
fn only_named_axes_are_enabled() {
    let (result, _, summary) = program("[[step]]\nenable = \"y\"\n[[step]]\ndwell = \"20ms\"\n");
    result.expect("runs");
    let enabled: Vec<_> = summary.axes.iter().map(|a| a.was_enabled).collect();
    assert_eq!(enabled, [false, true]);
}

/// Errors visible in the file are rejected with the file. A repetition from the command line is
/// checked during the run.
#[test]
fn a_move_of_an_axis_without_power_fails_its_step() {
    let text =
        "[[step]]\nenable = [\"y\"]\n[[step]]\nrepeat = 2\n[[step.step]]\nmove = { x = 1.0 }\n";
    let path = root().join("configs/test.toml");
    let error =
        ecaxis_master::config::parse(&path, &format!("{HEAD}{text}")).expect_err("x has no power");
    assert!(
        error.to_string().contains("no step before has enabled it"),
        "{error}"
    );
    let text =
        "[[step]]\nenable = [\"x\"]\n[[step]]\nmove = { x = 1.0 }\n[[step]]\ndisable = [\"x\"]\n";
    let text = format!("{HEAD}{text}").replace("enable = [\"x\"]\n[[step]]\nmove", "move");
    let mut options = virtual_time();
    options.repeat = Some(2);
    let (outcome, heard) = run(machine(&text), options);
    let error = outcome.result.expect_err("x has no power").to_string();
    assert_eq!(steps(&heard), ["1", "2", "1"]);
    assert!(error.starts_with("step 1 (line "), "{error}");
    assert!(
        error.contains("`x`") && error.contains("refused"),
        "{error}"
    );
}

#[test]
fn a_missing_input_fails_the_program_with_its_name() {
    let (result, ran, _) = program(
        r#"
[[step]]
set = { io."Output 3" = true }
[[step]]
wait = { io."Input 3" = true, io."Input 4" = true }
timeout = "250ms"
[[step]]
dwell = "1s"
"#,
    );
    let error = result.expect_err("input 4 stays off").to_string();
    assert_eq!(ran, ["1", "2"]);
    assert!(
        error.contains("io.Input 4 = 1 did not come within 250 ms: it is 0"),
        "{error}"
    );
}

#[test]
fn a_step_can_wait_for_process_data_of_a_drive() {
    let (result, ran, _) = program(
        r#"
[[step]]
wait = { x."0x6064" = { above = -5, below = 5 } }
[[step]]
disable = true
"#,
    );
    result.expect("the shaft stands at zero");
    assert_eq!(ran, ["1", "2"]);
}

/// An endless loop of steps without duration must not prevent a stop of the machine.
#[test]
fn steps_without_duration_let_the_cycle_run() {
    let mut options = virtual_time();
    options.limit = Some(50_000_000);
    let text = format!("{HEAD}[[step]]\nset = {{ io.\"Output 1\" = true }}\n");
    let (outcome, heard) = run(machine(&text), options);
    outcome.result.expect("the time limit ends it");
    assert!(steps(&heard).len() > 3);
    let nothing = format!(
        "repeat = 1000000\n{HEAD}[variables]\nn = 0\n[[step]]\nrepeat = 1000000\nstep = [{{ add = {{ n = 1 }} }}]\n"
    );
    let mut options = virtual_time();
    options.limit = Some(50_000_000);
    let (outcome, _) = run(machine(&nothing), options);
    outcome.result.expect("the time limit ends it");
}

#[test]
fn program_runs_lines_gears_tables_and_waves() {
    let (outcome, heard) = run(load("together.toml"), virtual_time());
    outcome.result.expect("runs");
    assert_eq!(steps(&heard).len(), 8);
    let summary = outcome.summary.expect("the cycle has run");
    for axis in &summary.axes {
        assert!(
            axis.final_error_counts.is_some_and(|e| e.abs() <= 1),
            "{axis:?}"
        );
        assert!(axis.target_position.abs() < 1e-6, "{axis:?}");
    }
    assert!(
        summary.machine_seconds < 10.0,
        "{}",
        summary.machine_seconds
    );
}

/// A line continues after a delay by lost frames. A drive that loses its targets at full speed, 250
/// mm/s, overshoots by 2.7 mm, which exceeds the 2.0 of the file.
#[test]
fn lost_frames_delay_a_line() {
    for (speed, following_error) in [(0.4, "2.0"), (1.0, "3.0")] {
        a_line_is_held_up(speed, following_error);
    }
}

fn a_line_is_held_up(speed: f64, following_error: &str) {
    let given = "following_error = 2.0";
    assert!(HEAD.contains(given));
    let head = HEAD.replace(given, &format!("following_error = {following_error}"));
    let text = format!(
        "{head}[[step]]\nline = {{ x = 50.0, y = 20.0 }}\nspeed = {speed:.1}\n[[step]]\ndwell = \"200ms\"\n"
    );
    let mut machine = machine(&text);
    machine.bus.lost_frames = 20;
    let script: String = (10..20)
        .map(|n| {
            format!(
                "[[fault]]\nkind = \"frame-loss\"\nat = \"{}ms\"\ncount = 4\n",
                50 * n
            )
        })
        .collect();
    let (outcome, _) = run(machine, faults(&script));
    outcome.result.expect("rides through");
    let summary = outcome.summary.expect("the cycle has run");
    assert!(summary.counters.lost_frames > 3, "{:?}", summary.counters);
    assert_eq!(summary.axes[0].target_position, 50.0);
    assert_eq!(summary.axes[1].target_position, 20.0);
}

#[test]
fn a_gear_stays_engaged_until_another_command_for_the_follower() {
    let (result, _, summary) = program(
        r#"
[[step]]
gear = { y = { to = "x", ratio = -0.5, actual = true } }
[[step]]
move = { x = 30.0 }
[[step]]
dwell = "300ms"
[[step]]
stop = ["y"]
[[step]]
move = { x = 0.0 }
[[step]]
dwell = "300ms"
"#,
    );
    result.expect("runs");
    assert_eq!(summary.axes[0].target_position, 0.0);
    assert!(
        (summary.axes[1].target_position + 15.0).abs() < 0.01,
        "{:?}",
        summary.axes[1]
    );
}

/// Homing changes the leader's position, which must not move the follower.
#[test]
fn a_leader_can_neither_home_nor_lose_power() {
    let text = HEAD.replacen(
        "following_error = 2.0 }",
        "following_error = 2.0 }\nhoming = { method = 37, position = 7.0 }",
        1,
    );
    let text = text.replacen(
        "mode = \"csp\"",
        "mode = \"csp\"\npdo.rx = [\"0x6040\", \"0x6060\", \"0x607A\"]\n\
         pdo.tx = [\"0x6041\", \"0x6061\", \"0x6064\", \"0x606C\", \"0x6077\"]",
        1,
    );
    for (order, part) in [
        ("home = [\"x\"]", "is homing"),
        ("disable = [\"x\"]", "no power"),
    ] {
        let text = format!(
            "{text}[[step]]\nmove = {{ x = 30.0 }}\n[[step]]\ngear = {{ y = {{ to = \"x\" }} }}\n\
             [[step]]\n{order}\n[[step]]\ndwell = \"1s\"\n"
        );
        let (outcome, _) = run(machine(&text), virtual_time());
        let error = outcome.result.expect_err("the gear is lost").to_string();
        assert!(error.contains("`y`") && error.contains(part), "{error}");
        let y = &outcome.summary.expect("the cycle has run").axes[1];
        assert!(y.final_position.abs() < 0.01, "{y:?}");
    }
}

#[test]
fn axes_cannot_follow_each_other() {
    let (result, ran, _) = program(
        "[[step]]\ngear = { y = { to = \"x\" } }\n[[step]]\ngear = { x = { to = \"y\" } }\n",
    );
    let error = result.expect_err("a ring").to_string();
    assert_eq!(ran, ["1", "2"]);
    assert!(error.contains("would follow each other"), "{error}");
}

#[test]
fn a_follower_that_cannot_follow_stops_the_machine() {
    let (result, _, summary) = program(
        "[[step]]\ngear = { y = { to = \"x\", ratio = 3.0 } }\n[[step]]\nmove = { x = 50.0 }\n",
    );
    let error = result.expect_err("y ends at 60").to_string();
    assert!(
        error.contains("`y`") && error.contains("cannot follow"),
        "{error}"
    );
    let x = &summary.axes[0];
    assert!(x.final_position < 49.0, "stopped on the way: {x:?}");
}

/// Time-based motion cannot wait for lost frames, so the step must not count as done.
#[test]
fn lost_frames_in_a_table_or_wave_fail_the_step() {
    for step in [
        "table = { x = \"points.csv\" }",
        "sine = { x = { amplitude = 2.0, frequency = 2.0, periods = 4 } }",
    ] {
        let mut machine = machine(&format!(
            "{HEAD}[[step]]\n{step}\n[[step]]\ndwell = \"1s\"\n"
        ));
        machine.bus.lost_frames = 20;
        let script = "[[fault]]\nkind = \"frame-loss\"\nat = \"1s\"\ncount = 12\n";
        let (outcome, heard) = run(machine, faults(script));
        let error = outcome.result.expect_err("held up").to_string();
        assert!(
            error.contains("`x`") && error.contains("lost frames delayed"),
            "{step}: {error}"
        );
        assert_eq!(steps(&heard), ["1"], "{step}");
    }
}

/// Returns the cycles after which the targets of `x` and `y` on the wire stay constant while
/// enabled.
fn last_changes(step: &str) -> [usize; 2] {
    let fine = HEAD.replace("encoder = 2000", "encoder = 1000000").replace(
        "mode = \"csp\"\n",
        "mode = \"csp\"\nsdo = [{ index = 0x6065, value = 2000000 }]\npdo.rx = [\"0x6040\", \"0x607A\"]\npdo.tx = [\"0x6041\", \"0x6064\"]\n",
    );
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut options = virtual_time();
    options.record = Some(folder.path().join("record"));
    let record = folder.path().join("record");
    let text = format!("{fine}{step}[[step]]\ndwell = \"50ms\"\n");
    let summary = run_well(machine(&text), options);
    for (axis, target) in summary.axes.iter().zip([50.0, -3.0]) {
        assert_eq!(axis.target_position, target, "{axis:?}");
    }
    let images = process_images(&record);
    [2, 8].map(|at| {
        let target = |k: usize| &images[k].0[at..at + 4];
        let moving: Vec<usize> = (1..images.len())
            .filter(|&k| images[k].0[at - 2] & 0x0f == 0x0f && target(k) != target(k - 1))
            .collect();
        *moving.last().expect("it moves")
    })
}

/// The last micrometres of a slow move are less than a count per cycle.
#[test]
fn axes_of_a_line_arrive_together() {
    let step = "[[step]]\nmove = { x = 50.0, y = -3.0 }\n";
    let [x, y] = last_changes(step);
    assert!(x > y + 50, "each as fast as it can: {x}, {y}");
    for step in [
        step.to_owned(),
        step.replace("move =", "move_by ="),
        format!("{step}speed = 0.5\nramp = 0.5\n"),
    ] {
        let [x, y] = last_changes(&format!("{step}arrive = \"together\"\n"));
        assert!(x.abs_diff(y) <= 3, "{step}: {x}, {y}");
    }
}

/// Positions are in the file's units; a modulo axis reports a position within its period.
#[test]
fn an_unreached_target_is_reported_in_its_unit() {
    // The target is between two counts, and the window is narrower than a count.
    let modulo = HEAD
        .replacen("position = [-60.0, 60.0], ", "", 1)
        .replacen("unit = \"mm\"", "unit = \"deg\"\nmodulo = 360.0", 1)
        .replacen(
            "encoder = 2000",
            "encoder = 2000\ntarget_window = 0.0001",
            1,
        );
    let text = format!("{modulo}[[step]]\nmove_by = {{ x = 725.0012 }}\n");
    let (outcome, _) = run(machine(&text), virtual_time());
    let error = outcome.result.expect_err("between two counts").to_string();
    assert!(
        error.contains("the target of 5.0012 deg is not reached, the axis is at 5.00"),
        "{error}"
    );
    let axis = &outcome.summary.expect("the cycle has run").axes[0];
    assert!((axis.target_position - 725.0012).abs() < 1e-9, "{axis:?}");
    for place in [axis.target_place, axis.final_place] {
        assert!(place.is_some_and(|p| (p - 5.0).abs() < 0.01), "{axis:?}");
    }
    let csv = HEAD.replacen("mode = \"csp\"", "mode = \"csv\"", 1);
    let text = format!("{csv}[[step]]\nvelocity = {{ x = 20.0 }}\n");
    let script = "[[fault]]\nkind = \"blocked\"\ndevice = 0\nat = \"0s\"\nfor = \"60s\"\n";
    let (outcome, _) = run(machine(&text), faults(script));
    let error = outcome.result.expect_err("it cannot turn").to_string();
    assert!(
        error.contains("the target of 20 mm/s is not reached, the axis is at 0.0"),
        "{error}"
    );
}

/// Bounds and outputs are the present values of variables, also while another branch changes them.
#[test]
fn variables_are_bounds_and_values_of_outputs() {
    let text = "[variables]\nn = 0\nlimit = { initial = 3.0, range = [0.0, 9.0] }\nlamp = { initial = 0.6, range = [0.0, 1.0] }\n\
        [[step]]\nwhile = { n = { below = \"limit\" } }\nstep = [{ add = { n = 1 } }]\n\
        [[step]]\nif = { n = \"limit\" }\nstep = [{ set = { io.\"Output 1\" = \"lamp\" } }]\nelse = [{ alarm = \"another number\" }]\n\
        [[step]]\nparallel = [{ step = [{ dwell = \"50ms\" }, { let = { limit = 1 } }] }, { step = [{ wait = { n = { above = \"limit\" } } }, { let = { lamp = 0 } }, { set = { io.\"Output 1\" = \"lamp\" } }] }]\n";
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = ecaxis_test_support::recorded(virtual_time(), folder.path());
    let (outcome, heard) = run(machine(&format!("{HEAD}{text}")), options);
    outcome.result.expect("runs");
    let rounds = steps(&heard).iter().filter(|step| *step == "1.1").count();
    assert_eq!(rounds, 3);
    let outputs = process_images(&path).into_iter();
    // The terminal has one byte behind two drives of 12 bytes out and 13 bytes in.
    let lamp: Vec<u8> = outputs
        .filter_map(|(sent, _)| sent.get(26).copied())
        .collect();
    let on = lamp.iter().position(|bits| *bits == 1).expect("on");
    let off = lamp[on..].iter().position(|bits| *bits == 0).expect("off");
    assert!((50..60).contains(&off), "{off} ms");
    let explained = heard.0.iter().filter_map(|progress| match progress {
        Progress::Program { what, .. } => Some(what.as_str()),
        _ => None,
    });
    let waits: Vec<_> = explained
        .filter(|what| what.contains("wait until"))
        .collect();
    assert_eq!(waits, ["wait until n > limit, 10 s at most"]);
}
