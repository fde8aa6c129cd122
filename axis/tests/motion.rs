//! Moves, velocities, torques, and rejected commands.

use crate::common::{DT, Drive, LIMITS, Rig, scale};
use ecaxis_axis::{
    Axis, AxisConfig, Command, CommandError, Delivery, Inputs, Limits, Mode, Scale, State,
    VelocityUnit,
};

const fn to(position: f64) -> Command {
    Command::MoveTo {
        position,
        speed: 1.0,
        ramp: 1.0,
    }
}

#[test]
fn csp_lands_on_the_count() {
    for (target, counts) in [
        (50.0, 20_000),
        (-50.0, -20_000),
        (12.345_678, 4938),
        (0.0, 0),
    ] {
        let mut rig = Rig::enabled(Mode::Csp);
        rig.axis.command(to(target)).unwrap();
        let status = rig.until(|s| s.in_target, 1000);
        assert_eq!(rig.out.target_position, counts);
        let status = if status.at_rest { status } else { rig.run(3) };
        assert_eq!(status.final_error_counts, Some(0));
        assert!(status.at_rest && !status.moving);
        assert!((status.position - target).abs() < 0.002);
        assert_eq!(status.guarded_cycles, 0);
    }
}

#[test]
fn following_error_is_a_few_cycles_of_velocity() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis.command(to(50.0)).unwrap();
    let status = rig.until(|s| s.in_target && s.at_rest, 1000);
    // 200 mm/s, and the cycle between the command and its report.
    assert!(
        (0.19..0.61).contains(&status.max_following_error),
        "{}",
        status.max_following_error
    );
    assert_eq!(status.trip, None);
}

#[test]
fn speed_and_ramp_are_fractions() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis
        .command(Command::MoveTo {
            position: 40.0,
            speed: 0.25,
            ramp: 0.1,
        })
        .unwrap();
    let (mut fastest, mut steepest, mut before) = (0.0f64, 0.0f64, 0.0f64);
    while !rig.axis.status().in_target {
        let status = rig.cycle();
        fastest = fastest.max(status.target_velocity);
        steepest = steepest.max((status.target_velocity - before).abs() / DT);
        before = status.target_velocity;
    }
    assert!((fastest - 50.0).abs() < 1e-9);
    assert!((steepest - 200.0).abs() < 1e-6);
}

#[test]
fn csp_reverses_and_stops() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis.command(to(50.0)).unwrap();
    rig.run(250);
    rig.axis.command(to(-50.0)).unwrap();
    rig.run(150);
    rig.axis.command(Command::Stop).unwrap();
    let status = rig.until(|s| !s.moving, 200);
    assert_eq!(status.target_velocity, 0.0);
    assert!(status.ready);
    let held = rig.out.target_position;
    assert_eq!(rig.run(50).final_error_counts, None);
    assert_eq!(rig.out.target_position, held);
    rig.axis.command(to(-50.0)).unwrap();
    rig.until(|s| s.in_target, 1000);
}

#[test]
fn two_lost_frames_do_not_stop_the_trajectory() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis.command(to(50.0)).unwrap();
    rig.run(200);
    let before = rig.out.target_position;
    rig.cycle_with(false);
    let status = rig.cycle_with(false);
    assert_eq!(rig.out.target_position - before, 160);
    assert_eq!(status.stale_cycles, 2);
    let status = rig.until(|s| s.in_target, 1000);
    assert_eq!((status.stale_cycles, status.trip), (0, None));
}

/// Lost targets never reached the drive: its lag behind them is not a following error.
#[test]
fn lost_frames_are_not_a_following_error() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis.command(to(50.0)).unwrap();
    rig.run(200);
    for _ in 0..6 {
        rig.cycle_with(false);
    }
    let status = rig.cycle();
    assert!(status.following_error > 0.5 && status.trip.is_none());
    let status = rig.until(|s| s.in_target, 1000);
    assert!(status.max_following_error < 0.61);
    // Alternating lost frames do not hide a blocked motor.
    rig.axis.command(to(-50.0)).unwrap();
    rig.drive.blocked = true;
    for cycle in 0..300 {
        rig.cycle_with(cycle % 2 == 0);
    }
    assert!(rig.axis.status().trip.is_some());
}

