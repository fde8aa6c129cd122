//! Signals and conditions as written.

use serde_json::Value as Json;
use toml::Spanned;
use toml::de::DeValue;

use super::super::fields::{Field, Key, Read, Table, TableKey, Value, Written};
use super::super::problem::{Problems, Span};
use super::super::schema::{self, Schema, any_of, named};
use super::number::RawNumber;
use super::step::Named;

/// `[signals]` and `[variables]`: names with a value each.
#[derive(Debug)]
pub(crate) struct NamedValues<T>(pub Named<T>);

impl<T> Default for NamedValues<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T> Field for NamedValues<T> {
    type Value = Self;

    fn of(value: Option<Self>) -> Option<Self> {
        Some(value.unwrap_or_default())
    }
}

impl<T: Read> Read for NamedValues<T> {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let DeValue::Table(table) = value.get_ref() else {
            p.add(value.span(), format!("`{key}` is a table of names"));
            return None;
        };
        let each = table.iter().filter_map(|(name, value)| {
            let name = Spanned::new(name.span(), name.get_ref().to_string());
            Some((name, Spanned::read(value, key, p)?))
        });
        Some(Self(each.collect()))
    }
}

impl<T: Schema> Schema for NamedValues<T> {
    fn schema() -> Json {
        named(T::schema())
    }
}

/// `io."Input 3"`: a device and one of its signals, a device and a value of its axis, or a name of
/// `[signals]` or `[variables]` alone.
#[derive(Debug, Clone)]
pub(crate) struct RawSignal {
    pub device: Option<Spanned<String>>,
    pub name: Spanned<String>,
}

#[derive(Debug)]
pub(crate) struct RawCondition {
    pub signal: RawSignal,
    pub equal: Key<RawNumber>,
    pub above: Key<RawNumber>,
    pub below: Key<RawNumber>,
}

table! { "a condition",
    table Bounds {
        /// The signal is greater than this number
        above: Key<RawNumber>,
        /// The signal is less than this number
        below: Key<RawNumber>,
    }
}

/// Reads `{ io."Input 3" = … }`: by device, then by signal.
fn signals<'d>(
    value: Value<'d>,
    key: &str,
    p: &mut Problems<'_>,
) -> Option<Vec<(RawSignal, Value<'d>)>> {
    let example = match key {
        "set" => {
            "write `{ io.\"Output 1\" = true }`, or `{ lamp = true }` with a name of [signals]"
        }
        _ => "write `{ io.\"Input 1\" = true }`, or `{ start = true }` with a name of [signals]",
    };
    let DeValue::Table(devices) = value.get_ref() else {
        p.add_hint(value.span(), "expected devices and their signals", example);
        return None;
    };
    let mut all = Vec::new();
    for (device, inner) in devices {
        let name = |name: &Spanned<toml::de::DeString<'_>>| {
            Spanned::new(name.span(), name.get_ref().to_string())
        };
        let signals = match inner.get_ref() {
            DeValue::Table(signals) if !is_bounds(signals) => signals,
            _ => {
                let signal = RawSignal {
                    device: None,
                    name: name(device),
                };
                all.push((signal, inner));
                continue;
            }
        };
        for (signal, value) in signals {
            let signal = RawSignal {
                device: Some(name(device)),
                name: name(signal),
            };
            all.push((signal, value));
        }
    }
    if all.is_empty() {
        p.add_hint(value.span(), "no signal is named", example);
    }
    Some(all)
}

/// Signals with a value each.
#[derive(Debug, Default)]
pub(crate) struct Levels(pub Vec<(RawSignal, Spanned<RawNumber>)>);

impl Field for Levels {
    type Value = Self;

    fn of(value: Option<Self>) -> Option<Self> {
        Some(value.unwrap_or_default())
    }
}

