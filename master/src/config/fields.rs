//! Reads typed values from TOML tables. An invalid value becomes a problem and a `None`. Reading
//! continues, so that one check finds all problems.

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::duration;
use super::problem::{Problems, Span, list, nearest};

type Value<'d> = &'d Spanned<DeValue<'d>>;

/// One table while it is read. Keys that are never read are unknown.
pub(crate) struct Fields<'d> {
    table: &'d DeTable<'d>,
    span: Span,
    /// The table's name in messages: `[bus]`.
    name: &'static str,
    asked: Vec<&'static str>,
    missing: Vec<(&'static str, &'static str)>,
}

impl<'d> Fields<'d> {
    pub fn new(table: &'d DeTable<'d>, span: Span, name: &'static str) -> Self {
        Self {
            table,
            span,
            name,
            asked: Vec::new(),
            missing: Vec::new(),
        }
    }

    pub fn get(&mut self, key: &'static str) -> Option<Value<'d>> {
        self.asked.push(key);
        self.table
            .iter()
            .find(|(k, _)| k.get_ref().as_ref() == key)
            .map(|(_, v)| v)
    }

    /// Returns `true` if the key is present, valid or not.
    pub fn has(&self, key: &str) -> bool {
        self.table.contains_key(key)
    }

    /// Like [`Fields::get`], but reports a missing key. `example` shows a possible line.
    pub fn need(&mut self, key: &'static str, example: &'static str) -> Option<Value<'d>> {
        let value = self.get(key);
        if value.is_none() {
            self.missing.push((key, example));
        }
        value
    }

    /// Returns the known keys of the table, each with its line.
    pub fn written(&self, problems: &Problems<'_>) -> Vec<(&'static str, u32)> {
        let keys = self.table.keys().filter_map(|key| {
            let known = self
                .asked
                .iter()
                .find(|asked| **asked == key.get_ref().as_ref())?;
            Some((*known, problems.line(&key.span())))
        });
        keys.collect()
    }

    pub fn asked(&self, key: &str) -> bool {
        self.asked.contains(&key)
    }

    /// Returns `true` if the table has keys that have not been read.
    pub fn unknown(&self) -> bool {
        self.table
            .keys()
            .any(|k| !self.asked.contains(&k.get_ref().as_ref()))
    }

    /// Reports unknown keys, then missing ones. A missing key that an unknown one resembles is not
    /// reported.
    pub fn done(self, problems: &mut Problems<'_>) {
        let mut meant = Vec::new();
        for key in self.table.keys() {
            let word = key.get_ref().as_ref();
            if self.asked.contains(&word) {
                continue;
            }
            let free = self
                .asked
                .iter()
                .copied()
                .filter(|k| !self.table.contains_key(*k));
            let all = self.asked.iter().copied();
            let hint = match nearest(word, free).or_else(|| nearest(word, all)) {
                Some(k) => {
                    meant.push(k);
                    format!("did you mean `{k}`?")
                }
                None => format!("known keys: {}", list(self.asked.iter().copied())),
            };
            problems.add_hint(
                key.span(),
                format!("unknown key `{word}` in {}", self.name),
                hint,
            );
        }
        for (key, example) in self.missing {
            if !meant.contains(&key) {
                let message = format!("`{key}` is missing in {}", self.name);
                problems.add_hint(self.span.clone(), message, format!("add `{example}`"));
            }
        }
    }
}

fn wrong<T>(problems: &mut Problems<'_>, value: Value<'_>, wanted: &str) -> Option<T> {
    let found = match value.get_ref() {
        DeValue::String(_) => "a string",
        DeValue::Integer(_) => "an integer",
        DeValue::Float(_) => "a number",
        DeValue::Boolean(_) => "true or false",
        DeValue::Datetime(_) => "a date",
        DeValue::Array(_) => "a list",
        DeValue::Table(_) => "a table",
    };
    problems.add(value.span(), format!("expected {wanted}, found {found}"));
    None
}

pub(crate) fn string(problems: &mut Problems<'_>, value: Value<'_>) -> Option<Spanned<String>> {
    match value.get_ref() {
        DeValue::String(s) => Some(Spanned::new(value.span(), s.to_string())),
        _ => wrong(problems, value, "a string"),
    }
}

pub(crate) fn boolean(problems: &mut Problems<'_>, value: Value<'_>) -> Option<Spanned<bool>> {
    match value.get_ref() {
        DeValue::Boolean(b) => Some(Spanned::new(value.span(), *b)),
        _ => wrong(problems, value, "true or false"),
    }
}

