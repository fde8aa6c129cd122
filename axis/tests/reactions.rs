//! Reactions to trips, emergency stops, brakes, automatic resets, enable blockers, dwell times,
//! touch probes.

use crate::common::{DT, Drive, LIMITS, Rig, all, scale};
use ecaxis_axis::{
    Axis, AxisConfig, Brake, Command, CommandError, Edge, EnableBlocker, FaultReset, Inputs,
    Limits, Mode, Probe, ProbeStatus, QuickStopOption, Source, State, StopMethod, Supervision,
    TorqueWatch, Trip,
};

const ENDLESS: Limits = Limits {
    position: None,
    ..LIMITS
};

fn rig(config: AxisConfig) -> Rig {
    Rig::new(Axis::new(config).unwrap(), Drive::at(0))
}

fn enabled(config: AxisConfig) -> Rig {
    let mut rig = rig(config);
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 2000);
    rig
}

fn supervised(mode: Mode, supervision: Supervision) -> AxisConfig {
    AxisConfig {
        supervision,
        ..all(mode, ENDLESS)
    }
}

const fn run_at(velocity: f64) -> Command {
    Command::Velocity {
        velocity,
        ramp: 1.0,
    }
}

/// The first Controlword after the trip, and the number of cycles until power is off.
#[test]
fn reactions_row_by_row() {
    for (reaction, first, least, most) in [
        (StopMethod::QuickStop, 0x0002, 100, 160),
        (StopMethod::Ramp, 0x000F, 145, 160),
        (StopMethod::DisableVoltage, 0x0000, 1, 3),
    ] {
        let mut rig = enabled(supervised(
            Mode::Csv,
            Supervision {
                reaction,
                torque: Some(TorqueWatch {
                    percent: 50.0,
                    time_s: 0.01,
                }),
                ..Supervision::default()
            },
        ));
        rig.axis.command(run_at(100.0)).unwrap();
        rig.until(|s| s.in_target, 200);
        // The drive reports a permanent torque.
        let mut cycles = 0;
        let status = loop {
            let mut inputs = rig.drive.inputs();
            inputs.torque = Some(-600);
            rig.drive.cycle(&rig.out, DT);
            rig.out = rig.axis.step(&inputs, DT);
            cycles += 1;
            let status = rig.axis.status();
            if status.trip.is_some() {
                break status;
            }
        };
        assert!((10..=11).contains(&cycles), "{cycles}");
        assert!(matches!(
            status.trip,
            Some(Trip::OverTorque { limit: 50.0, .. })
        ));
        assert_eq!(rig.out.controlword, first, "{reaction:?}");
        let mut cycles = 0;
        while rig.drive.state != State::SwitchOnDisabled
            && rig.drive.state != State::ReadyToSwitchOn
        {
            rig.cycle();
            cycles += 1;
        }
        assert!((least..=most).contains(&cycles), "{reaction:?}: {cycles}");
        assert!(matches!(
            rig.axis.command(Command::Enable),
            Err(CommandError::Tripped(_))
        ));
    }
}

/// A drive that has left its mode does not follow a ramp.
#[test]
fn ramp_becomes_quick_stop_if_the_mode_is_lost() {
    let mut rig = enabled(supervised(
        Mode::Csv,
        Supervision {
            reaction: StopMethod::Ramp,
            ..Supervision::default()
        },
    ));
    rig.axis.command(run_at(100.0)).unwrap();
    rig.run(100);
    let mut inputs = rig.drive.inputs();
    inputs.mode_display = Some(10);
    let out = rig.axis.step(&inputs, DT);
    assert_eq!(out.controlword, 0x0002);
}

#[test]
fn emergency_stop_takes_the_configured_method() {
    for (emergency, word) in [
        (StopMethod::QuickStop, 0x0002),
        (StopMethod::DisableVoltage, 0x0000),
    ] {
        let config = supervised(
            Mode::Csp,
            Supervision {
                emergency,
                ..Supervision::default()
            },
        );
        let mut rig = enabled(config);
        rig.axis.command(run_at(100.0)).unwrap();
        rig.run(100);
        rig.axis.command(Command::EmergencyStop).unwrap();
        // Also in a cycle whose frame was lost.
        rig.cycle_with(false);
        assert_eq!(rig.out.controlword, word);
        let status = rig.until(|s| s.state == State::SwitchOnDisabled, 200);
        assert_eq!(status.trip, Some(Trip::EmergencyStop));
        assert!(rig.axis.command(Command::Enable).is_err());
        rig.run(100);
        assert_eq!(rig.out.controlword, 0);
        rig.axis.command(Command::ResetFault).unwrap();
        rig.axis.command(Command::Enable).unwrap();
        rig.until(|s| s.ready, 20);
        // While enabling, and without power.
        let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(0));
        rig.axis.command(Command::EmergencyStop).unwrap();
        assert!(rig.axis.command(Command::Enable).is_err());
        rig.cycle();
        rig.axis.command(Command::ResetFault).unwrap();
        rig.axis.command(Command::Enable).unwrap();
        rig.until(|s| s.state == State::SwitchedOn, 10);
        rig.axis.command(Command::EmergencyStop).unwrap();
        for _ in 0..100 {
            rig.cycle();
            assert_eq!(rig.out.controlword & 0x09, 0);
        }
    }
}

