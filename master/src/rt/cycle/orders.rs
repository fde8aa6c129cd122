//! What the cycle is told to do, by the supervisor or by what has happened: orders and stops.

use ecaxis_axis::{Axis, Command};

use super::Engine;
use crate::config::{StopBy, StopByDrive};
use crate::rt::feed::{self, Start};
use crate::rt::guard::StopCause;
use crate::rt::handover::{Event, ORDERS_A_CYCLE, Order};

impl Engine {
    /// Everything handed over so far, so that what belongs together begins in the same cycle.
    pub(super) fn take_orders(&mut self) {
        for _ in 0..ORDERS_A_CYCLE {
            let Ok(order) = self.end.orders.pop() else {
                if self.end.orders.is_abandoned() && !self.halted {
                    self.end_alone();
                }
                return;
            };
            self.orders_taken += 1;
            self.take(order);
        }
    }

    fn take(&mut self, order: Order) {
        match order {
            Order::Axis { axis, command } => {
                // A stopping machine takes no new motion.
                if self.stopping.is_some() && !stops(command) {
                    return;
                }
                let Some(slot) = self.axes.get_mut(axis) else {
                    return;
                };
                if let Err(reason) = slot.command(command) {
                    let cycle = self.stats.counters.cycles;
                    self.report(Event::Refused {
                        cycle,
                        axis,
                        reason,
                    });
                }
            }
            Order::Feed { axis, start } => self.begin_feed(axis, start),
            Order::Output { output, value } => {
                if let Some(signal) = self.signals.outputs.get(output) {
                    signal.set(self.exchange.outputs_mut(), value);
                }
            }
            Order::Guard => self.guarding = true,
            Order::Unguard => self.guarding = false,
            Order::Stop => self.stop(StopCause::Requested),
            Order::ErrorCode { axis, code } => {
                if let Some(slot) = self.axes.get_mut(axis) {
                    slot.axis.note_error_code(code);
                }
            }
            Order::Halt => self.halted = true,
        }
    }

    /// The supervisor is gone without saying so: stop, then end the loop.
    fn end_alone(&mut self) {
        self.stop(StopCause::Requested);
        let since = self.stopping.map_or(self.next, |(_, since)| since);
        self.halted = self.without_power()
            || self.next.saturating_sub(since) > 2 * self.timing.stop_patience_ns;
    }

    /// The first cause wins. All axes decelerate within their limits and are then disabled; where the
    /// bus is not to be trusted, the drives do it by themselves, from the velocity that they know.
    pub(super) fn stop(&mut self, cause: StopCause) {
        if cause.severity() <= self.severity {
            return;
        }
        self.severity = cause.severity();
        // What comes later is a consequence, and only makes the stop shorter.
        let first = *self.stopping.get_or_insert((cause, self.next));
        let way = match cause {
            StopCause::BusLost { .. } | StopCause::LeftOp { .. } => {
                match self.stop_setup.bus_lost {
                    StopByDrive::QuickStop => StopBy::QuickStop,
                    StopByDrive::NoPower => StopBy::NoPower,
                }
            }
            StopCause::DriveFault { .. }
            | StopCause::Trip { .. }
            | StopCause::FollowLost { .. } => self.stop_setup.others,
            StopCause::Requested | StopCause::Controller | StopCause::EmergencyStop => StopBy::Ramp,
        };
        for slot in &mut self.axes {
            // An axis that does not take a command has no power, or is losing it already.
            match way {
                StopBy::QuickStop => quick_stop(&mut slot.axis),
                StopBy::NoPower => {
                    let _ = slot.axis.command(Command::DisableVoltage);
                }
                StopBy::Ramp if cause == StopCause::EmergencyStop => {
                    let _ = slot.axis.command(Command::EmergencyStop);
                }
                StopBy::Ramp if slot.axis.status().enabled => {
                    let _ = slot.axis.command(Command::Stop);
                }
                StopBy::Ramp => {
                    let _ = slot.axis.command(Command::Disable);
                }
            }
            slot.feed.end();
        }
        let cycle = self.stats.counters.cycles;
        if first.0 == cause {
            self.report(Event::Stopping { cycle, cause });
        }
    }

    fn begin_feed(&mut self, axis: usize, start: Start) {
        if self.stopping.is_some() {
            return;
        }
        let master = match start {
            Start::Gear { master, actual, .. } => self
                .axes
                .get(master)
                .and_then(|slot| feed::master_motion(&slot.axis.status(), actual)),
            _ => None,
        };
        let ring = matches!(start, Start::Gear { master, .. } if self.follows(master, axis));
        if let Some(slot) = self.axes.get_mut(axis) {
            let status = slot.axis.status();
            slot.feed.begin(start, &status, master, ring);
        }
    }

    /// Whether an axis is led by another, over however many gears.
    fn follows(&self, axis: usize, leader: usize) -> bool {
        let mut at = Some(axis);
        for _ in 0..=self.axes.len() {
            match at {
                Some(axis) if axis == leader => return true,
                Some(axis) => at = self.axes.get(axis).and_then(|s| Some(s.feed.master()?.0)),
                None => return false,
            }
        }
        true
    }
}

/// What a machine that is being stopped still takes.
pub(in crate::rt) fn stops(command: Command) -> bool {
    matches!(
        command,
        Command::Disable | Command::QuickStop | Command::EmergencyStop | Command::DisableVoltage
    )
}

/// The drive's own quick stop, then no power.
pub(super) fn quick_stop(axis: &mut Axis) {
    let _ = axis.command(Command::QuickStop);
    let _ = axis.command(Command::Disable);
}
