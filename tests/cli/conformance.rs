//! The tests that documents name exist.

use std::path::{Path, PathBuf};

use ecaxis_test_support::root;

/// Documents whose claims name tests as `binary::module::test`.
const DOCUMENTS: [&str; 2] = ["docs/conformance.md", "docs/stops.md"];

/// Returns the texts in backticks of all tables that are paths of at least three parts.
fn named_tests(document: &str) -> Vec<&str> {
    let rows = document.lines().filter(|line| line.starts_with('|'));
    let quoted = rows.flat_map(|row| row.split('`').skip(1).step_by(2));
    let part = |part: &str| {
        !part.is_empty() && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
    };
    quoted
        .filter(|text| text.split("::").count() >= 3 && text.split("::").all(part))
        .collect()
}

/// Returns the source files that may contain a module of a test binary or of a package.
fn sources(binary: &str, modules: &[&str]) -> Vec<PathBuf> {
    let tests = root().join("tests").join(binary);
    let package = root().join(binary);
    let folders = match tests.is_dir() {
        true => vec![tests],
        false => vec![package.join("src"), package.join("tests")],
    };
    let path: PathBuf = modules.iter().collect();
    // A module may be in its own file, or in that of its parent, as most `tests` are.
    let inner: PathBuf = modules
        .split_last()
        .map_or(&[][..], |(_, m)| m)
        .iter()
        .collect();
    let mut files = Vec::new();
    for folder in folders {
        for path in [&path, &inner] {
            if path.as_os_str().is_empty() {
                continue;
            }
            files.push(folder.join(path).with_extension("rs"));
            files.push(folder.join(path).join("mod.rs"));
        }
    }
    files
}

fn contains(file: &Path, test: &str) -> bool {
    let text = std::fs::read_to_string(file).unwrap_or_default();
    let Some((before, _)) = text.split_once(&format!("fn {test}(")) else {
        return false;
    };
    // Only attributes and comments are between the attribute and the function.
    let lines = before.trim_end().lines().rev();
    let mut attributes = lines.take_while(|line| {
        let line = line.trim_start();
        line.starts_with("#[") || line.starts_with("//")
    });
    attributes.any(|line| line.trim() == "#[test]")
}

fn exists(name: &str) -> bool {
    let parts: Vec<&str> = name.split("::").collect();
    let [binary, modules @ .., test] = parts.as_slice() else {
        return false;
    };
    sources(binary, modules)
        .iter()
        .any(|file| contains(file, test))
}

#[test]
fn every_test_that_a_document_names_exists() {
    for document in DOCUMENTS {
        let text = std::fs::read_to_string(root().join(document)).expect("the document");
        let named = named_tests(&text);
        assert!(named.len() >= 10, "{document}: {named:?}");
        let lost: Vec<_> = named.iter().filter(|name| !exists(name)).collect();
        assert!(
            lost.is_empty(),
            "{document} names tests that do not exist: {lost:#?}"
        );
    }
}

#[test]
fn a_name_without_a_test_is_found() {
    for (name, expected) in [
        ("cli::conformance::a_name_without_a_test_is_found", true),
        ("cli::conformance::exists", false),
        ("cli::conformance::no_such_test", false),
        ("cli::no_such_module::a_name_without_a_test_is_found", false),
        ("no_such_binary::conformance::exists", false),
        (
            "master::acyclic::topology::tests::parents_finds_lines_and_junctions",
            true,
        ),
    ] {
        assert_eq!(exists(name), expected, "{name}");
    }
}

/// Returns the cells of all table rows. The first and the last cell are empty.
fn rows(text: &str) -> Vec<Vec<&str>> {
    let rows = text.lines().filter(|line| line.starts_with("| "));
    rows.map(|row| row.split('|').map(str::trim).collect())
        .collect()
}

/// ETG.1500 1.0.2: what a MainDevice of Class A must have. The document claims the class, so each of
/// these features is there and tested. They contain those of Class B.
#[test]
fn every_mandatory_feature_of_class_a_is_tested() {
    const MANDATORY: [&str; 24] = [
        "103", "104", "105", "107", "201", "301", "302", "305", "401", "402", "404", "501", "502",
        "503", "504", "505", "601", "602", "701", "702", "703", "801", "1101", "1201",
    ];
    let text = std::fs::read_to_string(root().join("docs/conformance.md")).expect("the document");
    assert!(text.contains("claims Class A"));
    let rows = rows(&text);
    for feature in MANDATORY {
        let row = rows.iter().find(|row| row[1] == feature).expect("listed");
        let [class_a, ecaxis, tests] = [row[3], row[5], row[6]];
        assert!(class_a.starts_with("shall"), "{row:?}");
        assert!(ecaxis.starts_with("yes"), "{row:?}");
        assert!(!named_tests(&format!("|{tests}|")).is_empty(), "{row:?}");
    }
    // All other demands have a condition, which the row answers.
    for row in rows.iter().filter(|row| row.len() == 8) {
        for class in [row[3], row[4]] {
            let demanded = class.starts_with("shall") && !class.contains(" if ");
            assert!(!demanded || MANDATORY.contains(&row[1]), "{row:?}");
        }
    }
}

/// The features of ETG.1500 1.0.2 are listed once each, in order.
#[test]
fn conformance_lists_every_feature_of_the_directive() {
    const FEATURES: [u16; 40] = [
        101, 102, 103, 104, 105, 106, 107, 108, 201, 202, 203, 301, 302, 303, 304, 305, 401, 402,
        403, 404, 501, 502, 503, 504, 505, 506, 601, 602, 603, 701, 702, 703, 801, 901, 1001, 1101,
        1102, 1103, 1201, 1301,
    ];
    let text = std::fs::read_to_string(root().join("docs/conformance.md")).expect("the document");
    let rows = rows(&text);
    let numbers = rows
        .iter()
        .filter_map(|row| row.get(1)?.parse::<u16>().ok());
    assert_eq!(numbers.collect::<Vec<_>>(), FEATURES);
    // What is claimed is tested.
    for row in rows
        .iter()
        .filter(|row| row.len() == 8 && row[5].starts_with("yes"))
    {
        assert!(row[6].contains("::"), "{row:?}");
    }
}
