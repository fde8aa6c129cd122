//! Faults: their causes, the reaction of a moving axis, and the reset.

use super::*;

/// Returns a drive in CSV at this speed.
fn turning(rpm: i64) -> Rig {
    let mut rig = rig();
    rig.enable(9);
    rig.set(0x60ff, 0, rpm);
    rig.cycles(300);
    rig
}

/// Returns the milliseconds until the state, at most a second, and the largest speed step between
/// two cycles.
fn until(rig: &mut Rig, state: State) -> (u32, f64) {
    let (mut ms, mut jerk) = (0, 0.0_f64);
    while rig.drive.state() != state {
        assert!(ms < 1000, "still {:?}", rig.drive.state());
        let before = rig.drive.velocity_rev_s();
        rig.cycle();
        jerk = jerk.max((rig.drive.velocity_rev_s() - before).abs());
        ms += 1;
    }
    (ms, jerk)
}

#[test]
fn leaving_op_while_moving_decelerates_then_faults() {
    let mut rig = turning(3000);
    rig.in_op = false;
    rig.cycle();
    assert_eq!(rig.drive.state(), State::FaultReactionActive);
    assert_eq!(rig.word() & 0x4f, 0x0f);
    assert!(rig.drive.velocity_rev_s() > 45.0);
    let (ms, jerk) = until(&mut rig, State::Fault);
    // 10,000 rpm/s from 3000 rpm takes 300 ms.
    assert!((290..330).contains(&ms), "{ms}");
    assert!(jerk < 0.4, "{jerk}");
    assert!(rig.drive.velocity_rev_s().abs() < 0.1);
    assert!(!rig.drive.power_on());
    assert_eq!(rig.get(0x603f).to_le_bytes()[..2], [0x80, 0x81]);
    assert_eq!(rig.get(0x1001), 0x11);
    let emergency = rig.drive.take_emergency();
    assert_eq!(
        emergency,
        Some(Emergency {
            code: 0x8180,
            register: 0x11,
            data: [0; 5]
        })
    );
    // Back in Op the drive stays in Fault until a reset.
    rig.in_op = true;
    rig.cycles(20);
    assert_eq!(rig.drive.state(), State::Fault);
}

#[test]
fn leaving_op_while_not_enabled_raises_no_fault() {
    let mut rig = rig();
    rig.set(0x6040, 0, 0x06);
    rig.cycles(10);
    assert_eq!(rig.drive.state(), State::ReadyToSwitchOn);
    rig.in_op = false;
    rig.set(0x6040, 0, 0x0f);
    rig.cycles(10);
    assert_eq!(rig.drive.state(), State::SwitchOnDisabled);
    assert_eq!(rig.drive.take_emergency(), None);
}

#[test]
fn process_data_acts_only_in_op() {
    let mut rig = rig();
    rig.in_op = false;
    for word in [0x06, 0x07, 0x0f] {
        rig.set(0x6040, 0, word);
        rig.cycles(10);
        assert_eq!(rig.drive.state(), State::SwitchOnDisabled);
    }
    assert_eq!(rig.word() & 1 << 9, 0, "not remote");
    rig.set(0x6060, 0, 8);
    rig.cycle();
    assert_eq!(rig.get(0x6061), 8, "the mode is a parameter, too");
}

#[test]
fn abort_connection_option_chooses_the_reaction() {
    let mut rig = turning(1500);
    rig.set(0x6007, 0, 2);
    rig.cycles(5);
    rig.in_op = false;
    rig.cycles(2);
    assert_eq!(rig.drive.state(), State::Fault);
    assert!(rig.drive.velocity_rev_s() > 24.0, "coasting");

    let mut rig = turning(1500);
    rig.set(0x6007, 0, 0);
    rig.cycles(5);
    // The power-on value replaces zero only once, at power-on.
    rig.in_op = false;
    rig.cycles(50);
    assert_eq!(rig.drive.state(), State::OperationEnabled);
}

