//! Profiles of the drive: PP, PV, homing, and the switches into and out of these modes.

use crate::common::{DT, Drive, LIMITS, Rig, all, scale};
use ecaxis_axis::{
    Axis, AxisConfig, Command, CommandError, HomeReference, HomingError, HomingStatus, Limits,
    Mode, PositionValidity, State, Trip,
};

const COUNTS_PER_UNIT: f64 = 400.0;

const ENDLESS: Limits = Limits {
    position: None,
    ..LIMITS
};

fn enabled(mode: Mode) -> Rig {
    let mut rig = Rig::new(Axis::new(all(mode, ENDLESS)).unwrap(), Drive::at(1000));
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 100);
    rig
}

const fn go(position: f64, speed: f64, ramp: f64) -> Command {
    Command::MoveTo {
        position,
        speed,
        ramp,
    }
}

const fn run_at(velocity: f64) -> Command {
    Command::Velocity {
        velocity,
        ramp: 0.5,
    }
}

const HOME: Command = Command::Home { timeout_s: 5.0 };

#[test]
fn profile_position_move_arrives() {
    let mut rig = enabled(Mode::Pp);
    rig.axis.command(go(40.0, 0.5, 0.25)).unwrap();
    let mut words = vec![];
    let mut fastest = 0.0f64;
    let status = loop {
        let status = rig.cycle();
        if words.last() != Some(&rig.out.controlword) {
            words.push(rig.out.controlword);
        }
        if rig.out.controlword & 0x10 != 0 {
            assert_eq!(rig.out.target_position, 16_000);
            assert_eq!(rig.out.profile_velocity, 100 * 12_000);
            assert_eq!(rig.out.profile_acceleration, 500 * 12_000);
        }
        fastest = fastest.max(status.velocity);
        if !status.moving {
            break status;
        }
        assert!(!status.in_target && words.len() < 9);
    };
    assert_eq!(words, [0x003F, 0x000F]);
    assert!((fastest - 100.0).abs() < 1e-6);
    assert!(status.in_target && status.at_rest);
    assert_eq!(
        (status.final_error_counts, status.target_position),
        (Some(0), 40.0)
    );
    // Relative to the end of the last move.
    rig.axis
        .command(Command::MoveBy {
            distance: -10.0,
            speed: 1.0,
            ramp: 1.0,
        })
        .unwrap();
    let status = rig.until(|s| s.in_target, 2000);
    assert_eq!(
        (status.target_position, rig.drive.raw_position()),
        (30.0, 12_000)
    );
    assert_eq!(rig.axis.status().trip, None);
}

#[test]
fn a_profile_position_move_is_halted_and_replaced() {
    let mut rig = enabled(Mode::Pp);
    rig.axis.command(go(40.0, 1.0, 1.0)).unwrap();
    rig.run(150);
    rig.axis.command(Command::Stop).unwrap();
    rig.cycle();
    assert_eq!(rig.out.controlword, 0x010F);
    let status = rig.until(|s| !s.moving, 200);
    assert!(status.ready && status.at_rest && status.position < 39.0);
    rig.run(500);
    assert_eq!(rig.out.controlword, 0x010F, "the old target stays halted");
    rig.axis.command(go(-5.0, 1.0, 1.0)).unwrap();
    rig.run(50);
    rig.axis.command(go(20.0, 1.0, 1.0)).unwrap();
    let status = rig.until(|s| s.in_target, 1000);
    assert_eq!(rig.drive.raw_position(), 8000);
    // Disabling halts first.
    rig.axis.command(go(40.0, 1.0, 1.0)).unwrap();
    rig.run(100);
    rig.axis.command(Command::Disable).unwrap();
    rig.cycle();
    assert_eq!((rig.out.controlword, status.trip), (0x010F, None));
    rig.until(|s| s.state == State::SwitchOnDisabled, 500);
    assert!(rig.drive.velocity == 0.0);
}

