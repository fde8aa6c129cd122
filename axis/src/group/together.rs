//! Moves of several axes that end together, each with its own profile.
//!
//! Use it for axes without a geometric relation. [`super::Line`] plans a straight line.

use crate::setpoint::{JerkLimited, SetpointError};

/// Stretches all `moves` to the duration of the longest, so that they arrive in the same cycle.
/// Returns the duration in seconds.
///
/// Call it before the first cycle of the moves; afterwards they must advance in the same cycles.
///
/// An axis at rest moves more slowly. An axis in motion gets a lower velocity. If no velocity fits,
/// because the axis would arrive too early or much too late, it stops first. Then the common
/// duration may exceed the longest move.
///
/// O(moves²) in the worst case, some 100 µs for every move from motion: do not call it in the
/// cycle. No allocation. On an error, each move is unchanged or valid.
pub fn arrive_together(moves: &mut [JerkLimited]) -> Result<f64, SetpointError> {
    let mut duration = moves
        .iter()
        .map(JerkLimited::duration_s)
        .fold(0.0, f64::max);
    // Each iteration extends the duration for one more axis, which then fits any longer duration.
    for _ in 0..=moves.len() {
        let late = moves
            .iter()
            .filter(|m| m.lasting(duration).is_none())
            .map(JerkLimited::any_duration_from)
            .fold(duration, f64::max);
        if late == duration {
            break;
        }
        duration = late;
    }
    for planned in moves.iter_mut() {
        *planned = planned.lasting(duration).ok_or(SetpointError::NoTime)?;
    }
    Ok(duration)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::setpoint::{Goal, Motion, MotionLimits, MoveRequest, Rate, Setpoint};

    const DT: f64 = 0.001;

    fn limits() -> impl Strategy<Value = MotionLimits> {
        (20.0..200.0f64, 200.0..2000.0f64, 2000.0..40_000.0f64).prop_map(
            |(velocity, acceleration, jerk)| MotionLimits {
                velocity,
                acceleration,
                jerk,
            },
        )
    }

    proptest! {
        /// From rest and from motion: all axes arrive in the same cycle, within their limits.
        #[test]
        fn moves_arrive_in_the_same_cycle(
            axes in prop::collection::vec((limits(), -50.0..50.0f64, -1.0..1.0f64, any::<bool>()), 1..8),
        ) {
            let motions: Vec<Motion> = axes.iter().map(|(limits, _, velocity, moving)| Motion {
                velocity: if *moving { limits.velocity * velocity } else { 0.0 },
                ..Motion::at(0.0)
            }).collect();
            let mut moves: Vec<JerkLimited> = axes.iter().zip(&motions).map(|((limits, target, ..), motion)| {
                JerkLimited::new(MoveRequest::within(Goal::Position(*target), *limits), *motion, DT).unwrap()
            }).collect();
            let longest = moves.iter().map(JerkLimited::duration_s).fold(0.0, f64::max);
            let duration = arrive_together(&mut moves).unwrap();
            prop_assert!(duration >= longest);
            let mut at = motions;
            let mut arrived = vec![None; axes.len()];
            for cycle in 0..=(duration / DT) as u32 + 2 {
                for (index, (source, motion)) in moves.iter_mut().zip(&mut at).enumerate() {
                    let next = source.advance(*motion, Rate::WHOLE, DT);
                    let limits = axes[index].0;
                    let change = (next.velocity - motion.velocity).abs();
                    prop_assert!(change <= limits.acceleration * DT + 1e-9);
                    prop_assert!(next.velocity.abs() <= limits.velocity + 1e-9);
                    *motion = next;
                    if arrived[index].is_none() && source.remaining_s() <= 0.0 {
                        prop_assert_eq!(next.position, axes[index].1);
                        arrived[index] = Some(cycle);
                    }
                }
            }
            prop_assert!(arrived.iter().all(|cycle| cycle.is_some() && *cycle == arrived[0]), "{:?}", arrived);
        }
    }
}
