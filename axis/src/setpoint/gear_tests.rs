use proptest::prelude::*;

use super::super::test_support::Sequence;
use super::super::{Goal, JerkLimited, MoveRequest, Setpoint};
use super::*;

/// Advances a gear whose axis is not held.
fn follow(gear: &mut Gear, motion: Motion, from: Motion, dt_s: f64) -> Motion {
    let master = Master {
        motion,
        comes_to_rest: false,
    };
    gear.with_master(master).advance(from, Rate::WHOLE, dt_s)
}

const DT: f64 = 0.001;

const LIMITS: MotionLimits = MotionLimits {
    velocity: 200.0,
    acceleration: 2000.0,
    jerk: 40_000.0,
};

fn config(ratio: f64, engage: GearInMode) -> GearConfig {
    GearConfig {
        ratio,
        engage,
        smoothing_s: 0.0,
        limits: LIMITS,
        range: None,
    }
}

/// A master at 50 and a follower at rest: the follower accelerates, catches up and stays engaged.
#[test]
fn gear_engages_with_a_moving_master() {
    for engage in [GearInMode::Here, GearInMode::At { offset: 100.0 }] {
        let mut master = Motion {
            velocity: 50.0,
            ..Motion::at(10.0)
        };
        let start = Motion::at(3.0);
        let mut gear = Gear::new(config(-2.0, engage), master, start).unwrap();
        let mut sequence = Sequence::from(start, LIMITS, DT);
        let mut engaged_at = None;
        for cycle in 0..4000 {
            master.position += master.velocity * DT;
            let next = follow(&mut gear, master, sequence.motion, DT);
            sequence.then(next).unwrap();
            if gear.engaged() {
                engaged_at.get_or_insert(cycle);
                assert_eq!(next.position, -2.0 * master.position + gear.offset());
            } else {
                assert_eq!(engaged_at, None);
            }
        }
        // 100/1000 s to reach the relative velocity; then the distance, at most 100 faster.
        let most = if engage == GearInMode::Here {
            250
        } else {
            1200
        };
        assert!(
            engaged_at.is_some_and(|cycle| cycle < most),
            "{engaged_at:?}"
        );
        assert_eq!(gear.lag_cycles(), 0);
    }
}

#[test]
fn gear_catches_up_after_a_jump_of_the_master() {
    let mut gear = Gear::new(
        config(1.0, GearInMode::Here),
        Motion::at(0.0),
        Motion::at(0.0),
    )
    .unwrap();
    let mut sequence = Sequence::from(Motion::at(0.0), LIMITS, DT);
    for cycle in 0..1000 {
        let master = Motion::at(if cycle < 10 { 0.0 } else { 20.0 });
        sequence
            .then(follow(&mut gear, master, sequence.motion, DT))
            .unwrap();
        assert!(sequence.motion.position <= 20.0 + 1e-9);
    }
    assert!(gear.engaged() && sequence.motion.stands_at(20.0));
    assert_eq!(gear.lag_cycles(), 1);
    // A NaN does not move the follower.
    let next = follow(&mut gear, Motion::at(f64::NAN), sequence.motion, DT);
    assert!(next.stands_at(20.0));
}

#[test]
fn gear_smooths_a_reported_master() {
    // 0.0025 per count, in whole counts: 2.5 per second and cycle, an acceleration of 2500.
    let mut gear = Gear::new(
        GearConfig {
            smoothing_s: 0.02,
            ..config(1.0, GearInMode::Here)
        },
        Motion {
            velocity: 33.3,
            ..Motion::at(0.0)
        },
        Motion::at(0.0),
    )
    .unwrap();
    let mut sequence = Sequence::from(Motion::at(0.0), LIMITS, DT);
    let mut worst = 0.0f64;
    for cycle in 0..3000 {
        let position = f64::from(cycle) * DT * 33.3;
        let reported = Motion::at((position / 0.0025).round() * 0.0025);
        sequence
            .then(follow(&mut gear, reported, sequence.motion, DT))
            .unwrap();
        if cycle > 500 {
            worst = worst.max((sequence.motion.position - position).abs());
        }
    }
    assert!(gear.engaged());
    assert_eq!(gear.lag_cycles(), 0);
    assert!(worst < 0.0025, "{worst}");
}

/// A drive samples its position in its own loop: two or three of its cycles per bus cycle. Half of
/// the bus cycles report too long a way, half too short. The error grows with the velocity.
#[test]
fn gear_follows_a_master_sampled_by_its_own_loop() {
    const SAMPLE: f64 = 0.0004;
    for part in [0.2, 0.45, 0.6, 0.8, 0.95] {
        for acceleration in [300.0, 2000.0] {
            let velocity = LIMITS.velocity * part;
            let limits = MotionLimits {
                acceleration,
                ..LIMITS
            };
            let config = GearConfig {
                smoothing_s: 0.01,
                limits,
                ..config(1.0, GearInMode::Here)
            };
            let start = Motion {
                velocity,
                ..Motion::at(0.0)
            };
            let mut gear = Gear::new(config, start, start).unwrap();
            // `sequence` checks velocity and acceleration in every cycle.
            let mut sequence = Sequence::from(start, limits, DT);
            let (mut apart, mut worst) = (0, 0.0f64);
            for cycle in 1..4000 {
                let time = f64::from(cycle) * DT;
                let sampled = (time / SAMPLE).floor() * SAMPLE * velocity;
                let next = follow(&mut gear, Motion::at(sampled), sequence.motion, DT);
                sequence.then(next).unwrap();
                if cycle > 500 {
                    apart += u32::from(!gear.engaged());
                    worst = worst.max((next.position - time * velocity).abs());
                }
            }
            assert_eq!(apart, 0, "{part} {acceleration}");
            // The delay of one sample, reduced by the smoothing.
            assert!(worst <= 1.5 * SAMPLE * velocity, "{part}: {worst}");
        }
    }
}

