//! The JSON schema (draft 7) of the machine file, for editors. It comes from the same tables as the
//! checks: types, ranges, words and descriptions.
//!
//! The schema accepts what the check accepts. It does not contain what depends on several keys or on
//! an ESI file.

use serde_json::{Map, Value as Json, json};
use toml::Spanned;

use super::fields::{Domain, Elements, Field, Ns, TableKey};
use super::raw::{RawAxis, RawMachine, RawStep};

/// The values of a type, as a JSON schema.
pub(crate) trait Schema {
    fn schema() -> Json;
}

/// Returns the JSON schema of the machine file.
#[must_use]
pub fn machine_file() -> Json {
    let mut schema = RawMachine::schema();
    schema["$schema"] = json!("http://json-schema.org/draft-07/schema#");
    schema["title"] = json!("ecaxis machine file");
    schema["definitions"] = json!({
        "axis": RawAxis::schema(),
        "step": RawStep::definition(),
    });
    schema
}

/// Returns a reference to a definition of [`machine_file`].
pub(crate) fn definition(name: &str) -> Json {
    json!({ "$ref": format!("#/definitions/{name}") })
}

/// A key of a table: its type and its doc comment.
pub(crate) type Property = (TableKey, Json, &'static str);

/// Returns the schema of a table. Keys with an example are required.
pub(crate) fn table<const N: usize>(keys: [Property; N]) -> Json {
    let required = |((key, example), ..): &Property| example.map(|_| *key);
    let required: Vec<&str> = keys.iter().filter_map(required).collect();
    let properties = keys.map(|((key, _), schema, text)| (key.to_owned(), described(schema, text)));
    json!({
        "type": "object",
        "properties": Map::from_iter(properties),
        "required": required,
        "additionalProperties": false,
    })
}

/// Adds a description, and the default value that it names.
pub(crate) fn described(schema: Json, text: &str) -> Json {
    // A line of a doc comment begins with a space.
    let text = text.trim();
    let mut schema = match schema.get("$ref") {
        // Draft 7 ignores the keywords next to a reference.
        Some(_) => json!({ "allOf": [schema] }),
        None => schema,
    };
    schema["description"] = json!(text);
    let value = text
        .split_once("; default ")
        .and_then(|(_, value)| value.strip_suffix(')'))
        .and_then(|value| serde_json::from_str::<Json>(value.trim_matches('`')).ok());
    // A time needs a unit: 0 cannot be a value of such a key.
    if let Some(value) = value.filter(|value| value.is_string() || schema["type"] != "string") {
        schema["default"] = value;
    }
    schema
}

/// Returns the schema of a key with a range or words.
pub(crate) fn domain<F, T>(domain: &impl Domain<T>) -> Json
where
    F: Field<Value = Spanned<T>>,
{
    domain.schema()
}

/// A text that is an integer.
const INTEGER: &str = r"^\s*(0[xX][0-9A-Fa-f]+|#x[0-9A-Fa-f]+|[-+]?[0-9]+)\s*$";

/// Returns the schema of an integer, which may also be written as a string.
pub(crate) fn integer(low: impl Into<i64>, high: impl Into<i64>) -> Json {
    json!({
        "type": ["integer", "string"],
        "minimum": low.into(),
        "maximum": high.into(),
        "pattern": INTEGER,
    })
}

pub(crate) fn any_of<const N: usize>(schemas: [Json; N]) -> Json {
    json!({ "anyOf": schemas.to_vec() })
}

pub(crate) fn words<'w>(words: impl IntoIterator<Item = &'w str>) -> Json {
    let words: Vec<&str> = words.into_iter().collect();
    json!({ "type": "string", "enum": words })
}

/// Returns the schema of a table with free keys, at least one.
pub(crate) fn named(value: Json) -> Json {
    json!({ "type": "object", "additionalProperties": value, "minProperties": 1 })
}

impl<T: Schema> Schema for Spanned<T> {
    fn schema() -> Json {
        T::schema()
    }
}

impl<T: Schema> Schema for Vec<T> {
    fn schema() -> Json {
        json!({ "type": "array", "items": T::schema() })
    }
}

impl<T: Schema> Schema for Elements<T> {
    fn schema() -> Json {
        Vec::<T>::schema()
    }
}

impl Schema for String {
    fn schema() -> Json {
        json!({ "type": "string" })
    }
}

impl Schema for bool {
    fn schema() -> Json {
        json!({ "type": "boolean" })
    }
}

impl Schema for f64 {
    fn schema() -> Json {
        let largest = super::fields::LARGEST;
        json!({ "type": "number", "minimum": -largest, "maximum": largest })
    }
}

impl Schema for [f64; 2] {
    fn schema() -> Json {
        json!({ "type": "array", "items": f64::schema(), "minItems": 2, "maxItems": 2 })
    }
}

impl Schema for [u32; 2] {
    fn schema() -> Json {
        let turns = integer(1, u32::MAX);
        json!({ "type": "array", "items": turns, "minItems": 2, "maxItems": 2 })
    }
}

impl Schema for Ns {
    fn schema() -> Json {
        json!({
            "type": "string",
            "pattern": r"^[0-9_]*\.?[0-9_]*\s*(ns|us|µs|ms|s|min|h)\s*$",
        })
    }
}

#[cfg(test)]
#[path = "schema_tests.rs"]
mod tests;
