//! Override and hold by inputs at random times, over every kind of motion, as the drives receive it.
//!
//! `ECAXIS_OVERRIDE_SEEDS` sets the number of seeds for each kind (default 4).

use std::fmt::Write as _;

use ecaxis_master::config::Machine;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::random::Random;
use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::{assert_contains, recorded, run_badly, run_well, virtual_time};

/// Counts per turn: the jerk limit is 13 counts per cycle³.
const COUNTS: f64 = 131_072.0;
const VELOCITY: f64 = 20.0;
const ACCELERATION: f64 = 500.0;
const JERK: f64 = 100_000.0;
const DT: f64 = 0.001;

/// A kind of motion: its steps, the limits that it promises, where the axes end.
struct Kind {
    name: &'static str,
    steps: &'static str,
    jerk_limited: bool,
    /// The corners of the lines that the axes stay on, within a tolerance in turns.
    lines: (&'static [[f64; 3]], f64),
    end: [f64; 3],
}

const fn kind(name: &'static str, steps: &'static str, jerk_limited: bool, end: [f64; 3]) -> Kind {
    Kind {
        name,
        steps,
        jerk_limited,
        lines: (&[], 0.0),
        end,
    }
}

const KINDS: [Kind; 10] = [
    kind(
        "move",
        "[[step]]\nmove = { x = 10.0, y = -7.0, z = 3.0 }\n[[step]]\nmove = { x = 1.0, y = 2.0 }\nspeed = 0.6\n",
        true,
        [1.0, 2.0, 3.0],
    ),
    Kind {
        lines: (&[[0.0; 3], [12.0, 12.0, -6.0], [2.0, 2.0, -1.0]], 0.0),
        ..kind(
            "line",
            "[[step]]\nline = { x = 12.0, y = 12.0, z = -6.0 }\nspeed = 0.7\n[[step]]\nline = { x = 2.0, y = 2.0, z = -1.0 }\n",
            true,
            [2.0, 2.0, -1.0],
        )
    },
    kind(
        "together",
        "[[step]]\nmove = { x = 10.0, y = -3.0, z = 3.0 }\narrive = \"together\"\n[[step]]\nmove = { x = 0.0, y = 0.0, z = 1.0 }\narrive = \"together\"\n",
        true,
        [0.0, 0.0, 1.0],
    ),
    kind(
        "table",
        "[[step]]\ntable = { x = \"points.csv\" }\n[[step]]\ntable = { y = \"points.csv\" }\n",
        false,
        [0.0, 0.0, 0.0],
    ),
    Kind {
        lines: (
            &[
                [0.0; 3],
                [4.0, 4.0, 0.0],
                [8.0, 0.0, 2.0],
                [8.0, -3.0, 0.0],
                [1.0, 2.0, 3.0],
            ],
            0.25,
        ),
        ..kind(
            "path",
            "[[path]]\nname = \"p\"\naxes = [\"x\", \"y\", \"z\"]\ntolerance = 0.25\n\
             points = [[0.0, 0.0, 0.0], [4.0, 4.0, 0.0], [8.0, 0.0, 2.0], [8.0, -3.0, 0.0], [1.0, 2.0, 3.0]]\n[[step]]\npath = \"p\"\n",
            true,
            [1.0, 2.0, 3.0],
        )
    },
    kind(
        "sine",
        "[[step]]\nsine = { x = { amplitude = 0.9, frequency = 3.2, periods = 6 } }\n",
        true,
        [0.0, 0.0, 0.0],
    ),
    kind(
        "square",
        "[[step]]\nsquare = { x = { amplitude = 1.0, frequency = 0.8, periods = 2 } }\n",
        true,
        [0.0, 0.0, 0.0],
    ),
    kind(
        "gear",
        "[[step]]\ngear = { y = { to = \"x\", ratio = 0.5 } }\n[[step]]\nmove = { x = 12.0 }\n[[step]]\nmove = { x = 2.0 }\n",
        true,
        [2.0, 1.0, 0.0],
    ),
    kind(
        "superimposed",
        "[[step]]\nenable = true\n[[step]]\nparallel = [\n{ step = [{ move = { x = 10.0, y = 4.0 }, speed = 0.4, ramp = 0.4 }] },\n\
         { step = [{ wait = { x.position = { above = 1.0 } }, timeout = \"none\" }, { superimpose = { x = -0.75 } }] },\n]\n\
         [[step]]\ngear = { y = { to = \"x\", ratio = 0.5 } }\n[[step]]\nphase = { y = 1.0 }\n",
        false,
        [9.25, 5.0, 0.0],
    ),
    kind(
        "velocity",
        "[[step]]\nvelocity = { x = 8.0 }\n[[step]]\nwait = { x.position = { above = 8.0 } }\ntimeout = \"none\"\n[[step]]\nvelocity = { x = -8.0 }\n[[step]]\nwait = { x.position = { below = 4.0 } }\ntimeout = \"none\"\n[[step]]\nvelocity = { x = 0.0 }\n[[step]]\nmove = { x = 0.0 }\n",
        true,
        [0.0, 0.0, 0.0],
    ),
];

/// Returns a folder with a terminal that has an analog input.
fn bench() -> Bench {
    let bench = Bench::new();
    let text = bench.read("esi/IO8.xml");
    let analog = "<Entry><Index>#x6400</Index><SubIndex>1</SubIndex><BitLen>16</BitLen><Name>Analog 1</Name><DataType>INT</DataType></Entry>\n</TxPdo>";
    let inputs = "DefaultSize=\"1\" StartAddress=\"#x1100\"";
    let text = text
        .replace("</TxPdo>", analog)
        .replace(inputs, "DefaultSize=\"3\" StartAddress=\"#x1100\"");
    bench.write("esi/AI.xml", &text);
    let rows = "0, 0, 0\n0.5, 3, 8\n0.8, 5, 0\n1.4, -2.8, 0\n2.0, 0, 0\n";
    bench.write("points.csv", rows);
    bench
}

/// The inputs at the start.
const WHOLE: &str = "{ at = \"0s\", set = { pot = 1000 } },\n";

/// Returns three axes with inputs for hold and override, switched at random or not at all.
fn machine(bench: &Bench, steps: &str, random: Option<u64>) -> Machine {
    let mut inputs = String::from(WHOLE);
    if let Some(seed) = random {
        let mut random = Random::new(seed);
        let mut at = 700;
        while at < 5000 {
            at += 20 + random.below(400);
            let set = match random.below(4) {
                0 => "held = true".to_owned(),
                1 | 2 => format!("held = false, pot = {}", random.below(1200)),
                _ => format!("pot = {}", random.below(1300)),
            };
            let _ = writeln!(inputs, "{{ at = \"{at}ms\", set = {{ {set} }} }},");
        }
        inputs += "{ at = \"5500ms\", set = { held = false, pot = 1000 } },\n";
    }
    with_inputs(bench, steps, &inputs)
}

fn with_inputs(bench: &Bench, steps: &str, inputs: &str) -> Machine {
    let mut text = format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[signals]\nheld = \"io.Input 1\"\npot = \"io.Analog 1\"\n\
         [override]\nhold = {{ held = true }}\ninput = \"pot\"\nfull = 1000\n[sim]\ninputs = [\n{inputs}]\n"
    );
    for (position, name) in ["x", "y", "z"].iter().enumerate() {
        let _ = write!(
            text,
            "[[device]]\nname = \"{name}\"\nesi = \"esi/SV1.xml\"\nposition = {position}\nmode = \"csp\"\n[device.axis]\nencoder = {COUNTS}\n\
             limits = {{ position = [-60.0, 60.0], velocity = {VELOCITY}, acceleration = {ACCELERATION}, jerk = {JERK}, torque = 100.0, following_error = 2.0 }}\n",
        );
    }
    text += "[[device]]\nname = \"io\"\nesi = \"esi/AI.xml\"\nposition = 3\n";
    bench.machine(&(text + steps))
}

