//! Deceleration to standstill, for Controlword bit 8 and for stops of the power state machine.

use super::{Cycle, Mode, Motion};
use crate::drive::control::{Demand, Feed};
use crate::drive::objects::float;
use crate::drive::profile::Profile;
use crate::drive::state::Ramp;

impl Motion {
    /// Runs one control cycle of a stop. True when the demanded speed is zero.
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

    /// Stops without a ramp: the velocity loop demands zero speed and uses the full current. The
    /// axis then holds its position.
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