#[test]
fn blocked_shaft_raises_a_following_error() {
    let mut rig = rig();
    rig.enable(8);
    rig.drive.set_blocked(true);
    let start = rig.get(0x6064);
    let mut n = 0;
    while rig.drive.state() == State::OperationEnabled {
        n += 1;
        rig.set(0x607a, 0, start + 50 * n);
        rig.cycle();
        assert!(n < 100);
    }
    // The window is 2000 counts, without a time-out.
    assert!((40..44).contains(&n), "{n}");
    assert_ne!(rig.word() & 1 << 13, 0);
    rig.cycles(300);
    assert_eq!(rig.drive.state(), State::Fault);
    assert_eq!(rig.get(0x603f).to_le_bytes()[..2], [0x11, 0x86]);
    assert_eq!(rig.get(0x1001), 0x21);
    assert_eq!(rig.drive.take_emergency().map(|e| e.code), Some(0x8611));
    assert_eq!(rig.drive.take_emergency(), None);
}

#[test]
fn following_error_honours_time_out_and_disabled_window() {
    let mut rig = rig();
    rig.set(0x6066, 0, 50);
    rig.enable(8);
    rig.drive.set_blocked(true);
    rig.set(0x607a, 0, 3000);
    rig.cycles(50);
    assert_eq!(rig.drive.state(), State::OperationEnabled);
    assert_ne!(rig.word() & 1 << 13, 0);
    let (ms, _) = until(&mut rig, State::FaultReactionActive);
    assert!(ms < 20);

    let mut rig = self::rig();
    rig.set(0x6065, 0, 0xffff_ffff);
    rig.enable(8);
    rig.drive.set_blocked(true);
    rig.set(0x607a, 0, 1_000_000);
    rig.cycles(500);
    assert_eq!(rig.drive.state(), State::OperationEnabled);
}

#[test]
fn target_jump_raises_a_following_error() {
    let mut rig = rig();
    rig.enable(8);
    rig.set(0x607a, 0, 1_000_000);
    let (ms, _) = until(&mut rig, State::FaultReactionActive);
    assert!(ms < 30, "{ms}");
}

#[test]
fn reset_needs_an_edge() {
    let mut rig = turning(600);
    rig.set(0x6040, 0, 0x8f);
    rig.cycles(5);
    rig.drive.inject_fault(0x2310);
    until(&mut rig, State::Fault);
    rig.cycles(50);
    assert_eq!(rig.drive.state(), State::Fault, "the level does not reset");
    rig.set(0x6040, 0, 0x0f);
    rig.cycles(5);
    assert_eq!(rig.drive.state(), State::Fault);
    rig.set(0x6040, 0, 0x80);
    rig.cycles(2);
    assert_eq!(rig.drive.state(), State::SwitchOnDisabled);
    assert_eq!((rig.get(0x603f), rig.get(0x1001)), (0, 0));
    let mut sent = std::iter::from_fn(|| rig.drive.take_emergency()).map(|e| e.code);
    assert_eq!(sent.next(), Some(0x2310));
    assert_eq!(sent.next(), Some(0), "error reset");
    assert_eq!(sent.next(), None);
}

#[test]
fn reset_accepts_an_edge_shorter_than_a_control_cycle() {
    let mut rig = turning(0);
    rig.drive.inject_fault(0x2310);
    until(&mut rig, State::Fault);
    for word in [0x00, 0x80, 0x00] {
        rig.set(0x6040, 0, word);
        rig.drive.sync(&rig.store);
    }
    rig.cycle();
    assert_eq!(rig.drive.state(), State::SwitchOnDisabled);
}

#[test]
fn reset_is_refused_while_the_cause_persists() {
    let mut rig = turning(0);
    rig.drive.set_fault_cause(Some(0x4210));
    until(&mut rig, State::Fault);
    for word in [0x00, 0x80, 0x00] {
        rig.set(0x6040, 0, word);
        rig.cycles(3);
        assert_eq!(rig.drive.state(), State::Fault);
    }
    rig.drive.set_fault_cause(None);
    rig.set(0x6040, 0, 0x80);
    rig.cycles(3);
    assert_eq!(rig.drive.state(), State::SwitchOnDisabled);
}

#[test]
fn faults_stop_by_0x605e() {
    for (option, stops_in) in [(1, 600), (2, 150)] {
        let mut rig = rig();
        rig.set(0x605e, 0, option);
        rig.set(0x6084, 0, 2_500);
        rig.enable(9);
        rig.set(0x60ff, 0, 1500);
        rig.cycles(300);
        rig.drive.inject_fault(0x2310);
        let (ms, _) = until(&mut rig, State::Fault);
        assert!(ms.abs_diff(stops_in) < 20, "option {option}: {ms} ms");
    }
    let mut rig = turning(1500);
    rig.set(0x605e, 0, 0);
    rig.cycles(5);
    rig.drive.inject_fault(0x2310);
    rig.cycles(2);
    assert_eq!(rig.drive.state(), State::Fault, "coasts");
}

