//! Steps every axis once per cycle, from its inputs to its outputs.

use ecaxis_axis::setpoint::{Master, Motion};
use ecaxis_axis::{Mode, PowerLossCause, State, StopPhase};
use ecaxis_ecat::index::AxisIndex;

use super::{Engine, Nanos};
use crate::rt::axis::RtAxis;
use crate::rt::bus_monitor::StopCause;
use crate::rt::channel::Event;
use crate::rt::exchange::DeviceAnswer;
use crate::rt::gantry;
use crate::rt::gateway::Gateway;
use crate::rt::setpoint_generator::{self, CamRef, GearMaster, GeneratorError};

impl Engine {
    /// Reads the status words of the gateways, stops the groups of lost nodes, and writes the
    /// control words.
    pub(super) fn observe_gateways(&mut self) {
        let has_power = |slot: &RtAxis| slot.axis.status().state.has_power();
        for (n, gateway) in self.gateways.iter_mut().enumerate() {
            let own = |slot: &RtAxis| slot.node.is_some_and(|at| at.gateway == n);
            let powered = self.axes.iter().any(|slot| own(slot) && has_power(slot));
            let answer = self.exchange.device_answers().get(gateway.device());
            let fresh = answer == Some(&DeviceAnswer::Fresh);
            gateway.observe(self.exchange.inputs(), fresh, self.guarding, powered);
            gateway.write(self.exchange.outputs_mut());
            for (axis, slot) in self.axes.enumerate_mut() {
                let own = slot.node.filter(|at| at.gateway == n && slot.armed);
                let Some(state) = own.and_then(|at| gateway.lost(at.node)) else {
                    continue;
                };
                slot.axis.restarted(false);
                if let Some(group) = self.groups.get_mut(slot.group) {
                    group.found = group.found.or(Some(StopCause::NodeLost { axis, state }));
                }
            }
        }
    }

    /// Reports restarts of devices to their axes. Their groups have stopped. RT: O(devices × axes)
    /// while a device returns, else O(devices).
    pub(super) fn take_restarts(&mut self) {
        for device in self.exchange.device_answers().indices() {
            if let Some(same) = self.exchange.take_restart(device) {
                let own = self.axes.iter_mut().filter(|slot| slot.device == device);
                own.for_each(|slot| slot.axis.restarted(same));
                let at =
                    |slot: &&mut RtAxis| slot.second_encoder.is_some_and(|(_, at)| at == device);
                let encoders = self.axes.iter_mut().filter(at);
                encoders.for_each(|slot| slot.axis.restart_second_encoder());
            }
        }
    }

    /// True if the node of an axis behind a gateway is lost.
    pub(super) fn node_lost(gateways: &[Gateway], slot: &RtAxis) -> bool {
        slot.node.is_some_and(|at| {
            let gateway = gateways.get(at.gateway);
            gateway.is_none_or(|gateway| gateway.lost(at.node).is_some())
        })
    }

    /// Handles skipped cycles, in which nothing was sent. Drives kept the last output, so the axes
    /// continue from there. This runs before the staged frames are sent, because they date from
    /// before.
    pub(super) fn handle_skipped_cycles(&mut self, woke: Nanos) {
        let before = self.woke.replace(woke).unwrap_or(woke);
        let silent = woke.saturating_sub(before) / self.config.cycle_ns;
        if silent < 2 {
            return;
        }
        let skipped = u32::try_from(silent - 1).unwrap_or(u32::MAX);
        for slot in &mut self.axes {
            let outputs = slot.axis.skipped(skipped / slot.cycles.max(1));
            slot.words.take_back();
            slot.write(self.exchange.outputs_mut(), &outputs);
        }
        self.exchange.refresh_outputs();
    }

