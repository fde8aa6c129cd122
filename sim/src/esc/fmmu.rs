//! Fieldbus memory management units: logical bits ↔ physical bits.

/// One configured FMMU.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Fmmu {
    pub logical: u32,
    pub len: u16,
    pub start_bit: u8,
    pub stop_bit: u8,
    pub physical: u16,
    pub physical_bit: u8,
    pub read: bool,
    pub write: bool,
}

/// Where a datagram's bits meet an FMMU's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Overlap {
    /// First bit inside the datagram's data.
    pub data_bit: usize,
    /// First bit in the physical address space.
    pub physical_bit: usize,
    pub bits: usize,
}

impl Fmmu {
    /// From the 16 register bytes; `None` while it is not activated or maps nothing.
    #[must_use]
    pub fn from_registers(r: &[u8; 16]) -> Option<Self> {
        let fmmu = Self {
            logical: u32::from_le_bytes([r[0], r[1], r[2], r[3]]),
            len: u16::from_le_bytes([r[4], r[5]]),
            start_bit: r[6] & 7,
            stop_bit: r[7] & 7,
            physical: u16::from_le_bytes([r[8], r[9]]),
            physical_bit: r[10] & 7,
            read: r[11] & 1 != 0,
            write: r[11] & 2 != 0,
        };
        (r[12] & 1 != 0 && fmmu.bits() > 0).then_some(fmmu)
    }

    fn bits(&self) -> u64 {
        (u64::from(self.len) * 8 + u64::from(self.stop_bit) + 1)
            .saturating_sub(8 + u64::from(self.start_bit))
    }

    /// The bits a datagram of `len` bytes at logical address `start` shares with this FMMU.
    #[must_use]
    pub fn overlap(&self, start: u32, len: usize) -> Option<Overlap> {
        let mine = u64::from(self.logical) * 8 + u64::from(self.start_bit);
        let theirs = u64::from(start) * 8;
        let first = mine.max(theirs);
        let end = (mine + self.bits()).min(theirs + u64::try_from(len).ok()? * 8);
        let bits = end.checked_sub(first).filter(|bits| *bits > 0)?;
        Some(Overlap {
            data_bit: usize::try_from(first - theirs).ok()?,
            physical_bit: usize::from(self.physical) * 8
                + usize::from(self.physical_bit)
                + usize::try_from(first - mine).ok()?,
            bits: usize::try_from(bits).ok()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn registers(logical: u32, len: u16, bits: (u8, u8), physical: u16, bit: u8) -> [u8; 16] {
        let mut r = [0; 16];
        r[0..4].copy_from_slice(&logical.to_le_bytes());
        r[4..6].copy_from_slice(&len.to_le_bytes());
        (r[6], r[7]) = bits;
        r[8..10].copy_from_slice(&physical.to_le_bytes());
        (r[10], r[11], r[12]) = (bit, 1, 1);
        r
    }

    #[test]
    fn three_bits_in_the_middle_of_a_byte() {
        let fmmu = Fmmu::from_registers(&registers(0x1000, 1, (2, 4), 0x1100, 0)).unwrap();
        let overlap = fmmu.overlap(0x0fff, 4).unwrap();
        assert_eq!(
            overlap,
            Overlap {
                data_bit: 10,
                physical_bit: 0x1100 * 8,
                bits: 3
            }
        );
        assert_eq!(fmmu.overlap(0x1001, 4), None);
    }

    #[test]
    fn a_datagram_may_cover_the_tail_only() {
        let fmmu = Fmmu::from_registers(&registers(0x1000, 4, (0, 7), 0x1100, 0)).unwrap();
        let overlap = fmmu.overlap(0x1002, 8).unwrap();
        assert_eq!(
            overlap,
            Overlap {
                data_bit: 0,
                physical_bit: 0x1102 * 8,
                bits: 16
            }
        );
    }

    #[test]
    fn inactive_or_empty_maps_nothing() {
        let mut r = registers(0, 1, (0, 7), 0x1100, 0);
        r[12] = 0;
        assert_eq!(Fmmu::from_registers(&r), None);
        assert_eq!(Fmmu::from_registers(&registers(0, 0, (0, 7), 0, 0)), None);
        assert_eq!(Fmmu::from_registers(&registers(0, 1, (5, 2), 0, 0)), None);
    }
}
