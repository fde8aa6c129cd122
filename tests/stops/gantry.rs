//! Gantries: set-points and positions of both halves in every cycle, as the recording has them.
//! Virtual time.
//!
//! `ECAXIS_GANTRY_SEEDS` sets the number of seeds (default 12).

use std::path::Path;

use ecaxis_test_support::random::Random;
use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::{
    assert_contains, faults, load, machine, recorded, run, run_badly, run_well, virtual_time,
};

/// An axis of the project's ESI has 12 bytes out and 13 bytes in, at the same place of the image.
const REGION: usize = 13;
const COUNTS: f64 = 2000.0;
const DT: f64 = 0.001;

/// One cycle of one half.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Seen {
    controlword: u16,
    target: i32,
    statusword: u16,
    actual: i32,
}

impl Seen {
    fn has_power(self) -> bool {
        self.statusword & 0x6f == 0x27 || self.statusword & 0x6f == 0x07
    }
}

fn halves(recording: &Path) -> Vec<[Seen; 2]> {
    let word = |data: &[u8]| u16::from_le_bytes([data[0], data[1]]);
    let position = |data: &[u8]| i32::from_le_bytes([data[2], data[3], data[4], data[5]]);
    let half = |out: &[u8], data: &[u8]| Seen {
        controlword: word(out),
        target: position(out),
        statusword: word(data),
        actual: position(data),
    };
    let images = process_images(recording).into_iter();
    let images = images.filter(|(out, data)| out.len().min(data.len()) >= 2 * REGION);
    images
        .map(|(out, data)| [0, REGION].map(|at| half(&out[at..], &data[at..])))
        .collect()
}

fn seeds() -> std::ops::RangeInclusive<u64> {
    let seeds = std::env::var("ECAXIS_GANTRY_SEEDS");
    1..=seeds.map_or(12, |n| n.parse().expect("a number"))
}

struct Limits {
    velocity: u64,
    acceleration: u64,
    jerk: &'static str,
    skew: f64,
}

const USUAL: Limits = Limits {
    velocity: 20,
    acceleration: 500,
    jerk: "jerk = 20000.0, ",
    skew: 0.9,
};

/// Returns a gantry with the given keys of each half.
fn gantry(limits: &Limits, keys: [&str; 2], steps: &str) -> String {
    let mut text = String::from("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n");
    let Limits {
        velocity,
        acceleration,
        jerk,
        skew,
    } = limits;
    for (position, (name, keys)) in ["x1", "x2"].into_iter().zip(keys).enumerate() {
        text += &format!(
            "[[device]]\nname = \"{name}\"\nesi = \"esi/EPOS4.xml\"\nposition = {position}\nmode = \"csp\"\n\
             [device.axis]\nencoder = 2000\nlimits = {{ position = [-100.0, 100.0], velocity = {velocity}.0, \
             acceleration = {acceleration}.0, {jerk}torque = 100.0, following_error = 2.0 }}\n{keys}\n",
        );
    }
    text += &format!("[[gantry]]\naxes = [\"x1\", \"x2\"]\nmax_skew = {skew}\n");
    text + steps
}

/// Process data that homing needs; each half has 13 bytes in as well.
const HOMING_PDOS: &str = "pdo.rx = [\"0x6040\", \"0x607A\", \"0x6060\"]\npdo.tx = [\"0x6041\", \"0x6064\", \"0x6061\", \"0x606C\", \"0x6077\"]\n";

const MOVES: &str = "[[step]]\nenable = [\"x1\"]\n[[step]]\nmove = { x1 = 15.0 }\n[[step]]\nvelocity = { x1 = -12.0 }\n\
    [[step]]\nwait = { x1.position = { below = 5.0 } }\n[[step]]\nstop = [\"x1\"]\n[[step]]\nmove = { x1 = 0.0 }\nspeed = 0.5\n";

/// Asserts equal set-points in all cycles in which both drives are enabled.
#[track_caller]
fn same_targets(seen: &[[Seen; 2]]) -> usize {
    let both = |s: &&[Seen; 2]| {
        s.iter()
            .all(|half| half.controlword & 0x0f == 0x0f && half.has_power())
    };
    let mut cycles = 0;
    for (cycle, [a, b]) in seen.iter().filter(both).enumerate() {
        assert_eq!(a.target, b.target, "cycle {cycle}: {a:?} {b:?}");
        cycles += 1;
    }
    cycles
}