#[test]
fn set_point_without_acknowledgement_trips() {
    let mut rig = enabled(Mode::Pp);
    rig.drive.deaf = true;
    rig.axis.command(go(40.0, 1.0, 1.0)).unwrap();
    let status = rig.until(|s| s.trip.is_some(), 1100);
    assert_eq!(status.trip, Some(Trip::SetPointNotTaken));
}

#[test]
fn profile_velocity_is_reached_and_stopped() {
    let mut rig = enabled(Mode::Pv);
    rig.axis.command(run_at(60.0)).unwrap();
    rig.cycle();
    assert_eq!(rig.out.target_velocity, 60 * 12_000);
    assert_eq!(rig.out.profile_acceleration, 1000 * 12_000);
    let status = rig.until(|s| s.in_target, 200);
    assert!((status.velocity - 60.0).abs() < 2.0 && !status.at_rest);
    rig.axis.command(Command::Stop).unwrap();
    rig.cycle();
    assert_eq!((rig.out.controlword, rig.out.target_velocity), (0x010F, 0));
    let status = rig.until(|s| s.at_rest && !s.moving, 200);
    assert!(status.ready);
    rig.axis.command(run_at(-60.0)).unwrap();
    rig.cycle();
    assert_eq!(rig.out.controlword, 0x000F);
    rig.until(|s| s.in_target && s.velocity < -58.0, 300);
    assert!(matches!(
        rig.axis.command(run_at(201.0)),
        Err(CommandError::TooFast { .. })
    ));
    assert!(matches!(
        rig.axis.command(go(0.0, 1.0, 1.0)),
        Err(CommandError::WrongMode { .. })
    ));
}

#[test]
fn a_profile_velocity_stops_inside_the_range() {
    let mut rig = Rig::new(Axis::new(all(Mode::Pv, LIMITS)).unwrap(), Drive::at(0));
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 100);
    for (velocity, end) in [(150.0, 50.0), (-100.0, -50.0), (-20.0, -50.0)] {
        rig.axis.command(run_at(velocity)).unwrap();
        let status = rig.until(|s| s.held_by_range, 3000);
        assert_eq!(status.trip, None);
        let status = rig.until(|s| s.at_rest && !s.moving, 500);
        assert!((status.position - end).abs() < 1.5, "{}", status.position);
        assert!(status.position.abs() <= 50.0 && status.ready);
    }
}

/// The velocity continues through PV, CSP and CSV; no step exceeds the acceleration of one cycle.
#[test]
fn velocity_continues_into_and_out_of_pv() {
    for delay in [0, 5, 30] {
        let mut rig = enabled(Mode::Csp);
        rig.drive.mode_delay = Some(delay);
        rig.axis.command(run_at(60.0)).unwrap();
        rig.until(|s| s.in_target && !s.moving, 500);
        rig.run(5);
        let mut velocity = 60.0;
        for mode in [
            Mode::Pv,
            Mode::Csv,
            Mode::Pv,
            Mode::Csp,
            Mode::Pv,
            Mode::Cst,
        ] {
            rig.axis.command(Command::SetMode(mode)).unwrap();
            for _ in 0..200 {
                let before = rig.drive.position;
                let status = rig.cycle();
                let moved = (rig.drive.position - before) / COUNTS_PER_UNIT / DT;
                let most = LIMITS.acceleration * DT + 2.0 / COUNTS_PER_UNIT / DT;
                assert!(
                    (moved - velocity).abs() <= most,
                    "{mode}: from {velocity} to {moved}"
                );
                assert_eq!((status.trip, status.guarded_cycles), (None, 0));
                velocity = moved;
            }
            let status = rig.axis.status();
            assert_eq!((status.mode, status.in_target), (mode, true));
        }
    }
}

