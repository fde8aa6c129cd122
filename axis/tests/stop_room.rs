//! External set-points leave room for the stop ramp of the axis, the jerk phase included.

use crate::common::{DT, Drive, LIMITS, Rig, looped};
use ecaxis_axis::setpoint::{Goal, JerkLimited, Motion, MoveRequest};
use ecaxis_axis::{Axis, AxisConfig, Command, CommandError, Limits, Mode};
use proptest::prelude::*;

const END: f64 = 40.0;

fn config(velocity: f64, acceleration: f64, jerk_time: f64) -> AxisConfig {
    let limits = Limits {
        position: Some([-END, END]),
        velocity,
        acceleration,
        jerk: Some(acceleration / jerk_time),
        ..LIMITS
    };
    let mut config = looped(Mode::Csp, limits);
    config.jerk_limited = true;
    config
}

/// Returns the highest position of a jerk-limited stop from a motion that only slows down.
fn reach(config: &AxisConfig, motion: Motion) -> f64 {
    let limits = config.limits.motion();
    let slows = motion.acceleration.min(0.0);
    let most = (2.0 * limits.jerk * motion.velocity.abs()).sqrt();
    let acceleration = slows.max(-most);
    let start = Motion {
        acceleration,
        ..motion
    };
    let stop = MoveRequest::within(Goal::Velocity(0.0), limits);
    JerkLimited::new(stop, start, DT).expect("a stop").span()[1]
}

proptest! {
    #[test]
    fn external_set_points_leave_room_for_the_jerk_limited_stop(
        velocity in 20.0..200.0f64,
        acceleration in 100.0..2000.0f64,
        jerk_time in 0.01..0.3f64,
        parts in prop::collection::vec(-0.5..=1.0f64, 20),
        stop_after in 1..1500usize,
    ) {
        let config = config(velocity, acceleration, jerk_time);
        let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(0));
        rig.axis.command(Command::Enable).unwrap();
        rig.until(|s| s.ready, 100);
        let mut motion = Motion::at(rig.axis.status().target_position);
        for k in 0..stop_after {
            let change = acceleration * parts[k / 20 % parts.len()] * DT;
            let speed = (motion.velocity + change).clamp(0.0, velocity);
            let next = motion.then(motion.position + speed * DT, speed, DT);
            match rig.axis.set_point(next.position) {
                Ok(()) => {
                    // Half a percent of the room and the way of a cycle are the tolerance.
                    let tolerance = speed * DT + 0.005 * (END - next.position) + 1e-9;
                    let reach = reach(&config, next);
                    prop_assert!(reach <= END + tolerance, "{next:?} reaches {reach}");
                    rig.cycle();
                    motion = next;
                }
                Err(CommandError::NoRoomToStop { .. }) => {
                    let reach = reach(&config, next);
                    prop_assert!(reach > END, "{next:?} reaches only {reach}");
                    break;
                }
                Err(other) => prop_assert!(false, "{other}"),
            }
        }
        // The axis itself stops by this ramp.
        let expected = reach(&config, motion);
        rig.axis.command(Command::Stop).unwrap();
        let mut highest = motion.position;
        for _ in 0..20_000 {
            let status = rig.cycle();
            highest = highest.max(status.target_position);
            if status.at_rest {
                break;
            }
        }
        prop_assert!(rig.axis.status().at_rest);
        prop_assert!(highest <= END, "{highest}");
        if expected <= END {
            prop_assert!((highest - expected).abs() < 1e-3 * END, "{highest}, not {expected}");
        }
    }
}

#[derive(Debug, Clone, Copy)]
enum Next {
    To(f64),
    At(f64),
}

fn next() -> impl Strategy<Value = Next> {
    prop_oneof![
        (-END..END).prop_map(Next::To),
        (-200.0..200.0f64).prop_map(Next::At),
    ]
}

proptest! {
    /// Moves and velocities, each replaced after some cycles, then a stop: the set-point only slows
    /// down, and never turns. A velocity that the end of the range holds does not lead back.
    #[test]
    fn a_stop_never_gains_speed_and_a_held_velocity_never_turns(
        acceleration in 100.0..4000.0f64,
        jerk_time in 0.002..0.2f64,
        orders in prop::collection::vec((next(), 0.05..=1.0f64, 1..400u32), 1..5),
    ) {
        let velocity = 200.0;
        let config = config(velocity, acceleration, jerk_time);
        let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(0));
        rig.axis.command(Command::Enable).unwrap();
        rig.until(|s| s.ready, 100);
        let tolerance = 1e-6 / DT;
        let (mut before, mut speed) = (rig.axis.status().target_position, 0.0);
        for (order, ramp, cycles) in orders {
            let command = match order {
                Next::To(position) => Command::MoveTo { position, speed: 1.0, ramp },
                Next::At(velocity) => Command::Velocity { velocity, ramp },
            };
            // Refused where the present motion cannot stop inside the range.
            if rig.axis.command(command).is_err() {
                continue;
            }
            let mut towards = false;
            for _ in 0..cycles {
                let status = rig.cycle();
                let now = (status.target_position - before) / DT;
                let gained = (now - speed) * now.signum();
                (before, speed) = (status.target_position, now);
                if let Next::At(velocity) = order {
                    // An earlier move may still decelerate through rest.
                    towards |= speed * velocity > 0.0 && gained > 0.0;
                    let back = -speed * velocity.signum();
                    prop_assert!(!towards || back <= tolerance, "turned back at {back}: {order:?}");
                }
            }
        }
        rig.axis.command(Command::Stop).unwrap();
        for _ in 0..20_000 {
            let status = rig.cycle();
            let now = (status.target_position - before) / DT;
            before = status.target_position;
            prop_assert!(now.abs() <= speed.abs() + tolerance, "{speed} to {now}");
            prop_assert!(now * speed >= -tolerance * speed.abs(), "{speed} turns to {now}");
            speed = now;
            if status.at_rest {
                break;
            }
        }
        prop_assert!(rig.axis.status().at_rest);
    }
}