#[test]
fn both_halves_receive_the_same_set_points() {
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(faults(""), folder.path());
    let summary = run_well(machine(&gantry(&USUAL, ["", ""], MOVES)), options);
    assert_eq!(summary.program_runs, 1);
    let seen = halves(&path);
    assert!(same_targets(&seen) > 2000);
    let farthest = seen.iter().map(|[_, b]| b.target).max();
    assert_eq!(farthest, Some(30_000), "the second half has moved");
}

/// The set-points wait for both halves if the frames of one are lost.
#[test]
fn lost_frames_do_not_part_the_halves() {
    for seed in seeds() {
        let folder = tempfile::tempdir().expect("a folder");
        let script = format!(
            "seed = {seed}\n[[fault]]\nkind = \"frame-loss\"\nat = \"700ms\"\nfor = \"2s\"\nprobability = 0.12\n\
             [[fault]]\nkind = \"frame-delay\"\nat = \"700ms\"\nfor = \"2s\"\nprobability = 0.05\ndelay = \"1500us\"\n"
        );
        let (options, path) = recorded(faults(&script), folder.path());
        let text = gantry(&USUAL, ["", ""], MOVES);
        let text = text.replacen(
            "cycle = \"1ms\"\n",
            "cycle = \"1ms\"\nlost_frames = 20\n",
            1,
        );
        let (outcome, _) = run(machine(&text), options);
        outcome.result.expect("the run survives");
        same_targets(&halves(&path));
    }
}

/// One half is blocked at a random moment of a random motion. The other half stops before the skew
/// exceeds its limit by more than the way of one cycle.
#[test]
fn a_blocked_half_never_skews_the_gantry_beyond_its_limit() {
    let mut worst = 0.0_f64;
    for seed in seeds() {
        let mut random = Random::new(seed);
        let limits = Limits {
            velocity: 8 + random.below(12),
            acceleration: 400 + random.below(300),
            jerk: ["jerk = 20000.0, ", "jerk = 60000.0, "]
                [usize::try_from(random.below(2)).expect("0 or 1")],
            skew: 0.9,
        };
        let half = random.below(2);
        let at = 650 + random.below(1200);
        let script = format!("[[fault]]\nkind = \"blocked\"\ndevice = {half}\nat = \"{at}ms\"\n");
        let folder = tempfile::tempdir().expect("a folder");
        let (options, path) = recorded(faults(&script), folder.path());
        let text = gantry(&limits, ["", ""], MOVES).replace("-12.0", "-4.0");
        let text = text.replace(
            "[[step]]\nstop",
            "[[step]]\ndwell = \"100ms\"\n[[step]]\nstop",
        );
        let verb = ["move = { x1 = 15.0", "line = { x1 = 15.0"]
            [usize::try_from(seed % 2).expect("0 or 1")];
        let text = text.replace("move = { x1 = 15.0", verb);
        let (outcome, _) = run(machine(&text), options);
        let what = format!(
            "seed {seed}: half {half} blocked at {at} ms, {} units/s",
            limits.velocity
        );
        let error = outcome.result.expect_err(&what).to_string();
        // Near the target, the set-point arrives before the skew reaches its limit.
        assert!(
            error.contains("skew") || error.contains("not reached"),
            "{error}"
        );
        assert_contains(&error, &[&format!("`x{}`", half + 1)]);
        let seen = halves(&path);
        let allowed = limits.skew + limits.velocity as f64 * DT;
        for (cycle, [a, b]) in seen.iter().enumerate() {
            let skew = f64::from(a.actual.abs_diff(b.actual)) / COUNTS;
            worst = worst.max(skew / allowed);
            assert!(skew <= allowed, "{what}: {skew} in cycle {cycle}");
        }
        let [.., before, last] = &seen[..] else {
            panic!("{what}: no cycles")
        };
        for (before, last) in before.iter().zip(last) {
            assert!(!last.has_power(), "{what}: {last:?}");
            assert!(before.actual.abs_diff(last.actual) <= 1, "{what}: moves");
        }
    }
    println!("largest skew: {:.1} % of its limit", worst * 100.0);
}

