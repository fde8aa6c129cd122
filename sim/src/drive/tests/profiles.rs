//! Profile position, profile velocity and homing.

use super::*;

/// Milliseconds until Statusword bit 10.
fn until_reached(rig: &mut Rig) -> u32 {
    let mut ms = 0;
    while rig.word() & 1 << 10 == 0 {
        rig.cycle();
        ms += 1;
        assert!(ms < 10_000);
    }
    ms
}

#[test]
fn pp_moves_on_the_edge_and_acknowledges() {
    let mut rig = rig();
    rig.set(0x6081, 0, 1500);
    rig.enable(1);
    assert_ne!(rig.word() & 1 << 10, 0);
    rig.set(0x607a, 0, 20_000);
    rig.cycles(20);
    assert_eq!(rig.get(0x6064), 0, "no edge, no move");
    rig.set(0x6040, 0, 0x1f);
    rig.cycles(2);
    assert_eq!(rig.word() & 0x1400, 0x1000, "acknowledged, on its way");
    rig.set(0x6040, 0, 0x0f);
    rig.cycles(2);
    assert_eq!(rig.word() & 0x1000, 0, "ready for the next");
    let ms = until_reached(&mut rig);
    // 10 turns at 25 rev/s and 166.7 rev/s².
    assert!((545..570).contains(&ms), "{ms}");
    rig.cycles(100);
    assert!((rig.get(0x6064) - 20_000).abs() <= 1);
}

#[test]
fn pp_buffers_one_set_point_or_changes_at_once() {
    let mut rig = rig();
    rig.enable(1);
    let command = |rig: &mut Rig, target, word| {
        rig.set(0x607a, 0, target);
        rig.set(0x6040, 0, word);
        rig.cycles(3);
        rig.set(0x6040, 0, 0x0f);
        rig.cycles(3);
    };
    command(&mut rig, 4000, 0x1f);
    command(&mut rig, 1000, 0x1f);
    assert_ne!(rig.word() & 0x1000, 0, "buffer full");
    let mut furthest = 0;
    for _ in 0..1500 {
        rig.cycle();
        furthest = furthest.max(rig.get(0x6064));
    }
    assert!((furthest - 4000).abs() <= 1, "{furthest}");
    assert!((rig.get(0x6064) - 1000).abs() <= 1);

    command(&mut rig, 10_000, 0x1f);
    command(&mut rig, 2000, 0x3f);
    furthest = 0;
    for _ in 0..1500 {
        rig.cycle();
        furthest = furthest.max(rig.get(0x6064));
    }
    assert!(furthest < 2500, "{furthest}");
    assert!((rig.get(0x6064) - 2000).abs() <= 1);

    command(&mut rig, -500, 0x5f);
    rig.cycles(800);
    assert!((rig.get(0x6064) - 1500).abs() <= 1, "relative");
}

#[test]
fn pp_halts_and_goes_on() {
    let mut rig = rig();
    rig.enable(1);
    rig.set(0x607a, 0, 20_000);
    rig.set(0x6040, 0, 0x1f);
    rig.cycles(200);
    rig.set(0x6040, 0, 0x10f);
    rig.cycles(300);
    let stood = rig.get(0x6064);
    assert!(stood > 1000 && stood < 19_000);
    assert_ne!(rig.word() & 1 << 10, 0, "speed is zero");
    rig.set(0x6040, 0, 0x0f);
    rig.cycles(2000);
    assert!((rig.get(0x6064) - 20_000).abs() <= 1);
}

#[test]
fn pv_ramps_to_its_speed() {
    let mut rig = rig();
    rig.enable(3);
    rig.cycles(5);
    assert_ne!(rig.word() & 1 << 12, 0, "speed is zero");
    rig.set(0x60ff, 0, 3000);
    rig.cycles(2);
    let ms = until_reached(&mut rig);
    assert!((295..340).contains(&ms), "{ms}");
    rig.cycles(100);
    assert!((rig.drive.velocity_rev_s() - 50.0).abs() < 0.5);
    assert_eq!(rig.word() & 1 << 12, 0);
}

#[test]
fn homing_here() {
    let mut rig = Rig::new(PlantParams {
        initial_position: 777,
        ..PlantParams::default()
    });
    rig.set(0x6098, 0, 37);
    rig.enable(6);
    assert_eq!(rig.get(0x6064), 777);
    rig.set(0x6040, 0, 0x1f);
    rig.cycles(3);
    assert_eq!(rig.get(0x6064), 0);
    assert_eq!(rig.word() & 0x3400, 0x1400, "attained");

    rig.set(0x6098, 0, 5);
    rig.set(0x6040, 0, 0x0f);
    rig.cycles(5);
    rig.set(0x6040, 0, 0x1f);
    rig.cycles(3);
    assert_ne!(rig.word() & 1 << 13, 0, "no such method");
}

#[test]
fn an_unsupported_mode_leaves_the_old_one() {
    let mut rig = rig();
    rig.enable(8);
    for code in [0, 2, -1, 11] {
        rig.set(0x6060, 0, code);
        rig.cycles(3);
        assert_eq!(rig.get(0x6061), 8, "{code}");
    }
    assert_eq!(rig.get(0x6502), 0x3a5);
}

#[test]
fn changing_the_mode_while_enabled_takes_over_where_the_axis_is() {
    let mut rig = rig();
    rig.enable(9);
    rig.set(0x60ff, 0, 300);
    rig.cycles(200);
    rig.set(0x60ff, 0, 0);
    rig.cycles(100);
    let here = rig.get(0x6064);
    rig.set(0x607a, 0, here);
    rig.set(0x6060, 0, 8);
    rig.cycles(100);
    assert_eq!(rig.get(0x6061), 8);
    assert!((rig.get(0x6064) - here).abs() <= 1);
    assert_eq!(rig.drive.state(), State::OperationEnabled);
}
