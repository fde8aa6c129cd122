use proptest::prelude::*;

use super::*;

const DT: f64 = 0.001;

const LIMITS: MotionLimits = MotionLimits {
    velocity: 200.0,
    acceleration: 2000.0,
    jerk: 40_000.0,
};

#[test]
fn wave_slopes_are_the_highest_reached() {
    let mut wave = Wave::new(Shape::Sine, 3.0, 1.0, 2, 1e-5).unwrap();
    let promised = wave.slopes();
    let dt = 1e-3 / 16.0;
    let mut values = [0.0; 4];
    let mut highest = [0.0f64; 3];
    while !wave.finished() {
        values.rotate_left(1);
        values[3] = wave.advance(dt);
        let [a, b, c, d] = values;
        let differences = [
            (d - c) / dt,
            (d - 2.0 * c + b) / (dt * dt),
            (d - 3.0 * c + 3.0 * b - a) / (dt * dt * dt),
        ];
        for (highest, difference) in highest.iter_mut().zip(differences) {
            *highest = highest.max(difference.abs());
        }
    }
    for (highest, promised) in highest.into_iter().zip(promised) {
        assert!(
            highest <= promised && highest > promised * 0.999,
            "{highest} {promised}"
        );
    }
}

#[test]
fn wave_counts_its_periods() {
    let mut wave = Wave::new(Shape::Sine, 1.0, 5.0, 7, DT).unwrap();
    let (mut tops, mut before, mut rising, mut full) = (0, 0.0, false, 0.0f64);
    while !wave.finished() {
        let value = wave.advance(DT);
        if rising && value < before {
            tops += 1;
            full = full.max(before);
        }
        rising = value > before;
        before = value;
    }
    // One more top while fading in. The top while fading out lies before the last fade.
    assert_eq!(tops, 9);
    assert!((full - 1.0).abs() < 1e-3);
    assert_eq!(before, 0.0);
    let mut square = Wave::new(Shape::Square, 2.0, 5.0, 3, DT).unwrap();
    let (mut edges, mut before) = (0, 0.0);
    while !square.finished() {
        let value = square.advance(DT);
        edges += u32::from(value != before);
        before = value;
    }
    assert_eq!(edges, 7);
}

#[test]
fn wave_that_exceeds_a_limit_is_rejected() {
    let sine = |amplitude, frequency| Wave::new(Shape::Sine, amplitude, frequency, 3, DT).unwrap();
    let new = |wave, range| PositionWave::new(wave, Motion::at(0.0), LIMITS, range, DT);
    assert!(new(sine(5.0, 2.0), Some([-5.0, 5.0])).is_ok());
    type Refusal = fn(&SetpointError) -> bool;
    let cases: [(Wave, Option<[f64; 2]>, Refusal); 5] = [
        (sine(5.1, 2.0), Some([-5.0, 5.0]), |e| {
            matches!(e, SetpointError::LeavesRange { .. })
        }),
        (sine(40.0, 1.0), None, |e| {
            matches!(e, SetpointError::TooFast { .. })
        }),
        (sine(5.0, 3.1), None, |e| {
            matches!(e, SetpointError::TooSteep { .. })
        }),
        (sine(0.3, 11.0), None, |e| {
            matches!(e, SetpointError::TooMuchJerk { .. })
        }),
        (
            Wave::new(Shape::Square, 50.0, 1.0, 3, DT).unwrap(),
            None,
            |e| *e == SetpointError::NoTime,
        ),
    ];
    for (wave, range, refusal) in cases {
        let error = new(wave, range).unwrap_err();
        assert!(refusal(&error), "{wave:?}: {error}");
    }
    for value in [f64::NAN, 0.0, -1.0, f64::INFINITY, 1e-300] {
        assert!(Wave::new(Shape::Sine, value, 1.0, 1, DT).is_err());
        assert!(Wave::new(Shape::Sine, 1.0, value, 1, DT).is_err());
        assert!(Wave::new(Shape::Sine, 1.0, 1.0, 1, value).is_err());
    }
    assert!(Wave::new(Shape::Sine, 1.0, 1.0, 0, DT).is_err());
    assert!(Wave::new(Shape::Sine, 1.0, 101.0, 1, DT).is_err());
    let moving = Motion {
        velocity: 1.0,
        ..Motion::at(0.0)
    };
    assert!(PositionWave::new(sine(1.0, 1.0), moving, LIMITS, None, DT).is_err());
}

