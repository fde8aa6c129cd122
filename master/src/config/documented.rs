//! Checks that docs/machine-file.md and the parser have the same keys.

use std::collections::BTreeSet;
use std::path::Path;

fn is_key(word: &str) -> bool {
    let letter = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
    !word.is_empty() && word.chars().all(letter)
}

fn quoted(text: &str) -> Option<&str> {
    let (word, _) = text.trim_start().strip_prefix('"')?.split_once('"')?;
    is_key(word).then_some(word)
}

/// Returns the keys of the tables and the list of verbs in a source file.
fn keys(source: &str) -> BTreeSet<String> {
    let code = source.split("#[cfg(test)]").next().unwrap_or_default();
    let mut keys = BTreeSet::new();
    for table in code.split("table! {").skip(1) {
        let (table, _) = table.split_once("\n}\n").unwrap_or_default();
        for line in table.lines().map(str::trim) {
            let field = line.split_once(": ").filter(|(name, _)| is_key(name));
            let renamed = line.split_once(" as ").and_then(|(_, rest)| quoted(rest));
            let key = renamed.or(field.map(|(name, _)| name));
            keys.extend(key.map(str::to_owned));
        }
    }
    for list in ["const VERBS", "const COMPANIONS"] {
        let Some((_, after)) = code.split_once(list) else {
            continue;
        };
        let (list, _) = after.split_once("];").unwrap_or_default();
        let (_, list) = list.split_once('=').unwrap_or_default();
        for word in list.split(['(', '[', ',']) {
            keys.extend(quoted(word).map(str::to_owned));
        }
    }
    keys
}

fn known() -> BTreeSet<String> {
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/config");
    let files = [
        "raw/mod.rs",
        "raw/axis.rs",
        "raw/step.rs",
        "gateway.rs",
        "travel.rs",
    ];
    let sources = files.map(|file| std::fs::read_to_string(config.join(file)).unwrap());
    sources.iter().flat_map(|source| keys(source)).collect()
}

fn document() -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/machine-file.md");
    std::fs::read_to_string(path).unwrap()
}

#[test]
fn document_lists_every_key() {
    let (known, document) = (known(), document());
    // The search itself must find keys of every file.
    for key in [
        "cycle",
        "encoder",
        "gear",
        "velocity",
        "move_by",
        "timeout",
        "cable",
        "heartbeat",
        "rx",
    ] {
        assert!(
            known.contains(key),
            "{key} is not found in the sources: {known:?}"
        );
    }
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

#[test]
fn parser_reads_every_documented_key() {
    let (known, document) = (known(), document());
    let mut rows = 0;
    for line in document.lines() {
        let cell = line
            .strip_prefix("| `")
            .and_then(|rest| rest.split_once("` |"));
        let Some((path, _)) = cell else { continue };
        if path.split('.').all(is_key) {
            rows += 1;
            for key in path.split('.') {
                assert!(known.contains(key), "`{key}` is read nowhere: {line}");
            }
        }
    }
    assert!(rows > 80, "{rows} keys in the document's tables");
}
