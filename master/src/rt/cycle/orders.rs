//! What the cycle is told to do, by the supervisor or by what has happened: orders and stops.

use ecaxis_axis::{Axis, Command, Refused};

use super::{Engine, has_power};
use crate::config::{StopBy, StopByDrive};
use crate::rt::feed::{self, Start};
use crate::rt::groups::{Group, Stop, Way, admit};
use crate::rt::guard::StopCause;
use crate::rt::handover::{Event, ORDERS_A_CYCLE, Order};
use crate::rt::history::Anchor;
use crate::rt::slot::AxisSlot;

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
                let Some(slot) = self.axes.get_mut(axis) else {
                    return;
                };
                let admitted = admit(&mut self.groups, slot.group, command);
                if let Err(reason) = admitted.and_then(|()| slot.command(command)) {
                    // A stopping machine takes no new motion, and whoever ordered it will be told of the stop.
                    if self.stopping().is_some() {
                        return;
                    }
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
            Order::Stop => self.stop(None, StopCause::Requested),
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
        self.stop(None, StopCause::Requested);
        let since = self.stopping().map_or(self.next, |stop| stop.since);
        let patience = self.groups.iter().map(|group| group.patience).max();
        self.halted =
            self.without_power() || self.next.saturating_sub(since) > 2 * patience.unwrap_or(0);
    }

    /// Of the machine.
    pub(super) fn stopping(&self) -> Option<Stop> {
        self.groups.first().and_then(Group::stop)
    }

    /// A cause that belongs to one group stops that group by its own way, and with it the rest of the machine, within the limits of its
    /// axes, unless it may go on. `None`: it belongs to all of them.
    pub(super) fn stop(&mut self, own: Option<usize>, cause: StopCause) {
        let goes_on = own
            .and_then(|own| self.groups.get(own))
            .is_some_and(Group::alone);
        let machine_stops = self.stopping().is_some();
        if !goes_on {
            self.history.stopping(match cause {
                StopCause::Requested => Anchor::Requested,
                _ => Anchor::Failure,
            });
        }
        if let Some(own) = own.filter(|_| goes_on) {
            self.leave_lines(own);
        }
        for group in 0..self.groups.len() {
            if own.is_none_or(|own| own == group) {
                let first = self.stop_group(group, cause, cause.severity(), None);
                if first && goes_on && !machine_stops {
                    if let Some(group) = self.groups.get_mut(group) {
                        group.stops = group.stops.saturating_add(1);
                    }
                    let cycle = self.stats.counters.cycles;
                    self.report(Event::GroupStopping {
                        cycle,
                        group,
                        cause,
                    });
                }
            } else if !goes_on {
                let severity = StopCause::Requested.severity();
                self.stop_group(group, cause, severity, Some(Way::By(StopBy::Ramp)));
            }
        }
        if !machine_stops && !goes_on {
            let cycle = self.stats.counters.cycles;
            self.report(Event::Stopping { cycle, cause });
        }
    }

    /// A line that loses an axis with its group is no line any more for the others.
    fn leave_lines(&mut self, own: usize) {
        let mut slots = self.axes.iter();
        if !slots.any(|slot| slot.group == own && slot.feed.on_line()) {
            return;
        }
        for (axis, slot) in self.axes.iter_mut().enumerate() {
            if slot.group == own || !slot.feed.on_line() {
                continue;
            }
            slot.feed.part();
            if let Some(group) = self.groups.get_mut(slot.group) {
                group.found = group.found.or(Some(StopCause::FollowLost { axis }));
            }
        }
    }

    /// By `way`, or as the cause demands. The first cause wins: its axes decelerate within their limits and are then disabled; where the bus
    /// is not to be trusted, the drives do it by themselves, from the velocity that they know. `true`: it was not stopping before.
    fn stop_group(
        &mut self,
        index: usize,
        cause: StopCause,
        severity: u8,
        way: Option<Way>,
    ) -> bool {
        let Some(group) = self.groups.get_mut(index) else {
            return false;
        };
        let first = group.stop().is_none();
        if !group.begin(cause, severity, self.next) {
            return false;
        }
        let bus_lost = match self.stop_setup.bus_lost {
            StopByDrive::QuickStop => StopBy::QuickStop,
            StopByDrive::NoPower => StopBy::NoPower,
        };
        let way = way.unwrap_or_else(|| group.way(cause, bus_lost));
        for slot in self.axes.iter_mut().filter(|slot| slot.group == index) {
            // An axis that does not take a command has no power, or is losing it already.
            match way {
                Way::By(StopBy::QuickStop) => quick_stop(&mut slot.axis),
                Way::By(StopBy::NoPower) => {
                    let _ = slot.axis.command(Command::DisableVoltage);
                }
                Way::Emergency => {
                    let _ = slot.axis.command(Command::EmergencyStop);
                }
                Way::By(StopBy::Ramp) if slot.axis.status().enabled => {
                    let _ = slot.axis.command(Command::Stop);
                }
                Way::By(StopBy::Ramp) => {
                    let _ = slot.axis.command(Command::Disable);
                }
            }
            slot.feed.end();
        }
        first
    }

    /// Groups that have been reset may be enabled again: once they are at rest without power, no fault or trip is left, and their
    /// process data is there.
    pub(super) fn release(&mut self) {
        if self.stopping().is_some() {
            return;
        }
        for index in 0..self.groups.len() {
            let there = self.exchange.shares().get(index).is_some_and(|s| s.fresh)
                && self.guard.lost(index).is_none();
            let idle = |slot: &AxisSlot| {
                let status = slot.axis.status();
                let sound = status.fault.is_none() && status.trip.is_none();
                sound && !has_power(status.state)
            };
            let mut own = self.axes.iter().filter(|slot| slot.group == index);
            let Some(group) = self.groups.get_mut(index) else {
                continue;
            };
            if group.stop().is_none() || !there || !own.all(idle) || !group.release() {
                continue;
            }
            for slot in self.axes.iter_mut().filter(|slot| slot.group == index) {
                slot.disarm();
            }
            let cycle = self.stats.counters.cycles;
            let group = index;
            self.report(Event::GroupReleased { cycle, group });
        }
    }

    fn begin_feed(&mut self, axis: usize, start: Start) {
        if self.stopping().is_some() {
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
            let stopped = |group: &Group| group.stop().is_some();
            if self.groups.get(slot.group).is_some_and(stopped) {
                slot.feed.refuse(Refused::GroupStopped);
                return;
            }
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

/// The drive's own quick stop, then no power.
pub(super) fn quick_stop(axis: &mut Axis) {
    let _ = axis.command(Command::QuickStop);
    let _ = axis.command(Command::Disable);
}
