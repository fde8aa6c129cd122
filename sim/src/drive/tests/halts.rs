//! Controlword bit 8 by mode, and Statusword bit 10 during a halt.

use super::*;

const HALT: i64 = 0x010f;
const GO: i64 = 0x000f;

#[test]
fn profile_position_continues_after_a_halt() {
    let mut rig = rig();
    rig.set(0x6084, 0, 5_000);
    rig.set(0x6081, 0, 3000);
    rig.enable(1);
    rig.set(0x607a, 0, 100_000);
    rig.set(0x6040, 0, 0x1f);
    rig.run_ms(350);
    rig.set(0x6040, 0, HALT);
    rig.run_ms(500);
    assert_eq!(rig.word() & 1 << 10, 0, "still turning");
    rig.run_ms(150);
    assert_ne!(rig.word() & 1 << 10, 0, "bit 10 says: speed is zero");
    let stood = rig.get(0x6064);
    assert!((40_000..90_000).contains(&stood), "{stood}");
    rig.set(0x6040, 0, GO);
    rig.run_ms(5);
    assert_eq!(rig.word() & 1 << 10, 0, "on its way again");
    rig.run_ms(2000);
    assert_eq!(rig.word() & 1 << 10, 1 << 10);
    assert!((rig.get(0x6064) - 100_000).abs() <= 1);
}

#[test]
fn set_point_during_a_halt_starts_after_it() {
    let mut rig = rig();
    rig.enable(1);
    rig.set(0x607a, 0, 1000);
    rig.set(0x6040, 0, HALT | 0x10);
    rig.run_ms(300);
    assert_eq!(rig.get(0x6064), 0);
    assert_ne!(rig.word() & 1 << 12, 0, "acknowledged");
    rig.set(0x6040, 0, GO);
    rig.run_ms(600);
    assert!((rig.get(0x6064) - 1000).abs() <= 1);
}

#[test]
fn profile_velocity_continues_after_a_halt() {
    let mut rig = rig();
    rig.enable(3);
    rig.set(0x60ff, 0, 1000);
    rig.run_ms(300);
    rig.set(0x6040, 0, HALT);
    rig.run_ms(300);
    assert_eq!(rig.drive.velocity_rev_s(), 0.0);
    assert_eq!(rig.word() & 0x1400, 0x1400, "stands; the halt is reached");
    rig.set(0x6040, 0, GO);
    rig.run_ms(20);
    assert_eq!(rig.word() & 0x1400, 0);
    rig.run_ms(300);
    assert!((rig.drive.velocity_rev_s() - 16.67).abs() < 0.2);
    assert_eq!(rig.word() & 0x1400, 0x0400, "the speed is reached");
}

/// CiA 402 leaves halt in cyclic modes open, and maxon's drives do not support it. A drive without
/// 0x605D continues.
#[test]
fn cyclic_modes_halt_only_where_there_is_0x605d() {
    let halt_option = (0x605d, 0, 16, "Halt option code");
    for (extras, halts) in [(&[][..], false), (&[halt_option], true)] {
        for mode in [8, 9, 10] {
            let mut rig = Rig::with(PlantParams::default(), extras);
            rig.enable(mode);
            let moving = |rig: &mut Rig, cycles: i64| {
                for _ in 0..cycles {
                    let next = rig.get(0x607a) + 5;
                    rig.set(0x607a, 0, next);
                    rig.cycle();
                }
            };
            rig.set(0x60ff, 0, 150);
            rig.set(0x6071, 0, 60);
            moving(&mut rig, 200);
            assert!(rig.drive.velocity_rev_s() > 1.0, "mode {mode}");
            rig.set(0x6040, 0, HALT);
            moving(&mut rig, 300);
            let stands = rig.drive.velocity_rev_s().abs() < 0.05;
            assert_eq!(stands, halts, "mode {mode}");
            assert_eq!(rig.word() & 1 << 12 == 0, halts, "mode {mode}");
            assert_eq!(rig.drive.state(), State::OperationEnabled);
        }
    }
}

#[test]
fn csp_follows_its_targets_again_after_a_halt() {
    let mut rig = Rig::with(
        PlantParams::default(),
        &[(0x605d, 0, 16, "Halt option code")],
    );
    rig.enable(8);
    for n in 0..600 {
        rig.set(0x607a, 0, 5 * n);
        let word = if (200..300).contains(&n) { HALT } else { GO };
        rig.set(0x6040, 0, word);
        rig.cycle();
    }
    rig.run_ms(200);
    assert_eq!(rig.drive.state(), State::OperationEnabled);
    assert!((rig.get(0x6064) - 5 * 599).abs() <= 1);
    assert_eq!(rig.emergencies(), []);
}
