//! Backlash and pitch error of a simulated load, which has an encoder of its own (0x60E4:01):
//! where the load is, and what the drive receives. Virtual time.

use std::path::Path;

use ecaxis_axis::Command;
use ecaxis_master::config::{self, ConfigError, Machine};
use ecaxis_test_support::random::Random;
use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::script::{Act, home, move_to, perform_well};
use ecaxis_test_support::{
    assert_contains, faults, recorded, root, run, run_badly, run_well, with_load_encoder,
};

const COUNTS: f64 = 400.0;
const BACKLASH: f64 = 0.05;
const VELOCITY: f64 = 100.0;
const ACCELERATION: f64 = 1000.0;
const ERRORS: &str =
    "[[-40.0, 0.03], [-20.0, 0.0], [0.0, 0.0], [10.0, 0.02], [25.0, -0.025], [50.0, 0.04]]";

/// The EPOS4 with a position of the load.
fn esi() -> String {
    let epos4 = std::fs::read_to_string(root().join("configs/esi/EPOS4.xml"));
    with_load_encoder(&epos4.expect("our file"))
}

struct Bench(tempfile::TempDir);

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("load.xml"), esi()).expect("a file");
        Self(folder)
    }

    fn parse(&self, text: &str) -> Result<Machine, ConfigError> {
        config::parse(&self.0.path().join("m.toml"), text)
    }

    #[track_caller]
    fn machine(&self, text: &str) -> Machine {
        self.parse(text).unwrap_or_else(|error| panic!("{error}"))
    }

    fn path(&self) -> &Path {
        self.0.path()
    }
}

/// Returns a machine with one axis. `keys`: of the axis.
fn text(keys: &str, steps: &str) -> String {
    format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"x\"\nesi = \"load.xml\"\nposition = 0\nmode = \"csp\"\n\
         pdo.rx = [\"0x6040\", \"0x6060\", \"0x607A\", \"0x60B2\"]\npdo.tx = [\"0x6041\", \"0x6061\", \"0x6064\", \"0x606C\", \"0x60E4:01\"]\n\
         [device.sim]\nmotor = {{ backlash = {BACKLASH}, pitch_error = {ERRORS} }}\n[device.axis]\nunit = \"mm\"\nper_turn = 5.0\n\
         encoder = 2000\nlimits = {{ position = [-45.0, 55.0], velocity = {VELOCITY:.1}, acceleration = {ACCELERATION:.1}, jerk = 8000.0, following_error = 2.0 }}\n\
         csp = {{ torque_offset = 0.038 }}\n\
         homing = {{ method = 37, position = 0.0 }}\n{keys}\n{steps}"
    )
}

fn corrected() -> String {
    format!(
        "compensation = {{ backlash = {BACKLASH}, homing_ends = \"negative\", errors = {ERRORS} }}"
    )
}

/// What the wire carries in one cycle, in counts.
#[derive(Debug, Clone, Copy)]
struct Seen {
    controlword: u16,
    mode: u8,
    target: i32,
    statusword: u16,
    actual: i32,
    load: i32,
}

impl Seen {
    fn is_enabled(&self) -> bool {
        self.statusword & 0x6f == 0x27
    }
}

fn seen(recording: &Path) -> Vec<Seen> {
    seen_of(recording, 0)
}

/// Returns the part of a device. Each has 9 bytes out and 15 bytes in, at the same place.
fn seen_of(recording: &Path, device: usize) -> Vec<Seen> {
    const REGION: usize = 15;
    let at = device * REGION;
    let word = |data: &[u8]| u16::from_le_bytes([data[0], data[1]]);
    let long = |data: &[u8]| i32::from_le_bytes([data[0], data[1], data[2], data[3]]);
    let images = process_images(recording).into_iter();
    let images = images.filter(|(out, data)| out.len() >= at + 9 && data.len() >= at + REGION);
    images
        .map(|(out, data)| (out[at..].to_vec(), data[at..].to_vec()))
        .map(|(out, data)| Seen {
            controlword: word(&out),
            mode: out[2],
            target: long(&out[3..]),
            statusword: word(&data),
            actual: long(&data[3..]),
            load: long(&data[11..]),
        })
        .collect()
}

