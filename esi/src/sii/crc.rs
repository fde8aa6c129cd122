//! CRC-8, polynomial x⁸+x²+x+1, start value 0xff, no reflection (ETG.2010).

/// Returns the checksum of the first 14 bytes of an image, which byte 14 contains.
#[must_use]
pub fn checksum(config: &[u8; 14]) -> u8 {
    config.iter().fold(0xff, |crc, &byte| {
        (0..8).fold(crc ^ byte, |crc: u8, _| {
            if crc & 0x80 != 0 {
                crc << 1 ^ 0x07
            } else {
                crc << 1
            }
        })
    })
}

#[cfg(test)]
mod tests {
    use super::checksum;

    /// Controller settings and checksums from real devices.
    #[test]
    fn checksum_matches_real_devices() {
        for (config, expected) in [
            ([0x04, 0x01, 0, 0, 0, 0, 0x0f, 0, 0, 0, 0, 0, 0, 0], 0xd8),
            ([0, 0x0d, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], 0x46),
            ([0x08, 0, 0, 0x66, 0, 0x01, 0, 0, 0, 0, 0, 0, 0, 0], 0x0a),
        ] {
            assert_eq!(checksum(&config), expected);
        }
    }
}
