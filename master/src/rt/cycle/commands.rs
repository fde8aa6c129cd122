//! Commands to the cycle, and stops.

use ecaxis_axis::setpoint::Motion;
use ecaxis_axis::{Command, CommandError, StopMethod};
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, GroupIndex};

use super::{DropCause, Engine};
use crate::rt::axis::RtAxis;
use crate::rt::bus_monitor::StopCause;
use crate::rt::channel::{COMMANDS_PER_CYCLE, Event, RtCommand};
use crate::rt::exchange::SubDeviceDiagnostics;
use crate::rt::flight_recorder::Trigger;
use crate::rt::gantry;
use crate::rt::gateway::{Gateway, NodeCommand, NodePlace};
use crate::rt::overrides::check_hold;
use crate::rt::reaction_group::{ActiveStop, ReactionGroup, check_permitted};
use crate::rt::setpoint_generator::{CamRef, GearMaster, GeneratorError, GeneratorRequest};

impl Engine {
    /// Takes all queued commands, so that commands of one batch take effect in the same cycle.
    pub(super) fn take_orders(&mut self) {
        for _ in 0..COMMANDS_PER_CYCLE {
            let Ok(command) = self.end.commands.pop() else {
                if self.end.commands.is_abandoned() && !self.halted {
                    self.stop_without_supervisor();
                }
                break;
            };
            if !self.take_deferred(command) {
                self.commands_taken += 1;
                self.take(command);
            }
        }
        self.begin_deferred();
    }

