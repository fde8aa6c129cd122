//! Oversampling: one cycle contains several samples of a PDO.

use super::SelectError;
use crate::model::Pdo;

/// The maximum number of entries of one oversampled PDO; a frame has 11888 bits of process data.
const MAX_ENTRIES: usize = 16_384;

/// Appends `pdo` once for each sample in a cycle.
///
/// With an index increment, each sample is a separate PDO with the next index. Without it, a single
/// entry becomes longer, and several entries are repeated in the same PDO.
pub(super) fn append(to: &mut Vec<Pdo>, pdo: &Pdo, factor: u16) -> Result<(), SelectError> {
    let increment = pdo.oversampling.map_or(0, |own| own.index_increment);
    if factor <= 1 {
        to.push(pdo.clone());
        return Ok(());
    }
    let entries = pdo.entries.len().max(1).saturating_mul(usize::from(factor));
    let max = pdo.oversampling.and_then(|own| own.max);
    if entries > MAX_ENTRIES || max.is_some_and(|max| factor > max) {
        return Err(SelectError::TooManySamples {
            pdo: pdo.index,
            position: pdo.position,
            factor,
            max,
        });
    }
    if increment > 0 {
        to.extend((0..factor).map(|sample| {
            let mut copy = pdo.clone();
            copy.index = pdo.index.wrapping_add(sample);
            for entry in copy.entries.iter_mut().filter(|entry| !entry.is_gap()) {
                entry.index = entry.index.wrapping_add(sample.wrapping_mul(increment));
            }
            copy
        }));
        return Ok(());
    }
    let mut longer = pdo.clone();
    match longer.entries.as_mut_slice() {
        [only] => only.bit_len = only.bit_len.saturating_mul(factor),
        _ => {
            let one = longer.entries.clone();
            longer.entries = (0..factor).flat_map(|_| one.iter().cloned()).collect();
        }
    }
    to.push(longer);
    Ok(())
}
