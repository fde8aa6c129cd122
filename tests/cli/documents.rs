//! The links of the documents, and the order of the book.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use ecaxis_test_support::root;

/// Returns the documents: those of the root, and all below `docs`.
fn documents() -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![root().join("docs")];
    let markdown = |path: &PathBuf| path.extension() == Some("md".as_ref());
    let entries = |folder: &Path| -> Vec<PathBuf> {
        let entries = std::fs::read_dir(folder).expect("a folder");
        entries
            .map(|entry| entry.expect("an entry").path())
            .collect()
    };
    found.extend(entries(&root()).into_iter().filter(markdown));
    while let Some(folder) = folders.pop() {
        let (below, files): (Vec<_>, Vec<_>) =
            entries(&folder).into_iter().partition(|p| p.is_dir());
        folders.extend(below);
        found.extend(files.into_iter().filter(markdown));
    }
    found.sort();
    found
}

/// Returns the lines outside code blocks.
fn prose(text: &str) -> impl Iterator<Item = &str> {
    let mut code = false;
    text.lines().filter(move |line| {
        let fence = line.trim_start().starts_with("```");
        code ^= fence;
        !fence && !code
    })
}

/// Returns the targets of the links in a line, without those in code.
fn links(line: &str) -> Vec<String> {
    let parts = line.split('`').enumerate();
    let plain: String = parts
        .filter(|(n, _)| n % 2 == 0)
        .map(|(_, part)| part)
        .collect();
    let after = plain.split("](").skip(1);
    after
        .filter_map(|rest| Some(rest.split_once(')')?.0.to_owned()))
        .collect()
}

/// Returns the anchor of a heading, as GitHub and mdBook make it.
fn anchor(heading: &str) -> String {
    let kept = heading.trim().chars().filter_map(|c| match c {
        ' ' => Some('-'),
        c if c.is_alphanumeric() || c == '-' || c == '_' => Some(c),
        _ => None,
    });
    kept.collect::<String>().to_lowercase()
}

fn anchors(file: &Path) -> BTreeSet<String> {
    let text = std::fs::read_to_string(file).expect("a document");
    let headings = prose(&text).filter(|line| line.starts_with('#'));
    headings
        .map(|line| anchor(line.trim_start_matches('#')))
        .collect()
}

#[test]
fn every_relative_link_leads_to_a_file_and_a_heading() {
    let (mut checked, mut broken) = (0, Vec::new());
    for document in documents() {
        let text = std::fs::read_to_string(&document).expect("a document");
        for link in prose(&text)
            .flat_map(links)
            .filter(|link| !link.contains("://"))
        {
            checked += 1;
            let (file, heading) = link.split_once('#').unwrap_or((&link, ""));
            let target = match file {
                "" => document.clone(),
                file => document.with_file_name(file),
            };
            let there =
                target.exists() && (heading.is_empty() || anchors(&target).contains(heading));
            if !there {
                broken.push(format!("{}: {link}", document.display()));
            }
        }
    }
    assert!(checked > 100, "{checked} links");
    assert!(broken.is_empty(), "{broken:#?}");
}

#[test]
fn anchors_are_those_of_the_headings() {
    assert_eq!(
        anchor(" `[[device]]` and *more*, twice"),
        "device-and-more-twice"
    );
    assert_eq!(links("[a](b.md#c), `[d](e)` and [f](g)"), ["b.md#c", "g"]);
}

#[test]
fn every_document_has_its_place_in_the_book() {
    let docs = root().join("docs");
    let summary = std::fs::read_to_string(docs.join("SUMMARY.md")).expect("a document");
    let listed: Vec<PathBuf> = summary
        .lines()
        .flat_map(links)
        .map(|link| docs.join(link))
        .collect();
    let all: Vec<_> = documents()
        .into_iter()
        .filter(|path| path.starts_with(&docs))
        .collect();
    for document in all.iter().filter(|path| !path.ends_with("SUMMARY.md")) {
        let places = listed.iter().filter(|path| *path == document).count();
        assert_eq!(places, 1, "{} in docs/SUMMARY.md", document.display());
    }
}
