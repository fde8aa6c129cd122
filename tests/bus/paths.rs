//! Lines and arcs of several axes, as the drives receive them. Virtual time.

use std::path::Path;

use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::{
    assert_contains, faults, load, recorded, run_badly, run_well, virtual_time,
};

/// An axis has 12 bytes out and 13 bytes in, at the same place of the image.
const REGION: usize = 13;
const COUNTS: f64 = 131_072.0;
const ACCELERATION: f64 = 400.0;

fn text(rest: &str) -> String {
    let mut text = String::from("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n");
    for (position, name) in ["x", "y"].iter().enumerate() {
        text += &format!(
            "[[device]]\nname = \"{name}\"\nesi = \"esi/SV1.xml\"\nposition = {position}\nmode = \"csp\"\n[device.axis]\nencoder = {COUNTS}\n\
             limits = {{ position = [-20.0, 20.0], velocity = 20.0, acceleration = {ACCELERATION:.1}, jerk = 40000.0, torque = 100.0, following_error = 4.0 }}\n"
        );
    }
    text + rest
}

const SQUARE: &str = "[[path]]\nname = \"p\"\naxes = [\"x\", \"y\"]\ntolerance = 0.2\n\
    points = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]\n[[step]]\npath = \"p\"\n";

/// Returns the targets of both axes, in turns, in every cycle in which both have power.
fn targets(recording: &Path) -> Vec<[f64; 2]> {
    let images = process_images(recording).into_iter();
    let images = images.filter(|(out, _)| out.len() >= 2 * REGION - 1);
    let axis = |out: &[u8], at: usize| {
        let word = u16::from_le_bytes([out[at], out[at + 1]]);
        let target = [out[at + 2], out[at + 3], out[at + 4], out[at + 5]];
        (word == 0x000f).then_some(f64::from(i32::from_le_bytes(target)) / COUNTS)
    };
    let both = images.filter_map(|(out, _)| Some([axis(&out, 0)?, axis(&out, REGION)?]));
    both.collect()
}

#[test]
fn the_outline_runs() {
    let summary = run_well(load("outline.toml"), virtual_time());
    assert_eq!(summary.program_runs, 1);
    let ends = summary.axes.iter().map(|axis| axis.target_position);
    assert_eq!(ends.collect::<Vec<_>>(), [120.0, 0.0]);
}

/// A full circle of two arcs: every set-point is within the tolerance of its radius, and the speed
/// does not fall in between.
#[test]
fn arcs_keep_their_radius() {
    let path = "[[path]]\nname = \"c\"\naxes = [\"x\", \"y\"]\ntolerance = 0.01\nvelocity = 10.0\npoints = [[5.0, 0.0], \
        { through = [0.0, 5.0], to = [-5.0, 0.0] }, { through = [0.0, -5.0], to = [5.0, 0.0] }]\n[[step]]\npath = \"c\"\n";
    let bench = Bench::new();
    let (options, recording) = recorded(virtual_time(), bench.path());
    run_well(bench.machine(&text(path)), options);
    let seen = targets(&recording);
    let from = seen
        .iter()
        .position(|at| at[1] > 1.0 / COUNTS)
        .expect("the arc");
    let rows = &seen[from..];
    let mut fastest = 0;
    for (n, pair) in rows.windows(2).enumerate() {
        let radius = pair[0][0].hypot(pair[0][1]);
        assert!((radius - 5.0).abs() <= 0.01, "cycle {n}: {radius}");
        let speed = (pair[1][0] - pair[0][0]).hypot(pair[1][1] - pair[0][1]) * 1e3;
        assert!(speed <= 10.0 + 3e3 / COUNTS, "{speed}");
        fastest += usize::from(speed >= 9.98);
    }
    // Of 3.14 s without acceleration and deceleration.
    assert!((2900..3150).contains(&fastest), "{fastest}");
}

