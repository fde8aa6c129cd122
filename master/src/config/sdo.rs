//! A start-up SDO's value as bytes: width and sign from the ESI's dictionary, or from `type`.

use ecaxis_esi::{ObjectItem, Writable};

use super::raw::SdoValue;

/// What is wrong with the value, and a hint.
pub(crate) type Refusal = (String, Option<String>);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Signed(u32),
    Unsigned(u32),
    Float(u32),
    Text,
    Bytes,
}

const TYPES: [(&str, Kind); 12] = [
    ("bool", Kind::Unsigned(1)),
    ("i8", Kind::Signed(8)),
    ("u8", Kind::Unsigned(8)),
    ("i16", Kind::Signed(16)),
    ("u16", Kind::Unsigned(16)),
    ("i32", Kind::Signed(32)),
    ("u32", Kind::Unsigned(32)),
    ("i64", Kind::Signed(64)),
    ("u64", Kind::Unsigned(64)),
    ("f32", Kind::Float(32)),
    ("f64", Kind::Float(64)),
    ("text", Kind::Text),
];

/// ETG.2000 base types, and the short names of [`TYPES`].
fn kind(name: &str, bits: u32) -> Option<Kind> {
    let upper = name.trim().to_ascii_uppercase();
    let stem = upper.split(['(', '[', ' ']).next().unwrap_or_default();
    Some(match stem {
        "BOOL" | "BIT" | "BIT1" => Kind::Unsigned(1),
        "SINT" => Kind::Signed(8),
        "USINT" | "BYTE" | "BITARR8" => Kind::Unsigned(8),
        "INT" => Kind::Signed(16),
        "UINT" | "WORD" | "BITARR16" => Kind::Unsigned(16),
        "DINT" => Kind::Signed(32),
        "UDINT" | "DWORD" | "BITARR32" => Kind::Unsigned(32),
        "LINT" => Kind::Signed(64),
        "ULINT" | "LWORD" => Kind::Unsigned(64),
        "REAL" => Kind::Float(32),
        "LREAL" => Kind::Float(64),
        "STRING" | "VISIBLE_STRING" => Kind::Text,
        "ARRAY" | "OCTET_STRING" => Kind::Bytes,
        _ => match TYPES
            .iter()
            .find(|(short, _)| short.eq_ignore_ascii_case(stem))
        {
            Some((_, kind)) => *kind,
            // INT24 and the like: a width is all that is needed.
            None if (1..=64).contains(&bits) => {
                if stem.starts_with("INT") {
                    Kind::Signed(bits)
                } else {
                    Kind::Unsigned(bits)
                }
            }
            None if bits > 0 => Kind::Bytes,
            None => return None,
        },
    })
}

pub(crate) fn encode(
    value: &SdoValue,
    type_name: Option<&str>,
    item: Option<&ObjectItem>,
) -> Result<Vec<u8>, Refusal> {
    let names = || TYPES.map(|(name, _)| format!("`{name}`")).join(", ");
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
    let kind = match (type_name, item) {
        (Some(name), _) => kind(name, 0).ok_or_else(|| {
            (
                format!("unknown type `{name}`"),
                Some(format!("types: {}", names())),
            )
        })?,
        (None, Some(item)) => kind(&item.type_name, item.bit_len).ok_or_else(|| {
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
    let bytes = bytes(value, kind)?;
    if let (Some(item), SdoValue::Integer(n)) = (item, value) {
        let signed = matches!(kind, Kind::Signed(_));
        let low = item.min.as_deref().map(|b| little_endian(b, signed));
        let high = item.max.as_deref().map(|b| little_endian(b, signed));
        let n = i128::from(*n);
        if low.is_some_and(|low| n < low) || high.is_some_and(|high| n > high) {
            let end = |e: Option<i128>| e.map_or("…".to_owned(), |e| e.to_string());
            let range = format!("{} to {}", end(low), end(high));
            return Err((format!("{n} is outside what the ESI allows, {range}"), None));
        }
    }
    Ok(bytes)
}

fn little_endian(bytes: &[u8], signed: bool) -> i128 {
    let negative = signed && bytes.last().is_some_and(|b| b & 0x80 != 0);
    let mut all = [if negative { 0xff } else { 0 }; 16];
    for (to, from) in all.iter_mut().zip(bytes) {
        *to = *from;
    }
    i128::from_le_bytes(all)
}

fn bytes(value: &SdoValue, kind: Kind) -> Result<Vec<u8>, Refusal> {
    let misfit = |found: &str| -> Result<Vec<u8>, Refusal> {
        let wanted = match kind {
            Kind::Signed(bits) | Kind::Unsigned(bits) => format!("an integer of {bits} bits"),
            Kind::Float(_) => "a number".to_owned(),
            Kind::Text => "a text".to_owned(),
            Kind::Bytes => "bytes, such as [0x01, 0x02]".to_owned(),
        };
        Err((format!("the object takes {wanted}, not {found}"), None))
    };
    let integer = |n: i64, bits: u32, signed: bool| {
        let n = i128::from(n);
        let (low, high) = if signed {
            (-(1_i128 << (bits - 1)), (1_i128 << (bits - 1)) - 1)
        } else {
            (0, (1_i128 << bits) - 1)
        };
        if !(low..=high).contains(&n) {
            return Err((
                format!("{n} does not fit; the object takes {low} to {high}"),
                None,
            ));
        }
        let len = usize::try_from(bits.div_ceil(8)).unwrap_or(8);
        Ok(n.to_le_bytes().into_iter().take(len).collect())
    };
    match (value, kind) {
        (SdoValue::Bytes(b), _) => Ok(b.clone()),
        (SdoValue::Text(t), Kind::Text) => Ok(t.clone().into_bytes()),
        (SdoValue::Text(t), Kind::Signed(bits) | Kind::Unsigned(bits)) => {
            match super::fields::unquoted(t) {
                Some(n) => integer(n, bits, matches!(kind, Kind::Signed(_))),
                None => misfit("a text"),
            }
        }
        (SdoValue::Integer(n), Kind::Signed(bits)) => integer(*n, bits, true),
        (SdoValue::Integer(n), Kind::Unsigned(bits)) => integer(*n, bits, false),
        (SdoValue::Boolean(b), Kind::Signed(bits) | Kind::Unsigned(bits)) => {
            integer(i64::from(*b), bits, false)
        }
        (SdoValue::Integer(n), Kind::Float(bits)) => Ok(float(*n as f64, bits)),
        (SdoValue::Float(x), Kind::Float(bits)) => Ok(float(*x, bits)),
        (SdoValue::Float(x), _) => misfit(&x.to_string()),
        (SdoValue::Integer(n), _) => misfit(&n.to_string()),
        (SdoValue::Boolean(b), _) => misfit(&b.to_string()),
        (SdoValue::Text(_), _) => misfit("a text"),
    }
}

fn float(x: f64, bits: u32) -> Vec<u8> {
    if bits == 32 {
        (x as f32).to_le_bytes().to_vec()
    } else {
        x.to_le_bytes().to_vec()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn typed(value: SdoValue, name: &str) -> Result<Vec<u8>, Refusal> {
        encode(&value, Some(name), None)
    }

    #[test]
    fn widths_and_signs() {
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
    fn the_dictionary_decides() {
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
