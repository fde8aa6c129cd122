//! 0x60C2: the cycle time as value × 10^index seconds.

use crate::model::{Bytes, Dictionary, ObjectItem};
use crate::select::SelectError;

/// The range that the drive accepts. Without a dictionary entry, the range of the types.
struct Range {
    value: (u8, u8),
    exponent: (i8, i8),
}

/// Returns value (subindex 1) and exponent (subindex 2) for a bus cycle. Whole milliseconds use
/// exponent -3.
pub(super) fn interpolation_time(
    dictionary: &Dictionary,
    cycle_ns: u64,
) -> Result<(u8, i8), SelectError> {
    let range = range(dictionary);
    // Milliseconds come first, then the coarsest exact unit.
    let exponents = [-3, -4, -5, -6, -7, -8, -9, -2, -1, 0];
    let allowed = || {
        exponents
            .into_iter()
            .filter(|e| (range.exponent.0..=range.exponent.1).contains(e))
    };
    for exponent in allowed() {
        let unit = unit_ns(exponent);
        let exact = cycle_ns
            .checked_div(unit)
            .filter(|_| cycle_ns.checked_rem(unit) == Some(0));
        if let Some(value) = exact.and_then(|v| u8::try_from(v).ok())
            && value >= range.value.0.max(1)
            && value <= range.value.1
        {
            return Ok((value, exponent));
        }
    }
    let (mut below, mut above): (Option<u64>, Option<u64>) = (None, None);
    for exponent in allowed() {
        for value in range.value.0.max(1)..=range.value.1 {
            let time = u64::from(value).saturating_mul(unit_ns(exponent));
            if time < cycle_ns {
                below = Some(below.map_or(time, |best| best.max(time)));
            } else {
                above = Some(above.map_or(time, |best| best.min(time)));
            }
        }
    }
    let nearest: Vec<String> = [below, above]
        .into_iter()
        .flatten()
        .map(microseconds)
        .collect();
    Err(SelectError::CycleNotExpressible {
        cycle_ns,
        min: range.value.0,
        max: range.value.1,
        nearest: if nearest.is_empty() {
            "none".to_owned()
        } else {
            nearest.join(" and ")
        },
    })
}

fn range(dictionary: &Dictionary) -> Range {
    let (value, exponent) = (dictionary.item(0x60c2, 1), dictionary.item(0x60c2, 2));
    let byte = |item: Option<&ObjectItem>, bound: fn(&ObjectItem) -> Option<&Bytes>| {
        item.and_then(bound)
            .and_then(|bytes| bytes.first().copied())
    };
    let min = byte(value, |i| i.min.as_ref()).unwrap_or(0);
    let max = byte(value, |i| i.max.as_ref())
        .filter(|max| *max > 0)
        .unwrap_or(u8::MAX);
    let low = byte(exponent, |i| i.min.as_ref()).map_or(i8::MIN, |b| i8::from_le_bytes([b]));
    let high = byte(exponent, |i| i.max.as_ref()).map_or(i8::MAX, |b| i8::from_le_bytes([b]));
    // A range of 0 to 0 in the file means that no range is defined.
    let exponent = if low >= high {
        (i8::MIN, i8::MAX)
    } else {
        (low, high)
    };
    Range {
        value: (min, max),
        exponent,
    }
}

fn unit_ns(exponent: i8) -> u64 {
    u32::try_from(9 + i32::from(exponent))
        .ok()
        .and_then(|power| 10u64.checked_pow(power))
        .unwrap_or(u64::MAX)
}

fn microseconds(ns: u64) -> String {
    if ns.is_multiple_of(1000) {
        format!("{} µs", ns / 1000)
    } else {
        format!("{ns} ns")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Object;

    fn drive(max: u8) -> Dictionary {
        let item = |sub, max| ObjectItem {
            sub,
            bit_len: 8,
            default: [0].into(),
            max,
            ..ObjectItem::default()
        };
        let items = vec![item(0, None), item(1, Some([max].into())), item(2, None)];
        Dictionary {
            objects: vec![Object {
                index: 0x60c2,
                items,
                ..Object::default()
            }],
        }
    }

    #[test]
    fn interpolation_time_uses_a_unit_that_the_drive_accepts() {
        for (us, expected) in [
            (1_000, (1, -3)),
            (2_000, (2, -3)),
            (4_000, (4, -3)),
            (10_000, (10, -3)),
            (500, (5, -4)),
            (250, (25, -5)),
            (100, (1, -4)),
            (62, (62, -6)),
            (200_000, (20, -2)),
        ] {
            assert_eq!(
                interpolation_time(&drive(100), us * 1000),
                Ok(expected),
                "{us} µs"
            );
        }
        assert_eq!(
            interpolation_time(&Dictionary::default(), 125_000),
            Ok((125, -6))
        );
    }

    #[test]
    fn interpolation_time_error_names_the_neighbouring_cycles() {
        let error = interpolation_time(&drive(100), 125_000).unwrap_err();
        let SelectError::CycleNotExpressible { nearest, .. } = error else {
            panic!("{error}")
        };
        assert_eq!(nearest, "120 µs and 130 µs");
        assert!(interpolation_time(&drive(100), 0).is_err());
        assert!(interpolation_time(&drive(100), u64::MAX).is_err());
    }
}