impl Read for Levels {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let signals = signals(value, key, p)?.into_iter();
        let levels = signals.filter_map(|(signal, v)| Some((signal, level(v, key, p)?)));
        Some(Self(levels.collect()))
    }
}

impl Schema for Levels {
    fn schema() -> Json {
        let value = any_of([<RawNumber>::schema(), bool::schema()]);
        named(any_of([value.clone(), named(value)]))
    }
}

/// True for `{ above = 1, below = 2 }`.
fn is_bounds(table: &toml::de::DeTable<'_>) -> bool {
    let bound = |key: &str| Bounds::KEYS.iter().any(|(known, _)| *known == key);
    !table.is_empty() && table.keys().all(|key| bound(key.get_ref()))
}

/// Reads a number; `true` is 1.
fn level(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Key<RawNumber> {
    let quoted = |word: &str| {
        let word = word.trim();
        matches!(word, "true" | "false" | "on" | "off") || word.parse::<f64>().is_ok()
    };
    match value.get_ref() {
        DeValue::Boolean(on) => {
            let number = RawNumber::Fixed(f64::from(u8::from(*on)));
            Some(Spanned::new(value.span(), number))
        }
        DeValue::String(word) if quoted(word) => {
            let message = format!("expected a number, found \"{word}\"");
            p.add_hint(
                value.span(),
                message,
                "write a number, true or false, without quotes",
            );
            None
        }
        _ => Spanned::read(value, key, p),
    }
}

#[derive(Debug)]
pub(crate) struct Conditions(pub Vec<RawCondition>);

impl Read for Conditions {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let signals = signals(value, key, p)?.into_iter();
        Some(Self(
            signals
                .filter_map(|(signal, v)| condition(signal, v, key, p))
                .collect(),
        ))
    }
}

fn condition(
    signal: RawSignal,
    value: Value<'_>,
    key: &str,
    p: &mut Problems<'_>,
) -> Option<RawCondition> {
    let bounds = match value.get_ref() {
        DeValue::Table(_) => Bounds::read(value, key, p)?,
        _ => {
            let (equal, above, below) = (Some(level(value, key, p)?), None, None);
            return Some(RawCondition {
                signal,
                equal,
                above,
                below,
            });
        }
    };
    let Bounds {
        above,
        below,
        written,
        ..
    } = bounds;
    if above.is_none() && below.is_none() {
        if !written.unknown {
            let hint = "write `true`, a number, or `{ above = 100 }`";
            p.add_hint(value.span(), "this waits for nothing", hint);
        }
        return None;
    }
    Some(RawCondition {
        signal,
        equal: None,
        above,
        below,
    })
}

impl Schema for Conditions {
    fn schema() -> Json {
        let mut bounds = Bounds::schema();
        bounds["minProperties"] = 1.into();
        let bound = bounds["properties"].clone();
        let condition = any_of([<RawNumber>::schema(), bool::schema(), bounds]);
        // A bound is a number.
        let mut signals = named(condition.clone());
        signals["properties"] = bound;
        named(any_of([condition, signals]))
    }
}

/// Conditions that hold at once, or a list of alternatives.
#[derive(Debug)]
pub(crate) struct RawWhen(pub Vec<Conditions>);

impl Read for RawWhen {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let each = match value.get_ref() {
            DeValue::Array(each) if each.is_empty() => {
                let hint = "write `{ io.\"Input 1\" = true }`";
                p.add_hint(value.span(), "no condition is named", hint);
                return None;
            }
            DeValue::Array(each) => each.iter().collect(),
            _ => vec![value],
        };
        let read: Vec<_> = each
            .iter()
            .map(|each| Conditions::read(each, key, p))
            .collect();
        read.into_iter().collect::<Option<_>>().map(Self)
    }
}

impl Schema for RawWhen {
    fn schema() -> Json {
        let several = serde_json::json!({
            "type": "array", "items": Conditions::schema(), "minItems": 1
        });
        any_of([Conditions::schema(), several])
    }
}