/// Returns the load position at the end of every stay of 100 cycles or more, in mm.
fn stays(seen: &[Seen]) -> Vec<f64> {
    let mut found = Vec::new();
    let mut since = 0;
    for (n, cycle) in seen.iter().enumerate() {
        let moved = n > 0 && cycle.target != seen[n - 1].target;
        if moved || !cycle.is_enabled() {
            if n - since > 100 && seen[n - 1].is_enabled() {
                found.push(f64::from(seen[n - 1].load) / COUNTS);
            }
            since = n;
        }
    }
    found
}

const TARGETS: [f64; 10] = [
    10.0, 30.0, 29.9, 29.0, 29.02, -30.0, -5.0, -5.01, 42.0, 12.5,
];

fn moves(speed: f64) -> Vec<Act> {
    let mut acts = vec![home(5.0), Act::Dwell(0.2)];
    for target in TARGETS {
        acts.extend([move_to(target, speed), Act::Dwell(0.2)]);
    }
    acts
}

/// Asserts that the targets keep the limits of the drive while it follows them.
#[track_caller]
fn assert_limits(seen: &[Seen]) {
    // A target is rounded to a count.
    let [velocity, acceleration] = [VELOCITY * COUNTS * 1e-3, ACCELERATION * COUNTS * 1e-6];
    for w in seen.windows(3) {
        let follows = |c: &Seen| c.is_enabled() && c.mode == 8 && c.controlword == 0x0f;
        if !w.iter().all(follows) {
            continue;
        }
        let [a, b, c] = [0, 1, 2].map(|n| f64::from(w[n].target));
        assert!((c - b).abs() <= velocity + 1.0, "{w:?}");
        assert!((c - 2.0 * b + a).abs() <= acceleration + 2.0, "{w:?}");
    }
}

/// Returns the largest error of the load after each of the moves, in counts.
fn largest_error(keys: &str, speed: f64) -> f64 {
    let bench = Bench::new();
    let (options, path) = recorded(faults(""), bench.path());
    perform_well(bench.machine(&text(keys, "")), "x", &moves(speed), options);
    let seen = seen(&path);
    assert_limits(&seen);
    let stays = stays(&seen);
    let arrived = &stays[stays.len() - TARGETS.len()..];
    let errors = arrived.iter().zip(TARGETS).map(|(load, target)| {
        println!("{target}: {:+.1} counts", (load - target) * COUNTS);
        (load - target).abs() * COUNTS
    });
    errors.fold(0.0, f64::max)
}

#[test]
fn the_load_arrives_from_both_directions() {
    for speed in [1.0, 0.1] {
        let error = largest_error(&corrected(), speed);
        assert!(error <= 2.0, "{error} counts");
        // 20 counts of backlash, and up to 16 of the pitch.
        let without = largest_error("", speed);
        assert!((20.0..40.0).contains(&without), "{without} counts");
    }
}

/// Homing ends in the positive direction at the index pulse: its flank is the one without play.
#[test]
fn homing_ends_on_the_reference_flank() {
    let bench = Bench::new();
    let keys = corrected().replace("negative", "positive");
    let text = text(&keys, "")
        .replace("method = 37", "method = 34, search = 20.0, zero = 5.0")
        .replace("motor = {", "track = { index = 3.0 }\nmotor = {");
    let (options, path) = recorded(faults(""), bench.path());
    let trace = perform_well(bench.machine(&text), "x", &moves(0.5), options);
    assert!(trace.cycles.iter().all(|cycle| cycle.guarded_cycles == 0));
    let seen = seen(&path);
    assert_limits(&seen);
    let stays = stays(&seen);
    let arrived = &stays[stays.len() - TARGETS.len()..];
    // Home is at the index pulse, and the table is that of positions from there.
    let away = |n: usize| (arrived[n] - TARGETS[n]) * COUNTS;
    for (n, target) in TARGETS.iter().enumerate() {
        println!("{target}: {:+.1} counts from home", away(n));
    }
    // Equal places from both directions, and the same distance between places.
    for (a, b) in [(1, 2), (3, 4), (6, 7)] {
        assert!((away(a) - away(b)).abs() <= 2.5, "{a} {b}");
    }
}

fn within(random: &mut Random, low: f64, high: f64) -> f64 {
    low + (high - low) * random.below(1_000_000) as f64 * 1e-6
}

