//! Trips of an axis and their reported causes.

use crate::common::{DT, Drive, LIMITS, Rig, axis, scale};
use ecaxis_axis::{Axis, AxisConfig, Command, CommandError, Inputs, Limits, Mode, State, Trip};

const fn to(position: f64) -> Command {
    Command::MoveTo {
        position,
        speed: 1.0,
        ramp: 1.0,
    }
}

/// Returns an enabled axis without a position range.
fn endless(mode: Mode) -> Rig {
    let limits = Limits {
        position: None,
        ..LIMITS
    };
    let axis = Axis::new(AxisConfig::new(mode, scale(), limits)).unwrap();
    let mut rig = Rig::new(axis, Drive::at(0));
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 100);
    rig
}

#[test]
fn blocked_motor_trips_on_following_error() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis.command(to(50.0)).unwrap();
    rig.run(10);
    rig.drive.blocked = true;
    let status = rig.until(|s| s.trip.is_some(), 100);
    let Some(Trip::FollowingError { error, limit }) = status.trip else {
        panic!("{:?}", status.trip);
    };
    assert!(error > 1.0 && error < 1.5 && limit == 1.0);
    assert_eq!(rig.out.controlword, 0x0002, "quick stop in the same cycle");
    assert!(matches!(
        rig.axis.command(to(0.0)),
        Err(CommandError::Tripped(_))
    ));
    let status = rig.until(|s| s.state == State::SwitchOnDisabled, 120);
    assert!(status.max_following_error > 1.0);
    assert!(
        matches!(status.trip, Some(Trip::FollowingError { .. })),
        "first cause stays"
    );
    // Acknowledge, enable, move.
    rig.drive.blocked = false;
    rig.axis.command(Command::ResetFault).unwrap();
    rig.axis.command(Command::Enable).unwrap();
    let status = rig.until(|s| s.ready, 20);
    assert_eq!(status.max_following_error, 0.0);
}

#[test]
fn a_drive_that_ignores_quick_stop_loses_its_power() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis.command(to(50.0)).unwrap();
    rig.run(10);
    rig.drive.blocked = true;
    for _ in 0..3000 {
        rig.drive.state = State::OperationEnabled;
        rig.cycle();
    }
    assert_eq!(rig.out.controlword, 0x0000);
}

#[test]
fn axis_pushed_out_of_its_range_trips() {
    let mut rig = Rig::new(axis(Mode::Csv), Drive::at(20_000));
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 100);
    rig.drive.position = 20_300.0;
    assert_eq!(rig.cycle().trip, None, "inside the margin");
    rig.drive.position = 20_500.0;
    let status = rig.cycle();
    assert!(
        matches!(status.trip, Some(Trip::PositionLimit { high: 50.0, .. })),
        "{:?}",
        status.trip
    );
}

#[test]
fn an_axis_outside_its_range_can_be_driven_back() {
    // 60 mm; the range ends at 50.
    let mut rig = Rig::new(axis(Mode::Csp), Drive::at(24_000));
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 20);
    assert_eq!(rig.run(100).trip, None);
    assert!(matches!(
        rig.axis.command(to(55.0)),
        Err(CommandError::OutsideRange { .. })
    ));
    rig.axis.command(to(40.0)).unwrap();
    let status = rig.until(|s| s.in_target, 1000);
    assert_eq!((status.trip, status.guarded_cycles), (None, 0));
}

#[test]
fn over_velocity_in_torque_mode_trips() {
    let mut rig = endless(Mode::Cst);
    rig.axis
        .command(Command::Torque {
            percent: 100.0,
            ramp_s: 0.0,
        })
        .unwrap();
    // The load drives the axis: the torque that brakes at the velocity limit is too weak.
    rig.drive.load = 1500.0;
    let status = rig.until(|s| s.trip.is_some(), 5000);
    let Some(Trip::OverVelocity { velocity, limit }) = status.trip else {
        panic!("{:?}", status.trip);
    };
    assert!(
        limit == 200.0 && (240.0..250.0).contains(&velocity),
        "{velocity}"
    );
    let status = rig.until(|s| s.state == State::SwitchOnDisabled, 3000);
    assert!(status.at_rest);
}