/// Returns the targets in counts that each axis received with power, cycle by cycle.
fn targets(machine: &Machine, recording: &std::path::Path) -> [Vec<i64>; 3] {
    let mut offsets = Vec::new();
    let mut offset = 0;
    for device in &machine.devices {
        offsets.push(offset);
        let layout = &device.selection.layout;
        offset += layout.rx_bytes().max(layout.tx_bytes());
    }
    let mut targets = [const { Vec::new() }; 3];
    for (sent, _) in process_images(recording) {
        if sent.len() < offset {
            continue;
        }
        for (axis, targets) in targets.iter_mut().enumerate() {
            let at = offsets[axis];
            let word = u16::from_le_bytes([sent[at], sent[at + 1]]);
            if word == 0x000f {
                let target = [sent[at + 2], sent[at + 3], sent[at + 4], sent[at + 5]];
                targets.push(i64::from(i32::from_le_bytes(target)));
            }
        }
    }
    targets
}

/// Checks velocity, acceleration and jerk of targets, each with the rounding of its counts.
#[track_caller]
fn keeps_limits(targets: &[i64], jerk_limited: bool, what: &str) {
    let limit = |order: i32, limit: f64| limit * COUNTS * DT.powi(order);
    for (cycle, w) in targets.windows(4).enumerate() {
        let [velocity, acceleration, jerk] = [
            w[3] - w[2],
            w[3] - 2 * w[2] + w[1],
            w[3] - 3 * w[2] + 3 * w[1] - w[0],
        ]
        .map(|difference| difference.abs() as f64);
        assert!(
            velocity <= limit(1, VELOCITY) + 1.0,
            "{what} {cycle}: velocity {velocity}"
        );
        assert!(
            acceleration <= limit(2, ACCELERATION) + 2.0,
            "{what} {cycle}: {acceleration}"
        );
        assert!(
            !jerk_limited || jerk <= limit(3, JERK) + 4.0,
            "{what} {cycle}: jerk {jerk}"
        );
    }
}