/// Random moves with stops at random moments, while frames are lost. The targets keep the limits of
/// the drive, and no target moves once a stop has come to rest.
#[test]
fn stops_at_random_moments_keep_the_limits() {
    for seed in 1..=12 {
        let mut random = Random::new(seed);
        let mut acts = vec![home(5.0)];
        for _ in 0..25 {
            let order = match random.below(3) {
                0 => Command::Velocity {
                    velocity: within(&mut random, -60.0, 60.0),
                    ramp: 0.5,
                },
                1 => Command::MoveBy {
                    distance: within(&mut random, -0.3, 0.3),
                    speed: 1.0,
                    ramp: 1.0,
                },
                _ => Command::MoveTo {
                    position: within(&mut random, -30.0, 30.0),
                    speed: within(&mut random, 0.05, 1.0),
                    ramp: within(&mut random, 0.1, 1.0),
                },
            };
            let moving = within(&mut random, 0.03, 0.3);
            acts.extend([Act::Begin(order), Act::Dwell(moving)]);
            acts.extend([Act::Begin(Command::Stop), Act::Dwell(0.5)]);
        }
        let bench = Bench::new();
        let script = format!(
            "seed = {seed}\n[[fault]]\nkind = \"frame-loss\"\nat = \"1s\"\nfor = \"20s\"\nprobability = {}\n",
            if seed % 2 == 0 { "0.02" } else { "0.0" }
        );
        let (options, path) = recorded(faults(&script), bench.path());
        let text = text(&corrected(), "")
            .replace("cycle = \"1ms\"\n", "cycle = \"1ms\"\nlost_frames = 20\n");
        let trace = perform_well(bench.machine(&text), "x", &acts, options);
        let seen = seen(&path);
        if seed % 2 != 0 {
            assert_limits(&seen);
        }
        // The last 150 ms after each stop.
        let mut checked = 0;
        for (n, act) in acts.iter().enumerate() {
            if let (Act::Dwell(_), Some(Act::Begin(Command::Stop))) =
                (act, acts.get(n.wrapping_sub(1)))
            {
                let cycles = trace.of(n);
                let rest = &cycles[cycles.len().saturating_sub(150)..];
                let first = rest[0].target_position;
                assert!(
                    rest.iter().all(|c| c.target_position == first),
                    "seed {seed}"
                );
                checked += 1;
            }
        }
        assert_eq!(checked, 25);
        assert!(
            trace
                .cycles
                .iter()
                .all(|c| c.guarded_cycles == 0 && c.trip.is_none())
        );
        // So do the targets on the wire: a stay of 100 cycles or more after each, but for a motion
        // that is shorter than a count.
        let stays = stays(&seen).len();
        assert!(stays >= 24, "seed {seed}: {stays}");
    }
}

const ENCODER: &str =
    "second_encoder = { input = \"x.0x60E4:01\", counts_per_unit = 400.0, max_difference = 0.015 }";

/// The corrected axis is where the encoder at its load says. Without correction they part.
#[test]
fn a_second_encoder_stops_an_axis_that_is_elsewhere() {
    let steps = "[[step]]\nhome = true\n[[step]]\nmove = { x = 40.0 }\n[[step]]\nmove = { x = -30.0 }\n[[step]]\nmove = { x = 5.0 }\n";
    let bench = Bench::new();
    let keys = format!("{}\n{ENCODER}", corrected());
    run_well(bench.machine(&text(&keys, steps)), faults(""));
    let (options, path) = recorded(faults(""), bench.path());
    let (error, summary) = run_badly(bench.machine(&text(ENCODER, steps)), options);
    println!("{error}");
    assert_contains(
        &error,
        &["`x`", "off that of the second encoder: the limit is 0.0150"],
    );
    for axis in summary.expect("the cycle has run").axes {
        assert_ne!(axis.final_state, "Operation enabled");
    }
    // The cycle that shows the difference sends the quick stop.
    let seen = seen(&path);
    let moves = seen.iter().skip_while(|c| c.controlword & 0x0f != 0x0f);
    let apart = |c: &Seen| f64::from(c.actual - c.load).abs() / COUNTS > 0.015;
    let first = moves.clone().position(apart).expect("a difference");
    let stopped = moves.clone().position(|c| c.controlword == 0x0002);
    let stopped = stopped.expect("a quick stop");
    assert!((first..=first + 3).contains(&stopped), "{first} {stopped}");
    // Nothing is compared before home is known.
    let steps = steps.replace("[[step]]\nhome = true\n", "");
    run_well(bench.machine(&text(ENCODER, &steps)), faults(""));
}

