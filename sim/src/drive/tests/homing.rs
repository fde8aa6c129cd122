//! Homing: every method from every side, the Statusword during homing, and errors.

use super::*;
use crate::drive::{Track, input};

/// A track of 20 turns: mechanical ends behind the limit switches, home at 3000…3400, the index at
/// 700 and every 2000 counts from there.
const TRACK: Track = Track {
    negative_limit: Some(-20_000),
    positive_limit: Some(20_000),
    home: Some((3000, 3400)),
    probes: [None; 2],
    index: Some(700),
    ends: Some((-21_000, 21_000)),
    normally_closed: 0,
};

const THRESHOLD: Extra = (0x30b2, 0, 16, "Current threshold for homing mode");
const POSITION: Extra = (0x30b0, 0, 32, "Home position");
const DISTANCE: Extra = (0x30b1, 0, 32, "Home offset move distance");

/// Returns an enabled drive in homing mode at this count.
fn at(initial_position: i32, track: Track, method: i64) -> Rig {
    let mut rig = Rig::with(
        PlantParams {
            initial_position,
            track,
            ..PlantParams::default()
        },
        &[POSITION, DISTANCE, THRESHOLD],
    );
    rig.set(0x6098, 0, method);
    rig.set(0x6099, 1, 600);
    rig.set(0x6099, 2, 60);
    rig.set(0x609a, 0, 10_000);
    rig.set(0x30b2, 0, 1500);
    rig.enable(6);
    rig
}

/// Returns bits 13, 12 and 10.
fn bits(rig: &Rig) -> (bool, bool, bool) {
    let word = rig.word();
    (
        word & 1 << 13 != 0,
        word & 1 << 12 != 0,
        word & 1 << 10 != 0,
    )
}

const UNDER_WAY: (bool, bool, bool) = (false, false, false);
const NOT_STARTED: (bool, bool, bool) = (false, false, true);
const COMPLETED: (bool, bool, bool) = (false, true, true);
const FAILED_MOVING: (bool, bool, bool) = (true, false, false);
const FAILED: (bool, bool, bool) = (true, false, true);

/// Starts homing and runs it to the end, at most 20 seconds. Returns the sequence of bits.
fn run(rig: &mut Rig) -> Vec<(bool, bool, bool)> {
    let mut shown = vec![bits(rig)];
    rig.set(0x6040, 0, 0x1f);
    for _ in 0..20_000 {
        rig.cycle();
        if shown.last() != Some(&bits(rig)) {
            shown.push(bits(rig));
        }
        if bits(rig) == COMPLETED || bits(rig) == FAILED {
            break;
        }
    }
    shown
}

#[test]
fn homing_finds_home_by_every_method_from_every_side() {
    // Valid start positions by method, and the home position.
    let anywhere = [-19_500, 0, 2500, 3100, 3400, 3600, 19_500];
    let on_negative = [-20_500, -20_000, -19_900, 0, 19_000];
    let on_positive = [20_500, 20_000, 19_900, 0, -19_000];
    let rows: [(i64, &[i32], i64); 11] = [
        // The switch goes off at −19,999; the first index above it.
        (1, &on_negative, -19_300),
        (17, &on_negative, -19_999),
        (2, &on_positive, 18_700),
        (18, &on_positive, 19_999),
        // Home's negative edge left at 2999, the index below it.
        (7, &anywhere, 2700),
        (23, &anywhere, 2999),
        // Home's positive edge left at 3401, the index above it.
        (11, &anywhere, 4700),
        (27, &anywhere, 3401),
        (33, &[701, 1000, 2699, 2700], 700),
        (34, &[700, 701, 2500, 2699], 2700),
        (37, &[1234], 1234),
    ];
    for (method, starts, home) in rows {
        for &start in starts {
            let home = match (method, start) {
                // From an index pulse the axis moves to the next one.
                (33, 2700) => 700,
                _ => home,
            };
            let mut rig = at(start, TRACK, method);
            rig.set(0x30b0, 0, 50_000);
            let shown = run(&mut rig);
            let expected: &[_] = if method == 37 {
                &[NOT_STARTED, COMPLETED]
            } else {
                &[NOT_STARTED, UNDER_WAY, COMPLETED]
            };
            assert_eq!(shown, expected, "method {method} from {start}");
            rig.run_ms(200);
            // In the track's counts the axis stands at the switch or index. Switches are read once
            // per control cycle, in which a decelerating axis moves five counts.
            let off = rig.drive.plant.counts() - home;
            let bound = if method == 33 || method == 34 || home % 100 == 0 {
                1
            } else {
                5
            };
            assert!(off.abs() <= bound, "method {method} from {start}: {off}");
            let shown = rig.get(0x6064) - 50_000;
            assert!(shown.abs() <= 1, "method {method} from {start}: {shown}");
            assert_ne!(rig.word() & 1 << 15, 0, "referenced");
            assert_eq!(rig.drive.state(), State::OperationEnabled);
            assert_eq!(rig.emergencies(), []);
        }
    }
}