/// The rows of a file with times are set-points in their cycles.
#[test]
fn timed_points_are_passed_in_time() {
    let bench = Bench::new();
    let rows = "0,0,0,0,0\n0.3,1.5,8,-1,-4\n0.7,4,3,-2,0\n1.0,4.5,0,-2,0\n";
    bench.write("pvt.csv", rows);
    let steps = "[[path]]\nname = \"p\"\naxes = [\"x\", \"y\"]\nfile = \"pvt.csv\"\n[[step]]\npath = \"p\"\n";
    let (options, recording) = recorded(virtual_time(), bench.path());
    run_well(bench.machine(&text(steps)), options);
    let seen = targets(&recording);
    let first = seen.iter().position(|at| at[0] > 0.0).expect("a motion");
    for (cycle, expected) in [(300, [1.5, -1.0]), (700, [4.0, -2.0]), (1000, [4.5, -2.0])] {
        // Times add up with rounding, so a row may count for the cycle after it.
        let at = [first + cycle - 1, first + cycle].map(|row| seen[row.min(seen.len() - 1)]);
        let near =
            |at: [f64; 2]| (0..2).all(|axis| (at[axis] - expected[axis]).abs() <= 0.51 / COUNTS);
        assert!(at.into_iter().any(near), "{cycle}: {at:?}");
    }
}

/// One axis fails on the path: the other one decelerates within its limits, from the next cycle on.
#[test]
fn a_fault_on_a_path_stops_the_other_axis() {
    let bench = Bench::new();
    for at in ["500ms", "700ms", "1100ms"] {
        let script = format!(
            "[[fault]]\nkind = \"drive-fault\"\nat = \"{at}\"\ndevice = 0\ncode = 0x2310\n"
        );
        let (options, recording) = recorded(faults(&script), bench.path());
        let (error, summary) = run_badly(bench.machine(&text(SQUARE)), options);
        assert_contains(&error, &["`x`", "0x2310"]);
        let summary = summary.expect("the cycle has run");
        for axis in &summary.axes {
            assert_ne!(axis.final_state, "Operation enabled");
        }
        // The targets of the other axis while it has power.
        let mut y = Vec::new();
        for (out, _) in process_images(&recording) {
            if out.len() >= 2 * REGION - 1 && out[REGION] == 0x0f {
                let target = [2, 3, 4, 5].map(|at| out[REGION + at]);
                y.push(f64::from(i32::from_le_bytes(target)));
            }
        }
        let most = ACCELERATION * COUNTS * 1e-6 + 2.0;
        for w in y.windows(3) {
            let change = (w[2] - 2.0 * w[1] + w[0]).abs();
            assert!(change <= most, "{at}: {change}");
        }
        let [.., before, last] = y.as_slice() else {
            panic!("no cycles")
        };
        assert_eq!(before, last, "{at}: at rest before power-off");
    }
}

