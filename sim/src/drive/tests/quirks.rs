//! Each quirk, next to the same drive without it.

use super::*;
use crate::Quirks;
use crate::drive::Track;

const EXTRAS: [Extra; 3] = [
    (0x607c, 0, 32, "Home offset"),
    (0x607e, 0, 8, "Polarity"),
    (0x60e0, 0, 16, "Positive torque limit value"),
];

/// Returns a drive with one quirk of the table, by its key.
fn with(key: &str, value: f64) -> Rig {
    on(key, value, PlantParams::default())
}

fn on(key: &str, value: f64, plant: PlantParams) -> Rig {
    let mut quirks = Quirks::default();
    let quirk = Quirks::TABLE.iter().find(|quirk| quirk.key == key);
    quirk
        .expect("an entry of the table")
        .set(&mut quirks, value);
    Rig::with(PlantParams { quirks, ..plant }, &EXTRAS)
}

fn without() -> Rig {
    Rig::with(PlantParams::default(), &EXTRAS)
}

const MS_NS: f64 = 1e6;

fn bit(rig: &Rig, n: u32) -> bool {
    rig.word() >> n & 1 != 0
}

/// Enables CSP and runs a ramp of set-points. Returns in how many of these cycles bit 12 was set.
fn bit12_on_the_way(rig: &mut Rig, cycles: i64) -> i64 {
    rig.enable(8);
    let start = rig.get(0x6064);
    (1..=cycles)
        .filter(|n| {
            rig.set(0x607a, 0, start + 5 * n);
            rig.cycle();
            bit(rig, 12)
        })
        .count() as i64
}

#[test]
fn bit_12_never_comes_in_cyclic_modes() {
    assert_eq!(bit12_on_the_way(&mut without(), 100), 100);
    let mut rig = with("bit12_never", 1.0);
    assert_eq!(bit12_on_the_way(&mut rig, 100), 0);
    // The bit of other modes stays.
    rig.set(0x6060, 0, 1);
    rig.set(0x6040, 0, 0x1f);
    rig.run_ms(5);
    assert!(bit(&rig, 12));
}

#[test]
fn bit_12_comes_late() {
    // `enable` has run for 10 ms since the drive changed to Operation enabled, at the latest.
    let mut rig = with("bit12_late", 50.0 * MS_NS);
    let seen = bit12_on_the_way(&mut rig, 100);
    assert!((50..=65).contains(&seen), "{seen}");
}

#[test]
fn bit_12_is_lost_at_rest() {
    for (mut rig, lost) in [
        (without(), false),
        (with("bit12_lost_at_rest", 20.0 * MS_NS), true),
    ] {
        // The rest before the axis is enabled does not count.
        rig.run_ms(100);
        assert_eq!(bit12_on_the_way(&mut rig, 100), 100);
        rig.run_ms(30);
        assert_eq!(bit(&rig, 12), !lost);
        // It returns with the next change.
        let target = rig.get(0x607a);
        rig.set(0x607a, 0, target + 1);
        rig.cycle();
        assert!(bit(&rig, 12));
    }
}

#[test]
fn an_earlier_homing_is_still_attained() {
    let track = Track {
        index: Some(1500),
        ..Track::default()
    };
    let plant = PlantParams {
        track,
        ..PlantParams::default()
    };
    for key in [None, Some("homed_before")] {
        let mut rig = match key {
            None => Rig::with(plant, &EXTRAS),
            Some(key) => on(key, 150.0 * MS_NS, plant),
        };
        rig.set(0x6098, 0, 34);
        rig.set(0x6099, 2, 60);
        rig.enable(6);
        assert_eq!(bit(&rig, 12), key.is_some());
        rig.set(0x6040, 0, 0x1f);
        rig.run_ms(140);
        assert_eq!(bit(&rig, 12), key.is_some());
        assert_eq!(bit(&rig, 10), key.is_some());
        rig.run_ms(30);
        assert!(!bit(&rig, 12) && !bit(&rig, 10));
        rig.run_ms(3000);
        assert!(bit(&rig, 12) && bit(&rig, 10));
    }
}

#[test]
fn statuswords_are_unlisted_or_zero_after_a_change() {
    for (key, word) in [("unlisted_statusword", 0x0256), ("zero_statusword", 0)] {
        let mut rig = with(key, 20.0 * MS_NS);
        rig.run_ms(10);
        for (controlword, listed) in [(0x06, 0x0221), (0x07, 0x0223)] {
            rig.set(0x6040, 0, controlword);
            rig.run_ms(15);
            assert_eq!(rig.word(), word, "{key}");
            rig.run_ms(10);
            assert_eq!(rig.word() & 0x026f, listed, "{key}");
        }
    }
}

