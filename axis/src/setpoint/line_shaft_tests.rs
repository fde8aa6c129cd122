use proptest::prelude::*;

use super::super::MotionLimits;
use super::super::test_support::Sequence;
use super::*;

const DT: f64 = 0.001;
const MS: u64 = 1_000_000;
const BEGIN: u64 = 1_795_651_200_000_000_000;

const CONFIG: LineShaftConfig = LineShaftConfig {
    velocity: 20.0,
    acceleration: 200.0,
    timeout_s: 0.05,
    smoothing_s: 0.01,
    max_error: 0.5,
};

/// The limits of the shaft, and the rounding of positions in common time.
const LIMITS: MotionLimits = MotionLimits {
    velocity: CONFIG.velocity * (1.0 + 1e-6),
    acceleration: CONFIG.acceleration * (1.0 + 1e-6),
    jerk: f64::INFINITY,
};

fn point(stream: u64, at_ns: u64, motion: Motion) -> Option<LineShaftPoint> {
    Some(LineShaftPoint {
        stream,
        at_ns,
        motion,
    })
}

/// The motion of a leader: constant accelerations, one after another.
fn leader(pieces: &[(f64, f64)], at_s: f64) -> Motion {
    let mut motion = Motion::default();
    let mut left = at_s;
    for &(acceleration, lasts) in pieces.iter().chain(&[(0.0, f64::INFINITY)]) {
        let dt = left.min(lasts);
        motion.position += motion.velocity * dt + acceleration * dt * dt / 2.0;
        motion.velocity += acceleration * dt;
        motion.acceleration = acceleration;
        left -= dt;
        if left <= 0.0 {
            break;
        }
    }
    motion
}

fn shaft() -> LineShaft {
    LineShaft::new(CONFIG).unwrap()
}

/// Points of a constant velocity and of a constant acceleration, each 10 ms, 30 ms late.
#[test]
fn constant_velocity_and_acceleration_are_exact_at_any_delay() {
    for (velocity, acceleration) in [(3.0, 0.0), (-3.0, 0.0), (0.0, 50.0), (10.0, -30.0)] {
        let mut shaft = shaft();
        let at = |s: f64| Motion {
            position: 7.0 + velocity * s + acceleration * s * s / 2.0,
            velocity: velocity + acceleration * s,
            acceleration,
        };
        for cycle in 30..300_u64 {
            let sent = (cycle - 30) / 10 * 10;
            let newest = point(1, BEGIN + sent * MS, at(sent as f64 * DT));
            shaft.advance(Some(BEGIN + cycle * MS), newest, DT);
            let motion = shaft.running().unwrap();
            let off = motion.position - at(cycle as f64 * DT).position;
            assert!(off.abs() < 1e-9, "{velocity} {acceleration} {cycle}: {off}");
        }
    }
}

#[test]
fn the_end_of_a_stream_stops_the_shaft_and_names_the_reason() {
    let at = |cycle: u64| Motion {
        position: 4.0 * cycle as f64 * DT,
        velocity: 4.0,
        acceleration: 0.0,
    };
    let now = |cycle: u64| Some(BEGIN + cycle * MS);
    let of = |stream: u64, cycle: u64, motion| point(stream, BEGIN + cycle * MS, motion);
    let far = Motion {
        position: 100.0,
        ..Motion::default()
    };
    type Input = (Option<u64>, Option<LineShaftPoint>);
    let rows: [(&dyn Fn(u64) -> Input, LineShaftEnd); 6] = [
        (&|n| (now(n), of(1, 99, at(99))), LineShaftEnd::Timeout),
        (&|n| (now(n), of(2, n, at(n))), LineShaftEnd::StreamChanged),
        (&|n| (now(n), None), LineShaftEnd::Closed),
        (&|n| (None, of(1, n, at(n))), LineShaftEnd::CommonTime),
        (&|n| (now(n), of(1, n, far)), LineShaftEnd::Jumped),
        // Not newer than the newest one: as if none came.
        (&|n| (now(n), of(2, 98, far)), LineShaftEnd::Timeout),
    ];
    for (input, end) in rows {
        let mut shaft = shaft();
        for cycle in 0..100 {
            shaft.advance(now(cycle), of(1, cycle, at(cycle)), DT);
        }
        let mut sequence = Sequence::from(shaft.running().unwrap(), LIMITS, DT);
        let mut stopped_at = None;
        for cycle in 100..400 {
            let (now, point) = input(cycle);
            // What feeds the shaft later does not start it before it rests.
            shaft.advance(now, point, DT);
            let Ok(motion) = shaft.motion() else {
                stopped_at.get_or_insert(cycle);
                break;
            };
            sequence.then(motion).unwrap();
        }
        let stopped_at = stopped_at.expect("ends");
        assert_eq!(shaft.end(), end);
        assert_eq!(shaft.motion(), Err(end));
        // The timeout, 20 ms of deceleration and 20 ms at rest.
        assert!(stopped_at < 100 + 50 + 20 + 25, "{end:?}: {stopped_at}");
        assert_eq!(sequence.motion.velocity, 0.0);
        // 4²/(2·200), and the way in the timeout.
        let way = sequence.motion.position - at(99).position;
        let late = if end == LineShaftEnd::Timeout {
            0.2
        } else {
            0.0
        };
        assert!((way - late - 0.04).abs() < 0.01, "{end:?}: {way}");
        // A new stream runs again; its followers have left it.
        shaft.advance(now(500), of(3, 500, at(500)), DT);
        assert_eq!(shaft.state(), LineShaftState::Running);
    }
}

