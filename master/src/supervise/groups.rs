//! Groups that stop while the machine continues. Each stop is reported once and kept for later
//! steps that need its axes.

use std::sync::Arc;

use ecaxis_ecat::index::{AxisIndex, GroupIndex};

use super::Supervisor;
use super::failure_reader::{Findings, Inquiry, StopDetails};
use crate::config::{Action, OutputRef, Step};
use crate::post_mortem::Witnessed;
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

/// A stop whose devices are being read.
#[derive(Debug, Clone, Copy)]
pub(crate) struct InquiredStop {
    group: GroupIndex,
    number: u32,
    idle: bool,
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

    /// Returns the groups that have stopped, as far as this is reported.
    pub(super) fn stopped_groups(&self) -> Vec<GroupIndex> {
        let stops = self.stopped.iter().filter(|stop| !stop.released);
        stops.map(|stop| stop.group).collect()
    }

    /// Returns the error that stopped the last group without this axis.
    pub(super) fn stop_of_others(&self, axis: AxisIndex) -> Option<Arc<Error>> {
        let own = self.group_of(axis);
        let mut others = self.stopped.iter().rev();
        let last = others.find(|stop| !stop.released && stop.group != own)?;
        Some(Arc::clone(&last.cause))
    }

    /// Reports groups that stopped or were released since the last call. The devices of a stopped
    /// group are read meanwhile. Returns true once every stop is reported.
    pub(super) async fn report_stopped_groups(&mut self, snapshot: &Snapshot) -> bool {
        loop {
            let Some(mut inquiries) = self.inquiries.take() else {
                return true;
            };
            let findings = inquiries.findings.try_recv().ok();
            self.inquiries = Some(inquiries);
            if let Some(findings) = findings {
                self.take_findings(findings).await;
            } else if self.inquired.is_some() {
                return false;
            }
            if !self.inquire_next(snapshot) {
                return true;
            }
        }
    }

    /// Reports released groups. Requests the cause of the next stop that is not reported. Returns
    /// false if there is none.
    fn inquire_next(&mut self, snapshot: &Snapshot) -> bool {
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
            let Some(cause) = now.stopped.filter(|_| now.stops != reported) else {
                continue;
            };
            let stop = StopDetails {
                cause,
                group: Some(group),
                stopped: self.stopped_groups(),
                followed: cause.axis().and_then(|axis| self.stop_of_others(axis)),
            };
            self.inquired = Some(InquiredStop {
                group,
                number: now.stops,
                idle: self.machine.is_optional(group) && !now.powered,
            });
            let snapshot = snapshot.clone();
            let inquiries = self.inquiries.as_ref().map(|port| &port.inquiries);
            // There is one inquiry at a time, so it has room.
            let sent =
                inquiries.is_some_and(|port| port.try_send(Inquiry { stop, snapshot }).is_ok());
            return sent;
        }
        false
    }

    async fn take_findings(&mut self, findings: Findings) {
        let Some(InquiredStop {
            group,
            number,
            idle,
        }) = self.inquired.take()
        else {
            return;
        };
        self.note_error_code(&findings.explanation).await;
        let cause = Arc::new(findings.explanation.error);
        self.stopped.push(StoppedGroup {
            group,
            number,
            cause: Arc::clone(&cause),
            witnessed: findings.witnessed,
            released: false,
            idle,
        });
        let group = self.group_name(group);
        self.report(match idle {
            true => Progress::GroupWaits { group },
            false => Progress::GroupStopped { group, cause },
        });
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

    /// Fails if a device of these outputs was lost and its group is not reset yet: its outputs are off.
    pub(super) async fn ensure_unlocked(
        &mut self,
        step: &Step,
        values: &[(OutputRef, f64)],
    ) -> Result<(), Error> {
        let machine = Arc::clone(&self.machine);
        let snapshot = self.poll_snapshot().await?;
        let mut devices = values
            .iter()
            .filter_map(|(output, _)| Some(machine.outputs.get(output.0)?.device));
        let locked = devices.find(|device| snapshot.locked_outputs.get(*device) == Some(&true));
        let Some(device) = locked else {
            return Ok(());
        };
        self.report_stopped_groups(&snapshot).await;
        match self.stop_of(machine.group_of(device)) {
            Some(stop) => Err(Cause::GroupStopped {
                group: self.group_name(stop.group),
                cause: Arc::clone(&stop.cause),
            }
            .with_device(&self.bus.devices[device].at)
            .with_step(step)),
            None => Ok(()),
        }
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
