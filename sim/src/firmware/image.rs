//! Firmware files of simulated devices: a header of [`HEADER`] bytes, then the program bytes. All
//! values are little-endian.
//!
//! | bytes | |
//! |---|---|
//! | 0–7 | `ECAXISFW` |
//! | 8–11, 12–15 | vendor and product of the target device |
//! | 16–19 | revision of the device with this program (0x1018:03, SII words 12 and 13) |
//! | 20–23 | software version, four ASCII characters (0x100A) |
//! | 24–27 | length of the program in bytes |
//! | 28–31 | CRC-32 (IEEE 802.3) of the bytes 0–27 and of the program, also in 0x1F56 |

/// The length of the header in bytes.
pub const HEADER: usize = 32;
const MAGIC: &[u8; 8] = b"ECAXISFW";
const CRC_AT: usize = 28;

/// The header of a firmware file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FirmwareHeader {
    /// The vendor ID of the target device.
    pub vendor: u32,
    /// The product code of the target device.
    pub product: u32,
    /// The revision of the device with this program.
    pub revision: u32,
    /// The software version in ASCII.
    pub version: [u8; 4],
}

/// The reason why a file does not suit a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ImageError {
    NoHeader,
    OtherDevice,
    /// The program is damaged, or its length differs from the header.
    Checksum,
}

impl FirmwareHeader {
    /// Returns a firmware file with this header and this program.
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

    /// Parses the header at the start of a file, without checks of the rest.
    pub(crate) fn parse(file: &[u8]) -> Result<Self, ImageError> {
        let rest = file.strip_prefix(MAGIC).ok_or(ImageError::NoHeader)?;
        let words = rest.first_chunk::<24>().ok_or(ImageError::NoHeader)?;
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

    /// Like [`Self::parse`], for a complete file. Also returns the checksum.
    pub(crate) fn verify(file: &[u8]) -> Result<(Self, u32), ImageError> {
        let header = Self::parse(file)?;
        let (head, program) = file.split_at_checked(HEADER).ok_or(ImageError::NoHeader)?;
        let (head, crc) = head.split_at_checked(CRC_AT).ok_or(ImageError::NoHeader)?;
        let len = head
            .last_chunk()
            .map_or(0, |bytes| u32::from_le_bytes(*bytes));
        let crc = crc
            .first_chunk()
            .map_or(0, |bytes| u32::from_le_bytes(*bytes));
        if usize::try_from(len) != Ok(program.len()) || checksum(head, program) != crc {
            return Err(ImageError::Checksum);
        }
        Ok((header, crc))
    }
}

/// Returns the CRC-32 (reflected, polynomial 0x04C11DB7).
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
    fn checksum_equals_the_crc_32_of_ethernet() {
        assert_eq!(checksum(b"1234", b"56789"), 0xcbf4_3926);
    }

    #[test]
    fn verify_returns_the_header_of_a_file() {
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
    fn verify_detects_every_damaged_byte_and_truncation() {
        let file = HEAD.file(&[1, 2, 3, 4, 5]);
        for n in 0..file.len() {
            let mut damaged = file.clone();
            damaged[n] ^= 0x10;
            let expected = if n < MAGIC.len() {
                ImageError::NoHeader
            } else {
                ImageError::Checksum
            };
            assert_eq!(FirmwareHeader::verify(&damaged), Err(expected), "byte {n}");
            assert!(FirmwareHeader::verify(&file[..n]).is_err(), "{n} bytes");
        }
        assert!(FirmwareHeader::verify(&[&file[..], &[0]].concat()).is_err());
    }
}
