//! What the axis is to do with the power, and how one wish leads to the next.

use super::{Axis, Plan};
use crate::cia402::State;

/// A quick stop that was to end disabled ends so after this time even if the axis still turns; a deceleration that was to end
/// disabled, after having waited this long for lost frames.
const QUICK_STOP_LIMIT_S: f64 = 2.0;

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

impl Axis {
    /// Where a wish has been fulfilled, the next one follows from it. Time passes here whether frames are lost or not: power
    /// is taken away in bounded time even if none ever comes back.
    pub(super) fn settle_wish(&mut self, dt_s: f64) {
        let stopping = matches!(self.state, State::OperationEnabled | State::QuickStopActive);
        let at_rest = self.setpoint_at_rest() && !self.cut_short;
        self.wish = match self.wish {
            Wish::Disabling { frozen_s } => {
                let limits = self.config.limits;
                // The drive's own ramps may be gentler than ours, but not for ever.
                let drive = self.plan == Plan::Drive;
                let patience = if drive {
                    QUICK_STOP_LIMIT_S + 2.0 * limits.velocity / limits.acceleration
                } else {
                    QUICK_STOP_LIMIT_S
                };
                if !self.active || at_rest || frozen_s > patience {
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
                    Wish::Disabled
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
}
