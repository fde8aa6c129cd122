use proptest::prelude::*;

use super::*;

const DT: f64 = 0.001;

fn plain(target: f64, velocity: f64, acceleration: f64) -> Trapezoid {
    Trapezoid {
        target,
        velocity,
        acceleration,
        braking: acceleration,
    }
}

/// Runs until finished and checks every cycle. Returns the number of cycles and the final motion.
fn run(mut plan: Trapezoid, start: Motion, limit: f64, dt: f64) -> (u32, Motion) {
    let mut motion = start;
    for cycle in 0..5_000_000 {
        if plan.finished(motion) {
            return (cycle, motion);
        }
        let next = plan.advance(motion, Rate::WHOLE, dt);
        let change = (next.velocity - motion.velocity).abs();
        assert!(
            change <= limit * dt * (1.0 + 1e-9) + 1e-12,
            "cycle {cycle}: {motion:?} → {next:?}"
        );
        let step = (next.position - motion.position) / dt;
        assert!(
            (step - next.velocity).abs() <= 1e-6 * (1.0 + step.abs()),
            "cycle {cycle}: {motion:?} → {next:?}"
        );
        motion = next;
    }
    panic!("not finished: {plan:?} from {start:?} at {motion:?}");
}

/// Returns the sum that `braking_velocity` inverts.
fn way_to_stop(velocity: f64, acceleration: f64, dt: f64) -> f64 {
    let mut v = velocity;
    let mut way = 0.0;
    while v > 0.0 {
        way += v * dt;
        v -= acceleration * dt;
    }
    way
}

#[test]
fn braking_velocity_inverts_the_sum() {
    for acceleration in [1.0, 37.0, 2000.0] {
        for distance in [1e-9, 1e-4, 0.003, 0.1, 5.0, 77.7] {
            let v = braking_velocity(distance, acceleration, DT);
            let way = way_to_stop(v, acceleration, DT);
            assert!(
                (way - distance).abs() < 1e-9 * (1.0 + distance),
                "{acceleration} {distance}: {v} {way}"
            );
        }
    }
    // Extreme inputs give finite results.
    for (d, a, dt) in [
        (1e300, 1e-300, 1e-3),
        (0.0, 0.0, 0.0),
        (1.0, 1.0, 0.0),
        (f64::INFINITY, 1.0, DT),
    ] {
        assert!(braking_velocity(d, a, dt).is_finite());
    }
}

#[test]
fn trapezoid_takes_the_calculated_time() {
    // 100 mm at 200 mm/s and 2000 mm/s²: 0.1 s acceleration, 0.4 s constant, 0.1 s deceleration.
    let (cycles, end) = run(plain(50.0, 200.0, 2000.0), Motion::at(-50.0), 2000.0, DT);
    assert!((600..=603).contains(&cycles), "{cycles}");
    assert!(end.stands_at(50.0));
    // Triangular: 1 mm, 2·√(1/2000) = 44.7 ms.
    let (cycles, _) = run(plain(1.0, 200.0, 2000.0), Motion::at(0.0), 2000.0, DT);
    assert!((44..=48).contains(&cycles), "{cycles}");
}

#[test]
fn trapezoid_at_its_target_stays() {
    let (cycles, _) = run(plain(3.0, 1.0, 1.0), Motion::at(3.0), 1.0, DT);
    assert_eq!(cycles, 0);
}

#[test]
fn trapezoid_with_lower_acceleration_does_not_overshoot() {
    // At full speed 5 before the target: the same target again with a tenth of the acceleration.
    let motion = Motion {
        position: 35.0,
        velocity: 200.0,
        ..Motion::default()
    };
    let mut plan = plain(50.0, 200.0, 200.0).taking_over(motion, 2000.0, 2000.0, DT);
    let mut at = motion;
    while !plan.finished(at) {
        at = plan.advance(at, Rate::WHOLE, DT);
        assert!(at.position <= 50.0);
    }
}

#[test]
fn trapezoid_without_time_does_not_move() {
    let motion = Motion {
        position: 1.0,
        velocity: 2.0,
        ..Motion::default()
    };
    assert_eq!(
        plain(9.0, 1.0, 1.0).advance(motion, Rate::WHOLE, 0.0),
        motion
    );
}

proptest! {
    /// From rest: keeps the velocity, never passes the target, and ends exactly on it.
    #[test]
    fn trapezoid_from_rest_keeps_its_limits(
        start in -1e3..1e3f64, way in -200.0..200.0f64, velocity in 2.0..1e3f64, acceleration in 5.0..1e5f64,
        dt in prop::sample::select(vec![0.000_25, 0.001, 0.004]),
    ) {
        let mut plan = plain(start + way, velocity, acceleration);
        let mut motion = Motion::at(start);
        let (low, high) = (start.min(plan.target), start.max(plan.target));
        while !plan.finished(motion) {
            motion = plan.advance(motion, Rate::WHOLE, dt);
            prop_assert!(motion.velocity.abs() <= velocity);
            prop_assert!((low..=high).contains(&motion.position), "{:?} {:?}", plan, motion);
        }
        let time = way.abs() / velocity + velocity / acceleration;
        let (cycles, end) = run(plan, Motion::at(start), acceleration, dt);
        prop_assert!(end.stands_at(plan.target));
        prop_assert!(f64::from(cycles) * dt <= time + 6.0 * dt);
    }

    /// New targets at any time: the acceleration limit holds, and the second move stops where the
    /// first could.
    #[test]
    fn trapezoid_takes_over_at_any_time(
        first in -50.0..50.0f64, second in -50.0..50.0f64, after in 0u32..700,
        speeds in (0.01..1.0f64, 0.01..1.0f64), ramps in (0.02..1.0f64, 0.02..1.0f64),
    ) {
        let limit = 2000.0;
        let mut plan = plain(first, 200.0 * speeds.0, limit * ramps.0);
        let mut motion = Motion::at(0.0);
        for _ in 0..after {
            motion = plan.advance(motion, Rate::WHOLE, DT);
        }
        let mut next = plain(second, 200.0 * speeds.1, limit * ramps.1).taking_over(motion, plan.braking, limit, DT);
        let bound = 200.0 * speeds.1.max(speeds.0);
        let (low, high) = (first.min(second).min(0.0), first.max(second).max(0.0));
        let mut at = motion;
        for _ in 0..200_000 {
            at = next.advance(at, Rate::WHOLE, DT);
            prop_assert!(at.velocity.abs() <= bound);
            prop_assert!((low - 1e-9..=high + 1e-9).contains(&at.position), "{:?}", at);
        }
        let (_, end) = run(next, motion, limit, DT);
        prop_assert!(end.stands_at(second));
    }
}
