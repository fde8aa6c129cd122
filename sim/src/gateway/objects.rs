//! The gateway's CANopen objects, as a configuration tool on the secondary network accesses them
//! (manual §7).

use ecaxis_esi::model::SmUse;

use super::Gateway;
use super::anybus::{buffer_count, buffer_place};
use super::control::Target;
use super::dictionary::Dictionary;
use super::nmt::NmtCommand;
use super::node::{LOAD, SAVE};
use super::pdo;
use super::sdo::Objects;
use super::{Abort, anybus};

/// Hardware error: the data sizes exceed the limits of the fieldbus side.
const HARDWARE: u16 = 0x6600;
/// "conf".
const CONFIGURE: i64 = 0x666e_6f63;

impl Objects for Gateway {
    fn read(&self, index: u16, sub: u8) -> Result<Vec<u8>, Abort> {
        if let Some(count) = buffer_count(index) {
            if sub == 0 {
                return Ok(vec![count]);
            }
            let (receive, at, len) = buffer_place(index, sub).ok_or(Abort::NO_SUBINDEX)?;
            let buffer = if receive { &self.inputs } else { &self.outputs };
            let mut out = buffer
                .get(at..(at + len).min(buffer.len()))
                .map_or(Vec::new(), <[u8]>::to_vec);
            out.resize(len, 0);
            return Ok(out);
        }
        match (index, sub) {
            (0x1f82, 1..=127) => Ok(vec![self.node_state(sub)]),
            (0x1f83, 1..=127) => Ok(vec![u8::from(self.is_guarded(sub))]),
            _ => self.d.read(index, sub),
        }
    }

    fn write(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<(), Abort> {
        if buffer_count(index).is_some() {
            return self.write_buffer(index, sub, data);
        }
        let value = self.d.check(index, sub, data)?;
        match (index, sub) {
            (0x1003, 0) => (1..=16).for_each(|sub| self.d.set(0x1003, sub, 0)),
            (0x1010, 1) => {
                if value != SAVE {
                    return Err(Abort::NOT_STORED);
                }
                if !self.sizes_fit() {
                    self.emergency(HARDWARE, 0, self.now);
                    return Err(Abort::NOT_STORED);
                }
                self.stored = self.d.clone();
                return Ok(());
            }
            (0x1011, 1) => {
                if value != LOAD {
                    return Err(Abort::NOT_STORED);
                }
                self.stored = self.factory();
                return Ok(());
            }
            (0x1017, 0) if (1..10).contains(&value) => return Err(Abort::VALUE_TOO_LOW),
            (0x1600..=0x167f | 0x1a00..=0x1a7f, _) => self.check_mapping(index, sub, value)?,
            (0x1f25, _) => {
                if value != CONFIGURE {
                    return Err(Abort::NOT_STORED);
                }
                self.reconfigure(sub);
                return Ok(());
            }
            (0x1f82, _) => return self.request_nmt(sub, value),
            (0x1f83, _) => return self.request_guarding(sub, value),
            _ => {}
        }
        self.d.write(index, sub, data)?;
        match index {
            0x1006 => self.restart_sync(),
            0x1016 => self.load_consumers(),
            0x1017 => self.restart_heartbeat(),
            0x1400..=0x1a7f => self.load_pdos(),
            _ => {}
        }
        Ok(())
    }
}

impl Gateway {
    pub(super) fn factory(&self) -> Dictionary {
        let identity = &self.esi.identity;
        anybus::factory(
            self.options.node_id,
            identity.vendor,
            identity.product,
            identity.revision,
            self.serial,
        )
    }

    /// True if the SyncManagers of the EtherCAT side can have the lengths of 0x3000 and 0x3001.
    fn sizes_fit(&self) -> bool {
        let most = |usage| {
            let sms = self.esi.sync_managers.iter();
            let limits = sms
                .filter(|sm| sm.usage == usage)
                .filter_map(|sm| sm.max_size);
            i64::from(limits.min().unwrap_or(anybus::MAX_SIZE))
        };
        self.d.get(0x3000, 0) <= most(SmUse::Inputs)
            && self.d.get(0x3001, 0) <= most(SmUse::Outputs)
    }

    fn write_buffer(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<(), Abort> {
        if sub == 0 {
            return Err(Abort::READ_ONLY);
        }
        let (receive, at, len) = buffer_place(index, sub).ok_or(Abort::NO_SUBINDEX)?;
        match data.len().cmp(&len) {
            std::cmp::Ordering::Less => return Err(Abort::TOO_SHORT),
            std::cmp::Ordering::Greater => return Err(Abort::TOO_LONG),
            std::cmp::Ordering::Equal => {}
        }
        let buffer = if receive {
            &mut self.inputs
        } else {
            &mut self.outputs
        };
        for (to, from) in buffer.iter_mut().skip(at).zip(data) {
            *to = *from;
        }
        Ok(())
    }

    /// Checks a mapping entry. Entries change only while the PDO maps nothing. They must be buffer
    /// objects of the PDO's direction.
    fn check_mapping(&self, index: u16, sub: u8, value: i64) -> Result<(), Abort> {
        let bytes = |value: i64| {
            let (object, object_sub, bits) = pdo::entry(value as u32);
            let (receive, _, len) = buffer_place(object, object_sub)?;
            (receive == (index < 0x1800) && usize::from(bits) == len * 8).then_some(len)
        };
        if sub > 0 {
            return match (self.d.get(index, 0), value) {
                (1.., _) => Err(Abort::COUNT_NOT_ZERO),
                (_, 0) => Ok(()),
                _ => bytes(value).map(drop).ok_or(Abort::NOT_MAPPABLE),
            };
        }
        let mut len = 0;
        for sub in 1..=value as u8 {
            len += bytes(self.d.get(index, sub)).ok_or(Abort::NOT_MAPPABLE)?;
        }
        if len > 8 {
            return Err(Abort::MAPPING_TOO_LONG);
        }
        Ok(())
    }

    fn request_nmt(&mut self, sub: u8, value: i64) -> Result<(), Abort> {
        let command = match value {
            4 => NmtCommand::Stop,
            5 => NmtCommand::Start,
            6 => NmtCommand::ResetNode,
            7 => NmtCommand::ResetCommunication,
            127 => NmtCommand::EnterPreOperational,
            _ => return Err(Abort::VALUE),
        };
        let target = match sub {
            128 => Target::Network,
            own if own == self.options.node_id => Target::Module,
            node => Target::Node(node),
        };
        if self.set_state(command, target, self.now) {
            Ok(())
        } else {
            Err(Abort::WRONG_STATE)
        }
    }
}
