//! `ecaxis esi …` from the user's view: the output of each verb for the project's files, and error
//! messages.
//!
//! `ECAXIS_UPDATE_SNAPSHOTS=1` writes `tests/snapshots/esi` again; review the difference.

use std::path::Path;

use ecaxis_test_support::program::{self, Ran};
use ecaxis_test_support::{assert_snapshot, fixture, root};
use serde_json::Value;

fn esi(arguments: &[&str]) -> Ran {
    program::run([&["esi"], arguments].concat())
}

/// Returns exit code, standard output and standard error.
fn ran(arguments: &[&str]) -> (i32, String, String) {
    let ran = esi(arguments);
    (ran.code, ran.out, ran.err)
}

#[track_caller]
fn json(arguments: &[&str], expected: i32) -> Value {
    esi(arguments).exits(expected).json()
}

#[track_caller]
fn refused(arguments: &[&str], parts: &[&str]) {
    let ran = esi(arguments);
    assert_eq!(ran.out, "", "{arguments:?}");
    ran.fails(2, parts);
}

const EPOS4: &str = "configs/esi/EPOS4.xml";
const TERMINALS: &str = "configs/esi/terminals.xml";

/// The whole output matches the reviewed snapshots.
#[test]
fn esi_output_matches_the_snapshots() {
    for (name, arguments) in [
        ("list", &["list", "configs/esi"][..]),
        ("show-epos4", &["show", EPOS4]),
        (
            "show-epos4-cst",
            &["show", EPOS4, "--mode", "cst", "--cycle", "2ms"],
        ),
        ("show-terminals", &["show", TERMINALS]),
        ("show-di8", &["show", TERMINALS, "--device", "DI8"]),
        ("show-io8", &["show", "configs/esi/IO8.xml"]),
        ("objects-idx", &["objects", "configs/esi/IDX.xml"]),
        ("check-gateway", &["check", "configs/esi/gateway.xml"]),
    ] {
        let (code, out, err) = ran(arguments);
        assert_eq!(code, 0, "{arguments:?}: {err}");
        let now = format!("$ ecaxis esi {}\n{out}{err}", arguments.join(" "));
        assert_snapshot(&format!("esi/{name}.txt"), &now);
    }
}

#[test]
fn esi_json_works_for_every_verb_and_own_file() {
    for file in ["EPOS4", "IDX", "IO8", "gateway", "terminals"] {
        let path = format!("configs/esi/{file}.xml");
        let shown = json(&["show", &path, "--json"], 0);
        assert!(shown.is_object(), "{shown}");
        let checked = json(&["check", &path, "--json"], 0);
        assert_eq!(checked["ok"], true, "{checked}");
        let listed = json(&["list", &path, "--json"], 0);
        assert!(!listed.as_array().expect("a list").is_empty());
    }
    let objects = json(&["objects", EPOS4, "--json"], 0);
    let objects = objects.as_array().expect("a list");
    let known = |index: u64, sub: u64| {
        let mut all = objects.iter();
        all.any(|o| o["index"] == index && o["sub"] == sub)
    };
    assert!(known(0x6040, 0) && known(0x1018, 4) && !known(0x6040, 1));
}

#[test]
fn esi_compares_an_image_with_its_changed_copy() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let image = folder.path().join("an image.bin");
    let path = image.to_str().expect("UTF-8");
    let (code, _, err) = ran(&["sii", EPOS4, "-o", path]);
    assert_eq!(code, 0, "{err}");
    let (code, out, err) = ran(&["diff", EPOS4, path]);
    assert_eq!((code, out.as_str()), (0, ""), "{err}");

    let mut bytes = std::fs::read(&image).expect("written");
    // Product code, word 0x000a of the header.
    bytes[20] ^= 1;
    std::fs::write(&image, &bytes).expect("written");
    let (code, out, err) = ran(&["diff", EPOS4, path]);
    assert_eq!(code, 1, "{err}");
    assert!(out.contains("product") && out.contains("identity"), "{out}");
    let found = json(&["diff", EPOS4, path, "--json"], 1);
    assert_eq!(found["differences"].as_array().map(Vec::len), Some(1));

    std::fs::write(&image, &bytes[..100]).expect("written");
    refused(&["diff", EPOS4, path], &["100 bytes", "128"]);
    refused(&["sii", EPOS4, "-o", "/nowhere/x.bin"], &["/nowhere/x.bin"]);
}

