//! The process data of every device of every recorded vendor file, for each choice in its ESI. The
//! snapshots in `snapshots/` are reviewed against the XML.
//!
//! `ECAXIS_UPDATE_SNAPSHOTS=1 cargo test -p ecaxis-esi --test main layouts` writes the snapshots
//! again. The difference then needs the same review. Snapshots contain only numbers: a device is
//! its identity and line, a module its identity, an OpMode or assignment its index in the file.

mod choices;
mod text;

use crate::common;
use std::path::{Path, PathBuf};

use ecaxis_esi::{EsiFile, SelectError, SelectOptions, Severity, lint, parse, select};

/// Files with more devices get one line with a digest per choice.
const MANY_DEVICES: usize = 12;
const UPDATE: &str = "ECAXIS_UPDATE_SNAPSHOTS";

fn snapshot_of(path: &Path) -> PathBuf {
    let slug: String = path
        .file_stem()
        .unwrap()
        .to_string_lossy()
        .chars()
        .map(|c| {
            if c.is_ascii_alphanumeric() {
                c.to_ascii_lowercase()
            } else {
                '-'
            }
        })
        .collect();
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/snapshots")
        .join(format!("{slug}.txt"))
}

#[test]
fn every_layout_matches_its_reviewed_snapshot() {
    let files = common::files("esi", &["xml"]);
    let update = std::env::var_os(UPDATE).is_some();
    let mut wrong = Vec::new();
    for path in &files {
        let file = parse(&std::fs::read(path).unwrap())
            .unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let now = choices::of_file(&file, file.devices.len() <= MANY_DEVICES);
        let kept = snapshot_of(path);
        if update {
            std::fs::create_dir_all(kept.parent().unwrap()).unwrap();
            std::fs::write(&kept, &now).unwrap();
            continue;
        }
        let before = std::fs::read_to_string(&kept).unwrap_or_default();
        if before != now {
            wrong.push(format!(
                "{}\n{}",
                kept.display(),
                text::difference(&before, &now)
            ));
        }
    }
    assert!(
        wrong.is_empty(),
        "layouts differ from the reviewed ones ({UPDATE}=1 takes the new ones):\n{}",
        wrong.join("\n")
    );
    if common::fixtures().is_some() {
        assert!(files.len() >= 30, "only {} files", files.len());
    }
}

/// A drive with SoE only is rejected with a reason, by the selection and by the lint of its file.
#[test]
fn soe_only_drives_are_rejected() {
    let Some(bytes) = common::read("esi/beckhoff/Beckhoff AX5xxx.xml") else {
        return;
    };
    let file: EsiFile = parse(&bytes).unwrap();
    assert_eq!(file.devices.len(), 147);
    for device in &file.devices {
        let error = select(&file, device, &SelectOptions::default()).unwrap_err();
        assert!(matches!(error, SelectError::SoeOnly { .. }), "{error}");
    }
    let findings = lint(&file);
    let refused = findings
        .iter()
        .filter(|f| f.severity == Severity::Error && f.message.contains("SoE"));
    let lines: Vec<u32> = refused.map(|f| f.position.line).collect();
    let devices: Vec<u32> = file.devices.iter().map(|d| d.position.line).collect();
    assert_eq!(lines, devices);
}