#[test]
fn modes_that_brake_by_themselves_are_entered_at_rest() {
    let mut rig = enabled(Mode::Csp);
    rig.axis.command(run_at(60.0)).unwrap();
    rig.run(200);
    for command in [Command::SetMode(Mode::Pp), HOME] {
        assert!(matches!(
            rig.axis.command(command),
            Err(CommandError::StillMoving { .. })
        ));
    }
    rig.axis.command(Command::Stop).unwrap();
    rig.until(|s| s.at_rest && !s.moving, 500);
    rig.axis.command(Command::SetMode(Mode::Pp)).unwrap();
    rig.until(|s| s.mode == Mode::Pp, 20);
    rig.axis.command(go(10.0, 1.0, 1.0)).unwrap();
    rig.until(|s| s.in_target, 2000);
    rig.axis.command(Command::SetMode(Mode::Csp)).unwrap();
    let held = rig.drive.raw_position();
    let status = rig.until(|s| s.mode == Mode::Csp, 20);
    assert_eq!((rig.out.target_position, status.trip), (held, None));
    assert_eq!(
        rig.axis.command(Command::SetMode(Mode::Hm)),
        Err(CommandError::ModeNotOffered { mode: Mode::Hm })
    );
}

/// The origin shifts and the set-point does not jump.
#[test]
fn homing_returns_to_the_cyclic_mode() {
    for (mode, home_is) in [
        (Mode::Csp, 0.0),
        (Mode::Csp, 1_000_000.0),
        (Mode::Csv, -777.0),
        (Mode::Cst, 12.0),
        (Mode::Pp, 400.0),
    ] {
        for velocity_mapped in [true, false] {
            let mut rig = enabled(mode);
            rig.drive.home_is = home_is;
            rig.drive.mode_delay = Some(3);
            rig.axis.command(HOME).unwrap();
            assert_eq!(
                rig.axis.command(go(1.0, 1.0, 1.0)),
                Err(CommandError::Homing)
            );
            let mut done = None;
            for cycle in 0..2000 {
                let mut inputs = rig.drive.inputs();
                if !velocity_mapped {
                    inputs.velocity = None;
                }
                rig.drive.cycle(&rig.out, DT);
                rig.out = rig.axis.step(&inputs, DT);
                let status = rig.axis.status();
                assert_eq!(status.trip, None, "{mode}");
                // While positions apply, they equal the actual position; in PID mode the axis
                // moves.
                if rig.out.mode == 8 {
                    assert_eq!(Some(rig.out.target_position), inputs.position);
                }
                if status.homing == HomingStatus::Attained {
                    done.get_or_insert(cycle);
                }
            }
            let status = rig.axis.status();
            assert!((300..1000).contains(&done.unwrap()), "{done:?}");
            assert_eq!((status.mode, status.homed()), (mode, true));
            assert!((status.position - home_is / COUNTS_PER_UNIT).abs() < 0.02);
            // Positions are absolute from now on.
            let target = home_is / COUNTS_PER_UNIT + 1.0;
            rig.axis.command(go(target, 0.1, 0.05)).unwrap();
            rig.until(|s| s.in_target, 2000);
            assert!((rig.drive.position - home_is - 400.0).abs() <= 40.0);
        }
    }
}

/// After more turns than 32 bits hold, the position after homing is the drive's position, without
/// additional turns.
#[test]
fn homing_discards_earlier_turns() {
    let mut rig = Rig::new(
        Axis::new(all(Mode::Csp, ENDLESS)).unwrap(),
        Drive::at(i32::MAX - 100),
    );
    rig.axis.command(Command::Enable).unwrap();
    let start = rig.until(|s| s.ready, 20).position;
    rig.axis.command(go(start + 10.0, 1.0, 1.0)).unwrap();
    rig.until(|s| s.in_target && s.at_rest, 1000);
    rig.drive.position = f64::from(rig.drive.raw_position());
    rig.drive.home_at = Some(rig.drive.position - 100.0);
    rig.axis.command(HOME).unwrap();
    let status = rig.until(|s| s.homing == HomingStatus::Attained, 1000);
    assert!(status.position.abs() < 0.001, "{}", status.position);
}

