//! Axes that stop together, from the cause of a stop until they may be enabled again.
//!
//! The first group always exists and holds all axes without a group. If it stops, the machine
//! stops, and vice versa.

use ecaxis_axis::{Command, CommandError, StopMethod};
use ecaxis_ecat::index::{GroupIndex, IndexVec};

use super::bus_monitor::StopCause;
use super::config::{GroupConfig, GroupStopScope};
use super::overrides::Override;
use crate::clock::Nanos;

/// A stop in progress or completed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActiveStop {
    /// The first cause; later ones are consequences.
    pub cause: StopCause,
    pub since: Nanos,
    /// A failure during a requested stop.
    pub failure: Option<StopCause>,
    /// True once one of the axes was reset after the stop.
    acknowledged: bool,
}

/// Axes that stop together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReactionGroup {
    config: GroupConfig,
    stop: Option<ActiveStop>,
    /// Stops so far during which the machine continued.
    pub stops: u32,
    /// The cause found in this cycle.
    pub(super) found: Option<StopCause>,
}

/// The status of one group after one cycle.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GroupStatus {
    /// The first cause, from the stop until the reset.
    pub stopped: Option<StopCause>,
    /// Stops so far during which the machine continued.
    pub stops: u32,
    /// True if the group's process data is from this cycle.
    pub fresh: bool,
    /// True if one of its axes has power according to its process data.
    pub powered: bool,
    /// The override of the group alone; of the first group, that of the machine.
    pub rate: Override,
}

impl ReactionGroup {
    #[must_use]
    pub const fn new(config: GroupConfig) -> Self {
        Self {
            config,
            stop: None,
            stops: 0,
            found: None,
        }
    }

    #[must_use]
    pub fn stop(&self) -> Option<ActiveStop> {
        self.stop
    }

    /// True if the machine continues when this group stops.
    pub(super) fn continues_without(&self) -> bool {
        self.config.outside == GroupStopScope::Continue
    }

    /// Begins a stop at `now`. Returns false if the group is already stopping. A failure during a
    /// requested stop is then stored as the failure of that stop.
    pub(super) fn begin(&mut self, cause: StopCause, now: Nanos) -> bool {
        if let Some(stop) = &mut self.stop {
            if !stop.cause.is_failure() && cause.is_failure() {
                stop.failure.get_or_insert(cause);
            }
            return false;
        }
        self.stop = Some(ActiveStop {
            cause,
            since: now,
            failure: None,
            acknowledged: false,
        });
        true
    }

    /// Returns how `cause` stops the group's axes. Axes of missing devices are handled elsewhere.
    pub(super) fn method(&self, cause: StopCause) -> StopMethod {
        match cause {
            StopCause::DriveFault { .. }
            | StopCause::Trip { .. }
            | StopCause::NodeLost { .. }
            | StopCause::FollowLost { .. } => self.config.others,
            _ => StopMethod::Ramp,
        }
    }

    pub(super) fn acknowledge(&mut self) {
        if let Some(stop) = &mut self.stop {
            stop.acknowledged = true;
        }
    }

    /// Ends the stop after its conditions are met. Returns true if an axis was reset since the
    /// stop.
    pub(super) fn release(&mut self) -> bool {
        let released = self.stop.is_some_and(|stop| stop.acknowledged);
        if released {
            self.stop = None;
        }
        released
    }
}

/// True for commands that a stopping axis still accepts.
fn stops(command: Command) -> bool {
    matches!(
        command,
        Command::Disable | Command::QuickStop | Command::EmergencyStop | Command::DisableVoltage
    )
}

/// Checks whether an axis of a group may receive a command. RT.
pub(super) fn check_permitted(
    groups: &mut IndexVec<GroupIndex, ReactionGroup>,
    group: GroupIndex,
    command: Command,
) -> Result<(), CommandError> {
    let machine_stops = groups.first().is_some_and(|rest| rest.stop.is_some());
    if stops(command) {
        return Ok(());
    }
    if machine_stops {
        return Err(CommandError::Stopping);
    }
    match groups.get_mut(group) {
        Some(group) if group.stop.is_some() => {
            if command != Command::ResetFault {
                return Err(CommandError::GroupStopped);
            }
            group.acknowledge();
            Ok(())
        }
        _ => Ok(()),
    }
}
