//! `quirks` of `[device.sim]`: how a simulated device differs from the standard. Keys, types and
//! descriptions are those of [`Quirks::TABLE`].

use ecaxis_axis::Scale;
use ecaxis_sim::{Quirk, QuirkValue, Quirks};
use serde_json::{Map, json};

use super::AxisSetup;
use super::fields::{Domain, LARGEST, Ns, Read, Table, TableKey, Value, array};
use super::problem::{Problems, Span};
use super::schema::{self, Schema};

/// The quirks of a device, each with its value and the value's place.
#[derive(Debug)]
pub(crate) struct RawQuirks {
    span: Span,
    values: Vec<(&'static Quirk, f64, Span)>,
}

impl Read for RawQuirks {
    fn read(value: Value<'_>, _: &str, p: &mut Problems<'_>) -> Option<Self> {
        let keys: Vec<TableKey> = Quirks::TABLE.iter().map(|q| (q.key, None)).collect();
        let table = Table::of(value, "`quirks`", &keys, p)?;
        let mut values = Vec::new();
        for quirk in Quirks::TABLE {
            let Some(value) = table.get(quirk.key) else {
                continue;
            };
            if let Some(number) = number(quirk, value, p) {
                values.push((quirk, number, value.span()));
            }
        }
        table.done(p);
        let span = value.span();
        Some(Self { span, values })
    }
}

fn times() -> std::ops::RangeInclusive<Ns> {
    0..=QuirkValue::MAX_NS
}

/// Reads a value as a number in the unit of its type; distances in the unit of the axis.
fn number(quirk: &Quirk, value: Value<'_>, p: &mut Problems<'_>) -> Option<f64> {
    let key = quirk.key;
    match quirk.value {
        QuirkValue::Flag => bool::read(value, key, p).map(|on| f64::from(u8::from(on))),
        QuirkValue::Time => times().read(value, key, p).map(|ns| ns as f64),
        QuirkValue::Distance => f64::read(value, key, p),
        QuirkValue::Torque => {
            let torque = f64::read(value, key, p)?;
            if torque.abs() <= QuirkValue::MAX_TORQUE {
                return Some(torque);
            }
            let message = format!("`{key}` of {torque} N·m is not possible");
            p.add_hint(value.span(), message, "write a torque from -1000 to 1000");
            None
        }
        QuirkValue::Whole(low, high) => (low..=high).read(value, key, p).map(f64::from),
        QuirkValue::Factor => {
            let factor = f64::read(value, key, p)?;
            let most = QuirkValue::MAX_FACTOR;
            if (most.recip()..=most).contains(&factor) {
                return Some(factor);
            }
            let message = format!("`{key}` of {factor} is not possible");
            p.add_hint(value.span(), message, "write a factor from 1e-9 to 1e9");
            None
        }
        QuirkValue::Modes => {
            let modes = array(p, value, "a list of modes")?.into_iter();
            let modes: Vec<Option<u8>> = modes
                .map(|mode| QuirkValue::MODES.read(mode, key, p))
                .collect();
            let mask = modes
                .into_iter()
                .try_fold(0_u32, |mask, mode| Some(mask | 1 << (mode? - 1)));
            mask.map(f64::from)
        }
    }
}

impl Schema for RawQuirks {
    fn schema() -> serde_json::Value {
        let property = |quirk: &Quirk| {
            let value = match quirk.value {
                QuirkValue::Flag => bool::schema(),
                QuirkValue::Time => Domain::<Ns>::schema(&times()),
                QuirkValue::Distance => f64::schema(),
                QuirkValue::Torque => {
                    let most = QuirkValue::MAX_TORQUE;
                    json!({ "type": "number", "minimum": -most, "maximum": most })
                }
                QuirkValue::Whole(low, high) => schema::integer(low, high),
                QuirkValue::Factor => {
                    let most = QuirkValue::MAX_FACTOR;
                    json!({ "type": "number", "minimum": most.recip(), "maximum": most.min(LARGEST) })
                }
                QuirkValue::Modes => {
                    let modes = schema::words(QuirkValue::MODES.map(|(mode, _)| mode));
                    json!({ "type": "array", "items": modes })
                }
            };
            let (kind, off) = quirk.value.describe();
            let text = format!("{} ({kind}; default {off})", quirk.text);
            (quirk.key.to_owned(), schema::described(value, &text))
        };
        json!({
            "type": "object",
            "properties": Map::from_iter(Quirks::TABLE.iter().map(property)),
            "additionalProperties": false,
        })
    }
}

/// Converts distances to counts. For `axis` see [`super::travel::check`].
pub(crate) fn check(
    raw: &RawQuirks,
    axis: Result<Option<&AxisSetup>, ()>,
    p: &mut Problems<'_>,
) -> Quirks {
    let of_drive = raw
        .values
        .iter()
        .find(|(quirk, ..)| !quirk.point.is_of_any_device());
    if let (Err(()), Some((quirk, ..))) = (axis, of_drive) {
        let message = format!("`{}` without an axis", quirk.key);
        let hint = "only drives with a [device.axis] have it";
        p.add_hint(raw.span.clone(), message, hint);
    }
    let scale = axis.ok().flatten().map(|axis| &axis.config.scale);
    let mut quirks = Quirks::default();
    for (quirk, number, at) in &raw.values {
        match (quirk.value, scale) {
            (QuirkValue::Distance, Some(scale)) => match counts(*number, scale) {
                Some(counts) => quirk.set(&mut quirks, counts),
                None => p.add(at.clone(), format!("{number} exceeds 32 bits of counts")),
            },
            (QuirkValue::Distance, None) => {}
            _ => quirk.set(&mut quirks, *number),
        }
    }
    quirks
}

/// Returns a distance in the direction of the axis, in counts of the drive.
fn counts(distance: f64, scale: &Scale) -> Option<f64> {
    let sign = if scale.inverted() { -1.0 } else { 1.0 };
    let counts = (sign * distance * scale.counts_per_unit()).round();
    (counts.abs() <= f64::from(i32::MAX)).then_some(counts)
}

#[cfg(test)]
#[path = "sim_quirks_tests.rs"]
mod tests;
