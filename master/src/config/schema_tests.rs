//! Holds the schema and the check of the machine file together: on every example, and on every
//! value of every example replaced by one of another type, and with an unknown key in every table.

use std::path::{Path, PathBuf};

use serde_json::{Map, Value as Json, json};

use super::super::fields::unquoted;
use super::super::{ConfigError, parse};
use super::{INTEGER, machine_file};

/// Validates a value against the keywords that the schema uses.
struct Validator(Json);

impl Validator {
    fn accepts(&self, schema: &Json, value: &Json) -> bool {
        let Some(rules) = schema.as_object() else {
            return schema.as_bool().expect("a schema");
        };
        rules
            .iter()
            .all(|(word, rule)| self.keeps(rules, word, rule, value))
    }

    fn keeps(&self, rules: &Map<String, Json>, word: &str, rule: &Json, value: &Json) -> bool {
        let choices = || rule.as_array().expect("a list").iter();
        let count = || rule.as_u64().expect("a count") as usize;
        let bound = || rule.as_f64().expect("a number");
        match word {
            "$schema" | "title" | "description" | "default" | "definitions" => true,
            // Durations are texts; their mistakes are not ones of the type.
            "pattern" if rule != INTEGER => true,
            "pattern" => value.as_str().is_none_or(|text| unquoted(text).is_some()),
            "$ref" => {
                let to = rule.as_str().and_then(|to| to.strip_prefix('#'));
                let to = to.and_then(|to| self.0.pointer(to));
                self.accepts(to.expect("a definition"), value)
            }
            "type" if rule.is_array() => choices().any(|kind| is_of(kind, value)),
            "type" => is_of(rule, value),
            "enum" => choices().any(|choice| choice == value),
            "allOf" => choices().all(|choice| self.accepts(choice, value)),
            "anyOf" => choices().any(|choice| self.accepts(choice, value)),
            "oneOf" => {
                choices()
                    .filter(|choice| self.accepts(choice, value))
                    .count()
                    == 1
            }
            "minimum" => value.as_f64().is_none_or(|value| value >= bound()),
            "maximum" => value.as_f64().is_none_or(|value| value <= bound()),
            "items" => {
                let mut items = value.as_array().into_iter().flatten();
                items.all(|item| self.accepts(rule, item))
            }
            "minItems" => value.as_array().is_none_or(|items| items.len() >= count()),
            "maxItems" => value.as_array().is_none_or(|items| items.len() <= count()),
            "minProperties" => value.as_object().is_none_or(|keys| keys.len() >= count()),
            "maxProperties" => value.as_object().is_none_or(|keys| keys.len() <= count()),
            "properties" => rule
                .as_object()
                .expect("a table")
                .iter()
                .all(|(key, schema)| {
                    value
                        .get(key)
                        .is_none_or(|value| self.accepts(schema, value))
                }),
            "additionalProperties" => {
                let known = rules.get("properties");
                let known = |key: &str| known.is_some_and(|known| known.get(key).is_some());
                let mut keys = value.as_object().into_iter().flatten();
                keys.all(|(key, value)| known(key) || self.accepts(rule, value))
            }
            "required" => {
                let there = |key: &Json| value.get(key.as_str().expect("a key")).is_some();
                !value.is_object() || choices().all(there)
            }
            "dependencies" => rule
                .as_object()
                .expect("a table")
                .iter()
                .all(|(key, schema)| value.get(key).is_none() || self.accepts(schema, value)),
            _ => panic!("the schema uses `{word}`, which this test does not know"),
        }
    }
}

fn is_of(kind: &Json, value: &Json) -> bool {
    match kind.as_str().expect("a type") {
        "object" => value.is_object(),
        "array" => value.is_array(),
        "string" => value.is_string(),
        "boolean" => value.is_boolean(),
        "number" => value.is_number(),
        "integer" => value.is_i64() || value.is_u64(),
        other => panic!("unknown type {other}"),
    }
}

fn configs() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs");
    let files = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let mut files: Vec<_> = files
        .filter(|path| path.extension() == Some("toml".as_ref()))
        .collect();
    files.sort();
    assert!(files.len() > 14, "{files:?}");
    files
}

