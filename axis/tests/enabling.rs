//! Switching power on and off: no step when the axis is enabled, and no power without a request.

use crate::common;
use crate::common::{DEAD_TIME_S, Drive, LIMITS, Rig, axis, scale};
use ecaxis_axis::{
    Axis, AxisConfig, Command, CommandError, ConfigError, Inputs, Limits, Mode, PowerLossCause,
    State, Trip,
};

#[test]
fn nothing_happens_without_a_command() {
    for mode in [Mode::Csp, Mode::Csv, Mode::Cst] {
        let mut rig = Rig::of(mode);
        let status = rig.run(1000);
        assert_eq!(status.state, State::SwitchOnDisabled);
        assert_eq!(rig.out.controlword, 0);
        assert!(!status.enabled && !status.moving);
        assert!((status.time_in_state_s - 0.998).abs() < 0.003);
    }
}

#[test]
fn targets_follow_actual_values_until_enabled() {
    let free = Limits {
        position: None,
        ..LIMITS
    };
    for start in [0, 123_456, i32::MAX - 3, i32::MIN] {
        let config = AxisConfig {
            dead_time_s: DEAD_TIME_S,
            ..AxisConfig::new(Mode::Csp, scale(), free)
        };
        let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(start));
        rig.axis.command(Command::Enable).unwrap();
        // An external force turns the shaft.
        rig.drive.velocity = 40_000.0;
        loop {
            let reported = rig.drive.raw_position();
            if rig.cycle().enabled {
                break;
            }
            assert_eq!(rig.out.target_position, reported);
        }
        // The set-point takes the speed over and decelerates it within the limit of 0.8 counts per
        // cycle.
        let (mut sent, mut step) = (rig.out.target_position, None);
        for _ in 0..400 {
            rig.cycle();
            let next = rig.out.target_position.wrapping_sub(sent);
            let most = step.unwrap_or(next.abs());
            assert!(
                (most - 2..=most.max(1)).contains(&next.abs()),
                "{most} {next}"
            );
            (sent, step) = (rig.out.target_position, Some(next.abs()));
        }
        assert_eq!(step, Some(0));
    }
}

/// Its drive would brake it with a step of the target.
#[test]
fn an_axis_that_coasts_is_not_enabled() {
    for mode in [Mode::Csp, Mode::Csv, Mode::Cst, Mode::Pp, Mode::Pv] {
        let mut rig = Rig::of(mode);
        rig.drive.velocity = 40_000.0;
        rig.cycle();
        assert!(matches!(
            rig.axis.command(Command::Enable),
            Err(CommandError::StillMoving { velocity }) if velocity > 90.0
        ));
        rig.run(100);
        rig.axis.command(Command::Enable).unwrap();
        rig.until(|s| s.ready, 100);
    }
}

#[test]
fn disable_decelerates_first() {
    let mut rig = Rig::enabled(Mode::Csp);
    let go = Command::MoveTo {
        position: 50.0,
        speed: 1.0,
        ramp: 1.0,
    };
    rig.axis.command(go).unwrap();
    rig.run(200);
    rig.axis.command(Command::Disable).unwrap();
    assert_eq!(rig.axis.command(go), Err(CommandError::Stopping));
    let mut braking = 0;
    while rig.cycle().enabled {
        braking += 1;
    }
    assert!(
        (200..210).contains(&braking),
        "200 mm/s at 2000 mm/s², and 0.1 s at rest: {braking}"
    );
    let status = rig.until(|s| s.state == State::SwitchOnDisabled, 10);
    assert_eq!((status.trip, status.fault), (None, None));
    // Enable again.
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 20);
}

#[test]
fn enable_is_rejected_while_power_is_removed() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis.command(Command::Disable).unwrap();
    rig.cycle();
    assert_eq!(
        rig.axis.command(Command::Enable),
        Err(CommandError::Stopping)
    );
    let status = rig.until(|s| s.state == State::SwitchOnDisabled, 120);
    assert_eq!(status.trip, None);
}

