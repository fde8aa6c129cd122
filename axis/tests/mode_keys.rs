//! Drives that show their mode in Operation enabled only, or change it without power only.

use std::cell::Cell;

use crate::common::{Drive, LIMITS, Rig, all};
use ecaxis_axis::{
    Axis, AxisConfig, Brake, Command, CommandError, HomingError, HomingStatus, Mode, State,
    StopMethod, StopPhase, Trip,
};

fn config() -> AxisConfig {
    AxisConfig {
        mode_time_s: 0.2,
        ..all(Mode::Csp, LIMITS)
    }
}

const fn to(position: f64) -> Command {
    Command::MoveTo {
        position,
        speed: 1.0,
        ramp: 1.0,
    }
}

fn shown_late(cycles: u32, config: AxisConfig) -> Rig {
    let mut drive = Drive::at(1000);
    drive.shown_after = Some(cycles);
    Rig::new(Axis::new(config).unwrap(), drive)
}

#[test]
fn drive_that_shows_its_mode_when_enabled_gets_power_only_with_the_key() {
    let mut rig = shown_late(20, config());
    rig.axis.command(Command::Enable).unwrap();
    let status = rig.run(500);
    assert_eq!((status.state, status.enabled), (State::SwitchedOn, false));

    let config = AxisConfig {
        mode_display_enabled: true,
        ..config()
    };
    for cycles in [0, 20, 150] {
        let mut rig = shown_late(cycles, config);
        rig.axis.command(Command::Enable).unwrap();
        rig.until(|s| s.state == State::OperationEnabled, 20);
        let mut waited = 0;
        while !rig.axis.status().enabled {
            // Something moves the shaft: targets follow it, and no motion is accepted.
            rig.drive.position += 3.0;
            let inputs = rig.drive.inputs();
            rig.cycle();
            if rig.axis.status().enabled {
                break;
            }
            assert_eq!(Some(rig.out.target_position), inputs.position);
            assert_eq!((rig.out.target_velocity, rig.out.target_torque), (0, 0));
            assert!(rig.axis.command(to(5.0)).is_err());
            waited += 1;
        }
        assert!(
            waited + 1 >= cycles && waited < cycles + 5,
            "{waited} {cycles}"
        );
        assert_eq!(rig.axis.status().trip, None);
        rig.until(|s| s.ready, 5);
        rig.axis.command(to(5.0)).unwrap();
        rig.until(|s| s.in_target, 500);
    }
}

#[test]
fn mode_that_is_not_shown_in_time_is_a_trip_without_power() {
    let config = AxisConfig {
        mode_display_enabled: true,
        ..config()
    };
    let mut rig = shown_late(400, config);
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.state == State::OperationEnabled, 20);
    let status = rig.until(|s| s.trip.is_some(), 220);
    let trip = status.trip.unwrap();
    let expected = Trip::ModeNotShown {
        expected: Mode::Csp,
        display: Mode::Unknown(0),
        time_s: 0.2,
    };
    assert_eq!(trip, expected);
    assert!(trip.to_string().contains("0x6061"), "{trip}");
    rig.until(|s| !s.state.has_power(), 3000);
    rig.drive.shown_after = Some(0);
    let status = rig.run(500);
    assert!(!status.state.has_power(), "no power again by itself");
    assert!(matches!(
        rig.axis.command(Command::Enable),
        Err(CommandError::Tripped(_))
    ));
    rig.axis.command(Command::ResetFault).unwrap();
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 50);
    // A mode that changes later is lost at once.
    rig.drive.mode = 1;
    rig.drive.mode_delay = None;
    let status = rig.cycle();
    assert!(matches!(status.trip, Some(Trip::ModeLost { .. })));
}

fn unpowered(config: AxisConfig) -> Rig {
    let mut drive = Drive::at(1000);
    drive.mode_unpowered = true;
    drive.shown_after = config.mode_display_enabled.then_some(30);
    let config = AxisConfig {
        mode_change_unpowered: true,
        ..config
    };
    let mut rig = Rig::new(Axis::new(config).unwrap(), drive);
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 200);
    rig
}

#[test]
fn mode_switch_without_the_key_is_given_up() {
    let mut drive = Drive::at(1000);
    drive.mode_unpowered = true;
    let mut rig = Rig::new(Axis::new(config()).unwrap(), drive);
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 50);
    rig.axis.command(Command::SetMode(Mode::Csv)).unwrap();
    let status = rig.until(|s| s.switching.is_none(), 300);
    assert_eq!(
        (status.mode, status.switch_failed),
        (Mode::Csp, Some(Mode::Csv))
    );
}

