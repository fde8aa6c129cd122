//! `[[sub]]`: named steps with parameters. Before the file is read, each `call` gets a copy of the
//! steps with its own values, so that every check sees the numbers of every call.

use std::borrow::Cow;
use std::collections::BTreeSet;

use toml::Spanned;
use toml::de::{DeArray, DeTable, DeValue};

use super::fields::{Field, Key, Read, Table, TableKey, Value, Written};
use super::problem::{Problems, Span, list, suggestion};
use super::schema::{self, Schema};

/// The maximum number of steps after all calls are expanded.
pub(crate) const MOST_STEPS: usize = 10_000;
/// The most subprograms that call each other in a row.
const DEEPEST: usize = 8;

/// The keys of a step that contain steps.
const LISTS: [&str; 3] = ["step", "else", "parallel"];

table! { "[[sub]]",
    row RawSub {
        /// Name for `call` (text)
        name: Spanned<String> = "\"pick\"",
        /// Names of the numbers that a call gives, written `"$name"` in the steps (list of texts; default none)
        parameters: Key<Vec<String>>,
        /// The steps
        steps: Template as "step" = "[{ move = { x = \"$place\" } }]",
    }
}

/// Steps with parameters in place of values. Each call reads its own copy of them.
#[derive(Debug)]
pub(crate) struct Template;

impl Read for Template {
    fn read(value: Value<'_>, _: &str, p: &mut Problems<'_>) -> Option<Self> {
        match value.get_ref() {
            DeValue::Array(steps) if !steps.is_empty() => {}
            _ => p.add_hint(
                value.span(),
                "a subprogram is a list of steps",
                "write them below it under [[sub.step]]",
            ),
        }
        Some(Self)
    }
}

impl Field for Template {
    type Value = Self;

    fn of(_: Option<Self>) -> Option<Self> {
        Some(Self)
    }
}

impl Schema for Template {
    fn schema() -> serde_json::Value {
        serde_json::json!({ "type": "array", "items": { "type": "object" }, "minItems": 1 })
    }
}

/// A subprogram as written.
struct Sub<'d> {
    name: String,
    span: Span,
    parameters: Vec<Spanned<String>>,
    steps: DeArray<'d>,
    called: bool,
    /// A mistake in the steps has been reported.
    broken: bool,
}

/// Gives each `call` the steps of its subprogram.
pub(crate) fn expand<'d>(root: &mut DeTable<'d>, p: &mut Problems<'_>) {
    let before = p.count();
    let mut expansion = Expansion {
        subs: root.get("sub").map_or_else(Vec::new, |subs| read(subs, p)),
        running: Vec::new(),
        count: 0,
    };
    if let Some(DeValue::Array(steps)) = root.get_mut("step").map(Spanned::get_mut) {
        expansion.all(steps, p);
    }
    // The name of a call with a mistake may be meant.
    let unused = |sub: &&Sub<'_>| !sub.called && p.count() == before;
    let unused: Vec<_> = expansion.subs.iter().filter(unused).collect();
    for sub in unused {
        let hint = format!("call it, `call = \"{}\"`, or remove it", sub.name);
        let message = format!("no step calls the subprogram `{}`", sub.name);
        p.add_hint(sub.span.clone(), message, hint);
    }
}

/// Reads the well-formed subprograms. The others are reported with the rest of the file.
fn read<'d>(subs: &Spanned<DeValue<'d>>, p: &mut Problems<'_>) -> Vec<Sub<'d>> {
    let mut read: Vec<Sub<'d>> = Vec::new();
    let DeValue::Array(all) = subs.get_ref() else {
        return read;
    };
    for table in all.iter().filter_map(|sub| sub.get_ref().as_table()) {
        let (Some(name), Some(DeValue::Array(steps))) =
            (table.get("name"), table.get("step").map(Spanned::get_ref))
        else {
            continue;
        };
        let Some(word) = name.get_ref().as_str() else {
            continue;
        };
        if read.iter().any(|known| known.name == word) {
            let message = format!("`{word}` is the name of another subprogram already");
            p.add_hint(name.span(), message, "take another name");
            continue;
        }
        let parameters = table.get("parameters").map(Spanned::get_ref);
        let parameters = parameters.and_then(DeValue::as_array).map(|all| &**all);
        let parameters = parameters.unwrap_or_default().iter();
        let parameters: Vec<_> = parameters
            .filter_map(|word| {
                Some(Spanned::new(
                    word.span(),
                    word.get_ref().as_str()?.to_owned(),
                ))
            })
            .collect();
        let before = p.count();
        let mut used = BTreeSet::new();
        for step in steps.iter() {
            check(step, word, &parameters, &mut used, p);
        }
        for unused in parameters
            .iter()
            .filter(|name| !used.contains(name.get_ref()))
        {
            let name = unused.get_ref();
            let hint = format!("write `\"${name}\"` in a step, or remove it");
            let message = format!("no step of `{word}` uses its parameter `{name}`");
            p.add_hint(unused.span(), message, hint);
        }
        read.push(Sub {
            name: word.to_owned(),
            span: name.span(),
            parameters,
            steps: steps.clone(),
            called: false,
            broken: p.count() > before,
        });
    }
    read
}

