//! Whether outputs and SYNC0 keep in step while SYNC0 decides when outputs count.
//!
//! Outputs: a counter grows by 3 with every SYNC0 that finds no new ones and shrinks by 1 with every
//! other; above 0x10F1:02 the device leaves Op (ETG.1020, "synchronization errors"). A device without
//! that object, or with zero there, leaves it to its watchdog. SYNC0 itself is missed after three periods.

use super::SimDevice;
use crate::coe::store::{ObjectStore, Slot};
use crate::drive::{CONTROL_PERIOD_NS, DeviceError};
use crate::esc::al::{AlState, code};

const MISSED: u32 = 3;
/// SYNC0 periods without a pulse.
const PATIENCE: u64 = 3;

#[derive(Debug, Clone)]
pub(super) struct Supervision {
    /// 0x10F1:02.
    limit: Option<Slot>,
    /// 0x1C32:0B and 0x1C32:20.
    missed: Option<Slot>,
    sync_error: Option<Slot>,
    /// Outputs came since the last SYNC0.
    fresh: bool,
    /// They have begun to come since Op was entered.
    began: bool,
    errors: u32,
    /// Local time.
    last_sync0: u64,
}

impl Supervision {
    pub(super) fn new(store: &ObjectStore) -> Self {
        Self {
            limit: store.slot(0x10f1, 2),
            missed: store.slot(0x1c32, 0x0b),
            sync_error: store.slot(0x1c32, 0x20),
            fresh: false,
            began: false,
            errors: 0,
            last_sync0: 0,
        }
    }

    fn restart(&mut self) {
        (self.began, self.errors) = (false, 0);
    }
}

impl SimDevice {
    /// SyncManagers were written to the last byte.
    pub(super) fn outputs_came(&mut self, written: u8) {
        if self.process.iter().any(|d| written >> d.sm & 1 != 0) {
            self.supervision.fresh = true;
            self.arrivals.push(self.esc.clock.true_time(self.local));
        }
    }

    /// A SYNC0 pulse, before it takes effect.
    pub(super) fn count_sync0(&mut self) {
        let s = &mut self.supervision;
        s.last_sync0 = self.local;
        let fresh = std::mem::take(&mut s.fresh);
        if self.al.state != AlState::Op {
            s.restart();
            return;
        }
        s.began |= fresh;
        if fresh || !s.began {
            s.errors = s.errors.saturating_sub(1);
            return;
        }
        s.errors = s.errors.saturating_add(MISSED);
        if let Some(slot) = s.missed {
            self.store.set(slot, self.store.get(slot) + 1);
        }
        let limit = s.limit.map_or(0, |slot| self.store.get(slot));
        if limit > 0 && i64::from(s.errors) > limit {
            if let Some(slot) = s.sync_error {
                self.store.set(slot, 1);
            }
            s.restart();
            self.fall_to(AlState::SafeOp, code::SYNC_ERROR, DeviceError::RxPdoTimeout);
        }
    }

    /// The control cycle looks whether SYNC0 still comes.
    pub(super) fn watch_sync0(&mut self) {
        if self.al.state != AlState::Op || !self.sync0_decides() {
            return;
        }
        let period = self.esc.dc.as_ref().map_or(0, |dc| dc.sync.cycle0);
        let patience = PATIENCE * u64::from(period) + CONTROL_PERIOD_NS;
        if self.local.saturating_sub(self.supervision.last_sync0) > patience {
            self.fall_to(
                AlState::SafeOp,
                code::FATAL_SYNC_ERROR,
                DeviceError::SyncLost,
            );
        }
    }
}