    /// Steps masters before the axes that follow them, so that a follower's set-point is of the
    /// same cycle.
    pub(super) fn act(&mut self) {
        self.stop_missing_axes();
        self.set_rates();
        self.update_gantries();
        self.update_line_shafts();
        // Gears form no loops, so every pass steps at least one axis.
        for _ in 0..self.axes.len() {
            let mut waiting = false;
            for index in self.axes.indices() {
                let Some(slot) = self.axes.get(index) else {
                    continue;
                };
                if slot.acted {
                    continue;
                }
                let followed = slot.generator.followed();
                let followed = followed.or(slot.leader.map(|leader| leader.axis));
                let followed = followed.and_then(|master| self.axes.get(master));
                if followed.is_some_and(|master| !master.acted) {
                    waiting = true;
                } else {
                    self.step_axis(index);
                }
            }
            if !waiting {
                break;
            }
        }
        for group in self.groups.indices() {
            if let Some(cause) = self.groups.get_mut(group).and_then(|g| g.found.take()) {
                // If an axis cannot be stopped, or stops without a cause, the machine must not
                // continue without its group.
                let own = !matches!(
                    cause,
                    StopCause::Powered { .. } | StopCause::PowerLost { .. }
                );
                self.stop(own.then_some(group), cause);
            }
        }
        // After the stops: an output is off in the cycle in which its axis gets the stop.
        self.set_position_outputs();
    }

    /// Writes the outputs that follow positions. They are off while the group of the axis stops, and
    /// from the command on that removes the power.
    fn set_position_outputs(&mut self) {
        for at in &self.signals.positions {
            let on = self.axes.get(at.trigger.axis).is_some_and(|slot| {
                let group = self.groups.get(slot.group);
                let stops = group.is_none_or(|group| group.stop().is_some());
                !stops && slot.keeps_power && at.trigger.is_on(&slot.axis.status())
            });
            at.output
                .set(self.exchange.outputs_mut(), f64::from(u8::from(on)));
        }
    }

    /// Returns the motion of the master of a gear.
    pub(super) fn master_motion(&self, master: GearMaster) -> Result<Motion, GeneratorError> {
        match master {
            GearMaster::Axis { axis, actual } => {
                let status = self.axes.get(axis).map(|slot| slot.axis.status());
                status
                    .and_then(|status| setpoint_generator::master_motion(&status, actual))
                    .ok_or(GeneratorError::NoMaster)
            }
            GearMaster::LineShaft(shaft) => {
                let known = self.line_shafts.get(shaft);
                let known = known.ok_or(GeneratorError::NoMaster)?;
                let motion = known.shaft.motion();
                motion.map_err(|end| GeneratorError::LineShaft { shaft, end })
            }
        }
    }

    /// Returns true if a hold of an axis brings its master to rest as well: the master is held too,
    /// and the followed motion is a set-point, or its set-point still moves.
    fn comes_to_rest(&self, master: GearMaster) -> bool {
        match master {
            GearMaster::Axis { axis, actual } => self.axes.get(axis).is_some_and(|slot| {
                let moves = slot.axis.status().target_velocity != 0.0;
                slot.rates.own.is_held() && (moves || !actual)
            }),
            GearMaster::LineShaft(_) => false,
        }
    }

    /// Advances every line shaft to the instant of the set-points of this cycle.
    fn update_line_shafts(&mut self) {
        self.effect_at = self.common.effect_of(self.next);
        let dt_s = self.config.cycle_ns as f64 * 1e-9;
        for (index, shaft) in self.line_shafts.enumerate_mut() {
            let master = GearMaster::LineShaft(index);
            let mut followed = self.axes.iter().filter_map(|slot| slot.generator.master());
            let followed = followed.any(|(of, _)| of == master);
            shaft.advance(self.effect_at, followed, dt_s);
        }
    }