#[test]
fn quick_stop_holds_then_enables_again() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis
        .command(Command::MoveTo {
            position: 50.0,
            speed: 1.0,
            ramp: 1.0,
        })
        .unwrap();
    rig.run(200);
    rig.axis.command(Command::QuickStop).unwrap();
    rig.cycle();
    assert_eq!(rig.out.controlword, 0x0002);
    rig.until(|s| s.state == State::QuickStopActive, 5);
    assert!(matches!(
        rig.axis.command(Command::Enable),
        Err(CommandError::StillMoving { .. })
    ));
    let status = rig.run(500);
    assert_eq!(status.state, State::QuickStopActive);
    assert_eq!(status.trip, None);
    rig.axis.command(Command::Enable).unwrap();
    rig.cycle();
    assert_eq!(rig.out.controlword, 0x000F);
    rig.until(|s| s.ready, 10);
}

#[test]
fn quick_stop_may_end_disabled() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.drive.quick_stop_stays = false;
    rig.axis.command(Command::QuickStop).unwrap();
    rig.until(|s| s.state == State::SwitchOnDisabled, 10);
    assert_eq!(rig.run(10).state, State::SwitchOnDisabled);
    assert_eq!(rig.out.controlword, 0);
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 20);
}

#[test]
fn a_fault_disables_until_reset_and_enabled() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis
        .command(Command::MoveTo {
            position: 50.0,
            speed: 1.0,
            ramp: 1.0,
        })
        .unwrap();
    rig.run(200);
    rig.drive.fault();
    let status = rig.until(|s| s.state == State::Fault, 5);
    rig.axis.note_error_code(0x8611);
    rig.axis.note_error_code(0x1000);
    let fault = rig.axis.status().fault.unwrap();
    assert_eq!(fault.code, Some(0x8611));
    assert!(fault.to_string().contains("following error"));
    assert_eq!(status.trip, None, "a drive fault is not a trip");
    // Enable alone does not reset the fault.
    assert!(matches!(
        rig.axis.command(Command::Enable),
        Err(CommandError::Faulted(_))
    ));
    rig.run(300);
    assert_eq!((rig.drive.state, rig.drive.resets), (State::Fault, 0));
    // Reset alone does not enable.
    rig.axis.command(Command::ResetFault).unwrap();
    let status = rig.run(300);
    assert_eq!(
        (status.state, rig.drive.resets),
        (State::SwitchOnDisabled, 1)
    );
    assert_eq!((status.fault, status.resetting), (None, false));
    rig.axis.command(Command::Enable).unwrap();
    let status = rig.until(|s| s.ready, 20);
    assert!(!status.moving, "the old move is gone");
}

#[test]
fn reset_and_enable_work_in_the_same_cycle() {
    let mut rig = Rig::of(Mode::Csv);
    rig.drive.state = State::Fault;
    rig.run(5);
    rig.axis.command(Command::ResetFault).unwrap();
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 200);
}

#[test]
fn permanent_fault_reports_a_failed_reset() {
    let mut rig = Rig::of(Mode::Csp);
    rig.drive.state = State::Fault;
    rig.drive.stubborn = true;
    rig.run(5);
    rig.axis.command(Command::ResetFault).unwrap();
    rig.axis.command(Command::Enable).unwrap();
    let status = rig.until(|s| s.reset_failed, 1000);
    assert_eq!(rig.drive.resets, 3);
    assert!(!status.resetting && status.fault.is_some());
    rig.run(1000);
    assert_eq!(rig.drive.resets, 3);
    // A second attempt is possible.
    rig.drive.stubborn = false;
    rig.axis.command(Command::ResetFault).unwrap();
    rig.until(|s| s.state == State::SwitchOnDisabled, 200);
}

