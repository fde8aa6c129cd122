//! The SII EEPROM behind registers 0x0502–0x050F.
//!
//! Source: Beckhoff ESC data sheet, section I, 11; section II, 2.11.

use super::chip::EscInfo;
use super::chip::eeprom::{EIGHT_BYTES, TWO_BYTE_ADDRESS};

/// The duration of a write in ns.
const WRITE_NS: u64 = 500_000;

/// Bits of the control and status register 0x0502.
pub const WRITE_ENABLE: u16 = 0x0001;
pub const CHECKSUM_ERROR: u16 = 0x0800;
pub const NOT_LOADED: u16 = 0x1000;
pub const COMMAND_ERROR: u16 = 0x2000;
pub const WRITE_ENABLE_ERROR: u16 = 0x4000;
pub const BUSY: u16 = 0x8000;

/// A checksum value that is always accepted.
const ANY_CHECKSUM: u16 = 0x88a4;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Job {
    Read(u32),
    Write(u32, [u8; 2]),
    Reload,
}

impl Job {
    /// Returns command bits 10:8, which are visible while the job runs.
    fn code(self) -> u16 {
        match self {
            Self::Read(_) => 0x0100,
            Self::Write(..) => 0x0200,
            Self::Reload => 0x0400,
        }
    }
}

/// The result of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Finished {
    /// Bytes for the data register, and the number of valid ones.
    Read([u8; 8], usize),
    Written,
    /// The configuration area was read again and applies if it is valid.
    Reloaded,
}

#[derive(Debug, Clone)]
pub struct Eeprom {
    image: Vec<u8>,
    /// The chip bits of the status, see [`super::chip::eeprom`].
    features: u16,
    /// The duration of a read or reload in ns.
    read_ns: u64,
    job: Option<(Job, u64)>,
    error: u16,
}

impl Eeprom {
    #[must_use]
    pub fn new(image: Vec<u8>, info: &EscInfo) -> Self {
        Self {
            image,
            features: info.eeprom,
            read_ns: info.eeprom_read_ns,
            job: None,
            error: 0,
        }
    }

    /// Resets everything except the contents.
    pub fn power_on(&mut self) {
        (self.job, self.error) = (None, 0);
    }

    /// Returns words 0 to 6 if the checksum in word 7 matches (ETG.2010: x^8 + x^2 + x + 1, start
    /// value 0xff). Otherwise the status shows the error from now on.
    pub fn configuration(&mut self) -> Option<[u16; 7]> {
        let any = self.image.len() > 15 && self.word(7) == ANY_CHECKSUM;
        if !self.checksum_fits() && !any {
            self.error |= CHECKSUM_ERROR;
            return None;
        }
        self.error &= !CHECKSUM_ERROR;
        let mut words = [0; 7];
        for (n, word) in (0..).zip(&mut words) {
            *word = self.word(n);
        }
        Some(words)
    }

    /// Returns the checksum of the configuration area.
    fn checksum(&self) -> Option<u8> {
        let head = self.image.get(..14)?;
        Some(head.iter().fold(0xff_u8, |crc, byte| {
            (0..8).fold(crc ^ byte, |crc, _| {
                crc << 1 ^ if crc & 0x80 != 0 { 0x07 } else { 0 }
            })
        }))
    }