/// A master that stops is not predicted to reverse, whatever point is the last one.
#[test]
fn the_end_of_a_stream_in_a_stop_reverses_nothing() {
    let motion = |cycle: u64| {
        let base = leader(&[(0.0, 0.1), (-100.0, 0.08)], cycle as f64 * DT);
        Motion {
            position: 8.0 * cycle as f64 * DT + base.position,
            velocity: 8.0 + base.velocity,
            acceleration: base.acceleration,
        }
    };
    for last in 100..185 {
        let mut shaft = shaft();
        for cycle in 5..400_u64 {
            // 5 ms late, each 5 ms.
            let sent = ((cycle - 5) / 5 * 5).min(last);
            let newest = point(1, BEGIN + sent * MS, motion(sent));
            shaft.advance(Some(BEGIN + cycle * MS), newest, DT);
            let velocity = shaft.last_motion().velocity;
            // The change of the acceleration is known up to 10 ms later.
            assert!(velocity > -0.5, "{last} {cycle}: {velocity}");
        }
        assert_eq!(shaft.last_motion().velocity, 0.0);
    }
}

/// A point in the future does not begin above the velocity limit.
#[test]
fn an_early_point_begins_within_the_limits() {
    let mut shaft = shaft();
    let motion = Motion {
        position: 0.0,
        velocity: 20.0,
        acceleration: -200.0,
    };
    shaft.advance(Some(BEGIN), point(1, BEGIN + 40 * MS, motion), DT);
    assert_eq!(shaft.running().map(|motion| motion.velocity), Ok(20.0));
}

/// Wrong clocks do not prolong the time in which the end of a stream is not seen. The point stays
/// where it is, as that of a dead leader does.
#[test]
fn a_point_from_the_future_ends_with_its_arrival() {
    for ahead in 0..=120 {
        let mut shaft = shaft();
        let newest = point(1, BEGIN + ahead * MS, Motion::at(1.0));
        let ran: Vec<u64> = (0..400)
            .filter(|cycle| {
                shaft.advance(Some(BEGIN + cycle * MS), newest, DT);
                shaft.running().is_ok()
            })
            .collect();
        // As soon as it is within the timeout, and not again.
        let expected: Vec<u64> = (ahead.saturating_sub(50)..=50).collect();
        assert_eq!(ran, expected, "{ahead} ms ahead");
        let end = match expected.is_empty() {
            true => LineShaftEnd::NoPoints,
            false => LineShaftEnd::Timeout,
        };
        assert_eq!(shaft.end(), end);
        // The leader is there again.
        let again = BEGIN + 400 * MS;
        shaft.advance(Some(again), point(2, again, Motion::at(1.0)), DT);
        assert!(shaft.running().is_ok());
    }
}

#[test]
fn points_outside_the_limits_are_rejected() {
    let now = BEGIN + 100 * MS;
    let still = Motion::at(1.0);
    let with = |velocity: f64, acceleration: f64| Motion {
        velocity,
        acceleration,
        ..still
    };
    for (at_ns, motion, reason) in [
        (now, with(20.1, 0.0), "above the limit 20"),
        (now, with(0.0, -201.0), "above the limit 200"),
        (now, with(f64::NAN, 0.0), "finite"),
        (now, Motion::at(f64::INFINITY), "finite"),
        (now, Motion::at(1e16), "farther than"),
        (now - 51 * MS, still, "51.0 ms ago"),
        (now + 51 * MS, still, "51.0 ms ahead"),
        (u64::MAX, still, "ms"),
        (0, still, "ms"),
    ] {
        let point = point(1, at_ns, motion).unwrap();
        let error = CONFIG.check(&point, now).unwrap_err().to_string();
        assert!(error.contains(reason), "{error}");
        let mut shaft = shaft();
        shaft.advance(Some(now), Some(point), DT);
        assert_eq!(shaft.running(), Err(LineShaftEnd::NoPoints));
    }
}

