use proptest::prelude::*;

use super::super::test_support::Sequence;
use super::*;

const DT: f64 = 0.001;

const LIMITS: MotionLimits = MotionLimits {
    velocity: 200.0,
    acceleration: 2000.0,
    jerk: 40_000.0,
};

fn config(interpolation: Interpolation) -> StreamConfig {
    StreamConfig {
        interpolation,
        interval_s: 0.01,
        prefill: 3,
        limits: LIMITS,
        range: Some([-50.0, 50.0]),
        dt_s: DT,
    }
}

fn sine(k: u32) -> Knot {
    let omega = std::f64::consts::TAU;
    let t = f64::from(k) * 0.01;
    // 1 − cos starts and ends at rest.
    Knot {
        position: 10.0 * (1.0 - (omega * t).cos()),
        velocity: 10.0 * omega * (omega * t).sin(),
    }
}

#[test]
fn stream_follows_its_points() {
    let mut stream = Stream::<16>::new(config(Interpolation::Cubic), Motion::at(0.0)).unwrap();
    let mut sequence = Sequence::from(Motion::at(0.0), LIMITS, DT);
    let mut next = 1;
    let mut cycles = 0;
    while !stream.finished(sequence.motion) {
        while next <= 100 {
            let point = if next < 100 {
                sine(next)
            } else {
                Knot::default()
            };
            if stream.push(point).is_err() {
                break;
            }
            next += 1;
        }
        if next == 101 {
            stream.close().unwrap();
        }
        sequence
            .then(stream.advance(sequence.motion, Rate::WHOLE, DT))
            .unwrap();
        cycles += 1;
        // One point every tenth cycle.
        if cycles % 10 == 0 && cycles < 1000 {
            let expected = sine(cycles / 10).position;
            assert!(
                (sequence.motion.position - expected).abs() < 1e-9,
                "{cycles}"
            );
        }
    }
    assert_eq!(stream.state(), StreamState::Ended);
    assert!(sequence.motion.stands_at(0.0));
    assert!((1000..=1001).contains(&cycles), "{cycles}");
}

#[test]
fn stream_waits_for_its_first_points() {
    let mut stream = Stream::<4>::new(config(Interpolation::Cubic), Motion::at(0.0)).unwrap();
    for k in 1..=2 {
        stream.push(sine(k)).unwrap();
        assert_eq!(
            stream.advance(Motion::at(0.0), Rate::WHOLE, DT),
            Motion::at(0.0)
        );
        assert_eq!(stream.state(), StreamState::Waiting);
    }
    stream.push(sine(3)).unwrap();
    stream.push(sine(4)).unwrap();
    assert_eq!(stream.free(), 0);
    assert_eq!(
        stream.push(sine(5)),
        Err(SetpointError::Full { capacity: 4 })
    );
    assert!(stream.advance(Motion::at(0.0), Rate::WHOLE, DT).velocity > 0.0);
    assert_eq!(stream.state(), StreamState::Moving);
}

