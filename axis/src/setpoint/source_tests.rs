use proptest::prelude::*;

use super::super::test_support::Sequence;
use super::super::{MotionLimits, MoveRequest, Shape, Wave};
use super::*;
use crate::group::{Line, LineAxis};

const DT: f64 = 0.001;

const LIMITS: MotionLimits = MotionLimits {
    velocity: 200.0,
    acceleration: 2000.0,
    jerk: 40_000.0,
};

#[derive(Debug, Clone, Copy)]
enum Next {
    Hold,
    Trapezoid(f64, f64),
    Jerk(f64, f64),
    Velocity(f64, f64),
    /// Only from rest: from motion they are rejected, and the axis continues with its source.
    Line(f64),
    Wave(f64, bool),
    LostFrames,
}

fn next() -> impl Strategy<Value = Next> {
    let at = || -50.0..50.0f64;
    let part = || 0.02..=1.0f64;
    prop_oneof![
        Just(Next::Hold),
        (at(), part()).prop_map(|(target, part)| Next::Trapezoid(target, part)),
        (at(), part()).prop_map(|(target, part)| Next::Jerk(target, part)),
        (-1.0..1.0f64, part()).prop_map(|(velocity, part)| Next::Velocity(velocity, part)),
        at().prop_map(Next::Line),
        (0.1..10.0f64, any::<bool>()).prop_map(|(size, square)| Next::Wave(size, square)),
        Just(Next::LostFrames),
    ]
}

fn take(next: Next, now: Source, motion: Motion) -> Option<Source> {
    let limits = |part: f64| MotionLimits {
        velocity: LIMITS.velocity * part,
        acceleration: LIMITS.acceleration * part,
        jerk: LIMITS.jerk * part,
    };
    let jerk = |goal, part| {
        let order = MoveRequest {
            ceiling: LIMITS,
            ..MoveRequest::within(goal, limits(part))
        };
        let made = match now {
            Source::JerkLimited(source) => source.redirect(order, motion, DT),
            _ => JerkLimited::new(order, motion, DT),
        };
        made.ok().map(Source::JerkLimited)
    };
    match next {
        Next::Hold => Some(Source::Hold(Hold {
            acceleration: LIMITS.acceleration,
        })),
        Next::Trapezoid(target, part) => {
            let limits = limits(part);
            let plain = Trapezoid {
                target,
                velocity: limits.velocity,
                acceleration: limits.acceleration,
                braking: limits.acceleration,
            };
            let taken = plain.taking_over(motion, now.braking(), LIMITS.acceleration, DT);
            Some(Source::Trapezoid(taken))
        }
        Next::Jerk(target, part) => jerk(Goal::Position(target), part),
        Next::Velocity(velocity, part) => {
            jerk(Goal::Velocity(velocity * LIMITS.velocity * part), part)
        }
        Next::Line(target) => {
            let axis = LineAxis {
                from: motion,
                target,
                limits: LIMITS,
                fastest: LIMITS.velocity,
                range: None,
            };
            Line::plan(&[axis])
                .ok()
                .map(|line| Source::Line(line.along(&axis)))
        }
        Next::Wave(size, square) => {
            let shape = if square { Shape::Square } else { Shape::Sine };
            let wave = Wave::new(shape, size, 2.0, 2, DT).ok()?;
            let wave = PositionWave::new(wave, motion, LIMITS, None, DT).ok()?;
            Some(Source::Wave(wave))
        }
        Next::LostFrames => None,
    }
}

proptest! {
    /// Any source after any other, in any cycle: velocity and acceleration keep the limits, and a
    /// move reaches its target.
    #[test]
    fn any_source_takes_over_from_any_other(changes in prop::collection::vec((next(), 0u32..400), 1..12)) {
        let mut source = Source::Hold(Hold { acceleration: LIMITS.acceleration });
        let mut sequence = Sequence::from(Motion::at(0.0), LIMITS, DT);
        for (next, cycles) in changes {
            if matches!(next, Next::LostFrames) {
                sequence.hold_up();
            }
            if let Some(taken) = take(next, source, sequence.motion) {
                source = taken;
            }
            for _ in 0..cycles {
                let motion = source.advance(sequence.motion, Rate::WHOLE, DT);
                sequence.then(motion)?;
            }
        }
        if source.target().is_some() || matches!(source, Source::Hold(_) | Source::Wave(_)) {
            let mut left = 200_000;
            while !source.finished(sequence.motion) && left > 0 {
                let motion = source.advance(sequence.motion, Rate::WHOLE, DT);
                sequence.then(motion)?;
                left -= 1;
            }
            prop_assert!(source.finished(sequence.motion), "{source:?}");
            if let Some(target) = source.target() {
                prop_assert!(sequence.motion.stands_at(target), "{source:?}");
            }
        }
    }
}