#[test]
fn power_loss_without_request_trips() {
    for state in [
        State::SwitchOnDisabled,
        State::SwitchedOn,
        State::ReadyToSwitchOn,
    ] {
        let mut rig = Rig::enabled(Mode::Csp);
        rig.drive.state = state;
        let status = rig.cycle();
        assert_eq!(status.trip, Some(Trip::PowerLost { state }));
        assert_eq!(status.power_loss_cause, Some(PowerLossCause::Trip));
        rig.drive.state = State::SwitchOnDisabled;
        rig.run(200);
        assert_eq!(
            rig.drive.state,
            State::SwitchOnDisabled,
            "no power again by itself"
        );
        assert!(matches!(
            rig.axis.command(Command::Enable),
            Err(CommandError::Tripped(_))
        ));
        rig.axis.command(Command::ResetFault).unwrap();
        rig.axis.command(Command::Enable).unwrap();
        rig.until(|s| s.ready, 20);
    }
}

#[test]
fn no_motion_until_the_mode_is_confirmed() {
    let mut rig = Rig::of(Mode::Csp);
    rig.axis.command(Command::Enable).unwrap();
    for _ in 0..20 {
        let mut inputs = rig.drive.inputs();
        inputs.mode_display = Some(1);
        rig.drive.cycle(&rig.out, common::DT);
        rig.out = rig.axis.step(&inputs, common::DT);
        assert_eq!(Some(rig.out.target_position), inputs.position);
    }
    let status = rig.axis.status();
    assert_eq!(
        (status.state, rig.out.controlword),
        (State::SwitchedOn, 0x0007)
    );
    assert!(!status.mode_confirmed && !status.enabled);
    let go = Command::MoveTo {
        position: 1.0,
        speed: 1.0,
        ramp: 1.0,
    };
    assert_eq!(
        rig.axis.command(go),
        Err(CommandError::ModeNotConfirmed {
            expected: Mode::Csp,
            display: Mode::Pp
        })
    );
    rig.until(|s| s.ready, 3);
    rig.axis.command(go).unwrap();
    // A mode that changes during operation stops the axis.
    rig.run(20);
    let mut inputs = rig.drive.inputs();
    inputs.mode_display = Some(6);
    rig.out = rig.axis.step(&inputs, common::DT);
    assert!(matches!(
        rig.axis.status().trip,
        Some(Trip::ModeLost { .. })
    ));
    assert_eq!(rig.out.controlword, 0x0002);
    assert_eq!(Some(rig.out.target_position), inputs.position);
}

#[test]
fn csp_without_a_position_gets_no_power() {
    let mut axis = axis(Mode::Csp);
    axis.command(Command::Enable).unwrap();
    let inputs = Inputs {
        statusword: 0x0233,
        fresh: true,
        ..Inputs::default()
    };
    for _ in 0..10 {
        assert_eq!(axis.step(&inputs, 0.001).controlword & 0x09, 0);
    }
}

#[test]
fn stale_statuswords_are_ignored() {
    let mut rig = Rig::enabled(Mode::Csp);
    let mut inputs = rig.drive.inputs();
    inputs.statusword = 0x0218;
    inputs.fresh = false;
    let out = rig.axis.step(&inputs, common::DT);
    assert_eq!(out.controlword, 0x000F);
    assert_eq!(rig.axis.status().fault, None);
    assert_eq!(rig.axis.status().stale_cycles, 1);
    // A command still takes effect.
    rig.axis.command(Command::QuickStop).unwrap();
    assert_eq!(rig.axis.step(&inputs, common::DT).controlword, 0x0002);
}

#[test]
fn invalid_configurations_are_rejected() {
    for mode in [Mode::Hm, Mode::Unknown(-1), Mode::Unknown(0)] {
        assert_eq!(
            Axis::new(AxisConfig::new(mode, scale(), LIMITS)).err(),
            Some(ConfigError::Mode(mode))
        );
    }
    let bad = Limits {
        velocity: f64::NAN,
        ..LIMITS
    };
    assert!(Axis::new(AxisConfig::new(Mode::Csp, scale(), bad)).is_err());
    let config = AxisConfig {
        target_window: 0.0,
        ..AxisConfig::new(Mode::Csp, scale(), LIMITS)
    };
    assert!(Axis::new(config).is_err());
}
