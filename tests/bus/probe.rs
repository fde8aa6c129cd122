//! Touch probes on the simulated bus: the captured position equals the edge on the track for any
//! motion of the axis.

use ecaxis_master::session::{Progress, Summary};
use ecaxis_test_support::{Heard, load, machine, run, run_badly, run_well, virtual_time};

/// One count of the axis below, mm.
const COUNT: f64 = 5.0 / 2000.0;

fn axis(more: &str, track: &str, steps: &str) -> String {
    format!(
        r#"
[bus]
cycle = "1ms"

[[device]]
name = "feeler"
esi = "esi/EPOS4.xml"
position = 0
mode = "csp"
pdo.rx = ["0x6040", "0x6060", "0x607A", "0x60B8", "0x6081", "0x6083", "0x6084", "0x60FF"]
pdo.tx = ["0x6041", "0x6061", "0x6064", "0x606C", "0x60B9", "0x60BA", "0x60BB", "0x60BC", "0x60BD"]

[device.axis]
unit = "mm"
per_turn = 5.0
encoder = 2000
{more}

[device.sim]
track = {track}

{steps}
"#
    )
}

const RANGE: &str = "limits = { position = [-60.0, 60.0], velocity = 250.0, acceleration = 2500.0, following_error = 5.0 }";
const ENDLESS: &str = "limits = { velocity = 250.0, acceleration = 2500.0, following_error = 5.0 }";

fn step(probe: &str) -> String {
    format!("[[step]]\nprobe = {{ feeler = {{ {probe} }} }}\nspeed = 0.2\n")
}

/// Runs one probing step. Returns the summary and the captured position.
fn probed(more: &str, track: &str, steps: &str) -> (Summary, f64) {
    let summary = run_well(machine(&axis(more, track, steps)), virtual_time());
    let [found] = summary.probes.as_slice() else {
        panic!("{:?}", summary.probes)
    };
    let position = found.position;
    (summary, position)
}

#[test]
fn probe_captures_edges_to_the_count() {
    let inverted = format!("invert = true\n{RANGE}");
    let shifted = format!("offset = 7.0\n{RANGE}");
    let both = "{ probe1 = [10.0, 12.0], probe2 = [20.0, 21.0] }";
    // A falling edge is the first count after the switch.
    let rows = [
        (RANGE, both, "to = 50.0", 10.0),
        (RANGE, both, "to = 50.0, edge = \"rising\", input = 1", 10.0),
        (RANGE, both, "by = 50.0, edge = \"falling\"", 12.0 + COUNT),
        (RANGE, both, "to = 50.0, input = 2", 20.0),
        (
            RANGE,
            both,
            "to = 50.0, input = 2, edge = \"falling\"",
            21.0 + COUNT,
        ),
        (
            RANGE,
            "{ start = 30.0, probe1 = [10.0, 12.0] }",
            "to = 0.0",
            12.0,
        ),
        (
            RANGE,
            "{ start = 30.0, probe1 = [10.0, 12.0] }",
            "by = -30.0, edge = \"falling\"",
            10.0 - COUNT,
        ),
        (&inverted, both, "to = 50.0", 10.0),
        (
            &inverted,
            both,
            "to = 50.0, edge = \"falling\"",
            12.0 + COUNT,
        ),
        (
            &inverted,
            "{ start = 30.0, probe2 = [10.0, 12.0] }",
            "to = -20.0, input = 2",
            12.0,
        ),
        (
            &shifted,
            "{ start = 7.0, probe1 = [10.0, 12.0] }",
            "to = 50.0",
            10.0,
        ),
        // The input is on when the search starts.
        (
            RANGE,
            "{ start = 11.0, probe1 = [10.0, 12.0] }",
            "to = 50.0, edge = \"falling\"",
            12.0 + COUNT,
        ),
    ];
    for (more, track, probe, expected) in rows {
        let (summary, position) = probed(more, track, &step(probe));
        assert!(
            (position - expected).abs() < COUNT / 2.0,
            "{probe}: {position}, not {expected}"
        );
        let axis = &summary.axes[0];
        // The axis stops behind the edge, long before the end of the search.
        let behind = (axis.target_position - expected).abs();
        assert!(behind > 0.1 && behind < 3.0, "{probe}: {axis:?}");
        assert_eq!(
            axis.final_error_counts.map(|n| n.abs() <= 1),
            Some(true),
            "{axis:?}"
        );
    }
}

/// The captured position is independent of the speed; only the overrun differs.
#[test]
fn captured_positions_do_not_depend_on_the_speed() {
    let mut overrun = 0.0;
    for speed in [0.01, 0.1, 0.5, 1.0] {
        let text = format!("[[step]]\nprobe = {{ feeler = {{ to = 60.0 }} }}\nspeed = {speed}\n");
        let (summary, position) = probed(RANGE, "{ probe1 = [25.0, 26.0] }", &text);
        assert!((position - 25.0).abs() < COUNT / 2.0, "{speed}: {position}");
        let beyond = summary.axes[0].target_position - position;
        assert!(beyond > overrun, "{speed}: {beyond} after {overrun}");
        // A stop from v with a takes v²/2a. The edge is detected two cycles late at most, and the
        // set-point leads by one or two cycles.
        let velocity = 250.0 * speed;
        let most = velocity * velocity / 5000.0 + 0.006 * velocity + 0.01;
        assert!(beyond < most, "{speed}: {beyond}, at most {most}");
        overrun = beyond;
    }
}

