//! The SII EEPROM behind registers 0x0500–0x050F.

use super::info::EscInfo;
use super::info::eeprom::EIGHT_BYTES;

/// Time a write takes.
const WRITE_NS: u64 = 500_000;

pub const WRITE_ENABLE: u16 = 0x0001;
pub const CHECKSUM_ERROR: u16 = 0x0800;
pub const COMMAND_ERROR: u16 = 0x2000;
pub const WRITE_ENABLE_ERROR: u16 = 0x4000;
pub const BUSY: u16 = 0x8000;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Job {
    Read(u32),
    Write(u32, [u8; 2]),
    Reload,
}

#[derive(Debug, Clone)]
pub struct Eeprom {
    image: Vec<u8>,
    /// Bits of the status that tell of the chip, see [`super::info::eeprom`].
    features: u16,
    read_ns: u64,
    job: Option<(Job, u64)>,
    error: u16,
}

impl Eeprom {
    #[must_use]
    pub fn new(image: Vec<u8>, info: &EscInfo) -> Self {
        let mut eeprom = Self {
            image,
            features: info.eeprom,
            read_ns: info.eeprom_read_ns,
            job: None,
            error: 0,
        };
        eeprom.check();
        eeprom
    }

    /// Sets the checksum error while the first 14 bytes and their CRC disagree.
    fn check(&mut self) {
        self.error &= !CHECKSUM_ERROR;
        let crc = self.image.get(..14).map(|head| {
            head.iter().fold(0xff_u8, |crc, byte| {
                (0..8).fold(crc ^ byte, |crc, _| {
                    crc << 1 ^ if crc & 0x80 != 0 { 0x07 } else { 0 }
                })
            })
        });
        if crc.is_none() || crc != self.image.get(14).copied() {
            self.error |= CHECKSUM_ERROR;
        }
    }

    #[must_use]
    pub fn image(&self) -> &[u8] {
        &self.image
    }

    #[must_use]
    pub fn word(&self, word: u32) -> u16 {
        let at = usize::try_from(word)
            .unwrap_or(usize::MAX)
            .saturating_mul(2);
        match self.image.get(at..at.saturating_add(2)) {
            Some([low, high]) => u16::from_le_bytes([*low, *high]),
            _ => 0xffff,
        }
    }

    /// Overwrites a 32-bit value at a word address without the interface; for fault injection.
    pub fn patch(&mut self, word: usize, value: u32) {
        if let Some(bytes) = self.image.get_mut(word * 2..word * 2 + 4) {
            bytes.copy_from_slice(&value.to_le_bytes());
        }
    }

    /// A write to the control register with its address and data registers.
    pub fn command(&mut self, control: u16, address: u32, data: [u8; 2], local: u64) {
        if self.job.is_some() {
            return;
        }
        self.error &= CHECKSUM_ERROR;
        self.job = match control >> 8 & 7 {
            0 => None,
            1 => Some((Job::Read(address), local + self.read_ns)),
            2 if control & WRITE_ENABLE == 0 => {
                self.error |= WRITE_ENABLE_ERROR;
                None
            }
            2 => Some((Job::Write(address, data), local + WRITE_NS)),
            4 => Some((Job::Reload, local + self.read_ns)),
            _ => {
                self.error |= COMMAND_ERROR;
                None
            }
        };
    }

    #[must_use]
    pub fn due(&self) -> u64 {
        self.job.map_or(u64::MAX, |(_, due)| due)
    }

    /// Ends the running job; the bytes for the data register and how many count, if it was a read.
    pub fn finish(&mut self) -> Option<([u8; 8], usize)> {
        match self.job.take()?.0 {
            Job::Read(word) => {
                let mut out = [0xff; 8];
                for (n, pair) in (0..4).zip(out.chunks_exact_mut(2)) {
                    pair.copy_from_slice(&self.word(word.wrapping_add(n)).to_le_bytes());
                }
                let eight = self.features & EIGHT_BYTES != 0;
                Some((out, if eight { 8 } else { 4 }))
            }
            Job::Write(word, data) => {
                let at = usize::try_from(word)
                    .unwrap_or(usize::MAX)
                    .saturating_mul(2);
                match self.image.get_mut(at..at.saturating_add(2)) {
                    Some(bytes) => bytes.copy_from_slice(&data),
                    None => self.error |= COMMAND_ERROR,
                }
                None
            }
            Job::Reload => {
                self.check();
                None
            }
        }
    }

    #[must_use]
    pub fn status(&self) -> u16 {
        self.features | self.error | if self.job.is_some() { BUSY } else { 0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_eight_bytes_and_ones_beyond_the_end() {
        let mut eeprom = Eeprom::new((0..32).collect(), &EscInfo::default());
        eeprom.command(0x0100, 14, [0; 2], 0);
        assert_eq!(eeprom.status() & BUSY, BUSY);
        assert_eq!(
            eeprom.finish(),
            Some(([28, 29, 30, 31, 0xff, 0xff, 0xff, 0xff], 8))
        );
        assert_eq!(eeprom.status() & BUSY, 0);
    }

    #[test]
    fn writes_need_the_enable_bit() {
        let mut eeprom = Eeprom::new(vec![0; 32], &EscInfo::default());
        eeprom.command(0x0200, 4, [1, 2], 0);
        assert_eq!(eeprom.status() & WRITE_ENABLE_ERROR, WRITE_ENABLE_ERROR);
        eeprom.command(0x0201, 4, [1, 2], 0);
        eeprom.finish();
        assert_eq!(eeprom.word(4), 0x0201);
        assert_eq!(eeprom.status() & WRITE_ENABLE_ERROR, 0);
    }

    #[test]
    fn the_crc_covers_the_first_14_bytes() {
        let mut image = vec![0; 32];
        // ETG.2010: polynomial x^8 + x^2 + x + 1, start value 0xff.
        image[..15].copy_from_slice(&[8, 0, 0, 0x44, 0x88, 0x13, 1, 0, 0, 0, 0, 0, 0, 0, 0]);
        let bad = Eeprom::new(image.clone(), &EscInfo::default());
        let good = (0..=255).any(|crc| {
            image[14] = crc;
            Eeprom::new(image.clone(), &EscInfo::default()).status() & CHECKSUM_ERROR == 0
        });
        assert!(good && bad.status() & BUSY == 0);
    }
}