#[test]
fn one_wild_reading_is_not_over_velocity() {
    let mut rig = Rig::enabled(Mode::Csv);
    for _ in 0..4 {
        let mut inputs = rig.drive.inputs();
        inputs.velocity = Some(i32::MAX);
        rig.axis.step(&inputs, DT);
    }
    assert_eq!(rig.cycle().trip, None);
}

#[test]
fn velocity_is_derived_without_a_velocity_object() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis.command(to(50.0)).unwrap();
    for _ in 0..200 {
        let mut inputs = rig.drive.inputs();
        inputs.velocity = None;
        rig.drive.cycle(&rig.out, DT);
        rig.out = rig.axis.step(&inputs, DT);
    }
    let status = rig.axis.status();
    assert!((status.velocity - 200.0).abs() < 1.0, "{}", status.velocity);
    assert_eq!(status.trip, None);
}

#[test]
fn fault_while_stopping_for_a_trip_keeps_both_causes() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis.command(to(50.0)).unwrap();
    rig.run(10);
    rig.drive.blocked = true;
    rig.until(|s| s.trip.is_some(), 100);
    rig.drive.fault();
    let status = rig.until(|s| s.state == State::Fault, 5);
    assert!(status.trip.is_some() && status.fault.is_some());
    rig.axis.command(Command::ResetFault).unwrap();
    let status = rig.until(|s| s.state == State::SwitchOnDisabled, 200);
    assert_eq!((status.trip, status.fault), (None, None));
}

/// The drive counts velocities in another unit: it runs a hundred times as fast as it reports.
#[test]
fn positions_contradict_a_velocity_of_another_unit() {
    for (mode, command) in [
        (
            Mode::Csv,
            Command::Velocity {
                velocity: 20.0,
                ramp: 1.0,
            },
        ),
        (
            Mode::Pv,
            Command::Velocity {
                velocity: 20.0,
                ramp: 1.0,
            },
        ),
    ] {
        for (factor, far) in [(100.0, true), (4.0, false), (-1.0, false)] {
            let mut axis = Axis::new(AxisConfig::new(
                mode,
                scale(),
                Limits {
                    following_error: None,
                    position: None,
                    ..LIMITS
                },
            ))
            .unwrap();
            let mut drive = Drive::at(0);
            axis.command(Command::Enable).unwrap();
            let (mut position, mut reported, mut tripped) = (0.0, 0, None);
            for cycle in 0..400 {
                if cycle == 20 {
                    axis.command(command).unwrap();
                }
                let inputs = Inputs {
                    position: Some(position as i32),
                    velocity: Some(reported),
                    ..drive.inputs()
                };
                let out = axis.step(&inputs, DT);
                drive.cycle(&out, DT);
                reported = out.target_velocity;
                position += f64::from(reported) / 60_000.0 * 2000.0 * factor * DT;
                if let Some(trip) = axis.status().trip {
                    tripped = Some((cycle, trip));
                    break;
                }
            }
            let (cycle, trip) = tripped.expect("a trip");
            let late = if far { 60 } else { 110 };
            assert!(cycle < 20 + late, "{mode} {factor}: {cycle}");
            assert_eq!(
                matches!(trip, Trip::VelocityContradiction { .. }),
                !far,
                "{mode} {factor}: {trip}"
            );
        }
    }
}

/// A drive that shifts its position: the axis trips in the cycle that shows it, and drives nowhere.
#[test]
fn a_position_that_jumps_trips_at_once() {
    for mode in [Mode::Csp, Mode::Csv, Mode::Cst, Mode::Pp, Mode::Pv] {
        let config = AxisConfig {
            absolute: true,
            ..AxisConfig::new(
                mode,
                scale(),
                Limits {
                    following_error: None,
                    ..LIMITS
                },
            )
        };
        let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(0));
        rig.axis.command(Command::Enable).unwrap();
        rig.until(|s| s.ready, 100);
        rig.run(100);
        let before = rig.out;
        rig.drive.position += 2000.0;
        let status = rig.cycle();
        assert!(
            matches!(status.trip, Some(Trip::PositionJump { step, .. }) if step == 5.0),
            "{mode}: {:?}",
            status.trip
        );
        assert_eq!(rig.out.controlword, 0x0002);
        assert!(!status.homed(), "the position refers to nothing");
        if mode == Mode::Csp {
            assert_eq!(rig.out.target_position, before.target_position);
        }
    }
}