#[test]
fn halt_is_ignored() {
    for (mut rig, stops) in [(without(), true), (with("halt_ignored", 1.0), false)] {
        rig.enable(3);
        rig.set(0x60ff, 0, 600);
        rig.run_ms(500);
        rig.set(0x6040, 0, 0x10f);
        rig.run_ms(500);
        assert_eq!(rig.drive.velocity_rev_s().abs() < 0.1, stops);
    }
}

#[test]
fn stops_of_the_controlword_are_ignored_or_remove_the_power() {
    use State::{OperationEnabled, QuickStopActive, ReadyToSwitchOn, SwitchOnDisabled};
    for (key, controlword, state) in [
        (None, 0x02, QuickStopActive),
        (Some("quick_stop_ignored"), 0x02, OperationEnabled),
        (Some("quick_stop_removes_power"), 0x02, SwitchOnDisabled),
        (Some("quick_stop_ignored"), 0x06, ReadyToSwitchOn),
        (None, 0x06, ReadyToSwitchOn),
        (Some("shutdown_ignored"), 0x06, OperationEnabled),
        (Some("shutdown_ignored"), 0x02, QuickStopActive),
        (Some("shutdown_ignored"), 0x00, SwitchOnDisabled),
    ] {
        let mut rig = key.map_or_else(without, |key| with(key, 1.0));
        rig.set(0x605a, 0, 6);
        rig.set(0x605b, 0, 0);
        rig.enable(8);
        rig.set(0x6040, 0, controlword);
        rig.run_ms(2);
        assert_eq!(rig.drive.state(), state, "{key:?}, 0x{controlword:02x}");
    }
}

#[test]
fn a_fault_reset_needs_time() {
    for (mut rig, ms) in [(without(), 1), (with("reset_held", 30.0 * MS_NS), 32)] {
        rig.enable(8);
        rig.drive.inject_fault(0x2310);
        rig.set(0x6040, 0, 0);
        rig.run_ms(20);
        assert_eq!(rig.drive.state(), State::Fault);
        rig.set(0x6040, 0, 0x80);
        let took = (1..100).find(|_| {
            rig.cycle();
            rig.drive.state() != State::Fault
        });
        let took = took.expect("a reset");
        assert!((ms - 1..=ms).contains(&took), "{took} ms");
    }
}

#[test]
fn the_mode_is_shown_late_or_only_when_enabled() {
    let mut rig = with("mode_shown_late", 20.0 * MS_NS);
    rig.enable(8);
    rig.set(0x6060, 0, 9);
    rig.run_ms(15);
    assert_eq!(rig.get(0x6061), 8);
    rig.run_ms(10);
    assert_eq!(rig.get(0x6061), 9);

    let mut rig = with("mode_shown_enabled", 1.0);
    rig.set(0x6060, 0, 8);
    rig.run_ms(20);
    assert_eq!(rig.get(0x6061), 0);
    rig.enable(8);
    rig.set(0x6040, 0, 0x06);
    rig.run_ms(20);
    assert_eq!(rig.get(0x6061), 0);
}

#[test]
fn the_mode_changes_only_without_power() {
    for (mut rig, changes) in [(without(), true), (with("mode_without_power", 1.0), false)] {
        rig.enable(8);
        rig.set(0x6060, 0, 9);
        rig.run_ms(10);
        assert_eq!(rig.get(0x6061) == 9, changes);
        rig.set(0x6040, 0, 0x00);
        rig.run_ms(10);
        assert_eq!(rig.get(0x6061), 9);
    }
}

#[test]
fn unsupported_modes_are_not_listed_and_not_taken() {
    assert_eq!(without().get(0x6502), 0x3a5);
    let mut rig = with("unsupported_modes", f64::from(1_u32 << 8 | 1 << 9));
    assert_eq!(rig.get(0x6502), 0x0a5);
    rig.enable(8);
    for mode in [9, 10] {
        rig.set(0x6060, 0, mode);
        rig.run_ms(10);
        assert_eq!(rig.get(0x6061), 8);
    }
    rig.set(0x6060, 0, 3);
    rig.run_ms(10);
    assert_eq!(rig.get(0x6061), 3);
}

#[test]
fn velocities_have_another_unit() {
    for mode in [3, 9] {
        let mut rig = with("velocity_factor", 0.1);
        rig.enable(mode);
        rig.set(0x60ff, 0, 6000);
        rig.run_ms(800);
        assert!((rig.drive.velocity_rev_s() - 10.0).abs() < 0.5);
        assert!((rig.get(0x606c) - 6000).abs() < 300, "{}", rig.get(0x606c));
    }
}

