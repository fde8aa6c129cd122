//! Typed tables of the machine file. `table!` declares a table once: its keys with their types,
//! ranges and examples. An invalid value becomes a problem and a `None`. Reading continues, so that
//! one check finds all problems.

use std::fmt::Display;
use std::ops::RangeInclusive;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::duration::{self, show};
use super::problem::{Problems, Span, list, suggestion};
use super::schema::{self, Schema};
use crate::text::nearest;

pub(crate) type Value<'d> = &'d Spanned<DeValue<'d>>;

/// The value of a key; `None` if it is absent or invalid.
pub(crate) type Key<T> = Option<Spanned<T>>;

/// A time in ns, written as a text such as `"250us"`. No key of the file is a plain `u64`.
pub(crate) type Ns = u64;

pub(crate) trait KeyExt<T> {
    fn value(&self) -> Option<T>
    where
        T: Copy;
    fn place(&self) -> Option<Span>;
}

impl<T> KeyExt<T> for Key<T> {
    fn value(&self) -> Option<T>
    where
        T: Copy,
    {
        self.as_ref().map(|v| *v.get_ref())
    }

    fn place(&self) -> Option<Span> {
        self.as_ref().map(Spanned::span)
    }
}

/// A type of values. `key` is for messages.
pub(crate) trait Read: Sized {
    /// What messages call a list of these values.
    const LIST: &'static str = "a list";

    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self>;
}

/// The permitted values of a key: a range, or words with their meanings.
pub(crate) trait Domain<T> {
    fn read(&self, value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<T>;

    fn schema(&self) -> serde_json::Value;
}

/// A type of fields in `table!`.
pub(crate) trait Field: Sized {
    type Value;

    /// Returns `None` if the whole table is unusable without this value.
    fn of(value: Option<Self::Value>) -> Option<Self>;
}

/// A key that may be absent.
impl<T> Field for Option<T> {
    type Value = T;

    fn of(value: Option<T>) -> Option<Self> {
        Some(value)
    }
}

/// A key without which the table is unusable.
impl<T> Field for Spanned<T> {
    type Value = Self;

    fn of(value: Option<Self>) -> Option<Self> {
        value
    }
}

/// A list that may be absent. Its invalid elements are skipped.
impl<T> Field for Vec<T> {
    type Value = Elements<T>;

    fn of(value: Option<Elements<T>>) -> Option<Self> {
        Some(value.map_or_else(Vec::new, |elements| elements.0))
    }
}

pub(crate) struct Elements<T>(pub Vec<T>);

impl<T: Read> Read for Elements<T> {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let elements = array(p, value, T::LIST)?.into_iter();
        Some(Self(elements.filter_map(|v| T::read(v, key, p)).collect()))
    }
}

/// A list of which every element is valid.
impl<T: Read> Read for Vec<T> {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let elements = array(p, value, T::LIST)?.into_iter();
        let read: Vec<Option<T>> = elements.map(|v| T::read(v, key, p)).collect();
        read.into_iter().collect()
    }
}

