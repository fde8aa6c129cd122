//! 0x607E inverts positions and velocities on the bus; 0x6076 has the drive's unit.

use super::*;
use crate::drive::Track;

const OBJECTS: [Extra; 4] = [
    (0x607e, 0, 8, "Polarity"),
    (0x60b8, 0, 16, "Touch probe function"),
    (0x60b9, 0, 16, "Touch probe status"),
    (0x60ba, 0, 32, "Touch probe 1 positive edge"),
];

fn turned(polarity: i64, mode: i64) -> Rig {
    let plant = PlantParams {
        initial_position: 100,
        track: Track {
            probes: [Some((1003, 1010)), None],
            ..Track::default()
        },
        ..PlantParams::default()
    };
    let mut rig = Rig::with(plant, &OBJECTS);
    rig.set(0x607e, 0, polarity);
    rig.set(0x6065, 0, 0xffff_ffff);
    rig.enable(mode);
    rig
}

#[test]
fn polarity_bit_7_inverts_positions() {
    for (polarity, sign) in [(0x00, 1), (0x40, 1), (0x80, -1), (0xc0, -1)] {
        for mode in [1, 8] {
            let mut rig = turned(polarity, mode);
            assert_eq!(rig.get(0x6064), sign * 100, "0x{polarity:02x}");
            rig.set(0x6081, 0, 1000);
            rig.set(0x60b8, 0, 0x0011);
            // In CSP the steps stay within the following error window.
            for target in [700, 1200, 1700, 2000].map(|at| sign * at) {
                rig.set(0x607a, 0, target);
                for word in [0x1f, 0x0f] {
                    rig.set(0x6040, 0, word);
                    rig.run_ms(3);
                }
                rig.run_ms(600);
                let off = rig.get(0x6064) - target;
                assert!(
                    off.abs() <= 1,
                    "0x{polarity:02x}, mode {mode}: off by {off}"
                );
            }
            assert!(
                (rig.drive.position_counts() - 2000).abs() <= 1,
                "0x{polarity:02x}"
            );
            assert!(
                (rig.get(0x6062) - sign * 2000).abs() <= 1,
                "0x{polarity:02x}"
            );
            assert_eq!(
                rig.get(0x60ba),
                sign * 1003,
                "0x{polarity:02x}, mode {mode}"
            );
        }
    }
}

#[test]
fn polarity_bit_6_inverts_velocities() {
    for (polarity, sign) in [(0x00, 1.0), (0x80, 1.0), (0x40, -1.0), (0xc0, -1.0)] {
        for mode in [3, 9] {
            let mut rig = turned(polarity, mode);
            rig.set(0x60ff, 0, 600);
            rig.run_ms(800);
            let shown = rig.get(0x606c);
            assert!(
                (shown - 600).abs() < 30,
                "0x{polarity:02x}, mode {mode}: {shown}"
            );
            let true_one = rig.drive.velocity_rev_s();
            assert!(
                (true_one - sign * 10.0).abs() < 0.5,
                "0x{polarity:02x}, mode {mode}: {true_one}"
            );
        }
    }
}

#[test]
fn software_limits_apply_to_user_positions() {
    for (polarity, sign) in [(0x00, 1), (0xc0, -1)] {
        let mut rig = turned(polarity, 1);
        rig.set(0x607d, 1, -500);
        rig.set(0x607d, 2, 1500);
        rig.set(0x6081, 0, 1000);
        rig.run_ms(10);
        for (target, end) in [(3000, 1500), (-3000, -500)] {
            rig.set(0x607a, 0, target);
            for word in [0x1f, 0x0f] {
                rig.set(0x6040, 0, word);
                rig.run_ms(3);
            }
            rig.run_ms(1000);
            assert!(
                (rig.get(0x6064) - end).abs() <= 1,
                "0x{polarity:02x}: {}",
                rig.get(0x6064)
            );
            assert!(
                (rig.drive.position_counts() - sign * end).abs() <= 1,
                "0x{polarity:02x}"
            );
        }
    }
}

#[test]
fn rated_torque_has_the_unit_of_the_drive() {
    let newton_metres = PlantParams::default().rated_torque();
    for (vendor, per_newton_metre) in [(Some(0xfb), 1e6), (Some(0xe0a), 1e3), (None, 1e6)] {
        let mut store = ObjectStore::default();
        if let Some(vendor) = vendor {
            let slot = store.ensure(0x1018, 1, "Vendor ID", 32, Access::default(), &[]);
            store.set(slot, vendor);
        }
        Drive::new(&mut store, PlantParams::default());
        let slot = store.slot(0x6076, 0).expect("the drive made it");
        let off = store.get(slot) as f64 - newton_metres * per_newton_metre;
        assert!(off.abs() <= 0.5, "{vendor:?}: {}", store.get(slot));
    }
}
