//! What the axis is to do with the power, and how one wish leads to the next.

use super::{Axis, Plan};
use crate::cia402::State;
use crate::supervision::FaultReset;

/// A quick stop that was to end disabled ends so after this time even if the axis still turns; a deceleration that was to end
/// disabled, after having waited this long for lost frames.
const QUICK_STOP_LIMIT_S: f64 = 2.0;

/// An axis that has been enabled this long without a fault has all its automatic resets again.
const FORGET_S: f64 = 60.0;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Wish {
    Disabled,
    Enabled,
    /// Brake, then disable.
    Disabling {
        frozen_s: f64,
    },
    QuickStop {
        then_disable: bool,
        elapsed_s: f64,
    },
}

/// The brake, as far as it is known here.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Hold {
    /// It is to be open.
    pub(super) open: bool,
    /// For so long it has been open, or, at rest, closed.
    since_s: f64,
}

/// Automatic fault resets.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Resets {
    pub(super) tried: u8,
    waited_s: f64,
    healthy_s: f64,
}

impl Axis {
    /// Where a wish has been fulfilled, the next one follows from it. Time passes here whether frames are lost or not: power
    /// is taken away in bounded time even if none ever comes back.
    pub(super) fn settle_wish(&mut self, dt_s: f64) {
        self.hold.since_s = (self.hold.since_s + dt_s).min(FORGET_S * FORGET_S);
        if matches!(self.wish, Wish::Enabled | Wish::Disabled) {
            return;
        }
        let stopping = matches!(self.state, State::OperationEnabled | State::QuickStopActive);
        let at_rest = self.setpoint_at_rest() && !self.cut_short;
        self.wish = match self.wish {
            Wish::Disabling { .. } if !self.active => Wish::Disabled,
            Wish::Disabling { .. } if at_rest => self.once_held(self.wish),
            Wish::Disabling { frozen_s } => {
                let limits = self.config.limits;
                // The drive's own ramps may be gentler than ours, but not for ever.
                let drive = self.plan == Plan::Drive;
                let patience = if drive {
                    QUICK_STOP_LIMIT_S + 2.0 * limits.velocity / limits.acceleration
                } else {
                    QUICK_STOP_LIMIT_S
                };
                if frozen_s > patience {
                    Wish::Disabled
                } else {
                    let passed = if drive || self.frozen() { dt_s } else { 0.0 };
                    Wish::Disabling {
                        frozen_s: frozen_s + passed,
                    }
                }
            }
            Wish::QuickStop { .. } if !stopping => Wish::Disabled,
            Wish::QuickStop {
                then_disable: true,
                elapsed_s,
            } => {
                let stopped = self.state == State::QuickStopActive && self.standing();
                if stopped || elapsed_s > QUICK_STOP_LIMIT_S {
                    self.once_held(self.wish)
                } else {
                    Wish::QuickStop {
                        then_disable: true,
                        elapsed_s: elapsed_s + dt_s,
                    }
                }
            }
            other => other,
        };
    }

    /// At rest: the brake closes, and power goes once it holds.
    fn once_held(&mut self, until: Wish) -> Wish {
        if self.hold.open {
            self.hold = Hold::default();
        }
        if self.hold.since_s >= self.config.brake.engage_s {
            Wish::Disabled
        } else {
            until
        }
    }

    /// After the power: an axis that is enabled has its brake opened, one without power has it closed.
    pub(super) fn settle_brake(&mut self) {
        let powered = matches!(self.state, State::OperationEnabled | State::QuickStopActive);
        if self.active && self.wish == Wish::Enabled && !self.hold.open {
            self.hold = Hold {
                open: true,
                since_s: 0.0,
            };
        } else if !powered && self.hold.open {
            self.hold = Hold::default();
        }
    }

    /// The brake has not opened yet.
    pub(super) fn braked(&self) -> bool {
        !self.hold.open || self.hold.since_s < self.config.brake.release_s
    }

    /// Resets a fault by itself, if that is configured and not tried too often.
    pub(super) fn settle_reset(&mut self, dt_s: f64) {
        let FaultReset::Automatic { tries, delay_s } = self.config.fault_reset else {
            return;
        };
        if self.active {
            self.resets.healthy_s += dt_s;
            if self.resets.healthy_s > FORGET_S {
                self.resets.tried = 0;
            }
            return;
        }
        self.resets.healthy_s = 0.0;
        if self.state != State::Fault || self.reset {
            self.resets.waited_s = 0.0;
            return;
        }
        self.resets.waited_s += dt_s;
        if self.resets.waited_s >= delay_s && self.resets.tried < tries {
            self.resets.tried = self.resets.tried.saturating_add(1);
            self.resets.waited_s = 0.0;
            self.reset_failed = false;
            self.reset = true;
        }
    }
}
