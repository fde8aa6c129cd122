//! Decodes ROS 2 messages by their definition alone, independent of the encoder.

use std::collections::HashMap;
use std::ops::Index;

/// A decoded value.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    Integer(i128),
    Real(f64),
    Text(String),
    List(Vec<Value>),
    Message(Vec<(String, Value)>),
}

impl Index<&str> for Value {
    type Output = Value;

    fn index(&self, name: &str) -> &Value {
        let Self::Message(fields) = self else {
            panic!("{self:?} is not a message");
        };
        let field = fields.iter().find(|(field, _)| field == name);
        &field.unwrap_or_else(|| panic!("no {name} in {self:?}")).1
    }
}

impl Value {
    pub fn real(&self) -> f64 {
        match self {
            Self::Real(value) => *value,
            other => panic!("{other:?} is not a real number"),
        }
    }

    pub fn integer(&self) -> i128 {
        match self {
            Self::Integer(value) => *value,
            other => panic!("{other:?} is not an integer"),
        }
    }

    pub fn text(&self) -> &str {
        match self {
            Self::Text(text) => text,
            other => panic!("{other:?} is not a text"),
        }
    }

    pub fn list(&self) -> &[Value] {
        match self {
            Self::List(list) => list,
            other => panic!("{other:?} is not a list"),
        }
    }

    /// Returns the time in ns of the message's header.
    pub fn stamp(&self) -> u64 {
        let stamp = &self["header"]["stamp"];
        let ns = stamp["sec"].integer() * 1_000_000_000 + stamp["nanosec"].integer();
        u64::try_from(ns).expect("a time after 1970")
    }
}

/// The fields of each type: type, whether it is a sequence, name.
type Types<'s> = HashMap<&'s str, Vec<(&'s str, bool, &'s str)>>;

fn types(schema: &str) -> Types<'_> {
    let line = "=".repeat(80) + "\n";
    let parts = schema.split(line.as_str()).enumerate().map(|(n, part)| {
        let (name, fields) = match part.strip_prefix("MSG: ") {
            Some(part) => part.split_once('\n').expect("a type and its fields"),
            None => ("", part),
        };
        assert_eq!(name.is_empty(), n == 0, "only the first part has no name");
        let fields = fields.lines().filter(|line| !line.starts_with('#'));
        let fields = fields.filter(|line| !line.contains('=')).map(|line| {
            let (kind, name) = line.split_once(' ').expect("a type and a name");
            match kind.strip_suffix("[]") {
                Some(kind) => (kind, true, name),
                None => (kind, false, name),
            }
        });
        (name, fields.collect())
    });
    parts.collect()
}

struct Decoder<'s, 'b> {
    types: Types<'s>,
    bytes: &'b [u8],
    at: usize,
}

/// Decodes a message. `None`: the message does not have exactly the fields of the definition.
pub fn decode(schema: &str, bytes: &[u8]) -> Option<Value> {
    let bytes = bytes.strip_prefix(&[0, 1, 0, 0])?;
    let mut decoder = Decoder {
        types: types(schema),
        bytes,
        at: 0,
    };
    let value = decoder.message("")?;
    (decoder.at == bytes.len()).then_some(value)
}

impl Decoder<'_, '_> {
    fn message(&mut self, kind: &str) -> Option<Value> {
        let fields = self.types.get(kind).expect("a known type").clone();
        let mut values = Vec::new();
        for (kind, sequence, name) in fields {
            let value = if sequence {
                let count = self.primitive::<4>().map(u32::from_le_bytes)?;
                let values = (0..count).map(|_| self.value(kind));
                Value::List(values.collect::<Option<_>>()?)
            } else {
                self.value(kind)?
            };
            values.push((name.to_owned(), value));
        }
        Some(Value::Message(values))
    }

    fn value(&mut self, kind: &str) -> Option<Value> {
        Some(match kind {
            "bool" => Value::Integer(self.primitive::<1>().filter(|b| b[0] < 2)?[0].into()),
            "byte" | "uint8" => Value::Integer(self.primitive::<1>()?[0].into()),
            "int8" => Value::Integer(i8::from_le_bytes(self.primitive()?).into()),
            "uint16" => Value::Integer(u16::from_le_bytes(self.primitive()?).into()),
            "int32" => Value::Integer(i32::from_le_bytes(self.primitive()?).into()),
            "uint32" => Value::Integer(u32::from_le_bytes(self.primitive()?).into()),
            "uint64" => Value::Integer(u64::from_le_bytes(self.primitive()?).into()),
            "float64" => Value::Real(f64::from_le_bytes(self.primitive()?)),
            "string" => {
                let count = self.primitive::<4>().map(u32::from_le_bytes)?;
                let end = self.at.checked_add(usize::try_from(count).ok()?)?;
                let text = self.bytes.get(self.at..end)?.strip_suffix(&[0])?;
                self.at = end;
                Value::Text(String::from_utf8(text.to_vec()).ok()?)
            }
            message => self.message(message)?,
        })
    }

    fn primitive<const N: usize>(&mut self) -> Option<[u8; N]> {
        let at = self.at.next_multiple_of(N);
        let padding = self.bytes.get(self.at..at)?;
        assert!(padding.iter().all(|byte| *byte == 0), "padding is 0");
        self.at = at + N;
        self.bytes.get(at..self.at)?.try_into().ok()
    }
}