#[test]
fn positions_shift_once_after_the_axis_is_enabled() {
    let mut rig = with("shift_after_enable", 300.0);
    rig.enable(8);
    let before = rig.get(0x6064);
    rig.run_ms(40);
    // The drive takes the old target in the new frame: the shaft turns back by the shift.
    rig.run_ms(200);
    assert!((rig.get(0x6064) - before).abs() <= 1);
    assert!((rig.drive.plant.counts() + 300).abs() <= 1);
    rig.enable(8);
    rig.run_ms(200);
    assert!((rig.drive.plant.counts() + 300).abs() <= 1);
    // A drive that holds its place shows the shift.
    let mut rig = with("shift_after_enable", 300.0);
    rig.enable(3);
    rig.run_ms(40);
    assert_eq!(rig.get(0x6064), 300);
}

/// Homes by method 37 and returns 0x6064 after this time.
fn homed(rig: &mut Rig, ms: u64) -> i64 {
    rig.set(0x6098, 0, 37);
    rig.set(0x607c, 0, 1000);
    rig.enable(6);
    rig.set(0x6040, 0, 0x1f);
    rig.run_ms(ms);
    assert!(bit(rig, 12));
    rig.get(0x6064)
}

#[test]
fn positions_shift_after_each_homing() {
    assert_eq!(homed(&mut without(), 100), 1000);
    // Also if the mode changes in the meantime.
    let mut rig = with("shift_after_homing", -400.0);
    assert_eq!(homed(&mut rig, 20), 1000);
    rig.set(0x6060, 0, 3);
    rig.run_ms(40);
    assert_eq!(rig.get(0x6064), 600);
    let mut rig = with("shift_after_homing", -400.0);
    assert_eq!(homed(&mut rig, 20), 1000);
    rig.run_ms(40);
    assert_eq!(rig.get(0x6064), 600);
    assert_eq!(homed(&mut rig, 20), 1000);
    rig.run_ms(40);
    assert_eq!(rig.get(0x6064), 600);
}

#[test]
fn the_home_offset_has_the_opposite_sign() {
    let mut rig = with("home_offset_negated", 1.0);
    assert_eq!(homed(&mut rig, 100), -1000);
    assert_eq!(rig.get(0x607c), 1000);
}

#[test]
fn the_home_offset_is_not_kept() {
    let ignores = |rig: &Rig| rig.store.item(rig.slot(0x607c, 0)).unwrap().ignores_writes;
    assert!(!ignores(&without()));
    assert!(ignores(&with("home_offset_not_kept", 1.0)));
}

#[test]
fn a_bit_of_the_polarity_inverts_torques_too() {
    // Both turn positions and velocities; without the quirk a torque keeps its direction.
    for (bit, polarity, sign) in [
        (None, 0xe0, 1.0),
        (Some(5.0), 0xc0, 1.0),
        (Some(5.0), 0xe0, -1.0),
        (Some(6.0), 0xc0, -1.0),
    ] {
        let mut rig = bit.map_or_else(without, |bit| with("torque_polarity_bit", bit));
        rig.set(0x607e, 0, polarity);
        rig.enable(10);
        rig.set(0x6071, 0, 200);
        rig.run_ms(100);
        let speed = sign * rig.drive.velocity_rev_s();
        assert!(speed > 1.0, "{bit:?}, 0x{polarity:02x}: {speed}");
        assert!(rig.get(0x6077) > 100, "{bit:?}, 0x{polarity:02x}");
        // 0x60E0 limits torques that are positive on the bus.
        rig.set(0x60e0, 0, 100);
        rig.run_ms(20);
        assert!((rig.get(0x6077) - 100).abs() < 20, "{}", rig.get(0x6077));
    }
}

#[test]
fn inputs_are_zero_after_the_change_to_op() {
    let mut rig = with("zero_inputs", 5.0 * MS_NS);
    rig.run_ms(4);
    assert!(rig.drive.inputs_are_zero());
    rig.run_ms(4);
    assert!(!rig.drive.inputs_are_zero());
    assert!(!without().drive.inputs_are_zero());
}

