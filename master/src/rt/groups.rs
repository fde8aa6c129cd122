//! What stops together: a group from the cause that stops it to the moment its axes may be enabled again.
//!
//! The first group is what no other holds, and always there: where it stops, the machine stops, and the other way round.

use ecaxis_axis::{Command, Refused, StopMethod};

use super::guard::StopCause;
use crate::clock::Nanos;
use crate::config::{Machine, Outside};

/// A stop under way, or done.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stop {
    /// The first; what comes later is a consequence.
    pub cause: StopCause,
    pub since: Nanos,
    /// What failed while a stop that was asked for was under way.
    pub failure: Option<StopCause>,
    /// One of the axes has been reset since.
    acknowledged: bool,
}

/// Axes that stop together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Group {
    /// How its other axes stop when one faults, trips, or can no longer follow.
    others: StopMethod,
    /// The machine goes on without it.
    alone: bool,
    stop: Option<Stop>,
    /// Stops so far that the machine went on through.
    pub stops: u32,
    /// Found in this cycle.
    pub(super) found: Option<StopCause>,
}

/// One group after one cycle.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GroupStatus {
    /// First cause, from the stop to the reset that ends it.
    pub stopped: Option<StopCause>,
    /// Times that it has stopped while the machine went on.
    pub stops: u32,
    /// Its process data is this cycle's.
    pub fresh: bool,
    /// One of its axes has power, as far as its process data tells.
    pub powered: bool,
}

impl Group {
    /// All groups of a machine.
    #[must_use]
    #[allow(
        clippy::disallowed_methods,
        clippy::disallowed_macros,
        reason = "prepares"
    )]
    pub fn all(machine: &Machine) -> Vec<Self> {
        let stop = &machine.stop;
        let rest = Self::machine(stop.others);
        let named = stop.groups.iter().map(|group| Self {
            alone: group.outside == Outside::Continue,
            ..Self::machine(group.others)
        });
        std::iter::once(rest).chain(named).collect()
    }

    /// A machine without groups.
    #[must_use]
    pub const fn machine(others: StopMethod) -> Self {
        Self {
            others,
            alone: false,
            stop: None,
            stops: 0,
            found: None,
        }
    }

    #[must_use]
    pub fn stop(&self) -> Option<Stop> {
        self.stop
    }

    /// Whether the machine goes on when it stops.
    pub(super) fn alone(&self) -> bool {
        self.alone
    }

    /// Begins to stop at `now`. `false`: it is stopping already; a failure then is the stop's own, if it was asked for.
    pub(super) fn begin(&mut self, cause: StopCause, now: Nanos) -> bool {
        if let Some(stop) = &mut self.stop {
            if !stop.cause.is_failure() && cause.is_failure() {
                stop.failure.get_or_insert(cause);
            }
            return false;
        }
        self.stop = Some(Stop {
            cause,
            since: now,
            failure: None,
            acknowledged: false,
        });
        true
    }

    /// How `cause`, if it is the group's own, stops its axes; those whose device is missing are left to their drives.
    pub(super) fn method(&self, cause: StopCause) -> StopMethod {
        match cause {
            StopCause::DriveFault { .. }
            | StopCause::Trip { .. }
            | StopCause::FollowLost { .. } => self.others,
            _ => StopMethod::Ramp,
        }
    }

    pub(super) fn acknowledge(&mut self) {
        if let Some(stop) = &mut self.stop {
            stop.acknowledged = true;
        }
    }

    /// Nothing keeps it stopped any more: `true` where somebody wants it back.
    pub(super) fn release(&mut self) -> bool {
        let released = self.stop.is_some_and(|stop| stop.acknowledged);
        if released {
            self.stop = None;
        }
        released
    }
}

/// What axes that are being stopped still take.
fn stops(command: Command) -> bool {
    matches!(
        command,
        Command::Disable | Command::QuickStop | Command::EmergencyStop | Command::DisableVoltage
    )
}

/// Whether an axis of a group may be told something. RT.
pub(super) fn admit(groups: &mut [Group], group: usize, command: Command) -> Result<(), Refused> {
    let machine_stops = groups.first().is_some_and(|rest| rest.stop.is_some());
    if stops(command) {
        return Ok(());
    }
    if machine_stops {
        return Err(Refused::Stopping);
    }
    match groups.get_mut(group) {
        Some(group) if group.stop.is_some() => {
            if command != Command::ResetFault {
                return Err(Refused::GroupStopped);
            }
            group.acknowledge();
            Ok(())
        }
        _ => Ok(()),
    }
}