#[test]
fn homing_finds_obstacles_by_current() {
    let rows = [
        (-3, 19_000, 21_000),
        (-4, -19_000, -21_000),
        // The index on the way back.
        (-1, 19_000, 20_700),
        (-2, -19_000, -19_300),
    ];
    for (method, start, home) in rows {
        let track = Track {
            negative_limit: None,
            positive_limit: None,
            ..TRACK
        };
        let mut rig = at(start, track, method);
        assert_eq!(
            run(&mut rig),
            [NOT_STARTED, UNDER_WAY, COMPLETED],
            "method {method}"
        );
        rig.run_ms(200);
        let off = rig.drive.plant.counts() - home;
        assert!(off.abs() <= 2, "method {method}: {off}");
        let shown = rig.get(0x6064);
        assert!(shown.abs() <= 2, "method {method}: {shown}");
    }
}

#[test]
fn homing_offset_move_ends_at_the_home_position() {
    let mut rig = at(0, TRACK, 17);
    rig.set(0x30b1, 0, 5000);
    rig.set(0x30b0, 0, -123);
    assert_eq!(run(&mut rig), [NOT_STARTED, UNDER_WAY, COMPLETED]);
    rig.run_ms(200);
    assert!((rig.drive.plant.counts() - (5000 - 19_999)).abs() <= 2);
    assert!((rig.get(0x6064) + 123).abs() <= 1);
}

/// A drive without maxon's objects shows its home offset at home.
#[test]
fn home_offset_0x607c_is_the_position_at_home() {
    let mut rig = Rig::with(
        PlantParams {
            initial_position: 777,
            ..PlantParams::default()
        },
        &[(0x607c, 0, 32, "Home offset")],
    );
    rig.set(0x607c, 0, -5000);
    rig.set(0x6098, 0, 35);
    rig.enable(6);
    run(&mut rig);
    assert_eq!(rig.get(0x6064), -5000);
}

/// The braking distance exceeds the switch: 0.5 of a turn at 6000 counts/s and 33,333 counts/s²,
/// against 20 counts.
#[test]
fn homing_finds_a_switch_narrower_than_the_braking_distance() {
    let track = Track {
        home: Some((3000, 3020)),
        ..TRACK
    };
    for (method, start, home) in [
        (23, 0, 2999),
        (23, 6000, 2999),
        (27, 6000, 3021),
        (27, 0, 3021),
    ] {
        let mut rig = at(start, track, method);
        rig.set(0x6099, 1, 180);
        rig.set(0x609a, 0, 1000);
        rig.run_ms(5);
        assert_eq!(run(&mut rig), [NOT_STARTED, UNDER_WAY, COMPLETED]);
        rig.run_ms(200);
        let off = rig.drive.plant.counts() - home;
        // The axis leaves the switch faster than the search speed, because it still decelerates.
        assert!(off.abs() <= 4, "method {method} from {start}: {off}");
    }
}

#[test]
fn homing_fails_without_its_reference() {
    let nowhere = Track {
        home: None,
        ..TRACK
    };
    let no_index = Track {
        index: None,
        ..TRACK
    };
    let on_the_wrong_side = Track {
        negative_limit: None,
        ..TRACK
    };
    let rows = [
        // Limit switches at both ends, but no home switch.
        (7, nowhere, 0),
        (27, nowhere, 0),
        // Only the switch at the other end.
        (11, TRACK, 19_990),
        (33, no_index, 0),
        (1, no_index, 0),
        (34, no_index, 19_000),
        (5, TRACK, 0),
    ];
    for (method, track, start) in rows {
        let mut rig = at(start, track, method);
        if method == 11 {
            // The axis reverses once between the limit switches, and finds no home switch.
            rig = at(start, nowhere, method);
        }
        let shown = run(&mut rig);
        let expected: &[_] = match method {
            5 => &[NOT_STARTED, FAILED],
            _ => &[NOT_STARTED, UNDER_WAY, FAILED_MOVING, FAILED],
        };
        assert_eq!(shown, expected, "method {method}");
        assert_eq!(rig.drive.state(), State::OperationEnabled, "no fault");
        assert_eq!(rig.word() & 1 << 15, 0);
        rig.run_ms(100);
        assert_eq!(rig.drive.velocity_rev_s(), 0.0);
    }
    // Without the limit switch the axis hits the mechanical end: a following error.
    let mut rig = at(-19_000, on_the_wrong_side, 17);
    rig.set(0x6040, 0, 0x1f);
    rig.run_ms(3000);
    assert_eq!(rig.drive.state(), State::Fault);
    assert_eq!(rig.emergencies(), [0x8611]);
    assert_ne!(rig.word() & 1 << 13, 0);
}

