//! The EEPROM content of a SubDevice in a recording (ETG.1000.6, ETG.2010): words read with 0x0502
//! and 0x0508.

use std::collections::BTreeMap;

use super::registers::{part, part_u16};
use ecaxis_ecat::registers;
use ecaxis_ecat::sii::control::{BUSY, COMMAND, EIGHT_BYTES, READ};
use ecaxis_ecat::sii::{FIRST_CATEGORY, category};

/// The maximum number of categories.
const CATEGORIES: usize = 64;

/// The known words of an EEPROM.
#[derive(Debug, Default, Clone)]
pub struct Eeprom {
    words: BTreeMap<u16, u16>,
    /// The word address of a pending read.
    reading: Option<u16>,
    wide: bool,
}

impl Eeprom {
    /// Processes a write to the control registers.
    pub fn written(&mut self, register: u16, data: &[u8]) {
        let Some(control) = part_u16(register, data, registers::EEPROM_CONTROL) else {
            return;
        };
        self.reading = (control & COMMAND == READ)
            .then(|| part_u16(register, data, registers::EEPROM_ADDRESS))
            .flatten();
    }

    /// Processes a read of the control registers, and of the data registers if included.
    pub fn read(&mut self, register: u16, data: &[u8]) {
        let status = part_u16(register, data, registers::EEPROM_CONTROL);
        if let Some(status) = status {
            self.wide = status & EIGHT_BYTES != 0;
        }
        let (Some(at), false) = (self.reading, status.is_some_and(|s| s & BUSY != 0)) else {
            return;
        };
        let wide = part(register, data, registers::EEPROM_DATA, 8).filter(|_| self.wide);
        let Some(found) = wide.or_else(|| part(register, data, registers::EEPROM_DATA, 4)) else {
            return;
        };
        for (n, word) in (0..).zip(found.chunks_exact(2)) {
            if let ([low, high], Some(at)) = (word, at.checked_add(n)) {
                self.words.insert(at, u16::from_le_bytes([*low, *high]));
            }
        }
        self.reading = None;
    }

    pub fn words(&self) -> usize {
        self.words.len()
    }

    fn word(&self, at: u16) -> Option<u16> {
        self.words.get(&at).copied()
    }

    fn two(&self, at: u16) -> Option<u32> {
        Some(u32::from(self.word(at)?) | u32::from(self.word(at.checked_add(1)?)?) << 16)
    }

    pub fn alias(&self) -> Option<u16> {
        self.word(0x04)
    }

    pub fn vendor(&self) -> Option<u32> {
        self.two(0x08)
    }

    pub fn product(&self) -> Option<u32> {
        self.two(0x0a)
    }

    pub fn revision(&self) -> Option<u32> {
        self.two(0x0c)
    }

    pub fn serial(&self) -> Option<u32> {
        self.two(0x0e)
    }

    /// Returns start and length of a category in words. Its content may be unknown.
    fn category(&self, wanted: u16) -> Option<(u16, u16)> {
        let mut at = FIRST_CATEGORY;
        for _ in 0..CATEGORIES {
            let kind = self.word(at)?;
            let len = self.word(at.checked_add(1)?)?;
            let start = at.checked_add(2)?;
            if kind == wanted {
                return Some((start, len));
            }
            if kind == category::END {
                return None;
            }
            at = start.checked_add(len)?;
        }
        None
    }

    /// Returns the known bytes of a category up to the first unknown word.
    fn bytes(&self, category: u16) -> Option<Vec<u8>> {
        let (start, len) = self.category(category)?;
        let known = (start..start.saturating_add(len)).map_while(|at| self.word(at));
        Some(known.flat_map(u16::to_le_bytes).collect())
    }

    fn text(&self, number: u8) -> Option<String> {
        let strings = self.bytes(category::STRINGS)?;
        let mut rest = strings.get(1..)?;
        for _ in 1..number {
            rest = rest.get(1 + usize::from(*rest.first()?)..)?;
        }
        let text = rest.get(1..)?.get(..usize::from(*rest.first()?))?;
        let text = String::from_utf8_lossy(text);
        let text = text.trim_matches(|c: char| c.is_whitespace() || c.is_control());
        (number > 0 && !text.is_empty()).then(|| text.to_owned())
    }

    /// Returns the type ("order") text, else the name.
    pub fn name(&self) -> Option<String> {
        let general = self.bytes(category::GENERAL)?;
        let text = |at: usize| self.text(*general.get(at)?);
        text(2).or_else(|| text(3))
    }
}