/// A reset is for what a status has shown: it does not hide a cause of the same cycle.
#[test]
fn reset_does_not_clear_a_trip_of_the_same_cycle() {
    let mut rig = enabled(supervised(Mode::Csp, Supervision::default()));
    rig.axis.command(Command::EmergencyStop).unwrap();
    rig.axis.command(Command::ResetFault).unwrap();
    rig.cycle();
    assert_eq!(rig.axis.status().trip, Some(Trip::EmergencyStop));
    rig.axis.command(Command::ResetFault).unwrap();
    rig.cycle();
    assert_eq!(rig.axis.status().trip, None);
}

#[test]
fn over_acceleration_trips() {
    let supervision = Supervision {
        acceleration: Some(3000.0),
        ..Supervision::default()
    };
    let limits = Limits {
        following_error: None,
        ..ENDLESS
    };
    let mut rig = enabled(AxisConfig {
        supervision,
        ..all(Mode::Csv, limits)
    });
    rig.axis.command(run_at(200.0)).unwrap();
    assert_eq!(rig.run(300).trip, None, "the limit is 2000");
    let mut velocity = 200.0;
    let status = loop {
        let mut inputs = rig.drive.inputs();
        velocity -= 5.0;
        inputs.velocity = Some((velocity * 12_000.0) as i32);
        rig.out = rig.axis.step(&inputs, DT);
        let status = rig.axis.status();
        if status.trip.is_some() {
            break status;
        }
        assert!(velocity > -200.0);
    };
    assert!(matches!(
        status.trip,
        Some(Trip::OverAcceleration { limit: 3000.0, .. })
    ));
}

#[test]
fn brake_opens_before_motion_and_closes_before_power_is_removed() {
    let config = AxisConfig {
        brake: Brake {
            release_s: 0.05,
            engage_s: 0.03,
        },
        ..all(Mode::Csp, ENDLESS)
    };
    let mut rig = rig(config);
    assert!(!rig.out.brake_open);
    rig.axis.command(Command::Enable).unwrap();
    let status = rig.until(|s| s.enabled, 20);
    assert!(rig.out.brake_open && !status.ready);
    assert_eq!(status.waiting, Some(EnableBlocker::Brake));
    assert_eq!(
        rig.axis.command(run_at(1.0)),
        Err(CommandError::BrakeOpening)
    );
    // The load sinks; the set-point holds.
    let held = rig.out.target_position;
    let mut cycles = 0;
    while !rig.axis.status().ready {
        rig.cycle();
        cycles += 1;
    }
    assert!((49..=51).contains(&cycles) && rig.out.target_position == held);
    rig.axis.command(run_at(100.0)).unwrap();
    rig.run(100);
    rig.axis.command(Command::Disable).unwrap();
    let mut closing = 0;
    while rig.drive.state == State::OperationEnabled {
        let status = rig.cycle();
        assert!(rig.out.brake_open || status.target_velocity == 0.0);
        closing += u32::from(!rig.out.brake_open);
    }
    assert!((30..=34).contains(&closing), "{closing}");
    rig.run(5);
    // A fault closes the brake at once.
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 200);
    rig.drive.fault();
    rig.run(2);
    assert!(!rig.out.brake_open);
    // After a quick stop the brake closes at rest, and then power is removed.
    rig.axis.command(Command::ResetFault).unwrap();
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 500);
    rig.axis.command(run_at(100.0)).unwrap();
    rig.run(100);
    rig.axis.command(Command::EmergencyStop).unwrap();
    let mut closing = 0;
    while rig.drive.state != State::SwitchOnDisabled {
        rig.cycle();
        assert!(rig.out.brake_open || rig.drive.velocity.abs() < 2000.0);
        closing += u32::from(!rig.out.brake_open);
    }
    assert!((30..=34).contains(&closing), "{closing}");
}

