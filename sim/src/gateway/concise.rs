//! Concise device configurations (CiA 302-3), as object 0x1F22 holds them.

use super::options::Setting;

/// Emits the count, then index, subindex, size and data of each setting.
pub(super) fn emit(settings: &[Setting]) -> Vec<u8> {
    let count = u32::try_from(settings.len()).unwrap_or(0);
    let mut out = count.to_le_bytes().to_vec();
    for (index, sub, data) in settings {
        out.extend_from_slice(&index.to_le_bytes());
        out.push(*sub);
        out.extend_from_slice(&u32::try_from(data.len()).unwrap_or(0).to_le_bytes());
        out.extend_from_slice(data);
    }
    out
}

/// Returns `None` if the count or a size exceeds the data.
pub(super) fn parse(bytes: &[u8]) -> Option<Vec<Setting>> {
    if bytes.is_empty() {
        return Some(Vec::new());
    }
    let (count, mut rest) = bytes.split_first_chunk::<4>()?;
    let mut out = Vec::new();
    for _ in 0..u32::from_le_bytes(*count) {
        let ([low, high, sub], after) = rest.split_first_chunk::<3>()?;
        let (size, after) = after.split_first_chunk::<4>()?;
        let size = usize::try_from(u32::from_le_bytes(*size)).ok()?;
        let data = after.get(..size)?;
        out.push((u16::from_le_bytes([*low, *high]), *sub, data.to_vec()));
        rest = after.get(size..)?;
    }
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn concise_configurations_survive_a_round_trip(
            settings in prop::collection::vec((any::<u16>(), any::<u8>(), prop::collection::vec(any::<u8>(), 0..9)), 0..9),
            cut in 0usize..40,
        ) {
            let bytes = emit(&settings);
            prop_assert_eq!(parse(&bytes), Some(settings));
            let end = bytes.len().saturating_sub(cut);
            parse(&bytes[..end]);
        }
    }
}
