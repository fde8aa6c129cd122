//! The cycle of set-points and lines allocates nothing, including planning, rejections and
//! continuation after lost frames.

use crate::counting::allocations;
use ecaxis_axis::group::{Line, LineAxis};
use ecaxis_axis::setpoint::{
    Gear, GearConfig, GearInMode, Goal, Interpolation, JerkLimited, Knot, Master, Motion,
    MotionLimits, MoveRequest, Playback, PositionWave, Rate, Setpoint, Shape, Stream, StreamConfig,
    Table, Wave,
};

const DT: f64 = 0.001;

const LIMITS: MotionLimits = MotionLimits {
    velocity: 200.0,
    acceleration: 2000.0,
    jerk: 40_000.0,
};

/// Runs one simulated second with occasional lost frames.
fn run(mut source: impl FnMut(u32, Motion) -> Motion, start: Motion) -> Motion {
    let mut motion = start;
    for cycle in 0..1000 {
        if cycle % 300 == 299 {
            motion.velocity = 0.0;
        }
        motion = source(cycle, motion);
    }
    motion
}

/// Returns the number of allocations in `f`. The final motion shows that `f` moved.
fn counted(f: impl FnOnce() -> Motion) -> u64 {
    let before = allocations();
    let motion = f();
    let made = allocations() - before;
    assert_ne!(motion.position, 0.0);
    made
}

#[test]
fn moves_do_not_allocate() {
    let made = counted(|| {
        let order = |target| MoveRequest {
            range: Some([-60.0, 60.0]),
            ..MoveRequest::within(Goal::Position(target), LIMITS)
        };
        let mut source = JerkLimited::new(order(50.0), Motion::at(0.0), DT).unwrap();
        let mut refused = 0;
        let end = run(
            |cycle, motion| {
                if cycle % 70 == 0 {
                    let target = f64::from(cycle) * 0.17 - 40.0;
                    match source.redirect(order(target), motion, DT) {
                        Ok(next) => source = next,
                        Err(_) => refused += 1,
                    }
                }
                source.advance(motion, Rate::WHOLE, DT)
            },
            Motion::at(0.0),
        );
        assert!(refused > 2, "{refused}");
        end
    });
    assert_eq!(made, 0);
}

#[test]
fn lines_do_not_allocate() {
    let made = counted(|| {
        let axis = LineAxis {
            from: Motion::at(0.0),
            target: 40.0,
            limits: LIMITS,
            fastest: LIMITS.velocity,
            range: None,
        };
        let axes = [axis; 100];
        let line = Line::plan(&axes).unwrap();
        let mut along = axes.map(|axis| line.along(&axis));
        run(
            |cycle, motion| {
                let rate = match cycle {
                    0..50 => Rate::WHOLE,
                    50..150 => Rate::HELD,
                    _ => Rate::new(0.5),
                };
                let all = along
                    .iter_mut()
                    .map(|source| source.advance(motion, rate, DT));
                all.last().unwrap()
            },
            Motion::at(0.0),
        )
    });
    assert_eq!(made, 0);
}

#[test]
fn waves_streams_and_gears_do_not_allocate() {
    let made = counted(|| {
        let new = |shape| {
            let wave = Wave::new(shape, 2.0, 3.0, 2, DT).unwrap();
            PositionWave::new(wave, Motion::at(1.0), LIMITS, None, DT).unwrap()
        };
        let (mut sine, mut square) = (new(Shape::Sine), new(Shape::Square));
        run(
            |_, motion| sine.advance(motion, Rate::WHOLE, DT),
            Motion::at(1.0),
        );
        run(
            |_, motion| square.advance(motion, Rate::WHOLE, DT),
            Motion::at(1.0),
        )
    });
    assert_eq!(made, 0);
    let made = counted(|| {
        let config = StreamConfig {
            interpolation: Interpolation::Cubic,
            interval_s: 0.002,
            prefill: 4,
            limits: LIMITS,
            range: None,
            dt_s: DT,
        };
        let mut stream = Stream::<64>::new(config, Motion::at(0.0)).unwrap();
        run(
            |cycle, motion| {
                let t = f64::from(cycle / 2 + 1) * 0.002;
                let point = Knot {
                    position: 50.0 * t * t,
                    velocity: 100.0 * t,
                };
                if cycle % 2 == 0 {
                    let _ = stream.push(point);
                }
                // Rejected: too far away.
                let far = stream.push(Knot {
                    position: 1e6,
                    velocity: 0.0,
                });
                assert!(far.is_err());
                stream.advance(motion, Rate::WHOLE, DT)
            },
            Motion::at(0.0),
        )
    });
    assert_eq!(made, 0);
    let made = counted(|| {
        let config = GearConfig {
            ratio: 0.5,
            engage: GearInMode::At { offset: 3.0 },
            smoothing_s: 0.01,
            limits: LIMITS,
            range: Some([-50.0, 50.0]),
        };
        let mut gear = Gear::new(config, Motion::at(0.0), Motion::at(0.0)).unwrap();
        run(
            |cycle, motion| {
                let master = Master {
                    motion: Motion::at(f64::from(cycle) * 0.05),
                    comes_to_rest: false,
                };
                let mut following = gear.with_master(master);
                following.advance(motion, Rate::WHOLE, DT)
            },
            Motion::at(0.0),
        )
    });
    assert_eq!(made, 0);
}

#[test]
fn tables_do_not_allocate() {
    let table = Table::parse("0,0\n0.5,10\n0.9,5", Interpolation::Cubic).unwrap();
    table.check(LIMITS, None, 0.0, DT).unwrap();
    let made = counted(|| {
        let mut playback = Playback::new(&table, Motion::at(0.0), LIMITS, 0.0).unwrap();
        run(
            |_, motion| {
                let mut playing = playback.with_table(&table);
                playing.advance(motion, Rate::WHOLE, DT)
            },
            Motion::at(0.0),
        )
    });
    assert_eq!(made, 0);
}