/// 8,388,608 counts of the encoder are 10,000 units: a motion of 10,000 is a turn.
#[test]
fn the_ratio_of_0x6091_is_the_unit_of_positions() {
    let encoder = 8_388_608;
    let plant = PlantParams {
        counts_per_turn: 10_000,
        initial_position: 5000,
        track: Track {
            negative_limit: Some(-20_000),
            ..Track::default()
        },
        ..PlantParams::default()
    };
    let mut rig = on("gear_encoder", f64::from(encoder), plant);
    // At power-on the unit is a count of the encoder.
    assert_eq!(rig.get(0x6064), i64::from(encoder) / 2);
    rig.set(0x6091, 1, encoder.into());
    rig.set(0x6091, 2, 10_000);
    rig.run_ms(10);
    assert_eq!(rig.get(0x6064), 5000);
    rig.set(0x6065, 0, 0xffff_ffff);
    let turns =
        |rig: &Rig| rig.drive.plant.position() / f64::from(rig.drive.params.counts_per_turn);
    let before = turns(&rig);
    rig.enable(8);
    for n in 1..=1000 {
        rig.set(0x607a, 0, 5000 + 10 * n);
        rig.cycle();
    }
    rig.run_ms(100);
    assert!((rig.get(0x6064) - 15_000).abs() <= 2, "{}", rig.get(0x6064));
    assert!((turns(&rig) - before - 1.0).abs() < 1e-3);
    // A ratio of half the size: the same shaft, twice the units.
    rig.set(0x6040, 0, 0);
    rig.run_ms(50);
    rig.set(0x6091, 2, 20_000);
    rig.run_ms(10);
    assert!((rig.get(0x6064) - 30_000).abs() <= 4, "{}", rig.get(0x6064));
    assert!((turns(&rig) - before - 1.0).abs() < 1e-3);
    // The limit switch is at −2 turns.
    rig.drive.plant.position = -39_000.0;
    rig.run_ms(1);
    assert_eq!(rig.get(0x60fd) & 1, 0);
    rig.drive.plant.position = -41_000.0;
    rig.run_ms(1);
    assert_eq!(rig.get(0x60fd) & 1, 1);
    // A drive that has power keeps its unit.
    rig.drive.plant.position = 0.5;
    rig.run_ms(20);
    rig.enable(8);
    rig.set(0x6091, 2, 10_000);
    rig.run_ms(10);
    assert_eq!(rig.drive.params.counts_per_turn, 20_000);
}

/// A vertical axis with the brake of its drive: it falls only until the brake has closed.
#[test]
fn a_load_falls_without_power_unless_the_brake_is_closed() {
    let vertical = PlantParams::default();
    let fallen = |mut rig: Rig| {
        rig.enable(8);
        rig.run_ms(500);
        let at = rig.get(0x6064);
        rig.run_ms(50);
        assert!((rig.get(0x6064) - at).abs() <= 1, "held by torque");
        assert_eq!(rig.drive.state(), State::OperationEnabled);
        rig.set(0x6040, 0, 0);
        rig.run_ms(300);
        at - rig.get(0x6064)
    };
    // Without a brake the axis falls before it is enabled, too.
    assert!(fallen(on("load_torque", 0.05, vertical)) > 2000);
    let braked = |brake: f64| {
        let mut quirks = Quirks::default();
        for (key, value) in [("load_torque", 0.05), ("brake", brake * MS_NS)] {
            let quirk = Quirks::TABLE.iter().find(|quirk| quirk.key == key);
            quirk.unwrap().set(&mut quirks, value);
        }
        Rig::with(PlantParams { quirks, ..vertical }, &EXTRAS)
    };
    let mut rig = braked(50.0);
    rig.run_ms(100);
    assert_eq!(rig.get(0x6064), 0, "closed at power-on");
    let (soon, late) = (fallen(braked(0.0)), fallen(rig));
    assert!((0..=2).contains(&soon), "{soon}");
    assert!((3..1000).contains(&late), "{late}");
}

#[test]
fn an_output_opens_the_brake() {
    let mut quirks = Quirks::default();
    for (key, value) in [("load_torque", 0.05), ("brake_bit", 16.0)] {
        let quirk = Quirks::TABLE.iter().find(|quirk| quirk.key == key);
        quirk.unwrap().set(&mut quirks, value);
    }
    let plant = PlantParams {
        quirks,
        ..PlantParams::default()
    };
    let mut rig = Rig::with(plant, &EXTRAS);
    rig.enable(8);
    rig.set(0x6040, 0, 0);
    rig.run_ms(200);
    assert_eq!(rig.get(0x6064), 0);
    rig.set(0x60fe, 1, 1 << 16);
    rig.run_ms(200);
    assert!(rig.get(0x6064) < -100, "{}", rig.get(0x6064));
    rig.set(0x60fe, 1, 0);
    rig.run_ms(200);
    let at = rig.get(0x6064);
    rig.run_ms(100);
    assert_eq!(rig.get(0x6064), at);
}

#[test]
fn a_load_fault_adds_to_the_load() {
    let mut rig = with("load_torque", 0.05);
    rig.drive.set_load_torque(0.01);
    assert!((rig.drive.plant.load_torque - 0.06).abs() < 1e-12);
    rig.drive.set_load_torque(0.0);
    assert!((rig.drive.plant.load_torque - 0.05).abs() < 1e-12);
}
