//! Groups that stop while the machine goes on: told once, remembered for whoever needs one of their axes.

use std::sync::Arc;

use super::Supervisor;
use crate::config::{Action, Step};
use crate::rt::groups::GroupStatus;
use crate::rt::guard::StopCause;
use crate::rt::handover::Snapshot;
use crate::session::{GroupStop, Progress, RunError};
use crate::story::Witnessed;
use crate::story::look::Depth;

/// A stop of a group that the machine went on through.
#[derive(Debug, Clone)]
pub struct StoppedGroup {
    /// As in [`crate::config::Machine::group_of`].
    pub group: usize,
    /// Which of its stops it is, from 1.
    pub number: u32,
    pub cause: Arc<RunError>,
    pub witnessed: Witnessed,
    pub released: bool,
}

impl Supervisor {
    pub(super) fn group_of(&self, axis: usize) -> usize {
        let device = self.axes.get(axis);
        device.map_or(0, |&device| self.machine.group_of(device))
    }

    pub(super) fn group_name(&self, group: usize) -> String {
        self.machine.group_name(group).to_owned()
    }

    /// Whether the machine goes on without this group.
    pub(super) fn is_stopped(&self, group: usize) -> bool {
        self.stop_of(group).is_some()
    }

    fn stop_of(&self, group: usize) -> Option<&StoppedGroup> {
        let last = self.stopped.iter().rev().find(|s| s.group == group);
        last.filter(|stop| !stop.released)
    }

    /// What has become of groups since the last look.
    pub(super) async fn tell_of_groups(&mut self, snapshot: &Snapshot) {
        // A group that can no longer follow another one is explained by what stopped that.
        let follows = |now: &GroupStatus| matches!(now.stopped, Some(StopCause::FollowLost { .. }));
        let groups = snapshot.groups.iter().enumerate();
        let mut groups: Vec<_> = groups.collect();
        groups.sort_by_key(|(_, now)| follows(now));
        for (group, now) in groups {
            let last = self.stopped.iter_mut().rev().find(|s| s.group == group);
            let told = last.as_ref().map_or(0, |last| last.number);
            let over = now.stopped.is_none() || now.stops != told;
            if let Some(last) = last
                && over
                && !last.released
            {
                last.released = true;
                let group = self.group_name(group);
                self.tell(Progress::GroupReleased { group });
            }
            // A stop that was over before anybody looked has no cause any more.
            if let Some(cause) = now.stopped
                && now.stops != told
            {
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
                });
                let group = self.group_name(group);
                self.tell(Progress::GroupStopped { group, cause });
            }
        }
    }

    /// For the summary.
    pub(super) fn group_stops(&self) -> Vec<GroupStop> {
        let stops = self.stopped.iter();
        stops
            .map(|stop| GroupStop {
                group: self.group_name(stop.group),
                cause: stop.cause.to_string(),
                released: stop.released,
            })
            .collect()
    }

    /// Fails with what stopped the first of these axes, if one is stopped with its group.
    pub(super) fn none_stopped(&self, step: Option<&Step>, axes: &[usize]) -> Result<(), RunError> {
        let stopped = axes.iter().find_map(|&axis| {
            let stop = self.stop_of(self.group_of(axis))?;
            Some((axis, stop))
        });
        let Some((axis, stop)) = stopped else {
            return Ok(());
        };
        Err(RunError::GroupStopped {
            device: self.device_of(axis),
            step: step.map(Into::into),
            group: self.group_name(stop.group),
            cause: Arc::clone(&stop.cause),
        })
    }
}

/// The axes that a step cannot do without, as devices; a stopped group may be reset and disabled.
pub(super) fn needed(action: &Action) -> Vec<usize> {
    let targets = |targets: &[(usize, f64)]| targets.iter().map(|&(device, _)| device).collect();
    match action {
        Action::Enable { axes } | Action::Home { axes } | Action::Stop { axes } => axes.clone(),
        Action::Move { targets: t, .. }
        | Action::Line { targets: t, .. }
        | Action::Velocity { targets: t, .. }
        | Action::Torque { targets: t, .. } => targets(t),
        Action::Mode { targets } => targets.iter().map(|&(device, _)| device).collect(),
        Action::Wave { axis, .. } | Action::Table { axis, .. } | Action::Probe { axis, .. } => {
            vec![*axis]
        }
        Action::Gear { axis, master, .. } => vec![*axis, *master],
        Action::Disable { .. }
        | Action::Reset { .. }
        | Action::Dwell { .. }
        | Action::Wait { .. }
        | Action::Set { .. }
        | Action::Repeat { .. } => Vec::new(),
    }
}
