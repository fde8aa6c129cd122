//! Fieldbus memory management units: logical bits ↔ physical bits (Beckhoff ESC data sheet, section
//! I, 7).
//!
//! Bits next to the mapped bits keep their value everywhere. Real controllers guarantee that only
//! for digital outputs.

/// Maximum number of FMMUs of a controller in the simulation.
pub const COUNT: usize = 8;

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

/// The common bits of a datagram and an FMMU.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Overlap {
    /// The first bit in the data of the datagram.
    pub data_bit: usize,
    /// The first bit in the physical address space.
    pub physical_bit: usize,
    pub bits: usize,
}

impl Overlap {
    /// Returns the first physical byte and the one behind the last.
    #[must_use]
    pub fn physical_bytes(&self) -> (usize, usize) {
        let end = self.physical_bit + self.bits;
        (self.physical_bit / 8, end.div_ceil(8))
    }

    /// Returns the part of the overlap in these physical bytes.
    #[must_use]
    pub fn within(&self, start: usize, end: usize) -> Self {
        let first = self.physical_bit.max(start * 8);
        let last = (self.physical_bit + self.bits).min(end * 8);
        Self {
            data_bit: self.data_bit + (first - self.physical_bit),
            physical_bit: first,
            bits: last.saturating_sub(first),
        }
    }
}

impl Fmmu {
    /// Parses the 16 register bytes. `None` if the FMMU is inactive or maps no bits.
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

    /// Returns the common bits of this FMMU and a datagram of `len` bytes at logical address
    /// `start`.
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

/// The data direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Use {
    Read,
    Write,
}

impl Fmmu {
    fn logical_bytes(&self) -> std::ops::Range<u64> {
        let start = u64::from(self.logical);
        start..start + (u64::from(self.start_bit) + self.bits()).div_ceil(8)
    }

    fn physical_bytes(&self) -> std::ops::Range<u64> {
        let start = u64::from(self.physical);
        start..start + (u64::from(self.physical_bit) + self.bits()).div_ceil(8)
    }
}

fn meet(a: &std::ops::Range<u64>, b: &std::ops::Range<u64>) -> bool {
    a.start < b.end && b.start < a.end
}

/// The FMMUs of a controller that map bits.
#[derive(Debug, Clone, Default)]
pub struct Fmmus {
    reads: Vec<Fmmu>,
    writes: Vec<Fmmu>,
    /// True if two FMMUs of the same direction map one logical byte; the lower number wins.
    contested: bool,
    /// True if some memory is both read and written.
    looped: bool,
}

impl Fmmus {
    #[must_use]
    pub fn with_capacity() -> Self {
        Self {
            reads: Vec::with_capacity(COUNT),
            writes: Vec::with_capacity(COUNT),
            ..Self::default()
        }
    }

    pub fn clear(&mut self) {
        self.configure(&[]);
    }

    /// Configures all FMMUs from their registers.
    pub fn configure(&mut self, registers: &[u8]) {
        self.reads.clear();
        self.writes.clear();
        let all = registers.chunks_exact(16).take(COUNT);
        for fmmu in all.filter_map(|r| Fmmu::from_registers(r.try_into().ok()?)) {
            if fmmu.read {
                self.reads.push(fmmu);
            }
            if fmmu.write {
                self.writes.push(fmmu);
            }
        }
        let contested = |list: &[Fmmu]| {
            list.iter().enumerate().any(|(n, a)| {
                let others = list.iter().skip(n + 1);
                others
                    .into_iter()
                    .any(|b| meet(&a.logical_bytes(), &b.logical_bytes()))
            })
        };
        self.contested = contested(&self.reads) || contested(&self.writes);
        self.looped = self.reads.iter().any(|a| {
            let mut writes = self.writes.iter();
            writes.any(|b| meet(&a.physical_bytes(), &b.physical_bytes()))
        });
    }

    /// True if the order of reading and writing matters.
    #[must_use]
    pub fn looped(&self) -> bool {
        self.looped
    }

