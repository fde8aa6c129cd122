//! Option codes 0x605A–0x605E and 0x6007, code by code: the deceleration, and the final state.

use super::*;
use State as S;

/// Returns a drive at 3000 rpm in CSV. Slow-down ramp 5000 rpm/s, quick stop ramp 20,000 rpm/s: 600
/// ms and 150 ms.
fn turning(options: &[(u16, i64)]) -> Rig {
    let mut rig = Rig::with(
        PlantParams::default(),
        &[(0x605d, 0, 16, "Halt option code")],
    );
    for (index, value) in options {
        rig.set(*index, 0, *value);
    }
    rig.set(0x6083, 0, 20_000);
    rig.set(0x6084, 0, 5_000);
    rig.set(0x6085, 0, 20_000);
    rig.enable(9);
    rig.set(0x60ff, 0, 3000);
    rig.run_ms(300);
    assert!((rig.drive.velocity_rev_s() - 50.0).abs() < 0.5);
    rig
}

/// The deceleration of the axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    SlowDown,
    QuickStop,
    /// At the current limit: far steeper than either ramp.
    Limit,
    Coast,
}

/// Waits for standstill while the output stage is on. Returns the deceleration from its duration.
fn way(rig: &mut Rig) -> Way {
    let mut ms = 0;
    while rig.drive.velocity_rev_s().abs() > 0.2 && ms < 900 {
        if !rig.drive.power_on() {
            return Way::Coast;
        }
        rig.run_ms(1);
        ms += 1;
    }
    match ms {
        580..=640 => Way::SlowDown,
        140..=180 => Way::QuickStop,
        // 9.6 A at 37 mN·m/A decelerate 36 µkg·m² from 314 rad/s in 32 ms.
        25..=60 => Way::Limit,
        _ => panic!("{ms} ms"),
    }
}

#[test]
fn quick_stop_option_0x605a() {
    let rows = [
        (0, Way::Coast, S::SwitchOnDisabled),
        (1, Way::SlowDown, S::SwitchOnDisabled),
        (2, Way::QuickStop, S::SwitchOnDisabled),
        (3, Way::Limit, S::SwitchOnDisabled),
        (4, Way::Limit, S::SwitchOnDisabled),
        (5, Way::SlowDown, S::QuickStopActive),
        (6, Way::QuickStop, S::QuickStopActive),
        (7, Way::Limit, S::QuickStopActive),
        (8, Way::Limit, S::QuickStopActive),
    ];
    for (code, expected, end) in rows {
        let mut rig = turning(&[]);
        // Zero would count as "not set" at power-on.
        rig.set(0x605a, 0, code);
        rig.run_ms(5);
        assert_eq!(rig.step(0x0b), S::QuickStopActive, "option {code}");
        assert_eq!(rig.word() & 0x6f, 0x07, "option {code}");
        assert_eq!(way(&mut rig), expected, "option {code}");
        rig.run_ms(300);
        assert_eq!(rig.drive.state(), end, "option {code}");
        assert_eq!(rig.drive.power_on(), end == S::QuickStopActive);
        if end == S::QuickStopActive {
            let stood = rig.drive.position_counts();
            rig.drive.set_load_torque(0.03);
            rig.run_ms(300);
            let moved = (rig.drive.position_counts() - stood).abs();
            assert!(moved <= 2, "option {code} holds: {moved} counts");
            rig.set(0x60ff, 0, 0);
            rig.set(0x6040, 0, 0x0f);
            rig.run_ms(5);
            assert_eq!(rig.drive.state(), S::OperationEnabled, "transition 16");
        }
        assert_eq!(rig.emergencies(), [], "option {code}");
    }
}

#[test]
fn shutdown_option_0x605b_and_disable_option_0x605c() {
    let rows = [
        (0x605b, 0, 0x06, Way::Coast, S::ReadyToSwitchOn),
        (0x605b, 1, 0x06, Way::SlowDown, S::ReadyToSwitchOn),
        (0x605c, 0, 0x07, Way::Coast, S::SwitchedOn),
        (0x605c, 1, 0x07, Way::SlowDown, S::SwitchedOn),
    ];
    for (index, code, word, expected, end) in rows {
        let mut rig = turning(&[]);
        rig.set(index, 0, code);
        rig.run_ms(5);
        rig.set(0x6040, 0, word);
        rig.run_ms(1);
        let leaving = if expected == Way::Coast {
            end
        } else {
            S::OperationEnabled
        };
        assert_eq!(rig.drive.state(), leaving, "0x{index:04x} = {code}");
        assert_eq!(way(&mut rig), expected, "0x{index:04x} = {code}");
        rig.run_ms(300);
        assert_eq!(rig.drive.state(), end, "0x{index:04x} = {code}");
        assert!(!rig.drive.power_on());
    }
}

#[test]
fn halt_option_0x605d() {
    let rows = [
        (1, Way::SlowDown),
        (2, Way::QuickStop),
        (3, Way::Limit),
        (4, Way::Limit),
    ];
    for (code, expected) in rows {
        let mut rig = turning(&[(0x605d, code)]);
        rig.set(0x6040, 0, 0x010f);
        assert_eq!(way(&mut rig), expected, "option {code}");
        rig.run_ms(300);
        assert_eq!(rig.drive.state(), S::OperationEnabled, "option {code}");
        assert_eq!(rig.word() & 1 << 12, 0, "does not follow");
        let stood = rig.drive.position_counts();
        rig.run_ms(100);
        assert!((rig.drive.position_counts() - stood).abs() <= 1);
        rig.set(0x6040, 0, 0x000f);
        rig.run_ms(300);
        assert!((rig.drive.velocity_rev_s() - 50.0).abs() < 0.5, "goes on");
        assert_ne!(rig.word() & 1 << 12, 0);
    }
}

