//! A value that approaches its target with bounded slope: velocity in CSV, torque in CST.

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
    }
}
