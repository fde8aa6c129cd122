//! Moves on top of other motions, from the set-points that the drives receive. Virtual time.

use std::path::Path;

use ecaxis_master::config::Machine;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::{assert_contains, faults, recorded, run_well};

/// An axis has 12 bytes out and 13 bytes in, at the same place of the image.
const REGION: usize = 13;
const COUNTS: f64 = 131_072.0;
const VELOCITY: f64 = 20.0;
const ACCELERATION: f64 = 500.0;
const JERK: f64 = 50_000.0;
const DT: f64 = 0.001;

fn text(steps: &str) -> String {
    let mut text = String::from("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n");
    for (position, name) in ["x", "y"].iter().enumerate() {
        text += &format!(
            "[[device]]\nname = \"{name}\"\nesi = \"esi/SV1.xml\"\nposition = {position}\nmode = \"csp\"\n[device.axis]\nencoder = {COUNTS}\n\
             limits = {{ velocity = {VELOCITY}, acceleration = {ACCELERATION}, jerk = {JERK}, torque = 100.0, following_error = 4.0 }}\n"
        );
    }
    text + steps
}

fn machine(bench: &Bench, steps: &str) -> Machine {
    bench.machine(&text(steps))
}

/// Returns the targets of both axes in every cycle in which both have power, in counts.
fn targets(recording: &Path) -> Vec<[i64; 2]> {
    let images = process_images(recording).into_iter();
    let images = images.filter(|(out, _)| out.len() >= 2 * REGION - 1);
    let axis = |out: &[u8], at: usize| {
        let word = u16::from_le_bytes([out[at], out[at + 1]]);
        let target = [out[at + 2], out[at + 3], out[at + 4], out[at + 5]];
        (word == 0x000f).then_some(i64::from(i32::from_le_bytes(target)))
    };
    let both = images.filter_map(|(out, _)| Some([axis(&out, 0)?, axis(&out, REGION)?]));
    both.collect()
}

/// Returns the targets of a run.
fn run(bench: &Bench, steps: &str) -> Vec<[i64; 2]> {
    let (options, path) = recorded(faults(""), bench.path());
    run_well(machine(bench, steps), options);
    targets(&path)
}

/// Checks velocity and acceleration, each with the rounding of its counts; and the jerk.
#[track_caller]
fn keeps_limits(seen: &[[i64; 2]], jerk_limit: f64, what: &str) {
    let limit = |order: i32, limit: f64| limit * COUNTS * DT.powi(order);
    for axis in 0..2 {
        for (cycle, w) in seen.windows(4).enumerate() {
            let [a, b, c, d] = [w[0][axis], w[1][axis], w[2][axis], w[3][axis]];
            let found = [d - c, d - 2 * c + b, d - 3 * c + 3 * b - a];
            let [velocity, acceleration, jerk] = found.map(|n| n.abs() as f64);
            assert!(velocity <= limit(1, VELOCITY) + 1.0, "{what} {cycle}");
            assert!(
                acceleration <= limit(2, ACCELERATION) + 2.0,
                "{what} {cycle}"
            );
            assert!(
                jerk <= limit(3, jerk_limit) + 4.0,
                "{what} {cycle}: {jerk} of {}",
                limit(3, jerk_limit)
            );
        }
    }
}

/// In parallel with the first steps, `x` is shifted by 0.75 once it is above a position.
fn with_shift(base: &str, above: f64) -> String {
    format!(
        "[[step]]\nenable = true\n[[step]]\nparallel = [\n{{ step = [{base}] }},\n\
         {{ step = [{{ wait = {{ x.position = {{ above = {above} }} }}, timeout = \"none\" }}, {{ superimpose = {{ x = 0.75 }} }}] }},\n]\n"
    )
}

/// The other axis is not affected, and the end is exact, on every kind of motion.
#[test]
fn moves_are_added_to_every_kind_of_motion() {
    let bench = Bench::new();
    bench.write(
        "points.csv",
        "0, 0, 0\n0.5, 3, 8\n0.9, 5, 0\n1.6, 2.0, 0\n2.2, 2.5, 0\n",
    );
    let path = "[[path]]\nname = \"p\"\naxes = [\"x\", \"y\"]\ntolerance = 0.25\nvelocity = 8.0\nacceleration = 200.0\npoints = [[0.0, 0.0], [4.0, 4.0], [8.0, 0.0], [2.5, 3.0]]\n";
    for (what, base, ends) in [
        (
            "move",
            "{ move = { x = 2.5, y = 3.0 }, speed = 0.1 }",
            [2.5, 3.0],
        ),
        (
            "line",
            "{ line = { x = 2.5, y = 3.0 }, speed = 0.1 }",
            [2.5, 3.0],
        ),
        (
            "together",
            "{ move = { x = 2.5, y = 3.0 }, speed = 0.1, arrive = \"together\" }",
            [2.5, 3.0],
        ),
        (
            "square",
            "{ square = { x = { amplitude = 1.5, frequency = 0.5, periods = 2 } } }",
            [0.0, 0.0],
        ),
        ("table", "{ table = { x = \"points.csv\" } }", [2.5, 0.0]),
        ("path", "{ path = \"p\" }", [2.5, 3.0]),
        (
            "sine",
            "{ sine = { x = { amplitude = 1.5, frequency = 1.0, periods = 3 } } }",
            [0.0, 0.0],
        ),
    ] {
        let path = if what == "path" { path } else { "" };
        let alone = run(
            &bench,
            &format!(
                "{path}[[step]]\nenable = true\n[[step]]\nparallel = [{{ step = [{base}] }}, {{ step = [{{ dwell = \"1ms\" }}] }}]\n"
            ),
        );
        // While it accelerates, and at constant velocity.
        for above in [0.02, 1.0] {
            let seen = run(&bench, &format!("{path}{}", with_shift(base, above)));
            check(&alone, &seen, what, ends);
        }
    }
}

