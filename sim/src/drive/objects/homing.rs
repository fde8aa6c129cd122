//! Homing: 0x6098–0x609A, the home position, and maxon's 0x30B0–0x30B2.

use super::binder::{Binder, RW};
use super::{float, int, uint, whole};
use crate::coe::store::{ObjectStore, Slot};
use crate::drive::modes::METHODS;

#[derive(Debug, Clone)]
pub(super) struct HomingSlots {
    method: Slot,
    search_speed: Slot,
    zero_speed: Slot,
    acceleration: Slot,
    /// 0x30B0, else 0x607C.
    home_position: Option<Slot>,
    distance: Option<Slot>,
    current_threshold: Option<Slot>,
}

/// In counts and seconds.
#[derive(Debug, Clone, Copy, Default)]
pub(in crate::drive) struct HomingParameters {
    pub method: i64,
    /// Counts/s, 0x6099:01.
    pub search_speed: f64,
    /// Counts/s, 0x6099:02.
    pub zero_speed: f64,
    /// Counts/s², 0x609A.
    pub acceleration: f64,
    /// What 0x6064 shows where the axis ends up.
    pub home_position: i64,
    /// Counts from the place found to where the axis ends up, 0x30B1.
    pub distance: i64,
    /// A, 0x30B2.
    pub current_threshold: f64,
}

/// 0x60E3, as far as the ESI has room; 35 does what 37 does.
fn list_methods(b: &mut Binder<'_>) {
    let listed = METHODS.iter().filter(|&&code| code != 35);
    for (sub, code) in (1..).zip(listed) {
        if let Some(slot) = b.0.slot(0x60e3, sub) {
            b.fill(slot, *code);
        }
    }
}

const DISTANCE: (u16, &str, u32) = (0x30b1, "Home offset move distance", 32);
const THRESHOLD: (u16, &str, u32) = (0x30b2, "Current threshold for homing mode", 16);
/// mA.
const THRESHOLD_MA: i64 = 500;

/// For a dictionary that says nothing about its maker's objects. Not 0x30B0: such a dictionary has 0x607C.
pub(super) fn add(b: &mut Binder<'_>) {
    for (index, name, bits) in [DISTANCE, THRESHOLD] {
        b.bind(index, 0, name, bits, RW);
    }
}

impl HomingSlots {
    /// `per_rpm`, `per_rpm_s`: the drive's units of speed and acceleration.
    pub(super) fn bind(b: &mut Binder<'_>, per_rpm: f64, per_rpm_s: f64) -> Self {
        let units = |value: f64| whole(value).clamp(1, 0xffff_ffff);
        let method = b.with_default(0x6098, 0, "Homing method", 8, 37);
        b.choose(method, METHODS);
        list_methods(b);
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
            home_position: b.own(0x30b0, 0, "Home position").or(b.0.slot(0x607c, 0)),
            distance: b.own(DISTANCE.0, 0, DISTANCE.1),
            current_threshold: b
                .own(THRESHOLD.0, 0, THRESHOLD.1)
                .inspect(|&slot| b.fill(slot, THRESHOLD_MA)),
        }
    }

    /// Counts/s and counts/s² a unit.
    pub(super) fn read(
        &self,
        store: &ObjectStore,
        velocity_unit: f64,
        acceleration_unit: f64,
    ) -> HomingParameters {
        let signed = |slot: Option<Slot>| slot.map_or(0, |slot| int(store, slot));
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