/// The limits of the drive must permit the positions that the correction adds: the range ends 0.01
/// beyond `limits.position`.
#[test]
fn the_limits_of_the_drive_are_compared_with_its_own_positions() {
    let sdo = "mode = \"csp\"\nsdo = [{ index = 0x607D, sub = 1, value = -18050 }, { index = 0x607D, sub = 2, value = 22000 }]\n";
    for (keys, exceeds) in [(corrected(), true), (String::new(), false)] {
        let bench = Bench::new();
        let text = text(&keys, "[[step]]\nhome = true\n").replacen("mode = \"csp\"\n", sdo, 1);
        let (outcome, heard) = run(bench.machine(&text), faults(""));
        outcome.result.expect("runs");
        let warnings = heard.warnings();
        let about =
            |text: &&String| text.contains("0x607d:02") && text.contains("goes to 55.01 mm");
        assert_eq!(
            warnings.iter().any(|text| about(&text)),
            exceeds,
            "{warnings:?}"
        );
    }
}

#[test]
fn the_type_of_an_encoder_says_whether_its_counts_are_negative() {
    for (kind, unsigned) in [("DINT", false), ("UDINT", true)] {
        let bench = Bench::new();
        let name = "<Name>Position of the load</Name><Type>";
        let esi = esi().replacen(&format!("{name}DINT"), &format!("{name}{kind}"), 1);
        std::fs::write(bench.path().join("load.xml"), esi).expect("a file");
        let machine = bench.machine(&text(ENCODER, ""));
        let encoder = machine
            .axes
            .iter()
            .find_map(|axis| axis.config.second_encoder);
        assert_eq!(encoder.map(|encoder| encoder.unsigned), Some(unsigned));
    }
}

#[test]
fn a_pitch_error_needs_no_backlash() {
    let bench = Bench::new();
    let keys = "compensation = { errors = [[0.0, 0.0], [1.0, 0.01]] }";
    bench.parse(&text(keys, "")).expect("a machine");
}

#[test]
#[rustfmt::skip] // one row per mistake
fn wrong_corrections_are_refused() {
    let bench = Bench::new();
    std::fs::write(bench.path().join("bad.csv"), "position,error\n0,0\n10,x\n").expect("a file");
    let table = "compensation = { errors =";
    for (keys, message, hint) in [
        ("compensation = {}", "neither a backlash nor a pitch error", "write `errors"),
        ("compensation = { backlash = -0.1, homing_ends = \"positive\" }", "a backlash of -0.1 is not possible", "the way that the motor turns"),
        ("compensation = { backlash = 0.1 }", "which flank has no play", "homing_ends = \"negative\""),
        ("compensation = { backlash = 0.1, homing_ends = \"up\" }", "`homing_ends` cannot be \"up\"", "`positive`"),
        (&format!("{table} [[0.0, 0.0], [0.0, 0.1]] }}"), "does not come after 0", "a row is a position"),
        (&format!("{table} [[0.0, 0.0], [1.0, 0.2]] }}"), "the error changes by 20.0 % of the way", "the scale of the axis"),
        (&format!("{table} [[0.0, 0.0], [0.01, 0.0002], [0.02, 0.0]] }}"), "bends too much", "farther apart"),
        (&format!("{table} [[0.0, 0.0], [1.0]] }}"), "a point has 2 numbers", "a row is a position"),
        (&format!("{table} [[0.0, 0.0]] }}"), "2 to 100000 points, not 1", "a row is a position"),
        ("compensation = { file = \"none.csv\" }", "none.csv", "relative to the machine file"),
        ("compensation = { file = \"bad.csv\" }", "line 3: a field is not a number", "a row is a position"),
        ("second_encoder = { input = \"x.0x60E5:01\", counts_per_unit = 400.0, max_difference = 0.1 }", "0x60E5:01", "Position of the load"),
        ("second_encoder = { input = \"x.0x6041\", counts_per_unit = 400.0, max_difference = 0.1 }", "has no 32 bits of counts", "DINT"),
        ("second_encoder = { input = \"x.0x60E4:01\", counts_per_unit = 0.0, max_difference = 0.1 }", "an encoder has counts", "in one unit"),
        ("second_encoder = { input = \"x.0x60E4:01\", counts_per_unit = 400.0, max_difference = 0.0 }", "`max_difference` is above 0", "sound machine"),
    ] {
        let text = text(keys, "");
        let error = bench.parse(&text).expect_err(keys).to_string();
        let line = text.lines().position(|line| line.starts_with(keys)).expect("a line") + 1;
        assert_contains(&error, &[message, hint, &format!(":{line}:")]);
    }
    let csv = text(&corrected(), "").replace("mode = \"csp\"", "mode = \"csv\"").replace("0x607A", "0x60FF");
    let error = bench.parse(&csv.replace("csp = {", "#")).expect_err("csv").to_string();
    assert_contains(&error, &["nothing commands the position of an axis in `mode = \"csv\"`", "csv = { kv = 20.0 }"]);
    let pp = text(&corrected(), "").replace("mode = \"csp\"", "mode = \"pp\"").replace("\"0x60B2\"", "\"0x6081\", \"0x6083\", \"0x6084\"");
    let error = bench.parse(&pp.replace("csp = {", "#")).expect_err("pp").to_string();
    assert_contains(&error, &["the drive plans with its own positions", "mode = \"csp\""]);
}

