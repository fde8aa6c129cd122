//! The status of an axis in one cycle.

use super::stop::PowerGoal;
use super::{Axis, Plan};
use crate::cia402::{Mode, State, Statusword};
use crate::setpoint::Goal;
use crate::status::{AxisStatus, EnableBlocker};
use crate::units::Counts;

/// Longest time in seconds in a state on the way to Operation enabled. After it the axis reports
/// why it waits.
const PASSING_S: f64 = 0.1;

impl Axis {
    /// Returns the status of this cycle. RT: O(1).
    #[must_use]
    pub fn status(&self) -> AxisStatus {
        let arrived = self.follows() && self.setpoint_arrived();
        let goal = self.profile.goal().map(|goal| goal.target);
        let (goal_position, goal_velocity) = match self.mode {
            Mode::Pp => (goal, None),
            Mode::Pv => (None, goal.map(|goal| self.profile_velocity(goal))),
            _ => (None, None),
        };
        let sent = goal_position.map_or(self.sent, |goal| self.drive_counts(goal));
        let error_counts = self
            .actual
            .counts()
            .map_or(0, |Counts(at)| sent.0.saturating_sub(at));
        AxisStatus {
            mode: self.mode,
            switching: self.switching(),
            switch_failed: self.switch_failed,
            state: self.state,
            time_in_state_s: self.memory.in_state_s(),
            statusword: self.statusword.bits(),
            controlword: self.controlword.bits(),
            powered: self.has_control(),
            enabled: self.follows(),
            ready: self.follows() && self.goal == PowerGoal::On && !self.braked(),
            mode_confirmed: self.mode_confirmed(),
            moving: self.follows() && !arrived,
            in_target: arrived
                && self.reached()
                && self.settled_s >= self.config.supervision.target_dwell_s,
            at_rest: self.rests() && self.rested_s >= self.config.supervision.standstill_dwell_s,
            position: self.actual.position(),
            velocity: self.actual.load_velocity(&self.compensation),
            torque: self.actual.torque(),
            commanded_target: self.commanded_target,
            target_position: goal_position.unwrap_or(self.motion.position),
            target_velocity: goal_velocity.unwrap_or(self.motion.velocity),
            target_acceleration: self.motion.acceleration,
            target_torque: self.loop_state.limited_torque(),
            following_error: self.supervision.following_error,
            max_following_error: self.supervision.max_following_error,
            // A plan that leads elsewhere has replaced the move.
            final_error_counts: (arrived
                && self.planned_end().is_some()
                && self.planned_end() == self.commanded_target)
                .then_some(error_counts),
            takes_up: self.takes_up(),
            encoder_difference: self.second.difference,
            held_by_range: self.held_by_range,
            guarded_cycles: self.guarded_cycles,
            stale_cycles: self.stale_cycles,
            waiting: self.waiting(),
            probes: self.probes.status(),
            resets_tried: self.auto_reset.tried,
            homing: self.home.status,
            validity: self.home.validity,
            fault: self.fault,
            trip: self.trip,
            power_loss_cause: self.power_loss_cause,
            stop: self.stop_status(),
            internal_limit: self.statusword.contains(Statusword::INTERNAL_LIMIT_ACTIVE),
            resetting: self.reset,
            reset_failed: self.reset_failed,
        }
    }

    fn rests(&self) -> bool {
        let commanded = self.setpoint_at_rest() || matches!(self.plan, Plan::Torque(_));
        commanded && self.at_standstill()
    }

    /// Updates the times in target and at rest, at the end of a cycle.
    pub(super) fn update_settling_times(&mut self, dt_s: f64) {
        let watch = &self.config.supervision;
        if watch.target_dwell_s == 0.0 && watch.standstill_dwell_s == 0.0 {
            return;
        }
        let time = |so: bool, before: f64| if so { before + dt_s } else { 0.0 };
        self.settled_s = time(
            self.follows() && self.setpoint_arrived() && self.reached(),
            self.settled_s,
        );
        self.rested_s = time(self.rests(), self.rested_s);
    }

    fn waiting(&self) -> Option<EnableBlocker> {
        if self.goal != PowerGoal::On {
            return None;
        }
        if self.follows() {
            return self.braked().then_some(EnableBlocker::Brake);
        }
        if self.lacks_position() {
            return Some(EnableBlocker::Position);
        }
        // While enabling, each state lasts a few cycles.
        if self.memory.in_state_s() < PASSING_S {
            return None;
        }
        let word = self.statusword;
        let state = self.state;
        Some(match (state, self.mode_display) {
            (State::SwitchedOn | State::OperationEnabled, Some(display))
                if !self.mode_confirmed()
                    && (state == State::OperationEnabled || !self.config.mode_display_enabled) =>
            {
                EnableBlocker::Mode {
                    expected: self.mode,
                    display: Mode::from_code(display),
                }
            }
            (State::OperationEnabled, _) if !self.reported_to_follow() => {
                EnableBlocker::Follows { mode: self.mode }
            }
            _ if !word.contains(Statusword::REMOTE) => EnableBlocker::Remote,
            _ if !word.contains(Statusword::VOLTAGE_ENABLED) => EnableBlocker::Voltage,
            _ => EnableBlocker::Drive { state },
        })
    }

    /// Returns the position at which the plan ends.
    fn planned_end(&self) -> Option<f64> {
        match &self.plan {
            Plan::Move(trapezoid) => Some(trapezoid.target),
            Plan::Jerk(source) => match source.request().goal {
                Goal::Position(target) => Some(target),
                Goal::Velocity(_) => None,
            },
            Plan::DriveProfile if self.mode == Mode::Pp => {
                self.profile.goal().map(|goal| goal.target)
            }
            _ => None,
        }
    }

    /// True if the axis has arrived at the target of the set-point.
    fn reached(&self) -> bool {
        // A plan that leads elsewhere has replaced the move.
        if self.commanded_target.is_some() && self.commanded_target != self.planned_end() {
            return false;
        }
        match self.plan {
            Plan::Velocity(ramp) => self.velocity_reached(self.at_rate(ramp).target),
            Plan::Torque(_) => true,
            Plan::DriveProfile => match (self.mode, self.profile.goal()) {
                (Mode::Pp, Some(goal)) => {
                    let error = goal.target - self.actual.position();
                    self.profile.reached() && error.abs() <= self.config.target_window
                }
                _ => !self.held_by_range,
            },
            Plan::Hold(_) | Plan::Move(_) | Plan::Jerk(_) | Plan::External => {
                // Of the drive: a stop may leave the load within its play.
                let error = self.drive_motion().position - self.actual.drive();
                error.abs() <= self.config.target_window
            }
        }
    }
}