#[test]
fn positions_continue_across_the_end_of_32_bits() {
    let scale = Scale::new(2000.0, 5.0)
        .unwrap()
        .with_velocity_unit(VelocityUnit::MILLI_RPM);
    let limits = Limits {
        position: None,
        ..LIMITS
    };
    let axis = Axis::new(AxisConfig::new(Mode::Csp, scale, limits)).unwrap();
    let mut rig = Rig::new(axis, Drive::at(i32::MAX - 100));
    rig.axis.command(Command::Enable).unwrap();
    let start = rig.until(|s| s.ready, 20).position;
    rig.axis.command(to(start + 10.0)).unwrap();
    let status = rig.until(|s| s.in_target && s.at_rest, 1000);
    assert_eq!(rig.out.target_position, i32::MIN + 3899);
    assert!((status.position - start - 10.0).abs() < 1e-6);
    assert_eq!(status.trip, None);
}

#[test]
fn inverted_axis_applies_its_offset() {
    let scale = scale().with_invert(true).with_offset(10.0).unwrap();
    let axis = Axis::new(AxisConfig::new(Mode::Csp, scale, LIMITS)).unwrap();
    let mut rig = Rig::new(axis, Drive::at(0));
    rig.axis.command(Command::Enable).unwrap();
    assert_eq!(rig.until(|s| s.ready, 20).position, 10.0);
    rig.axis.command(to(15.0)).unwrap();
    rig.until(|s| s.in_target, 1000);
    assert_eq!(rig.out.target_position, -2000);
}

#[test]
fn csv_ramps_and_reports() {
    let mut rig = Rig::enabled(Mode::Csv);
    rig.axis
        .command(Command::Velocity {
            velocity: 20.0,
            ramp: 0.05,
        })
        .unwrap();
    let status = rig.run(100);
    assert!(status.moving && !status.in_target);
    assert_eq!(
        rig.out.target_velocity, 120_000,
        "10 mm/s after 0.1 s of 100 mm/s²"
    );
    let status = rig.until(|s| s.in_target, 300);
    assert_eq!(rig.out.target_velocity, 240_000);
    assert!(!status.at_rest);
    rig.axis.command(Command::Stop).unwrap();
    let status = rig.until(|s| s.in_target && s.at_rest, 100);
    assert_eq!((rig.out.target_velocity, status.target_velocity), (0, 0.0));
}

#[test]
fn csv_stops_inside_its_range() {
    let mut rig = Rig::enabled(Mode::Csv);
    rig.axis
        .command(Command::Velocity {
            velocity: 200.0,
            ramp: 1.0,
        })
        .unwrap();
    let status = rig.run(2000);
    assert_eq!(status.trip, None);
    assert!(status.held_by_range);
    assert!(
        (49.0..50.5).contains(&status.position),
        "{}",
        status.position
    );
    assert!(status.target_velocity.abs() < 0.5);
    // And out of the range again.
    rig.axis
        .command(Command::Velocity {
            velocity: -10.0,
            ramp: 1.0,
        })
        .unwrap();
    rig.until(|s| s.in_target && s.position < 48.0, 1000);
}

#[test]
fn cst_ramps_and_stops() {
    let mut rig = Rig::enabled(Mode::Cst);
    rig.axis
        .command(Command::Torque {
            percent: 20.0,
            ramp_s: 0.1,
        })
        .unwrap();
    let status = rig.run(50);
    assert!((status.target_torque - 10.0).abs() < 1e-9);
    assert_eq!(rig.out.target_torque, 100);
    rig.until(|s| s.in_target, 60);
    assert_eq!(rig.out.target_torque, 200);
    rig.axis.command(Command::Stop).unwrap();
    rig.until(|s| s.in_target, 30);
    assert_eq!(rig.out.target_torque, 0);
    // Without a ramp: the configured slope, 1000 % per second.
    rig.axis
        .command(Command::Torque {
            percent: -5.0,
            ramp_s: 0.0,
        })
        .unwrap();
    rig.cycle();
    assert_eq!(rig.out.target_torque, -10);
}

