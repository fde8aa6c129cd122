//! Access of SDO clients to a node's objects, and the effects of a write.

use super::super::Abort;
use super::super::dictionary::Dictionary;
use super::super::nmt::NmtState;
use super::super::pdo;
use super::super::sdo::Objects;
use super::{Node, epos};

/// "save" and "load", first letter in the lowest byte.
pub(in super::super) const SAVE: i64 = 0x6576_6173;
pub(in super::super) const LOAD: i64 = 0x6461_6f6c;

const MODES: [i64; 6] = [-3, -2, -1, 1, 3, 6];

impl Objects for Node {
    fn read(&self, index: u16, sub: u8) -> Result<Vec<u8>, Abort> {
        self.d.read(index, sub)
    }

    fn write(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<(), Abort> {
        let value = self.d.check(index, sub, data)?;
        match (index, sub) {
            (0x1003, 0) => {
                for sub in 1..=super::HISTORY {
                    self.d.set(0x1003, sub, 0);
                }
            }
            (0x1010, 1) => {
                if value != SAVE {
                    return Err(Abort::NOT_STORED);
                }
                self.stored = self.d.clone();
                for index in epos::VOLATILE {
                    self.stored.set(index, 0, 0);
                }
                // A read returns "can be saved on command", not the written word.
                return Ok(());
            }
            (0x1011, 1) => {
                if value != LOAD {
                    return Err(Abort::NOT_STORED);
                }
                self.stored = self.factory();
                return Ok(());
            }
            (0x1400..=0x1402 | 0x1800..=0x1802, 2) if !matches!(value, 1 | 255) => {
                return Err(Abort::VALUE);
            }
            (0x1600..=0x1602 | 0x1a00..=0x1a02, _) => self.check_mapping(index, sub, value)?,
            (0x6060, 0) if !MODES.contains(&value) => return Err(Abort::VALUE),
            _ => {}
        }
        self.d.write(index, sub, data)?;
        if (0x1400..0x1c00).contains(&index) {
            self.load_pdos();
        }
        if index >= 0x2000 {
            self.take_set_points();
        }
        Ok(())
    }
}

impl Node {
    fn factory(&self) -> Dictionary {
        let s = &self.settings;
        epos::dictionary(s.drive, s.id, s.serial, s.bit_rate)
    }

    /// Checks a mapping entry. Contents change in Pre-Operational, while the PDO maps nothing.
    fn check_mapping(&self, index: u16, sub: u8, value: i64) -> Result<(), Abort> {
        if self.nmt != NmtState::PreOperational {
            return Err(Abort::WRONG_STATE);
        }
        let mappable: &[_] = if index < 0x1800 {
            &epos::RECEIVABLE
        } else {
            &epos::TRANSMITTABLE
        };
        let known = |value: i64| mappable.contains(&pdo::entry(value as u32));
        if sub > 0 {
            if self.d.get(index, 0) != 0 {
                return Err(Abort::WRONG_STATE);
            }
            return if value == 0 || known(value) {
                Ok(())
            } else {
                Err(Abort::NOT_MAPPABLE)
            };
        }
        if value > 4 {
            return Err(Abort::VALUE_TOO_HIGH);
        }
        let mut bits = 0;
        for sub in 1..=value as u8 {
            let mapped = self.d.get(index, sub);
            if !known(mapped) {
                return Err(Abort::NOT_MAPPABLE);
            }
            bits += u32::from(pdo::entry(mapped as u32).2);
        }
        if bits > 64 {
            return Err(Abort::MAPPING_TOO_LONG);
        }
        Ok(())
    }
}
