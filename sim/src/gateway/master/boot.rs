//! The boot of a slave, from its boot-up message until it may be started: identity, configuration,
//! error control.

use super::super::concise;
use super::super::nmt::NmtCommand;
use super::super::{Abort, Gateway};
use super::{Boot, Purpose, Request};

/// Software error, and its additional information (appendix C).
const SOFTWARE: u16 = 0x6161;
const INCONSISTENT: u8 = 4;
const SDO_TIMEOUT: u8 = 7;
const SDO_ERROR: u8 = 8;

/// An object of a slave, and the object with its expected value.
const IDENTITY: [(u16, u8, u16); 5] = [
    (0x1000, 0, 0x1f84),
    (0x1018, 1, 0x1f85),
    (0x1018, 2, 0x1f86),
    (0x1018, 3, 0x1f87),
    (0x1018, 4, 0x1f88),
];

/// A subindex of 0x1020 (verify configuration), and the object with its expected value.
const CONFIGURED: [(u8, u16); 2] = [(1, 0x1f26), (2, 0x1f27)];

impl Gateway {
    pub(super) fn booted(&mut self, node: u8, now: u64) {
        let assignment = self.assignment(node);
        if !self.is_master() || assignment & 1 == 0 {
            return;
        }
        let dcf = self.d.bytes(0x1f22, node).to_vec();
        let Some(slave) = self.master.slave(node) else {
            return;
        };
        // A slave that restarts by itself boots again only if its assignment says so.
        if slave.boot != Boot::Waiting && assignment & 1 << 2 == 0 {
            return;
        }
        // A node that restarts by itself may have other values again.
        slave.restored &= slave.boot == Boot::Waiting;
        // A restarted node does not answer earlier requests.
        self.master.forget(Some(node));
        let Some(slave) = self.master.slave(node) else {
            return;
        };
        match concise::parse(&dcf) {
            Some(settings) => {
                slave.settings = settings;
                slave.boot = Boot::Identity(0);
                self.boot_on(node, now);
            }
            None => {
                slave.boot = Boot::Refused;
                self.software_error(INCONSISTENT, node, now);
            }
        }
    }

    /// Sends the next request of a slave's boot, or ends the boot.
    fn boot_on(&mut self, node: u8, now: u64) {
        let assignment = self.assignment(node);
        let expected = CONFIGURED.map(|(_, object)| self.d.get(object, node) as u32);
        let Some(slave) = self.master.slaves.get_mut(usize::from(node)) else {
            return;
        };
        if let Boot::Identity(line) = &mut slave.boot {
            let next = IDENTITY.iter().enumerate().skip(*line);
            // The device type is always read: the answer shows that the node exists.
            let mut asked =
                next.filter(|(n, (.., expected))| *n == 0 || self.d.get(*expected, node) != 0);
            if let Some((n, (index, sub, _))) = asked.next() {
                *line = n;
                let (index, sub) = (*index, *sub);
                return self.enqueue(node, index, sub, None, Purpose::Boot, now);
            }
            let restores = assignment & 1 << 7 != 0 && !slave.restored;
            slave.boot = if restores {
                Boot::Factory
            } else {
                Boot::Configured(0)
            };
        }
        if slave.boot == Boot::Factory {
            let load = b"load".to_vec();
            return self.enqueue(node, 0x1011, 1, Some(load), Purpose::Boot, now);
        }
        if let Boot::Configured(line) = slave.boot {
            match CONFIGURED.get(line) {
                Some((sub, _)) if expected.iter().any(|value| *value != 0) => {
                    return self.enqueue(node, 0x1020, *sub, None, Purpose::Boot, now);
                }
                // Both are as expected: the node keeps its configuration.
                None => slave.boot = Boot::Settings(slave.settings.len()),
                Some(_) => slave.boot = Boot::Settings(0),
            }
        }
        if let Boot::Settings(n) = slave.boot {
            if let Some((index, sub, data)) = slave.settings.get(n).cloned() {
                return self.enqueue(node, index, sub, Some(data), Purpose::Boot, now);
            }
            slave.boot = Boot::Ready;
            if slave.consumer == 0 {
                self.start_guarding(node, now);
            }
            self.start_slaves(now);
        }
    }

    pub(super) fn boot_answer(
        &mut self,
        request: &Request,
        result: Result<Vec<u8>, Abort>,
        now: u64,
    ) {
        let node = request.node;
        let expected = IDENTITY.map(|(.., object)| self.d.get(object, node) as u32);
        let configured = CONFIGURED.map(|(_, object)| self.d.get(object, node) as u32);
        let Some(slave) = self.master.slave(node) else {
            return;
        };
        match (&mut slave.boot, result) {
            // Factory values take effect after a reset.
            (Boot::Factory, Ok(_)) => {
                slave.restored = true;
                self.nmt(NmtCommand::ResetNode, node, now);
            }
            // A node without 0x1020 is configured each time.
            (Boot::Configured(_), Err(abort)) if abort != Abort::TIMEOUT => {
                slave.boot = Boot::Settings(0);
                self.boot_on(node, now);
            }
            (Boot::Configured(line), Ok(data)) => {
                let found = data.iter().rev().fold(0u32, |v, b| v << 8 | u32::from(*b));
                let same = configured.get(*line) == Some(&found);
                slave.boot = if same {
                    Boot::Configured(*line + 1)
                } else {
                    Boot::Settings(0)
                };
                self.boot_on(node, now);
            }
            (
                boot
                @ (Boot::Identity(_) | Boot::Factory | Boot::Configured(_) | Boot::Settings(_)),
                Err(abort),
            ) => {
                *boot = Boot::Refused;
                let error = if abort == Abort::TIMEOUT {
                    SDO_TIMEOUT
                } else {
                    SDO_ERROR
                };
                self.software_error(error, node, now);
            }
            (Boot::Identity(line), Ok(data)) => {
                let found = data.iter().rev().fold(0u32, |v, b| v << 8 | u32::from(*b));
                let expected = expected.get(*line).copied().unwrap_or(0);
                if matches(*line, expected, found) {
                    *line += 1;
                    self.boot_on(node, now);
                } else {
                    // The node stays in Pre-Operational.
                    slave.boot = Boot::Refused;
                }
            }
            (Boot::Settings(n), Ok(_)) => {
                *n += 1;
                self.boot_on(node, now);
            }
            _ => {}
        }
    }

    /// Object 0x1F25: configures one slave or all slaves again.
    pub(in super::super) fn reconfigure(&mut self, sub: u8) {
        let now = self.now;
        for node in 1..=127 {
            if sub == 128 || sub == node {
                if let Some(slave) = self.master.slave(node) {
                    slave.boot = Boot::Waiting;
                }
                self.booted(node, now);
            }
        }
    }

    fn software_error(&mut self, error: u8, node: u8, now: u64) {
        self.emergency(SOFTWARE, u16::from_le_bytes([node, error]), now);
    }
}

/// Compares expected and found identity. An expected 0 matches everything. Of a revision, the major
/// part must be equal and the minor part at least the expected one.
fn matches(line: usize, expected: u32, found: u32) -> bool {
    match (line, expected) {
        (_, 0) => true,
        (3, _) => found >> 16 == expected >> 16 && found & 0xffff >= expected & 0xffff,
        _ => found == expected,
    }
}