#[test]
#[rustfmt::skip] // one row per mistake
fn wrong_paths_are_refused() {
    let bench = Bench::new();
    bench.write("rows.csv", "0, 0\n1, 1\n2\n");
    bench.write("late.csv", "0, 0, 0\n1, 1, 1\n1, 2, 2\n");
    for (from, to, parts) in [
        ("path = \"p\"", "path = \"q\"", &["no path is named `q`", "`p`"] as &[&str]),
        ("[\"x\", \"y\"]", "[\"x\", \"z\"]", &["no axis is named `z`"]),
        ("[\"x\", \"y\"]", "[\"x\", \"x\"]", &["`x` is named twice"]),
        ("[10.0, 10.0]", "[10.0]", &["point 3 has 1 positions for 2 axes"]),
        ("[10.0, 10.0]", "[30.0, 10.0]", &["`x` cannot follow this path", "s after its begin", "20"]),
        ("[10.0, 0.0], [10.0, 10.0]", "{ through = [5.0, 0.0], to = [10.0, 0.0] }", &["three points on a straight line"]),
        ("tolerance = 0.2\n", "", &[]),
        ("tolerance = 0.2\npoints = [[0.0, 0.0], [10.0, 0.0]", "points = [[0.0, 0.0], { through = [5.0, 1.0], to = [10.0, 0.0] }", &["an arc needs a tolerance"]),
        ("tolerance = 0.2", "tolerance = -0.2", &["a tolerance is not negative"]),
        ("tolerance = 0.2", "velocity = 0.0", &["`velocity` must be above 0"]),
        ("tolerance = 0.2", "velocity = 0.000001", &["takes more than"]),
        ("points = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]", "points = [[0.0, 0.0]]", &["two different points"]),
        ("points = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]", "points = [[0.0, 0.0], [0.0, 0.0]]", &["two different points"]),
        ("points = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]", "points = []", &["begins at a point"]),
        ("points = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]", "", &["either `points` or a `file`"]),
        ("points = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]", "file = \"none.csv\"", &["none.csv"]),
        ("points = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]", "file = \"rows.csv\"", &["line 3: point 3 has 1 positions"]),
        ("points = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]", "file = \"late.csv\"", &["does not go with a file that has times"]),
        ("tolerance = 0.2\npoints = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]", "file = \"late.csv\"", &["line 3", "does not come after"]),
        ("[[step]]", "[[path]]\nname = \"p\"\naxes = [\"x\"]\npoints = [[0.0], [1.0]]\n[[step]]", &["the path \"p\" is there already"]),
        ("[[path]]", "[[stop.group]]\nname = \"a\"\naxes = [\"x\"]\n[[path]]", &["different groups", "[[stop.group]]"]),
    ] {
        assert!(SQUARE.contains(from), "{from}");
        let text = text(&SQUARE.replacen(from, to, 1));
        match bench.parse(&text) {
            Ok(_) => assert!(parts.is_empty(), "{to} is accepted"),
            Err(error) => {
                assert!(!parts.is_empty(), "{error}");
                assert_contains(&error.to_string(), parts);
                assert!(error.to_string().contains("help:"), "{error}");
            }
        }
    }
}

/// Two lines in branches that run at the same time: the override of one group leaves the other line
/// as fast as it was.
#[test]
fn lines_in_parallel_branches_are_independent() {
    let mut text = String::from("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n");
    for (position, name) in ["a", "b", "c", "d"].iter().enumerate() {
        text += &format!(
            "[[device]]\nname = \"{name}\"\nesi = \"esi/SV1.xml\"\nposition = {position}\nmode = \"csp\"\n[device.axis]\nencoder = {COUNTS}\n\
             limits = {{ velocity = 20.0, acceleration = {ACCELERATION:.1}, torque = 100.0, following_error = 4.0 }}\n"
        );
    }
    text += "[[stop.group]]\nname = \"left\"\naxes = [\"a\", \"b\"]\n[[step]]\noverride = { left = 20 }\n\
        [[step]]\nparallel = [{ step = [{ line = { a = 10.0, b = 5.0 } }] }, { step = [{ line = { c = -8.0, d = 16.0 } }] }]\n";
    let bench = Bench::new();
    let (options, recording) = recorded(virtual_time(), bench.path());
    run_well(bench.machine(&text), options);
    let mut alone = 0;
    for (out, _) in process_images(&recording) {
        if out.len() < 4 * REGION - 1 || (0..4).any(|n| out[n * REGION] != 0x0f) {
            continue;
        }
        let at = |n: usize| {
            let target = [2, 3, 4, 5].map(|byte| out[n * REGION + byte]);
            i64::from(i32::from_le_bytes(target))
        };
        // The devices of a group follow the others in the image.
        let [c, d, a, b] = [0, 1, 2, 3].map(at);
        // Each axis begins where its drive stands, at most some counts from 0.
        assert!((a - 2 * b).abs() <= 8, "{a} {b}");
        assert!((2 * c + d).abs() <= 8, "{c} {d}");
        // The right line is at its end.
        alone += usize::from(d == 16 * COUNTS as i64 && a < 10 * COUNTS as i64);
    }
    assert!(alone > 1000, "{alone}");
}