#[test]
fn esi_rejects_unreadable_files() {
    for verb in ["list", "show", "check", "objects"] {
        refused(&[verb, "nothere.xml"], &["cannot read nothere.xml"]);
        refused(&[verb], &["Usage"]);
    }
    for verb in ["show", "check", "objects"] {
        refused(&[verb, "configs"], &["cannot read configs: is a directory"]);
        refused(&[verb, "Cargo.toml"], &["Cargo.toml:1:1", "help"]);
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let cut = folder.path().join("half a file.xml");
    let whole = std::fs::read(root().join(EPOS4)).expect("our ESI");
    std::fs::write(&cut, &whole[..whole.len() / 2]).expect("written");
    let path = cut.to_str().expect("UTF-8");
    refused(
        &["check", path],
        &["half a file.xml:", "not complete", "EtherCATInfo/"],
    );
}

#[test]
fn esi_selects_a_device_by_its_options() {
    refused(
        &["objects", TERMINALS],
        &["describes 7 devices", "--device", "esi list"],
    );
    refused(
        &["show", TERMINALS, "--device", "DI9"],
        &["did you mean `DI8`?"],
    );
    refused(
        &["show", EPOS4, "--mode", "hm"],
        &["no mode hm", "csp (module \"CSP\")"],
    );
    refused(&["show", EPOS4, "--dc", "nope"], &["no DC mode \"nope\""]);
    for which in [
        ["--device", "2"],
        ["--device", "0x44490008"],
        ["--product", "0x44490008"],
    ] {
        let shown = json(&[&["show", TERMINALS, "--json"], &which[..]].concat(), 0);
        assert_eq!(shown["type"], "DI8", "{which:?}: {shown}");
    }
}

/// A finding names the file that contains the problem and its path in that file.
#[test]
fn findings_of_modules_name_the_referenced_file() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).expect("written");
        path.to_str().expect("UTF-8").to_owned()
    };
    write(
        "Modules.xml",
        "<EtherCATModule><Modules>\n\
         <Module><Type ModuleIdent='1'>A</Type><Name>A</Name>\n\
         <RxPdo><Index>#x1600</Index><Exclude>#x1600</Exclude><Name>P</Name></RxPdo></Module>\n\
         <Module><Type ModuleIdent='2'>B</Type><Name>B</Name></Module>\n\
         </Modules></EtherCATModule>",
    );
    let file = write(
        "a device.xml",
        "<EtherCATInfo><InfoReference>modules.XML</InfoReference><Vendor><Id>1</Id></Vendor>\n\
         <Descriptions><Devices><Device><Type ProductCode='1'>D</Type>\n\
         <Slots><Slot MinInstances='1' MaxInstances='1'><Name>S</Name>\n\
         <ModuleIdent>1</ModuleIdent><ModuleIdent>2</ModuleIdent></Slot></Slots></Device></Devices></Descriptions></EtherCATInfo>",
    );
    let (code, out, err) = ran(&["check", &file]);
    assert_eq!(code, 0, "{out}{err}");
    let lines: Vec<&str> = out.lines().collect();
    let device = "a device.xml:2:24: note: EtherCATInfo/Descriptions/Devices/Device[1]: ";
    let module = "modules.XML:3:1: warning: EtherCATModule/Modules/Module[1]/RxPdo[1]: ";
    assert_eq!(lines.len(), 2, "{out}");
    assert!(lines[0].contains(device), "{out}");
    assert!(lines[1].contains(module), "{out}");
    assert!(err.contains("1 warning, 1 note"), "{err}");
    let found = json(&["check", &file, "--json"], 0);
    assert_eq!(found["findings"][1]["file"], "modules.XML");
}

/// File names with spaces are accepted. The vendor files' contents are not stored in snapshots.
#[test]
fn esi_reads_vendor_files() {
    let Some(folder) = fixture("esi") else { return };
    let one = |path: &str| folder.join(path).to_str().expect("UTF-8").to_owned();
    let inputs = one("beckhoff/Beckhoff EL1xxx.xml");
    let (code, out, err) = ran(&["show", &inputs]);
    assert_eq!(code, 0, "{err}");
    assert!(out.contains("155 devices"), "{out}");
    refused(&["objects", &inputs], &["155 devices"]);

    // Two clock modes of this device have the same name; their descriptions differ.
    let device = ["--device", "EL1262", "--revision", "0x30000"];
    let (_, out, _) = ran(&[&["show", &inputs], &device[..]].concat());
    let named: Vec<&str> = out.lines().filter(|l| l.starts_with("  DcSync ")).collect();
    assert!(named.len() == 2 && named[0] != named[1], "{out}");

    let drives = one("beckhoff/Beckhoff AX5xxx.xml");
    let (code, out, _) = ran(&["check", &drives]);
    assert_eq!(code, 0, "{out}");
    let listed = json(&["list", folder.to_str().expect("UTF-8"), "--json"], 0);
    assert!(listed.as_array().expect("a list").len() > 300);
    let name = |entry: &Value| Path::new(entry["file"].as_str().unwrap_or("")).is_relative();
    assert!(listed.as_array().expect("a list").iter().all(name));
}