/// Hold at random, then an emergency stop: both halves get the same set-points and the same stop.
#[test]
fn holds_and_emergency_stops_do_not_part_the_halves() {
    for seed in seeds() {
        let mut random = Random::new(seed);
        let emergency = 1500 + random.below(1500);
        let mut inputs = String::new();
        let mut at = 650;
        while at < emergency {
            let held = random.below(2) == 0;
            inputs += &format!("{{ at = \"{at}ms\", set = {{ held = {held} }} }},\n");
            at += 30 + random.below(300);
        }
        inputs += &format!("{{ at = \"{emergency}ms\", set = {{ emergency = true }} }},\n");
        let head = format!(
            "[signals]\nheld = \"io.Input 1\"\nemergency = \"io.Input 2\"\n[override]\nhold = {{ held = true }}\n\
             [stop]\nemergency = {{ emergency = true }}\n[sim]\ninputs = [\n{inputs}]\n"
        );
        let io = "[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 2\n";
        let steps = MOVES.replace(
            "[[step]]\nmove = { x1 = 0.0",
            "[[step]]\nline = { x1 = 90.0 }\nspeed = 0.2\n[[step]]\nmove = { x1 = 0.0",
        );
        let text = gantry(&USUAL, ["", ""], &format!("{io}{steps}"));
        let folder = tempfile::tempdir().expect("a folder");
        let (options, path) = recorded(faults(""), folder.path());
        let (error, _) = run_badly(machine(&format!("{head}{text}")), options);
        assert_contains(&error, &["emergency"]);
        let seen = halves(&path);
        same_targets(&seen);
        for (cycle, [a, b]) in seen.iter().enumerate() {
            assert_eq!(a.controlword, b.controlword, "seed {seed}, cycle {cycle}");
            let skew = a.actual.abs_diff(b.actual);
            assert!(skew <= 4, "seed {seed}, cycle {cycle}: {skew} counts");
        }
    }
}

/// The other half stops by quick stop, as the drive with the fault does.
#[test]
fn a_fault_of_one_half_stops_the_other_one_alike() {
    for device in [0, 1] {
        let script = format!(
            "[[fault]]\nkind = \"drive-fault\"\ndevice = {device}\nat = \"900ms\"\ncode = 0x8611\n"
        );
        let folder = tempfile::tempdir().expect("a folder");
        let (options, path) = recorded(faults(&script), folder.path());
        let text = gantry(&USUAL, ["", ""], MOVES);
        let (error, _) = run_badly(machine(&text), options);
        assert_contains(&error, &["0x8611", &format!("`x{}`", device + 1)]);
        let seen = halves(&path);
        let other = 1 - device;
        let stop = seen
            .iter()
            .position(|s| s[other].controlword & 0x06 == 0x02);
        let stop = stop.expect("quick stop");
        assert!(seen[stop - 1][other].has_power());
        for [a, b] in &seen {
            let skew = f64::from(a.actual.abs_diff(b.actual)) / COUNTS;
            assert!(skew < 0.3, "{skew}");
        }
        let last = seen.last().expect("cycles");
        assert!(last.iter().all(|half| !half.has_power()), "{last:?}");
    }
}

/// The switch of the second half is farther away than that of the first.
#[test]
fn homing_squares_a_racked_gantry() {
    for racked in [0.01, 0.04, 0.7, -0.3] {
        let keys = |home: f64| {
            format!(
                "homing = {{ method = 23, search = 2.0, zero = 0.5 }}\n[device.sim]\ntrack = {{ home = [{home}, 9.0] }}\n"
            )
        };
        let keys = [keys(3.0), keys(3.0 + racked)];
        let steps =
            "[[step]]\nenable = true\n[[step]]\nhome = true\n[[step]]\nmove = { x1 = 5.0 }\n";
        let folder = tempfile::tempdir().expect("a folder");
        let (options, path) = recorded(faults(""), folder.path());
        let text = gantry(&USUAL, [&keys[0], &keys[1]], steps);
        let text = text.replace("[device.axis]", &format!("{HOMING_PDOS}[device.axis]"));
        run_well(machine(&text), options);
        let seen = halves(&path);
        let [a, b] = *seen.last().expect("cycles");
        assert!(a.actual.abs_diff(b.actual) <= 1, "{racked}: {a:?} {b:?}");
    }
}

/// Beyond the limit, homing stops both halves.
#[test]
fn homing_does_not_rack_the_gantry() {
    let keys = |home: f64| {
        format!(
            "homing = {{ method = 23, search = 2.0, zero = 0.5 }}\n[device.sim]\ntrack = {{ home = [{home}, 9.0] }}\n"
        )
    };
    let keys = [keys(3.0), keys(5.0)];
    let steps = "[[step]]\nenable = true\n[[step]]\nhome = [\"x1\"]\n";
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(faults(""), folder.path());
    let text = gantry(&USUAL, [&keys[0], &keys[1]], steps);
    let text = text.replace("[device.axis]", &format!("{HOMING_PDOS}[device.axis]"));
    let (error, _) = run_badly(machine(&text), options);
    assert_contains(&error, &["homing has moved the halves", "0.9000"]);
    let seen = halves(&path);
    let last = seen.last().expect("cycles");
    assert!(last.iter().all(|half| !half.has_power()), "{last:?}");
    // The first half stands at its switch, so the second one has not gone much farther.
    let way = f64::from(last[1].actual) / COUNTS;
    assert!((3.8..4.1).contains(&way), "{way}");
}

