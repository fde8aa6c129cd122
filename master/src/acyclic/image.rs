//! EEPROM images: their parts, and how to write them to a device. The layout is in ETG.1000.6 and
//! ETG.2010.

use std::ops::Range;

use ecaxis_esi::sii::checksum;

use super::eeprom::{Eeprom, EepromError};
use crate::mailbox::MailboxTransport;
use crate::report::Error;

/// The length in bytes of the area that the controller loads by itself, including its checksum.
const CONFIGURATION: usize = 16;
const ALIAS: usize = 8;
const CHECKSUM: usize = 14;
const CATEGORIES: usize = 0x80;
const END: u16 = 0xffff;

/// Returns the configuration area with another station alias and a matching checksum.
#[must_use]
pub fn with_alias(area: [u8; CONFIGURATION], alias: u16) -> [u8; CONFIGURATION] {
    let mut area = area;
    let [low, high] = alias.to_le_bytes();
    (area[ALIAS], area[ALIAS + 1]) = (low, high);
    let mut summed = [0; CHECKSUM];
    for (to, from) in summed.iter_mut().zip(area) {
        *to = from;
    }
    area[CHECKSUM] = checksum(&summed);
    area[CHECKSUM + 1] = 0;
    area
}

/// Returns the data range of the first category of this type; `None` if the image has none.
#[must_use]
pub fn category(image: &[u8], kind: u16) -> Option<Range<usize>> {
    let word = |at: usize| {
        let bytes = image.get(at..)?.first_chunk()?;
        Some(u16::from_le_bytes(*bytes))
    };
    let mut at = CATEGORIES;
    loop {
        let (found, words) = (word(at)?, word(at + 2)?);
        let data = at + 4..at + 4 + 2 * usize::from(words);
        if found == END || data.end > image.len() {
            return None;
        }
        if found == kind {
            return Some(data);
        }
        at = data.end;
    }
}

/// Returns the image with other data in a category, padded to whole words; later categories move.
/// `None` if the category is missing or the data is too long.
#[must_use]
pub fn with_category(image: &[u8], kind: u16, data: &[u8]) -> Option<Vec<u8>> {
    let place = category(image, kind)?;
    let words = u16::try_from(data.len().div_ceil(2)).ok()?;
    let mut out = image.get(..place.start.checked_sub(2)?)?.to_vec();
    out.extend_from_slice(&words.to_le_bytes());
    out.extend_from_slice(data);
    out.resize(out.len() + data.len() % 2, 0xff);
    out.extend_from_slice(image.get(place.end..)?);
    Some(out)
}

/// A failed write of an image.
#[derive(Debug, thiserror::Error)]
#[error("{source}{}", self.remaining_state())]
pub struct WriteError {
    pub source: Error,
    /// The number of words written.
    pub written: usize,
    /// The number of words to write.
    pub of: usize,
}

impl WriteError {
    /// Returns a text with the number of words written, to follow the error's text.
    #[must_use]
    pub fn remaining_state(&self) -> String {
        match (self.written, self.of) {
            (0, _) => "; nothing was written".to_owned(),
            (written, of) => format!("; {written} of {of} words were written"),
        }
    }
}