    pub(super) fn take(&mut self, command: RtCommand) {
        match command {
            RtCommand::Axis { axis, command } => {
                let Some(slot) = self.axes.get(axis) else {
                    return;
                };
                let rate = self.overrides.rate(slot.group);
                let admitted = check_permitted(&mut self.groups, slot.group, command)
                    .and_then(|()| check_hold(rate, command));
                let taken = admitted.and_then(|()| {
                    gantry::command(&mut self.axes, &mut self.gantries, axis, command)
                });
                if let Err(reason) = taken {
                    // A stopping machine rejects motion. The sender receives the stop event
                    // instead. An axis of a stopped group stops already.
                    let stops = command == Command::Stop && reason == CommandError::GroupStopped;
                    if stops || self.stopping().is_some() {
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
            RtCommand::Generate { axis, start } => self.start_generator(axis, start),
            RtCommand::Output { output, value } => {
                if let Some(signal) = self.signals.outputs.get(output.0) {
                    signal.set(self.exchange.outputs_mut(), value);
                }
            }
            RtCommand::Shift {
                axis,
                distance,
                superimpose,
            } => self.shift(axis, distance, superimpose),
            RtCommand::Couple { gantry, coupled } => self.couple(gantry, coupled),
            RtCommand::Override { group, factor } => self.overrides.set_factor(group, factor),
            RtCommand::Hold { group, held } => self.overrides.set_hold(group, held),
            RtCommand::EnterOp => self.common.enter_op(),
            RtCommand::StartBusMonitor => {
                self.guarding = true;
                self.exchange.expect_op(true);
            }
            RtCommand::Absent { group } => {
                for device in self.guard.devices_of(group) {
                    self.exchange.lock_outputs(device);
                }
                self.stop(Some(group), StopCause::Absent);
            }
            RtCommand::StopBusMonitor => {
                self.guarding = false;
                self.exchange.expect_op(false);
                self.axes.iter_mut().for_each(RtAxis::disarm);
            }
            RtCommand::Node {
                gateway,
                node,
                command,
            } => self.command_node(gateway, node, command),
            RtCommand::EndGateways => self.gateways.iter_mut().for_each(Gateway::end),
            RtCommand::Stop => self.stop(None, StopCause::Requested),
            RtCommand::ErrorCode { axis, code } => {
                if let Some(slot) = self.axes.get_mut(axis) {
                    slot.axis.note_error_code(code);
                }
            }
            RtCommand::Defer { at, count } => self.defer(at, count),
            RtCommand::CancelStart => self.cancel_deferred(),
            RtCommand::Halt => self.halted = true,
        }
    }

    fn shift(&mut self, axis: AxisIndex, distance: f64, superimpose: bool) {
        if self.stopping().is_some() {
            return;
        }
        let allowed = self.check_generator(axis);
        let Some(slot) = self.axes.get_mut(axis) else {
            return;
        };
        let dt_s = slot.dt_s(self.config.cycle_ns);
        let done = allowed.and_then(|()| match superimpose {
            true => slot.generator.superimpose(&slot.axis, distance, dt_s),
            false => slot.generator.shift(distance, dt_s),
        });
        if let Err(reason) = done {
            let cycle = self.stats.counters.cycles;
            self.report(Event::Refused {
                cycle,
                axis,
                reason,
            });
        }
    }

    /// Commands the NMT state of a node whose axis has no power.
    fn command_node(&mut self, device: DeviceIndex, node: usize, command: NodeCommand) {
        let mut gateways = self.gateways.iter_mut().enumerate();
        let Some((number, gateway)) = gateways.find(|(_, g)| g.device() == device) else {
            return;
        };
        let place = NodePlace {
            gateway: number,
            node,
        };
        let powered = |slot: &RtAxis| {
            let status = slot.axis.status();
            status.enabled || status.state.has_power()
        };
        let mut slots = self.axes.enumerate_mut();
        let own = slots.find(|(_, slot)| slot.node == Some(place));
        if let Some((axis, _)) = own.as_ref().filter(|(_, slot)| powered(slot)) {
            let (cycle, axis) = (self.stats.counters.cycles, *axis);
            drop(slots);
            let reason = CommandError::HasPower;
            return self.report(Event::Refused {
                cycle,
                axis,
                reason,
            });
        }
        gateway.command(node, command);
        if let Some((_, slot)) = own.filter(|_| command == NodeCommand::Reset) {
            slot.axis.restarted(false);
        }
    }

    fn couple(&mut self, gantry: usize, coupled: bool) {
        let Some(gantry) = self.gantries.get_mut(gantry) else {
            return;
        };
        let axes = gantry.axes();
        let Some([first, second]) = gantry::halves(&mut self.axes, axes) else {
            return;
        };
        if let Err(reason) = gantry.couple([first, second], coupled) {
            let (cycle, axis) = (self.stats.counters.cycles, axes[0]);
            self.report(Event::Refused {
                cycle,
                axis,
                reason,
            });
        }
    }

    /// The supervisor ended without a halt command: stop the machine, then end the loop.
    fn stop_without_supervisor(&mut self) {
        self.stop(None, StopCause::Requested);
        self.halted = self.stop_ended();
    }

    /// Returns the stop of the machine.
    pub(super) fn stopping(&self) -> Option<ActiveStop> {
        self.groups.first().and_then(ReactionGroup::stop)
    }

    /// Stops `own`, or all groups if `own` is `None`. A cause of one group stops that group by its
    /// configured method. The rest of the machine stops within the limits of its axes, unless it
    /// may continue.
    pub(super) fn stop(&mut self, own: Option<GroupIndex>, cause: StopCause) {
        let goes_on = own
            .and_then(|own| self.groups.get(own))
            .is_some_and(ReactionGroup::continues_without);
        let machine_stops = self.stopping().is_some();
        // All commands of a common start take effect, or none.
        self.drop_deferred(DropCause::Stopped);
        if cause != StopCause::Requested {
            self.exchange.stop_windows(own.filter(|_| goes_on));
        }
        if !goes_on {
            self.history.stopping(match cause {
                StopCause::Requested => Trigger::Requested,
                _ => Trigger::Failure,
            });
        }
        if let Some(own) = own.filter(|_| goes_on) {
            self.abort_lines(own);
        }
        for group in self.groups.indices() {
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

    /// Ends the lines that share an axis with a stopped group: the other axes can no longer follow
    /// them.
    fn abort_lines(&mut self, own: GroupIndex) {
        for index in self.axes.indices() {
            let slots = &mut self.axes;
            let line = slots.get(index).and_then(|slot| slot.generator.line());
            let Some(line) = line else { continue };
            let broken = |slot: &RtAxis| slot.group == own && slot.generator.line() == Some(line);
            if !slots.iter().any(broken) {
                continue;
            }
            let Some(slot) = slots.get_mut(index).filter(|slot| slot.group != own) else {
                continue;
            };
            slot.generator.abort_line();
            if let Some(group) = self.groups.get_mut(slot.group) {
                let cause = StopCause::FollowLost { axis: index };
                group.found = group.found.or(Some(cause));
            }
        }
    }

    /// Stops a group by `method`, or as the cause demands. An axis that is already stopping never
    /// stops more gently. Returns true if the group was not stopping before.
    fn stop_group(
        &mut self,
        index: GroupIndex,
        cause: StopCause,
        method: Option<StopMethod>,
    ) -> bool {
        let Some(group) = self.groups.get_mut(index) else {
            return false;
        };
        // A consequence of another group's failure is not a failure of this group.
        let failure = |group: &ReactionGroup| group.stop().and_then(|stop| stop.failure);
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
            slot.generator.end();
        }
        if failed {
            self.history.stopping(Trigger::Failure);
            let cycle = self.stats.counters.cycles;
            self.report(Event::Stopping { cycle, cause });
        }
        first
    }

    /// Stops axes whose group is stopping and whose device is missing. Such a drive stops by itself
    /// if it no longer receives frames.
    pub(super) fn stop_missing_axes(&mut self) {
        for slot in &mut self.axes {
            let stopping = self
                .groups
                .get(slot.group)
                .and_then(ReactionGroup::stop)
                .is_some();
            let lost = self.guard.device_lost(slot.device) || Self::node_lost(&self.gateways, slot);
            if stopping && self.guarding && lost {
                slot.axis.stop_by(self.config.bus_lost);
            }
        }
    }

    /// True once nothing more can be done to stop any axis.
    pub(super) fn stop_ended(&self) -> bool {
        self.axes.iter().all(|slot| slot.axis.stop_ended())
    }

    /// Releases groups that were reset; a group without axes needs no reset. Their axes must be at
    /// rest without power, without a fault or trip, their process data must be fresh, and their
    /// devices in Op.
    pub(super) fn release(&mut self) {
        if self.stopping().is_some() {
            return;
        }
        for index in self.groups.indices() {
            let there = self
                .exchange
                .group_results()
                .get(index)
                .is_some_and(|s| s.fresh)
                && self.guard.lost(index).is_none();
            let op = |device: &DeviceIndex| {
                let found = self.exchange.diagnoses().get(*device);
                found.is_some_and(SubDeviceDiagnostics::is_in_op)
            };
            let there = there && self.guard.devices_of(index).all(|device| op(&device));
            let idle = |slot: &RtAxis| {
                let status = slot.axis.status();
                let sound = status.fault.is_none() && status.trip.is_none();
                sound && !status.state.has_power()
            };
            let mut own = self.axes.iter().filter(|slot| slot.group == index);
            let has_axes = own.clone().next().is_some();
            let Some(group) = self.groups.get_mut(index) else {
                continue;
            };
            if group.stop().is_none() || !there || !own.all(idle) {
                continue;
            }
            if !has_axes {
                group.acknowledge();
            }
            if !group.release() {
                continue;
            }
            for slot in self.axes.iter_mut().filter(|slot| slot.group == index) {
                slot.disarm();
            }
            self.exchange.release_windows(index);
            self.exchange.unlock_outputs(index);
            let cycle = self.stats.counters.cycles;
            let group = index;
            self.report(Event::GroupReleased { cycle, group });
        }
    }

    /// Fails if the group of an axis has stopped, or its gantry permits no motion.
    fn check_generator(&self, axis: AxisIndex) -> Result<(), CommandError> {
        let group = self.axes.get(axis).map(|slot| slot.group);
        let group = group.and_then(|group| self.groups.get(group));
        if group.is_some_and(|group| group.stop().is_some()) {
            return Err(CommandError::GroupStopped);
        }
        gantry::check_motion(&self.gantries, axis)
    }

    fn start_generator(&mut self, axis: AxisIndex, start: GeneratorRequest) {
        if self.stopping().is_some() {
            return;
        }
        let master = match start {
            GeneratorRequest::Gear { master, cam, .. } => self
                .new_master_motion(axis, master)
                .map(|motion| CamRef::through(cam, &self.config.cams, motion)),
            _ => Ok(Motion::default()),
        };
        let allowed = self.check_generator(axis);
        if let Some(slot) = self.axes.get_mut(axis) {
            if let Err(reason) = allowed {
                slot.generator.refuse(reason);
                return;
            }
            let status = slot.axis.status();
            let rate = self.overrides.rate(slot.group);
            slot.generator.begin(start, &status, master, rate);
        }
    }

    /// Returns the motion of a master that `axis` is to follow.
    fn new_master_motion(
        &self,
        axis: AxisIndex,
        master: GearMaster,
    ) -> Result<Motion, GeneratorError> {
        match master {
            GearMaster::Axis { axis: of, .. } if self.follows(of, axis) => {
                Err(GeneratorError::Ring)
            }
            // Not while the shaft stops.
            GearMaster::LineShaft(shaft) => match self.line_shafts.get(shaft) {
                Some(known) => {
                    (known.shaft.running()).map_err(|end| GeneratorError::LineShaft { shaft, end })
                }
                None => Err(GeneratorError::NoMaster),
            },
            master => self.master_motion(master),
        }
    }

    /// True if an axis follows `leader`, directly or through other gears.
    fn follows(&self, axis: AxisIndex, leader: AxisIndex) -> bool {
        let mut at = Some(axis);
        for _ in 0..=self.axes.len() {
            match at {
                Some(axis) if axis == leader => return true,
                Some(axis) => at = self.axes.get(axis).and_then(|s| s.generator.followed()),
                None => return false,
            }
        }
        true
    }
}
