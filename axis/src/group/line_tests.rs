use proptest::prelude::*;

use super::*;

const DT: f64 = 0.001;

const LIMITS: MotionLimits = MotionLimits {
    velocity: 200.0,
    acceleration: 2000.0,
    jerk: 40_000.0,
};

fn axis(from: f64, target: f64, limits: MotionLimits) -> LineAxis {
    LineAxis {
        from: Motion::at(from),
        target,
        limits,
        fastest: limits.velocity * 1.1,
        range: Some([-100.0, 100.0]),
    }
}

fn six() -> [LineAxis; 6] {
    let limits = |part: f64| MotionLimits {
        velocity: LIMITS.velocity * part,
        acceleration: LIMITS.acceleration / part,
        jerk: LIMITS.jerk * part * part,
    };
    [
        axis(0.0, 50.0, LIMITS),
        axis(-50.0, 49.123, limits(0.5)),
        axis(10.0, -77.7, limits(1.5)),
        axis(3.0, 3.0, LIMITS),
        axis(-1.0, -1.001, LIMITS),
        axis(99.0, -99.0, limits(0.9)),
    ]
}

/// One axis and the derivatives of its positions.
struct Follower {
    axis: LineAxis,
    source: LinePath,
    motion: Motion,
    rate: Rate,
    differences: Motion,
}

impl Follower {
    fn new(line: &Line, axis: LineAxis) -> Self {
        Self {
            source: line.along(&axis),
            axis,
            motion: axis.from,
            rate: Rate::WHOLE,
            differences: axis.from,
        }
    }

    fn cycle(&mut self) -> Result<(), TestCaseError> {
        let next = self.source.advance(self.motion, self.rate, DT);
        let velocity = (next.position - self.motion.position) / DT;
        let acceleration = (velocity - self.differences.velocity) / DT;
        let jerk = (acceleration - self.differences.acceleration) / DT;
        let limits = self.axis.limits;
        // Positions are rounded to 1e-14 × 100.
        prop_assert!(velocity.abs() <= self.axis.fastest + 1e-9);
        prop_assert!(acceleration.abs() <= limits.acceleration + 1e-6);
        prop_assert!(jerk.abs() <= limits.jerk + 1e-3);
        prop_assert!((velocity - next.velocity).abs() <= 1e-9);
        self.differences = Motion {
            position: next.position,
            velocity,
            acceleration,
        };
        self.motion = next;
        Ok(())
    }
}

/// Largest distance from the line, in user units. The reference is the nearest point on the line to
/// all positions.
fn deviation(followers: &[Follower]) -> f64 {
    let way = |f: &Follower| f.axis.target - f.axis.from.position;
    let gone = |f: &Follower| f.motion.position - f.axis.from.position;
    let length: f64 = followers.iter().map(|f| way(f) * way(f)).sum();
    let part: f64 = followers.iter().map(|f| way(f) * gone(f)).sum::<f64>() / length;
    followers
        .iter()
        .map(|f| (gone(f) - part * way(f)).abs())
        .fold(0.0, f64::max)
}

#[test]
fn six_axes_arrive_in_the_same_cycle_on_a_straight_line() {
    let axes = six();
    let line = Line::plan(&axes).unwrap();
    let mut followers = axes.map(|axis| Follower::new(&line, axis));
    let mut cycles = 0;
    while !followers.iter().all(|f| f.source.finished(f.motion)) {
        let mut arrived = 0;
        for follower in &mut followers {
            follower.cycle().unwrap();
            arrived += u32::from(follower.source.finished(follower.motion));
        }
        assert!(arrived == 0 || arrived == 6, "{arrived}");
        assert!(deviation(&followers) < 1e-12);
        cycles += 1;
    }
    for f in &followers {
        assert!(f.motion.stands_at(f.axis.target));
    }
    // As fast as the axis with the longest way, at 180: 198/180 + 180/2222 + 2222/32400.
    assert!((f64::from(cycles) * DT - line.duration_s()).abs() <= 2.0 * DT);
    assert!(line.duration_s() < 2.2);
}

#[test]
fn line_starts_at_rest_and_keeps_every_range() {
    let mut axes = six();
    axes[2].target = 100.1;
    let error = Line::plan(&axes).unwrap_err();
    assert_eq!(error.axis, 2);
    assert!(matches!(error.error, SetpointError::LeavesRange { .. }));
    let mut axes = six();
    axes[4].from.velocity = 1.0;
    assert_eq!(
        Line::plan(&axes),
        Err(LineError {
            axis: 4,
            error: SetpointError::NotAtRest { velocity: 1.0 }
        })
    );
    let mut axes = six();
    axes[1].target = f64::NAN;
    assert_eq!(Line::plan(&axes).unwrap_err().axis, 1);
    axes[1] = axis(
        0.0,
        1.0,
        MotionLimits {
            jerk: 0.0,
            ..LIMITS
        },
    );
    assert_eq!(Line::plan(&axes).unwrap_err().axis, 1);
}

#[test]
fn line_of_zero_length_is_finished() {
    let axes = [axis(1.0, 1.0, LIMITS), axis(2.0, 2.0, LIMITS)];
    for axes in [&axes[..], &[]] {
        let line = Line::plan(axes).unwrap();
        assert_eq!(line.duration_s(), 0.0);
        for axis in axes {
            let mut source = line.along(axis);
            assert!(source.finished(axis.from));
            assert_eq!(source.advance(axis.from, Rate::WHOLE, DT), axis.from);
        }
    }
}

#[derive(Debug, Clone, Copy)]
enum Event {
    Rate(f64),
    /// Frames are lost; all axes stand.
    Freeze,
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        Just(Event::Rate(0.0)),
        (0.05..=1.2f64).prop_map(Event::Rate),
        Just(Event::Freeze),
    ]
}

proptest! {
    /// Stops, new speeds and interruptions at any time: the axes stay on the line, within the
    /// limits, in step.
    #[test]
    fn axes_stay_on_the_line_after_any_event(events in prop::collection::vec((event(), 0u32..300), 0..8)) {
        let axes = six();
        let line = Line::plan(&axes).unwrap();
        let mut followers = axes.map(|axis| Follower::new(&line, axis));
        for (event, cycles) in events.into_iter().chain([(Event::Rate(1.0), 10_000)]) {
            for f in &mut followers {
                match event {
                    Event::Rate(rate) => f.rate = Rate::new(rate),
                    Event::Freeze => {
                        f.motion.velocity = 0.0;
                        f.differences.velocity = 0.0;
                        f.differences.acceleration = 0.0;
                    }
                }
            }
            for _ in 0..cycles {
                for f in &mut followers {
                    f.cycle()?;
                }
                prop_assert!(deviation(&followers) < 1e-11);
            }
        }
        for f in &followers {
            prop_assert!(f.motion.stands_at(f.axis.target));
            prop_assert!(f.source.finished(f.motion));
        }
    }
}