/// The maximum absolute number. Beyond it, axes and tables reject positions, and `f64` loses
/// decimals.
const LARGEST: f64 = 1e15;

/// Reads an integer or decimal number of at most ±[`LARGEST`].
pub(crate) fn number(problems: &mut Problems<'_>, value: Value<'_>) -> Option<Spanned<f64>> {
    let parsed = match value.get_ref() {
        DeValue::Float(f) => f.as_str().parse::<f64>().ok(),
        DeValue::Integer(i) => whole(i).map(|i| i as f64),
        _ => return wrong(problems, value, "a number"),
    };
    match parsed {
        Some(n) if n.abs() <= LARGEST => Some(Spanned::new(value.span(), n)),
        _ => wrong_range(problems, value, "a number from -1e15 to 1e15"),
    }
}

fn whole(i: &toml::de::DeInteger<'_>) -> Option<i64> {
    i64::from_str_radix(i.as_str(), i.radix()).ok()
}

fn wrong_range<T>(problems: &mut Problems<'_>, value: Value<'_>, wanted: &str) -> Option<T> {
    /// The maximum number of digits shown of a number.
    const SHOWN: usize = 24;
    let text = problems.text(&value.span());
    let cut = text.char_indices().nth(SHOWN).map(|(at, _)| at);
    let text = match cut {
        Some(at) => format!("{}…", &text[..at]),
        None => text.to_owned(),
    };
    problems.add(value.span(), format!("expected {wanted}, found {text}"));
    None
}

/// Reads an integer between `min` and `max`. Also accepts a string, because other tools print
/// identities so.
pub(crate) fn integer<T>(
    problems: &mut Problems<'_>,
    value: Value<'_>,
    min: T,
    max: T,
) -> Option<Spanned<T>>
where
    T: TryFrom<i64> + PartialOrd + std::fmt::Display + Copy,
{
    let parsed = match value.get_ref() {
        DeValue::Integer(i) => whole(i),
        DeValue::String(s) => unquoted(s),
        _ => return wrong(problems, value, "a whole number"),
    };
    match parsed.and_then(|n| T::try_from(n).ok()) {
        Some(n) if n >= min && n <= max => Some(Spanned::new(value.span(), n)),
        _ => wrong_range(
            problems,
            value,
            &format!("a whole number from {min} to {max}"),
        ),
    }
}

/// Parses `"0x6064"`, `"#x6064"` or `"24676"`.
pub(crate) fn unquoted(text: &str) -> Option<i64> {
    let text = text.trim();
    for prefix in ["0x", "0X", "#x"] {
        if let Some(hex) = text.strip_prefix(prefix) {
            return hex
                .bytes()
                .all(|b| b.is_ascii_hexdigit())
                .then(|| i64::from_str_radix(hex, 16).ok())?;
        }
    }
    text.parse().ok()
}

/// Reads a duration in ns.
pub(crate) fn duration(problems: &mut Problems<'_>, value: Value<'_>) -> Option<Spanned<u64>> {
    let text = match value.get_ref() {
        DeValue::String(s) => s,
        DeValue::Integer(_) | DeValue::Float(_) => {
            let number = problems.text(&value.span());
            let hint = format!("write \"{number}ms\" or \"{number}us\", with the quotes");
            problems.add_hint(value.span(), "a duration needs a unit", hint);
            return None;
        }
        _ => return wrong(problems, value, "a duration such as \"1ms\""),
    };
    match duration::parse(text) {
        Ok(ns) => Some(Spanned::new(value.span(), ns)),
        Err(e) => {
            let all = value.span();
            // Only within plain quotes the text's bytes equal the file's.
            let at = if all.len() == text.len() + 2 && !e.at.is_empty() {
                all.start + 1 + e.at.start..all.start + 1 + e.at.end
            } else {
                all
            };
            problems.add_hint(at, e.message, e.hint);
            None
        }
    }
}

pub(crate) fn table<'d>(
    problems: &mut Problems<'_>,
    value: Value<'d>,
    name: &'static str,
) -> Option<Fields<'d>> {
    match value.get_ref() {
        DeValue::Table(t) => Some(Fields::new(t, value.span(), name)),
        _ => wrong(problems, value, "a table"),
    }
}

/// Returns the elements of a list.
pub(crate) fn array<'d>(
    problems: &mut Problems<'_>,
    value: Value<'d>,
    wanted: &str,
) -> Option<Vec<Value<'d>>> {
    match value.get_ref() {
        DeValue::Array(a) => Some(a.iter().collect()),
        _ => wrong(problems, value, wanted),
    }
}
