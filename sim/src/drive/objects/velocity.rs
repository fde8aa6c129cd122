//! When a speed counts as reached, as zero, as slipping: 0x606D–0x6070 and 0x60F8, where the ESI has
//! them.

use super::binder::Binder;
use super::{cycles, float, uint};
use crate::coe::store::{ObjectStore, Slot};

#[derive(Debug, Clone)]
pub(super) struct VelocitySlots {
    window: Option<Slot>,
    window_time: Option<Slot>,
    threshold: Option<Slot>,
    threshold_time: Option<Slot>,
    max_slippage: Option<Slot>,
}

/// Counts/s and control cycles. `None`: not given, or zero.
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
            window: b.0.slot(0x606d, 0),
            window_time: b.0.slot(0x606e, 0),
            threshold: b.0.slot(0x606f, 0),
            threshold_time: b.0.slot(0x6070, 0),
            max_slippage: b.0.slot(0x60f8, 0),
        }
    }

    pub(super) fn read(&self, store: &ObjectStore, velocity_unit: f64) -> VelocityWindows {
        let speed = |slot: Option<Slot>| {
            let value = uint(store, slot?);
            (value > 0).then(|| float(value) * velocity_unit)
        };
        let time = |slot: Option<Slot>| slot.map_or(0, |slot| cycles(uint(store, slot)));
        VelocityWindows {
            window: speed(self.window),
            window_time: time(self.window_time),
            threshold: speed(self.threshold),
            threshold_time: time(self.threshold_time),
            max_slippage: speed(self.max_slippage),
        }
    }
}
