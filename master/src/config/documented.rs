//! Checks that docs/machine-file.md and the parser have the same keys.

use std::collections::BTreeSet;
use std::path::Path;

/// Text that precedes a key where a table is read.
const READERS: [&str; 5] = [".get(", ".need(", "number(", "&mut f,", "optional!(p, f,"];

fn is_key(word: &str) -> bool {
    let letter = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
    !word.is_empty() && word.chars().all(letter)
}

fn quoted(text: &str) -> Option<&str> {
    let (word, _) = text.trim_start().strip_prefix('"')?.split_once('"')?;
    is_key(word).then_some(word)
}

/// Returns the keys that a source file reads from tables.
fn keys(source: &str) -> BTreeSet<String> {
    let code = source.split("#[cfg(test)]").next().unwrap_or_default();
    let mut keys = BTreeSet::new();
    for reader in READERS {
        let asked = code.match_indices(reader);
        let asked = asked.filter_map(|(at, _)| quoted(&code[at + reader.len()..]));
        keys.extend(asked.map(str::to_owned));
    }
    // Keys in lists.
    for list in ["const VERBS", "const COMPANIONS"] {
        let Some((_, after)) = code.split_once(list) else {
            continue;
        };
        let (list, _) = after.split_once("];").unwrap_or_default();
        let (_, list) = list.split_once('=').unwrap_or_default();
        for line in list.split('(').flat_map(|part| part.split('[')) {
            keys.extend(quoted(line).map(str::to_owned));
        }
    }
    keys
}

fn known() -> BTreeSet<String> {
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/config");
    let raw = std::fs::read_dir(config.join("raw")).unwrap();
    let mut files: Vec<_> = raw.map(|entry| entry.unwrap().path()).collect();
    let own = ["sim.rs", "gateway.rs", "track.rs"];
    files.extend(
        own.map(|name| config.join(name))
            .into_iter()
            .filter(|f| f.exists()),
    );
    let sources = files
        .iter()
        .map(|file| std::fs::read_to_string(file).unwrap());
    sources.flat_map(|source| keys(&source)).collect()
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