#[test]
fn homing_without_a_switch_times_out() {
    let mut rig = enabled(Mode::Csp);
    rig.drive.home_at = None;
    rig.axis.command(Command::Home { timeout_s: 0.5 }).unwrap();
    let status = rig.until(|s| matches!(s.homing, HomingStatus::Failed(_)), 1000);
    let HomingStatus::Failed(error) = status.homing else {
        panic!();
    };
    assert_eq!(error, HomingError::Timeout { timeout_s: 0.5 });
    assert_eq!(
        (status.mode, status.homed(), status.trip),
        (Mode::Csp, false, None)
    );
    assert!(status.at_rest && rig.run(50).ready);
    rig.drive.home_at = Some(-1e6);
    rig.axis.command(HOME).unwrap();
    rig.drive.home_at = Some(0.0);
    rig.until(|s| s.homing == HomingStatus::Attained, 3000);
}

#[test]
fn homing_reports_errors_and_aborts() {
    // A homing error of the drive.
    let mut rig = enabled(Mode::Csv);
    rig.drive.homing_error = true;
    rig.axis.command(HOME).unwrap();
    let status = rig.until(|s| matches!(s.homing, HomingStatus::Failed(_)), 1000);
    assert_eq!(status.homing, HomingStatus::Failed(HomingError::Drive));
    assert_eq!(status.mode, Mode::Csv);
    // Stop.
    let mut rig = enabled(Mode::Csp);
    rig.axis.command(HOME).unwrap();
    rig.run(100);
    assert_eq!(rig.out.controlword, 0x001F);
    rig.axis.command(Command::Stop).unwrap();
    rig.cycle();
    assert_eq!(rig.out.controlword, 0x011F);
    let status = rig.until(|s| matches!(s.homing, HomingStatus::Failed(_)), 100);
    assert_eq!(status.homing, HomingStatus::Failed(HomingError::Aborted));
    assert!(status.ready && status.mode == Mode::Csp);
    // A fault.
    rig.axis.command(HOME).unwrap();
    rig.run(100);
    rig.drive.fault();
    let status = rig.run(10);
    assert_eq!(status.homing, HomingStatus::Failed(HomingError::PowerLost));
    assert_eq!((status.mode, rig.out.mode), (Mode::Csp, 8));
    // Disable.
    let mut rig = enabled(Mode::Csp);
    rig.axis.command(HOME).unwrap();
    rig.run(100);
    rig.axis.command(Command::Disable).unwrap();
    let status = rig.until(|s| s.state == State::SwitchOnDisabled, 500);
    assert!(matches!(status.homing, HomingStatus::Failed(_)));
    // Homing mode is not available.
    let mut rig = enabled(Mode::Csp);
    rig.drive.mode_delay = None;
    rig.axis.command(HOME).unwrap();
    let status = rig.until(|s| matches!(s.homing, HomingStatus::Failed(_)), 2000);
    assert_eq!(
        status.homing,
        HomingStatus::Failed(HomingError::ModeRefused)
    );
    assert!(status.ready && status.mode == Mode::Csp);
    // Invalid time limits.
    for timeout_s in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(rig.axis.command(Command::Home { timeout_s }).is_err());
    }
    let config = AxisConfig::new(Mode::Csp, scale(), LIMITS);
    let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(0));
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 20);
    assert_eq!(
        rig.axis.command(HOME),
        Err(CommandError::ModeNotOffered { mode: Mode::Hm })
    );
}

/// Lost frames during homing only change its duration.
#[test]
fn homing_and_moves_survive_lost_frames() {
    for mode in [Mode::Csp, Mode::Pp] {
        let mut rig = enabled(mode);
        rig.axis.command(HOME).unwrap();
        for cycle in 0..4000 {
            rig.cycle_with(cycle % 7 != 0 && cycle % 100 > 5);
        }
        let status = rig.axis.status();
        assert_eq!((status.homing, status.trip), (HomingStatus::Attained, None));
        rig.axis.command(go(20.0, 1.0, 1.0)).unwrap();
        for cycle in 0..2000 {
            rig.cycle_with(cycle % 7 != 0 && cycle % 100 > 5);
        }
        let status = rig.axis.status();
        assert!(status.in_target && status.trip.is_none());
        assert_eq!(rig.drive.raw_position(), 8000);
    }
}

