//! The server's SDO Information: its stored objects and subindices, each named after its address.

use std::collections::BTreeMap;

type Objects = BTreeMap<(u16, u8), Vec<u8>>;

pub fn object_name(index: u16) -> String {
    format!("The object at {index:#06x}, whose name fits no mailbox")
}

pub fn entry_name(index: u16, sub: u8) -> String {
    format!("Item {sub} of {index:#06x}, also with a name too long for one")
}

/// Returns the messages without their CoE headers. A message has 12 bytes of headers in a mailbox
/// of `len`.
pub fn answers(objects: &Objects, request: &[u8], len: usize) -> Vec<Vec<u8>> {
    let (opcode, answer) = match answer(objects, request[0], &request[4..]) {
        Ok(answer) => (request[0] + 1, answer),
        Err(code) => (7, code.to_le_bytes().to_vec()),
    };
    let parts: Vec<&[u8]> = answer.chunks(len - 12).collect();
    let fragments = parts.iter().enumerate().map(|(n, part)| {
        let left = parts.len() - 1 - n;
        let mut fragment = vec![opcode | u8::from(left > 0) << 7, 0];
        fragment.extend(u16::try_from(left).unwrap().to_le_bytes());
        fragment.extend_from_slice(part);
        fragment
    });
    fragments.collect()
}

fn answer(objects: &Objects, opcode: u8, body: &[u8]) -> Result<Vec<u8>, u32> {
    let index = u16::from_le_bytes([body[0], body[1]]);
    let mut indices: Vec<u16> = objects.keys().map(|key| key.0).collect();
    indices.dedup();
    let mut out = body[..2].to_vec();
    match opcode {
        1 if index == 0 => {
            for _ in 0..5 {
                out.extend(u16::try_from(indices.len()).unwrap().to_le_bytes());
            }
        }
        1 if index <= 5 => out.extend(indices.iter().flat_map(|index| index.to_le_bytes())),
        1 => return Err(0x0601_0000),
        3 => {
            let subs = objects.keys().filter(|key| key.0 == index);
            let max = subs.map(|key| key.1).max().ok_or(0x0602_0000_u32)?;
            out.extend([0x07, 0x00, max, if max == 0 { 7 } else { 9 }]);
            out.extend(object_name(index).bytes());
        }
        5 => {
            let sub = body[2];
            let value = objects.get(&(index, sub)).ok_or(0x0609_0011_u32)?;
            let bits = u16::try_from(8 * value.len()).unwrap();
            // Sends a unit and a default that were not requested.
            out.extend([sub, 0x1f, 0x05, 0x00]);
            out.extend(bits.to_le_bytes());
            out.extend([0x3f, 0x01]);
            out.extend([0, 0, 0x10, 0]);
            out.extend(value);
            out.extend(entry_name(index, sub).bytes());
        }
        _ => return Err(0x0504_0001),
    }
    Ok(out)
}