/// Compares a run without and one with a shift.
fn check(alone: &[[i64; 2]], seen: &[[i64; 2]], what: &str, ends: [f64; 2]) {
    let shifted = [ends[0] + 0.75, ends[1]];
    for (seen, end) in [(alone, ends), (seen, shifted)] {
        let last = *seen.last().expect("cycles");
        assert_eq!(
            last.map(|counts| counts as f64 / COUNTS),
            end,
            "{what} ends"
        );
    }
    // From its first motion to its last, in cycles.
    let begins = |seen: &[[i64; 2]]| seen.iter().position(|[x, _]| *x != seen[0][0]);
    let from = [alone, seen].map(|seen| begins(seen).expect("a motion"));
    // Both have the same way below; the shift adds from 0 to 0.75.
    for (cycle, ([before, _], [after, _])) in
        (alone[from[0]..].iter()).zip(&seen[from[1]..]).enumerate()
    {
        let added = (after - before) as f64 / COUNTS;
        assert!(
            (-2.0 / COUNTS..=0.75 + 2.0 / COUNTS).contains(&added),
            "{what} {cycle}: {added}"
        );
    }
    let others = |seen: &[[i64; 2]]| {
        let mut way: Vec<_> = seen.iter().map(|[_, y]| *y).collect();
        way.dedup();
        way
    };
    assert_eq!(others(alone), others(seen), "{what}: y");
    // The jerk of both motions adds up. Tables have their own, and a square wave leaves no share
    // of the limits for the shift.
    let jerk = match what {
        "table" | "square" => f64::INFINITY,
        _ => 2.0 * JERK,
    };
    keeps_limits(seen, jerk, what);
}

/// A velocity goes on with its own ramp and its override; the position is ahead by exactly the
/// distance. At rest the distance is a move.
#[test]
fn a_velocity_goes_on_ahead_by_the_distance() {
    let bench = Bench::new();
    let steps = "[[step]]\nvelocity = { x = 8.0 }\n[[step]]\ndwell = \"200ms\"\n[[step]]\nsuperimpose = { x = 1.5 }\n\
        [[step]]\ndwell = \"200ms\"\n[[step]]\nsuperimpose = { x = -2.0, y = 0.5 }\n[[step]]\ndwell = \"200ms\"\n\
        [[step]]\nvelocity = { x = 19.9 }\n[[step]]\nsuperimpose = { x = 0.1 }\n[[step]]\nstop = [\"x\"]\n";
    let seen = run(&bench, steps);
    let calm = seen
        .windows(2)
        .position(|w| w[1][0] - w[0][0] == (8.0 * COUNTS * DT) as i64)
        .expect("the velocity");
    keeps_limits(&seen, JERK, "velocity");
    let ahead = |cycle: usize| seen[cycle][0] as f64 / COUNTS - 8.0 * DT * cycle as f64;
    let steps: Vec<f64> = (calm..seen.len() - 60)
        .step_by(10)
        .filter(|&cycle| (ahead(cycle) - ahead(cycle + 50)).abs() < 2.0 / COUNTS)
        .map(|cycle| ((ahead(cycle) - ahead(calm)) * 1000.0).round() / 1000.0)
        .collect();
    let mut levels = steps;
    levels.dedup();
    assert_eq!(levels[..3], [0.0, 1.5, -0.5], "{levels:?}");
    assert_eq!(seen.last().map(|[_, y]| *y), Some((0.5 * COUNTS) as i64));
}

#[test]
fn only_commanded_positions_are_shifted() {
    let bench = Bench::new();
    let steps = "[[step]]\nsuperimpose = { x = 1.0 }\n";
    let text = text(steps).replacen("\"csp\"", "\"csv\"", 1);
    let message = bench.parse(&text).expect_err("a velocity only");
    assert_contains(&message, &["`superimpose`", "`x`", "\"csv\""]);
}