#[test]
fn mode_switch_passes_through_no_power() {
    let brake = Brake {
        release_s: 0.02,
        engage_s: 0.03,
    };
    for late in [false, true] {
        let config = AxisConfig {
            brake,
            mode_display_enabled: late,
            ..config()
        };
        let mut rig = unpowered(config);
        let at = rig.drive.position;
        for mode in [Mode::Csv, Mode::Pp, Mode::Csp] {
            rig.axis.command(Command::SetMode(mode)).unwrap();
            assert_eq!(
                rig.axis.command(to(1.0)),
                Err(CommandError::Switching { to: mode })
            );
            let mut off = 0;
            let before = rig.axis.status().mode;
            for _ in 0..1000 {
                let status = rig.cycle();
                let word = rig.out.controlword & 0x0F;
                off += u32::from(!status.state.has_power());
                // 0x6060 changes without power only.
                if status.state.has_power() && off == 0 {
                    assert_eq!(rig.out.mode, before.code());
                }
                assert!(off > 0 || word == 0x0F || word == 0x06, "{word:#x}");
                if status.ready && status.mode == mode {
                    break;
                }
            }
            let status = rig.axis.status();
            assert_eq!(
                (status.mode, status.switching, status.trip),
                (mode, None, None)
            );
            assert!(status.ready && off > 0, "{mode}: {off}");
            assert_eq!(rig.drive.position, at);
        }
        rig.axis.command(to(5.0)).unwrap();
        rig.until(|s| s.in_target, 500);
    }
}

#[test]
fn mode_switch_without_power_needs_standstill() {
    let mut rig = unpowered(config());
    rig.axis.command(to(40.0)).unwrap();
    rig.run(50);
    assert!(matches!(
        rig.axis.command(Command::SetMode(Mode::Csv)),
        Err(CommandError::StillMoving { .. })
    ));
    assert_eq!(rig.until(|s| s.in_target, 1000).trip, None);
}

/// Whatever stops the axis during a switch keeps its power off.
#[test]
fn power_does_not_return_after_a_stop() {
    for stop in [
        Command::Stop,
        Command::Disable,
        Command::QuickStop,
        Command::DisableVoltage,
        Command::EmergencyStop,
    ] {
        for cycles in 0..130 {
            let mut rig = unpowered(config());
            rig.axis.command(Command::SetMode(Mode::Csv)).unwrap();
            rig.run(cycles);
            let status = rig.axis.status();
            if status.mode == Mode::Csv && status.enabled {
                assert!(cycles > 100, "{cycles}");
                break;
            }
            rig.axis.command(stop).unwrap();
            let status = rig.run(2000);
            // The drive stays in Quick stop active.
            let off = !status.state.has_power() || stop == Command::QuickStop;
            assert!(off, "{stop:?} after {cycles}");
            assert_ne!(
                status.state,
                State::OperationEnabled,
                "{stop:?} after {cycles}"
            );
            assert_eq!((status.switching, status.enabled), (None, false));
        }
    }
    let mut rig = unpowered(config());
    rig.axis.command(Command::SetMode(Mode::Csv)).unwrap();
    rig.run(104);
    rig.drive.fault();
    rig.run(2000);
    assert_eq!(rig.drive.state, State::Fault);
}

type Stops<'a> = &'a dyn Fn(&mut Axis);

