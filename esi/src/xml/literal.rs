//! Default, minimum and maximum literals → little-endian bytes of the object's length.

use ecaxis_ecat::data_type::{DataType, Kind};

use super::number::{boolean, hex_bytes, hex_start, number};
use super::object::Literal;
use crate::model::Bytes;

/// Converts a literal; `Ok(None)`: the element is empty. The error text completes "default …".
pub(super) fn bytes(
    literal: &Literal<'_>,
    type_name: &str,
    bit_len: u32,
) -> Result<Option<Bytes>, String> {
    let length = usize::try_from(bit_len.div_ceil(8)).unwrap_or(0);
    let data_type = DataType::named(type_name, bit_len).unwrap_or(DataType::BYTES);
    match literal {
        Literal::Value(text) | Literal::Data(text) if text.is_empty() => Ok(None),
        Literal::Value(text) if data_type.kind == Kind::Text => {
            Ok(Some(Bytes::fitted(text.as_bytes(), length)))
        }
        Literal::Value(text) => value(text, data_type, bit_len, length).map(Some),
        Literal::Data(text) => match data(text, length) {
            Some(data) => Ok(Some(data)),
            None => Err(format!(
                "{:?} is not a sequence of hexadecimal bytes",
                short(text)
            )),
        },
        Literal::Text(text) => Ok(Some(Bytes::fitted(text.as_bytes(), length))),
    }
}

/// Returns `bit_len` bits of a block from `bit_offset`.
pub(crate) fn slice(block: &[u8], bit_offset: u32, bit_len: u32) -> Option<Bytes> {
    let (offset, length) = (
        usize::try_from(bit_offset).ok()?,
        usize::try_from(bit_len).ok()?,
    );
    if length == 0 || offset.checked_add(length)? > block.len().checked_mul(8)? {
        return None;
    }
    let mut out = vec![0u8; length.div_ceil(8)];
    for bit in 0..length {
        let from = offset + bit;
        let set = block.get(from / 8)? >> (from % 8) & 1;
        *out.get_mut(bit / 8)? |= set << (bit % 8);
    }
    Some(out.into())
}

/// Returns the bit length of a base type, or 0 for other names.
pub(super) fn base_bits(type_name: &str) -> u32 {
    DataType::named(type_name, 0).map_or(0, |data_type| data_type.bits)
}

fn value(text: &str, data_type: DataType, bit_len: u32, length: usize) -> Result<Bytes, String> {
    if data_type.kind == Kind::Real && !text.contains(['x', 'X']) {
        let bytes = match data_type.bits {
            32 => text.parse::<f32>().map(|v| v.to_le_bytes().to_vec()),
            _ => text.parse::<f64>().map(|v| v.to_le_bytes().to_vec()),
        };
        let bytes = bytes.map_err(|_| not_a_number(text))?;
        return Ok(Bytes::fitted(&bytes, length));
    }
    let value = number(text)
        .or_else(|| boolean(text).map(i128::from))
        .ok_or_else(|| not_a_number(text))?;
    let fits = match bit_len {
        0 => false,
        1..=120 => value < 1i128 << bit_len && value >= -(1i128 << (bit_len - 1)),
        _ => true,
    };
    if !fits {
        return Err(format!("{:?} does not fit {bit_len} bits", short(text)));
    }
    let mut short = value.to_le_bytes();
    if length <= short.len() {
        odd_length(short.get_mut(..length).unwrap_or_default(), bit_len);
        return Ok(Bytes::fitted(&short, length));
    }
    let mut long = short.to_vec();
    long.resize(length, if value < 0 { 0xff } else { 0 });
    odd_length(&mut long, bit_len);
    Ok(long.into())
}

fn not_a_number(text: &str) -> String {
    format!("{:?} is not a number", short(text))
}

/// Parses any number of hexadecimal bytes, fitted to `length`.
fn data(text: &str, length: usize) -> Option<Bytes> {
    let mut short = [0; 16];
    if text.len() <= 2 * short.len() {
        let (pairs, rest) = hex_start(text.as_bytes(), &mut short);
        if rest.is_empty() {
            return Some(Bytes::fitted(short.get(..pairs)?, length));
        }
    }
    Some(Bytes::fitted(&hex_bytes(text)?, length))
}

/// Clears the sign bits of a negative number beyond `bit_len`.
fn odd_length(bytes: &mut [u8], bit_len: u32) {
    if !bit_len.is_multiple_of(8)
        && let Some(last) = bytes.last_mut()
    {
        *last &= (1u8 << (bit_len % 8)) - 1;
    }
}

fn short(text: &str) -> String {
    text.chars().take(40).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn v(text: &str) -> Literal<'_> {
        Literal::Value(text.into())
    }

    #[test]
    fn literal_bytes_follow_type_and_length() {
        for (text, type_name, bits, expected) in [
            ("-1", "INT", 16, vec![0xff, 0xff]),
            ("#xffff", "INT", 16, vec![0xff, 0xff]),
            ("#x00B44700", "UDINT", 32, vec![0x00, 0x47, 0xb4, 0x00]),
            ("true", "BOOL", 1, vec![1]),
            ("-1", "BIT3", 3, vec![0x07]),
            ("1.5", "REAL", 32, vec![0, 0, 0xc0, 0x3f]),
            ("#x3f800000", "REAL", 32, vec![0, 0, 0x80, 0x3f]),
            ("7", "STRING(3)", 24, vec![b'7', 0, 0]),
        ] {
            assert_eq!(
                bytes(&v(text), type_name, bits),
                Ok(Some(expected.into())),
                "{text} {type_name}"
            );
        }
        assert_eq!(bytes(&v(""), "INT", 16), Ok(None));
        assert!(bytes(&v("256"), "USINT", 8).is_err());
        assert!(bytes(&v("-129"), "SINT", 8).is_err());
        assert!(bytes(&v("x"), "INT", 16).is_err());
        assert!(bytes(&v("1"), "INT", 0).is_err());
    }

    #[test]
    fn literal_data_stays_little_endian() {
        assert_eq!(
            bytes(&Literal::Data("0001".into()), "UINT", 16),
            Ok(Some([0, 1].into()))
        );
        assert_eq!(
            bytes(&Literal::Data("01".into()), "UDINT", 32),
            Ok(Some([1, 0, 0, 0].into()))
        );
    }

    #[test]
    fn literal_slice_cuts_a_block_at_bit_offsets() {
        assert_eq!(
            slice(&[2, 0, 0x34, 0x12, 0x78], 16, 16),
            Some([0x34, 0x12].into())
        );
        assert_eq!(slice(&[0xf0], 4, 4), Some([0x0f].into()));
        assert_eq!(slice(&[0xf0], 4, 8), None);
    }
}
