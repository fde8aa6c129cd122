//! The limits of the current: 0x3001:02, 0x6072, 0x6073, 0x60E0 and 0x60E1.

use super::bind::{Binder, RW};
use super::{float, uint, whole};
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};
use crate::drive::plant::PlantParams;

/// An optional limit of the drive. In process data zero means zero; in an object that was never
/// written it means "no limit".
#[derive(Debug, Clone, Copy)]
struct Limit {
    slot: EntryHandle,
    mapped: bool,
}

#[derive(Debug, Clone)]
pub(super) struct TorqueSlots {
    rated_torque: EntryHandle,
    /// Counts of 0x6076 per N·m.
    counts_per_newton_metre: f64,
    output_current_limit: Option<EntryHandle>,
    max_torque: Option<Limit>,
    max_current: Option<Limit>,
    /// 0x60E0, 0x60E1.
    directions: [Option<Limit>; 2],
}

/// The current limits of both directions, in A. Neither is negative.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::drive) struct CurrentLimits {
    pub forward: f64,
    pub backward: f64,
}

impl CurrentLimits {
    pub(in crate::drive) fn clamp(self, current: f64) -> f64 {
        current.clamp(-self.backward, self.forward)
    }
}

impl Limit {
    /// Returns the limit in thousandths, if it is active.
    fn get(self, store: &ObjectStore) -> Option<f64> {
        let value = uint(store, self.slot);
        (value > 0 || self.mapped).then(|| float(value))
    }
}

/// Returns the counts of 0x6076 per N·m. The unit comes from the dictionary (ETG.1004: newton metre
/// is 0x56, the highest byte a power of ten). Without one, the unit is µNm for a maxon drive and
/// mNm otherwise.
fn counts_per_newton_metre(b: &Binder<'_>, rated_torque: EntryHandle) -> f64 {
    const NEWTON_METRE: u32 = 0x56;
    let unit = b.store.item(rated_torque).map_or(0, |item| item.unit);
    if unit & 0x00ff_ffff == NEWTON_METRE << 16 {
        let [.., power] = unit.to_le_bytes();
        return 10f64.powi(-i32::from(i8::from_le_bytes([power])));
    }
    if b.is_maxon() { 1e6 } else { 1e3 }
}

impl TorqueSlots {
    pub(super) fn bind(b: &mut Binder<'_>, plant: &PlantParams) -> Self {
        let rated_torque = b.bind(0x6076, 0, "Motor rated torque", 32, RW);
        let counts_per_newton_metre = counts_per_newton_metre(b, rated_torque);
        let rated = whole(plant.rated_torque() * counts_per_newton_metre);
        b.motor_data(rated_torque, rated);
        if let Some(rated_current) = b.slot(0x6075, 0) {
            b.motor_data(rated_current, whole(plant.nominal_current * 1e3));
        }
        // Without a factory value in the ESI: the torque at the current limit, in thousandths of
        // the rated torque. Zero would leave a drive without torque as soon as it is mapped.
        let peak = whole(1000.0 * plant.current_limit / plant.nominal_current.max(1e-9));
        let mut limit = |index| {
            let slot = b.slot(index, 0)?;
            b.fill(slot, peak);
            Some(Limit {
                slot,
                mapped: false,
            })
        };
        let max_torque = limit(0x6072);
        let max_current = limit(0x6073);
        let directions = [0x60e0, 0x60e1].map(limit);
        Self {
            rated_torque,
            counts_per_newton_metre,
            output_current_limit: b.own(0x3001, 2, "Output current limit"),
            max_torque,
            max_current,
            directions,
        }
    }

    fn limits(&mut self) -> impl Iterator<Item = &mut Limit> {
        let [forward, backward] = &mut self.directions;
        [
            &mut self.max_torque,
            &mut self.max_current,
            forward,
            backward,
        ]
        .into_iter()
        .flatten()
    }

    /// Sets the mapped limits. True if a limit changes with the process data.
    pub(super) fn set_mapped(&mut self, is_mapped: impl Fn(EntryHandle) -> bool) -> bool {
        let mut any = false;
        for limit in self.limits() {
            limit.mapped = is_mapped(limit.slot);
            any |= limit.mapped;
        }
        any
    }

    /// Returns the rated torque, in N·m.
    pub(super) fn rated(&self, store: &ObjectStore) -> f64 {
        float(uint(store, self.rated_torque)) / self.counts_per_newton_metre
    }

    /// Returns the limits. `inverted`: torques on the bus have the opposite sign.
    pub(super) fn read(
        &self,
        store: &ObjectStore,
        plant: &PlantParams,
        inverted: bool,
    ) -> CurrentLimits {
        let ampere = match plant.torque_constant {
            k if k > 0.0 => 1e-3 * self.rated(store) / k,
            _ => f64::INFINITY,
        };
        let torque = |limit: Option<Limit>| limit?.get(store).map(|value| value * ampere);
        let current =
            |limit: Option<Limit>| limit?.get(store).map(|v| v * 1e-3 * plant.nominal_current);
        let least = |limits: &[Option<f64>]| {
            limits
                .iter()
                .flatten()
                .fold(plant.current_limit, |least, &limit| least.min(limit))
        };
        let both = least(&[
            self.output_current_limit
                .map(|slot| float(uint(store, slot)) * 1e-3),
            torque(self.max_torque),
            current(self.max_current),
        ]);
        let mut directions = self
            .directions
            .map(|limit| torque(limit).map_or(both, |limit| limit.min(both)));
        if inverted {
            directions.reverse();
        }
        let [forward, backward] = directions;
        CurrentLimits {
            forward: forward.max(0.0),
            backward: backward.max(0.0),
        }
    }
}
