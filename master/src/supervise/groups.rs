//! Groups that stop while the machine continues. Each stop is reported once and kept for later
//! steps that need its axes.

use std::sync::Arc;

use ecaxis_ecat::index::{AxisIndex, GroupIndex};

use super::Supervisor;
use crate::config::{Action, Step};
use crate::post_mortem::Witnessed;
use crate::post_mortem::snapshot::Depth;
use crate::report::{Cause, Error, GroupStop, Progress};
use crate::rt::bus_monitor::StopCause;
use crate::rt::channel::Snapshot;
use crate::rt::reaction_group::GroupStatus;

/// A stop of a group during which the machine continued.
#[derive(Debug, Clone)]
pub struct StoppedGroup {
    pub group: GroupIndex,
    /// The number of the stop within its group, from 1.
    pub number: u32,
    pub cause: Arc<Error>,
    pub witnessed: Witnessed,
    pub released: bool,
    /// All devices of the group are optional, and no axis had power: no failure.
    pub idle: bool,
}

impl Supervisor {
    pub(super) fn group_of(&self, axis: AxisIndex) -> GroupIndex {
        self.machine.group_of_axis(axis)
    }

    pub(super) fn group_name(&self, group: GroupIndex) -> String {
        self.machine.group_name(group).to_owned()
    }

    /// Returns `true` if the machine continues without this group.
    pub(super) fn is_stopped(&self, group: GroupIndex) -> bool {
        self.stop_of(group).is_some()
    }

    fn stop_of(&self, group: GroupIndex) -> Option<&StoppedGroup> {
        let last = self.stopped.iter().rev().find(|s| s.group == group);
        last.filter(|stop| !stop.released)
    }

    /// Reports groups that stopped or were released since the last call.
    pub(super) async fn report_stopped_groups(&mut self, snapshot: &Snapshot) {
        // Followers come last: the stop of the group they followed explains theirs.
        let follows = |now: &GroupStatus| matches!(now.stopped, Some(StopCause::FollowLost { .. }));
        let groups = snapshot.groups.enumerate();
        let mut groups: Vec<_> = groups.collect();
        groups.sort_by_key(|(_, now)| follows(now));
        for (group, now) in groups {
            let last = self.stopped.iter_mut().rev().find(|s| s.group == group);
            let reported = last.as_ref().map_or(0, |last| last.number);
            let over = now.stopped.is_none() || now.stops != reported;
            if let Some(last) = last
                && over
                && !last.released
            {
                last.released = true;
                let group = self.group_name(group);
                self.report(Progress::GroupReleased { group });
            }
            // A stop that has already ended has no cause any more.
            if let Some(cause) = now.stopped
                && now.stops != reported
            {
                let idle = self.machine.is_optional(group) && !now.powered;
                let cause = self.explain_stop(cause, Some(group), snapshot).await;
                let cause = Arc::new(cause);
                let witnessed = Witnessed {
                    looks: self.look(Depth::Brief).await,
                    group: Some(group),
                };
                self.stopped.push(StoppedGroup {
                    group,
                    number: now.stops,
                    cause: Arc::clone(&cause),
                    witnessed,
                    released: false,
                    idle,
                });
                let group = self.group_name(group);
                self.report(match idle {
                    true => Progress::GroupWaits { group },
                    false => Progress::GroupStopped { group, cause },
                });
            }
        }
    }

    /// Returns the stops for the summary.
    pub(super) fn group_stops(&self) -> Vec<GroupStop> {
        let stops = self.stopped.iter().filter(|stop| !stop.idle);
        stops
            .map(|stop| GroupStop {
                group: self.group_name(stop.group),
                cause: stop.cause.to_string(),
                released: stop.released,
            })
            .collect()
    }

    /// Fails with the cause of the first of these axes whose group is stopped.
    pub(super) fn ensure_not_stopped(
        &self,
        step: Option<&Step>,
        axes: &[AxisIndex],
    ) -> Result<(), Error> {
        let stopped = axes.iter().find_map(|&axis| {
            let stop = self.stop_of(self.group_of(axis))?;
            Some((axis, stop))
        });
        let Some((axis, stop)) = stopped else {
            return Ok(());
        };
        let error = Cause::GroupStopped {
            group: self.group_name(stop.group),
            cause: Arc::clone(&stop.cause),
        }
        .with_device(self.device_of(axis));
        Err(match step {
            Some(step) => error.with_step(step),
            None => error,
        })
    }
}

/// Returns the axes that a step needs to run. Resetting and disabling work in a
/// stopped group.
pub(super) fn needed(action: &Action) -> Vec<AxisIndex> {
    match action {
        Action::Disable { .. } | Action::Reset { .. } => Vec::new(),
        Action::Gear { axis, master, .. } => std::iter::once(*axis).chain(master.axis()).collect(),
        action => action.commanded(),
    }
}
