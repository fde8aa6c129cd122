//! What the cycle is told to do, by the supervisor or by what has happened: orders and stops.

use ecaxis_axis::{Command, Refused, StopMethod};

use super::Engine;
use crate::rt::feed::{self, Start};
use crate::rt::groups::{Group, Stop, admit};
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
            Order::Guard => {
                self.guarding = true;
                self.exchange.expect_op(true);
            }
            Order::Unguard => {
                self.guarding = false;
                self.exchange.expect_op(false);
                self.axes.iter_mut().for_each(AxisSlot::disarm);
            }
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
        self.halted = self.stop_ended();
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
        if cause != StopCause::Requested {
            self.exchange.stop_windows(own.filter(|_| goes_on));
        }
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
                let first = self.stop_group(group, cause, None);
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
                self.stop_group(group, cause, Some(StopMethod::Ramp));
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

    /// By `method`, or as the cause demands; an axis that stops already stops no gentler. `true`: it was not stopping before.
    fn stop_group(&mut self, index: usize, cause: StopCause, method: Option<StopMethod>) -> bool {
        let Some(group) = self.groups.get_mut(index) else {
            return false;
        };
        // What follows from another group's failure is no failure of this one.
        let failure = |group: &Group| group.stop().and_then(|stop| stop.failure);
        let before = failure(group);
        let first = if method.is_none() || group.stop().is_none() {
            group.begin(cause, self.next)
        } else {
            false
        };
        let failed = before.is_none() && failure(group).is_some();
        let method = method.unwrap_or_else(|| group.method(cause));
        for slot in self.axes.iter_mut().filter(|slot| slot.group == index) {
            if cause == StopCause::EmergencyStop {
                let _ = slot.axis.command(Command::EmergencyStop);
            } else {
                slot.axis.stop_by(method);
            }
            slot.feed.end();
        }
        if failed {
            self.history.stopping(Anchor::Failure);
            let cycle = self.stats.counters.cycles;
            self.report(Event::Stopping { cycle, cause });
        }
        first
    }

    /// Axes that are stopping, and whose device is missing: the drive stops by itself, as far as it hears of it.
    pub(super) fn stop_missing_axes(&mut self) {
        for slot in &mut self.axes {
            let stopping = self.groups.get(slot.group).and_then(Group::stop).is_some();
            if stopping && self.guarding && self.guard.device_lost(slot.device) {
                slot.axis.stop_by(self.stop_setup.bus_lost);
            }
        }
    }

    /// Nothing more can be done to stop any axis.
    pub(super) fn stop_ended(&self) -> bool {
        self.axes.iter().all(|slot| slot.axis.stop_ended())
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
                sound && !status.state.has_power()
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
            self.exchange.release_windows(index);
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
