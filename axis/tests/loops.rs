//! Position loops in the master, with moves, velocities, external set-points and jerk-limited
//! moves.

use crate::common::{DEAD_TIME_S, DT, Drive, LIMITS, Rig, looped};
use ecaxis_axis::{
    Axis, AxisConfig, AxisStatus, Command, CommandError, ConfigError, FeedForward, Limits, Loops,
    Mode, PositionPid, VelocityLoop,
};

const COUNTS_PER_UNIT: f64 = 400.0;

/// Lower limits: with torque at the limit of [`LIMITS`] this drive would not reach 2000 mm/s².
const SLOW: Limits = Limits {
    position: None,
    velocity: 200.0,
    acceleration: 100.0,
    torque: 100.0,
    following_error: Some(1.0),
    ..LIMITS
};

fn enabled(config: AxisConfig) -> Rig {
    let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(1000));
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 100);
    rig
}

const fn to(position: f64) -> Command {
    Command::MoveTo {
        position,
        speed: 1.0,
        ramp: 1.0,
    }
}

const fn run_at(velocity: f64) -> Command {
    Command::Velocity {
        velocity,
        ramp: 1.0,
    }
}

const CYCLIC: [Mode; 3] = [Mode::Csp, Mode::Csv, Mode::Cst];

#[test]
fn a_move_works_in_every_mode_with_a_position_loop() {
    for mode in CYCLIC {
        let mut rig = enabled(looped(mode, SLOW));
        rig.axis.command(to(40.0)).unwrap();
        let status = rig.until(|s| s.in_target && s.at_rest, 3000);
        assert_eq!((status.trip, status.guarded_cycles), (None, 0), "{mode}");
        let status = rig.run(1000);
        assert!(status.in_target && !status.moving);
        let off = status.final_error_counts.unwrap();
        assert!(off.abs() <= 1, "{mode}: {off} counts");
        assert!(
            status.max_following_error < 0.1,
            "{mode}: {}",
            status.max_following_error
        );
    }
}

#[test]
fn a_velocity_works_in_every_mode_with_a_position_loop() {
    for mode in CYCLIC {
        let limits = Limits {
            position: Some([-50.0, 50.0]),
            ..SLOW
        };
        let mut rig = enabled(looped(mode, limits));
        rig.axis.command(run_at(20.0)).unwrap();
        let status = rig.until(|s| s.in_target, 1000);
        assert!((status.velocity - 20.0).abs() < 1.0, "{mode}");
        // The axis stops inside the range.
        let status = rig.until(|s| s.held_by_range && s.at_rest, 5000);
        assert_eq!((status.trip, status.guarded_cycles), (None, 0));
        assert!((status.position - 50.0).abs() < 0.02, "{}", status.position);
        rig.axis.command(run_at(-20.0)).unwrap();
        rig.until(|s| s.in_target && s.position < 0.0, 5000);
    }
}

#[test]
fn the_torque_loop_holds_against_a_load() {
    let mut rig = enabled(looped(Mode::Cst, SLOW));
    let held = rig.axis.status().target_position;
    rig.drive.load = -100.0;
    let status = rig.run(3000);
    assert_eq!(status.trip, None);
    assert!((status.position - held).abs() * COUNTS_PER_UNIT <= 5.0);
    assert!((status.target_torque - 10.0).abs() < 0.2);
}

#[test]
fn the_velocity_loop_holds_against_a_drift() {
    let mut rig = enabled(looped(Mode::Csv, SLOW));
    let held = rig.axis.status().target_position;
    for _ in 0..2000 {
        rig.drive.position += 0.04;
        rig.cycle();
    }
    let status = rig.axis.status();
    assert!((status.position - held).abs() * COUNTS_PER_UNIT <= 5.0);
}

#[test]
fn offsets_feed_forward_only_in_csp() {
    let config = AxisConfig {
        loops: Loops {
            csp: FeedForward {
                velocity: 0.5,
                acceleration: 0.4,
            },
            ..looped(Mode::Csp, SLOW).loops
        },
        ..looped(Mode::Csp, SLOW)
    };
    let mut rig = enabled(config);
    rig.axis.command(run_at(60.0)).unwrap();
    rig.run(200);
    assert_eq!(rig.out.torque_offset, 400, "100 mm/s² at 0.4 % each");
    rig.until(|s| s.in_target && !s.moving, 1000);
    rig.run(2);
    assert_eq!(
        (rig.out.velocity_offset, rig.out.torque_offset),
        (30 * 12_000, 0)
    );
    rig.drive.mode_delay = Some(5);
    rig.axis.command(Command::SetMode(Mode::Csv)).unwrap();
    let mut before = rig.out.velocity_offset;
    rig.cycle();
    assert_eq!(
        rig.out.velocity_offset, 0,
        "it would be added to the target velocity"
    );
    rig.axis.command(Command::Stop).unwrap();
    rig.until(|s| s.mode == Mode::Csv && !s.moving, 2000);
    rig.axis.command(Command::SetMode(Mode::Csp)).unwrap();
    rig.until(|s| s.mode == Mode::Csp, 100);
    rig.axis.command(run_at(-60.0)).unwrap();
    before -= before;
    for _ in 0..1000 {
        rig.cycle();
        let change = rig.out.velocity_offset.abs_diff(before);
        assert!(f64::from(change) <= SLOW.acceleration * DT * 12_000.0 + 1.0);
        before = rig.out.velocity_offset;
    }
    assert_eq!(before, -30 * 12_000);
}

