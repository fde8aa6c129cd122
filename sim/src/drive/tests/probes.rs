//! Touch probes: 0x60B8 to 0x60BD.

use super::*;
use crate::drive::{Track, input};

const OBJECTS: [Extra; 9] = [
    (0x60b8, 0, 16, "Touch probe function"),
    (0x60b9, 0, 16, "Touch probe status"),
    (0x60ba, 0, 32, "Touch probe 1 positive edge"),
    (0x60bb, 0, 32, "Touch probe 1 negative edge"),
    (0x60bc, 0, 32, "Touch probe 2 positive edge"),
    (0x60bd, 0, 32, "Touch probe 2 negative edge"),
    (0x60d0, 1, 16, "Touch probe 1 source"),
    (0x60d0, 2, 16, "Touch probe 2 source"),
    (0x60d5, 0, 16, "Touch probe 1 positive edge counter"),
];

/// Probe 1 is on at 1003…1010, probe 2 at 1500…1507; the index is at 250.
fn probing() -> Rig {
    let mut rig = Rig::with(
        PlantParams {
            track: Track {
                probes: [Some((1003, 1010)), Some((1500, 1507))],
                index: Some(250),
                ..Track::default()
            },
            ..PlantParams::default()
        },
        &OBJECTS,
    );
    rig.set(0x6081, 0, 1500);
    rig.enable(1);
    rig
}

fn go(rig: &mut Rig, target: i64) {
    rig.set(0x607a, 0, target);
    for word in [0x1f, 0x0f] {
        rig.set(0x6040, 0, word);
        rig.run_ms(3);
    }
    rig.run_ms(1000);
    assert!((rig.get(0x6064) - target).abs() <= 1);
}

fn status(rig: &Rig) -> i64 {
    rig.store.get(rig.slot(0x60b9, 0))
}

fn latched(rig: &Rig) -> [i64; 4] {
    [0x60ba, 0x60bb, 0x60bc, 0x60bd].map(|index| rig.get(index))
}

#[test]
fn touch_probe_functions_latch_row_by_row() {
    // Function, then the four position objects and the status after a move to 2000 and back.
    let rows = [
        (0x0000, [0, 0, 0, 0], 0x0000),
        // Edges without the probe, the probe without edges.
        (0x3030, [0, 0, 0, 0], 0x0000),
        (0x0101, [0, 0, 0, 0], 0x0101),
        // The first edge of a kind stays.
        (0x0011, [1003, 0, 0, 0], 0x0003),
        (0x0021, [0, 1011, 0, 0], 0x0005),
        (0x0031, [1003, 1011, 0, 0], 0x0007),
        (0x3100, [0, 0, 1500, 1508], 0x0700),
        (0x3131, [1003, 1011, 1500, 1508], 0x0707),
        // Continuous: the last edge of the return move. Each value inverted its toggle bit, twice
        // in total.
        (0x0033, [1010, 1002, 0, 0], 0x0007),
        (0x3300, [0, 0, 1507, 1499], 0x0700),
        // Zero impulse: 250 on the way out. The return move does not store again.
        (0x0015, [250, 0, 0, 0], 0x0003),
        (0x0017, [250, 0, 0, 0], 0x0003),
        (0x0025, [0, 0, 0, 0], 0x0001),
        // 0x60D0: probe 1 uses input 2, probe 2 the zero impulse.
        (0x0019, [1500, 0, 0, 0], 0x0003),
        (0x1900, [0, 0, 250, 0], 0x0300),
        // Reserved source.
        (0x001d, [0, 0, 0, 0], 0x0000),
    ];
    for (function, positions, expected) in rows {
        let mut rig = probing();
        rig.set(0x60d0, 1, 2);
        rig.set(0x60d0, 2, 5);
        rig.set(0x60b8, 0, function);
        go(&mut rig, 2000);
        go(&mut rig, 0);
        assert_eq!(latched(&rig), positions, "0x{function:04x}");
        assert_eq!(status(&rig), expected, "0x{function:04x}");
    }
}

#[test]
fn touch_probe_toggles_and_counts_in_continuous_mode() {
    let mut rig = probing();
    rig.set(0x60b8, 0, 0x0013);
    for (n, target, position) in [(1, 2000, 1003), (2, 0, 1010), (3, 1200, 1003)] {
        go(&mut rig, target);
        assert_eq!(rig.get(0x60ba), position);
        assert_eq!(status(&rig), 0x03 | (n % 2) << 6);
        assert_eq!(rig.get(0x60d5), n);
    }
}

#[test]
fn touch_probe_stores_again_after_enabling_it_or_an_edge() {
    let mut rig = probing();
    rig.set(0x60b8, 0, 0x0011);
    go(&mut rig, 2000);
    assert_eq!(latched(&rig)[0], 1003);
    for (off, stored) in [(0x0000, 0), (0x0001, 0x03)] {
        rig.set(0x60b8, 0, off);
        rig.run_ms(2);
        assert_eq!(status(&rig), stored, "0x{off:04x}");
        rig.set(0x60b8, 0, 0x0011);
        rig.run_ms(2);
        assert_eq!(status(&rig), 0x01, "nothing stored");
        let (target, position) = if off == 0 { (0, 1010) } else { (2000, 1003) };
        go(&mut rig, target);
        assert_eq!((status(&rig), latched(&rig)[0]), (0x03, position));
    }
}

/// An external edge may come at any time in the control cycle. The latched position is that of the
/// edge.
#[test]
fn touch_probe_latches_external_edges_between_control_cycles() {
    for after in [0.0, 0.25, 0.5, 0.99] {
        let mut rig = probing();
        rig.set(0x6060, 0, 9);
        rig.set(0x60ff, 0, 3000);
        rig.run_ms(400);
        rig.set(0x60b8, 0, 0x0031);
        rig.run_ms(2);
        let before = rig.drive.position_counts();
        rig.drive.set_input(input::TOUCH_PROBE_1, true, after);
        rig.drive.control(&mut rig.store, true);
        // 100,000 counts/s: 40 counts in a control cycle.
        let expected = before + (40.0 * after) as i64;
        let off = rig.get(0x60ba) - expected;
        assert!(off.abs() <= 1, "{after}: off by {off}");
        assert_eq!(status(&rig), 0x03);

        // Two edges within one cycle store two positions.
        rig.set(0x60b8, 0, 0);
        rig.drive.set_input(input::TOUCH_PROBE_1, false, 0.0);
        rig.drive.control(&mut rig.store, true);
        rig.set(0x60b8, 0, 0x0031);
        rig.drive.control(&mut rig.store, true);
        rig.drive.set_input(input::TOUCH_PROBE_1, true, 0.25);
        rig.drive.set_input(input::TOUCH_PROBE_1, false, 0.75);
        rig.drive.control(&mut rig.store, true);
        assert_eq!(status(&rig), 0x07);
        let apart = rig.get(0x60bb) - rig.get(0x60ba);
        assert!((apart - 20).abs() <= 1, "{apart}");
    }
}

#[test]
fn touch_probe_2_needs_its_objects() {
    let mut rig = Rig::with(PlantParams::default(), &OBJECTS[..4]);
    rig.enable(1);
    rig.set(0x60b8, 0, 0x3131);
    rig.drive.set_input(input::TOUCH_PROBE_2, true, 0.0);
    rig.run_ms(3);
    assert_eq!(status(&rig), 0x01);
}