/// A master far beyond both ends of the follower's range, and back.
#[test]
fn gear_stops_at_the_end_of_the_range() {
    for sign in [1.0, -1.0] {
        let config = GearConfig {
            range: Some([-10.0, 10.0]),
            ..config(sign, GearInMode::Here)
        };
        let mut gear = Gear::new(config, Motion::at(0.0), Motion::at(0.0)).unwrap();
        let mut sequence = Sequence::from(Motion::at(0.0), LIMITS, DT);
        for cycle in 0..3000 {
            // To 90 and back without a pause, with velocity steps to catch up with.
            let master = f64::from((cycle - 1000i32).abs().min(900)) * -0.1 + 90.0;
            sequence
                .then(follow(&mut gear, Motion::at(master), sequence.motion, DT))
                .unwrap();
            assert!(sequence.motion.position.abs() <= 10.0, "{cycle}");
            if cycle == 1000 {
                assert!((sequence.motion.position - 10.0 * sign).abs() < 1e-6);
                assert!(!gear.engaged());
            }
        }
        assert!(gear.engaged() && sequence.motion.stands_at(0.0));
        assert!(gear.lag_cycles() >= 1);
    }
}

#[test]
fn gear_rejects_invalid_configurations() {
    let at = Motion::at(0.0);
    for ratio in [0.0, f64::NAN, f64::INFINITY, 1e-300] {
        assert!(Gear::new(config(ratio, GearInMode::Here), at, at).is_err());
    }
    for value in [f64::NAN, 1e300] {
        assert!(Gear::new(config(1.0, GearInMode::At { offset: value }), at, at).is_err());
        assert!(Gear::new(config(1.0, GearInMode::Here), Motion::at(value), at).is_err());
        assert!(Gear::new(config(1.0, GearInMode::Here), at, Motion::at(value)).is_err());
        let smoothed = GearConfig {
            smoothing_s: value,
            ..config(1.0, GearInMode::Here)
        };
        assert!(Gear::new(smoothed, at, at).is_err());
    }
    assert!(
        Gear::new(
            config(1e12, GearInMode::At { offset: 0.0 }),
            Motion::at(1e12),
            at
        )
        .is_err()
    );
}

