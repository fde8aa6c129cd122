//! Bits that are copied from one place of the image to another.

use super::BitField;

/// The longest part that is copied at once if the bits are not whole bytes.
const PART: usize = 64;

/// Bits of the process image, and the place to which they are copied.
#[doc(alias = "CopyInfo")]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BitCopy {
    /// The first bit of the source in the image.
    pub from: usize,
    /// The first bit of the target in the image.
    pub to: usize,
    pub bits: usize,
}

impl BitCopy {
    /// Copies the bits from one image to the other. The neighbours of the target stay unchanged.
    /// RT: O(bits).
    pub fn apply(self, from: &[u8], to: &mut [u8]) {
        if [self.from, self.to, self.bits].iter().all(|n| n % 8 == 0) {
            let [first, target, len] = [self.from / 8, self.to / 8, self.bits / 8];
            let from = from.get(first..first + len);
            if let (Some(from), Some(to)) = (from, to.get_mut(target..target + len)) {
                to.copy_from_slice(from);
            }
            return;
        }
        for (from_part, to_part) in self.parts() {
            to_part.set(to, from_part.get(from));
        }
    }

    /// Copies the bits within one image. Source and target must not overlap. RT: O(bits).
    pub fn apply_within(self, image: &mut [u8]) {
        for (from, to) in self.parts() {
            let value = from.get(image);
            to.set(image, value);
        }
    }

    fn parts(self) -> impl Iterator<Item = (BitField, BitField)> {
        (0..self.bits).step_by(PART).map(move |done| {
            let len = (self.bits - done).min(PART);
            let part = |first: usize| BitField::at(first + done, len);
            (part(self.from), part(self.to))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn bit(image: &[u8], at: usize) -> bool {
        image[at / 8] >> (at % 8) & 1 == 1
    }

    proptest! {
        /// Every bit of the target has the value of its source, and all other bits are unchanged.
        #[test]
        fn copy_moves_its_bits_and_no_others(
            from in 0_usize..96, to in 0_usize..96, bits in 1_usize..200, fill: u8,
            source in proptest::collection::vec(any::<u8>(), 40),
            aligned: bool,
        ) {
            let round = |n: usize| if aligned { n.next_multiple_of(8) } else { n };
            let copy = BitCopy { from: round(from), to: round(to), bits: round(bits) };
            let mut image = vec![fill; 40];
            copy.apply(&source, &mut image);
            for at in 0..image.len() * 8 {
                let copied = at.checked_sub(copy.to).filter(|n| *n < copy.bits);
                let expected = match copied {
                    Some(n) => bit(&source, copy.from + n),
                    None => bit(&[fill], at % 8),
                };
                prop_assert_eq!(bit(&image, at), expected, "bit {}", at);
            }
            let mut both = [source.clone(), vec![fill; 40]].concat();
            let within = BitCopy { to: copy.to + source.len() * 8, ..copy };
            within.apply_within(&mut both);
            prop_assert_eq!(&both[..source.len()], &source[..]);
            prop_assert_eq!(&both[source.len()..], &image[..]);
        }
    }

    #[test]
    fn copy_outside_the_image_changes_nothing() {
        let mut image = [0_u8; 4];
        BitCopy {
            from: 24,
            to: 0,
            bits: 16,
        }
        .apply(&[0xff; 4], &mut image);
        BitCopy {
            from: 0,
            to: 24,
            bits: 16,
        }
        .apply(&[0xff; 4], &mut image);
        assert_eq!(image, [0; 4]);
    }
}