/// Homed halves out of square stay where they are while the machine is held, and are squared
/// afterwards. The program waits meanwhile.
#[test]
fn a_held_gantry_is_not_squared() {
    let head = "[signals]\nheld = \"io.Input 1\"\n[override]\nhold = { held = true }\n[sim]\ninputs = [\n\
        { at = \"0s\", set = { held = true } },\n{ at = \"12s\", set = { held = false } },\n]\n";
    let io = "[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 2\n";
    let half = |start: f64| {
        format!(
            "absolute = true\n[device.sim]\ntrack = {{ start = {start}, negative_limit = -90.0 }}\n"
        )
    };
    let steps = "[[step]]\nenable = true\n[[step]]\nmove = { x1 = 2.0 }\n";
    let text = gantry(&USUAL, [&half(1.0), &half(1.5)], &format!("{io}{steps}"));
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(faults(""), folder.path());
    let summary = run_well(machine(&format!("{head}{text}")), options);
    assert!(summary.machine_seconds > 12.0);
    let seen = halves(&path);
    let powered = |s: &&[Seen; 2]| {
        s.iter()
            .all(|half| half.controlword == 0x0f && half.has_power())
    };
    let targets: Vec<_> = seen
        .iter()
        .filter(powered)
        .map(|s| s.map(|half| half.target))
        .collect();
    assert!(
        targets[..10_000].iter().all(|both| *both == targets[0]),
        "moves while held"
    );
    assert_eq!(targets[0], [2000, 3000]);
    assert_eq!(targets.last(), Some(&[4000, 4000]));
}

/// A half that loses Statusword bit 12 trips, at rest as well, and the run fails. Both halves receive
/// the same stop.
#[test]
fn a_half_that_no_longer_follows_at_rest_stops_the_gantry() {
    for lost in [0, 1] {
        let mut keys = [String::new(), String::new()];
        keys[lost] = "[device.sim]\nquirks = { bit12_lost_at_rest = \"300ms\" }\n".to_owned();
        let steps =
            "[[step]]\nenable = true\n[[step]]\nmove = { x1 = 3.0 }\n[[step]]\ndwell = \"5s\"\n";
        let folder = tempfile::tempdir().expect("a folder");
        let (options, path) = recorded(faults(""), folder.path());
        let text = gantry(&USUAL, [&keys[0], &keys[1]], steps);
        let (error, _) = run_badly(machine(&text), options);
        assert_contains(&error, &[&format!("`x{}`", lost + 1)]);
        let seen = halves(&path);
        let last = seen.last().expect("cycles");
        assert!(last.iter().all(|half| !half.has_power()), "{last:?}");
        // Positions differ by less than the limit of the skew at all times.
        for [a, b] in &seen {
            assert!(a.actual.abs_diff(b.actual) < 100, "{a:?} {b:?}");
        }
    }
}

/// A few Statuswords of one half that CiA 402 does not list stop nothing. Words that remain stop both
/// halves alike.
#[test]
fn strange_statuswords_of_one_half_leave_both_alike() {
    /// Consecutive words without a reaction (`docs/stops.md`).
    const TOLERATED: u32 = 5;
    for (half, word, at) in [
        (0, "0x0056", 800),
        (1, "0x0056", 800),
        (0, "0x0000", 1021),
        (1, "0x0000", 1480),
    ] {
        for count in [1, TOLERATED, 300] {
            let what = format!("{count} words {word} of half {half} at {at} ms");
            let script = format!(
                "[[fault]]\nkind = \"statusword\"\ndevice = {half}\nvalue = {word}\ncount = {count}\n\
                 at = \"{at}ms\"\n"
            );
            let folder = tempfile::tempdir().expect("a folder");
            let (options, path) = recorded(faults(&script), folder.path());
            let (outcome, _) = run(machine(&gantry(&USUAL, ["", ""], MOVES)), options);
            let seen = halves(&path);
            let strange = |s: &&[Seen; 2]| matches!(s[half].statusword & 0x6f, 0x00 | 0x46);
            assert!(
                seen.iter().filter(strange).count() > 0,
                "{what}: in no cycle"
            );
            match outcome.result {
                Ok(()) => assert!(count <= TOLERATED, "{what}: no stop"),
                Err(error) => {
                    let error = error.to_string();
                    assert!(count > TOLERATED, "{what}: {error}");
                    assert_contains(&error, &[&format!("`x{}`", half + 1), word]);
                }
            }
            let mut before = seen[0];
            for (cycle, [a, b]) in seen.iter().enumerate() {
                let way = |half: usize| seen[cycle][half].actual.abs_diff(before[half].actual);
                // At rest, the stop of the half with strange words lasts longer.
                let moves = way(0).max(way(1)) > 1;
                assert!(
                    a.controlword == b.controlword || !moves,
                    "{what}, cycle {cycle}: {a:?} {b:?}"
                );
                before = seen[cycle];
                let skew = a.actual.abs_diff(b.actual);
                let strange = seen[cycle][half].statusword & 0x6f;
                assert!(
                    skew <= 4 || strange == 0,
                    "{what}, cycle {cycle}: {skew} counts"
                );
                if a.controlword == 0x000f {
                    assert_eq!(a.target, b.target, "{what}, cycle {cycle}");
                }
            }
        }
    }
}