#[test]
fn fault_reaction_option_0x605e() {
    let rows = [
        (0, Way::Coast),
        (1, Way::SlowDown),
        (2, Way::QuickStop),
        (3, Way::Limit),
        (4, Way::Limit),
    ];
    for (code, expected) in rows {
        let mut rig = turning(&[]);
        rig.set(0x605e, 0, code);
        rig.run_ms(5);
        rig.drive.inject_fault(0x2310);
        rig.step(0x0f);
        assert_eq!(way(&mut rig), expected, "option {code}");
        rig.run_ms(300);
        assert_eq!(rig.drive.state(), S::Fault, "option {code}");
        assert!(!rig.drive.power_on());
        assert_eq!(rig.emergencies(), [0x2310]);
    }
}

#[test]
fn abort_connection_option_0x6007() {
    let errors = [
        (DeviceError::SyncLost, 0x8280),
        (DeviceError::RxPdoTimeout, 0x8250),
        (DeviceError::BusDown, 0x8180),
    ];
    for (error, emergency) in errors {
        // Fault signal: the reaction is that of 0x605E.
        let rows = [(1, Way::SlowDown), (2, Way::Coast), (3, Way::QuickStop)];
        for (code, expected) in rows {
            let mut rig = turning(&[(0x6007, code), (0x605e, 1)]);
            rig.drive.error(error);
            rig.step(0x0f);
            assert_eq!(way(&mut rig), expected, "{error:?}, option {code}");
            rig.run_ms(300);
            assert_eq!(rig.drive.state(), S::Fault, "{error:?}, option {code}");
            assert_eq!(rig.emergencies(), [emergency]);
        }
        let mut rig = turning(&[]);
        rig.set(0x6007, 0, 0);
        rig.run_ms(5);
        rig.drive.error(error);
        rig.run_ms(100);
        assert_eq!(rig.drive.state(), S::OperationEnabled, "no action");
        assert_eq!(rig.emergencies(), []);
    }
}

/// In states without power the option codes have no effect.
#[test]
fn option_codes_act_only_on_a_powered_axis() {
    for code in 0..=8 {
        for (words, word, end) in [
            (&[0x06][..], 0x02, S::SwitchOnDisabled),
            (&[0x06, 0x07], 0x02, S::SwitchOnDisabled),
            (&[0x06, 0x07], 0x06, S::ReadyToSwitchOn),
            (&[], 0x02, S::SwitchOnDisabled),
        ] {
            let mut rig = rig();
            for index in [0x605a, 0x605b, 0x605c] {
                rig.set(index, 0, code);
            }
            rig.run_ms(10);
            for word in words {
                rig.step(*word);
            }
            assert_eq!(rig.step(word), end, "option {code}, 0x{word:02x}");
        }
    }
}

/// A faster stop replaces an active one, never the reverse; the final state follows the same rule.
#[test]
fn faster_stops_replace_active_ones() {
    let ramp_first = [(0x605a, 5), (0x605c, 1), (0x605e, 2)];
    // A slow quick stop, then a fault: the fault's ramp, then Fault.
    let mut rig = turning(&ramp_first);
    rig.set(0x6040, 0, 0x0b);
    rig.run_ms(20);
    assert_eq!(rig.drive.state(), S::QuickStopActive);
    rig.drive.inject_fault(0x2310);
    rig.run_ms(1);
    assert_eq!(rig.drive.state(), S::FaultReactionActive);
    assert_eq!(way(&mut rig), Way::QuickStop);
    rig.run_ms(100);
    assert_eq!(rig.drive.state(), S::Fault);

    // Disable operation on its ramp, then quick stop.
    let mut rig = turning(&[(0x605a, 6), (0x605c, 1)]);
    rig.set(0x6040, 0, 0x07);
    rig.run_ms(20);
    assert_eq!(rig.drive.state(), S::OperationEnabled);
    rig.set(0x6040, 0, 0x03);
    rig.run_ms(1);
    assert_eq!(rig.drive.state(), S::QuickStopActive);
    assert_eq!(way(&mut rig), Way::QuickStop);

    // Disable voltage ends any stop at once.
    for word in [0x07, 0x0b] {
        let mut rig = turning(&ramp_first);
        rig.set(0x6040, 0, word);
        rig.run_ms(20);
        assert!(rig.drive.power_on());
        rig.set(0x6040, 0, 0x00);
        rig.run_ms(1);
        assert_eq!(rig.drive.state(), S::SwitchOnDisabled);
        assert_eq!(way(&mut rig), Way::Coast);
    }

    // Enabled again during the ramp: the axis continues from there.
    let mut rig = turning(&ramp_first);
    rig.set(0x6040, 0, 0x07);
    rig.run_ms(100);
    assert!(rig.drive.velocity_rev_s() < 45.0);
    rig.set(0x6040, 0, 0x0f);
    rig.run_ms(200);
    assert_eq!(rig.drive.state(), S::OperationEnabled);
    assert!((rig.drive.velocity_rev_s() - 50.0).abs() < 0.5);
}

/// 0x60C5 limits the profile's ramps.
#[test]
fn profiles_never_exceed_0x60c5() {
    for (limit, ms) in [(0xffff_ffff_i64, 300), (5_000, 600)] {
        let mut rig = rig();
        rig.set(0x60c5, 0, limit);
        rig.enable(3);
        for (target, rpm) in [(3000, 50.0), (0, 0.0)] {
            rig.set(0x60ff, 0, target);
            rig.run_ms(ms - 40);
            assert!((rig.drive.velocity_rev_s() - rpm).abs() > 2.0, "{limit}");
            rig.run_ms(100);
            assert!((rig.drive.velocity_rev_s() - rpm).abs() < 0.5, "{limit}");
        }
    }
}