/// The end of a stop during homing is an axis without power, whose homing has ended: the way back to the
/// previous mode would give power again.
#[test]
fn power_does_not_return_after_a_stop_of_homing() {
    let command = |command| move |axis: &mut Axis| _ = axis.command(command);
    let stops: [(&str, Stops<'_>); 7] = [
        ("disable", &command(Command::Disable)),
        ("quick stop", &command(Command::QuickStop)),
        ("disable voltage", &command(Command::DisableVoltage)),
        ("emergency stop", &command(Command::EmergencyStop)),
        ("ramp from outside", &|axis| axis.stop_by(StopMethod::Ramp)),
        ("quick stop from outside", &|axis| {
            axis.stop_by(StopMethod::QuickStop);
        }),
        ("no voltage from outside", &|axis| {
            axis.stop_by(StopMethod::DisableVoltage);
        }),
    ];
    for (name, stop) in stops {
        for (cycles, repeated) in (0..400).step_by(3).flat_map(|n| [(n, false), (n, true)]) {
            let mut rig = unpowered(config());
            rig.axis.command(Command::Home { timeout_s: 5.0 }).unwrap();
            rig.run(cycles);
            if rig.axis.status().homing == HomingStatus::Attained && rig.axis.status().ready {
                assert!(cycles > 100, "{name}: {cycles}");
                break;
            }
            stop(&mut rig.axis);
            let mut off = 0;
            let mut first_off = None;
            for cycle in 0..3000 {
                if repeated {
                    stop(&mut rig.axis);
                }
                let status = rig.cycle();
                let enables = rig.out.controlword & 0x0F == 0x0F;
                off += u32::from(!status.state.has_power());
                first_off = first_off.or((off > 0).then_some(cycle));
                assert!(
                    !(enables && off > 0),
                    "{name} after {cycles}: power at {cycle}"
                );
            }
            let status = rig.axis.status();
            let (stop, homing) = (status.stop, status.homing);
            // A ramp rests for 100 ms, and needs no time-out.
            if name != "quick stop" {
                assert!(
                    first_off.is_some_and(|cycle| cycle < 400),
                    "{name} after {cycles}: {first_off:?}"
                );
            }
            // The drive stays in Quick stop active.
            let stays = name == "quick stop"
                && stop.is_some_and(|stop| stop.phase == StopPhase::Standstill);
            assert!(stop.is_none() || stays, "{name} after {cycles}: {stop:?}");
            assert_ne!(homing, HomingStatus::Running, "{name} after {cycles}");
        }
    }
}

/// Before the drive is commanded to lose its power, a loss is not that of the switch.
#[test]
fn power_that_is_lost_before_its_removal_does_not_return() {
    for homes in [false, true] {
        for cycles in 0..99 {
            let mut rig = unpowered(config());
            let command = match homes {
                true => Command::Home { timeout_s: 5.0 },
                false => Command::SetMode(Mode::Csv),
            };
            rig.axis.command(command).unwrap();
            rig.run(cycles);
            assert_eq!(rig.out.controlword & 0x0F, 0x0F);
            rig.drive.state = State::SwitchOnDisabled;
            let status = rig.run(3000);
            assert!(
                matches!(status.trip, Some(Trip::PowerLost { .. })),
                "{cycles}"
            );
            assert!(!status.state.has_power(), "{cycles}");
            assert_ne!(status.homing, HomingStatus::Running);
        }
    }
}

/// A drive that keeps its power keeps its mode.
#[test]
fn drive_that_keeps_its_power_fails_the_switch() {
    for homes in [false, true] {
        let mut rig = unpowered(config());
        rig.drive.ignores_shutdown = true;
        let command = match homes {
            true => Command::Home { timeout_s: 5.0 },
            false => Command::SetMode(Mode::Csv),
        };
        rig.axis.command(command).unwrap();
        let status = rig.until(|s| s.switching.is_none(), 400);
        let refused = if homes { Mode::Hm } else { Mode::Csv };
        assert_eq!(
            (status.mode, status.switch_failed),
            (Mode::Csp, Some(refused))
        );
        let status = rig.run(10);
        let failed = HomingStatus::Failed(HomingError::ModeRefused);
        assert_eq!(status.homing == failed, homes, "{:?}", status.homing);
        rig.drive.ignores_shutdown = false;
        assert!(!rig.run(3000).state.has_power());
    }
}

#[test]
fn mode_that_is_refused_without_power_leaves_the_axis_without_power() {
    let mut rig = unpowered(config());
    rig.drive.mode_delay = None;
    rig.axis.command(Command::SetMode(Mode::Csv)).unwrap();
    let status = rig.until(|s| s.switch_failed.is_some(), 500);
    assert_eq!((status.mode, status.switching), (Mode::Csp, None));
    let status = rig.run(500);
    assert!(!status.state.has_power());
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 50);
}

#[test]
fn homing_switches_without_power_to_homing_and_back() {
    let mut rig = unpowered(config());
    rig.drive.home_is = 0.0;
    rig.axis.command(Command::Home { timeout_s: 5.0 }).unwrap();
    let hm_powered = Cell::new(0);
    let status = rig.until(
        |s| {
            let homes = s.mode == Mode::Hm && s.state.has_power();
            hm_powered.set(hm_powered.get() + u32::from(homes));
            s.homing == HomingStatus::Attained && s.ready
        },
        5000,
    );
    assert!(hm_powered.get() > 0 && status.homed());
    assert_eq!((status.mode, status.trip), (Mode::Csp, None));
    rig.axis.command(to(5.0)).unwrap();
    rig.until(|s| s.in_target, 1000);

    let mut rig = unpowered(config());
    rig.drive.mode_delay = None;
    rig.axis.command(Command::Home { timeout_s: 5.0 }).unwrap();
    let failed = HomingStatus::Failed(HomingError::ModeRefused);
    let status = rig.until(|s| s.homing == failed, 1000);
    assert!(!status.homed() && !rig.run(500).state.has_power());
}