#[test]
fn automatic_resets_are_bounded_and_give_no_power() {
    let config = AxisConfig {
        fault_reset: FaultReset::Automatic {
            tries: 2,
            delay_s: 0.2,
        },
        ..all(Mode::Csp, ENDLESS)
    };
    let mut rig = enabled(config);
    rig.drive.fault();
    let status = rig.until(|s| s.resetting, 210);
    assert!(status.fault.is_some() && status.time_in_state_s > 0.19);
    let status = rig.until(|s| s.state == State::SwitchOnDisabled, 200);
    assert_eq!((status.fault, status.resets_tried), (None, 1));
    rig.run(1000);
    assert_eq!(
        (rig.drive.state, rig.out.controlword),
        (State::SwitchOnDisabled, 0)
    );
    // A permanent fault: one more attempt of three pulses, then only commands reset it.
    rig.drive.stubborn = true;
    rig.drive.fault();
    rig.run(5000);
    let status = rig.axis.status();
    assert_eq!((rig.drive.resets, status.resets_tried), (4, 2));
    assert!(status.reset_failed && status.fault.is_some());
    rig.drive.stubborn = false;
    rig.axis.command(Command::ResetFault).unwrap();
    let status = rig.until(|s| s.state == State::SwitchOnDisabled, 200);
    assert_eq!(status.resets_tried, 0);
    // Without the configuration there is no automatic reset.
    let mut rig = enabled(all(Mode::Csp, ENDLESS));
    rig.drive.fault();
    rig.run(5000);
    assert_eq!(rig.drive.resets, 0);
}

#[test]
fn enable_blockers_are_reported() {
    let mut rig = rig(all(Mode::Csp, ENDLESS));
    assert_eq!(rig.run(200).waiting, None, "no request");
    rig.axis.command(Command::Enable).unwrap();
    let stuck = |rig: &mut Rig, inputs: Inputs| {
        for _ in 0..110 {
            rig.axis.step(&inputs, DT);
        }
        rig.axis.status().waiting
    };
    let base = rig.drive.inputs();
    let with = |statusword| Inputs { statusword, ..base };
    for (inputs, waiting) in [
        (with(0x0050), Some(EnableBlocker::Remote)),
        (with(0x0221), Some(EnableBlocker::Voltage)),
        (
            with(0x0231),
            Some(EnableBlocker::Drive {
                state: State::ReadyToSwitchOn,
            }),
        ),
        (
            Inputs {
                mode_display: Some(3),
                ..with(0x0233)
            },
            Some(EnableBlocker::Mode {
                expected: Mode::Csp,
                display: Mode::Pv,
            }),
        ),
    ] {
        assert_eq!(stuck(&mut rig, inputs), waiting);
        assert!(!waiting.unwrap().to_string().is_empty());
    }
    let mut blind = Axis::new(all(Mode::Csp, ENDLESS)).unwrap();
    blind.command(Command::Enable).unwrap();
    let inputs = Inputs {
        position: None,
        ..with(0x0233)
    };
    blind.step(&inputs, DT);
    assert_eq!(blind.status().waiting, Some(EnableBlocker::Position));
    let status = rig.until(|s| s.ready, 200);
    assert_eq!(status.waiting, None);
    assert!(status.word().contains(ecaxis_axis::Statusword::REMOTE));
}

#[test]
fn dwell_times_delay_in_target_and_at_rest() {
    let supervision = Supervision {
        target_dwell_s: 0.1,
        standstill_dwell_s: 0.2,
        standstill: Some(0.5),
        ..Supervision::default()
    };
    let mut rig = enabled(supervised(Mode::Csp, supervision));
    rig.axis
        .command(Command::MoveTo {
            position: 10.0,
            speed: 1.0,
            ramp: 1.0,
        })
        .unwrap();
    rig.until(|s| !s.moving, 1000);
    let (mut target, mut rest) = (None, None);
    for cycle in 1..300 {
        let status = rig.cycle();
        if status.in_target {
            target.get_or_insert(cycle);
        }
        if status.at_rest {
            rest.get_or_insert(cycle);
        }
    }
    assert!((98..=104).contains(&target.unwrap()), "{target:?}");
    assert!((198..=206).contains(&rest.unwrap()), "{rest:?}");
    // A push out of the window restarts the dwell time.
    let mut inputs = rig.drive.inputs();
    inputs.position = inputs.position.map(|p| p + 100);
    rig.axis.step(&inputs, DT);
    assert!(!rig.axis.status().in_target);
    assert!(!rig.run(90).in_target);
    assert!(rig.run(20).in_target);
}

#[test]
fn quick_stop_option_without_transition_16_skips_it() {
    for (code, word) in [(2, 0x0000), (6, 0x000F)] {
        let config = AxisConfig {
            quick_stop: Some(QuickStopOption(code)),
            ..all(Mode::Csp, ENDLESS)
        };
        let mut rig = enabled(config);
        rig.axis.command(Command::QuickStop).unwrap();
        rig.until(|s| s.state == State::QuickStopActive, 5);
        rig.axis.command(Command::Enable).unwrap();
        rig.cycle();
        assert_eq!(rig.out.controlword, word, "option code {code}");
        rig.until(|s| s.ready, 20);
    }
}

