use proptest::prelude::*;

use super::*;

const DT: f64 = 0.001;

const LIMITS: MotionLimits = MotionLimits {
    velocity: 200.0,
    acceleration: 2000.0,
    jerk: 40_000.0,
};

/// Checks the positions sent to a drive, independently of the source's own values.
struct Watch {
    limits: MotionLimits,
    dt: f64,
    motion: Motion,
    rate: Rate,
    /// Derived from positions.
    velocity: f64,
    acceleration: f64,
    /// True: the jerk is checked as well.
    check_jerk: bool,
}

impl Watch {
    fn at(motion: Motion, limits: MotionLimits, dt: f64) -> Self {
        Self {
            limits,
            dt,
            motion,
            rate: Rate::WHOLE,
            velocity: motion.velocity,
            acceleration: motion.acceleration,
            check_jerk: true,
        }
    }

    fn cycle(&mut self, source: &mut JerkLimited) -> Result<(), TestCaseError> {
        let next = source.advance(self.motion, self.rate, self.dt);
        // Rounding for a position of at most 1400.
        let rounding = 1400.0 * 4.0 * f64::EPSILON;
        let velocity = (next.position - self.motion.position) / self.dt;
        let acceleration = (velocity - self.velocity) / self.dt;
        let jerk = (acceleration - self.acceleration) / self.dt;
        let rounding = rounding / self.dt;
        prop_assert!((velocity - next.velocity).abs() <= rounding);
        prop_assert!(
            velocity.abs() <= self.limits.velocity + rounding,
            "{velocity} {source:?}"
        );
        let rounding = 2.0 * rounding / self.dt;
        prop_assert!(
            acceleration.abs() <= self.limits.acceleration + rounding,
            "{acceleration} {source:?}"
        );
        let rounding = 2.0 * rounding / self.dt;
        if self.check_jerk {
            prop_assert!(
                jerk.abs() <= self.limits.jerk + rounding,
                "{jerk} {source:?}"
            );
        }
        self.velocity = velocity;
        self.acceleration = acceleration;
        self.motion = next;
        Ok(())
    }

    fn finish(&mut self, source: &mut JerkLimited) -> Result<u32, TestCaseError> {
        for cycle in 0..2_000_000 {
            if source.finished(self.motion) {
                return Ok(cycle);
            }
            self.cycle(source)?;
        }
        Err(TestCaseError::fail(format!("does not arrive: {source:?}")))
    }
}

fn go(target: f64, limits: MotionLimits) -> MoveRequest {
    MoveRequest {
        ceiling: LIMITS,
        ..MoveRequest::within(Goal::Position(target), limits)
    }
}

fn part() -> impl Strategy<Value = MotionLimits> {
    (0.01..=1.0f64, 0.02..=1.0f64, 0.02..=1.0f64).prop_map(|(v, a, j)| MotionLimits {
        velocity: LIMITS.velocity * v,
        acceleration: LIMITS.acceleration * a,
        jerk: LIMITS.jerk * j,
    })
}

#[test]
fn move_takes_the_calculated_time() {
    // Seven segments: v/a + a/j + s/v = 0.1 + 0.05 + 0.5 s.
    let mut source = JerkLimited::new(go(100.0, LIMITS), Motion::at(0.0), DT).unwrap();
    assert!((source.duration_s() - 0.65).abs() < 1e-4);
    let mut watch = Watch::at(Motion::at(0.0), LIMITS, DT);
    let cycles = watch.finish(&mut source).unwrap();
    assert!((651..=652).contains(&cycles), "{cycles}");
    // Four segments: neither velocity nor acceleration reaches its limit; s = 2·j·t³ with t a
    // quarter of the time.
    let source = JerkLimited::new(go(0.01, LIMITS), Motion::at(0.0), DT).unwrap();
    let expected = 4.0 * (0.01f64 / (2.0 * 40_000.0)).cbrt();
    assert!((source.duration_s() - expected).abs() < 1e-6);
    assert!((source.span()[1] - 0.01).abs() < 1e-12);
}

