//! What set-points cost: a cycle of each source for 100 axes, and planning a jerk-limited move.

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use ecaxis_axis::group::{Line, LineAxis};
use ecaxis_axis::setpoint::{
    Goal, JerkLimited, Motion, MotionLimits, MoveRequest, Rate, Setpoint, Trapezoid,
};

const DT: f64 = 0.001;
const AXES: usize = 100;

const LIMITS: MotionLimits = MotionLimits {
    velocity: 200.0,
    acceleration: 2000.0,
    jerk: 40_000.0,
};

fn far(target: f64) -> JerkLimited {
    let order = MoveRequest::within(Goal::Position(target), LIMITS);
    JerkLimited::new(order, Motion::at(0.0), DT).expect("a move")
}

/// Long moves from end to end, so that every phase of them has its share.
fn cycles(c: &mut Criterion) {
    let mut group = c.benchmark_group("setpoint_cycle_of_100_axes");
    group.throughput(Throughput::Elements(AXES as u64));

    let mut axes = [(far(50.0), Motion::at(0.0)); AXES];
    group.bench_function("jerk_limited", |b| {
        b.iter(|| {
            for (source, motion) in &mut axes {
                *motion = source.advance(*motion, Rate::WHOLE, DT);
                if source.finished(*motion) {
                    *source = far(50.0);
                    *motion = Motion::at(0.0);
                }
            }
            black_box(&axes);
        });
    });

    let trapezoid = Trapezoid {
        target: 50.0,
        velocity: LIMITS.velocity,
        acceleration: LIMITS.acceleration,
        braking: LIMITS.acceleration,
    };
    let mut axes = [(trapezoid, Motion::at(0.0)); AXES];
    group.bench_function("trapezoid", |b| {
        b.iter(|| {
            for (source, motion) in &mut axes {
                *motion = source.advance(*motion, Rate::WHOLE, DT);
                if source.finished(*motion) {
                    *motion = Motion::at(0.0);
                }
            }
            black_box(&axes);
        });
    });

    let part = |index: usize| LineAxis {
        from: Motion::at(0.0),
        target: 10.0 + index as f64,
        limits: LIMITS,
        fastest: LIMITS.velocity,
        range: None,
    };
    let parts: [LineAxis; AXES] = std::array::from_fn(part);
    let line = Line::plan(&parts).expect("a line");
    let start = parts.map(|part| (line.along(&part), Motion::at(0.0)));
    let mut axes = start;
    group.bench_function("line", |b| {
        b.iter(|| {
            for (source, motion) in &mut axes {
                *motion = source.advance(*motion, Rate::WHOLE, DT);
            }
            if axes[0].0.finished(axes[0].1) {
                axes = start;
            }
            black_box(&axes);
        });
    });
    group.finish();
}

fn plans(c: &mut Criterion) {
    let mut group = c.benchmark_group("plan_jerk_limited_move");
    let order = |target| MoveRequest::within(Goal::Position(target), LIMITS);
    let mut moving = far(50.0);
    let mut motion = Motion::at(0.0);
    for _ in 0..180 {
        motion = moving.advance(motion, Rate::WHOLE, DT);
    }
    for (name, target) in [("long", 100.0), ("short", 1.0)] {
        group.bench_function(format!("{name}_from_rest"), |b| {
            b.iter(|| JerkLimited::new(order(black_box(target)), Motion::at(0.0), DT));
        });
    }
    for (name, target) in [("onwards", 60.0), ("back", -60.0)] {
        group.bench_function(format!("{name}_in_motion"), |b| {
            b.iter(|| moving.redirect(order(black_box(target)), motion, DT));
        });
    }
    group.finish();
}

criterion_group!(benches, cycles, plans);
criterion_main!(benches);
