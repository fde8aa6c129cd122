//! 0x60FD and 0x60FE, limit switches and software limits.

use super::*;
use crate::drive::Track;

fn on(track: Track) -> Rig {
    Rig::new(PlantParams {
        track,
        ..PlantParams::default()
    })
}

/// Limit switches at ±2000 counts, home between 500 and 600.
const TRACK: Track = Track {
    negative_limit: Some(-2000),
    positive_limit: Some(2000),
    home: Some((500, 600)),
    probes: [None; 2],
    index: Some(0),
    ends: None,
    normally_closed: 0,
};

fn inputs(rig: &Rig) -> i64 {
    rig.store.get(rig.slot(0x60fd, 0))
}

/// Runs CSV at this speed until a fault, at most two seconds.
fn run_into(rig: &mut Rig, rpm: i64) {
    rig.set(0x60ff, 0, rpm);
    for _ in 0..2000 {
        if rig.drive.state() == State::Fault {
            return;
        }
        rig.cycle();
    }
    panic!("no fault at {}", rig.get(0x6064));
}

#[test]
fn switches_follow_the_axis_position() {
    for (at, expected) in [
        (-2001, 0b001),
        (-2000, 0b001),
        (-1999, 0),
        (499, 0),
        (500, 0b100),
        (600, 0b100),
        (601, 0),
        (1999, 0),
        (2000, 0b010),
        (99_999, 0b010),
    ] {
        for normally_closed in [0, 0b111] {
            let rig = Rig::new(PlantParams {
                initial_position: at,
                track: Track {
                    normally_closed,
                    ..TRACK
                },
                ..PlantParams::default()
            });
            assert_eq!(inputs(&rig), expected ^ i64::from(normally_closed), "{at}");
        }
    }
}

#[test]
fn external_inputs_appear_in_the_next_control_cycle() {
    let mut rig = on(TRACK);
    for (bit, value) in [(16, 1 << 16), (31, 1 << 31), (2, 1 << 2), (24, 1 << 24)] {
        rig.drive.set_input(bit, true, 0.0);
        assert_eq!(inputs(&rig), 0);
        rig.cycle();
        assert_eq!(inputs(&rig), value);
        rig.drive.set_input(bit, false, 0.0);
        rig.cycle();
        assert_eq!(inputs(&rig), 0);
    }
    rig.drive.set_input(200, true, 0.0);
    rig.cycle();
    assert_eq!(inputs(&rig), 0);
}

#[test]
fn limit_switch_stops_a_moving_axis_with_its_fault() {
    for (rpm, code, bit) in [(-600, 0x8a80, 0b001), (600, 0x8a81, 0b010)] {
        let mut rig = on(TRACK);
        rig.enable(9);
        run_into(&mut rig, rpm);
        assert_eq!(rig.emergencies(), [code]);
        assert_eq!(rig.get(0x1001), 0x21);
        assert_eq!(inputs(&rig), bit);
        let at = rig.get(0x6064).abs();
        // From 20,000 counts/s the axis stops within 600 counts at 333,333 counts/s².
        assert!((2550..2700).contains(&at), "{at}");

        // A reset succeeds on the switch. The axis may move back, but not further.
        let reset = |rig: &mut Rig| {
            for word in [0x00, 0x80, 0x06, 0x0f] {
                rig.set(0x60ff, 0, 0);
                rig.set(0x6040, 0, word);
                rig.run_ms(10);
            }
            assert_eq!(rig.drive.state(), State::OperationEnabled);
        };
        reset(&mut rig);
        assert_ne!(rig.word() & 1 << 11, 0, "internal limit active");
        rig.emergencies();
        run_into(&mut rig, rpm / 10);
        assert_eq!(rig.emergencies(), [code]);
        reset(&mut rig);
        rig.set(0x60ff, 0, -rpm / 2);
        rig.run_ms(100);
        assert_eq!(rig.drive.state(), State::OperationEnabled);
        assert_eq!(inputs(&rig), 0);
        assert_eq!(rig.word() & 1 << 11, 0);
    }
}

