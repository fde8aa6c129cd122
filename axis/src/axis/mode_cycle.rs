//! Mode switches of drives that change their mode of operation only without power
//! ([`AxisConfig::mode_change_unpowered`](super::AxisConfig)).
//!
//! The axis stands, and its power is removed as by [`super::Command::Disable`]. Then 0x6060 gets the
//! new mode. Once 0x6061 shows it, the axis is enabled again: the command that switches the mode is
//! the command for this power. Any stop, trip or fault meanwhile ends the switch without power.

use super::Axis;
use super::stop::PowerGoal;
use crate::cia402::{Mode, State};

/// Longest time in seconds from the new mode until the drive follows set-points again, in addition
/// to the time for the mode.
const ENABLE_S: f64 = 10.0;

/// A mode switch without power.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ModeCycle {
    from: Mode,
    pub(super) to: Mode,
    /// Time in seconds since the power was removed.
    unpowered_s: f64,
    /// Time in seconds for which the drive was commanded to lose its power, and kept it.
    kept_s: f64,
}

impl Axis {
    /// Removes the power of an axis at rest for a mode switch. Has no effect during a stop, which ends
    /// without power: nothing may give it back.
    pub(super) fn begin_mode_cycle(&mut self, to: Mode) {
        if self.goal != PowerGoal::On {
            return;
        }
        self.switch_failed = None;
        self.remove_power_at_rest();
        self.mode_cycle = Some(ModeCycle {
            from: self.mode,
            to,
            unpowered_s: 0.0,
            kept_s: 0.0,
        });
    }

    /// Gives a switch in progress another mode. There is no power, so the drive accepts it.
    pub(super) const fn redirect_mode_cycle(&mut self, to: Mode) {
        if let Some(cycle) = &mut self.mode_cycle {
            (cycle.to, cycle.unpowered_s) = (to, 0.0);
        }
    }

    /// Ends a switch in progress. Power does not return.
    pub(super) fn cancel_mode_cycle(&mut self) {
        if self.mode_cycle.take().is_some() && self.goal == PowerGoal::On && !self.has_control() {
            self.goal = PowerGoal::Off;
        }
    }

    /// True before the drive is commanded to lose its power for a switch: a loss of power is not the
    /// planned one.
    pub(super) fn precedes_mode_cycle(&self) -> bool {
        let waits = matches!(self.goal, PowerGoal::Stopping(stop) if !stop.removes_power());
        self.mode_cycle.is_some() && waits
    }

    fn fail_mode_cycle(&mut self, to: Mode) {
        self.cancel_mode_cycle();
        self.switch_failed = Some(to);
    }

    /// Advances a switch in progress, once per cycle.
    pub(super) fn settle_mode_cycle(&mut self, fresh: bool, dt_s: f64) {
        let Some(mut cycle) = self.mode_cycle.filter(|_| fresh) else {
            return;
        };
        if self.fault.is_some() || self.trip.is_some() {
            self.cancel_mode_cycle();
            return;
        }
        if self.mode == cycle.to && self.follows() {
            self.mode_cycle = None;
            return;
        }
        let unpowered = matches!(self.state, State::SwitchOnDisabled | State::ReadyToSwitchOn);
        match self.goal {
            PowerGoal::Stopping(stop) => {
                if stop.removes_power() {
                    cycle.kept_s += dt_s;
                }
                self.mode_cycle = Some(cycle);
                if cycle.kept_s > self.config.mode_time_s {
                    self.fail_mode_cycle(cycle.to);
                }
                return;
            }
            PowerGoal::Off if unpowered => {
                self.mode = cycle.to;
                let shown = self.config.mode_display_enabled || self.mode_confirmed();
                if shown && cycle.unpowered_s > 0.0 && self.enable().is_err() {
                    self.fail_mode_cycle(cycle.to);
                    return;
                }
            }
            PowerGoal::Off | PowerGoal::On => {}
        }
        cycle.unpowered_s += dt_s;
        self.mode_cycle = Some(cycle);
        let most_s = match self.goal {
            PowerGoal::On => self.config.mode_time_s + ENABLE_S,
            _ => self.config.mode_time_s,
        };
        if cycle.unpowered_s > most_s {
            if self.goal != PowerGoal::On {
                // The drive keeps its previous mode.
                self.mode = cycle.from;
            }
            self.fail_mode_cycle(cycle.to);
        }
    }
}
