use ecaxis_axis::setpoint::MotionLimits;

use super::*;
use crate::messages::Duration;

const CYCLE_S: f64 = 1e-3;
const AT: Start = Start {
    position: 10.0,
    enabled: true,
    stands: true,
    mode: 8,
};

fn joint(name: &str, index: usize) -> Joint {
    Joint {
        name: name.to_owned(),
        axis: name.to_owned(),
        index,
        scale: 1e-3,
        rated_effort: None,
        interfaces: Vec::new(),
        limits: MotionLimits {
            velocity: 100.0,
            acceleration: 1000.0,
            jerk: 1e9,
        },
        range: Some([-60.0, 60.0]),
        max_torque: None,
        modes: Vec::new(),
        has_homing: false,
    }
}

fn point(seconds: f64, positions: &[f64], velocities: &[f64]) -> JointTrajectoryPoint {
    JointTrajectoryPoint {
        positions: positions.to_vec(),
        velocities: velocities.to_vec(),
        time_from_start: Duration {
            sec: seconds as i32,
            nanosec: ((seconds - seconds.floor()) * 1e9) as u32,
        },
        ..JointTrajectoryPoint::default()
    }
}

fn trajectory(names: &[&str], points: Vec<JointTrajectoryPoint>) -> JointTrajectory {
    JointTrajectory {
        joint_names: names.iter().map(|name| (*name).to_owned()).collect(),
        points,
        ..JointTrajectory::default()
    }
}

fn planned(trajectory: &JointTrajectory) -> Result<Vec<Plan>, String> {
    plan(
        trajectory,
        &[joint("a", 0), joint("b", 1)],
        &[AT, AT],
        0.002,
        CYCLE_S,
    )
}

#[test]
fn trajectories_begin_at_the_axis_and_end_at_the_last_point() {
    // At the time 0, near the axis; and later, from the axis.
    for first in [
        point(0.0, &[0.0101, 0.0099], &[]),
        point(0.2, &[0.011, 0.01], &[]),
    ] {
        let points = vec![
            first,
            point(1.0, &[0.04, 0.0], &[]),
            point(2.0, &[0.02, -0.01], &[]),
        ];
        let plans = planned(&trajectory(&["b", "a"], points)).unwrap();
        assert_eq!(
            plans.iter().map(|plan| plan.joint).collect::<Vec<_>>(),
            [1, 0]
        );
        assert_eq!(plans[0].table.ends(), [10.0, 20.0]);
        assert_eq!(plans[1].table.ends(), [10.0, -10.0]);
        assert!((plans[0].table.duration_s() - 2.0).abs() < 1e-9);
    }
    assert!(planned(&trajectory(&["a"], vec![])).unwrap().is_empty());
}

#[test]
fn trajectories_that_break_a_limit_anywhere_are_refused_whole() {
    let good = || {
        vec![
            point(1.0, &[0.03, 0.01], &[]),
            point(2.0, &[0.01, 0.01], &[]),
        ]
    };
    let refused = |change: &dyn Fn(&mut Vec<JointTrajectoryPoint>), part: &str| {
        let mut points = good();
        change(&mut points);
        let error = planned(&trajectory(&["a", "b"], points)).unwrap_err();
        assert!(error.contains(part), "{error}");
    };
    assert!(planned(&trajectory(&["a", "b"], good())).is_ok());
    refused(&|p| p[1].positions[1] = 0.061, "`b`, up to point 1");
    // Between the points, too.
    let fast = [
        point(0.5, &[0.059, 0.01], &[0.09, 0.0]),
        point(1.5, &[0.01, 0.01], &[0.0, 0.0]),
    ];
    refused(&|p| *p = fast.to_vec(), "`a`");
    refused(
        &|p| {
            p[0].time_from_start = Duration {
                sec: 0,
                nanosec: 200_000_000,
            }
        },
        "`a`, up to point 0",
    );
    refused(
        &|p| p[1].time_from_start = p[0].time_from_start,
        "does not come after",
    );
    refused(
        &|p| {
            p[1].time_from_start = Duration {
                sec: -1,
                nanosec: 0,
            }
        },
        "does not come after",
    );
    refused(&|p| p[1].positions[0] = f64::NAN, "not all finite");
    refused(
        &|p| p[1].positions.truncate(1),
        "point 1 has 1 positions for 2 joints",
    );
    refused(
        &|p| p[0].velocities = vec![0.0, 0.0],
        "some points have velocities",
    );
    refused(
        &|p| {
            p[0].velocities = vec![0.0, 0.0];
            p[1].velocities = vec![0.01, 0.0];
        },
        "`a`, up to point 1",
    );
    refused(
        &|p| p.insert(0, point(0.0, &[0.0, 0.01], &[])),
        "the first point is -0.010000 from",
    );
}

#[test]
fn trajectories_need_joints_that_can_follow() {
    let points = || vec![point(1.0, &[0.02], &[])];
    let joints = [joint("a", 0)];
    let with = |start: Start| {
        plan(
            &trajectory(&["a"], points()),
            &joints,
            &[start],
            0.002,
            CYCLE_S,
        )
    };
    assert!(with(AT).is_ok());
    for (start, part) in [
        (
            Start {
                enabled: false,
                ..AT
            },
            "not enabled",
        ),
        (
            Start {
                stands: false,
                ..AT
            },
            "begins at rest",
        ),
        (Start { mode: 9, ..AT }, "mode with positions"),
        (
            Start {
                position: f64::NAN,
                ..AT
            },
            "`a`",
        ),
    ] {
        let error = with(start).unwrap_err();
        assert!(error.contains(part), "{error}");
    }
    for (names, part) in [
        (vec!["c"], "no joint is called `c`"),
        (vec![], "names no joint"),
        (vec!["a", "a"], "positions"),
    ] {
        let error = planned(&trajectory(&names, points())).unwrap_err();
        assert!(error.contains(part), "{error}");
    }
}