proptest! {
    /// A master with arbitrary moves, jumps and stops; engaged and disengaged at any time. The
    /// follower keeps limits and range, and reaches its ideal position once the master stands.
    #[test]
    fn gear_keeps_the_limits(
        ratio in prop_oneof![-3.0..-0.1f64, 0.1..3.0f64], absolute in prop::option::of(-30.0..30.0f64), ranged in any::<bool>(),
        smoothing_s in prop::sample::select(vec![0.0, 0.01]),
        moves in prop::collection::vec((-15.0..15.0f64, 0u32..400, prop::option::weighted(0.1, -5.0..5.0f64), prop::option::weighted(0.3, -5.0..5.0f64)), 1..8),
        velocity in -150.0..150.0f64,
    ) {
        let range = ranged.then_some([-60.0, 60.0]);
        let engage = absolute.map_or(GearInMode::Here, |offset| GearInMode::At { offset });
        let mut master = Motion::at(0.0);
        let mut source = JerkLimited::new(MoveRequest::within(Goal::Position(0.0), LIMITS), master, DT).unwrap();
        let start = Motion { velocity, ..Motion::at(5.0) };
        let mut gear = Gear::new(GearConfig { range, smoothing_s, ..config(ratio, engage) }, master, start).unwrap();
        let mut sequence = Sequence::from(start, LIMITS, DT);
        for (target, cycles, jump, shift) in moves.into_iter().chain([(1.0, 6000, None, None)]) {
            master.position += jump.unwrap_or(0.0);
            if let Some(distance) = shift {
                gear.shift(distance, DT).unwrap();
            }
            source = source.redirect(MoveRequest::within(Goal::Position(target), LIMITS), master, DT).unwrap();
            for _ in 0..cycles {
                master = source.advance(master, Rate::WHOLE, DT);
                sequence.then(follow(&mut gear, master, sequence.motion, DT))?;
                if ranged {
                    prop_assert!(sequence.motion.position.abs() <= 60.0 + 1e-9, "{:?}", sequence.motion);
                }
            }
        }
        let ideal = ratio * master.position + gear.offset();
        if !ranged || ideal.abs() < 59.9 {
            prop_assert!((sequence.motion.position - ideal).abs() < 1e-9, "{} {:?} {:?}", ideal, sequence.motion, gear);
            prop_assert!(gear.engaged());
        } else {
            prop_assert!(sequence.motion.velocity.abs() < 1e-3);
        }
    }

    /// Shifts of a follower of a master at constant velocity: the jerk is bounded, the follower
    /// stays engaged, and the offset is exact.
    #[test]
    fn shifts_are_jerk_limited(
        velocity in -60.0..60.0f64, shifts in prop::collection::vec((-20.0..20.0f64, 1u32..400), 1..6),
    ) {
        let master = |cycle: u32| Motion { velocity, ..Motion::at(velocity * f64::from(cycle) * DT) };
        let mut gear = Gear::new(config(1.0, GearInMode::Here), master(0), master(0)).unwrap();
        let mut motion = master(0);
        let (mut cycle, mut total) = (0, 0.0);
        for (distance, cycles) in shifts.into_iter().chain([(1.0, 6000)]) {
            gear.shift(distance, DT).unwrap();
            total += distance;
            for _ in 0..cycles {
                cycle += 1;
                let next = follow(&mut gear, master(cycle), motion, DT);
                let jerk = (next.acceleration - motion.acceleration) / DT;
                prop_assert!(next.velocity.abs() <= LIMITS.velocity * (1.0 + 1e-9));
                prop_assert!(next.acceleration.abs() <= LIMITS.acceleration * 0.5 * (1.0 + 1e-6));
                // The rounding of positions.
                prop_assert!(jerk.abs() <= LIMITS.jerk * (1.0 + 1e-6) + 1e-3, "{}", jerk);
                motion = next;
            }
        }
        prop_assert!(gear.engaged());
        prop_assert_eq!(gear.lag_cycles(), 0);
        prop_assert!((gear.offset() - total).abs() < 1e-9);
        prop_assert!((motion.position - master(cycle).position - total).abs() < 1e-9);
    }

    #[test]
    fn gear_stays_finite_with_any_number(
        ratio: f64, offset: f64, distance: f64, smoothing_s in 0.0..1.0f64,
        cycles in prop::collection::vec((any::<f64>(), any::<f64>(), any::<f64>()), 1..20),
    ) {
        let config = GearConfig { smoothing_s, ..config(ratio, GearInMode::At { offset }) };
        if let Ok(mut gear) = Gear::new(config, Motion::at(0.0), Motion::at(0.0)) {
            let mut motion = Motion::at(0.0);
            let _ = gear.shift(distance, DT);
            for (position, velocity, dt) in cycles {
                let master = Motion { position, velocity, acceleration: 0.0 };
                motion = follow(&mut gear, master, motion, dt.abs().min(0.1));
                prop_assert!(motion.position.is_finite() && motion.velocity.is_finite());
            }
        }
    }
}

/// Held with its master, a follower is exactly at its ideal position until both stand. Held alone,
/// or while it catches up, it decelerates and waits; then it catches up.
#[test]
fn a_held_follower_rests() {
    for (together, engaged) in [(true, true), (false, true), (true, false)] {
        let config = GearConfig {
            ratio: 0.5,
            engage: if engaged {
                GearInMode::Here
            } else {
                GearInMode::At { offset: 90.0 }
            },
            smoothing_s: 0.0,
            limits: LIMITS,
            range: None,
        };
        let mut gear = Gear::new(config, Motion::at(0.0), Motion::at(0.0)).unwrap();
        let goal = MoveRequest::within(Goal::Velocity(LIMITS.velocity), LIMITS);
        let mut source = JerkLimited::new(goal, Motion::at(0.0), DT).unwrap();
        let (mut master, mut at) = (Motion::at(0.0), Motion::at(0.0));
        let mut cycle = |gear: &mut Gear, held: bool| {
            let rate = |held| if held { Rate::HELD } else { Rate::WHOLE };
            master = source.advance(master, rate(held && together), DT);
            let next = Master {
                motion: master,
                comes_to_rest: together,
            };
            let before = at;
            at = gear.with_master(next).advance(at, rate(held), DT);
            let change = (at.velocity - before.velocity).abs();
            assert!(change <= LIMITS.acceleration * DT * (1.0 + 1e-9));
            (master, at)
        };
        let begun = if engaged { 1000 } else { 300 };
        for _ in 0..begun {
            cycle(&mut gear, false);
        }
        assert_eq!(gear.engaged(), engaged);
        for _ in 0..1000 {
            let (master, at) = cycle(&mut gear, true);
            if together && engaged {
                assert!((at.position - master.position * 0.5).abs() < 1e-9);
            }
        }
        let (_, resting) = cycle(&mut gear, true);
        assert_eq!(resting.velocity, 0.0, "{together} {engaged}");
        for _ in 0..20_000 {
            cycle(&mut gear, false);
        }
        let (master, at) = cycle(&mut gear, false);
        assert!(gear.engaged(), "{together} {engaged}");
        let offset = if engaged { 0.0 } else { 90.0 };
        assert!((at.position - master.position * 0.5 - offset).abs() < 1e-9);
    }
}
