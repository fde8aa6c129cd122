//! Checks that docs/machine-file.md and the parser have the same keys, with the same descriptions.

use std::collections::BTreeSet;
use std::path::Path;

use serde_json::Value as Json;

use super::schema;

fn is_key(word: &str) -> bool {
    let letter = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
    !word.is_empty() && word.chars().all(letter)
}

/// Adds the keys of all tables in a schema.
fn add_keys(schema: &Json, keys: &mut BTreeSet<String>) {
    match schema {
        Json::Object(fields) => {
            for (field, value) in fields {
                if field == "properties" {
                    let properties = value.as_object().into_iter().flatten();
                    keys.extend(properties.map(|(key, _)| key.clone()));
                }
                add_keys(value, keys);
            }
        }
        Json::Array(values) => values.iter().for_each(|value| add_keys(value, keys)),
        _ => {}
    }
}

fn known() -> BTreeSet<String> {
    let mut keys = BTreeSet::new();
    add_keys(&schema::machine_file(), &mut keys);
    keys
}

fn read(name: &str) -> String {
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs");
    std::fs::read_to_string(docs.join(name)).unwrap()
}

fn document() -> String {
    read("machine-file.md")
}

#[test]
fn document_lists_every_key() {
    // The table of quirks is in a document of its own.
    let (known, document) = (known(), document() + &read("drive.md"));
    assert!(known.len() > 130, "{known:?}");
    let there = |key: &str| {
        let shapes = [
            format!("`{key}`"),
            format!("`{key}."),
            format!(".{key}`"),
            format!("`{key} = "),
            format!("[{key}]"),
            format!(".{key}]"),
        ];
        shapes.iter().any(|shape| document.contains(shape))
    };
    let missing: Vec<_> = known.iter().filter(|key| !there(key)).collect();
    assert!(
        missing.is_empty(),
        "not in docs/machine-file.md: {missing:?}"
    );
}

/// The tables of the schema that a section of the document describes.
#[rustfmt::skip] // one row per section
const SECTIONS: [(&str, &str); 20] = [
    ("[bus]", "/properties/bus"),
    ("[[device]]", "/properties/device/items"),
    ("[device.axis]", "/definitions/axis"),
    ("Units", "/definitions/axis"),
    ("Limits", "/definitions/axis/properties/limits"),
    ("Loops", "/definitions/axis"),
    ("Supervision and stopping", "/definitions/axis"),
    ("Homing", "/definitions/axis/properties/homing"),
    ("Backlash and pitch error", "/definitions/axis"),
    ("Second encoder", "/definitions/axis"),
    ("[device.can]", "/properties/device/items/properties/can"),
    ("[[device.node]]", "/properties/device/items/properties/node/items"),
    ("[device.sim]", "/properties/device/items/properties/sim"),
    ("[[copy]]", "/properties/copy/items"),
    ("[[line_shaft]]", "/properties/line_shaft/items"),
    ("[stop]", "/properties/stop"),
    ("[override]", "/properties/override"),
    ("[server]", "/properties/server"),
    ("[eoe]", "/properties/eoe"),
    ("Ethernet of a device", "/properties/device/items/properties/eoe"),
];

/// Formats a row as the doc comment of the key.
fn description(kind: &str, default: &str, meaning: &str) -> String {
    let mut text = String::new();
    let mut letters = meaning.chars();
    if let Some(first) = letters.next() {
        text.extend(first.to_uppercase());
        text += letters.as_str();
        text.push(' ');
    }
    let default = match default {
        "" | "needed" => String::new(),
        default => format!("; default {default}"),
    };
    format!("{text}({kind}{default})")
}

#[test]
fn descriptions_of_the_schema_are_those_of_the_document() {
    let (schema, document) = (schema::machine_file(), document());
    let (mut section, mut rows) = (None, 0);
    let mut of_group = false;
    for line in document.lines() {
        if line.starts_with('#') {
            let heading = line.trim_start_matches('#').trim();
            section = SECTIONS.iter().find(|(known, _)| *known == heading);
            of_group = false;
        }
        of_group |= line.starts_with("| key of a group |");
        let cells: Vec<&str> = line.split(" | ").collect();
        let (Some((_, place)), [key, kind, default, meaning]) = (section, cells.as_slice()) else {
            continue;
        };
        let key = key
            .strip_prefix("| `")
            .and_then(|key| key.strip_suffix('`'));
        let Some(key) = key.filter(|key| key.split('.').all(is_key)) else {
            continue;
        };
        rows += 1;
        let group = if of_group {
            "/properties/group/items"
        } else {
            ""
        };
        let path = key.replace('.', "/properties/");
        let place = format!("{place}{group}/properties/{path}");
        let known = schema.pointer(&place);
        let known = known.unwrap_or_else(|| panic!("`{key}` is read nowhere: {line}"));
        let meaning = meaning.trim_end_matches('|').trim();
        assert_eq!(
            known["description"],
            description(kind.trim(), default.trim(), meaning)
        );
    }
    assert!(rows > 90, "{rows} keys in the document's tables");
}

/// Each quirk of the simulated drive is a row of docs/drive.md, and each row a quirk.
#[test]
fn document_lists_every_quirk_as_the_table_does() {
    let document = read("drive.md");
    let section = document.split("\n## Quirks\n").nth(1).unwrap_or_default();
    let section = section.split("\n## ").next().unwrap_or_default();
    let rows: Vec<&str> = section.lines().filter(|l| l.starts_with("| `")).collect();
    let row = |quirk: &ecaxis_sim::Quirk| {
        let mut letters = quirk.text.chars();
        let first = letters.next().map(|c| c.to_lowercase().to_string());
        let text = first.unwrap_or_default() + letters.as_str();
        let (kind, _) = quirk.value.describe();
        let objects = quirk.point.objects();
        format!("| `{}` | {kind} | {objects} | {text} |", quirk.key)
    };
    let table: Vec<String> = ecaxis_sim::Quirks::TABLE.iter().map(row).collect();
    assert_eq!(rows, table, "wanted:\n{}", table.join("\n"));
}

#[test]
fn every_property_has_a_description() {
    fn look(schema: &Json, path: &str, bare: &mut Vec<String>) {
        if let Some(properties) = schema["properties"].as_object() {
            for (key, value) in properties {
                let path = format!("{path}.{key}");
                if value["description"].as_str().is_none_or(str::is_empty) {
                    bare.push(path.clone());
                }
                look(value, &path, bare);
            }
        }
        let parts = ["items", "additionalProperties"].map(|part| &schema[part]);
        let choices = schema["anyOf"].as_array().into_iter().flatten();
        let all = parts.into_iter().chain(choices);
        for part in all.filter(|part| part.is_object()) {
            look(part, path, bare);
        }
    }
    let schema = schema::machine_file();
    let mut bare = Vec::new();
    look(&schema, "", &mut bare);
    for definition in ["axis", "step"] {
        look(&schema["definitions"][definition], definition, &mut bare);
    }
    assert!(bare.is_empty(), "{bare:?}");
}
