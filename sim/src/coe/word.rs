//! The location of an item's value in the arena of the object dictionary. Cyclic operation needs
//! nothing else, so it performs no table lookup.

use std::ops::Range;

/// Bytes behind the last item, so that every item can be read as a whole word.
pub(super) const TAIL: usize = size_of::<u64>();

/// The location of an item in the arena.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct WordRef {
    start: u32,
    bits: u32,
    /// True if the type of the item is signed.
    signed: bool,
}

impl WordRef {
    pub(super) fn new(start: usize, bits: u32, signed: bool) -> Self {
        Self {
            // The arena is smaller than 4 GiB.
            start: u32::try_from(start).unwrap_or(u32::MAX),
            bits,
            signed,
        }
    }

    /// Returns the byte range of the item.
    pub(super) fn range(self) -> Range<usize> {
        let start = self.start as usize;
        start..start + self.bits.div_ceil(8) as usize
    }

    fn read(self, arena: &[u8], signed: bool) -> i64 {
        let word = arena
            .get(self.start as usize..)
            .and_then(<[u8]>::first_chunk);
        let mask = low(self.bits);
        let value = u64::from_le_bytes(*word.unwrap_or(&[0; TAIL])) & mask;
        let sign = if signed { mask ^ mask >> 1 } else { 0 };
        (value ^ sign).wrapping_sub(sign).cast_signed()
    }

    /// Returns the value, sign-extended for signed types. Long items yield their low 64 bits.
    pub(super) fn get(self, arena: &[u8]) -> i64 {
        self.read(arena, self.signed)
    }

    pub(super) fn get_signed(self, arena: &[u8]) -> i64 {
        self.read(arena, true)
    }

    /// Sets whole bytes; unused bits become zero.
    pub(super) fn set(self, arena: &mut [u8], value: i64) {
        let word = arena
            .get_mut(self.start as usize..)
            .and_then(<[u8]>::first_chunk_mut);
        if let Some(word) = word {
            let taken = low(self.bits.min(64).next_multiple_of(8));
            let others = u64::from_le_bytes(*word) & !taken;
            *word = (others | value.cast_unsigned() & low(self.bits)).to_le_bytes();
        }
    }
}

/// Returns a mask of the lowest `bits` bits, at most 64.
fn low(bits: u32) -> u64 {
    match bits {
        0 => 0,
        bits => u64::MAX >> 64_u32.saturating_sub(bits),
    }
}