#[test]
fn quick_stop_ramps_down_and_can_be_left() {
    let mut rig = turning(3000);
    rig.set(0x6040, 0, 0x0b);
    rig.cycles(100);
    let speed = rig.drive.velocity_rev_s();
    assert!((speed - 33.3).abs() < 1.0, "{speed}");
    rig.cycles(300);
    assert_eq!(rig.drive.state(), State::QuickStopActive);
    assert_eq!(rig.drive.velocity_rev_s(), 0.0);
    rig.set(0x60ff, 0, 0);
    rig.set(0x6040, 0, 0x0f);
    rig.cycles(3);
    assert_eq!(rig.drive.state(), State::OperationEnabled);
}

#[test]
fn communication_errors_matter_to_an_enabled_axis_only() {
    for (error, code) in [
        (DeviceError::SyncLost, 0x8280),
        (DeviceError::RxPdoTimeout, 0x8250),
        (DeviceError::BusDown, 0x8180),
    ] {
        let mut idle = rig();
        idle.cycles(10);
        idle.drive.error(error);
        idle.cycles(2);
        assert_eq!(idle.drive.state(), State::SwitchOnDisabled);

        let mut rig = turning(600);
        rig.drive.error(error);
        rig.drive.error(error);
        until(&mut rig, State::Fault);
        assert_eq!(rig.drive.take_emergency().map(|e| e.code), Some(code));
        assert_eq!(rig.drive.take_emergency(), None);
    }
}

#[test]
fn software_limits_keep_csp_inside_and_trip_csv() {
    let mut rig = rig();
    rig.set(0x607d, 1, -1000);
    rig.set(0x607d, 2, 1000);
    rig.enable(8);
    for n in 0..150 {
        rig.set(0x607a, 0, 10 * n);
        rig.cycle();
    }
    rig.cycles(100);
    assert_eq!(rig.get(0x6064), 1000);
    assert_eq!(rig.word() & 0x1800, 0x0800, "limit active, not following");
    assert_eq!(rig.drive.state(), State::OperationEnabled);

    rig.set(0x6060, 0, 9);
    rig.set(0x60ff, 0, 100);
    until(&mut rig, State::Fault);
    assert_eq!(rig.drive.take_emergency().map(|e| e.code), Some(0x8a82));
}

#[test]
fn software_limits_of_the_esi_apply_if_the_axis_is_inside() {
    let limits = |initial_position, min: i32, max: i32| {
        let mut store = ObjectStore::default();
        for (sub, value) in [(1, min), (2, max)] {
            store.ensure(
                0x607d,
                sub,
                "Limit",
                32,
                Access::default(),
                &value.to_le_bytes(),
            );
        }
        let plant = PlantParams {
            initial_position,
            ..PlantParams::default()
        };
        let drive = Drive::new(&mut store, plant);
        drive.parameters.software_limits
    };
    assert_eq!(limits(0, -10, 10), Some((-10, 10)));
    assert_eq!(limits(10, -10, 10), Some((-10, 10)));
    let none = Some((i64::from(i32::MIN), i64::from(i32::MAX)));
    assert_eq!(limits(11, -10, 10), none);
    assert_eq!(limits(0, 5, 10), none);
    assert_eq!(limits(0, 0, 0), None);
}

#[test]
fn error_history_lists_the_newest_first() {
    let mut store = ObjectStore::default();
    for sub in 0..=5 {
        let bits = if sub == 0 { 8 } else { 32 };
        store.ensure(0x1003, sub, "Error history", bits, Access::default(), &[]);
    }
    let mut drive = Drive::new(&mut store, PlantParams::default());
    for code in [0x2310, 0x4210] {
        drive.inject_fault(code);
        drive.control(&mut store, false);
    }
    let value = |sub| store.get(store.slot(0x1003, sub).unwrap());
    assert_eq!(
        (value(0), value(1), value(2), value(3)),
        (2, 0x4210, 0x2310, 0)
    );
}
