//! The value of a start-up SDO as bytes. Width and sign come from the ESI's dictionary or from
//! `type`.

use ecaxis_esi::{ObjectItem, Writable};

use super::raw::SdoValue;
use ecaxis_ecat::data_type::{DataType, Kind};

/// The problem with a value, and a hint.
pub(crate) type ValueProblem = (String, Option<String>);

/// Type names shown in messages; those of ETG.2000 are accepted as well.
const TYPES: [&str; 12] = [
    "bool", "i8", "u8", "i16", "u16", "i32", "u32", "i64", "u64", "f32", "f64", "text",
];

pub(crate) fn encode(
    value: &SdoValue,
    type_name: Option<&str>,
    item: Option<&ObjectItem>,
) -> Result<Vec<u8>, ValueProblem> {
    let names = || TYPES.map(|name| format!("`{name}`")).join(", ");
    if let Some(item) = item {
        let closed = match item.access.write {
            Writable::Never => true,
            Writable::Always => false,
            Writable::Only { pre_op, .. } => !pre_op,
        };
        if closed {
            return Err((
                format!("\"{}\" cannot be written in PreOp", item.name),
                None,
            ));
        }
    }
    let data_type = match (type_name, item) {
        (Some(name), _) => DataType::named(name, 0).ok_or_else(|| {
            (
                format!("unknown type `{name}`"),
                Some(format!("types: {}", names())),
            )
        })?,
        (None, Some(item)) => DataType::named(&item.type_name, item.bit_len).ok_or_else(|| {
            (
                format!("the ESI's type `{}` is not known", item.type_name),
                None,
            )
        })?,
        (None, None) => {
            let hint = "check index and sub, or give its type: `type = \"u32\"`".to_owned();
            return Err(("the ESI has no such object".to_owned(), Some(hint)));
        }
    };
    let bytes = bytes(value, data_type)?;
    if let (Some(item), SdoValue::Integer(_)) = (item, value)
        && let Some(problem) = outside_range(item, data_type.kind, &bytes)
    {
        return Err((problem, None));
    }
    Ok(bytes)
}

/// Returns the problem with a value that ecaxis derives, if the ESI's range excludes it.
pub(crate) fn outside_esi_range(item: &ObjectItem, data: &[u8]) -> Option<String> {
    let data_type = DataType::named(&item.type_name, item.bit_len)?;
    outside_range(item, data_type.kind, data)
}

fn outside_range(item: &ObjectItem, kind: Kind, data: &[u8]) -> Option<String> {
    if !matches!(kind, Kind::Signed | Kind::Unsigned) {
        return None;
    }
    let signed = kind == Kind::Signed;
    let number = |bytes: &[u8]| little_endian(bytes, signed);
    let low = item.min.as_deref().map(number);
    let high = item.max.as_deref().map(number);
    // Files write 0 to 0 where they define no range.
    if low.zip(high).is_some_and(|(low, high)| low >= high) {
        return None;
    }
    let n = number(data);
    let is_outside = low.is_some_and(|low| n < low) || high.is_some_and(|high| n > high);
    is_outside.then(|| {
        let end = |e: Option<i128>| e.map_or("…".to_owned(), |e| e.to_string());
        let range = format!("{} to {}", end(low), end(high));
        format!("{n} is outside what the ESI allows, {range}")
    })
}

pub(crate) fn little_endian(bytes: &[u8], signed: bool) -> i128 {
    let negative = signed && bytes.last().is_some_and(|b| b & 0x80 != 0);
    let mut all = [if negative { 0xff } else { 0 }; 16];
    for (to, from) in all.iter_mut().zip(bytes) {
        *to = *from;
    }
    i128::from_le_bytes(all)
}

fn bytes(value: &SdoValue, data_type: DataType) -> Result<Vec<u8>, ValueProblem> {
    let number = matches!(data_type.kind, Kind::Unsigned | Kind::Signed);
    let written = match value {
        SdoValue::Bytes(bytes) => return Ok(bytes.clone()),
        // TOML has already removed quotes and escapes.
        SdoValue::Text(text) if data_type.kind == Kind::Text => {
            return Ok(text.clone().into_bytes());
        }
        SdoValue::Text(text) => text.clone(),
        SdoValue::Integer(n) => n.to_string(),
        // TOML writes `nan` in lower case.
        SdoValue::Float(x) => x.to_string().to_lowercase(),
        SdoValue::Boolean(b) if number => u8::from(*b).to_string(),
        SdoValue::Boolean(b) => b.to_string(),
    };
    let texts = matches!(data_type.kind, Kind::Text | Kind::Unicode);
    if texts && !matches!(value, SdoValue::Text(_)) {
        return Err((format!("the object takes a text, not {written}"), None));
    }
    data_type
        .read(&written)
        .map_err(|error| (error.to_string(), None))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn typed(value: SdoValue, name: &str) -> Result<Vec<u8>, ValueProblem> {
        encode(&value, Some(name), None)
    }

    #[test]
    fn encode_uses_width_and_sign_of_the_type() {
        use SdoValue::{Boolean, Bytes, Float, Integer, Text};
        for (value, name, bytes) in [
            (Integer(2000), "u32", vec![0xd0, 7, 0, 0]),
            (Integer(-1), "i16", vec![0xff, 0xff]),
            (Integer(-1), "DINT", vec![0xff; 4]),
            (Boolean(true), "bool", vec![1]),
            (Float(1.0), "f32", vec![0, 0, 0x80, 0x3f]),
            (Integer(1), "REAL", vec![0, 0, 0x80, 0x3f]),
            (Text("ab".into()), "text", vec![b'a', b'b']),
            (Text("0x10".into()), "u16", vec![0x10, 0]),
            (Bytes(vec![1, 2, 3]), "u8", vec![1, 2, 3]),
        ] {
            assert_eq!(typed(value, name), Ok(bytes), "{name}");
        }
        for (value, name, message) in [
            (
                Integer(256),
                "u8",
                "256 does not fit; the object takes 0 to 255",
            ),
            (
                Integer(-1),
                "u64",
                "-1 does not fit; the object takes 0 to 18446744073709551615",
            ),
            (
                Float(0.5),
                "u8",
                "the object takes an integer of 8 bits, not 0.5",
            ),
            (Integer(1), "u33", "unknown type `u33`"),
        ] {
            assert_eq!(typed(value, name).unwrap_err().0, message);
        }
    }

    #[test]
    fn encode_follows_the_dictionary() {
        let mut item = ObjectItem {
            name: "Following error window".into(),
            type_name: "UDINT".into(),
            bit_len: 32,
            max: Some([0xff, 0, 0, 0].into()),
            ..ObjectItem::default()
        };
        let value = SdoValue::Integer(2000);
        assert!(
            encode(&value, None, Some(&item))
                .unwrap_err()
                .0
                .contains("cannot be written")
        );
        item.access.write = Writable::Always;
        let refused = encode(&value, None, Some(&item)).unwrap_err().0;
        assert_eq!(refused, "2000 is outside what the ESI allows, … to 255");
        assert_eq!(
            encode(&SdoValue::Integer(255), None, Some(&item)),
            Ok(vec![255, 0, 0, 0])
        );
        assert!(
            encode(&value, None, None)
                .unwrap_err()
                .1
                .unwrap()
                .contains("type")
        );
    }
}
