//! From the inputs to the outputs: every axis once a cycle.

use ecaxis_axis::StopPhase;

use super::{Engine, Nanos};
use crate::rt::feed;
use crate::rt::guard::StopCause;

impl Engine {
    /// Cycles that were left out sent nothing, and drives hold what they got last: the axes go on from there. They are told before
    /// the frames that wait are sent, which are from before.
    pub(super) fn catch_up(&mut self, woke: Nanos) {
        let before = self.woke.replace(woke).unwrap_or(woke);
        let silent = woke.saturating_sub(before) / self.timing.cycle_ns;
        if silent < 2 {
            return;
        }
        let skipped = u32::try_from(silent - 1).unwrap_or(u32::MAX);
        for slot in &mut self.axes {
            let outputs = slot.axis.skipped(skipped);
            slot.write(self.exchange.outputs_mut(), &outputs);
        }
        self.exchange.restage();
    }

    /// Masters before those that follow them, so that a follower's set-point is of the same cycle.
    pub(super) fn act(&mut self) {
        self.stop_missing_axes();
        // Gears form no rings, so every round acts on one axis at least.
        for _ in 0..self.axes.len() {
            let mut waiting = false;
            for index in 0..self.axes.len() {
                let Some(slot) = self.axes.get(index) else {
                    continue;
                };
                if slot.acted {
                    continue;
                }
                let followed = slot.feed.master().and_then(|(m, _)| self.axes.get(m));
                if followed.is_some_and(|master| !master.acted) {
                    waiting = true;
                } else {
                    self.act_on(index);
                }
            }
            if !waiting {
                break;
            }
        }
        for group in 0..self.groups.len() {
            if let Some(cause) = self.groups.get_mut(group).and_then(|g| g.found.take()) {
                // A group that cannot be stopped is not one to go on without.
                let own = !matches!(cause, StopCause::Powered { .. });
                self.stop(own.then_some(group), cause);
            }
        }
    }

    /// One axis; what of it has to stop its group is noted there.
    fn act_on(&mut self, index: usize) {
        let dt_s = self.timing.cycle_ns as f64 * 1e-9;
        let master = self.axes.get(index).and_then(|slot| {
            let (master, actual) = slot.feed.master()?;
            let status = self.axes.get(master)?.axis.status();
            feed::master_motion(&status, actual)
        });
        let Some(slot) = self.axes.get_mut(index) else {
            return;
        };
        let Some(group) = self.groups.get_mut(slot.group) else {
            return;
        };
        slot.acted = true;
        let lost = slot.feed.give(&mut slot.axis, &self.tables, master, dt_s);
        let outputs = slot.axis.act();
        slot.write(self.exchange.outputs_mut(), &outputs);
        let status = slot.axis.status();
        slot.armed |= slot.ordered && status.fault.is_none();
        if status.enabled {
            slot.largest_following_error =
                slot.largest_following_error.max(status.max_following_error);
            slot.last_enabled = Some(status);
        }
        if group.stop().is_some() {
            if status.stop.is_some_and(|s| s.phase == StopPhase::PowerKept) {
                group.found = Some(StopCause::Powered { axis: index });
            }
            // By command, or by itself where the machine file says so.
            if status.resetting {
                group.acknowledge();
            }
        }
        let cause = match (status.fault, status.trip) {
            (Some(_), _) if slot.armed => Some(StopCause::DriveFault { axis: index }),
            (None, Some(trip)) if slot.armed => Some(StopCause::Trip { axis: index, trip }),
            _ => lost.then_some(StopCause::FollowLost { axis: index }),
        };
        group.found = group.found.or(cause);
    }
}