#[test]
fn move_to_the_present_position_takes_no_time() {
    let source = JerkLimited::new(go(3.0, LIMITS), Motion::at(3.0), DT).unwrap();
    assert_eq!(source.duration_s(), 0.0);
    assert!(source.finished(Motion::at(3.0)));
}

#[test]
fn move_continues_from_rest_after_an_interruption() {
    let mut source = JerkLimited::new(go(50.0, LIMITS), Motion::at(0.0), DT).unwrap();
    let mut watch = Watch::at(Motion::at(0.0), LIMITS, DT);
    for _ in 0..200 {
        watch.cycle(&mut source).unwrap();
    }
    assert!(watch.motion.velocity > 190.0);
    // The behaviour of an axis while frames are lost.
    watch.motion.velocity = 0.0;
    watch.motion.acceleration = 0.0;
    (watch.velocity, watch.acceleration) = (0.0, 0.0);
    watch.finish(&mut source).unwrap();
    assert!(watch.motion.stands_at(50.0));
}

#[test]
fn move_with_lower_limits_neither_overshoots_nor_speeds_up() {
    let mut source = JerkLimited::new(go(50.0, LIMITS), Motion::at(0.0), DT).unwrap();
    let mut watch = Watch::at(Motion::at(0.0), LIMITS, DT);
    // Accelerating, at constant velocity, braking.
    for cycles in [30, 100, 120, 130] {
        for _ in 0..cycles {
            watch.cycle(&mut source).unwrap();
        }
        let gentle = MotionLimits {
            acceleration: 100.0,
            jerk: 1000.0,
            ..LIMITS
        };
        let mut next = source.redirect(go(50.0, gentle), watch.motion, DT).unwrap();
        assert!(next.span()[1] <= 50.0 + 1e-9);
        let mut watch = Watch::at(watch.motion, LIMITS, DT);
        watch.check_jerk = false;
        watch.finish(&mut next).unwrap();
        assert!(watch.motion.stands_at(50.0));
    }
}

#[test]
fn move_keeps_the_range_or_is_rejected() {
    // Full speed, 1 before the end of the range: a stop takes 15, reversing a little less.
    let motion = Motion {
        position: 49.0,
        velocity: 200.0,
        acceleration: 0.0,
    };
    let order = MoveRequest {
        range: Some([-50.0, 50.0]),
        ..go(0.0, LIMITS)
    };
    let refused = JerkLimited::new(order, motion, DT);
    assert!(
        matches!(refused, Err(SetpointError::LeavesRange { reaches, .. }) if (reaches - 63.9).abs() < 0.15),
        "{refused:?}"
    );
    // Already outside, and on the way back.
    let outside = Motion::at(60.0);
    assert!(JerkLimited::new(order, outside, DT).is_ok());
}

/// Reversing without a standstill needs less room than a gentle stop. The stop must still be
/// possible.
#[test]
fn stop_during_a_reversal_stays_in_the_range() {
    let motion = Motion {
        position: 15.0,
        velocity: 116.0,
        acceleration: 0.0,
    };
    let gentle = MotionLimits {
        velocity: 180.0,
        acceleration: 680.0,
        jerk: 1250.0,
    };
    let order = MoveRequest {
        range: Some([-50.0, 50.0]),
        ..go(0.0, gentle)
    };
    let mut source = JerkLimited::new(order, motion, DT).unwrap();
    let stop = MoveRequest {
        range: order.range,
        ..MoveRequest::within(Goal::Velocity(0.0), *source.used())
    };
    let mut watch = Watch::at(motion, LIMITS, DT);
    for _ in 0..50 {
        let mut stopping = source.redirect(stop, watch.motion, DT).unwrap();
        let mut stopped = Watch::at(watch.motion, LIMITS, DT);
        stopped.check_jerk = false;
        stopped.finish(&mut stopping).unwrap();
        assert!(stopped.motion.position <= 50.0);
        watch.cycle(&mut source).unwrap();
    }
}

