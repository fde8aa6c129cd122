//! The second half of a gantry: its set-point comes from the first half.
//!
//! A coupled axis has no plan of its own. It takes the set-point of its leader in every cycle, also
//! during a stop by set-points, so both halves slow down on the same curve. A lost frame of one half
//! counts as lost for both: a drive that waits at its last target stops both.

use super::{Axis, ControlledQuantity, Plan};
use crate::cia402::Mode;
use crate::setpoint::Motion;
use crate::status::{PowerLossCause, Trip};
use crate::supervision::StopMethod;

/// The lost frames of an axis, for the axis that is coupled to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Losses {
    stale_cycles: u32,
    undelivered_cycles: u32,
}

impl Losses {
    /// Returns true if a set-point may differ from its plan, because frames are lost or late.
    #[must_use]
    pub const fn delay_setpoints(self) -> bool {
        let longest = super::lost_frames::RIDE_THROUGH_CYCLES;
        self.stale_cycles > longest || self.undelivered_cycles > longest
    }
}

impl Axis {
    /// Takes `motion` as the set-point of this cycle, in CSP. Unlike [`Axis::set_point`] it is also
    /// valid while the axis stops by set-points, and the range of positions is the leader's.
    /// `takes_up`: [`crate::AxisStatus::takes_up`] of the leader. Velocity and acceleration limits
    /// apply. Call it between [`Axis::observe`] and [`Axis::act`]. RT: O(1).
    pub fn follow(&mut self, motion: Motion, takes_up: bool) {
        let position = self.controlled_quantity() == ControlledQuantity::Position;
        let possible =
            self.follows() && position && self.mode == Mode::Csp && self.switch.is_none();
        if possible && !self.setpoint_frozen() && motion.check().is_ok() {
            self.external_setpoint = Some(motion);
            self.plan = Plan::External;
            self.forget_target();
            self.led = true;
            self.correction.led = takes_up;
        }
    }

    /// Narrows the range of positions to `range` of an axis that follows this one, until `None`. An
    /// axis outside may return. Call it between [`Axis::observe`] and [`Axis::act`]. RT: O(1).
    pub fn share_range(&mut self, range: Option<[f64; 2]>) {
        let own = self.own_range;
        self.config.limits.position = match (own, range) {
            (Some([low, high]), Some([from, to])) if low.max(from) <= high.min(to) => {
                Some([low.max(from), high.min(to)])
            }
            // No position is right for both.
            (Some(_), Some(_)) => Some([self.motion.position; 2]),
            (own, range) => own.or(range),
        };
    }

    /// Returns the lost frames of this axis. RT: O(1).
    #[must_use]
    pub const fn losses(&self) -> Losses {
        Losses {
            stale_cycles: self.stale_cycles,
            undelivered_cycles: self.undelivered_cycles,
        }
    }

    /// Counts the lost frames of a coupled axis as those of this axis. Call it between
    /// [`Axis::observe`] and [`Axis::act`]. RT: O(1).
    pub fn share_losses(&mut self, other: Losses) {
        self.stale_cycles = self.stale_cycles.max(other.stale_cycles);
        self.undelivered_cycles = self.undelivered_cycles.max(other.undelivered_cycles);
    }

    /// Records a trip. The first cause remains.
    pub(super) fn note_trip(&mut self, trip: Trip) {
        self.trip_is_new |= self.trip.is_none();
        self.trip.get_or_insert(trip);
    }

    /// Trips the axis for a cause found outside it, and stops it by `method`. The first cause
    /// remains. RT: O(1).
    pub fn trip_by(&mut self, trip: Trip, method: StopMethod) {
        self.note_trip(trip);
        self.stop_with(PowerLossCause::Trip, method, false);
    }
}