    /// Returns the bits of a datagram that the `n`th FMMU of this direction maps, from byte `from`
    /// of the data on. Also returns the `from` of the next call. `Err`: the FMMU does not exist.
    pub fn next_overlap(
        &self,
        n: usize,
        way: Use,
        address: u32,
        len: usize,
        from: usize,
    ) -> Result<Option<(Overlap, usize)>, FmmuIndexError> {
        let list = match way {
            Use::Read => &self.reads,
            Use::Write => &self.writes,
        };
        let fmmu = list.get(n).ok_or(FmmuIndexError)?;
        if from >= len {
            return Ok(None);
        }
        if !self.contested {
            return Ok(fmmu.overlap(address, len).map(|overlap| (overlap, len)));
        }
        let lower = list.get(..n).unwrap_or_default();
        Ok((from..len).find_map(|at| {
            let byte = address.checked_add(u32::try_from(at).ok()?)?;
            let mut overlap = fmmu.overlap(byte, 1)?;
            overlap.data_bit += at * 8;
            let taken = |f: &Fmmu| f.logical_bytes().contains(&u64::from(byte));
            (!lower.iter().any(taken)).then_some((overlap, at + 1))
        }))
    }
}

/// The FMMU index is out of range.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FmmuIndexError;

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
    fn fmmu_maps_three_bits_in_the_middle_of_a_byte() {
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
    fn fmmu_maps_a_datagram_that_covers_only_its_end() {
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
    fn fmmu_that_is_inactive_or_empty_maps_nothing() {
        let mut r = registers(0, 1, (0, 7), 0x1100, 0);
        r[12] = 0;
        assert_eq!(Fmmu::from_registers(&r), None);
        assert_eq!(Fmmu::from_registers(&registers(0, 0, (0, 7), 0, 0)), None);
        assert_eq!(Fmmu::from_registers(&registers(0, 1, (5, 2), 0, 0)), None);
    }

    #[test]
    fn lower_fmmu_number_gets_a_contested_byte() {
        let mut all = [0; 128];
        // 0x1000–0x1001 and 0x1001–0x1002; the third FMMU has the other direction.
        all[..16].copy_from_slice(&registers(0x1000, 2, (0, 7), 0x1100, 0));
        all[16..32].copy_from_slice(&registers(0x1001, 2, (0, 7), 0x1200, 0));
        all[32..48].copy_from_slice(&registers(0x1001, 1, (0, 7), 0x1300, 0));
        all[32 + 11] = 2;
        let mut fmmus = Fmmus::default();
        fmmus.configure(&all);
        let mapped = |n, way| {
            let mut from = 0;
            let mut seen = Vec::new();
            while let Ok(Some((o, next))) = fmmus.next_overlap(n, way, 0x1000, 4, from) {
                seen.push((o.data_bit / 8, o.physical_bit / 8, o.bits));
                from = next;
            }
            seen
        };
        assert_eq!(mapped(0, Use::Read), [(0, 0x1100, 8), (1, 0x1101, 8)]);
        assert_eq!(mapped(1, Use::Read), [(2, 0x1201, 8)]);
        assert_eq!(mapped(0, Use::Write), [(1, 0x1300, 8)]);
        assert_eq!(
            fmmus.next_overlap(2, Use::Read, 0x1000, 4, 0),
            Err(FmmuIndexError),
            "two that read"
        );
    }

    #[test]
    fn uncontested_fmmus_map_in_one_step() {
        let mut all = [0; 48];
        all[..16].copy_from_slice(&registers(0x1000, 2, (0, 7), 0x1100, 0));
        all[16..32].copy_from_slice(&registers(0x1000, 2, (0, 7), 0x1100, 0));
        all[16 + 11] = 2;
        let mut fmmus = Fmmus::default();
        fmmus.configure(&all);
        assert!(fmmus.looped());
        let next = |from| fmmus.next_overlap(0, Use::Read, 0x0fff, 8, from).unwrap();
        let (overlap, then) = next(0).unwrap();
        assert_eq!((overlap.data_bit, overlap.bits), (8, 16));
        assert_eq!(next(then), None);
        fmmus.clear();
        assert!(!fmmus.looped());
    }
}