/// A drive that ignores bit 8 is stopped by its quick stop, in each mode with a halt.
#[test]
fn an_ignored_halt_ends_in_a_quick_stop() {
    for mode in [Mode::Pp, Mode::Pv] {
        for hold in [false, true] {
            let mut rig = enabled(mode);
            rig.drive.ignores_halt = true;
            let command = match mode {
                Mode::Pp => go(90_000.0, 0.5, 1.0),
                _ => run_at(100.0),
            };
            rig.axis.command(command).unwrap();
            rig.run(1000);
            if hold {
                rig.axis.set_rate(0.0);
            } else {
                rig.axis.command(Command::Stop).unwrap();
            }
            // v / a is 0.05 s. In PV the velocity is 0 as well, which this drive obeys.
            let mut words = Vec::new();
            for _ in 0..1300 {
                rig.cycle();
                words.push(rig.out.controlword & 0x000F);
            }
            let status = rig.axis.status();
            if mode == Mode::Pv {
                assert_eq!((status.trip, status.velocity), (None, 0.0));
                continue;
            }
            assert!(
                matches!(status.trip, Some(Trip::HaltIgnored { velocity, .. }) if velocity > 99.0),
                "{mode} {hold}: {:?}",
                status.trip
            );
            words.dedup();
            assert_eq!(words.get(..2), Some(&[0x000F, 0x0002][..]), "{mode} {hold}");
        }
    }
    let mut rig = enabled(Mode::Csp);
    rig.drive.ignores_halt = true;
    rig.drive.home_at = None;
    rig.axis.command(HOME).unwrap();
    rig.run(200);
    rig.axis.command(Command::Stop).unwrap();
    let status = rig.run(1300);
    assert!(matches!(status.trip, Some(Trip::HaltIgnored { .. })));
    assert!(matches!(status.homing, HomingStatus::Failed(_)));
}

/// "Attained" of an earlier homing, and a drive that does not keep its home offset.
#[test]
fn home_needs_evidence() {
    let home = |position, moves| AxisConfig {
        home: Some(HomeReference {
            position,
            window: 0.1,
            moves,
        }),
        ..all(Mode::Csp, ENDLESS)
    };
    let enabled = |config| {
        let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(1000));
        rig.axis.command(Command::Enable).unwrap();
        rig.until(|s| s.ready, 100);
        rig
    };
    // The drive clears bit 12 150 ms late, and finds home later.
    let mut rig = enabled(home(Some(0.0), true));
    rig.drive.stale_attained = 150;
    rig.axis.command(HOME).unwrap();
    let status = rig.until(|s| s.homing != HomingStatus::Running, 6000);
    assert_eq!(status.homing, HomingStatus::Attained);
    assert!(rig.drive.homing_searched, "before it was homed");
    assert_eq!(status.validity, PositionValidity::Homed);
    // It never clears bit 12.
    let mut rig = enabled(home(None, true));
    rig.drive.stale_attained = u32::MAX;
    rig.drive.home_at = None;
    rig.axis.command(HOME).unwrap();
    let status = rig.until(|s| s.homing != HomingStatus::Running, 6000);
    assert_eq!(
        status.homing,
        HomingStatus::Failed(HomingError::NeverCleared)
    );
    assert_eq!(status.validity, PositionValidity::Unknown);
    // 0x607C says 3 mm; the drive counts from 0.
    let mut rig = enabled(home(Some(3.0), true));
    rig.axis.command(HOME).unwrap();
    let status = rig.until(|s| s.homing != HomingStatus::Running, 6000);
    assert_eq!(
        status.homing,
        HomingStatus::Failed(HomingError::Elsewhere {
            reported: 0.0,
            expected: 3.0
        })
    );
    assert!(!status.homed());
}