    fn checksum_fits(&self) -> bool {
        let crc = self.checksum();
        crc.is_some() && crc == self.image.get(14).copied()
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

    /// Overwrites the station alias and updates a valid checksum, for fault injection.
    pub fn patch_alias(&mut self, alias: u16) {
        let fits = self.checksum_fits();
        if let Some(word) = self.image.get_mut(8..10) {
            word.copy_from_slice(&alias.to_le_bytes());
        }
        if let (true, Some(crc)) = (fits, self.checksum())
            && let Some(byte) = self.image.get_mut(14)
        {
            *byte = crc;
        }
    }

    /// Overwrites a 32-bit value at a word address without the interface, for fault injection.
    pub fn patch(&mut self, word: usize, value: u32) {
        if let Some(bytes) = self.image.get_mut(word * 2..word * 2 + 4) {
            bytes.copy_from_slice(&value.to_le_bytes());
        }
    }

    /// Reduces a word address to the bits that the chip receives.
    fn address(&self, word: u32) -> u32 {
        let bits = if self.features & TWO_BYTE_ADDRESS != 0 {
            18
        } else {
            10
        };
        word & ((1 << bits) - 1)
    }

    /// Executes a command of the control register with the contents of the address and data
    /// registers.
    pub fn command(&mut self, control: u16, address: u32, data: [u8; 2], local: u64) {
        if self.is_busy() {
            return;
        }
        // Any valid command clears these.
        self.error &= !(COMMAND_ERROR | WRITE_ENABLE_ERROR);
        let address = self.address(address);
        self.job = match control >> 8 & 7 {
            0 => None,
            1 => Some((Job::Read(address), local.saturating_add(self.read_ns))),
            2 if control & WRITE_ENABLE == 0 => {
                self.error |= WRITE_ENABLE_ERROR;
                None
            }
            2 => Some((Job::Write(address, data), local.saturating_add(WRITE_NS))),
            4 => Some((Job::Reload, local.saturating_add(self.read_ns))),
            _ => {
                self.error |= COMMAND_ERROR;
                None
            }
        };
    }

    #[must_use]
    pub fn is_busy(&self) -> bool {
        self.job.is_some()
    }

    #[must_use]
    pub fn due(&self) -> u64 {
        self.job.map_or(u64::MAX, |(_, due)| due)
    }

    /// Ends the current job.
    pub fn finish(&mut self) -> Option<Finished> {
        Some(match self.job.take()?.0 {
            Job::Read(word) => {
                let mut out = [0xff; 8];
                // At its end, a chip goes on with its beginning (AT24C16 data sheet, "sequential
                // read").
                for (n, pair) in (0..4).zip(out.chunks_exact_mut(2)) {
                    let word = self.address(word.wrapping_add(n));
                    pair.copy_from_slice(&self.word(word).to_le_bytes());
                }
                let eight = self.features & EIGHT_BYTES != 0;
                Finished::Read(out, if eight { 8 } else { 4 })
            }
            Job::Write(word, data) => {
                let at = usize::try_from(word)
                    .unwrap_or(usize::MAX)
                    .saturating_mul(2);
                match self.image.get_mut(at..at.saturating_add(2)) {
                    Some(bytes) => bytes.copy_from_slice(&data),
                    None => self.error |= COMMAND_ERROR,
                }
                Finished::Written
            }
            Job::Reload => Finished::Reloaded,
        })
    }

    /// Returns 0x0502 without the write enable bit and the loading error.
    #[must_use]
    pub fn status(&self) -> u16 {
        let job = self.job.map_or(0, |(job, _)| BUSY | job.code());
        self.features | self.error | job
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_features(image: Vec<u8>, eeprom: u16) -> Eeprom {
        let info = EscInfo {
            eeprom,
            ..EscInfo::ET1100
        };
        Eeprom::new(image, &info)
    }

    fn eeprom(image: Vec<u8>) -> Eeprom {
        with_features(image, EIGHT_BYTES)
    }

    #[test]
    fn eeprom_reads_4_or_8_bytes_and_ones_beyond_the_end() {
        let bytes = [28, 29, 30, 31, 0xff, 0xff, 0xff, 0xff];
        for (features, len) in [(EIGHT_BYTES, 8), (0, 4)] {
            let mut eeprom = with_features((0..32).collect(), features);
            eeprom.command(0x0100, 14, [0; 2], 0);
            assert_eq!(eeprom.status(), features | BUSY | 0x0100);
            assert_eq!(eeprom.finish(), Some(Finished::Read(bytes, len)));
            assert_eq!(eeprom.status(), features);
        }
    }

    #[test]
    fn small_eeprom_uses_ten_bits_of_the_address() {
        let read = |features, word| {
            let mut eeprom = with_features((0..32).collect(), features);
            eeprom.command(0x0100, word, [0; 2], 0);
            eeprom.finish()
        };
        let word_2 = Some(Finished::Read([4, 5, 6, 7, 8, 9, 10, 11], 4));
        assert_eq!(read(0, 0x402), word_2);
        assert_ne!(read(TWO_BYTE_ADDRESS, 0x402), word_2);
        assert_eq!(read(TWO_BYTE_ADDRESS, 0x4_0002), word_2);
    }

    #[test]
    fn eeprom_errors_stay_until_the_next_valid_command() {
        // (control, error bits afterwards)
        let rows = [
            (0x0200, WRITE_ENABLE_ERROR),
            (0x0300, COMMAND_ERROR),
            (0x0501, COMMAND_ERROR),
            (0x0700, COMMAND_ERROR),
            (0x0000, 0),
            (0x0200, WRITE_ENABLE_ERROR),
            (0x0100, 0),
        ];
        let mut eeprom = eeprom(vec![0; 32]);
        for (control, expected) in rows {
            eeprom.command(control, 4, [1, 2], 0);
            eeprom.finish();
            let errors = eeprom.status() & (COMMAND_ERROR | WRITE_ENABLE_ERROR);
            assert_eq!(errors, expected, "0x{control:04x}");
        }
    }

    #[test]
    fn eeprom_writes_take_time_and_persist() {
        let mut eeprom = eeprom(vec![0; 32]);
        eeprom.command(0x0201, 4, [1, 2], 0);
        assert_eq!(eeprom.word(4), 0);
        eeprom.command(0x0201, 5, [3, 4], 0);
        assert_eq!(eeprom.finish(), Some(Finished::Written));
        eeprom.power_on();
        assert_eq!((eeprom.word(4), eeprom.word(5)), (0x0201, 0), "busy");
        eeprom.command(0x0201, 16, [1, 2], 0);
        eeprom.finish();
        assert_eq!(eeprom.status() & COMMAND_ERROR, COMMAND_ERROR, "no memory");
    }

    #[test]
    fn the_crc_covers_the_first_14_bytes() {
        let mut image = vec![0; 32];
        image[..15].copy_from_slice(&[8, 0, 0, 0x44, 0x88, 0x13, 1, 0, 0, 0, 0, 0, 0, 0, 0]);
        let sound: Vec<u8> = (0..=255)
            .filter(|crc| {
                image[14] = *crc;
                eeprom(image.clone()).configuration().is_some()
            })
            .collect();
        assert_eq!(sound.len(), 1);
        image[14] = sound[0];
        let words = eeprom(image.clone()).configuration().unwrap();
        assert_eq!(words[..3], [8, 0x4400, 0x1388]);
        image[14] ^= 1;
        let mut bad = eeprom(image.clone());
        assert_eq!(bad.configuration(), None);
        assert_eq!(bad.status() & CHECKSUM_ERROR, CHECKSUM_ERROR);
        image[14..16].copy_from_slice(&ANY_CHECKSUM.to_le_bytes());
        assert!(eeprom(image).configuration().is_some());
        assert_eq!(eeprom(vec![0; 7]).configuration(), None);
    }
}
