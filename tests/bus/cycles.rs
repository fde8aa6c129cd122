//! The shortest and longest cycle times, on the simulated bus in virtual time.

use ecaxis_master::config::Machine;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::{axes, faults, machine, run, run_badly, run_well, virtual_time};

/// Returns the machine of `axes` with another cycle.
fn at(cycle: &str) -> String {
    axes(2).replace("\"1ms\"", &format!("\"{cycle}\""))
}

fn moves(machine: Machine, cycle_ns: u64) {
    assert_eq!(machine.bus.cycle_ns, cycle_ns);
    let summary = run_well(machine, virtual_time());
    assert_eq!(summary.cycle_ns, cycle_ns);
    assert_eq!(summary.counters.overruns, 0);
    assert_eq!(summary.counters.lost_frames, 0);
    assert_eq!(summary.axes.len(), 2);
    for axis in &summary.axes {
        let error = axis.final_error_counts.expect("CSP");
        assert!(error.abs() <= 1, "{axis:#?}");
    }
    let phase = summary.dc_phase_error.expect("distributed clocks");
    assert!(phase.count > 0, "frames keep in phase with SYNC0");
    // 80 turns and back at 50 turns/s and 500 turns/s²: 1.7 s each, plus bring-up and stop.
    assert!(
        (3.4..10.0).contains(&summary.machine_seconds),
        "{}",
        summary.machine_seconds
    );
}

#[test]
fn axes_move_at_four_kilohertz() {
    moves(machine(&at("250us")), 250_000);
}

#[test]
fn axes_move_at_fifty_hertz() {
    // A drive at 50 turns/s lags one turn behind a target that changes every 20 ms.
    let text = at("20ms").replace("following_error = 1.0", "following_error = 4.0");
    moves(machine(&text), 20_000_000);
}

/// A cycle that 0x60C2 cannot express is rejected, except for drives without this object.
fn moves_without_interpolation_time(cycle: &str, cycle_ns: u64, refused: &str) {
    let text = at(cycle);
    let bench = Bench::new();
    let error = bench.parse(&text).expect_err("EPOS4 has 0x60C2");
    assert!(error.contains(refused), "{error}");
    bench.change("esi/EPOS4.xml", |esi| esi.replace("#x60C2", "#x2FFF"));
    moves(bench.machine(&text), cycle_ns);
}

/// 62.5 µs is 625 × 10⁻⁷ s, and 0x60C2 has only 8 bits for the value 625.
#[test]
fn sixteen_kilohertz_requires_drives_without_0x60c2() {
    let refused = "62500 ns cannot be written to 0x60C2 (value 0..100 times a power of ten); nearest are 62 µs and 63 µs";
    moves_without_interpolation_time("62.5us", 62_500, refused);
}

/// 125 µs is expressible, but this drive's file allows 100 at most.
#[test]
fn eight_kilohertz_requires_drives_without_0x60c2() {
    let refused = "125000 ns cannot be written to 0x60C2 (value 0..100 times a power of ten); nearest are 120 µs and 130 µs";
    moves_without_interpolation_time("125us", 125_000, refused);
}

#[test]
fn a_cycle_shorter_than_its_frames_is_reported_as_lost_bus() {
    // 30 axes need more than three quarters of 50 µs on the wire.
    let text = axes(30).replace("\"1ms\"", "\"50us\"");
    let (error, summary) = run_badly(machine(&text), virtual_time());
    assert!(
        error.contains("cyclic frames do not return in time") || error.contains("bus is lost"),
        "{error}"
    );
    assert!(summary.is_some_and(|s| s.counters.cycles > 0));
}

/// Limits of a drive looked like a wrong machine file when the computer had missed some cycles.
#[test]
fn a_limit_of_the_drive_names_lost_frames_as_its_cause() {
    let limits = |script: &str| {
        let (outcome, heard) = run(machine(&axes(1)), faults(script));
        assert!(outcome.result.is_ok(), "{outcome:?}");
        let mut limits = heard.warnings();
        limits.retain(|text| text.contains("internal limit active"));
        limits
    };
    assert_eq!(limits(""), [""; 0]);
    let two = "[[fault]]\nkind = \"frame-loss\"\ncount = 2\nat = ";
    let script = (8..16).map(|tenth| format!("{two}\"{tenth}00ms\"\n"));
    let caught_up = limits(&script.collect::<String>());
    assert_eq!(caught_up.len(), 1, "{caught_up:?}");
    assert!(
        caught_up[0].contains("to catch up after late or lost frames"),
        "{caught_up:?}"
    );
}
