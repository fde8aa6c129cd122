//! Supervises outputs and SYNC0 while SYNC0 triggers the outputs.
//!
//! A counter grows by 3 with every SYNC0 without new outputs and shrinks by 1 with every other
//! SYNC0. Above 0x10F1:02 the device leaves Op (ETG.1020, "synchronization errors"). Without that
//! object, or with zero in it, only the watchdog supervises the outputs. SYNC0 itself counts as
//! lost after three periods.

use super::SimDevice;
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};
use crate::drive::{CONTROL_PERIOD_NS, DeviceError};
use crate::esc::al::{AlState, code};

const MISSED: u32 = 3;
/// The number of SYNC0 periods without a pulse after which SYNC0 is lost.
const MAX_PERIODS: u64 = 3;

#[derive(Debug, Clone)]
pub(super) struct Supervision {
    /// The limit, 0x10F1:02.
    limit: Option<EntryHandle>,
    /// The counters 0x1C32:0B and 0x1C32:20.
    missed: Option<EntryHandle>,
    sync_error: Option<EntryHandle>,
    /// True if outputs arrived since entry to SafeOp and the watchdog has not expired after it.
    received: bool,
    /// True if outputs arrived since the last SYNC0.
    fresh: bool,
    /// True if outputs arrived since entry to Op.
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
            received: false,
            fresh: false,
            began: false,
            errors: 0,
            last_sync0: 0,
        }
    }

    /// True if valid outputs have come.
    pub(super) fn has_outputs(&self) -> bool {
        self.received
    }

    /// Ends the validity of the outputs that have come so far.
    pub(super) fn end_outputs(&mut self) {
        self.received = false;
    }

    /// Begins to supervise with the first outputs in Op.
    pub(super) fn enter_op(&mut self) {
        self.fresh = false;
    }

    fn restart(&mut self) {
        (self.began, self.errors) = (false, 0);
    }
}

impl SimDevice {
    /// Handles SyncManagers that were written to the last byte.
    pub(super) fn outputs_came(&mut self, written: u8) {
        if self.process.iter().any(|d| written >> d.sm & 1 != 0) {
            self.supervision.fresh = true;
            self.supervision.received = true;
            self.arrivals.push(self.esc.clock.true_time(self.local));
            self.continue_to_op();
        }
    }

    /// Counts a SYNC0 pulse before it takes effect.
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

    /// Checks in the control cycle that SYNC0 still arrives.
    pub(super) fn watch_sync0(&mut self) {
        if self.al.state != AlState::Op || !self.sync0_decides() {
            return;
        }
        let period = self.esc.dc.as_ref().map_or(0, |dc| dc.sync.cycle0);
        let timeout = MAX_PERIODS * u64::from(period) + CONTROL_PERIOD_NS;
        if self.local.saturating_sub(self.supervision.last_sync0) > timeout {
            self.fall_to(
                AlState::SafeOp,
                code::FATAL_SYNC_ERROR,
                DeviceError::SyncLost,
            );
        }
    }
}
