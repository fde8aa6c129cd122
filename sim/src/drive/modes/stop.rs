//! Coming to rest: for Controlword bit 8 and for the stops of the power state machine.

use super::{Cycle, Mode, Motion};
use crate::drive::control::{Demand, Feed};
use crate::drive::objects::float;
use crate::drive::profile::Profile;
use crate::drive::state::Ramp;

impl Motion {
    /// One control cycle of a stop. True when the demanded speed is zero.
    pub(in crate::drive) fn stop(
        &mut self,
        ramp: Ramp,
        mode: Option<Mode>,
        cycle: &Cycle,
    ) -> (Demand, bool) {
        let p = cycle.parameters;
        let deceleration = match ramp {
            Ramp::SlowDown if mode == Some(Mode::Homing) => cycle.homing.acceleration,
            Ramp::SlowDown => p.profile.deceleration,
            Ramp::QuickStop => p.quick_stop_deceleration,
            Ramp::Limit => return self.stop_at_the_limit(cycle),
        };
        let there = self.profile.ramp(0.0, deceleration, deceleration);
        (self.profile_demand(0.0), there)
    }

    /// No ramp: the velocity loop is asked to stand and takes all the current there is. Where the axis
    /// then stands, it is held.
    fn stop_at_the_limit(&mut self, cycle: &Cycle) -> (Demand, bool) {
        if !self.held && !cycle.stands {
            self.profile = Profile::at(float(cycle.counts), cycle.velocity);
            let demand = Demand::Velocity {
                velocity: 0.0,
                feed: Feed::default(),
                torque: 0.0,
            };
            return (demand, false);
        }
        if !self.held {
            self.held = true;
            self.profile = Profile::at(float(cycle.counts), 0.0);
        }
        (self.hold(), true)
    }
}
