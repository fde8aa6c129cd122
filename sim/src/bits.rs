//! Bit-packed copies, least significant bit first, as FMMUs and PDOs use them.

/// Copies `len` bits and keeps all other bits. Bits outside either slice are skipped.
pub(crate) fn copy(to: &mut [u8], to_bit: usize, from: &[u8], from_bit: usize, len: usize) {
    if (to_bit | from_bit | len).is_multiple_of(8) {
        let n = len / 8;
        if let (Some(to), Some(from)) = (
            to.get_mut(to_bit / 8..to_bit / 8 + n),
            from.get(from_bit / 8..from_bit / 8 + n),
        ) {
            to.copy_from_slice(from);
            return;
        }
    }
    let mut done = 0;
    while done < len {
        let (t, f) = (to_bit + done, from_bit + done);
        let n = (8 - t % 8).min(8 - f % 8).min(len - done);
        let (Some(to), Some(from)) = (to.get_mut(t / 8), from.get(f / 8)) else {
            return;
        };
        let mask = (0xff_u8 >> (8 - n)) << (t % 8);
        let value = (*from >> (f % 8)) << (t % 8);
        *to = *to & !mask | value & mask;
        done += n;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn bit(bytes: &[u8], at: usize) -> bool {
        bytes[at / 8] >> (at % 8) & 1 != 0
    }

    proptest! {
        #[test]
        fn copy_moves_exactly_the_requested_bits(
            to in prop::array::uniform8(any::<u8>()), from in prop::array::uniform8(any::<u8>()),
            to_bit in 0usize..32, from_bit in 0usize..32, len in 0usize..32,
        ) {
            let mut out = to;
            copy(&mut out, to_bit, &from, from_bit, len);
            for at in 0..64 {
                let expected = if (to_bit..to_bit + len).contains(&at) {
                    bit(&from, at - to_bit + from_bit)
                } else {
                    bit(&to, at)
                };
                prop_assert_eq!(bit(&out, at), expected);
            }
        }
    }

    #[test]
    fn copy_stops_at_the_end_of_either_slice() {
        let mut out = [0; 2];
        copy(&mut out, 8, &[0xff, 0xff], 0, 16);
        assert_eq!(out, [0, 0xff]);
    }
}