/// External set-points are accepted unchanged or rejected.
#[test]
fn external_set_points_are_accepted_or_rejected() {
    for mode in CYCLIC {
        let mut rig = enabled(looped(mode, SLOW));
        let start = rig.axis.status().target_position;
        let wave = |k: i32| start + 5.0 * (1.0 - (f64::from(k) * DT * 4.0).cos());
        for k in 1..3000 {
            rig.axis.set_point(wave(k)).unwrap();
            let status = rig.cycle();
            assert_eq!(status.target_position, wave(k));
            assert_eq!((status.trip, status.guarded_cycles), (None, 0));
        }
        // Without a set-point the axis decelerates within its limits.
        let velocity = rig.axis.status().target_velocity;
        assert!(velocity.abs() > 5.0);
        let after = rig.cycle().target_velocity;
        assert!((after.abs() - (velocity.abs() - 0.1)).abs() < 1e-9);
        rig.until(|s| s.in_target && s.at_rest, 2000);
        // Too far, too sudden, NaN.
        let here = rig.axis.status().target_position;
        assert!(matches!(
            rig.axis.set_point(here + 0.201),
            Err(CommandError::Step { .. })
        ));
        assert!(matches!(
            rig.axis.set_point(here + 0.001),
            Err(CommandError::Jump { .. })
        ));
        assert!(matches!(
            rig.axis.set_point(f64::NAN),
            Err(CommandError::NotFinite { .. })
        ));
        assert_eq!(rig.cycle().target_position, here);
    }
}

#[test]
fn external_set_points_leave_room_to_stop_within_the_range() {
    const END: f64 = 5.0;
    let mut config = looped(Mode::Csp, SLOW);
    config.limits.position = Some([-END, END]);
    let (most, acceleration) = (config.limits.velocity, config.limits.acceleration);
    for sign in [1.0, -1.0] {
        let mut rig = enabled(config);
        let mut at = rig.axis.status().target_position;
        let mut velocity = 0.0_f64;
        let refused = loop {
            velocity = (velocity + acceleration * DT).min(most);
            match rig.axis.set_point(at + sign * velocity * DT) {
                Ok(()) => at = rig.cycle().target_position,
                Err(error) => break error,
            }
        };
        assert!(
            matches!(refused, CommandError::NoRoomToStop { .. }),
            "{refused}"
        );
        // Without a set-point the axis decelerates within its limits, and within the range.
        for _ in 0..2000 {
            let target = rig.cycle().target_position;
            assert!((-END..=END).contains(&target), "{target}");
        }
        let status = rig.cycle();
        assert!(status.at_rest && status.trip.is_none(), "{status:?}");
        assert!((END - status.target_position.abs()) < 0.1, "{status:?}");
    }
}

#[test]
fn external_set_points_may_stop_at_the_end_of_the_range() {
    const END: f64 = 5.0;
    let mut config = looped(Mode::Csp, SLOW);
    config.limits.position = Some([-END, END]);
    let acceleration = config.limits.acceleration;
    let mut rig = enabled(config);
    let start = rig.axis.status().target_position;
    // Constant acceleration, then the same deceleration.
    let half = 400;
    let scale = (END - start) / f64::from(half * half);
    assert!(2.0 * scale / (DT * DT) <= acceleration);
    for k in 1..=2 * half {
        let position = match k <= half {
            true => start + scale * f64::from(k * k) / 2.0,
            false => END - scale * f64::from((2 * half - k) * (2 * half - k)) / 2.0,
        };
        rig.axis.set_point(position).unwrap();
        rig.cycle();
    }
    assert_eq!(rig.axis.status().target_position, END);
}

#[test]
fn external_set_points_end_with_lost_frames() {
    let mut rig = enabled(looped(Mode::Csp, SLOW));
    for _ in 0..2 {
        rig.cycle_with(false);
        let here = rig.axis.status().target_position;
        rig.axis.set_point(here).unwrap();
    }
    rig.cycle_with(false);
    let here = rig.axis.status().target_position;
    assert_eq!(rig.axis.set_point(here), Err(CommandError::FramesLost));
}

#[test]
fn dead_time_is_not_a_following_error() {
    let config = AxisConfig {
        dead_time_s: 0.0,
        ..looped(Mode::Csp, SLOW)
    };
    for (config, low, high) in [
        (config, 0.05, 0.07),
        (looped(Mode::Csp, SLOW), 0.0, 1.5 / COUNTS_PER_UNIT),
    ] {
        let mut rig = enabled(config);
        rig.axis.command(run_at(60.0)).unwrap();
        let status = rig.until(|s| s.in_target, 2000);
        let error = status.following_error.abs();
        assert!((low..=high).contains(&error), "{error}");
    }
    assert_eq!(DEAD_TIME_S, 0.002);
}