#[test]
fn limit_switches_act_in_every_mode() {
    for mode in [1, 3, 8, 9, 10] {
        let mut rig = on(TRACK);
        rig.set(0x6081, 0, 600);
        rig.enable(mode);
        rig.set(0x607a, 0, 9000);
        rig.set(0x6040, 0, 0x1f);
        rig.set(0x60ff, 0, 600);
        rig.set(0x6071, 0, 60);
        let mut target = 0;
        for _ in 0..1500 {
            if mode == 8 {
                target += 10;
                rig.set(0x607a, 0, target);
            }
            rig.cycle();
        }
        assert_eq!(rig.drive.state(), State::Fault, "mode {mode}");
        assert_eq!(rig.emergencies(), [0x8a81], "mode {mode}");
    }
}

#[test]
fn maxon_objects_invert_and_disable_inputs() {
    let names = [
        (0x3141, 1, 16, "Digital inputs logic state"),
        (0x3141, 2, 16, "Digital inputs polarity"),
        (0x3142, 1, 8, "Digital input 1 configuration"),
        (0x3142, 2, 8, "Digital input 2 configuration"),
        (0x3142, 3, 8, "Digital input 3 configuration"),
    ];
    let mut rig = Rig::with(
        PlantParams {
            initial_position: 3000,
            track: Track {
                normally_closed: 0b010,
                ..TRACK
            },
            ..PlantParams::default()
        },
        &names,
    );
    // Input 1: home, 2: positive limit, 3: nothing.
    for (sub, function) in [(1, 2), (2, 1), (3, 255)] {
        rig.set(0x3142, sub, function);
    }
    let logic = |rig: &Rig| rig.store.get(rig.slot(0x3141, 1));
    rig.run_ms(5);
    assert_eq!(inputs(&rig), 0, "its contact is open");
    rig.set(0x3141, 2, 0b10);
    rig.run_ms(5);
    assert_eq!((inputs(&rig), logic(&rig)), (0b010, 0b10));
    rig.set(0x3142, 2, 255);
    rig.run_ms(5);
    assert_eq!(inputs(&rig), 0, "no input has this function");
}

#[test]
fn outputs_are_masked_by_0x60fe() {
    let mut rig = rig();
    rig.set(0x60fe, 1, 0x0005_0001);
    assert_eq!(
        rig.drive.outputs(&rig.store),
        0x0005_0001,
        "no mask, no limit"
    );
    let mut rig = Rig::with(
        PlantParams::default(),
        &[(0x60fe, 1, 32, "Outputs"), (0x60fe, 2, 32, "Mask")],
    );
    rig.set(0x60fe, 1, 0x0005_0001);
    assert_eq!(rig.drive.outputs(&rig.store), 0);
    rig.set(0x60fe, 2, 0x0004_0000);
    assert_eq!(rig.drive.outputs(&rig.store), 0x0004_0000);
}

#[test]
fn mechanical_ends_stop_the_axis() {
    let mut rig = on(Track {
        ends: Some((-100, 100)),
        ..Track::default()
    });
    rig.enable(10);
    for (torque, end) in [(200, 100), (-200, -100)] {
        rig.set(0x6071, 0, torque);
        rig.run_ms(200);
        assert_eq!(rig.get(0x6064), end);
        assert_eq!(rig.drive.velocity_rev_s(), 0.0);
    }
}

#[test]
fn warning_sets_bit_7_in_every_state() {
    let mut rig = rig();
    rig.run_ms(5);
    assert_eq!(rig.word() & 1 << 7, 0);
    rig.drive.set_warning(true);
    rig.run_ms(1);
    assert_ne!(rig.word() & 1 << 7, 0);
    rig.enable(9);
    assert_eq!(rig.word() & 0xef, 0xa7 | 1 << 5 & 0xef);
    rig.drive.set_warning(false);
    rig.run_ms(1);
    assert_eq!(rig.word() & 1 << 7, 0);
}