/// Reports parameters that the subprogram does not have, and collects those used.
fn check(
    value: &Spanned<DeValue<'_>>,
    sub: &str,
    parameters: &[Spanned<String>],
    used: &mut BTreeSet<String>,
    p: &mut Problems<'_>,
) {
    let mut word = |text: &str, span: Span, p: &mut Problems<'_>| {
        let Some(name) = text.strip_prefix('$') else {
            return;
        };
        let known = parameters.iter().map(|known| known.get_ref().as_str());
        if known.clone().any(|known| known == name) {
            used.insert(name.to_owned());
        } else {
            let hint = match parameters {
                [] => format!("write `parameters = [\"{name}\"]` in [[sub]]"),
                _ => suggestion(name, known, "its parameters"),
            };
            p.add_hint(span, format!("`{sub}` has no parameter `{name}`"), hint);
        }
    };
    match value.get_ref() {
        DeValue::String(text) => word(text, value.span(), p),
        DeValue::Array(all) => {
            for value in all.iter() {
                check(value, sub, parameters, used, p);
            }
        }
        DeValue::Table(table) => {
            for key in table.keys() {
                word(key.get_ref(), key.span(), p);
            }
            for value in table.values() {
                check(value, sub, parameters, used, p);
            }
        }
        _ => {}
    }
}

struct Expansion<'d> {
    subs: Vec<Sub<'d>>,
    /// The subprograms that are being expanded.
    running: Vec<usize>,
    /// The number of steps so far.
    count: usize,
}

impl<'d> Expansion<'d> {
    fn all(&mut self, steps: &mut DeArray<'d>, p: &mut Problems<'_>) {
        for step in steps.iter_mut() {
            self.count += 1;
            let DeValue::Table(step) = step.get_mut() else {
                continue;
            };
            if let Some(call) = step.get("call").cloned() {
                self.call(step, &call, p);
            } else {
                for key in LISTS {
                    if let Some(DeValue::Array(inner)) = step.get_mut(key).map(Spanned::get_mut) {
                        self.all(inner, p);
                    }
                }
            }
        }
    }

    fn call(&mut self, step: &mut DeTable<'d>, call: &Spanned<DeValue<'d>>, p: &mut Problems<'_>) {
        // The steps of a call come from its subprogram only.
        if let Some((key, _)) = step.get_key_value("step") {
            let hint = "write the steps under [[sub.step]] of the subprogram";
            p.add_hint(key.span(), "`step` does not go with `call`", hint);
        }
        let key = Spanned::new(call.span(), Cow::Borrowed("step"));
        let steps = call
            .get_ref()
            .as_str()
            .and_then(|name| self.copy(name, call.span(), step.get("with"), p));
        let none = || DeValue::Array(DeArray::new());
        let steps = Spanned::new(call.span(), steps.map_or_else(none, DeValue::Array));
        step.insert(key, steps);
    }

