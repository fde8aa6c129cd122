//! Rest that is demanded while the axis keeps its power: by a stop, by a hold, by velocity 0.
//!
//! A position loop brings the axis to rest, and its following error supervises that. Every other
//! mode leaves it to the drive: its halt (bit 8), its velocity 0, its torque 0. This module
//! supervises what the drive makes of it, with the time-out of a stop.

use super::stop::{Deceleration, PowerGoal, SETTLE_S};
use super::{Axis, ControlledQuantity, Plan};
use crate::cia402::Mode;
use crate::status::{PowerLossCause, Trip};
use crate::supervision::StopMethod;

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Rest {
    /// A stop has ended the torque; the axis has not come to rest since.
    torque_ended: bool,
    standing_s: f64,
    deceleration: Option<Deceleration>,
}

impl Axis {
    /// Demands that the axis comes to rest although its torque has ended.
    pub(super) fn demand_rest(&mut self) {
        self.rest = Rest {
            torque_ended: true,
            ..Rest::default()
        };
    }

    /// Ends the demand: another torque is commanded.
    pub(super) fn permit_motion(&mut self) {
        self.rest = Rest::default();
    }

    /// Supervises a demanded rest, once per cycle. RT: O(1).
    pub(super) fn settle_rest(&mut self, fresh: bool, dt_s: f64) {
        if !(self.follows() && self.goal == PowerGoal::On) {
            self.rest.deceleration = None;
            return;
        }
        if !fresh {
            return;
        }
        if self.at_standstill() {
            self.rest.deceleration = None;
            self.rest.standing_s += dt_s;
            if self.rest.standing_s >= SETTLE_S {
                self.rest.torque_ended = false;
            }
            return;
        }
        self.rest.standing_s = 0.0;
        if !self.demands_rest() {
            self.rest.deceleration = None;
            return;
        }
        let speed = self.actual.velocity().abs();
        let window = self.standstill_window();
        let mut deceleration = self
            .rest
            .deceleration
            .unwrap_or_else(|| Deceleration::new(speed, self.stop_time_s(speed)));
        deceleration.pass(dt_s);
        deceleration.note(speed, window);
        self.rest.deceleration = Some(deceleration);
        if deceleration.is_late(&self.config) {
            self.rest.deceleration = None;
            self.end_unrested(deceleration.elapsed_s());
        }
    }

    /// True if the drive has been commanded to rest and closes no position loop to get there.
    fn demands_rest(&self) -> bool {
        match self.controlled_quantity() {
            ControlledQuantity::Position => false,
            ControlledQuantity::Torque => self.rest.torque_ended || self.rate == 0.0,
            ControlledQuantity::Velocity => {
                matches!(self.plan, Plan::Velocity(ramp) if self.at_rate(ramp).target == 0.0)
                    && self.motion.velocity == 0.0
            }
            ControlledQuantity::Drive => match self.mode {
                Mode::Pp => self.profile.is_halted(),
                Mode::Pv => {
                    let target = self.profile.goal().map_or(0.0, |goal| goal.target);
                    self.profile.is_halted() || self.profile_velocity(target) == 0.0
                }
                Mode::Hm => self.home.is_halted(),
                _ => false,
            },
        }
    }

    /// Goes on to the drive's quick stop. A torque of 0 is not expected to stop an axis; a halt or
    /// a velocity of 0 is.
    fn end_unrested(&mut self, time_s: f64) {
        let velocity = self.actual.velocity();
        let trip = match self.controlled_quantity() {
            ControlledQuantity::Torque => {
                return self.stop_with(PowerLossCause::Coasting, StopMethod::QuickStop, true);
            }
            ControlledQuantity::Drive if self.mode != Mode::Pv || self.profile.is_halted() => {
                Trip::HaltIgnored { velocity, time_s }
            }
            _ => Trip::NotStopped {
                velocity,
                time_s,
                method: StopMethod::Ramp,
            },
        };
        // A ramp has just failed.
        let method = self.config.supervision.reaction.max(StopMethod::QuickStop);
        self.trip_by(trip, method);
    }
}