/// Writes the words that differ and reads all of them back. The configuration area comes last, so
/// that a device that loses power before keeps its identity. Returns the number of words written.
/// `progress` receives the words done and the total. After the first word, the write can no longer
/// be cancelled.
///
/// # Errors
/// [`EepromError::Smaller`] before anything is written; [`EepromError::NotKept`] if a word reads
/// back differently; [`Cause::Interrupted`](crate::report::Cause::Interrupted) before the first
/// word; otherwise as [`Eeprom::write`].
pub async fn write<W: MailboxTransport>(
    eeprom: &Eeprom<'_, W>,
    image: &[u8],
    progress: &mut dyn FnMut(usize, usize),
) -> Result<usize, WriteError> {
    let mut wanted = image.to_vec();
    wanted.resize(image.len().next_multiple_of(2), 0xff);
    let mut there = vec![0; wanted.len()];
    let failed = |written, of| {
        move |source| WriteError {
            source,
            written,
            of,
        }
    };
    eeprom.read(0, &mut there).await.map_err(failed(0, 0))?;
    let differing = |there: &[u8]| -> Vec<(u32, [u8; 2], [u8; 2])> {
        let (wanted, _) = wanted.as_chunks::<2>();
        let (there, _) = there.as_chunks::<2>();
        let both = (0..).zip(wanted.iter().zip(there));
        let differ = both.filter(|(_, (wanted, there))| wanted != there);
        differ
            .map(|(word, (wanted, there))| (word, *wanted, *there))
            .collect()
    };
    let mut writes = differing(&there);
    let first = u32::try_from(CONFIGURATION / 2).unwrap_or(0);
    let own = writes.partition_point(|(word, ..)| *word < first);
    writes.rotate_left(own);
    let of = writes.len();
    if let Some(bytes) = wraps_around_at(&there) {
        return Err(failed(0, of)(eeprom.failed(EepromError::Smaller { bytes })));
    }
    if eeprom.stop().is_cancelled() {
        return Err(failed(0, of)(eeprom.stopped()));
    }
    let whole = async {
        for (n, (word, value, _)) in writes.iter().enumerate() {
            progress(n, of);
            eeprom.write(*word, *value).await.map_err(failed(n, of))?;
        }
        eeprom.read(0, &mut there).await.map_err(failed(of, of))?;
        match differing(&there).first() {
            None => Ok(of),
            Some((word, wanted, found)) => {
                let source = eeprom.failed(EepromError::NotKept {
                    word: *word,
                    wanted: u16::from_le_bytes(*wanted),
                    found: u16::from_le_bytes(*found),
                });
                Err(failed(of, of)(source))
            }
        }
    };
    eeprom.stop().shield(whole).await
}

/// Returns the length of a chip that was read beyond its end, a power of two: from there its
/// content repeats.
fn wraps_around_at(there: &[u8]) -> Option<usize> {
    let lengths = (0..usize::BITS).map(|n| 1 << n);
    let lengths = lengths.skip_while(|length| *length < CATEGORIES);
    let mut shorter = lengths.take_while(|length| *length < there.len());
    shorter.find(|length| {
        let (chip, behind) = there.split_at(*length);
        let all_one = behind.windows(2).all(|two| two.first() == two.last());
        chip.starts_with(behind.get(..chip.len()).unwrap_or(behind)) && !all_one
    })
}

#[cfg(test)]
mod tests {
    use ecaxis_esi::sii::{self, Sii};

    use super::*;

    fn image() -> Vec<u8> {
        let mut sii = Sii {
            alias: 5,
            byte_size: 2048,
            ended: true,
            ..Sii::default()
        };
        sii.others = vec![(0x0801, vec![1, 2, 3, 4]), (0x0802, vec![9, 9])];
        sii.to_bytes()
    }

    #[test]
    fn with_alias_updates_the_checksum() {
        let mut image = image();
        let area = with_alias(*image.first_chunk().expect("an area"), 1001);
        image[..16].copy_from_slice(&area);
        let sii = sii::parse(&image).expect("an image");
        assert_eq!((sii.alias, sii.checksum_ok), (1001, true));
    }

    #[test]
    fn with_category_replaces_the_data_of_a_category() {
        let image = image();
        assert_eq!(
            category(&image, 0x0801).map(|r| image[r].to_vec()),
            Some(vec![1, 2, 3, 4])
        );
        assert_eq!(category(&image, 0x0803), None);
        for data in [&[][..], &[7], &[7; 8]] {
            let other = with_category(&image, 0x0801, data).expect("replaced");
            let sii = sii::parse(&other).expect("an image");
            let mut padded = data.to_vec();
            padded.resize(data.len().next_multiple_of(2), 0xff);
            assert_eq!(sii.others, [(0x0801, padded), (0x0802, vec![9, 9])]);
            assert!(sii.ended);
        }
        assert_eq!(with_category(&image, 0x0803, &[1]), None);
        assert_eq!(with_category(&image, 0x0801, &vec![0; 0x2_0000]), None);
        // An image cut off at any length.
        for end in 0..image.len() {
            let _ = with_category(&image[..end], 0x0802, &[1]);
        }
    }
}