    /// Returns the steps of a call. A mistake is reported.
    fn copy(
        &mut self,
        name: &str,
        at: Span,
        with: Option<&Spanned<DeValue<'d>>>,
        p: &mut Problems<'_>,
    ) -> Option<DeArray<'d>> {
        let Some(index) = self.subs.iter().position(|sub| sub.name == name) else {
            let names = self.subs.iter().map(|sub| sub.name.as_str());
            let hint = match self.subs.is_empty() {
                true => format!("write [[sub]] with `name = \"{name}\"` and its steps"),
                false => suggestion(name, names, "subprograms"),
            };
            p.add_hint(at, format!("no subprogram is named `{name}`"), hint);
            return None;
        };
        if self.running.contains(&index) {
            let names = self.running.iter().chain([&index]);
            let names: Vec<_> = names.map(|&sub| self.subs[sub].name.as_str()).collect();
            let message = format!("`{name}` calls itself: {}", names.join(" → "));
            let hint = "repeat steps with `repeat` or `while`";
            p.add_hint(at, message, hint);
            return None;
        }
        if self.running.len() >= DEEPEST {
            let message = format!("calls are nested more than {DEEPEST} deep");
            p.add_hint(at, message, "call fewer subprograms from each other");
            return None;
        }
        let sub = &mut self.subs[index];
        sub.called = true;
        if sub.broken {
            return None;
        }
        let none = DeTable::new();
        let given = match with.map(Spanned::get_ref) {
            None => &none,
            Some(DeValue::Table(given)) => given,
            Some(_) => {
                let hint = "write `with = { place = 5.0 }`";
                let at = with.map_or(0..0, Spanned::span);
                p.add_hint(at, "`with` is a table of parameters and their values", hint);
                return None;
            }
        };
        let known = || sub.parameters.iter().map(|known| known.get_ref().as_str());
        let before = p.count();
        for (key, value) in given {
            let word = key.get_ref();
            if matches!(value.get_ref(), DeValue::Array(_) | DeValue::Table(_)) {
                let message = format!("`{word}` stands for a number, true or false, or a name");
                p.add_hint(value.span(), message, "give it one value");
            }
            if !known().any(|known| known == word.as_ref()) {
                let message = format!("`{name}` has no parameter `{word}`");
                let hint = match sub.parameters.is_empty() {
                    true => "leave it out".to_owned(),
                    false => suggestion(word, known(), "its parameters"),
                };
                p.add_hint(key.span(), message, hint);
            }
        }
        let missing: Vec<_> = known()
            .filter(|known| !given.contains_key(*known))
            .collect();
        if !missing.is_empty() {
            let message = format!("`{name}` needs {}", list(missing.iter().copied()));
            let hint = format!("write `with = {{ {} = 5.0 }}`", missing.join(" = 5.0, "));
            p.add_hint(at.clone(), message, hint);
        }
        let mut steps = sub.steps.clone();
        for step in steps.iter_mut() {
            substitute(step, given, p);
        }
        if p.count() > before {
            return None;
        }
        if self.count + steps.len() > MOST_STEPS {
            let message =
                format!("a program has {MOST_STEPS} steps at most, those of its calls included");
            p.add_hint(at, message, "call it in a `repeat`, instead of often");
            return None;
        }
        self.running.push(index);
        self.all(&mut steps, p);
        self.running.pop();
        Some(steps)
    }
}

/// Puts the values of a call in place of the parameters.
fn substitute<'d>(value: &mut Spanned<DeValue<'d>>, given: &DeTable<'d>, p: &mut Problems<'_>) {
    let of = |text: &str| given.get(text.strip_prefix('$')?);
    match value.get_mut() {
        DeValue::String(text) => {
            if let Some(argument) = of(text) {
                *value = argument.clone();
            }
        }
        DeValue::Array(all) => {
            for value in all.iter_mut() {
                substitute(value, given, p);
            }
        }
        DeValue::Table(table) => {
            let mut replaced = DeTable::new();
            for (key, mut value) in std::mem::take(table) {
                substitute(&mut value, given, p);
                let key = match of(key.get_ref()) {
                    None => key,
                    Some(argument) => match argument.get_ref() {
                        DeValue::String(name) => Spanned::new(argument.span(), name.clone()),
                        _ => {
                            let message = format!("`{}` stands for a name", key.get_ref());
                            p.add_hint(argument.span(), message, "write a name in quotes: \"x\"");
                            key
                        }
                    },
                };
                if replaced.contains_key(&key) {
                    let message = format!("`{}` is there twice", key.get_ref());
                    p.add_hint(key.span(), message, "give each parameter another name");
                }
                replaced.insert(key, value);
            }
            *table = replaced;
        }
        _ => {}
    }
}
