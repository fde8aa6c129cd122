//! Locates recorded third-party files. They are not part of the repository.

#![allow(dead_code)]

use std::path::{Path, PathBuf};

/// Returns `ECAXIS_FIXTURES`, or `../shared/fixtures` next to the workspace. Prints a note if the
/// folder is missing; on CI this is a failure.
pub fn fixtures() -> Option<PathBuf> {
    let root = std::env::var_os("ECAXIS_FIXTURES").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/fixtures"),
        PathBuf::from,
    );
    if root.is_dir() {
        return Some(root);
    }
    assert!(
        std::env::var_os("CI").is_none(),
        "fixtures are missing at {}",
        root.display()
    );
    println!(
        "skipped: no fixtures at {} (set ECAXIS_FIXTURES)",
        root.display()
    );
    None
}

/// Returns the files of open projects, which are in a folder next to the fixtures.
pub fn vendor_files(folder: &str, extensions: &[&str]) -> Vec<PathBuf> {
    let found = files(&format!("../vendor-files/{folder}"), extensions);
    if fixtures().is_some() && found.is_empty() {
        let on_ci = std::env::var_os("CI").is_some();
        assert!(!on_ci, "no vendor-files/{folder} next to the fixtures");
        println!("skipped: no vendor-files/{folder} next to the fixtures (set ECAXIS_FIXTURES)");
    }
    found
}

pub fn files(folder: &str, extensions: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders: Vec<PathBuf> = fixtures()
        .map(|root| root.join(folder))
        .into_iter()
        .collect();
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
            } else if path
                .extension()
                .and_then(|e| e.to_str())
                .is_some_and(|e| extensions.contains(&e))
            {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

pub fn read(path: &str) -> Option<Vec<u8>> {
    let path = fixtures()?.join(path);
    Some(std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display())))
}

pub const EPOS4: &str = "esi/maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml";