/// A drive that kept its velocity over lost frames does not move back.
#[test]
fn velocity_loop_does_not_move_back_after_lost_frames() {
    for mode in [Mode::Csv, Mode::Cst] {
        let limits = Limits {
            following_error: None,
            ..SLOW
        };
        let mut rig = enabled(looped(mode, limits));
        rig.axis.command(run_at(60.0)).unwrap();
        rig.until(|s| s.in_target, 2000);
        for lost in [1, 2, 3, 50] {
            for _ in 0..lost {
                let inputs = ecaxis_axis::Inputs {
                    fresh: false,
                    ..rig.drive.inputs()
                };
                // The frame is lost, and the motor keeps turning.
                rig.drive.position += rig.drive.velocity * DT;
                rig.out = rig.axis.step(&inputs, DT);
            }
            let mut slowest = f64::MAX;
            for _ in 0..500 {
                rig.cycle();
                slowest = slowest.min(rig.drive.velocity / COUNTS_PER_UNIT);
            }
            assert!(slowest > 50.0, "{mode} after {lost}: {slowest}");
        }
    }
}

#[test]
fn invalid_loops_are_rejected() {
    let good = looped(Mode::Csp, SLOW);
    let with = |loops| AxisConfig { loops, ..good };
    let csv = |kv, feed_forward| {
        with(Loops {
            csv: Some(VelocityLoop { kv, feed_forward }),
            ..Loops::default()
        })
    };
    let cst = |kp, tn_s, tv_s| {
        with(Loops {
            cst: Some(PositionPid {
                kp,
                tn_s,
                tv_s,
                acceleration: 0.0,
            }),
            ..Loops::default()
        })
    };
    for config in [
        csv(0.0, 1.0),
        csv(f64::NAN, 1.0),
        csv(1.0, 1.1),
        csv(1.0, -0.1),
        cst(0.0, None, 0.0),
        cst(1.0, Some(0.0), 0.0),
        cst(1.0, None, -1.0),
        AxisConfig {
            dead_time_s: 1.0,
            ..good
        },
        AxisConfig {
            mode_time_s: 0.0,
            ..good
        },
    ] {
        assert!(matches!(
            Axis::new(config).err(),
            Some(ConfigError::NotPositive { .. } | ConfigError::Outside { .. })
        ));
    }
}

/// In every mode with a position loop, with redirections and stops: velocity, acceleration and jerk
/// keep their limits.
#[test]
fn jerk_limited_moves_keep_the_limits_in_every_mode() {
    const JERK: f64 = 2000.0;
    for mode in CYCLIC {
        let limits = Limits {
            jerk: Some(JERK),
            position: Some([-50.0, 50.0]),
            ..SLOW
        };
        let config = AxisConfig {
            jerk_limited: true,
            ..looped(mode, limits)
        };
        let mut rig = enabled(config);
        let mut before = rig.axis.status();
        let watch = |before: &mut AxisStatus, rig: &mut Rig, cycles: u32| {
            let mut steepest = 0.0f64;
            for _ in 0..cycles {
                let status = rig.cycle();
                let jerk = (status.target_acceleration - before.target_acceleration) / DT;
                assert!(jerk.abs() <= JERK * (1.0 + 1e-5), "{mode}: {jerk}");
                assert!(status.target_acceleration.abs() <= SLOW.acceleration * (1.0 + 1e-6));
                assert_eq!((status.trip, status.guarded_cycles), (None, 0));
                steepest = steepest.max(jerk.abs());
                *before = status;
            }
            (*before, steepest)
        };
        rig.axis.command(to(50.0)).unwrap();
        let (_, steepest) = watch(&mut before, &mut rig, 800);
        assert!(steepest > 0.9 * JERK, "uses what it may");
        rig.axis.command(to(-50.0)).unwrap();
        watch(&mut before, &mut rig, 900);
        // An acceleration that increases the speed ends at once, with any jerk limit.
        rig.axis.command(Command::Stop).unwrap();
        let speed = rig.axis.status().target_velocity.abs();
        before = rig.cycle();
        assert!(
            before.target_velocity.abs() <= speed * (1.0 + 1e-9),
            "{mode}"
        );
        let (status, _) = watch(&mut before, &mut rig, 1500);
        assert!(status.at_rest && !status.moving, "{mode}");
        rig.axis.command(to(12.5)).unwrap();
        let (status, _) = watch(&mut before, &mut rig, 3000);
        assert!(status.in_target && status.at_rest);
        assert!(status.final_error_counts.unwrap().abs() <= 1);
    }
}

/// Lost frames interrupt the move where the drive stands; the move continues from there.
#[test]
fn jerk_limited_move_continues_after_lost_frames() {
    let config = AxisConfig {
        jerk_limited: true,
        ..looped(Mode::Csp, LIMITS)
    };
    let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(0));
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 100);
    rig.axis.command(to(50.0)).unwrap();
    for cycle in 0..3000 {
        rig.cycle_with(cycle % 300 > 20);
    }
    let status = rig.axis.status();
    assert!(status.in_target && status.trip.is_none());
    assert_eq!(rig.out.target_position, 20_000);
}
