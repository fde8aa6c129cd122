//! Where an item's value is in the object dictionary's arena: what cycling needs to know of it, close
//! together and read as one word.

/// Bytes behind the last item, so that every item can be read as a whole word.
pub(super) const TAIL: usize = size_of::<u64>();

/// Where an item's low 64 bits are: all that cycling needs to know of it, close together.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    start: usize,
    /// The item's bits.
    mask: u64,
    /// The sign bit, if the dictionary's type has one.
    sign: u64,
}

impl Place {
    pub(super) fn new(start: usize, bit_len: u32, signed: bool) -> Self {
        let mask = match bit_len {
            0 => 0,
            bits => u64::MAX >> 64_u32.saturating_sub(bits),
        };
        Self {
            start,
            mask,
            sign: if signed { sign(mask) } else { 0 },
        }
    }

    fn read(&self, arena: &[u8], sign: u64) -> i64 {
        let word = arena.get(self.start..).and_then(<[u8]>::first_chunk);
        let value = u64::from_le_bytes(*word.unwrap_or(&[0; TAIL])) & self.mask;
        (value ^ sign).wrapping_sub(sign).cast_signed()
    }

    /// Sign-extended if the type is signed.
    pub(super) fn get(&self, arena: &[u8]) -> i64 {
        self.read(arena, self.sign)
    }

    pub(super) fn get_signed(&self, arena: &[u8]) -> i64 {
        self.read(arena, sign(self.mask))
    }

    /// Whole bytes; what the value does not fill is zero.
    pub(super) fn set(&self, arena: &mut [u8], value: i64) {
        let whole = |n: u32| {
            u64::MAX
                .checked_shr(64 - n.next_multiple_of(8))
                .unwrap_or(0)
        };
        let taken = whole(64 - self.mask.leading_zeros());
        let word = arena
            .get_mut(self.start..)
            .and_then(<[u8]>::first_chunk_mut);
        if let Some(word) = word {
            let others = u64::from_le_bytes(*word) & !taken;
            *word = (others | value.cast_unsigned() & self.mask).to_le_bytes();
        }
    }
}

/// The highest bit.
fn sign(mask: u64) -> u64 {
    mask ^ mask >> 1
}