#[test]
fn stream_rejects_points_that_break_a_limit() {
    let new = |interpolation| Stream::<16>::new(config(interpolation), Motion::at(49.0)).unwrap();
    type Refusal = fn(&SetpointError) -> bool;
    let knot = |position, velocity| Knot { position, velocity };
    let cases: [(Interpolation, Knot, Refusal); 8] = [
        (Interpolation::Cubic, knot(f64::NAN, 0.0), |e| {
            matches!(e, SetpointError::NotFinite { .. })
        }),
        (Interpolation::Cubic, knot(49.0, f64::INFINITY), |e| {
            matches!(e, SetpointError::NotFinite { .. })
        }),
        (Interpolation::Cubic, knot(1e300, 0.0), |e| {
            matches!(e, SetpointError::TooFar { .. })
        }),
        (Interpolation::Cubic, knot(45.0, 0.0), |e| {
            matches!(e, SetpointError::TooFast { .. })
        }),
        (Interpolation::Cubic, knot(48.9, -30.0), |e| {
            matches!(e, SetpointError::TooSteep { .. })
        }),
        (Interpolation::Linear, knot(48.9, 0.0), |e| {
            matches!(e, SetpointError::TooSteep { .. })
        }),
        (Interpolation::Linear, knot(50.1, 0.0), |e| {
            matches!(
                e,
                SetpointError::LeavesRange { .. } | SetpointError::TooSteep { .. }
            )
        }),
        (Interpolation::Cubic, knot(1e-300, 1e-310), |e| {
            matches!(e, SetpointError::TooFast { .. })
        }),
    ];
    for (interpolation, point, refusal) in cases {
        let mut stream = new(interpolation);
        let before = stream.clone();
        let error = stream.push(point).unwrap_err();
        assert!(refusal(&error), "{point:?}: {error}");
        assert_eq!(stream, before);
    }
    // A stop after this point would leave the range.
    let mut stream = new(Interpolation::Cubic);
    stream.push(knot(49.095, 19.0)).unwrap();
    stream.push(knot(49.38, 38.0)).unwrap();
    let error = stream.push(knot(49.855, 57.0)).unwrap_err();
    assert!(
        matches!(error, SetpointError::LeavesRange { .. }),
        "{error}"
    );
    // A stream cannot end in motion.
    assert!(stream.close().is_err());
    let mut bad = config(Interpolation::Linear);
    bad.interval_s = 0.0005;
    assert!(Stream::<4>::new(bad, Motion::at(0.0)).is_err());
    bad.interval_s = f64::NAN;
    assert!(Stream::<4>::new(bad, Motion::at(0.0)).is_err());
    let mut none = Stream::<0>::new(config(Interpolation::Linear), Motion::at(0.0)).unwrap();
    assert_eq!(
        none.push(knot(0.0, 0.0)),
        Err(SetpointError::Full { capacity: 0 })
    );
    assert_eq!(
        none.advance(Motion::at(0.0), Rate::WHOLE, DT),
        Motion::at(0.0)
    );
}

#[derive(Debug, Clone, Copy)]
enum Event {
    /// Fractions of two limits.
    Push(f64, f64),
    Run(u8),
    HoldUp,
    Close,
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        12 => (-1.0..1.0f64, -1.0..1.0f64).prop_map(|(a, b)| Event::Push(a, b)),
        6 => any::<u8>().prop_map(|n| Event::Run(n % 25)),
        1 => Just(Event::Close),
        1 => Just(Event::HoldUp),
    ]
}

proptest! {
    /// Any points at any time, with underruns and interruptions: limits and range hold, and the
    /// axis stands in the end.
    #[test]
    fn stream_keeps_the_limits(
        cubic in any::<bool>(), interval in prop::sample::select(vec![0.001, 0.0015, 0.004, 0.01]),
        events in prop::collection::vec(event(), 1..200), start in -50.0..50.0f64,
    ) {
        let interpolation = if cubic { Interpolation::Cubic } else { Interpolation::Linear };
        let config = StreamConfig { interval_s: interval, ..config(interpolation) };
        let mut stream = Stream::<8>::new(config, Motion::at(start)).unwrap();
        let mut sequence = Sequence::from(Motion::at(start), LIMITS, DT);
        let mut newest = Knot { position: start, velocity: 0.0 };
        for event in events.into_iter().chain([Event::Run(200)]) {
            match event {
                Event::Push(a, b) => {
                    // Near the limit: a change of velocity within one interval.
                    let change = LIMITS.acceleration * if cubic { interval } else { DT };
                    let velocity = newest.velocity + a * change;
                    let mean = if cubic { (velocity + newest.velocity) / 2.0 * (1.0 + 0.01 * b) } else { velocity };
                    let point = Knot { position: newest.position + mean * interval, velocity };
                    if stream.push(point).is_ok() {
                        newest = point;
                    }
                }
                Event::HoldUp => sequence.hold_up(),
                Event::Close => { let _ = stream.close(); }
                Event::Run(cycles) => for _ in 0..cycles {
                    sequence.then(stream.advance(sequence.motion, Rate::WHOLE, DT))?;
                    prop_assert!(sequence.motion.position.abs() <= 50.0 + 1e-9);
                },
            }
        }
        prop_assert!(stream.state() == StreamState::Waiting || stream.finished(sequence.motion), "{:?}", stream.state());
        if stream.state() == StreamState::Ended {
            prop_assert!(sequence.motion.stands_at(newest.position));
        }
        prop_assert_eq!(sequence.motion.velocity, 0.0);
    }
}