proptest! {
    /// Every accepted wave keeps the limits in every cycle and ends at its start. After an
    /// interruption the axis stops.
    #[test]
    fn wave_keeps_the_limits(
        square in any::<bool>(), amplitude in 0.01..50.0f64, frequency in 0.1..20.0f64, periods in 1u32..4,
        held_up in prop::option::of(0u32..2000),
    ) {
        let shape = if square { Shape::Square } else { Shape::Sine };
        let wave = Wave::new(shape, amplitude, frequency, periods, DT).unwrap();
        let Ok(mut source) = PositionWave::new(wave, Motion::at(7.0), LIMITS, Some([-40.0, 40.0]), DT) else {
            return Ok(());
        };
        let (mut motion, mut differences) = (Motion::at(7.0), Motion::at(7.0));
        let mut cycle = 0;
        while !source.finished(motion) {
            if held_up == Some(cycle) {
                motion.velocity = 0.0;
                differences = Motion::at(motion.position);
            }
            let next = source.advance(motion, Rate::WHOLE, DT);
            let velocity = (next.position - motion.position) / DT;
            let acceleration = (velocity - differences.velocity) / DT;
            let jerk = (acceleration - differences.acceleration) / DT;
            prop_assert!(velocity.abs() <= LIMITS.velocity + 1e-9);
            prop_assert!(acceleration.abs() <= LIMITS.acceleration + 1e-6);
            if !source.interrupted() {
                prop_assert!(jerk.abs() <= LIMITS.jerk + 1e-3, "{}", jerk);
            }
            prop_assert!(next.position.abs() <= 40.0);
            differences = Motion { position: next.position, velocity, acceleration };
            motion = next;
            cycle += 1;
            prop_assert!(f64::from(cycle) * DT < wave.duration_s() + 1.0);
        }
        if !source.interrupted() {
            prop_assert!(motion.stands_at(7.0));
            prop_assert!(f64::from(cycle) * DT >= wave.duration_s() - DT);
        }
    }
}

proptest! {
    /// Rates that change at any time, on waves that use all their limits: the limits hold in every
    /// cycle, a hold stands still within seconds, and the wave ends at its start.
    #[test]
    fn rates_keep_the_limits_of_a_wave(
        square in any::<bool>(), frequency in 0.3..8.0f64, used in 0.2..0.999f64,
        rates in prop::collection::vec((prop_oneof![Just(0.0), 0.05..1.2f64], 1u32..800), 1..8),
    ) {
        let slopes = Wave::new(Shape::Sine, 1.0, frequency, 3, DT).unwrap().slopes();
        let most = [LIMITS.velocity, LIMITS.acceleration * 0.97, LIMITS.jerk * 0.94];
        let amplitude = slopes.iter().zip(most).map(|(slope, most)| most / slope).fold(f64::MAX, f64::min);
        let (shape, amplitude) = match square {
            true => (Shape::Square, amplitude * used * 0.3),
            false => (Shape::Sine, amplitude * used),
        };
        let wave = Wave::new(shape, amplitude, frequency, 3, DT).unwrap();
        let mut source = PositionWave::new(wave, Motion::at(1.0), LIMITS, None, DT).unwrap();
        let mut motion = Motion::at(1.0);
        let mut ended = false;
        let rates = rates.into_iter().chain([(0.0, 20_000), (1.0, 60_000)]);
        for (rate, cycles) in rates {
            let rate = Rate::new(rate);
            for _ in 0..cycles {
                let next = source.advance(motion, rate, DT);
                let jerk = (next.acceleration - motion.acceleration) / DT;
                prop_assert!(next.velocity.abs() <= LIMITS.velocity + 1e-9);
                prop_assert!(next.acceleration.abs() <= LIMITS.acceleration + 1e-6);
                prop_assert!(jerk.abs() <= LIMITS.jerk + 1e-2, "{} {:?}", jerk, source);
                prop_assert!((next.position - 1.0).abs() <= amplitude * 1.0 + 1e-9 || square);
                motion = next;
                ended = source.finished(motion);
                if ended {
                    break;
                }
            }
            prop_assert!(!rate.is_held() || cycles < 20_000 || motion.velocity == 0.0, "{:?}", source);
        }
        prop_assert!(ended && motion.stands_at(1.0), "{:?}", source);
    }
}