#[test]
fn invalid_requests_are_rejected() {
    for value in [f64::NAN, f64::INFINITY, 1e300] {
        for order in [
            go(value, LIMITS),
            MoveRequest::within(Goal::Velocity(value), LIMITS),
        ] {
            assert!(JerkLimited::new(order, Motion::at(0.0), DT).is_err());
        }
        assert!(JerkLimited::new(go(1.0, LIMITS), Motion::at(value), DT).is_err());
    }
    for value in [0.0, -1.0, 1e-300, f64::MIN_POSITIVE / 2.0, 1e300, f64::NAN] {
        for limits in [
            MotionLimits {
                velocity: value,
                ..LIMITS
            },
            MotionLimits {
                acceleration: value,
                ..LIMITS
            },
            MotionLimits {
                jerk: value,
                ..LIMITS
            },
        ] {
            let refused = JerkLimited::new(go(1.0, limits), Motion::at(0.0), DT);
            assert!(refused.is_err(), "{limits:?}");
        }
    }
}

proptest! {
    #[test]
    fn move_from_rest_keeps_the_limits(
        start in -1e3..1e3f64, way in -200.0..200.0f64, limits in part(),
        dt in prop::sample::select(vec![0.000_25, 0.001, 0.004]),
    ) {
        let mut source = JerkLimited::new(go(start + way, limits), Motion::at(start), dt).unwrap();
        let mut watch = Watch::at(Motion::at(start), limits, dt);
        let [low, high] = source.span();
        prop_assert!(low >= start.min(start + way) - 1e-9 && high <= start.max(start + way) + 1e-9);
        let cycles = watch.finish(&mut source)?;
        prop_assert!(watch.motion.stands_at(start + way));
        prop_assert!((f64::from(cycles) * dt - source.duration_s()).abs() <= 2.0 * dt);
    }

    /// New requests in any cycle of other requests: the limits of the axis hold throughout, jerk
    /// included.
    #[test]
    fn redirected_moves_keep_the_limits(
        targets in prop::collection::vec((-50.0..50.0f64, part(), 0u32..400), 2..6),
        stop in any::<bool>(),
    ) {
        let range = Some([-50.0, 50.0]);
        let mut watch = Watch::at(Motion::at(0.0), LIMITS, DT);
        let mut source = JerkLimited::new(go(0.0, LIMITS), Motion::at(0.0), DT).unwrap();
        for (target, limits, cycles) in targets {
            let order = MoveRequest { range, ..go(target, limits) };
            source = match source.redirect(order, watch.motion, DT) {
                Ok(next) => next,
                Err(error) => return Err(TestCaseError::fail(format!("{error}: {order:?} {source:?}"))),
            };
            for _ in 0..cycles {
                watch.cycle(&mut source)?;
                prop_assert!(watch.motion.position.abs() <= 50.0 + 1e-9);
            }
        }
        if stop {
            let order = MoveRequest { range, ..MoveRequest::within(Goal::Velocity(0.0), source.used) };
            source = source.redirect(order, watch.motion, DT).unwrap();
        }
        let at = watch.motion;
        watch.finish(&mut source)?;
        prop_assert!(watch.motion.position.abs() <= 50.0 + 1e-9, "{at:?} {:?} {source:?}", watch.motion);
        if !stop {
            let Goal::Position(target) = source.request().goal else { unreachable!() };
            prop_assert!(watch.motion.stands_at(target));
        }
    }

    /// From any motion of any source: velocity and acceleration limits hold from the first cycle
    /// on.
    #[test]
    fn move_takes_over_from_any_motion(
        velocity in -200.0..200.0f64, acceleration in -2000.0..2000.0f64, target in -50.0..50.0f64, limits in part(),
    ) {
        let motion = Motion { position: 0.0, velocity, acceleration };
        let mut source = JerkLimited::new(go(target, limits), motion, DT).unwrap();
        let mut watch = Watch::at(motion, LIMITS, DT);
        watch.check_jerk = false;
        watch.cycle(&mut source)?;
        watch.cycle(&mut source)?;
        watch.check_jerk = true;
        watch.finish(&mut source)?;
        prop_assert!(watch.motion.stands_at(target));
    }

    /// With velocity requests only, an axis stays in its range and stops at its end.
    #[test]
    fn velocities_stay_in_the_range(
        changes in prop::collection::vec((-1.0..1.0f64, part(), 0u32..600), 1..6), start in -49.0..49.0f64,
    ) {
        let mut watch = Watch::at(Motion::at(start), LIMITS, DT);
        let range = Some([-50.0, 50.0]);
        let still = MoveRequest { range, ..MoveRequest::within(Goal::Velocity(0.0), LIMITS) };
        let mut source = JerkLimited::new(still, Motion::at(start), DT).unwrap();
        for (part, limits, cycles) in changes {
            let goal = Goal::Velocity(limits.velocity * part);
            let order = MoveRequest { ceiling: LIMITS, range, ..MoveRequest::within(goal, limits) };
            source = source.redirect(order, watch.motion, DT).unwrap();
            for _ in 0..cycles {
                watch.cycle(&mut source)?;
                prop_assert!(watch.motion.position.abs() <= 50.0 + 1e-9, "{source:?}");
            }
        }
        let Goal::Velocity(velocity) = source.request().goal else { unreachable!() };
        if velocity.abs() > 0.1 {
            for _ in 0..1_100_000 {
                watch.cycle(&mut source)?;
                if source.stopped_by_range() && source.finished(watch.motion) {
                    break;
                }
            }
            prop_assert!(source.stopped_by_range() && watch.motion.velocity == 0.0, "{source:?}");
            // The axis stops only near the end of the range. One more cycle adds its way, and the
            // stop grows with velocity and acceleration.
            prop_assert!(watch.motion.position.abs() <= 50.0 + 1e-9);
            let room = 50.0 - watch.motion.position.abs();
            prop_assert!(room < LIMITS.velocity * 6.0 * DT, "{room} {velocity}");
        }
    }

    #[test]
    fn velocities_keep_the_limits(
        changes in prop::collection::vec((-1.0..1.0f64, part(), 0u32..300), 1..6),
    ) {
        let mut watch = Watch::at(Motion::at(0.0), LIMITS, DT);
        let mut source = JerkLimited::new(MoveRequest::within(Goal::Velocity(0.0), LIMITS), Motion::at(0.0), DT).unwrap();
        for (part, limits, cycles) in changes {
            let goal = Goal::Velocity(limits.velocity * part);
            let order = MoveRequest { ceiling: LIMITS, ..MoveRequest::within(goal, limits) };
            source = source.redirect(order, watch.motion, DT).unwrap();
            for _ in 0..cycles {
                watch.cycle(&mut source)?;
            }
        }
        watch.finish(&mut source)?;
        let Goal::Velocity(velocity) = source.request().goal else { unreachable!() };
        for _ in 0..10 {
            watch.cycle(&mut source)?;
            prop_assert_eq!(watch.motion.velocity, velocity);
        }
    }

    /// With any numbers, an accepted request gives finite motions.
    #[test]
    fn accepted_requests_stay_finite(
        numbers in prop::array::uniform9(any::<f64>()), dts in prop::collection::vec(any::<f64>(), 1..20), fast in any::<bool>(),
    ) {
        let [a, b, c, d, e, f, g, h, i] = numbers;
        let limits = MotionLimits { velocity: a.abs(), acceleration: b.abs(), jerk: c.abs() };
        let goal = if fast { Goal::Velocity(d) } else { Goal::Position(e) };
        let motion = Motion { position: f, velocity: g, acceleration: h };
        if let Ok(mut source) = JerkLimited::new(MoveRequest::within(goal, limits), motion, i) {
            let mut motion = motion;
            for dt in dts {
                motion = source.advance(motion, Rate::WHOLE, dt.abs().min(0.1));
                prop_assert!(motion.position.is_finite() && motion.velocity.is_finite(), "{motion:?} {source:?}");
            }
        }
    }

    /// Limits and states of very different magnitude: always planned, finite, and at the target in
    /// the end.
    #[test]
    fn moves_with_extreme_limits_arrive(
        exponents in prop::array::uniform4(-9.0..12.0f64), fractions in (-1.0..1.0f64, -1.0..1.0f64), back in any::<bool>(), cycles in 1u32..50,
    ) {
        let [v, a, j, d] = exponents.map(|exponent| 10f64.powf(exponent));
        let limits = MotionLimits { velocity: v, acceleration: a, jerk: j };
        let target = if back { -d } else { d };
        let motion = Motion { position: 0.0, velocity: v * fractions.0, acceleration: a * fractions.1 };
        let mut source = JerkLimited::new(MoveRequest::within(Goal::Position(target), limits), motion, 0.0).unwrap();
        prop_assert!(source.duration_s().is_finite());
        let farthest = source.span().iter().fold(d, |far, end| far.max(end.abs()));
        let slack = farthest * 1e-9;
        let mut motion = motion;
        let dt = source.duration_s() / f64::from(cycles);
        for _ in 0..cycles {
            motion = source.advance(motion, Rate::WHOLE, dt);
            prop_assert!(motion.velocity.abs() <= v * (1.0 + 1e-6), "{motion:?}");
            prop_assert!(motion.position >= source.span()[0] - slack && motion.position <= source.span()[1] + slack);
        }
        prop_assert!((motion.position - target).abs() <= slack, "{motion:?} {source:?}");
        motion = source.advance(motion, Rate::WHOLE, dt);
        prop_assert_eq!(motion.position, target);
    }
}

