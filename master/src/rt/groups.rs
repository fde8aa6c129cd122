//! What stops together: a group from the cause that stops it to the moment its axes may be enabled again.
//!
//! The first group is what no other holds, and always there: where it stops, the machine stops, and the other way round.

use ecaxis_axis::{Command, Refused};

use super::guard::StopCause;
use crate::clock::Nanos;
use crate::config::{Machine, Outside, StopBy};

/// How an axis is brought to rest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Way {
    By(StopBy),
    Emergency,
}

/// A stop under way, or done.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stop {
    /// The first; what comes later is a consequence, and only makes the stop shorter.
    pub cause: StopCause,
    pub since: Nanos,
    severity: u8,
    /// One of the axes has been reset since.
    acknowledged: bool,
}

/// Axes that stop together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Group {
    /// How its other axes stop when one faults, trips, or can no longer follow.
    others: StopBy,
    /// The machine goes on without it.
    alone: bool,
    /// How long its slowest axis may take from full speed to rest. One that is not at rest this long
    /// after the group began to stop is left to its drive's own quick stop.
    pub patience: Nanos,
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
        let rest = (stop.others, false);
        let named = stop.groups.iter();
        let named = named.map(|group| (group.others, group.outside == Outside::Continue));
        let groups = std::iter::once(rest).chain(named).enumerate();
        groups
            .map(|(index, (others, alone))| {
                let devices = machine.devices.iter().enumerate();
                let own = devices.filter(|(device, _)| machine.group_of(*device) == index);
                let axes = own.filter_map(|(_, device)| device.axis.as_ref());
                let times = axes.map(|axis| {
                    let limits = axis.config.limits;
                    limits.velocity / limits.acceleration
                });
                Self {
                    alone,
                    ..Self::machine(others, times.fold(0.0, f64::max))
                }
            })
            .collect()
    }

    /// A machine without groups, whose slowest axis comes to rest in `ramp_s` seconds.
    #[must_use]
    pub fn machine(others: StopBy, ramp_s: f64) -> Self {
        Self {
            others,
            alone: false,
            patience: patience(ramp_s),
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

    /// Begins to stop at `now`, or stops anew by a shorter way. `false`: it is stopping for something as grave already.
    pub(super) fn begin(&mut self, cause: StopCause, severity: u8, now: Nanos) -> bool {
        if self.stop.is_some_and(|stop| severity <= stop.severity) {
            return false;
        }
        let before = self
            .stop
            .map_or((cause, now), |stop| (stop.cause, stop.since));
        self.stop = Some(Stop {
            cause: before.0,
            since: before.1,
            severity,
            acknowledged: false,
        });
        true
    }

    /// What `cause`, if it is the group's own, does to its axes.
    pub(super) fn way(&self, cause: StopCause, bus_lost: StopBy) -> Way {
        match cause {
            StopCause::BusLost { .. } | StopCause::LeftOp { .. } => Way::By(bus_lost),
            StopCause::DriveFault { .. }
            | StopCause::Trip { .. }
            | StopCause::FollowLost { .. } => Way::By(self.others),
            StopCause::Requested | StopCause::Controller | StopCause::Powered { .. } => {
                Way::By(StopBy::Ramp)
            }
            StopCause::EmergencyStop => Way::Emergency,
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

/// The slowest axis' time from full speed to rest, and a second for the drive.
fn patience(slowest_s: f64) -> Nanos {
    // Longer than an hour is as good as for ever; the cast saturates.
    1_000_000_000 + (slowest_s.min(3600.0) * 1e9) as Nanos
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