    /// Publishes the set-points of this cycle for other machines.
    pub(super) fn publish_setpoints(&mut self) {
        let at = self.effect_at.filter(|_| self.guarding);
        for (setpoints, slot) in self.setpoints.iter_mut().zip(&self.axes) {
            let (config, status) = (slot.axis.config(), slot.axis.status());
            let velocity = config.limits.velocity;
            let dt_s = slot.dt_s(self.config.cycle_ns);
            // The instant of a set-point behind a gateway is that of its CAN network.
            let at = at.filter(|_| slot.node.is_none());
            // Without a position loop, the position in CSV is the reported one.
            let at = at.filter(|_| status.mode != Mode::Csv || config.loops.csv.is_some());
            setpoints.publish(at, &status, velocity, dt_s);
        }
    }

    /// Advances every gantry. Their second halves follow in this cycle.
    fn update_gantries(&mut self) {
        let cycle_ns = self.config.cycle_ns;
        for gantry in &mut self.gantries {
            if let Some(halves) = gantry::halves(&mut self.axes, gantry.axes()) {
                let dt_s = halves[0].dt_s(cycle_ns);
                gantry.update(halves, dt_s);
            }
        }
    }

    /// Steps one axis. A cause that must stop its group is stored in the group.
    fn step_axis(&mut self, index: AxisIndex) {
        let master = self
            .axes
            .get(index)
            .and_then(|slot| slot.generator.master());
        let master = match master {
            Some((master, cam)) => self.master_motion(master).map(|motion| Master {
                motion: CamRef::through(cam, &self.config.cams, motion),
                comes_to_rest: self.comes_to_rest(master),
            }),
            None => Ok(Master {
                motion: Motion::default(),
                comes_to_rest: false,
            }),
        };
        let leader = self.axes.get(index).and_then(|slot| {
            let leader = slot.leader?;
            let first = self.axes.get(leader.axis)?.axis.status();
            Some((leader.set_point(&first), first.takes_up))
        });
        let Some(slot) = self.axes.get_mut(index) else {
            return;
        };
        let Some(group) = self.groups.get_mut(slot.group) else {
            return;
        };
        slot.acted = true;
        let dt_s = slot.dt_s(self.config.cycle_ns);
        let lost = slot
            .generator
            .advance(&mut slot.axis, master, slot.rates, dt_s);
        if let Some((motion, takes_up)) = leader {
            slot.axis.follow(motion, takes_up);
        }
        let outputs = slot.axis.act();
        slot.write(self.exchange.outputs_mut(), &outputs);
        let resets = std::mem::take(&mut slot.reset);
        let status = slot.axis.status();
        slot.armed |= slot.ordered && status.fault.is_none() && slot.heard.is_some();
        if status.enabled {
            slot.largest_following_error =
                slot.largest_following_error.max(status.max_following_error);
            slot.last_enabled = Some(status);
        }
        if group.stop().is_some() {
            if status.stop.is_some_and(|s| s.phase == StopPhase::PowerKept) {
                group.found = Some(StopCause::Powered { axis: index });
            }
            // Reset by command, or automatically if the machine file says so.
            if status.resetting {
                group.acknowledge();
            }
        }
        // A stop from outside the axis is one of its group or of its gantry, which record it.
        let cause = status.power_loss_cause;
        let recorded = cause.is_some_and(|cause| cause != PowerLossCause::Outside);
        if group.stop().is_some() || recorded {
            slot.power.end();
        }
        if status.switching.is_some() {
            slot.power.switch_mode();
        }
        let operates = status.state == State::OperationEnabled;
        let heard = status.stale_cycles == 0;
        if heard && slot.power.is_lost(status.enabled, operates) {
            let state = status.state;
            group.found = Some(StopCause::PowerLost { axis: index, state });
        }
        let cause = match (status.fault, status.trip) {
            (Some(_), _) if slot.armed => Some(StopCause::DriveFault { axis: index }),
            (None, Some(trip)) if slot.armed => Some(StopCause::Trip { axis: index, trip }),
            _ => lost.then_some(StopCause::FollowLost { axis: index }),
        };
        group.found = group.found.or(cause);
        if resets {
            let cycle = self.stats.counters.cycles;
            self.report(Event::ResetDrive { cycle, axis: index });
        }
    }
}