/// A second drive whose mechanics have other errors.
fn two(own: &str, steps: &str) -> String {
    let first = text(&corrected(), "");
    let (bus, device) = first.split_at(first.find("[[device]]").expect("a device"));
    let second = device
        .replace("name = \"x\"", "name = \"y\"")
        .replace("position = 0\nmode", "position = 1\nmode")
        .replace(&format!("backlash = {BACKLASH}"), "backlash = 0.1")
        .replace(ERRORS, own);
    format!("{bus}{device}{second}{steps}")
}

const OTHER: &str = "[[-40.0, -0.02], [-10.0, 0.01], [20.0, 0.03], [50.0, -0.01]]";

/// Halves with different errors: their loads are at the same place after each move, and both drives
/// keep their limits.
#[test]
fn halves_of_a_gantry_have_corrections_of_their_own() {
    let mut steps = String::from(
        "[[gantry]]\naxes = [\"x\", \"y\"]\nmax_skew = 0.5\n[[step]]\nhome = [\"x\"]\n[[step]]\ndwell = \"200ms\"\n",
    );
    for target in TARGETS {
        steps += &format!("[[step]]\nmove = {{ x = {target:?} }}\n[[step]]\ndwell = \"200ms\"\n");
    }
    let bench = Bench::new();
    let (options, path) = recorded(faults(""), bench.path());
    run_well(bench.machine(&two(OTHER, &steps)), options);
    for device in [0, 1] {
        let seen = seen_of(&path, device);
        assert_limits(&seen);
        let stays = stays(&seen);
        let arrived = &stays[stays.len() - TARGETS.len()..];
        for (load, target) in arrived.iter().zip(TARGETS) {
            let error = (load - target).abs() * COUNTS;
            assert!(error <= 2.0, "drive {device} at {target}: {error} counts");
        }
    }
}

/// The partner fails at moments around a reversal: the targets keep the limits, and come to rest.
#[test]
fn a_fault_of_the_partner_stops_the_correction_too() {
    for at in (0..12).map(|n| 700 + 25 * n) {
        let steps = "[[step]]\nmove = { x = 10.0, y = 10.0 }\n[[step]]\nmove = { x = -30.0, y = -30.0 }\n[[step]]\nmove = { x = 5.0 }\n";
        let script = format!(
            "[[fault]]\nkind = \"drive-fault\"\nat = \"{at}ms\"\ndevice = 1\ncode = 0x2310\n"
        );
        let bench = Bench::new();
        let (options, path) = recorded(faults(&script), bench.path());
        let (error, _) = run_badly(bench.machine(&two(OTHER, steps)), options);
        assert_contains(&error, &["`y`", "0x2310"]);
        let seen = seen(&path);
        assert_limits(&seen);
        let powered: Vec<_> = seen.iter().filter(|c| c.controlword == 0x0f).collect();
        let [.., before, last] = powered.as_slice() else {
            panic!("no cycles")
        };
        assert_eq!(before.target, last.target, "{at}: at rest before power-off");
    }
}
