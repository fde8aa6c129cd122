//! Homing: 0x6098–0x609A, the home position, and maxon's 0x30B0–0x30B2.

use super::bind::{Binder, RW};
use super::{float, int, uint, whole};
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};
use crate::drive::modes::METHODS;
use crate::quirks::Quirks;

#[derive(Debug, Clone)]
pub(super) struct HomingSlots {
    method: EntryHandle,
    search_speed: EntryHandle,
    zero_speed: EntryHandle,
    acceleration: EntryHandle,
    /// 0x30B0, or 0x607C without it.
    home_position: Option<EntryHandle>,
    distance: Option<EntryHandle>,
    current_threshold: Option<EntryHandle>,
}

/// Homing parameters, in counts and seconds.
#[derive(Debug, Clone, Copy, Default)]
pub(in crate::drive) struct HomingParameters {
    pub method: i64,
    /// 0x6099:01, in counts/s.
    pub search_speed: f64,
    /// 0x6099:02, in counts/s.
    pub zero_speed: f64,
    /// 0x609A, in counts/s².
    pub acceleration: f64,
    /// The value of 0x6064 at the end of homing.
    pub home_position: i64,
    /// 0x30B1: the distance from the reference found to the end position, in counts.
    pub distance: i64,
    /// 0x30B2, in A.
    pub current_threshold: f64,
}

/// Fills 0x60E3 as far as the ESI has entries. Method 35 does the same as 37.
fn list_methods(b: &mut Binder<'_>) {
    let listed = METHODS.iter().filter(|&&code| code != 35);
    for (sub, code) in (1..).zip(listed) {
        if let Some(slot) = b.slot(0x60e3, sub) {
            b.fill(slot, *code);
        }
    }
}

const DISTANCE: (u16, &str, u32) = (0x30b1, "Home offset move distance", 32);
const THRESHOLD: (u16, &str, u32) = (0x30b2, "Current threshold for homing mode", 16);
/// The default of 0x30B2, in mA.
const THRESHOLD_MA: i64 = 500;

/// Adds maxon's objects to a dictionary without vendor-specific objects. 0x30B0 is not added: such
/// a dictionary has 0x607C.
pub(super) fn add(b: &mut Binder<'_>) {
    for (index, name, bits) in [DISTANCE, THRESHOLD] {
        b.bind(index, 0, name, bits, RW);
    }
}

impl HomingSlots {
    /// Binds the objects. `per_rpm`, `per_rpm_s`: the drive's units of speed and acceleration.
    pub(super) fn bind(b: &mut Binder<'_>, per_rpm: f64, per_rpm_s: f64, quirks: &Quirks) -> Self {
        let units = |value: f64| whole(value).clamp(1, 0xffff_ffff);
        let method = b.with_default(0x6098, 0, "Homing method", 8, 37);
        b.choose(method, METHODS);
        list_methods(b);
        let home_position = b.own(0x30b0, 0, "Home position").or(b.slot(0x607c, 0));
        if let Some(slot) = home_position.filter(|_| quirks.home_offset_not_kept) {
            b.store.ignore_writes(slot);
        }
        Self {
            method,
            search_speed: b.with_default(
                0x6099,
                1,
                "Speed for switch search",
                32,
                units(100.0 * per_rpm),
            ),
            zero_speed: b.with_default(
                0x6099,
                2,
                "Speed for zero search",
                32,
                units(10.0 * per_rpm),
            ),
            acceleration: b.with_default(
                0x609a,
                0,
                "Homing acceleration",
                32,
                units(1000.0 * per_rpm_s),
            ),
            home_position,
            distance: b.own(DISTANCE.0, 0, DISTANCE.1),
            current_threshold: b
                .own(THRESHOLD.0, 0, THRESHOLD.1)
                .inspect(|&slot| b.fill(slot, THRESHOLD_MA)),
        }
    }

    /// Reads the parameters. Speed and acceleration units are in counts/s and counts/s².
    pub(super) fn read(
        &self,
        store: &ObjectStore,
        velocity_unit: f64,
        acceleration_unit: f64,
    ) -> HomingParameters {
        let signed = |slot: Option<EntryHandle>| slot.map_or(0, |slot| int(store, slot));
        HomingParameters {
            method: int(store, self.method),
            search_speed: float(uint(store, self.search_speed)) * velocity_unit,
            zero_speed: float(uint(store, self.zero_speed)) * velocity_unit,
            acceleration: float(uint(store, self.acceleration).max(1)) * acceleration_unit,
            home_position: signed(self.home_position),
            distance: signed(self.distance),
            current_threshold: self
                .current_threshold
                .map_or_else(|| float(THRESHOLD_MA), |slot| float(uint(store, slot)))
                * 1e-3,
        }
    }
}