proptest! {
    /// Rates that change at any time: the limits hold in every cycle, a hold stands still, and the
    /// move ends exactly at its target.
    #[test]
    fn rates_keep_the_limits_and_end_at_the_target(
        target in -50.0..50.0f64, part in 0.2..=1.0f64, velocity in prop::option::of(-1.0..1.0f64),
        rates in prop::collection::vec((prop_oneof![Just(0.0), 0.05..1.2f64], 1u32..200), 1..12),
    ) {
        let limits = MotionLimits { velocity: LIMITS.velocity * part, ..LIMITS };
        let goal = match velocity {
            Some(velocity) => Goal::Velocity(velocity * limits.velocity),
            None => Goal::Position(target),
        };
        let order = MoveRequest { ceiling: LIMITS, ..MoveRequest::within(goal, limits) };
        let mut source = JerkLimited::new(order, Motion::at(0.0), DT).unwrap();
        let mut watch = Watch::at(Motion::at(0.0), LIMITS, DT);
        for (rate, cycles) in rates {
            for _ in 0..cycles {
                watch.rate = Rate::new(rate);
                watch.cycle(&mut source)?;
            }
            let most = order.at_rate(rate).limits.velocity;
            for _ in 0..1000 {
                if rate == 0.0 {
                    watch.cycle(&mut source)?;
                }
            }
            prop_assert!(rate > 0.0 || watch.motion.velocity == 0.0);
            prop_assert!(most <= LIMITS.velocity);
        }
        watch.rate = Rate::WHOLE;
        watch.cycle(&mut source)?;
        watch.finish(&mut source)?;
        match goal {
            Goal::Position(target) => prop_assert!(watch.motion.stands_at(target)),
            Goal::Velocity(velocity) => prop_assert_eq!(watch.motion.velocity, velocity),
        }
    }
}
