use proptest::prelude::*;

use super::*;
use crate::setpoint::{Motion, Playback, Rate, Setpoint, TableRate};

const DT: f64 = 0.001;

/// The positions of all axes in every cycle.
fn played(plan: &PathPlan) -> Vec<Vec<f64>> {
    let tables = plan.tables();
    let mut columns = Vec::new();
    for table in tables {
        let limits = MotionLimits {
            velocity: 1e6,
            acceleration: 1e6,
            jerk: 1e6,
        };
        let mut motion = Motion::at(table.ends()[0]);
        let mut playback = Playback::new(table, motion, limits, 0.0).unwrap();
        let mut column = vec![motion.position];
        while !playback.finished(motion) {
            motion = playback.with_table(table).advance(motion, Rate::WHOLE, DT);
            column.push(motion.position);
        }
        columns.push(column);
    }
    let rows = columns[0].len();
    (0..rows)
        .map(|row| columns.iter().map(|column| column[row]).collect())
        .collect()
}

/// Distance of a point from the programmed lines.
fn distance(point: &[f64], corners: &[Vec<f64>]) -> f64 {
    let near = corners.windows(2).map(|ends| {
        let way: Vec<f64> = ends[1].iter().zip(&ends[0]).map(|(b, a)| b - a).collect();
        let out: Vec<f64> = point.iter().zip(&ends[0]).map(|(p, a)| p - a).collect();
        let square: f64 = way.iter().map(|w| w * w).sum();
        let along: f64 = way.iter().zip(&out).map(|(w, o)| w * o).sum();
        let along = (along / square).clamp(0.0, 1.0);
        let off = out.iter().zip(&way).map(|(o, w)| (o - along * w).powi(2));
        off.sum::<f64>().sqrt()
    });
    near.fold(f64::INFINITY, f64::min)
}

/// The largest velocity, acceleration and jerk of a column, as shares of the limits.
fn shares(rows: &[Vec<f64>], axis: usize, limits: &MotionLimits) -> [f64; 3] {
    let at = |row: usize| rows[row.min(rows.len() - 1)][axis];
    let mut most = [0.0_f64; 3];
    for row in 0..rows.len() {
        let [a, b, c, d] = [at(row), at(row + 1), at(row + 2), at(row + 3)];
        let found = [
            (b - a) / DT / limits.velocity,
            (c - 2.0 * b + a) / (DT * DT) / limits.acceleration,
            (d - 3.0 * c + 3.0 * b - a) / (DT * DT * DT) / limits.jerk,
        ];
        for (most, found) in most.iter_mut().zip(found) {
            *most = most.max(found.abs());
        }
    }
    most
}