/// Returns an axis that has just been commanded a torque. Its motor accelerates `strength` times as
/// much as its limits say.
fn with_torque(percent: f64, strength: f64) -> Rig {
    with_torque_slope(percent, strength, LIMITS.torque * 10.0)
}

/// `slope`: the largest change of the torque, percent per second.
fn with_torque_slope(percent: f64, strength: f64, slope: f64) -> Rig {
    let limits = Limits {
        position: None,
        // The drive of these tests reaches 250 mm/s² with its whole torque.
        acceleration: 250.0 / strength,
        ..LIMITS
    };
    let mut config = AxisConfig::new(Mode::Cst, scale(), limits);
    config.dead_time_s = 2.0 * DT;
    config.torque_slope = slope;
    let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(0));
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 100);
    let ramp_s = 0.0;
    rig.axis
        .command(Command::Torque { percent, ramp_s })
        .unwrap();
    rig
}

/// An axis at the velocity limit, with 5 % of friction and 50 % of commanded torque.
fn at_the_velocity_limit() -> Rig {
    let mut rig = with_torque(50.0, 1.0);
    for _ in 0..6000 {
        rig.drive.load = -50.0 * rig.drive.velocity.signum();
        rig.cycle();
    }
    rig
}

/// Turns a motor by torque that accelerates `strength` times as much as its limits say, against
/// friction in per mille. Returns the fastest and the last speed.
fn turned(percent: f64, strength: f64, friction: f64) -> [f64; 2] {
    let mut rig = with_torque(percent, strength);
    let (mut fastest, mut last): (f64, f64) = (0.0, 0.0);
    for _ in 0..12_000 {
        rig.drive.load = -friction * rig.drive.velocity.signum();
        let status = rig.cycle();
        assert!(status.trip.is_none(), "{:?}", status.trip);
        last = status.velocity;
        fastest = fastest.max(last.abs());
    }
    [fastest, last]
}

/// The speed rises to the velocity limit and stays there, with less torque than commanded.
#[test]
fn cst_reduces_the_torque_at_the_velocity_limit() {
    for percent in [30.0, 100.0, -60.0] {
        for strength in [0.5, 1.0, 3.0] {
            for friction in [0.0, 100.0] {
                let [fastest, last] = turned(percent, strength, friction);
                let limit = LIMITS.velocity;
                let at =
                    format!("{percent} % x {strength}, friction {friction}: {fastest}, {last}");
                assert!(fastest < limit * 1.03, "{at}");
                assert!(
                    (last - limit * percent.signum()).abs() < limit * 0.01,
                    "{at}"
                );
            }
        }
    }
}

/// Torques at random, on motors and slopes of any strength: no step of the torque exceeds the slope,
/// the speed stays near its limit, and a stop brings the torque to 0 on its slope.
#[test]
fn torques_keep_their_slope_at_the_velocity_limit() {
    let mut overshoot: f64 = 0.0;
    for seed in 1..=300_u64 {
        let mut state = seed;
        let mut random = |low: f64, high: f64| {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            low + (high - low) * (state >> 33) as f64 / f64::from(1_u32 << 31)
        };
        let (strength, friction) = (random(0.4, 4.0), random(0.0, 150.0));
        let slope = random(200.0, 5000.0);
        let mut rig = with_torque_slope(random(-100.0, 100.0), strength, slope);
        let most = slope * 10.0 * DT + 1.0;
        let mut before = i32::from(rig.axis.step(&rig.drive.inputs(), DT).target_torque);
        let mut fastest: f64 = 0.0;
        for n in 0..6000 {
            if n < 5000 && random(0.0, 1.0) < 0.002 {
                let (percent, ramp_s) = (random(-100.0, 100.0), random(0.0, 0.2));
                let _ = rig.axis.command(Command::Torque { percent, ramp_s });
            }
            if n == 5000 {
                rig.axis.command(Command::Stop).unwrap();
            }
            rig.drive.load = -friction * rig.drive.velocity.signum();
            let status = rig.cycle();
            let torque = i32::from(rig.out.target_torque);
            let change = f64::from((torque - before).abs());
            assert!(change <= most, "seed {seed}, {n}: {before} {torque}");
            assert!(status.trip.is_none(), "seed {seed}: {:?}", status.trip);
            before = torque;
            fastest = fastest.max(status.velocity.abs());
        }
        assert_eq!(before, 0, "seed {seed}");
        overshoot = overshoot.max(fastest / LIMITS.velocity - 1.0);
        assert!(
            fastest < LIMITS.velocity * 1.02,
            "seed {seed}: {fastest}, {strength} {friction} {slope}"
        );
    }
    println!("{:.1} % above the velocity limit", overshoot * 100.0);
}

