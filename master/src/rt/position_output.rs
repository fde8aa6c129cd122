//! Outputs that follow the position of an axis, decided in every cycle.

use ecaxis_axis::AxisStatus;
use ecaxis_ecat::index::AxisIndex;

use super::image::SignalBits;

/// An output that is on while an axis is in one of the ranges.
#[derive(Debug, Clone)]
pub struct PositionOutput {
    pub output: SignalBits,
    pub trigger: PositionTrigger,
}

/// The positions at which an output is on. User units.
#[derive(Debug, Clone, PartialEq)]
pub struct PositionTrigger {
    pub axis: AxisIndex,
    /// True for the reported position, false for the set-point of the same cycle.
    pub actual: bool,
    /// Each from its first position up to, without, its last.
    pub ranges: Box<[[f64; 2]]>,
    /// The ranges repeat after this way.
    pub period: Option<f64>,
    /// The output switches this much before the axis is there.
    pub lead_s: f64,
}

impl PositionTrigger {
    /// Returns true if the output is on. Without power, and while positions refer to nothing, it is
    /// off. RT: O(ranges).
    #[must_use]
    pub fn is_on(&self, status: &AxisStatus) -> bool {
        if !(status.enabled && status.validity.is_defined()) {
            return false;
        }
        let (position, velocity, acceleration) = if self.actual {
            (status.position, status.velocity, 0.0)
        } else {
            let acceleration = status.target_acceleration;
            (status.target_position, status.target_velocity, acceleration)
        };
        let ahead = velocity + acceleration * self.lead_s / 2.0;
        let mut at = position + ahead * self.lead_s;
        if let Some(period) = self.period {
            at = at.rem_euclid(period);
        }
        // No range contains NaN.
        self.ranges
            .iter()
            .any(|[first, last]| at >= *first && at < *last)
    }
}