fn read(path: &Path) -> Json {
    toml::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

/// The first messages of the check: of unknown keys, and of values of a wrong type.
fn is_wrong_type(message: &str) -> bool {
    message.starts_with("unknown key") || message.starts_with("expected ")
}

/// Returns `true` if the check rejects a document as the schema must.
///
/// The ESI files are absent: to read them for each change takes most of the time.
fn is_rejected(document: &Json) -> bool {
    let text = toml::to_string(document).expect("TOML");
    match parse(Path::new("/absent/machine.toml"), &text) {
        Err(ConfigError::Problems(problems)) => problems
            .iter()
            .any(|problem| is_wrong_type(&problem.message)),
        _ => false,
    }
}

#[test]
fn schema_accepts_every_example() {
    let validator = Validator(machine_file());
    for path in configs() {
        assert!(
            validator.accepts(&validator.0, &read(&path)),
            "{}",
            path.display()
        );
    }
}

/// Returns the places of all values, as JSON pointers.
fn places(value: &Json, place: &str, all: &mut Vec<String>) {
    let keys: Vec<String> = match value {
        Json::Object(keys) => keys.keys().cloned().collect(),
        Json::Array(items) => (0..items.len()).map(|n| n.to_string()).collect(),
        _ => Vec::new(),
    };
    for key in keys {
        let escaped = key.replace('~', "~0").replace('/', "~1");
        let place = format!("{place}/{escaped}");
        all.push(place.clone());
        let inner = match value {
            Json::Array(items) => &items[key.parse::<usize>().unwrap()],
            _ => &value[&key],
        };
        places(inner, &place, all);
    }
}

#[test]
fn schema_rejects_what_the_check_rejects_by_type_or_key() {
    let validator = Validator(machine_file());
    let (mut rejected, mut accepted, mut missed) = (0, 0, Vec::new());
    for path in configs() {
        let document = read(&path);
        let mut all = Vec::new();
        places(&document, "", &mut all);
        // Of many steps and devices of one file, the first ones have every key.
        all.truncate(120);
        for place in all {
            let values = [
                json!(true),
                json!(7),
                json!(1.5),
                json!("word"),
                json!([]),
                json!({}),
            ];
            let mut changes: Vec<Json> = values.to_vec();
            if let Some(table) = document.pointer(&place).filter(|value| value.is_object()) {
                let mut more = table.clone();
                more["unknown_key"] = json!(1);
                changes.push(more);
            }
            for change in changes {
                let mut changed = document.clone();
                *changed.pointer_mut(&place).expect("a place") = change.clone();
                let accepts = validator.accepts(&validator.0, &changed);
                if is_rejected(&changed) {
                    rejected += 1;
                    if accepts {
                        missed.push(format!("{} {place} = {change}", path.display()));
                    }
                } else if accepts {
                    accepted += 1;
                }
            }
        }
    }
    assert!(missed.is_empty(), "{missed:#?}");
    assert!(rejected > 3000 && accepted > 300, "{rejected} {accepted}");
}

/// What the check accepts, the schema accepts.
#[test]
fn schema_accepts_every_notation() {
    let validator = Validator(machine_file());
    let accepts = |place: &str, value: Json| {
        let schema = validator.0.pointer(place).expect("a place");
        validator.accepts(schema, &value)
    };
    let device = "/properties/device/items/properties";
    for (key, value) in [
        ("position", json!("0x10")),
        ("vendor", json!(0xfb)),
        ("pdo", json!({ "rx": ["0x6040", { "index": 0x607A }] })),
        (
            "sdo",
            json!([{ "index": "0x6065", "value": [1, 2] }, { "index": 1, "value": "a" }]),
        ),
        (
            "axis",
            json!([{ "encoder": 1, "limits": { "velocity": 1, "acceleration": 1 } }]),
        ),
    ] {
        assert!(accepts(&format!("{device}/{key}"), value), "{key}");
    }
    let spin = |value: Json| accepts("/properties/bus/properties/spin", value);
    assert!(spin(json!("auto")) && spin(json!(0)) && spin(json!("20us")));
    assert!(!spin(json!(1)) && !spin(json!(true)));
    let step = |value: Json| accepts("/definitions/step", value);
    assert!(step(json!({ "stop": true })) && step(json!({ "stop": "x" })));
    assert!(step(json!({ "repeat": 3, "step": [{ "dwell": "1s" }] })));
    assert!(step(json!({ "torque": { "t": 1 }, "ramp": "200ms" })));
    assert!(!step(json!({ "stop": false })) && !step(json!({})));
    assert!(!step(json!({ "dwell": "1s", "speed": 0.5 })));
    assert!(!step(json!({ "dwell": "1s", "stop": true })));
}

#[test]
fn defaults_are_values_of_their_keys() {
    fn look(validator: &Validator, schema: &Json, defaults: &mut usize) {
        if let Some(default) = schema.get("default") {
            *defaults += 1;
            assert!(validator.accepts(schema, default), "{schema}");
        }
        match schema {
            Json::Object(fields) => fields.values().for_each(|s| look(validator, s, defaults)),
            Json::Array(items) => items.iter().for_each(|s| look(validator, s, defaults)),
            _ => {}
        }
    }
    let validator = Validator(machine_file());
    let mut defaults = 0;
    look(&validator, &validator.0, &mut defaults);
    assert!(defaults > 25, "{defaults}");
}