/// At the velocity limit, late answers and a stop begin from the torque that was sent: it goes to zero
/// and never beyond.
#[test]
fn a_reduced_torque_ends_at_zero() {
    for late in [true, false] {
        let mut rig = at_the_velocity_limit();
        let sent = rig.axis.step(&rig.drive.inputs(), DT).target_torque;
        assert!((0..300).contains(&sent), "{sent} of 500");
        if !late {
            rig.axis.command(Command::Stop).unwrap();
        }
        let mut before = i32::from(sent);
        for n in 0..300 {
            let inputs = Inputs {
                fresh: !late,
                delivery: match late && n > 0 {
                    true => Delivery::Earlier,
                    false => Delivery::Unknown,
                },
                ..rig.drive.inputs()
            };
            let torque = i32::from(rig.axis.step(&inputs, DT).target_torque);
            assert!(
                (0..=before).contains(&torque),
                "late {late}, cycle {n}: {before} {torque}"
            );
            before = torque;
        }
        assert_eq!(before, 0, "late {late}");
    }
}

#[test]
fn rejected_commands_give_a_reason_and_change_nothing() {
    let mut rig = Rig::of(Mode::Csp);
    rig.run(5);
    assert_eq!(
        rig.axis.command(to(1.0)),
        Err(CommandError::NotEnabled {
            state: State::SwitchOnDisabled
        })
    );
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis.command(to(10.0)).unwrap();
    rig.run(20);
    let cases = [
        (to(50.001), "outside the range [-50, 50]"),
        (to(f64::NAN), "not a finite number"),
        (to(f64::INFINITY), "not a finite number"),
        (
            Command::MoveTo {
                position: 0.0,
                speed: 0.0,
                ramp: 1.0,
            },
            "speed is 0",
        ),
        (
            Command::MoveTo {
                position: 0.0,
                speed: 1.1,
                ramp: 1.0,
            },
            "speed is 1.1",
        ),
        (
            Command::MoveTo {
                position: 0.0,
                speed: 1.0,
                ramp: f64::NAN,
            },
            "ramp is NaN",
        ),
        (
            Command::Velocity {
                velocity: f64::NEG_INFINITY,
                ramp: 1.0,
            },
            "not a finite number",
        ),
        (Command::SetMode(Mode::Csv), "mode CSV is not among those"),
        (
            Command::Torque {
                percent: 1.0,
                ramp_s: 1.0,
            },
            "needs mode CST, the axis is in CSP",
        ),
    ];
    for (command, text) in cases {
        let before = format!("{:?}", rig.axis);
        let refused = rig.axis.command(command).expect_err("must be refused");
        assert!(refused.to_string().contains(text), "{refused}");
        assert_eq!(format!("{:?}", rig.axis), before);
    }
    let mut rig = Rig::enabled(Mode::Csv);
    assert!(matches!(
        rig.axis.command(to(1.0)),
        Err(CommandError::WrongMode { .. })
    ));
    assert!(matches!(
        rig.axis.command(Command::Velocity {
            velocity: -201.0,
            ramp: 1.0
        }),
        Err(CommandError::TooFast { limit: 200.0, .. })
    ));
    let mut rig = Rig::enabled(Mode::Cst);
    assert!(matches!(
        rig.axis.command(Command::Torque {
            percent: 100.1,
            ramp_s: 0.0
        }),
        Err(CommandError::TooMuchTorque { limit: 100.0, .. })
    ));
    assert!(matches!(
        rig.axis.command(Command::Torque {
            percent: 1.0,
            ramp_s: -1.0
        }),
        Err(CommandError::Negative { .. })
    ));
}
