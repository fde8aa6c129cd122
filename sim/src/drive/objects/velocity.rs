//! Thresholds for target speed, zero speed and slippage: 0x606D–0x6070 and 0x60F8, if the ESI has
//! them.

use super::bind::Binder;
use super::{cycles, float, uint};
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};

#[derive(Debug, Clone)]
pub(super) struct VelocitySlots {
    window: Option<EntryHandle>,
    window_time: Option<EntryHandle>,
    threshold: Option<EntryHandle>,
    threshold_time: Option<EntryHandle>,
    max_slippage: Option<EntryHandle>,
}

/// Thresholds in counts/s and control cycles. `None`: no value, or zero.
#[derive(Debug, Clone, Copy, Default)]
pub(in crate::drive) struct VelocityWindows {
    pub window: Option<f64>,
    pub window_time: u32,
    pub threshold: Option<f64>,
    pub threshold_time: u32,
    pub max_slippage: Option<f64>,
}

impl VelocitySlots {
    pub(super) fn find(b: &Binder<'_>) -> Self {
        Self {
            window: b.slot(0x606d, 0),
            window_time: b.slot(0x606e, 0),
            threshold: b.slot(0x606f, 0),
            threshold_time: b.slot(0x6070, 0),
            max_slippage: b.slot(0x60f8, 0),
        }
    }

    pub(super) fn read(&self, store: &ObjectStore, velocity_unit: f64) -> VelocityWindows {
        let speed = |slot: Option<EntryHandle>| {
            let value = uint(store, slot?);
            (value > 0).then(|| float(value) * velocity_unit)
        };
        let time = |slot: Option<EntryHandle>| slot.map_or(0, |slot| cycles(uint(store, slot)));
        VelocityWindows {
            window: speed(self.window),
            window_time: time(self.window_time),
            threshold: speed(self.threshold),
            threshold_time: time(self.threshold_time),
            max_slippage: speed(self.max_slippage),
        }
    }
}
