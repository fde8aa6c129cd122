//! The status: everything about the axis in one cycle.

use super::{Axis, Plan, Wish};
use crate::cia402::Mode;
use crate::status::AxisStatus;
use crate::units::{Counts, UserUnits};

impl Axis {
    /// RT: O(1).
    #[must_use]
    pub fn status(&self) -> AxisStatus {
        let arrived = self.active && self.setpoint_arrived();
        let goal = self.profile.goal().map(|goal| goal.target);
        let (goal_position, goal_velocity) = match self.mode {
            Mode::Pp => (goal, None),
            Mode::Pv => (None, goal),
            _ => (None, None),
        };
        let sent = goal_position.map_or(self.sent, |goal| {
            self.config.scale.position_to_counts(UserUnits(goal))
        });
        let error_counts = self
            .actual
            .counts()
            .map_or(0, |Counts(at)| sent.0.saturating_sub(at));
        let standing_still = self.setpoint_at_rest() || matches!(self.plan, Plan::Torque(_));
        AxisStatus {
            mode: self.mode,
            switching: self.switch.map(|switch| switch.to),
            switch_failed: self.switch_failed,
            state: self.state,
            time_in_state_s: self.memory.in_state_s(),
            statusword: self.statusword.bits(),
            controlword: self.controlword.bits(),
            enabled: self.active,
            ready: self.active && self.wish == Wish::Enabled,
            mode_confirmed: self.mode_confirmed(),
            moving: self.active && !arrived,
            in_target: arrived && self.reached(),
            at_rest: standing_still && self.standing(),
            position: self.actual.position(),
            velocity: self.actual.velocity(),
            torque: self.actual.torque(),
            target_position: goal_position.unwrap_or(self.motion.position),
            target_velocity: goal_velocity.unwrap_or(self.motion.velocity),
            target_acceleration: self.motion.acceleration,
            target_torque: self.given.torque,
            following_error: self.watch.following_error,
            max_following_error: self.watch.max_following_error,
            final_error_counts: (arrived
                && (matches!(self.plan, Plan::Move(_)) || goal_position.is_some()))
            .then_some(error_counts),
            held_by_range: self.held_by_range,
            guarded_cycles: self.guarded_cycles,
            stale_cycles: self.stale_cycles,
            homing: self.home.status,
            homed: self.home.homed,
            fault: self.fault,
            trip: self.trip,
            resetting: self.reset,
            reset_failed: self.reset_failed,
        }
    }

    /// The axis is where the set-point has arrived.
    fn reached(&self) -> bool {
        match self.plan {
            Plan::Velocity(ramp) => self.velocity_reached(ramp.target),
            Plan::Torque(_) => true,
            Plan::Drive => match (self.mode, self.profile.goal()) {
                (Mode::Pp, Some(goal)) => {
                    let error = goal.target - self.actual.position();
                    self.profile.reached() && error.abs() <= self.config.target_window
                }
                _ => true,
            },
            Plan::Hold(_) | Plan::Move(_) | Plan::Fed => {
                let error = self.motion.position - self.actual.position();
                error.abs() <= self.config.target_window
            }
        }
    }
}
