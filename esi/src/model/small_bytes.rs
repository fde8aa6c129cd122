//! Values of objects. Most values are as short as a number.

use std::fmt;
use std::ops::Deref;

/// Immutable bytes. Short values are stored inline, without heap memory.
#[derive(Clone)]
pub struct Bytes(Repr);

const SHORT: usize = 22;

#[derive(Clone)]
enum Repr {
    /// Bytes after `length` are zero.
    Short {
        length: u8,
        bytes: [u8; SHORT],
    },
    Long(Box<[u8]>),
}

impl Bytes {
    /// Returns the bytes.
    #[must_use]
    pub fn as_slice(&self) -> &[u8] {
        match &self.0 {
            Repr::Short { length, bytes } => bytes.get(..usize::from(*length)).unwrap_or(bytes),
            Repr::Long(bytes) => bytes,
        }
    }

    #[must_use]
    pub(crate) fn zeroes(length: usize) -> Self {
        Self::fitted(&[], length)
    }

    /// Returns `length` bytes: the start of `bytes`, padded with zeroes.
    #[must_use]
    pub(crate) fn fitted(bytes: &[u8], length: usize) -> Self {
        let bytes = bytes.get(..length).unwrap_or(bytes);
        match u8::try_from(length) {
            Ok(short) if length <= SHORT => {
                let mut held = [0; SHORT];
                for (to, from) in held.iter_mut().zip(bytes) {
                    *to = *from;
                }
                Self(Repr::Short {
                    length: short,
                    bytes: held,
                })
            }
            _ => {
                let mut long = Vec::with_capacity(length);
                long.extend_from_slice(bytes);
                long.resize(length, 0);
                Self(Repr::Long(long.into()))
            }
        }
    }
}

impl Default for Bytes {
    fn default() -> Self {
        Self::zeroes(0)
    }
}

impl Deref for Bytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        self.as_slice()
    }
}

impl From<&[u8]> for Bytes {
    fn from(bytes: &[u8]) -> Self {
        Self::fitted(bytes, bytes.len())
    }
}

impl<const N: usize> From<[u8; N]> for Bytes {
    fn from(bytes: [u8; N]) -> Self {
        bytes.as_slice().into()
    }
}

impl From<Vec<u8>> for Bytes {
    fn from(bytes: Vec<u8>) -> Self {
        bytes.as_slice().into()
    }
}

impl FromIterator<u8> for Bytes {
    fn from_iter<T: IntoIterator<Item = u8>>(bytes: T) -> Self {
        bytes.into_iter().collect::<Vec<_>>().into()
    }
}

impl PartialEq for Bytes {
    fn eq(&self, other: &Self) -> bool {
        self.as_slice() == other.as_slice()
    }
}

impl Eq for Bytes {}

impl<T: AsRef<[u8]>> PartialEq<T> for Bytes {
    fn eq(&self, other: &T) -> bool {
        self.as_slice() == other.as_ref()
    }
}

impl fmt::Debug for Bytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.as_slice().fmt(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_bytes_keep_values_of_any_length() {
        for length in [0, 1, SHORT - 1, SHORT, SHORT + 1, 300] {
            let bytes: Vec<u8> = (1..=u8::MAX).cycle().take(length).collect();
            let held = Bytes::from(bytes.clone());
            assert_eq!(held, bytes);
            assert_eq!(held.clone(), Bytes::from(&*bytes));
            assert_eq!(format!("{held:?}"), format!("{bytes:?}"));
        }
    }

    #[test]
    fn small_bytes_fitted_cuts_long_values_and_pads_short_ones_with_zeroes() {
        for length in [0, 2, SHORT, SHORT + 1] {
            let mut expected = vec![7; 10];
            expected.resize(length, 0);
            assert_eq!(Bytes::fitted(&[7; 10], length), expected);
            assert_eq!(Bytes::zeroes(length), vec![0; length]);
        }
    }

    #[test]
    fn small_bytes_are_not_larger_than_a_vector() {
        assert_eq!(size_of::<Bytes>(), size_of::<Vec<u8>>());
        assert_eq!(size_of::<Option<Bytes>>(), size_of::<Vec<u8>>());
    }
}
