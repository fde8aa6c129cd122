//! The layer setting services of the master (manual §6.3): a missing slave whose identity is known
//! gets its number.

use super::super::can::CanFrame;
use super::super::lss::{MASTER, cs};
use super::super::nmt::NmtCommand;
use super::super::{Gateway, MS};
use super::Boot;

/// The time for the answers to one service.
const ANSWER_NS: u64 = 100 * MS;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    /// Waits for all answers.
    Identify,
    Select,
    Number,
    Store,
}

/// The services for one slave at a time.
#[derive(Debug, Clone)]
pub(super) struct Lss {
    /// The slave that gets its number, and what is awaited.
    active: Option<(u8, Step)>,
    answers: u32,
    /// The end of the boot time, of the answers, or never.
    pub(super) due: u64,
}

impl Default for Lss {
    fn default() -> Self {
        Self {
            active: None,
            answers: 0,
            due: u64::MAX,
        }
    }
}

impl Gateway {
    /// Starts the boot time (0x1F89, in ms). 0: no layer setting services.
    pub(super) fn start_boot_time(&mut self, now: u64) {
        let time = self.d.get(0x1f89, 0).cast_unsigned() * MS;
        self.master.lss.due = if time > 0 { now + time } else { u64::MAX };
    }

    pub(super) fn step_lss(&mut self, now: u64) {
        if self.master.lss.due > now {
            return;
        }
        match self.master.lss.active {
            Some((node, Step::Identify)) if self.master.lss.answers == 1 => {
                for (command, part) in (cs::SELECT_VENDOR..).zip(self.lss_address(node)) {
                    self.lss_send(command, part.to_le_bytes(), now);
                }
                self.lss_await(node, Step::Select, now);
            }
            // No answer, or more than one: this slave keeps missing.
            Some((node, _)) => self.end_lss(node, now),
            None => self.identify_next(0, now),
        }
    }

    /// Asks for the next missing slave with a known identity.
    fn identify_next(&mut self, after: u8, now: u64) {
        self.master.lss.active = None;
        let missing = (after + 1..=127).find(|node| {
            let slave = self.master.slaves.get(usize::from(*node));
            self.assignment(*node) & 1 != 0
                && slave.is_some_and(|slave| slave.boot == Boot::Waiting)
                && self.lss_address(*node).iter().all(|part| *part != 0)
        });
        let Some(node) = missing else {
            self.master.lss.due = u64::MAX;
            return;
        };
        let [vendor, product, revision, serial] = self.lss_address(node);
        let parts = [vendor, product, revision, revision, serial, serial];
        for (command, part) in (cs::IDENTIFY_VENDOR..).zip(parts) {
            self.lss_send(command, part.to_le_bytes(), now);
        }
        self.lss_await(node, Step::Identify, now);
    }

    fn end_lss(&mut self, node: u8, now: u64) {
        self.lss_send(cs::SWITCH_GLOBAL, [0; 4], now);
        self.identify_next(node, now);
    }

    pub(in super::super) fn lss_answer(&mut self, frame: &CanFrame, now: u64) {
        let ([command, error, ..], Some((node, step))) = (frame.padded(), self.master.lss.active)
        else {
            return;
        };
        match (step, command, error) {
            (Step::Identify, cs::IDENTIFIED, _) => self.master.lss.answers += 1,
            (Step::Select, cs::SELECTED, _) => {
                self.lss_send(cs::SET_NUMBER, [node, 0, 0, 0], now);
                self.lss_await(node, Step::Number, now);
            }
            (Step::Number, cs::SET_NUMBER, 0) => {
                self.lss_send(cs::STORE, [0; 4], now);
                self.lss_await(node, Step::Store, now);
            }
            (Step::Store, cs::STORE, _) => {
                self.end_lss(node, now);
                self.nmt(NmtCommand::ResetCommunication, node, now);
            }
            (_, cs::SET_NUMBER, _) => self.end_lss(node, now),
            _ => {}
        }
    }

    fn lss_await(&mut self, node: u8, step: Step, now: u64) {
        self.master.lss = Lss {
            active: Some((node, step)),
            answers: 0,
            due: now + ANSWER_NS,
        };
    }

    fn lss_send(&mut self, command: u8, [a, b, c, d]: [u8; 4], now: u64) {
        self.send(MASTER, &[command, a, b, c, d, 0, 0, 0], now);
    }

    /// Returns the expected identity of a slave (0x1F85 to 0x1F88).
    fn lss_address(&self, node: u8) -> [u32; 4] {
        [0x1f85, 0x1f86, 0x1f87, 0x1f88].map(|object| self.d.get(object, node) as u32)
    }
}