#[test]
fn the_half_that_is_not_ready_is_named() {
    for late in [0, 1] {
        let mut keys = [String::new(), String::new()];
        keys[late] = "[device.sim]\nquirks = { bit12_never = true }\n".to_owned();
        let text = gantry(&USUAL, [&keys[0], &keys[1]], MOVES);
        let (error, _) = run_badly(machine(&text), virtual_time());
        let named = format!("`x{}`", late + 1);
        assert_contains(&error, &[&named, "bit 12 is not set"]);
    }
}

/// A half without frames holds its last target at once, so the other half waits as well: braking it
/// within its limits would skew the gantry.
#[test]
fn a_lost_half_makes_both_set_points_wait() {
    let folder = tempfile::tempdir().expect("a folder");
    let script = "[[fault]]\nkind = \"absent\"\ndevice = 1\nat = \"700ms\"\nfor = \"50ms\"\n";
    let (options, path) = recorded(faults(script), folder.path());
    let text = gantry(&USUAL, ["", ""], MOVES);
    let text = text.replacen("cycle = \"1ms\"\n", "cycle = \"1ms\"\nlost_frames = 6\n", 1);
    let (error, _) = run_badly(machine(&text), options);
    assert_contains(&error, &["`x2`", "no longer answers"]);
    let seen = halves(&path);
    same_targets(&seen);
    let powered = |[first, _]: &&[Seen; 2]| first.controlword & 0x0f == 0x0f;
    let targets: Vec<i32> = seen.iter().filter(powered).map(|[a, _]| a.target).collect();
    let last = targets[targets.len() - 1];
    let held = targets.iter().rev().take_while(|target| **target == last);
    let held = held.count();
    let moving = targets[targets.len() - 10].abs_diff(last);
    assert!(
        (3..=6).contains(&held) && moving > 20,
        "held {held}, before {moving}"
    );
}

/// Halves that were not homed keep their distance.
#[test]
fn decoupled_halves_move_alone_and_couple_where_they_are() {
    let steps = "[[step]]\nenable = true\n[[step]]\ndecouple = [\"x1\"]\n[[step]]\nmove = { x2 = 2.0 }\n\
        [[step]]\nmove = { x1 = 1.0 }\n[[step]]\ncouple = [\"x1\"]\n[[step]]\nmove = { x1 = 5.0 }\n";
    let summary = run_well(machine(&gantry(&USUAL, ["", ""], steps)), faults(""));
    let ends: Vec<_> = summary
        .axes
        .iter()
        .map(|axis| axis.target_position)
        .collect();
    assert_eq!(ends, [5.0, 6.0]);
    // A coupled second half does not move alone.
    let steps = steps.replace("move = { x1 = 5.0 }", "move = { x2 = 5.0 }");
    let (error, _) = run_badly(machine(&gantry(&USUAL, ["", ""], &steps)), faults(""));
    assert_contains(&error, &["step 6", "`x2`", "second half of a gantry"]);
    // Nor does it couple in motion.
    let steps = "[[step]]\nenable = true\n[[step]]\ndecouple = [\"x1\"]\n[[step]]\nvelocity = { x2 = 2.0 }\n\
        [[step]]\ncouple = true\n";
    let (error, _) = run_badly(machine(&gantry(&USUAL, ["", ""], steps)), faults(""));
    assert_contains(&error, &["step 4", "still moves"]);
}

#[test]
fn the_sample_homes_squares_and_moves_its_gantry() {
    let summary = run_well(load("gantry.toml"), virtual_time());
    assert_eq!(summary.program_runs, 1);
    let [x1, x2, _] = &summary.axes[..] else {
        panic!("three axes")
    };
    assert_eq!(x1.target_position, 10.0);
    assert_eq!(x1.final_position, x2.final_position);
}