/// Returns the distance of a point from lines through corners.
fn distance(at: [f64; 3], corners: &[[f64; 3]]) -> f64 {
    let dot = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let minus = |a: [f64; 3], b: [f64; 3]| [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    let lines = corners.windows(2).map(|ends| {
        let (way, out) = (minus(ends[1], ends[0]), minus(at, ends[0]));
        let along = (dot(way, out) / dot(way, way)).clamp(0.0, 1.0);
        let off = minus(out, way.map(|way| way * along));
        dot(off, off).sqrt()
    });
    lines.fold(f64::INFINITY, f64::min)
}

/// The axes stand for this many cycles between two motions.
fn longest_rest(targets: &[i64]) -> usize {
    let moves: Vec<_> = targets.windows(2).map(|w| w[0] != w[1]).collect();
    let first = moves.iter().position(|moves| *moves).unwrap_or(0);
    let last = moves.iter().rposition(|moves| *moves).unwrap_or(0);
    let rests = moves[first..=last].split(|moves| *moves).map(<[bool]>::len);
    rests.max().unwrap_or(0)
}

#[test]
fn random_overrides_keep_limits_paths_and_ends() {
    let seeds = std::env::var("ECAXIS_OVERRIDE_SEEDS");
    let seeds: u64 = seeds.map_or(4, |n| n.parse().expect("a number"));
    let bench = bench();
    for kind in KINDS {
        let mut rests = 0;
        for seed in 0..seeds {
            let machine = machine(&bench, kind.steps, Some(seed));
            let (options, recording) = recorded(virtual_time(), bench.path());
            let summary = run_well(machine.clone(), options);
            let targets = targets(&machine, &recording);
            for (index, targets) in targets.iter().enumerate() {
                let what = format!("{} seed {seed} axis {index}", kind.name);
                keeps_limits(targets, kind.jerk_limited, &what);
            }
            rests += usize::from(targets.iter().any(|targets| longest_rest(targets) > 50));
            let (corners, tolerance) = kind.lines;
            if !corners.is_empty() {
                let [x, y, z] = &targets;
                for ((x, y), z) in x.iter().zip(y).zip(z) {
                    let at = [x, y, z].map(|counts| *counts as f64 / COUNTS);
                    let off = distance(at, corners);
                    // Each axis is rounded to counts.
                    let most = tolerance + 1.0 / COUNTS;
                    assert!(off <= most, "{} seed {seed}: {off}", kind.name);
                }
            }
            for (axis, end) in summary.axes.iter().zip(kind.end) {
                assert_eq!(axis.target_position, end, "{} seed {seed}", kind.name);
                assert_eq!(axis.trip, None);
            }
        }
        println!(
            "{}: {seeds} seeds, {rests} with a hold on the way",
            kind.name
        );
        assert!(
            rests * 2 >= usize::try_from(seeds).expect("a count"),
            "{}",
            kind.name
        );
    }
}

/// A hold at three moments of each kind of motion: all axes rest together until it ends, and go on.
#[test]
fn a_held_machine_rests_whatever_moves_it() {
    let bench = bench();
    let actual = kind(
        "gear of reported positions",
        "[[step]]\ngear = { y = { to = \"x\", ratio = 0.5, actual = true, smoothing = \"10ms\" } }\n[[step]]\nmove = { x = 12.0 }\n[[step]]\nmove = { x = 2.0 }\n",
        false,
        [12.0, 6.0, 0.0],
    );
    for kind in KINDS.iter().chain([&actual]) {
        let mut holds = 0;
        // Cycles of 1 ms without a hold.
        let free = with_inputs(&bench, kind.steps, WHOLE);
        let (options, recording) = recorded(virtual_time(), bench.path());
        run_well(free.clone(), options);
        let lasts = targets(&free, &recording)[0].len();
        for at in [800, 950, 1100] {
            if lasts < at + 50 {
                continue;
            }
            let inputs = format!(
                "{WHOLE}{{ at = \"{at}ms\", set = {{ held = true }} }},\n{{ at = \"{}ms\", set = {{ held = false }} }},\n",
                at + 4000
            );
            let machine = with_inputs(&bench, kind.steps, &inputs);
            let (options, recording) = recorded(virtual_time(), bench.path());
            run_well(machine.clone(), options);
            let targets = targets(&machine, &recording);
            let [x, y, z] = &targets;
            let all: Vec<_> = x
                .iter()
                .zip(y)
                .zip(z)
                .map(|((x, y), z)| [x, y, z])
                .collect();
            let rests = all.chunk_by(|a, b| a == b);
            let longest = rests.map(<[_]>::len).max().unwrap_or(0);
            assert!(longest > 3000, "{} at {at} ms: {longest} cycles", kind.name);
            let resting = all.chunk_by(|a, b| a == b).rfind(|rest| rest.len() > 3000);
            holds += usize::from(resting.is_some_and(|rest| rest.last() != all.last()));
        }
        assert!(holds > 0, "{}: no hold on the way", kind.name);
    }
}

/// A hold interrupts the search for home by the drive. The step begins it again afterwards.
#[test]
fn a_held_machine_does_not_search_home() {
    let bench = Bench::new();
    let text = "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[signals]\nheld = \"io.Input 1\"\n[override]\nhold = { held = true }\n\
        [sim]\ninputs = [\n{ at = \"0s\", set = { held = true } },\n{ at = \"2s\", set = { held = false } },\n\
        { at = \"2200ms\", set = { held = true } },\n{ at = \"4s\", set = { held = false } },\n]\n\
        [[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\nmode = \"csp\"\n\
        pdo.rx = [\"0x6040\", \"0x607A\", \"0x6060\"]\npdo.tx = [\"0x6041\", \"0x6064\", \"0x6061\", \"0x606C\", \"0x6077\"]\n\
        [device.axis]\nencoder = 2000\nlimits = { velocity = 20.0, acceleration = 500.0, following_error = 2.0 }\n\
        homing = { method = 23, search = 2.0, zero = 0.5, acceleration = 100.0 }\n\
        [device.sim]\ntrack = { home = [2.0, 9.0] }\n\
        [[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 1\n\
        [[step]]\nenable = true\n[[step]]\nhome = [\"x\"]\n";
    let machine = bench.machine(text);
    let (options, recording) = recorded(virtual_time(), bench.path());
    let summary = run_well(machine, options);
    assert!(summary.machine_seconds > 4.5, "{}", summary.machine_seconds);
    let images = process_images(&recording);
    let actual = images.iter().filter(|(_, data)| data.len() >= 6);
    let actual: Vec<_> = actual
        .map(|(_, data)| i32::from_le_bytes([data[2], data[3], data[4], data[5]]))
        .collect();
    // It rests twice: until the first search, and while this is interrupted.
    let rests = actual.chunk_by(|a, b| a.abs_diff(*b) <= 1);
    let rests = rests.filter(|rest| rest.len() > 1500).count();
    assert!(rests >= 2, "{rests}");
}

/// However short the hold is, the step `home` begins again.
#[test]
fn a_short_hold_does_not_end_a_step_that_homes() {
    let bench = Bench::new();
    for (hold_ms, cycle) in [(1, "1ms"), (4, "1ms"), (20, "1ms"), (50, "2ms")] {
        let end = 2_200 + hold_ms;
        let text = format!(
            "[bus]\nnic = \"sim\"\ncycle = \"{cycle}\"\n[signals]\nheld = \"io.Input 1\"\n[override]\nhold = {{ held = true }}\n\
             [sim]\ninputs = [\n{{ at = \"2200ms\", set = {{ held = true }} }},\n{{ at = \"{end}ms\", set = {{ held = false }} }},\n]\n\
             [[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\nmode = \"csp\"\n\
             pdo.rx = [\"0x6040\", \"0x607A\", \"0x6060\"]\npdo.tx = [\"0x6041\", \"0x6064\", \"0x6061\", \"0x606C\", \"0x6077\"]\n\
             [device.axis]\nencoder = 2000\nlimits = {{ velocity = 20.0, acceleration = 500.0, following_error = 2.0 }}\n\
             homing = {{ method = 23, search = 1.0, zero = 0.5, acceleration = 100.0 }}\n\
             [device.sim]\ntrack = {{ home = [8.0, 9.0] }}\n\
             [[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 1\n\
             [[step]]\nenable = true\n[[step]]\nhome = [\"x\"]\n"
        );
        let summary = run_well(bench.machine(&text), virtual_time());
        assert_eq!(summary.program_runs, 1, "{hold_ms} ms");
    }
}

/// A drive that changes its mode only without power has none while it goes into homing and back.
/// Whenever the hold comes, home is found after it.
#[test]
fn a_hold_during_a_change_of_mode_without_power_does_not_end_homing() {
    let bench = Bench::new();
    for at_ms in (300..=600).step_by(11) {
        for hold_ms in [1, 300] {
            let end = at_ms + hold_ms;
            let text = format!(
                "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[signals]\nheld = \"io.Input 1\"\n[override]\nhold = {{ held = true }}\n\
                 [sim]\ninputs = [\n{{ at = \"{at_ms}ms\", set = {{ held = true }} }},\n{{ at = \"{end}ms\", set = {{ held = false }} }},\n]\n\
                 [[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\nmode = \"csp\"\n\
                 pdo.rx = [\"0x6040\", \"0x607A\", \"0x6060\"]\npdo.tx = [\"0x6041\", \"0x6064\", \"0x6061\", \"0x606C\", \"0x6077\"]\n\
                 [device.axis]\nencoder = 2000\nmode_change = \"no-power\"\nlimits = {{ velocity = 20.0, acceleration = 500.0, following_error = 2.0 }}\n\
                 homing = {{ method = 37, search = 1.0, zero = 0.5, acceleration = 100.0 }}\n\
                 [device.sim]\nquirks = {{ mode_without_power = true }}\n\
                 [[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 1\n\
                 [[step]]\nenable = true\n[[step]]\nhome = [\"x\"]\n[[step]]\nmove = {{ x = 1.0 }}\n"
            );
            let summary = run_well(bench.machine(&text), virtual_time());
            assert_eq!(summary.program_runs, 1, "{hold_ms} ms at {at_ms} ms");
        }
    }
}

/// At 100 % from an input, the drives receive in each cycle what they receive from a machine without
/// `[override]`.
#[test]
fn full_override_changes_nothing() {
    let bench = bench();
    for kind in KINDS {
        let mut seen = Vec::new();
        for table in [true, false] {
            let mut machine = machine(&bench, kind.steps, None);
            if !table {
                machine.overrides = ecaxis_master::config::OverrideConfig::default();
            }
            let (options, recording) = recorded(virtual_time(), bench.path());
            run_well(machine.clone(), options);
            seen.push(targets(&machine, &recording));
        }
        assert!(seen[0] == seen[1], "{}", kind.name);
    }
}

/// The step `override` at half speed: a move takes about twice as long; the group's factor
/// multiplies.
#[test]
fn step_sets_the_override_of_machine_and_group() {
    let bench = bench();
    let step = "[[step]]\nmove = { x = 40.0 }\n";
    let seconds = |first: &str| {
        let text = format!("[[stop.group]]\nname = \"left\"\naxes = [\"x\"]\n{first}{step}");
        run_well(machine(&bench, &text, None), virtual_time()).machine_seconds
    };
    let whole = seconds("");
    let half = seconds("[[step]]\noverride = 50\n");
    let quarter = seconds("[[step]]\noverride = { machine = 50, left = 50 }\n");
    let faster = seconds("[[step]]\noverride = 120\n");
    // 40 turns at 20 turns/s.
    assert!((half - whole - 2.0).abs() < 0.2, "{whole} {half}");
    assert!((quarter - whole - 6.0).abs() < 0.3, "{whole} {quarter}");
    assert!((faster - whole).abs() < 0.01, "the limit of the axis holds");
    for (steps, parts) in [
        ("[[step]]\noverride = 0\n", ["between 1 %", "120 %"]),
        ("[[step]]\noverride = 121\n", ["between 1 %", "120 %"]),
        (
            "[[step]]\noverride = { lift = 50 }\n",
            ["no group is named `lift`", "machine"],
        ),
    ] {
        let text = format!(
            "[bus]\ncycle = \"1ms\"\n[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 0\n{steps}"
        );
        assert_contains(&bench.parse(&text).expect_err(steps), &parts);
    }
    for (table, parts) in [
        ("initial = 130", ["between 0 %", "120 %"]),
        ("input = \"io.Input 9\"\nfull = 5", ["Input 9", "io"]),
        ("input = \"io.Input 1\"", ["`full` is missing", "100 %"]),
        ("full = 5", ["no input is named", "input ="]),
        (
            "input = \"io.Input 1\"\nfull = 0",
            ["`zero` and `full`", "same"],
        ),
    ] {
        let text = format!(
            "[bus]\ncycle = \"1ms\"\n[override]\n{table}\n[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 0\n"
        );
        assert_contains(&bench.parse(&text).expect_err(table), &parts);
    }
}

/// A trip in a hold, and in a motion at 40 %: the others stop within their limits, as without an
/// override, and nothing moves later.
#[test]
fn trip_stops_the_others_in_a_hold_and_at_any_override() {
    let bench = bench();
    for pot in [0, 400, 1000] {
        let steps = "[[step]]\nmove = { x = 50.0, y = 50.0 }\n";
        let mut machine = machine(&bench, steps, None);
        machine.switched[0].value = 1000.0;
        let mut later = machine.switched[0].clone();
        (later.at_ns, later.value) = (1_600_000_000, f64::from(pot));
        let mut last = later.clone();
        (last.at_ns, last.value) = (3_000_000_000, 1000.0);
        machine.switched.extend([later, last]);
        let script =
            "[[fault]]\nkind = \"drive-fault\"\ncode = 0x8611\ndevice = 0\nat = \"2200ms\"\n";
        let (options, recording) = recorded(ecaxis_test_support::faults(script), bench.path());
        let (error, summary) = run_badly(machine.clone(), options);
        assert_contains(&error, &["`x`", "0x8611"]);
        let summary = summary.expect("a summary");
        assert!(
            summary
                .axes
                .iter()
                .all(|axis| axis.final_state != "Operation enabled")
        );
        let targets = targets(&machine, &recording);
        keeps_limits(&targets[1], true, "y");
        let end = &targets[1][targets[1].len() - 50..];
        assert!(
            end.iter().all(|target| *target == end[0]),
            "y stands before its power goes"
        );
    }
}