#[test]
fn modulo_axes_report_captured_positions_wrapped_and_continuous() {
    let round = format!("modulo = 36.0\nway = \"positive\"\n{ENDLESS}");
    let track = "{ start = 30.0, probe1 = [40.0, 41.0] }";
    let (outcome, Heard(heard)) = run(
        machine(&axis(&round, track, &step("to = 20.0"))),
        virtual_time(),
    );
    outcome.result.expect("found");
    let summary = outcome.summary.expect("the cycle has run");
    let found = &summary.probes[0];
    assert!((found.position - 40.0).abs() < COUNT / 2.0, "{found:?}");
    assert!(
        found.place.is_some_and(|p| (p - 4.0).abs() < COUNT / 2.0),
        "{found:?}"
    );
    assert_eq!(
        found.to_string(),
        "`feeler`: rising edge of input 1 at 4.0000 mm"
    );
    let reported = heard
        .iter()
        .filter(|p| matches!(p, Progress::Captured { run: 1, capture } if capture == found));
    assert_eq!(reported.count(), 1);
    let axis = &summary.axes[0];
    assert!(
        axis.final_place.is_some_and(|p| p > 4.0 && p < 7.0),
        "{axis:?}"
    );
    assert!(axis.final_position > 40.0, "{axis:?}");
}

#[test]
fn the_example_finds_the_same_position_every_time() {
    let summary = run_well(load("probe.toml"), virtual_time());
    let found: Vec<_> = summary
        .probes
        .iter()
        .map(|p| (p.step.as_str(), p.axis.as_str(), p.times, p.position))
        .collect();
    assert_eq!(
        found,
        [
            ("1", "x", 1, 31.25),
            ("3.1", "x", 3, 31.25),
            ("4", "table", 1, found[2].3),
        ]
    );
    assert!((found[2].3 - 410.0).abs() < 0.03, "{found:?}");
}

/// Covers profile modes of the drive and a position loop in the MainDevice.
#[test]
fn probe_works_in_other_modes() {
    let looped = format!("csv = {{ kv = 20.0 }}\n{RANGE}");
    for mode in ["pp", "csv"] {
        let steps = format!(
            "[[step]]\nmode = {{ feeler = \"{mode}\" }}\n{}",
            step("to = 50.0")
        );
        let (summary, position) = probed(&looped, "{ probe1 = [10.0, 12.0] }", &steps);
        assert!((position - 10.0).abs() < COUNT / 2.0, "{mode}: {position}");
        let axis = &summary.axes[0];
        assert_eq!(axis.mode, mode);
        let beyond = axis.final_position - position;
        assert!(beyond > 0.1 && beyond < 4.0, "{mode}: {axis:?}");
    }
}

#[test]
fn a_missing_edge_fails_the_step() {
    for (track, probe, reported) in [
        (
            "{}",
            "to = 50.0",
            "no rising edge came at the input of touch probe 1 on the way to 50 mm",
        ),
        (
            "{ probe1 = [10.0, 12.0] }",
            "to = 50.0, input = 2",
            "touch probe 2",
        ),
        (
            "{ probe1 = [10.0, 52.0] }",
            "to = 50.0, edge = \"falling\"",
            "no falling edge",
        ),
        // The input is already on.
        (
            "{ start = 11.0, probe1 = [10.0, 12.0] }",
            "to = 50.0",
            "no rising edge",
        ),
        (
            "{ probe1 = [51.0, 52.0] }",
            "by = 50.0",
            "on the way to 50 mm",
        ),
    ] {
        let text = axis(RANGE, track, &step(probe));
        let (error, summary) = run_badly(machine(&text), virtual_time());
        assert!(error.starts_with("step 1 (line "), "{error}");
        assert!(
            error.contains("`feeler`") && error.contains(reported),
            "{probe}: {error}"
        );
        let axis = &summary.expect("the cycle has run").axes[0];
        assert!((axis.final_position - 50.0).abs() < 0.1, "{axis:?}");
    }
}

/// Edges of an earlier search do not count.
#[test]
fn each_search_ignores_earlier_edges() {
    let steps = format!(
        "{}{}",
        step("to = 50.0"),
        "[[step]]\nprobe = { feeler = { to = 14.0 } }\nspeed = 0.2\n"
    );
    let text = axis(RANGE, "{ probe1 = [10.0, 20.0] }", &steps);
    let (error, summary) = run_badly(machine(&text), virtual_time());
    assert!(error.starts_with("step 2 (line "), "{error}");
    assert_eq!(summary.map(|s| s.probes.len()), Some(1));
}
