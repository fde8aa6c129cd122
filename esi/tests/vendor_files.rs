//! Every recorded vendor file can be read, and the drive we know best is read exactly.

#![allow(clippy::print_stdout)]

mod common;

use ecaxis_esi::parse;

#[test]
fn every_vendor_file_parses() {
    let files = common::files("esi", &["xml"]);
    for path in &files {
        let bytes = std::fs::read(path).unwrap();
        let file = parse(&bytes).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert!(!file.devices.is_empty(), "{}", path.display());
        for object in file.devices.iter().flat_map(|d| &d.dictionary.objects) {
            for item in &object.items {
                assert_eq!(
                    item.default.len(),
                    item.bit_len.div_ceil(8) as usize,
                    "{:04x}",
                    object.index
                );
            }
        }
        println!(
            "{}: {} devices, {} modules, {} objects, {} warnings",
            path.file_name().unwrap().to_string_lossy(),
            file.devices.len(),
            file.modules.len(),
            file.devices
                .iter()
                .map(|d| d.dictionary.objects.len())
                .sum::<usize>()
                + file
                    .modules
                    .iter()
                    .map(|m| m.dictionary.objects.len())
                    .sum::<usize>(),
            file.warnings.len(),
        );
        for warning in file.warnings.iter().take(4) {
            println!(
                "    {} {}: {}",
                warning.position, warning.path, warning.message
            );
        }
    }
    if common::fixtures().is_some() {
        assert!(files.len() >= 30, "only {} files", files.len());
    }
}

#[test]
fn every_bus_dump_parses() {
    for path in common::files("igh_xml", &["xml"]) {
        let file = parse(&std::fs::read(&path).unwrap())
            .unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert!(file.devices.len() >= 3, "{}", path.display());
    }
}