fn limits() -> impl Strategy<Value = MotionLimits> {
    (50.0..500.0, 500.0..5000.0, 10.0..80.0).prop_map(|(velocity, acceleration, times)| {
        MotionLimits {
            velocity,
            acceleration,
            jerk: acceleration * times,
        }
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    #[test]
    fn lines_keep_limits_and_tolerance(
        axes in prop::collection::vec(limits(), 2..4),
        points in prop::collection::vec(prop::array::uniform3(-200.0..200.0_f64), 2..12),
        tolerance in prop_oneof![Just(0.0), 0.01..5.0],
        velocity in 50.0..1000.0,
    ) {
        let count = axes.len();
        let corners: Vec<Vec<f64>> = points.iter().map(|p| p[..count].to_vec()).collect();
        let segments: Vec<_> = corners[1..].iter().map(|to| PathSegment::Line { to: to.clone() }).collect();
        let path = PathLimits {
            motion: MotionLimits { velocity, acceleration: f64::INFINITY, jerk: f64::INFINITY },
            tolerance,
        };
        let plan = PathPlan::new(&corners[0], &segments, &axes, &path, DT).unwrap();
        for (table, limits) in plan.tables().iter().zip(&axes) {
            prop_assert_eq!(table.check(*limits, None, 0.0, DT), Ok(()));
        }
        let rows = played(&plan);
        prop_assert_eq!(rows.last(), corners.last());
        for (axis, limits) in axes.iter().enumerate() {
            let shares = shares(&rows, axis, limits);
            prop_assert!(shares[0] <= 1.0 && shares[1] <= 1.0 && shares[2] <= 1.001, "{:?}", shares);
        }
        for pair in rows.windows(2) {
            let way: f64 = pair[0].iter().zip(&pair[1]).map(|(a, b)| (b - a).powi(2)).sum();
            prop_assert!(way.sqrt() / DT <= velocity);
        }
        let farthest = rows.iter().map(|row| distance(row, &corners)).fold(0.0, f64::max);
        prop_assert!(farthest <= tolerance + 1e-9, "{} of {}", farthest, tolerance);
        if tolerance == 0.0 {
            for corner in &corners {
                let nearest = rows.iter().map(|row| {
                    row.iter().zip(corner).map(|(a, b)| (a - b).powi(2)).sum::<f64>()
                });
                prop_assert!(nearest.fold(f64::INFINITY, f64::min) == 0.0);
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]
    /// A rate that changes at any time keeps the limits of all axes, their common time and the end.
    #[test]
    fn rates_keep_the_limits_of_paths(
        axes in prop::collection::vec(limits(), 2..4),
        points in prop::collection::vec(prop::array::uniform3(-200.0..200.0_f64), 2..8),
        tolerance in prop_oneof![Just(0.0), 0.01..5.0],
        quarter in any::<bool>(),
        rates in prop::collection::vec((prop_oneof![Just(0.0), Just(1.0), 0.02..1.0_f64], 0.01..0.6_f64), 1..8),
    ) {
        let dt = if quarter { DT / 4.0 } else { DT };
        let count = axes.len();
        let corners: Vec<Vec<f64>> = points.iter().map(|p| p[..count].to_vec()).collect();
        let segments: Vec<_> = corners[1..].iter().map(|to| PathSegment::Line { to: to.clone() }).collect();
        let path = PathLimits { motion: UNLIMITED, tolerance };
        let plan = PathPlan::new(&corners[0], &segments, &axes, &path, dt).unwrap();
        let tables = plan.tables();
        let mut players: Vec<_> = tables.iter().zip(&axes).map(|(table, limits)| {
            Playback::new(table, Motion::at(table.ends()[0]), *limits, 0.0).unwrap()
        }).collect();
        let mut rate = TableRate::WHOLE;
        let (mut ended, mut slowest) = (false, 0);
        for (wanted, seconds) in rates.into_iter().chain([(0.0, 20.0), (1.0, 1e4)]) {
            let mut cycles = 0;
            while f64::from(cycles) * dt < seconds && !ended {
                let value = rate.advance(Rate::new(wanted), dt, |course| {
                    players.iter().zip(tables).zip(&axes).all(|((play, table), limits)| play.keeps(table, limits, course, dt))
                });
                ended = true;
                for ((play, table), limits) in players.iter_mut().zip(tables).zip(&axes) {
                    let before = play.motion();
                    let next = play.with_table(table).advance(before, value, dt);
                    let jerk = (next.acceleration - before.acceleration) / dt;
                    prop_assert!(next.velocity.abs() <= limits.velocity * 1.000_001);
                    prop_assert!(next.acceleration.abs() <= limits.acceleration * 1.000_001, "{} of {}", next.acceleration, limits.acceleration);
                    prop_assert!(jerk.abs() <= limits.jerk * 1.01, "{} of {}", jerk, limits.jerk);
                    ended &= play.finished(next);
                }
                cycles += 1;
                if wanted == 0.0 && value.is_held() {
                    break;
                }
                slowest = slowest.max(if wanted == 0.0 { cycles } else { 0 });
            }
            // A hold ends, unless the path does.
            prop_assert!(wanted > 0.0 || ended || rate.value().is_held() || seconds < 20.0);
        }
        prop_assert!(ended);
        prop_assert!(f64::from(slowest) * dt < 3.0, "a hold took {} s", f64::from(slowest) * dt);
        for ((play, table), corner) in players.iter().zip(tables).zip(corners.last().unwrap()) {
            prop_assert_eq!(play.motion().position, table.ends()[1]);
            prop_assert_eq!(play.motion().position, *corner);
        }
    }
}

const LIMITS: MotionLimits = MotionLimits {
    velocity: 100.0,
    acceleration: 1000.0,
    jerk: 100_000.0,
};
const UNLIMITED: MotionLimits = MotionLimits {
    velocity: f64::INFINITY,
    acceleration: f64::INFINITY,
    jerk: f64::INFINITY,
};

fn arc(start: &[f64], through: &[f64], to: &[f64], tolerance: f64) -> Result<PathPlan, PathError> {
    let segments = [PathSegment::Arc {
        through: through.to_vec(),
        to: to.to_vec(),
    }];
    let limits = PathLimits {
        motion: UNLIMITED,
        tolerance,
    };
    PathPlan::new(start, &segments, &vec![LIMITS; start.len()], &limits, DT)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    /// Arcs in space: the plan passes the three points, and keeps radius, plane and limits.
    #[test]
    fn arcs_keep_their_circle(
        center in prop::array::uniform3(-50.0..50.0_f64),
        directions in prop::array::uniform2(prop::array::uniform3(-1.0..1.0_f64)),
        radius in 1.0..80.0_f64,
        angles in (0.1..6.0_f64, 0.05..0.95_f64, any::<bool>()),
        tolerance in 0.02..2.0,
    ) {
        let dot = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let unit = |a: [f64; 3]| a.map(|x| x / dot(a, a).sqrt());
        let [u, v] = directions;
        prop_assume!(dot(u, u) > 0.01);
        let u = unit(u);
        let across = dot(u, v);
        let w = [v[0] - across * u[0], v[1] - across * u[1], v[2] - across * u[2]];
        prop_assume!(dot(w, w) > 0.01);
        let w = unit(w);
        let (end, middle, backwards) = angles;
        let sign = if backwards { -1.0 } else { 1.0 };
        let point = |angle: f64| -> Vec<f64> {
            let (sin, cos) = (sign * angle).sin_cos();
            (0..3).map(|n| center[n] + radius * (u[n] * cos + w[n] * sin)).collect()
        };
        let plan = arc(&point(0.0), &point(end * middle), &point(end), tolerance).unwrap();
        prop_assert!((plan.length() - radius * end).abs() < 1e-5 * radius, "{}", plan.length());
        for table in plan.tables() {
            prop_assert_eq!(table.check(LIMITS, None, 0.0, DT), Ok(()));
        }
        let rows = played(&plan);
        prop_assert_eq!(rows.last(), Some(&point(end)));
        let mut swept = 0.0_f64;
        for row in &rows {
            let out = [row[0] - center[0], row[1] - center[1], row[2] - center[2]];
            let (x, y) = (dot(out, u), dot(out, w) * sign);
            prop_assert!((x.hypot(y) - radius).abs() <= tolerance, "{} of {}", x.hypot(y), radius);
            prop_assert!((dot(out, out) - x * x - y * y).abs() < 1e-4 * radius * radius);
            let angle = y.atan2(x).rem_euclid(core::f64::consts::TAU);
            // The way from the first to the last angle is the one through the middle.
            prop_assert!(angle <= end + 1e-3 || angle > core::f64::consts::TAU - 1e-3, "{}", angle);
            swept = swept.max(angle.min(end));
        }
        prop_assert!(swept > end * 0.99);
    }
}

#[test]
fn impossible_paths_are_refused() {
    let straight = arc(&[0.0, 0.0], &[1.0, 1.0], &[2.0, 2.0], 0.1);
    assert_eq!(straight, Err(PathError::Straight { point: 2 }));
    let same = arc(&[0.0, 0.0], &[1.0, 1.0], &[0.0, 0.0], 0.1);
    assert_eq!(same, Err(PathError::Circle { point: 2 }));
    let exact = arc(&[0.0, 0.0], &[1.0, 1.0], &[2.0, 0.0], 0.0);
    assert_eq!(exact, Err(PathError::ArcWithoutTolerance));
    assert_eq!(
        arc(&[0.0, 0.0], &[1.0, 1.0], &[2.0, 0.0], f64::NAN),
        Err(PathError::Limits)
    );
    let far = arc(&[0.0, 0.0], &[1.0, f64::NAN], &[2.0, 0.0], 0.1);
    assert!(
        matches!(far, Err(PathError::Position { point: 2, .. })),
        "{far:?}"
    );
    let slow = PathLimits {
        motion: MotionLimits {
            velocity: 1e-9,
            ..UNLIMITED
        },
        tolerance: 0.0,
    };
    let line = [PathSegment::Line { to: vec![1.0] }];
    let slow = PathPlan::new(&[0.0], &line, &[LIMITS], &slow, DT);
    assert!(matches!(slow, Err(PathError::TooLong { .. })), "{slow:?}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]
    /// Short lines, lines that continue straight, and lines that leave an arc almost tangentially.
    #[test]
    fn short_and_tangent_parts_keep_the_tolerance(
        lengths in prop::collection::vec((0.001..30.0_f64, prop_oneof![Just(0.0), -3.0..3.0_f64]), 3..14),
        tolerance in 0.02..0.5,
        jerk in 20.0..100.0,
    ) {
        let limits = [MotionLimits { jerk: LIMITS.acceleration * jerk, ..LIMITS }; 2];
        let (mut at, mut heading) = ([0.0_f64, 0.0], 0.0_f64);
        let mut corners = vec![at.to_vec()];
        for (length, turn) in lengths {
            heading += turn;
            at = [at[0] + length * heading.cos(), at[1] + length * heading.sin()];
            corners.push(at.to_vec());
        }
        let segments: Vec<_> = corners[1..].iter().map(|to| PathSegment::Line { to: to.clone() }).collect();
        let path = PathLimits { motion: UNLIMITED, tolerance };
        let plan = PathPlan::new(&corners[0], &segments, &limits, &path, DT).unwrap();
        let rows = played(&plan);
        let farthest = rows.iter().map(|row| distance(row, &corners)).fold(0.0, f64::max);
        prop_assert!(farthest <= tolerance + 1e-9, "{} of {}", farthest, tolerance);
    }

    #[test]
    fn lines_at_arcs_keep_the_tolerance(
        radius in 5.0..1000.0_f64,
        sweep in 0.1..2.0_f64,
        length in 1.0..200.0_f64,
        off in prop_oneof![Just(0.0), -1e-3..1e-3_f64, -1.0..1.0_f64],
        tolerance in 0.02..0.5,
    ) {
        // The arc ends at the origin in the direction of x; the line leaves it by `off`.
        let on_arc = |angle: f64| vec![-radius * angle.sin(), radius * (1.0 - angle.cos())];
        let end = vec![length * off.cos(), length * off.sin()];
        let segments = [
            PathSegment::Arc { through: on_arc(sweep * 0.5), to: vec![0.0, 0.0] },
            PathSegment::Line { to: end.clone() },
        ];
        let limits = [MotionLimits { jerk: 30_000.0, ..LIMITS }; 2];
        let path = PathLimits { motion: UNLIMITED, tolerance };
        let plan = PathPlan::new(&on_arc(sweep), &segments, &limits, &path, DT).unwrap();
        for row in played(&plan) {
            let circle = (row[0].hypot(row[1] - radius) - radius).abs();
            let line = distance(&row, &[vec![0.0, 0.0], end.clone()]);
            prop_assert!(circle.min(line) <= tolerance + 1e-9, "{:?}: {} {}", row, circle, line);
        }
    }
}