#[test]
fn a_touch_probe_captures_once_in_user_units() {
    let mut rig = enabled(all(Mode::Csp, ENDLESS));
    let arm = Command::ArmProbe {
        probe: Probe::First,
        edge: Edge::Negative,
        source: Source::Input,
        stop: false,
    };
    assert_eq!(rig.axis.command(arm), Err(CommandError::NoProbe));
    let step = |rig: &mut Rig, status: u16, latched: i32| {
        let inputs = Inputs {
            touch_probe_status: Some(status),
            touch_probe_positions: [Some(-1), Some(latched), None, None],
            ..rig.drive.inputs()
        };
        rig.drive.cycle(&rig.out, DT);
        rig.out = rig.axis.step(&inputs, DT);
        (rig.out.touch_probe_function, rig.axis.status().probes[0])
    };
    assert_eq!(step(&mut rig, 0, 0), (0, ProbeStatus::Off));
    rig.axis.command(arm).unwrap();
    assert_eq!(step(&mut rig, 0, 0), (0x0021, ProbeStatus::Arming));
    assert_eq!(step(&mut rig, 1, 0), (0x0021, ProbeStatus::Armed));
    let captured = ProbeStatus::Captured { position: 2.5 };
    assert_eq!(step(&mut rig, 5, 1000), (0, captured));
    assert_eq!(step(&mut rig, 0, 4000), (0, captured));
    rig.axis
        .command(Command::DisarmProbe {
            probe: Probe::First,
        })
        .unwrap();
    assert_eq!(step(&mut rig, 0, 4000), (0, ProbeStatus::Off));
}

#[test]
fn an_edge_stops_the_axis_in_the_cycle_that_shows_it() {
    for mode in [Mode::Csp, Mode::Csv] {
        for stop in [true, false] {
            let mut config = all(mode, ENDLESS);
            config.jerk_limited = mode == Mode::Csp;
            let mut rig = enabled(config);
            let step = |rig: &mut Rig, status: u16| {
                let inputs = Inputs {
                    touch_probe_status: Some(status),
                    touch_probe_positions: [Some(800), None, None, None],
                    ..rig.drive.inputs()
                };
                rig.drive.cycle(&rig.out, DT);
                rig.out = rig.axis.step(&inputs, DT);
                rig.axis.status()
            };
            step(&mut rig, 0);
            let arm = Command::ArmProbe {
                probe: Probe::First,
                edge: Edge::Positive,
                source: Source::Input,
                stop,
            };
            rig.axis.command(arm).unwrap();
            let go = Command::MoveTo {
                position: 100.0,
                speed: 1.0,
                ramp: 1.0,
            };
            rig.axis.command(go).unwrap();
            step(&mut rig, 0);
            for _ in 0..200 {
                step(&mut rig, 1);
            }
            let before = step(&mut rig, 1);
            assert!(before.target_velocity > 5.0, "{before:?}");
            step(&mut rig, 3);
            let after = step(&mut rig, 3);
            assert_eq!(
                after.target_acceleration < before.target_acceleration,
                stop,
                "{mode}: {after:?}"
            );
            let mut last = after;
            for _ in 0..3000 {
                last = step(&mut rig, 3);
            }
            assert!(last.at_rest, "{mode}: {last:?}");
            assert_eq!(last.target_position < 90.0, stop, "{mode}: {last:?}");
        }
    }
}

#[test]
fn invalid_supervision_is_rejected() {
    let good = AxisConfig::new(Mode::Csp, scale(), LIMITS);
    let with = |supervision| AxisConfig {
        supervision,
        ..good
    };
    for config in [
        with(Supervision {
            torque: Some(TorqueWatch {
                percent: 0.0,
                time_s: 1.0,
            }),
            ..Supervision::default()
        }),
        with(Supervision {
            torque: Some(TorqueWatch {
                percent: 1.0,
                time_s: -1.0,
            }),
            ..Supervision::default()
        }),
        with(Supervision {
            acceleration: Some(f64::NAN),
            ..Supervision::default()
        }),
        with(Supervision {
            standstill: Some(-1.0),
            ..Supervision::default()
        }),
        with(Supervision {
            target_dwell_s: f64::INFINITY,
            ..Supervision::default()
        }),
        AxisConfig {
            brake: Brake {
                release_s: -0.1,
                engage_s: 0.0,
            },
            ..good
        },
        AxisConfig {
            fault_reset: FaultReset::Automatic {
                tries: 1,
                delay_s: f64::NAN,
            },
            ..good
        },
    ] {
        assert!(Axis::new(config).is_err());
    }
}