/// Declares a table: `key: type [domain] as "other key" = "example" ,`. A key with an example must
/// be there. A `table` without its key is empty; a `row` is part of a list. The doc comments are
/// the descriptions of the JSON schema: `meaning (type; default value)`, as in
/// docs/machine-file.md.
macro_rules! table {
    ($name:literal, $(#[$meta:meta])* table $table:ident $fields:tt) => {
        table!($name, $(#[$meta])* #[derive(Default)] row $table $fields);

        impl Field for $table {
            type Value = Self;

            fn of(value: Option<Self>) -> Option<Self> {
                Some(value.unwrap_or_default())
            }
        }
    };
    ($name:literal, $(#[$meta:meta])* row $table:ident {
        $($(#[doc = $doc:literal])* $field:ident: $type:ty $([$domain:expr])? $(as $key:literal)? $(= $example:literal)?,)*
    }) => {
        $(#[$meta])*
        #[derive(Debug)]
        #[allow(dead_code, reason = "`span` and `written` are not of interest in every table")]
        pub(crate) struct $table {
            pub span: Span,
            pub written: Written,
            $($(#[doc = $doc])* pub $field: $type,)*
        }

        impl $table {
            const KEYS: &[TableKey] = &[
                $((table!(@key $field $($key)?), table!(@example $($example)?))),*
            ];
        }

        impl Schema for $table {
            fn schema() -> serde_json::Value {
                schema::table([$((
                    (table!(@key $field $($key)?), table!(@example $($example)?)),
                    table!(@schema $type $(, $domain)?),
                    concat!($($doc),*),
                )),*])
            }
        }

        impl Read for $table {
            const LIST: &str = match $name.as_bytes() {
                [b'[', b'[', ..] => concat!($name, " with two brackets"),
                _ => "a list of tables",
            };

            fn read(value: Value<'_>, _: &str, p: &mut Problems<'_>) -> Option<Self> {
                let table = Table::of(value, $name, Self::KEYS, p)?;
                let written = table.written(p);
                $(
                    let key = table!(@key $field $($key)?);
                    let read = table
                        .get(key)
                        .and_then(|v| table!(@read $type, v, key, p $(, $domain)?));
                    let $field = <$type as Field>::of(read);
                )*
                table.done(p);
                Some(Self { span: value.span(), written, $($field: $field?,)* })
            }
        }
    };
    (@key $field:ident $key:literal) => { $key };
    (@key $field:ident) => { stringify!($field) };
    (@example $example:literal) => { Some($example) };
    (@example) => { None };
    (@schema $type:ty, $domain:expr) => { schema::domain::<$type, _>(&$domain) };
    (@schema $type:ty) => { <<$type as Field>::Value as Schema>::schema() };
    (@read $type:ty, $value:ident, $key:ident, $p:ident, $domain:expr) => {
        Domain::read(&$domain, $value, $key, $p).map(|v| Spanned::new($value.span(), v))
    };
    (@read $type:ty, $value:ident, $key:ident, $p:ident) => {
        <<$type as Field>::Value as Read>::read($value, $key, $p)
    };
}

/// The keys that a table has.
#[derive(Debug, Default, Clone)]
pub(crate) struct Written {
    /// The known keys, each with its line.
    pub keys: Vec<(&'static str, u32)>,
    /// `true` if there are unknown keys as well.
    pub unknown: bool,
}

impl Written {
    /// Returns `true` if the key is present, valid or not.
    pub fn has(&self, key: &str) -> bool {
        self.keys.iter().any(|(known, _)| *known == key)
    }
}

/// A key; if it must be there, with an example: a value, or whole lines.
pub(crate) type TableKey = (&'static str, Option<&'static str>);

/// One table while it is read.
pub(crate) struct Table<'d> {
    entries: &'d DeTable<'d>,
    span: Span,
    /// The table's name in messages: `[bus]`.
    name: &'static str,
    keys: &'d [TableKey],
}

impl<'d> Table<'d> {
    pub fn of(
        value: Value<'d>,
        name: &'static str,
        keys: &'d [TableKey],
        p: &mut Problems<'_>,
    ) -> Option<Self> {
        let DeValue::Table(entries) = value.get_ref() else {
            return wrong(p, value, "a table");
        };
        Some(Self {
            entries,
            span: value.span(),
            name,
            keys,
        })
    }

    pub fn get(&self, key: &str) -> Option<Value<'d>> {
        self.entries.get(key)
    }

    pub fn read<T: Read>(&self, key: &str, p: &mut Problems<'_>) -> Option<T> {
        T::read(self.get(key)?, key, p)
    }

    pub fn written(&self, p: &Problems<'_>) -> Written {
        let line = |(key, _): &TableKey| {
            let (written, _) = self.entries.get_key_value(*key)?;
            Some((*key, p.line(&written.span())))
        };
        let keys: Vec<_> = self.keys.iter().filter_map(line).collect();
        let unknown = keys.len() < self.entries.len();
        Written { keys, unknown }
    }

    /// Reports unknown keys, then missing ones. A missing key that an unknown one resembles is not
    /// reported.
    pub fn done(self, p: &mut Problems<'_>) {
        let mut meant = Vec::new();
        for key in self.entries.keys() {
            let word = key.get_ref().as_ref();
            let all = self.keys.iter().map(|(key, _)| *key);
            if all.clone().any(|known| known == word) {
                continue;
            }
            let free = all.clone().filter(|k| !self.entries.contains_key(*k));
            let hint = match nearest(word, free).or_else(|| nearest(word, all.clone())) {
                Some(k) => {
                    meant.push(k);
                    format!("did you mean `{k}`?")
                }
                None => format!("known keys: {}", list(all)),
            };
            let message = format!("unknown key `{word}` in {}", self.name);
            p.add_hint(key.span(), message, hint);
        }
        for (key, example) in self.keys {
            if let Some(example) = example
                && !self.entries.contains_key(*key)
                && !meant.contains(key)
            {
                let message = format!("`{key}` is missing in {}", self.name);
                let hint = match example.contains('\n') {
                    true => format!("add `{example}`"),
                    false => format!("add `{key} = {example}`"),
                };
                p.add_hint(self.span.clone(), message, hint);
            }
        }
    }
}

/// Reports a value of the wrong type.
pub(crate) fn wrong<T>(p: &mut Problems<'_>, value: Value<'_>, wanted: &str) -> Option<T> {
    let found = match value.get_ref() {
        DeValue::String(_) => "a string",
        DeValue::Integer(_) => "an integer",
        DeValue::Float(_) => "a number",
        DeValue::Boolean(_) => "true or false",
        DeValue::Datetime(_) => "a date",
        DeValue::Array(_) => "a list",
        DeValue::Table(_) => "a table",
    };
    let hint = match wanted {
        "a number" => "write a number, such as 5.0",
        "a whole number" => "write a number, such as 5",
        "a string" => "write a name or a text in quotes: \"…\"",
        "true or false" => "write `true` or `false`, without quotes",
        "a table" => "write keys and values in braces: `{ … }`",
        wanted if wanted.starts_with("a duration") => "write a number with its unit: \"500ms\"",
        wanted if wanted.starts_with("[[") => "write each one below its name in two brackets",
        _ => "write a list in brackets: `[ … ]`",
    };
    let message = format!("expected {wanted}, found {found}");
    p.add_hint(value.span(), message, hint);
    None
}

fn wrong_range<T>(p: &mut Problems<'_>, value: Value<'_>, wanted: &str) -> Option<T> {
    /// The maximum number of digits shown of a number.
    const SHOWN: usize = 24;
    let text = p.text(&value.span());
    let text = match text.char_indices().nth(SHOWN) {
        Some((at, _)) => format!("{}…", &text[..at]),
        None => text.to_owned(),
    };
    let message = format!("expected {wanted}, found {text}");
    p.add_hint(value.span(), message, "write a number within this range");
    None
}

/// Returns the elements of a list.
pub(crate) fn array<'d>(
    p: &mut Problems<'_>,
    value: Value<'d>,
    wanted: &str,
) -> Option<Vec<Value<'d>>> {
    match value.get_ref() {
        DeValue::Array(a) => Some(a.iter().collect()),
        _ => wrong(p, value, wanted),
    }
}

impl<T: Read> Read for Spanned<T> {
    const LIST: &'static str = T::LIST;

    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        Some(Self::new(value.span(), T::read(value, key, p)?))
    }
}

impl Read for String {
    const LIST: &'static str = "a list of names";

    fn read(value: Value<'_>, _: &str, p: &mut Problems<'_>) -> Option<Self> {
        match value.get_ref() {
            DeValue::String(s) => Some(s.to_string()),
            _ => wrong(p, value, "a string"),
        }
    }
}

impl Read for bool {
    fn read(value: Value<'_>, _: &str, p: &mut Problems<'_>) -> Option<Self> {
        match value.get_ref() {
            DeValue::Boolean(b) => Some(*b),
            _ => wrong(p, value, "true or false"),
        }
    }
}

/// The maximum absolute number. Beyond it, axes and tables reject positions, and `f64` loses
/// decimals.
pub(crate) const LARGEST: f64 = 1e15;

/// An integer or decimal number of at most ±[`LARGEST`].
impl Read for f64 {
    fn read(value: Value<'_>, _: &str, p: &mut Problems<'_>) -> Option<Self> {
        let parsed = match value.get_ref() {
            DeValue::Float(f) => f.as_str().parse().ok(),
            DeValue::Integer(i) => whole(i).map(|i| i as f64),
            _ => return wrong(p, value, "a number"),
        };
        match parsed.filter(|n: &f64| n.abs() <= LARGEST) {
            None => wrong_range(p, value, "a number from -1e15 to 1e15"),
            number => number,
        }
    }
}

impl Read for [f64; 2] {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let ends = array(p, value, "a list of two positions")?;
        let [low, high] = ends.as_slice() else {
            let example = format!("write `{key} = [10.0, 10.5]`");
            p.add_hint(value.span(), format!("`{key}` has two ends"), example);
            return None;
        };
        let [low, high] = [low, high].map(|end| f64::read(end, key, p));
        Some([low?, high?])
    }
}

fn whole(i: &toml::de::DeInteger<'_>) -> Option<i64> {
    i64::from_str_radix(i.as_str(), i.radix()).ok()
}

/// Reads an integer in `range`. Also accepts a string, because other tools print identities so.
fn integer<T>(value: Value<'_>, range: &RangeInclusive<T>, p: &mut Problems<'_>) -> Option<T>
where
    T: TryFrom<i64> + PartialOrd + Display,
{
    let parsed = match value.get_ref() {
        DeValue::Integer(i) => whole(i),
        DeValue::String(s) => unquoted(s),
        _ => return wrong(p, value, "a whole number"),
    };
    let parsed = parsed.and_then(|n| T::try_from(n).ok());
    match parsed.filter(|n| range.contains(n)) {
        None => {
            let wanted = format!("a whole number from {} to {}", range.start(), range.end());
            wrong_range(p, value, &wanted)
        }
        number => number,
    }
}

macro_rules! integers {
    ($($type:ty),*) => {$(
        impl Read for $type {
            fn read(value: Value<'_>, _: &str, p: &mut Problems<'_>) -> Option<Self> {
                integer(value, &(Self::MIN..=Self::MAX), p)
            }
        }

        /// A key without which the table is unusable.
        impl Field for $type {
            type Value = Spanned<Self>;

            fn of(value: Option<Spanned<Self>>) -> Option<Self> {
                value.map(Spanned::into_inner)
            }
        }

        impl Domain<$type> for RangeInclusive<$type> {
            fn read(&self, value: Value<'_>, _: &str, p: &mut Problems<'_>) -> Option<$type> {
                integer(value, self, p)
            }

            fn schema(&self) -> serde_json::Value {
                schema::integer(*self.start(), *self.end())
            }
        }

        impl Schema for $type {
            fn schema() -> serde_json::Value {
                schema::integer(Self::MIN, Self::MAX)
            }
        }
    )*};
}

integers!(u8, u16, u32, i8, i64);

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

impl Read for Ns {
    fn read(value: Value<'_>, _: &str, p: &mut Problems<'_>) -> Option<Self> {
        let text = match value.get_ref() {
            DeValue::String(s) => s,
            DeValue::Integer(_) | DeValue::Float(_) => {
                let number = p.text(&value.span());
                let hint = format!("write \"{number}ms\" or \"{number}us\", with the quotes");
                p.add_hint(value.span(), "a duration needs a unit", hint);
                return None;
            }
            _ => return wrong(p, value, "a duration such as \"1ms\""),
        };
        let parsed = duration::parse(text).map_err(|e| {
            let all = value.span();
            // Only within plain quotes the text's bytes equal the file's.
            let at = if all.len() == text.len() + 2 && !e.at.is_empty() {
                all.start + 1 + e.at.start..all.start + 1 + e.at.end
            } else {
                all
            };
            p.add_hint(at, e.message, e.hint);
        });
        parsed.ok()
    }
}

impl Domain<Ns> for RangeInclusive<Ns> {
    fn read(&self, value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Ns> {
        let ns = Ns::read(value, key, p)?;
        if self.contains(&ns) {
            return Some(ns);
        }
        let [ns, low, high] = [ns, *self.start(), *self.end()].map(show);
        let message = format!("`{key}` of {ns} is not possible");
        p.add_hint(
            value.span(),
            message,
            format!("it must be from {low} to {high}"),
        );
        None
    }

    fn schema(&self) -> serde_json::Value {
        Ns::schema()
    }
}

/// Words with their meanings.
impl<T: Copy, const N: usize> Domain<T> for [(&'static str, T); N] {
    fn read(&self, value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<T> {
        let word = String::read(value, key, p)?;
        let known = self.iter().find(|(name, _)| *name == word);
        if known.is_none() {
            let message = format!("`{key}` cannot be \"{word}\"");
            let names = self.iter().map(|(name, _)| *name);
            p.add_hint(value.span(), message, suggestion(&word, names, "there are"));
        }
        known.map(|(_, meaning)| *meaning)
    }

    fn schema(&self) -> serde_json::Value {
        schema::words(self.iter().map(|(word, _)| *word))
    }
}

/// Texts that a later check reads, with messages of its own.
impl<const N: usize> Domain<String> for [&'static str; N] {
    fn read(&self, value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<String> {
        String::read(value, key, p)
    }

    fn schema(&self) -> serde_json::Value {
        schema::words(*self)
    }
}
