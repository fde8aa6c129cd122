//! Reports of drives that limit what they are commanded.

use crate::report::Progress;
use crate::rt::channel::Snapshot;

use super::Supervisor;

/// The cycles in which a drive still catches up after missed targets.
const CATCH_UP_CYCLES: u64 = 50;

/// What has been reported of one axis.
#[derive(Debug, Clone, Copy, Default)]
pub struct ReportedLimits {
    by_command: bool,
    by_missed_targets: bool,
}

/// The frames that did not bring a target in time.
#[derive(Debug, Clone, Copy, Default)]
pub struct MissedTargets {
    total: u64,
    /// The cycle in which the total last changed.
    last: u64,
}

impl MissedTargets {
    /// Returns true while the drives catch up on missed targets.
    fn observe(&mut self, snapshot: &Snapshot) -> bool {
        let lost = snapshot.counters.lost_frames;
        let total = lost.saturating_add(snapshot.late_wake_ups);
        let cycles = snapshot.counters.cycles;
        if total != self.total {
            (self.total, self.last) = (total, cycles);
        }
        total > 0 && cycles.saturating_sub(self.last) <= CATCH_UP_CYCLES
    }
}

impl Supervisor {
    /// Reports Statusword bit 11 (internal limit active) for each axis: once after missed targets,
    /// where a drive in CSP brakes and accelerates again, and once at any other time.
    pub(super) fn report_limits(&mut self, snapshot: &Snapshot) {
        let missed = self.missed.observe(snapshot);
        for (axis, status) in snapshot.axes.enumerate() {
            if !status.internal_limit || !status.enabled {
                continue;
            }
            let reported = &mut self.limited[axis];
            let (reported, cause) = match missed {
                false => (&mut reported.by_command, ""),
                true => (
                    &mut reported.by_missed_targets,
                    " to catch up after late or lost frames",
                ),
            };
            if !std::mem::replace(reported, true) {
                let device = self.device_of(axis);
                self.report(Progress::Warning(format!(
                    "{device}: the drive limits what it is commanded{cause} (Statusword bit 11, internal limit active)"
                )));
            }
        }
    }
}
