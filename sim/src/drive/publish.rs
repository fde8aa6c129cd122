//! The drive's outputs: Statusword and actual values.

use super::control::Demand;
use super::modes::{Mode, bit};
use super::objects::float;
use super::{Drive, State};
use crate::coe::object_dictionary::ObjectStore;

impl Drive {
    fn statusword(&self, limited: bool) -> u16 {
        let state = self.power.state();
        let mut word = state.bits();
        let mut set = |on: bool, bit: u16| word |= if on { bit } else { 0 };
        // Voltage enabled: most drives report the supply, a maxon drive its power stage.
        let power_stage = self.power.powered() || state == State::SwitchedOn;
        set(power_stage || !self.objects.is_maxon, 1 << 4);
        set(self.warning, 1 << 7);
        set(self.in_op, 1 << 9);
        set(limited || self.at_limit_switch(), bit::INTERNAL_LIMIT);
        if let Some(mode) = self.mode {
            let velocity = self.controller.velocity();
            let bits = self
                .motion
                .status(mode, self.follows(), velocity, &self.parameters);
            set(true, bits);
            set(
                self.following_error
                    && matches!(mode, Mode::CyclicPosition | Mode::ProfilePosition),
                bit::MODE_13,
            );
        }
        if self.quirks.any() {
            word = self.quirks.statusword(word, self.mode);
        }
        word
    }

    pub(super) fn publish(&self, store: &mut ObjectStore, demand: &Demand, limited: bool) {
        let (o, p) = (&self.objects, &self.parameters);
        let polarity = self.frame.polarity;
        let counts = self.controller.counts();
        let velocity = self.controller.velocity();
        let torque_per_ampere = self.tuning.torque_constant / p.torque_unit.max(1e-12);
        let current = self.controller.current();
        store.show(o.statusword, i64::from(self.statusword(limited)));
        store.show(o.error_code, i64::from(self.faults.code()));
        // All axes of a device share 0x1001; the first one begins.
        let others = if o.is_first {
            0
        } else {
            store.get(o.error_register)
        };
        let register = others | i64::from(self.faults.register());
        store.show(o.error_register, register);
        let mode = if self.quirks.any() {
            self.quirks.shown_mode()
        } else {
            self.mode
        };
        store.show(o.mode_display, mode.map_or(0, Mode::code));
        store.show(o.position, self.frame.turned(self.frame.show(counts)));
        store.show(
            o.velocity,
            polarity.velocity(whole(velocity / p.velocity_unit)),
        );
        store.show(
            o.torque,
            polarity.torque(whole(current * torque_per_ampere)),
        );
        let error = self.motion.following_error(demand, counts);
        store.show(o.following_error, polarity.way(whole(error)));
        let (position, speed) = match demand {
            Demand::Off => (float(counts), 0.0),
            _ => self.motion.demanded(),
        };
        let shown = self.frame.show(whole(position));
        store.show(o.position_demand, self.frame.turned(shown));
        store.show(
            o.velocity_demand,
            polarity.velocity(whole(speed / p.velocity_unit)),
        );
        if let (Some(slot), Some(mechanics)) = (o.load_position, &self.mechanics) {
            store.show(slot, polarity.way(mechanics.counts()));
        }
        if let Some(slot) = o.velocity_averaged {
            let averaged = self.controller.averaged_velocity();
            store.show(slot, polarity.velocity(whole(averaged / p.velocity_unit)));
        }
        if let Some(slot) = o.torque_averaged {
            let averaged = self.controller.averaged_current();
            store.show(slot, polarity.torque(whole(averaged * torque_per_ampere)));
        }
        if let Some(slot) = o.current {
            store.show(slot, whole(current * 1e3));
        }
        if let Some(slot) = o.current_averaged {
            store.show(slot, whole(self.controller.averaged_current() * 1e3));
        }
        if let Some(slot) = o.current_demand {
            store.show(slot, whole(self.controller.current_demand() * 1e3));
        }
        if let Some(slot) = o.thermal_level {
            store.show(slot, whole(self.controller.thermal_level() * 1e2));
        }
    }
}

/// Rounds without `f64::round`, which is a library call on some processors.
#[expect(clippy::cast_possible_truncation, reason = "saturates")]
fn whole(value: f64) -> i64 {
    (value + 0.5_f64.copysign(value)) as i64
}