proptest! {
    /// Any leader within the limits, any delay and loss: position and velocity are continuous,
    /// velocity and acceleration within the limits, also while it stops.
    #[test]
    fn the_output_keeps_the_limits(
        pieces in prop::collection::vec((-190.0..190.0f64, 0.01..0.1f64), 1..8),
        late in prop::collection::vec(0..60u64, 400),
        lost in prop::collection::vec(any::<bool>(), 400),
        ppm in -100i64..100,
    ) {
        let mut shaft = LineShaft::new(LineShaftConfig { max_error: 5.0, ..CONFIG }).unwrap();
        let mut sequence: Option<Sequence> = None;
        let mut newest = None;
        for cycle in 0..1000_u64 {
            let elapsed = (cycle * MS).saturating_add_signed(cycle as i64 * ppm);
            if let (Some(&late), Some(false)) = (late.get(cycle as usize), lost.get(cycle as usize)) {
                let at = elapsed.saturating_sub(late * MS);
                let motion = leader(&pieces, at as f64 * 1e-9);
                newest = point(1, BEGIN + at, motion);
            }
            let before = shaft.state();
            shaft.advance(Some(BEGIN + elapsed), newest, DT);
            match (&mut sequence, shaft.motion()) {
                (Some(sequence), Ok(motion)) if before != LineShaftState::Waiting => {
                    // A cycle of common time differs from the nominal one by its drift.
                    let mut motion = motion;
                    motion.velocity = (motion.position - sequence.motion.position) / DT;
                    sequence.then(motion)?;
                }
                (_, Ok(motion)) => {
                    let limits = LIMITS.scaled(1.001);
                    sequence = Some(Sequence::from(motion, limits, DT));
                }
                _ => sequence = None,
            }
        }
        prop_assert_eq!(shaft.state(), LineShaftState::Waiting);
    }

    #[test]
    fn nothing_makes_the_output_not_finite(
        inputs in prop::collection::vec(
            (any::<Option<u64>>(), 0..3u64, any::<u64>(), any::<[f64; 3]>(), any::<bool>()), 1..50,
        ),
        near in any::<bool>(),
    ) {
        let mut shaft = shaft();
        for (n, (now, stream, at, [position, velocity, acceleration], there)) in (0..).zip(inputs) {
            let now = now.map(|now| if near { BEGIN + n * MS + now % MS } else { now });
            let at = if near { BEGIN + n * MS + at % (10 * MS) } else { at };
            let motion = Motion { position, velocity, acceleration };
            shaft.advance(now, point(stream, at, motion).filter(|_| there), DT);
            if let Ok(motion) = shaft.motion() {
                prop_assert!(motion.check().is_ok(), "{:?}", motion);
                prop_assert!(motion.velocity.abs() <= CONFIG.velocity * 1.001);
            }
        }
    }

    /// A difference of any size decays without overshoot beyond a tenth; a small one within the
    /// smoothing time, a large one as fast as the limits permit.
    #[test]
    fn a_difference_decays(
        jump in prop_oneof![-0.01..0.01f64, -0.49..0.49f64],
        velocity in -10.0..10.0f64,
    ) {
        let settled = match jump.abs() < 0.01 {
            true => 40,
            // Half of the acceleration to brake, and the velocity that the master leaves.
            false => 60 + (2.5e3 * (jump.abs() / 100.0).sqrt()) as u64,
        };
        let mut shaft = shaft();
        let at = |cycle: u64| Motion { position: velocity * cycle as f64 * DT, velocity, acceleration: 0.0 };
        for cycle in 0..10 {
            shaft.advance(Some(BEGIN + cycle * MS), point(1, BEGIN + cycle * MS, at(cycle)), DT);
        }
        for cycle in 10..settled + 60 {
            let mut motion = at(cycle);
            motion.position += jump;
            shaft.advance(Some(BEGIN + cycle * MS), point(1, BEGIN + cycle * MS, motion), DT);
            let left = shaft.running().unwrap().position - motion.position;
            prop_assert!(left * jump.signum() < jump.abs() * 0.1, "{} {}", left, jump);
            if cycle >= settled {
                prop_assert!(left.abs() <= 0.05 * jump.abs() + 1e-9, "{} {} {}", cycle, left, jump);
            }
        }
    }
}
