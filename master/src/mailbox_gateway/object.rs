//! An object with its entries, and the CoE services of a server of objects.

use ecaxis_ecat::mailbox::coe::{Answer, Fragment};
use ecaxis_ecat::mailbox::{TYPE_COE, abort_code};

use crate::mailbox::RawMessage;

/// Object codes (ETG.1000.6 Table 41).
const VARIABLE: u8 = 7;
const ARRAY: u8 = 8;
const RECORD: u8 = 9;

/// Data types (ETG.1020, "Base Data Types").
const BOOLEAN: u16 = 1;
const UNSIGNED8: u16 = 5;
const UNSIGNED16: u16 = 6;
const UNSIGNED32: u16 = 7;
const VISIBLE_STRING: u16 = 9;
const OCTET_STRING: u16 = 10;

/// Access rights (ETG.1000.6 Table 46): readable, and writable, in PreOp, SafeOp and Op.
const READ: u16 = 0x0007;
const WRITE: u16 = 0x0038;

/// Opcodes of SDO Information.
const LIST: u8 = 1;
const OBJECT: u8 = 3;
const ENTRY: u8 = 5;
const ERROR: u8 = 7;

/// A frame fits into a UDP datagram on Ethernet.
const MAX_BODY: usize = 1472 - 2 - 6;
/// The bytes of an SDO Information message before its data.
const INFORMATION_HEADER: usize = 6;
/// The bytes of an upload answer before its data.
const UPLOAD_HEADER: usize = 10;
/// Indices in a list: all, and those of ETG.1000.6 Table 43 that are empty here.
const LISTS: u16 = 5;

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Entry {
    pub(super) sub: u8,
    data_type: u16,
    access: u16,
    pub(super) name: &'static str,
    pub(super) value: Vec<u8>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Object {
    pub(super) index: u16,
    code: u8,
    data_type: u16,
    name: String,
    /// In the order of their subindices.
    pub(super) entries: Vec<Entry>,
}

impl Object {
    fn new(index: u16, code: u8, data_type: u16, name: String) -> Self {
        Self {
            index,
            code,
            data_type,
            name,
            entries: Vec::new(),
        }
    }

    pub(super) fn number(index: u16, name: &'static str, value: u32) -> Self {
        Self::new(index, VARIABLE, UNSIGNED32, name.to_owned()).u32(0, name, value)
    }

    pub(super) fn text(index: u16, name: &'static str, value: &str) -> Self {
        let object = Self::new(index, VARIABLE, VISIBLE_STRING, name.to_owned());
        object.string(0, name, value.len(), value)
    }

    /// Returns a record; its entries follow. Subindex 0 is `max_sub`.
    pub(super) fn record(index: u16, name: String, max_sub: u8) -> Self {
        Self::new(index, RECORD, 0, name).u8(0, "SubIndex 000", max_sub)
    }

    /// Returns an array of 16-bit numbers, at most 255.
    pub(super) fn array(index: u16, name: String, values: &[u16]) -> Self {
        let count = u8::try_from(values.len()).unwrap_or(u8::MAX);
        let array = Self::new(index, ARRAY, UNSIGNED16, name).u8(0, "SubIndex 000", count);
        let mut numbered = (1..=count).zip(values);
        numbered.by_ref().fold(array, |array, (sub, value)| {
            array.u16(sub, "Fixed Station Address", *value)
        })
    }

    fn entry(mut self, sub: u8, data_type: u16, name: &'static str, value: Vec<u8>) -> Self {
        self.entries.push(Entry {
            sub,
            data_type,
            access: READ,
            name,
            value,
        });
        self
    }

    pub(super) fn bool(self, sub: u8, name: &'static str, value: bool) -> Self {
        self.entry(sub, BOOLEAN, name, vec![value.into()])
    }

    pub(super) fn u8(self, sub: u8, name: &'static str, value: u8) -> Self {
        self.entry(sub, UNSIGNED8, name, vec![value])
    }

    pub(super) fn u16(self, sub: u8, name: &'static str, value: u16) -> Self {
        self.entry(sub, UNSIGNED16, name, value.to_le_bytes().to_vec())
    }

    pub(super) fn u32(self, sub: u8, name: &'static str, value: u32) -> Self {
        self.entry(sub, UNSIGNED32, name, value.to_le_bytes().to_vec())
    }

    /// Adds a text of a fixed length, cut at a whole character.
    pub(super) fn string(self, sub: u8, name: &'static str, length: usize, text: &str) -> Self {
        let mut end = text.len().min(length);
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        let mut value = text.as_bytes().get(..end).unwrap_or_default().to_vec();
        value.resize(length, 0);
        self.entry(sub, VISIBLE_STRING, name, value)
    }

    pub(super) fn octets(self, sub: u8, name: &'static str, value: &[u8]) -> Self {
        self.entry(sub, OCTET_STRING, name, value.to_vec())
    }

    /// Makes the last entry writable.
    pub(super) fn writable(mut self) -> Self {
        if let Some(last) = self.entries.last_mut() {
            last.access |= WRITE;
        }
        self
    }

    fn max_sub(&self) -> u8 {
        self.entries.last().map_or(0, |entry| entry.sub)
    }

    pub(super) fn has(&self, sub: u8) -> bool {
        self.entries.iter().any(|entry| entry.sub == sub)
    }

    /// Returns the value of a subindex, or the abort code.
    fn value(&self, sub: u8) -> Result<Vec<u8>, u32> {
        let entry = self.entries.iter().find(|entry| entry.sub == sub);
        let entry = entry.ok_or(abort_code::NO_SUBINDEX)?;
        Ok(entry.value.clone())
    }

    /// Returns all values from subindex 0 or 1 on. Subindex 0 has 16 bits, and larger values begin
    /// at even places.
    fn complete(&self, sub: u8) -> Result<Vec<u8>, u32> {
        if sub > 1 || self.code == VARIABLE {
            return Err(abort_code::UNSUPPORTED_ACCESS);
        }
        let mut data = Vec::new();
        for entry in self.entries.iter().filter(|entry| entry.sub >= sub) {
            if data.len() % 2 != 0 && (entry.value.len() > 1 || data.len() == 1) {
                data.push(0);
            }
            data.extend_from_slice(&entry.value);
        }
        Ok(data)
    }
}

/// Returns the answer to an upload.
pub(super) fn upload(object: Option<&Object>, index: u16, sub: u8, complete: bool) -> RawMessage {
    let found = object.ok_or(abort_code::NO_OBJECT);
    let found = found.and_then(|object| match complete {
        true => object.complete(sub),
        false => object.value(sub),
    });
    let answer = match &found {
        Ok(data) if data.len() > MAX_BODY - UPLOAD_HEADER => Answer::Abort {
            index,
            sub,
            code: abort_code::LONGER_THAN_MAILBOX,
        },
        Ok(data) => Answer::Upload {
            index,
            sub,
            size: data.len(),
            data,
        },
        Err(code) => Answer::Abort {
            index,
            sub,
            code: *code,
        },
    };
    coe(answer.body())
}

/// A source of objects.
pub(super) trait Objects {
    fn indices(&self) -> Vec<u16>;
    fn object(&self, index: u16) -> Option<Object>;
}

/// Returns the answers to a request of SDO Information.
pub(super) fn information(objects: &impl Objects, opcode: u8, body: &[u8]) -> Vec<RawMessage> {
    let described = match (opcode, body) {
        (LIST, [low, high, ..]) => list(objects, u16::from_le_bytes([*low, *high])),
        (OBJECT, [low, high, ..]) => {
            let found = objects.object(u16::from_le_bytes([*low, *high]));
            found.ok_or(abort_code::NO_OBJECT).map(|object| {
                let mut data = object.index.to_le_bytes().to_vec();
                data.extend(object.data_type.to_le_bytes());
                data.extend([object.max_sub(), object.code]);
                data.extend(object.name.as_bytes());
                data
            })
        }
        (ENTRY, [low, high, sub, requested, ..]) => {
            let found = objects.object(u16::from_le_bytes([*low, *high]));
            found.ok_or(abort_code::NO_OBJECT).and_then(|object| {
                describe_entry(&object, *sub, *requested).ok_or(abort_code::NO_SUBINDEX)
            })
        }
        _ => Err(abort_code::INVALID_COMMAND),
    };
    match described {
        Err(code) => vec![fragment(ERROR, 0, &code.to_le_bytes())],
        Ok(data) => {
            let parts: Vec<_> = data.chunks(MAX_BODY - INFORMATION_HEADER).collect();
            let left = (0..parts.len()).rev();
            let parts = parts.iter().zip(left).map(|(part, left)| {
                let left = u16::try_from(left).unwrap_or(u16::MAX);
                fragment(opcode + 1, left, part)
            });
            parts.collect()
        }
    }
}

fn list(objects: &impl Objects, list: u16) -> Result<Vec<u8>, u32> {
    let indices = objects.indices();
    let mut data = list.to_le_bytes().to_vec();
    match list {
        0 => {
            let count = u16::try_from(indices.len()).unwrap_or(u16::MAX);
            data.extend(count.to_le_bytes());
            data.resize(2 + 2 * usize::from(LISTS), 0);
        }
        1 => data.extend(indices.into_iter().flat_map(u16::to_le_bytes)),
        2..=LISTS => {}
        _ => return Err(abort_code::OUT_OF_RANGE),
    }
    Ok(data)
}

/// Returns access rights and name; units, default and limits are not described.
fn describe_entry(object: &Object, sub: u8, requested: u8) -> Option<Vec<u8>> {
    /// Access rights, category, mapping.
    const ALWAYS: u8 = 0x07;
    let entry = object.entries.iter().find(|entry| entry.sub == sub)?;
    let bits = u16::try_from(entry.value.len() * 8).unwrap_or(u16::MAX);
    let mut data = object.index.to_le_bytes().to_vec();
    data.extend([sub, requested & ALWAYS]);
    for word in [entry.data_type, bits, entry.access] {
        data.extend(word.to_le_bytes());
    }
    data.extend(entry.name.as_bytes());
    Some(data)
}

fn fragment(opcode: u8, left: u16, data: &[u8]) -> RawMessage {
    coe(Fragment { opcode, left, data }.body())
}

pub(super) fn coe(body: Vec<u8>) -> RawMessage {
    RawMessage {
        channel: 0,
        protocol: TYPE_COE,
        body,
    }
}
