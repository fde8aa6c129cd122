//! Position loops in the master, structured like the axis controllers of TwinCAT.
//!
//! | mode | command to the drive |
//! |---|---|
//! | CSP | target position; optional offsets for velocity and torque (0x60B1, 0x60B2) |
//! | CSV | `feed_forward · v + Kv · e` |
//! | CST | `Kp · (e + 1/Tn ∫e + Tv · de/dt) + Ka · a` |
//!
//! v and a are velocity and acceleration of the set-point. e is the set-point minus the reported
//! position. Without a position loop, CSV accepts velocities and CST accepts torques.

use crate::setpoint::Ramp;

/// The position loops of an axis. The default has no loop and no offset.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Loops {
    /// Feedforward offsets in CSP.
    pub csp: FeedForward,
    /// The position loop in CSV; `None`: the axis has no positions there.
    pub csv: Option<VelocityLoop>,
    /// The position loop in CST; `None`: the axis has torques only.
    pub cst: Option<PositionPid>,
}

/// Feed-forward offsets for a drive in CSP.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct FeedForward {
    /// Fraction of the set-point velocity added as 0x60B1, 0 to 1.
    pub velocity: f64,
    /// Torque per acceleration added as 0x60B2, percent of rated torque per user unit/s².
    pub acceleration: f64,
}

/// Position loop in CSV.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VelocityLoop {
    /// Velocity per position error, 1/s.
    pub kv: f64,
    /// Fraction of the set-point velocity passed to the drive, 0 to 1.
    pub feed_forward: f64,
}

/// Position loop in CST.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PositionPid {
    /// Percent of rated torque per user unit.
    pub kp: f64,
    /// Integral action time, seconds. `None`: no integral part.
    pub tn_s: Option<f64>,
    /// Derivative action time, seconds.
    pub tv_s: f64,
    /// Torque per acceleration, percent of rated torque per user unit/s².
    pub acceleration: f64,
}

/// Inputs of a PID loop in one cycle, user units and seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Deviation {
    pub position: f64,
    pub velocity: f64,
    /// Acceleration of the set-point.
    pub acceleration: f64,
}

/// The integral part of a PID loop, percent of rated torque.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Integral(f64);

impl PositionPid {
    /// Runs one cycle and returns the torque within ±`limit`. While the limit is active, the
    /// integral does not grow further. In a loop without integral part, a torque taken over
    /// decreases by `slope` per second.
    #[must_use]
    pub(crate) fn advance(
        &self,
        integral: Integral,
        seen: Deviation,
        limit: f64,
        slope: f64,
        dt_s: f64,
    ) -> (Integral, f64) {
        let direct = self.direct(seen);
        let next = match self.tn_s {
            Some(tn_s) => integral.0 + self.kp * seen.position * dt_s / tn_s,
            None => Ramp { target: 0.0, slope }.advance(integral.0, dt_s),
        };
        let beyond = (direct + next).abs() > limit;
        let deeper = (next - integral.0) * (direct + next) > 0.0;
        let kept = if beyond && deeper || !next.is_finite() {
            integral.0
        } else {
            next
        };
        (Integral(kept), bounded(direct + kept, limit))
    }

    /// Returns the integral with which the loop outputs `torque` now.
    #[must_use]
    pub(crate) fn starting_with(&self, torque: f64, seen: Deviation) -> Integral {
        let integral = torque - self.direct(seen);
        Integral(if integral.is_finite() { integral } else { 0.0 })
    }

    fn direct(&self, seen: Deviation) -> f64 {
        self.kp * (seen.position + self.tv_s * seen.velocity)
            + self.acceleration * seen.acceleration
    }
}

impl VelocityLoop {
    /// Returns the velocity correction for `error`.
    #[must_use]
    pub fn correction(&self, error: f64) -> f64 {
        self.kv * error
    }
}

/// Returns `value` limited to ±`limit`; NaN becomes 0.
pub(crate) fn bounded(value: f64, limit: f64) -> f64 {
    if value.is_nan() {
        0.0
    } else {
        value.max(-limit).min(limit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PID: PositionPid = PositionPid {
        kp: 50.0,
        tn_s: Some(0.02),
        tv_s: 0.01,
        acceleration: 0.001,
    };
    const DT: f64 = 0.001;

    fn off(position: f64) -> Deviation {
        Deviation {
            position,
            velocity: 0.0,
            acceleration: 0.0,
        }
    }

    #[test]
    fn pid_parts_follow_their_gains() {
        let (integral, torque) = PID.advance(Integral::default(), off(0.1), 100.0, 1.0, DT);
        // 50 · 0.1, plus 1/20 of it for one millisecond of Tn.
        assert!((torque - 5.25).abs() < 1e-12);
        assert!((integral.0 - 0.25).abs() < 1e-12);
        let seen = Deviation {
            position: 0.0,
            velocity: 2.0,
            acceleration: 1000.0,
        };
        let (_, torque) = PID.advance(Integral::default(), seen, 100.0, 1.0, DT);
        assert!((torque - (50.0 * 0.01 * 2.0 + 1.0)).abs() < 1e-12);
    }

    #[test]
    fn saturation_does_not_wind_up() {
        let mut integral = Integral::default();
        let mut torque = 0.0;
        for _ in 0..10_000 {
            (integral, torque) = PID.advance(integral, off(1.0), 20.0, 1.0, DT);
            assert_eq!(torque, 20.0);
        }
        // After a crossing of the set-point the torque changes its sign at once.
        for _ in 0..3 {
            (integral, torque) = PID.advance(integral, off(-1.0), 20.0, 1.0, DT);
        }
        assert_eq!(torque, -20.0);
    }

    #[test]
    fn pid_takes_over_any_torque() {
        for pid in [PID, PositionPid { tn_s: None, ..PID }] {
            let seen = Deviation {
                position: 0.01,
                velocity: -1.0,
                acceleration: 300.0,
            };
            let mut integral = pid.starting_with(12.5, seen);
            let (next, torque) = pid.advance(integral, seen, 100.0, 10.0, DT);
            assert!((torque - 12.5).abs() <= 0.05, "{torque}");
            // Without integral part, the torque taken over decays.
            integral = next;
            for _ in 0..2000 {
                (integral, _) = pid.advance(integral, off(0.0), 100.0, 10.0, DT);
            }
            assert_eq!(integral.0 == 0.0, pid.tn_s.is_none());
        }
    }

    #[test]
    fn nan_gives_zero_torque() {
        for value in [f64::NAN, f64::INFINITY, f64::MAX] {
            let (integral, torque) = PID.advance(Integral::default(), off(value), 20.0, 1.0, DT);
            assert!(integral.0.is_finite() && torque.abs() <= 20.0);
            assert!(PID.starting_with(value, off(value)).0.is_finite());
        }
    }
}
