//! Moves of several axes that end together, each on its own way.
//!
//! For axes that have nothing to do with each other geometrically; a straight line is [`super::Line`]'s.

use crate::setpoint::{JerkLimited, SetpointError};

/// Makes all `moves` last as long as the longest of them, so that they arrive in the same cycle; returns how long, in seconds.
/// Before their first cycle, after which they are to advance in the same cycles.
///
/// An axis at rest goes its way more slowly. One in motion is given a lower velocity; where no velocity fits, because it could only
/// arrive earlier or much later, it stops first. Then all of them may take longer than the longest did.
///
/// O(moves²) at worst, some 100 µs for every move from motion: not for the cycle. No allocation. On an error the moves are unchanged or
/// already good in themselves.
pub fn arrive_together(moves: &mut [JerkLimited]) -> Result<f64, SetpointError> {
    let mut duration = moves
        .iter()
        .map(JerkLimited::duration_s)
        .fold(0.0, f64::max);
    // Each round lengthens the time for one more axis that then fits any longer time.
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
    use crate::setpoint::{Goal, Motion, MotionLimits, Order, Setpoint};

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
        /// From rest and from motion: all arrive in the same cycle, within their limits.
        #[test]
        fn same_cycle(
            axes in prop::collection::vec((limits(), -50.0..50.0f64, -1.0..1.0f64, any::<bool>()), 1..8),
        ) {
            let motions: Vec<Motion> = axes.iter().map(|(limits, _, velocity, moving)| Motion {
                velocity: if *moving { limits.velocity * velocity } else { 0.0 },
                ..Motion::at(0.0)
            }).collect();
            let mut moves: Vec<JerkLimited> = axes.iter().zip(&motions).map(|((limits, target, ..), motion)| {
                JerkLimited::new(Order::within(Goal::Position(*target), *limits), *motion, DT).unwrap()
            }).collect();
            let longest = moves.iter().map(JerkLimited::duration_s).fold(0.0, f64::max);
            let duration = arrive_together(&mut moves).unwrap();
            prop_assert!(duration >= longest);
            let mut at = motions;
            let mut arrived = vec![None; axes.len()];
            for cycle in 0..=(duration / DT) as u32 + 2 {
                for (index, (source, motion)) in moves.iter_mut().zip(&mut at).enumerate() {
                    let next = source.advance(*motion, DT);
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
