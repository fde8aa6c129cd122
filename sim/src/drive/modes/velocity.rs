//! Profile velocity: a ramp to the target, and the status of the speed.

use super::{Cycle, Motion};
use crate::drive::control::Demand;
use crate::drive::objects::{Parameters, float};

/// Control cycles for which the speed has been inside its window, above zero, and slipping.
#[derive(Debug, Clone, Default)]
pub(super) struct VelocityWindow {
    inside: u32,
    turning: u32,
    slipping: bool,
}

/// The windows without 0x606D and 0x606F, as shares of the maximum speed and of the target.
const SPEED_SHARE: f64 = 0.002;
const TARGET_SHARE: f64 = 0.02;

impl VelocityWindow {
    /// Returns Statusword bit 12: the speed is below 0x606F, or above it for at most 0x6070.
    pub(super) fn is_zero(&self, velocity: f64, p: &Parameters) -> bool {
        let grace = 1..=p.velocity.threshold_time;
        velocity.abs() <= zero(p) || grace.contains(&self.turning)
    }

    /// Returns Statusword bit 13: slippage beyond 0x60F8.
    pub(super) fn slips(&self) -> bool {
        self.slipping
    }
}

fn zero(p: &Parameters) -> f64 {
    p.velocity.threshold.unwrap_or(SPEED_SHARE * p.max_speed)
}

impl Motion {
    pub(super) fn profile_velocity(&mut self, cycle: &Cycle, torque: f64) -> Demand {
        let p = cycle.parameters;
        let wanted = float(cycle.set_points.velocity) * p.velocity_unit;
        let limit = p.max_profile_speed;
        let target = wanted.clamp(-limit, limit);
        self.cut = target != wanted;
        let there = self
            .profile
            .ramp(target, p.profile.acceleration, p.profile.deceleration);
        let off = (cycle.velocity - target).abs();
        let window = p
            .velocity
            .window
            .unwrap_or((TARGET_SHARE * target.abs()).max(SPEED_SHARE * p.max_speed));
        let speed = &mut self.speed;
        let count = |cycles: u32, on: bool| if on { cycles.saturating_add(1) } else { 0 };
        speed.inside = count(speed.inside, there && off <= window);
        speed.turning = count(speed.turning, cycle.velocity.abs() > zero(p));
        let demanded = self.profile.velocity;
        speed.slipping = p
            .velocity
            .max_slippage
            .is_some_and(|most| (cycle.velocity - demanded).abs() > most);
        self.reached = speed.inside > p.velocity.window_time;
        self.profile.position = float(cycle.counts);
        Demand::Velocity {
            velocity: self.profile.velocity,
            feed: self.profile.feed(),
            torque,
        }
    }
}
