//! Firmware files of simulated devices: a header of [`HEADER`] bytes, then what stands for the program. Little-endian.
//!
//! | bytes | |
//! |---|---|
//! | 0–7 | `ECAXISFW` |
//! | 8–11, 12–15 | vendor and product that it is for |
//! | 16–19 | revision of the device once it runs (0x1018:03, SII words 12 and 13) |
//! | 20–23 | software version, four ASCII characters (0x100A) |
//! | 24–27 | bytes of program |
//! | 28–31 | CRC-32 (IEEE 802.3) of the bytes 0–27 and of the program; as 0x1F56 shows it |

/// Bytes of the header.
pub const HEADER: usize = 32;
const MAGIC: &[u8; 8] = b"ECAXISFW";
const CRC_AT: usize = 28;

/// What a firmware file says of itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FirmwareHeader {
    pub vendor: u32,
    pub product: u32,
    /// Of the device once it runs.
    pub revision: u32,
    /// Software version, ASCII.
    pub version: [u8; 4],
}

/// Why a file is no firmware for a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Unfit {
    NoHeader,
    OtherDevice,
    /// The program is damaged, or not as long as the header says.
    Checksum,
}

impl FirmwareHeader {
    /// A firmware file with this program.
    #[must_use]
    pub fn file(&self, program: &[u8]) -> Vec<u8> {
        let mut file = MAGIC.to_vec();
        for word in [self.vendor, self.product, self.revision] {
            file.extend_from_slice(&word.to_le_bytes());
        }
        file.extend_from_slice(&self.version);
        let len = u32::try_from(program.len()).unwrap_or(u32::MAX);
        file.extend_from_slice(&len.to_le_bytes());
        let crc = checksum(&file, program);
        file.extend_from_slice(&crc.to_le_bytes());
        file.extend_from_slice(program);
        file
    }

    /// The header at the beginning of a file, as far as it can be judged without the rest.
    pub(crate) fn parse(file: &[u8]) -> Result<Self, Unfit> {
        let rest = file.strip_prefix(MAGIC).ok_or(Unfit::NoHeader)?;
        let words = rest.first_chunk::<24>().ok_or(Unfit::NoHeader)?;
        let word = |at: usize| {
            let bytes = words.get(at..).and_then(|rest| rest.first_chunk());
            bytes.map_or(0, |bytes| u32::from_le_bytes(*bytes))
        };
        Ok(Self {
            vendor: word(0),
            product: word(4),
            revision: word(8),
            version: word(12).to_le_bytes(),
        })
    }

    /// As [`Self::parse`], of a whole file; with its checksum.
    pub(crate) fn verify(file: &[u8]) -> Result<(Self, u32), Unfit> {
        let header = Self::parse(file)?;
        let (head, program) = file.split_at_checked(HEADER).ok_or(Unfit::NoHeader)?;
        let (head, crc) = head.split_at_checked(CRC_AT).ok_or(Unfit::NoHeader)?;
        let len = head
            .last_chunk()
            .map_or(0, |bytes| u32::from_le_bytes(*bytes));
        let crc = crc
            .first_chunk()
            .map_or(0, |bytes| u32::from_le_bytes(*bytes));
        if usize::try_from(len) != Ok(program.len()) || checksum(head, program) != crc {
            return Err(Unfit::Checksum);
        }
        Ok((header, crc))
    }
}

/// Reflected, polynomial 0x04C11DB7.
fn checksum(head: &[u8], program: &[u8]) -> u32 {
    let crc = head.iter().chain(program).fold(u32::MAX, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| {
            crc >> 1 ^ if crc & 1 == 0 { 0 } else { 0xedb8_8320 }
        })
    });
    !crc
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: FirmwareHeader = FirmwareHeader {
        vendor: 0xe0a,
        product: 0x4550_0004,
        revision: 0x0002_0000,
        version: *b"0200",
    };

    #[test]
    fn the_checksum_is_that_of_ethernet() {
        assert_eq!(checksum(b"1234", b"56789"), 0xcbf4_3926);
    }

    #[test]
    fn a_file_says_what_it_was_made_of() {
        let program: Vec<u8> = (0..=255).collect();
        let file = HEAD.file(&program);
        assert_eq!(file.len(), HEADER + 256);
        assert_eq!(FirmwareHeader::parse(&file), Ok(HEAD));
        assert_eq!(
            FirmwareHeader::verify(&file).map(|(head, _)| head),
            Ok(HEAD)
        );
    }

    #[test]
    fn every_damaged_byte_and_every_cut_is_found() {
        let file = HEAD.file(&[1, 2, 3, 4, 5]);
        for n in 0..file.len() {
            let mut damaged = file.clone();
            damaged[n] ^= 0x10;
            let expected = if n < MAGIC.len() {
                Unfit::NoHeader
            } else {
                Unfit::Checksum
            };
            assert_eq!(FirmwareHeader::verify(&damaged), Err(expected), "byte {n}");
            assert!(FirmwareHeader::verify(&file[..n]).is_err(), "{n} bytes");
        }
        assert!(FirmwareHeader::verify(&[&file[..], &[0]].concat()).is_err());
    }
}
