//! Jerk-limited moves compared with rsruckig, whose moves have the shortest possible time.

use ecaxis_axis::setpoint::{Goal, JerkLimited, Motion, MotionLimits, MoveRequest};
use proptest::prelude::*;
use rsruckig::prelude::{InputParameter, Ruckig, ThrowErrorHandler, Trajectory};

/// The planner reserves a millionth of every limit for rounding.
const PLANNED: f64 = 1.0 - 1e-6;

proptest! {
    #![proptest_config(ProptestConfig { cases: ProptestConfig::default().cases.max(2000), failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn jerk_limited_moves_take_the_shortest_time(
        velocity in 1.0..200.0f64, acceleration in 20.0..2000.0f64, jerk in 200.0..40_000.0f64,
        moving in any::<bool>(), part in (-1.0..1.0f64, -0.999..0.999f64), target in -100.0..100.0f64,
    ) {
        let mut start = (0.0, 0.0);
        if moving {
            start.0 = velocity * part.0;
            // At most the acceleration that can end before the velocity limit.
            let headroom = velocity - start.0 * part.1.signum();
            start.1 = part.1 * acceleration.min((2.0 * jerk * headroom).sqrt());
        }
        let mut input = InputParameter::<1>::new(None);
        input.current_velocity[0] = start.0;
        input.current_acceleration[0] = start.1;
        input.target_position[0] = target;
        input.max_velocity[0] = velocity;
        input.max_acceleration[0] = acceleration;
        input.max_jerk[0] = jerk;
        let mut judge = Trajectory::<1>::new(None);
        Ruckig::<1, ThrowErrorHandler>::new(None, 0.001)
            .calculate(&input, &mut judge)
            .map_err(|error| TestCaseError::reject(error.to_string()))?;
        let limits = MotionLimits { velocity, acceleration, jerk }.scaled(1.0 / PLANNED);
        let motion = Motion { position: 0.0, velocity: start.0, acceleration: start.1 };
        let ours = JerkLimited::new(MoveRequest::within(Goal::Position(target), limits), motion, 0.0).unwrap();
        let (ours, shortest) = (ours.duration_s(), judge.get_duration());
        prop_assert!((ours - shortest).abs() <= shortest * 1e-6, "{} {}", ours, shortest);
    }
}
