//! Error control: heartbeats, guarding requests, and the reaction to a missing node.

use super::super::can::CanFrame;
use super::super::control::Target;
use super::super::nmt::{NmtCommand, NmtState};
use super::super::{Abort, Gateway, MS};
use super::Guard;

/// Life guard or heartbeat error.
const ERROR_CONTROL: u16 = 0x8130;

impl Gateway {
    /// Loads 0x1016; its entries may be in any order.
    pub(in super::super) fn load_consumers(&mut self) {
        for slave in &mut self.master.slaves {
            slave.consumer = 0;
        }
        for sub in 1..=127 {
            let entry = self.d.get(0x1016, sub) as u32;
            let node = (entry >> 16 & 0x7f) as u8;
            if let Some(slave) = self.master.slave(node).filter(|_| node > 0) {
                slave.consumer = u64::from(entry & 0xffff) * MS;
            }
        }
    }

    /// Handles a boot-up message, a heartbeat or the answer to a guarding request.
    pub(in super::super) fn heard(&mut self, node: u8, byte: u8, now: u64) {
        if byte == 0 {
            return self.booted(node, now);
        }
        let Some(slave) = self.master.slave(node) else {
            return;
        };
        let (state, toggle) = (byte & 0x7f, byte & 0x80 != 0);
        if let Some(guard) = &mut slave.guard {
            if guard.toggle.is_some_and(|expected| expected != toggle) {
                return self.error_event(node, now);
            }
            guard.toggle = Some(!toggle);
            guard.unanswered = 0;
        } else if slave.consumer > 0 {
            slave.deadline = now + slave.consumer;
        } else {
            return;
        }
        slave.state = Some(state);
        slave.error = false;
    }

    pub(in super::super) fn request_guarding(&mut self, sub: u8, value: i64) -> Result<(), Abort> {
        if !self.is_master() || !(0..=1).contains(&value) {
            return Err(Abort::VALUE);
        }
        for node in 1..=127 {
            if sub != 128 && sub != node {
                continue;
            }
            if value == 1 {
                self.start_guarding(node, self.now);
            } else if let Some(slave) = self.master.slave(node) {
                (slave.guard, slave.error) = (None, false);
            }
        }
        Ok(())
    }

    /// Starts guarding with the values of 0x1F81, unless a heartbeat is expected.
    pub(super) fn start_guarding(&mut self, node: u8, now: u64) {
        let [_, retries, low, high] = self.assignment(node).to_le_bytes();
        let period = u64::from(u16::from_le_bytes([low, high])) * MS;
        if let Some(slave) = self.master.slave(node)
            && (slave.consumer, period > 0, retries > 0) == (0, true, true)
        {
            slave.guard = Some(Guard {
                period,
                retries,
                unanswered: 0,
                next: now,
                toggle: None,
            });
        }
    }

    /// Handles due events: missing heartbeats, guarding requests, SDO time-outs.
    pub(in super::super) fn step_master(&mut self, now: u64) {
        self.step_lss(now);
        if self
            .master
            .active
            .as_ref()
            .is_some_and(|(.., at)| *at <= now)
            && let Some((request, client, _)) = self.master.active.take()
        {
            self.send_sdo(request.node, &client.give_up(), now);
            self.finish(&request, Err(Abort::TIMEOUT), now);
        }
        for node in 1..=127u8 {
            let own = self.options.node_id;
            let Some(slave) = self.master.slave(node) else {
                continue;
            };
            if slave.deadline <= now {
                self.error_event(node, now);
                continue;
            }
            let Some(guard) = slave.guard.as_mut().filter(|guard| guard.next <= now) else {
                continue;
            };
            guard.next = now + guard.period;
            let given_up = guard.unanswered >= guard.retries;
            guard.unanswered = guard.unanswered.saturating_add(1);
            let news = given_up && !slave.error;
            self.bus
                .send(own, CanFrame::request(0x700 + u16::from(node)), now);
            if news {
                self.error_event(node, now);
            }
        }
    }

    /// Handles a node that is missing or reports a wrong state.
    fn error_event(&mut self, node: u8, now: u64) {
        let assignment = self.assignment(node);
        let Some(slave) = self.master.slave(node) else {
            return;
        };
        slave.deadline = u64::MAX;
        (slave.error, slave.state) = (true, None);
        if let Some(guard) = &mut slave.guard {
            guard.toggle = None;
        }
        self.emergency(ERROR_CONTROL, u16::from(node), now);
        if !self.is_master() {
            // A slave leaves OPERATIONAL and waits (§6.4.1).
            if self.nmt == NmtState::Operational {
                self.nmt = NmtState::PreOperational;
            }
            return;
        }
        let mandatory = assignment & 1 << 3 != 0;
        if mandatory && self.start_up() & 1 << 6 != 0 {
            self.set_state(NmtCommand::Stop, Target::Network, now);
        } else if mandatory && self.start_up() & 1 << 4 != 0 {
            self.set_state(NmtCommand::ResetNode, Target::Network, now);
        } else if assignment & 1 << 2 != 0 {
            // A node that still receives boots again.
            self.nmt(NmtCommand::ResetCommunication, node, now);
        }
    }
}