/// A falling bit 4, a halt, a quick stop, another mode or another state interrupts homing. The
/// Statusword shows it.
#[test]
fn homing_shows_interruptions_in_the_statusword() {
    let searching = || {
        let mut rig = at(0, TRACK, 18);
        rig.set(0x6040, 0, 0x1f);
        rig.run_ms(500);
        assert_eq!(bits(&rig), UNDER_WAY);
        assert!(rig.drive.velocity_rev_s() > 9.0);
        rig
    };
    let stops = |rig: &mut Rig, shown| {
        rig.run_ms(200);
        assert_eq!(rig.drive.velocity_rev_s(), 0.0);
        assert_eq!(bits(rig), shown);
        let stood = rig.drive.position_counts();
        rig.run_ms(300);
        assert!((rig.drive.position_counts() - stood).abs() <= 1);
    };

    let mut rig = searching();
    rig.set(0x6040, 0, 0x0f);
    stops(&mut rig, NOT_STARTED);
    assert_eq!(run(&mut rig), [NOT_STARTED, UNDER_WAY, COMPLETED], "again");

    let mut rig = searching();
    rig.set(0x6040, 0, 0x11f);
    stops(&mut rig, NOT_STARTED);
    assert_eq!(
        run(&mut rig),
        [NOT_STARTED, UNDER_WAY, COMPLETED],
        "goes on"
    );

    let mut rig = searching();
    rig.set(0x6040, 0, 0x11f);
    stops(&mut rig, NOT_STARTED);
    rig.set(0x6040, 0, 0x0f);
    stops(&mut rig, NOT_STARTED);

    let mut rig = searching();
    rig.set(0x6040, 0, 0x0b);
    stops(&mut rig, NOT_STARTED);
    assert_eq!(rig.drive.state(), State::QuickStopActive);

    let mut rig = searching();
    rig.set(0x60ff, 0, 0);
    rig.set(0x6060, 0, 3);
    rig.run_ms(300);
    assert_eq!(rig.drive.velocity_rev_s(), 0.0);
    rig.set(0x6060, 0, 6);
    rig.run_ms(5);
    assert_eq!(bits(&rig), NOT_STARTED);

    let mut rig = searching();
    rig.drive.inject_fault(0x2310);
    rig.run_ms(300);
    assert_eq!(bits(&rig), FAILED, "homing ended in an error");
    for word in [0x00, 0x80, 0x06, 0x0f] {
        rig.set(0x6040, 0, word);
        rig.run_ms(10);
    }
    assert_eq!(bits(&rig), NOT_STARTED);
}

#[test]
fn homing_keeps_bit_12_until_the_next_start() {
    let mut rig = at(0, TRACK, 37);
    run(&mut rig);
    rig.set(0x6040, 0, 0x0f);
    rig.run_ms(10);
    assert_eq!(bits(&rig), COMPLETED);
    rig.set(0x6098, 0, 34);
    rig.run_ms(5);
    rig.set(0x6040, 0, 0x1f);
    rig.run_ms(3);
    assert_eq!(bits(&rig), UNDER_WAY);
    assert_eq!(rig.word() & 1 << 15, 0, "no longer referenced");
}

/// Between home found and home reached the standard sets bit 12 without bit 10. This drive sets bit
/// 12 only at the end position, for clients that read bit 12 alone.
#[test]
fn homing_reports_completion_at_the_end_position() {
    let mut rig = at(0, TRACK, 18);
    rig.set(0x30b1, 0, -10_000);
    rig.set(0x6040, 0, 0x1f);
    let mut worst = 0;
    for _ in 0..20_000 {
        rig.cycle();
        if rig.word() & 1 << 12 != 0 {
            worst = (rig.drive.plant.counts() - 9_999).abs();
            break;
        }
    }
    assert_ne!(rig.word() & 1 << 12, 0);
    assert!(worst <= 5, "{worst}");
}

#[test]
fn homing_uses_external_switches() {
    let mut rig = at(0, Track::default(), 23);
    rig.set(0x6040, 0, 0x1f);
    rig.run_ms(300);
    let before = rig.drive.position_counts();
    rig.drive.set_input(input::HOME, true, 0.0);
    rig.run_ms(200);
    assert!(rig.drive.velocity_rev_s() < 0.0, "leaves it");
    rig.drive.set_input(input::HOME, false, 0.0);
    let left = rig.drive.position_counts();
    rig.run_ms(300);
    assert_eq!(bits(&rig), COMPLETED);
    assert!(left > before && rig.get(0x6064).abs() <= 2);
}
