//! A value that approaches its target with bounded slope: velocity in CSV, torque in CST.

use super::braking_velocity;

/// A velocity or torque that changes with limited slope.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ramp {
    /// The final value.
    pub target: f64,
    /// Change per second.
    pub slope: f64,
}

impl Ramp {
    /// Advances one cycle; ends exactly on the target. RT: O(1).
    #[must_use]
    pub fn advance(self, value: f64, dt_s: f64) -> f64 {
        let most = self.slope * dt_s;
        let left = self.target - value;
        if left.abs() <= most {
            self.target
        } else {
            value + most.copysign(left)
        }
    }

    /// Advances one cycle and changes the slope by `jerk` per second at most. `slope`: the change
    /// per second of the last cycle. Ends exactly on the target. RT: O(1).
    #[must_use]
    pub fn advance_smoothly(self, value: f64, slope: f64, jerk: f64, dt_s: f64) -> f64 {
        let left = self.target - value;
        let bend = jerk * dt_s;
        // The slope can become 0 at the target.
        let steepest = braking_velocity(left.abs(), jerk, dt_s).min(self.slope);
        let next = steepest.copysign(left).max(slope - bend).min(slope + bend);
        let step = next * dt_s;
        if (left - step).abs() <= left.abs() * 1e-9 {
            self.target
        } else {
            value + step
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn ramp_keeps_its_slope_and_arrives(start in -1e3..1e3f64, target in -1e3..1e3f64, slope in 1.0..1e5f64) {
            let ramp = Ramp { target, slope };
            let mut value = start;
            for _ in 0..2_100_000 {
                let next = ramp.advance(value, 0.001);
                prop_assert!((next - value).abs() <= slope * 0.001 + 1e-9);
                value = next;
                if value == target {
                    break;
                }
            }
            prop_assert_eq!(value, target);
        }

        /// Targets at any time: slope and its change are bounded, and each value between two targets
        /// that are reached is between them.
        #[test]
        fn smooth_ramp_keeps_slope_and_jerk_and_arrives(
            targets in prop::collection::vec((-1e3..1e3f64, 1..3000u32), 1..8), slope in 1.0..1e5f64, times in 2.0..100.0f64,
        ) {
            const DT: f64 = 0.001;
            let jerk = slope * times;
            let (mut value, mut now) = (0.0, 0.0);
            let last = (500.0, 2_100_000);
            for (target, cycles) in targets.into_iter().chain([last]) {
                let ramp = Ramp { target, slope };
                for _ in 0..cycles {
                    let next = ramp.advance_smoothly(value, now, jerk, DT);
                    let change = (next - value) / DT;
                    prop_assert!(change.abs() <= slope * (1.0 + 1e-9) + 1e-8);
                    prop_assert!((change - now).abs() <= jerk * DT * (1.0 + 1e-6) + 1e-6, "{} {}", change, now);
                    prop_assert!(next.abs() <= 1e3 * (1.0 + 1e-9));
                    (value, now) = (next, change);
                    if value == target && now == 0.0 {
                        break;
                    }
                }
            }
            prop_assert_eq!(value, 500.0);
        }
    }
}
