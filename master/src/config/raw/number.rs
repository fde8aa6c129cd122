//! Numbers that may be the values of variables, and `[variables]`.

use serde_json::Value as Json;
use toml::Spanned;
use toml::de::DeValue;

use super::super::fields::{Field, Key, Ns, Read, Table, TableKey, Value, Written};
use super::super::problem::{Problems, Span};
use super::super::schema::{self, Schema, any_of};

/// A number, or the name of a variable.
#[derive(Debug, Clone)]
pub(crate) enum RawNumber<T = f64> {
    Fixed(T),
    Variable(String),
}

/// Returns the name of a variable. A parameter that no call has replaced is reported.
fn variable(value: Value<'_>, p: &mut Problems<'_>) -> Option<Option<String>> {
    match value.get_ref() {
        DeValue::String(word) if word.starts_with('$') => {
            let message = format!("`{word}` is a parameter, and parameters exist in [[sub]] only");
            p.add_hint(
                value.span(),
                message,
                "write a number, or the name of a variable",
            );
            None
        }
        DeValue::String(word) if word.starts_with(|c: char| c.is_alphabetic() || c == '_') => {
            Some(Some(word.to_string()))
        }
        _ => Some(None),
    }
}

impl Read for RawNumber {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        Some(match variable(value, p)? {
            Some(name) => Self::Variable(name),
            None => Self::Fixed(f64::read(value, key, p)?),
        })
    }
}

/// A time, or the name of a variable in s.
impl Read for RawNumber<Ns> {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        Some(match variable(value, p)? {
            Some(name) => Self::Variable(name),
            None => Self::Fixed(Ns::read(value, key, p)?),
        })
    }
}

impl Schema for RawNumber {
    fn schema() -> Json {
        any_of([f64::schema(), String::schema()])
    }
}

impl Schema for RawNumber<Ns> {
    fn schema() -> Json {
        String::schema()
    }
}

/// A variable: its value at the start, and its range.
#[derive(Debug)]
pub(crate) struct RawVariable {
    pub initial: f64,
    pub range: Key<[f64; 2]>,
}

table! { "a variable",
    row VariableTable {
        /// Value at the start of each run of the program
        initial: Spanned<f64> = "0.0",
        /// Least and greatest value; steps need it to use the variable as a number
        range: Key<[f64; 2]> = "[0.0, 10.0]",
    }
}

impl Read for RawVariable {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        if let DeValue::Table(_) = value.get_ref() {
            let VariableTable { initial, range, .. } = VariableTable::read(value, key, p)?;
            let (initial, range) = (initial.into_inner(), Some(range?));
            return Some(Self { initial, range });
        }
        Some(Self {
            initial: f64::read(value, key, p)?,
            range: None,
        })
    }
}

impl Schema for RawVariable {
    fn schema() -> Json {
        any_of([f64::schema(), VariableTable::schema()])
    }
}
