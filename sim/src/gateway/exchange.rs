//! Exchange between EtherCAT's objects and the buffers; execution of the control word, and the
//! status word (manual §6.2).

use super::control::{self, Command, ControlWord, NO_OPERATION, ReportedState, Target, general};
use super::nmt::NmtState;
use super::{ERROR_PASSIVE, Gateway};
use crate::Nanos;
use crate::coe::object_dictionary::ObjectStore;

impl Gateway {
    /// Exchanges data between the networks; `now` is true time. Outputs pass only while EtherCAT is
    /// in Op. Inputs always pass.
    pub(crate) fn forward(&mut self, store: &mut ObjectStore, in_op: bool, now: Nanos) {
        if in_op {
            for (byte, slot) in self.outputs.iter_mut().zip(&self.slots[1]) {
                *byte = store.bytes(*slot).first().copied().unwrap_or(0);
            }
        }
        self.advance(now);
        self.obey(in_op, now);
        self.poll_events(now);
        self.inputs[0] = self.status;
        self.inputs[1] = self.error_node();
        for (byte, slot) in self.inputs.iter().zip(&self.slots[0]) {
            if let Some(to) = store.bytes_mut(*slot).first_mut() {
                *to = *byte;
            }
        }
    }

    /// Executes a new command. A command is new if its toggle bit differs from the last one's.
    fn obey(&mut self, in_op: bool, now: u64) {
        if !in_op {
            // An old command in the buffer must not act when the fieldbus comes back.
            self.status = NO_OPERATION << 4 | u8::from(self.toggle) << 7;
            // "If the PLC is not running, the NMT state is set to PRE-OPERATIONAL" (slave).
            if !self.is_master() {
                self.permit(false, now);
            }
            return;
        }
        let [byte, node, ..] = self.outputs;
        if control::toggle(byte) == self.toggle || self.disturbance.control_ignored {
            return;
        }
        let Some(word) = ControlWord::decode([byte, node]) else {
            return;
        };
        let extension = match word.command {
            Command::SetState(command) => self
                .set_state(command, word.target, now)
                .then_some(byte & 0x0f),
            Command::NodeState => self.reported(word.target).map(|state| state as u8),
            Command::GeneralStatus => Some(self.general_status()),
            Command::NoOperation => Some(byte & 0x0f),
        };
        if let Some(extension) = extension {
            self.toggle = word.toggle;
            self.status = byte & 0xf0 | extension;
        }
    }

    fn reported(&self, target: Target) -> Option<ReportedState> {
        let value = match target {
            Target::Module => self.nmt.code(),
            _ if !self.is_master() => return None,
            Target::Node(node) => self.node_state(node),
            Target::Network => self.network_state(),
        };
        Some(ReportedState::from_request_nmt(value))
    }

    fn general_status(&self) -> u8 {
        let mut bits = 0;
        if self.transmit_errors >= ERROR_PASSIVE {
            bits |= general::ERROR_PASSIVE;
        }
        if self.error_node() != 0 {
            bits |= general::ERROR_CONTROL;
        }
        if self.misses_sync() {
            bits |= general::SYNC;
        }
        bits
    }

    /// True if the PDOs need a SYNC that the gateway does not produce. No other node produces it.
    fn misses_sync(&self) -> bool {
        let producer = self.d.get(0x1005, 0) & 0x4000_0000 != 0;
        self.nmt == NmtState::Operational && self.d.get(0x1006, 0) > 0 && !producer
    }
}
