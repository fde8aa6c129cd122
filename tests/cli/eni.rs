//! `ecaxis eni`: machines as ENI files. The schema of the ETG and the recorded bring-up judge them.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::process::Command;

use ecaxis_test_support::program::{self, Ran};
use ecaxis_test_support::recordings::{self, FPWR};
use ecaxis_test_support::{
    assert_contains, assert_fits, assert_snapshot, fixture, load, recorded, root, run_well, skip,
    virtual_time,
};
use ecaxis_tools::eni::{self, Element};

fn eni(arguments: &[&str]) -> Ran {
    program::run([&["eni"], arguments].concat())
}

/// Returns the machine files of the project.
fn samples() -> Vec<PathBuf> {
    let folder = std::fs::read_dir(root().join("configs")).expect("our folder");
    let files = folder.map(|entry| entry.expect("an entry").path());
    let mut files: Vec<_> = files
        .filter(|path| path.extension().is_some_and(|e| e == "toml"))
        .collect();
    files.sort();
    assert!(files.len() > 15, "{files:?}");
    files
}

#[test]
fn exported_samples_validate_against_the_schema() {
    let Some(schema) = fixture("schema/beremiz/EtherCATConfig.xsd") else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    for file in samples() {
        let bus = folder.path().join("bus.xml");
        let output = bus.to_str().unwrap();
        let file = file.to_str().unwrap();
        eni(&[file, "-o", output, "--force"]).exits(0);
        let mut judge = Command::new("xmllint");
        let Ok(ran) = judge
            .arg("--noout")
            .arg("--schema")
            .args([&schema, &bus])
            .output()
        else {
            skip("no xmllint (libxml2-utils)");
            return;
        };
        let said = String::from_utf8_lossy(&ran.stderr);
        assert!(ran.status.success(), "{file}: {said}");
    }
}

/// Returns the elements at a path below a root.
fn all<'e>(root: &'e Element, path: &[&str]) -> Vec<&'e Element> {
    path.iter().fold(vec![root], |found, name| {
        let children = found.into_iter().flat_map(|element| &element.children);
        children.filter(|child| child.name == *name).collect()
    })
}

fn text<'e>(element: &'e Element, name: &str) -> &'e str {
    let found = element.children.iter().find(|child| child.name == name);
    found.map_or("", |child| &child.text)
}

fn is_configuration(register: u16) -> bool {
    // SyncManagers 2 and 3, FMMUs of the process data, watchdogs, cycle times and AssignActivate.
    // The mailbox status has an FMMU of its own, and no MainDevice knows the start time before.
    matches!(
        register,
        0x0400 | 0x0410 | 0x0420 | 0x0600 | 0x0610 | 0x0810 | 0x0818 | 0x0980 | 0x09a0 | 0x09a4
    )
}

/// The ENI writes to the registers of each device exactly what the bring-up of the same machine
/// sends, and its frames have the working counters of the cycle.
#[test]
fn exported_commands_are_those_of_the_bring_up() {
    let folder = tempfile::tempdir().unwrap();
    for (name, frames) in [("demo.toml", 1), ("terminals.toml", 1), ("mixed.toml", 1)] {
        let machine = load(name);
        let exported = eni::export(&machine).expect(name);
        let root = Element::parse(&exported.text).expect(name);
        let mut written = BTreeSet::new();
        for command in all(&root, &["Config", "Slave", "InitCmds", "InitCmd"]) {
            let number = |name| text(command, name).parse::<u16>().expect("a number");
            let upwards = all(command, &["Transition"]);
            if number("Cmd") == 5
                && upwards.iter().any(|t| t.text == "PS")
                && is_configuration(number("Ado"))
            {
                written.insert((
                    number("Adp"),
                    number("Ado"),
                    text(command, "Data").to_owned(),
                ));
            }
        }
        let (options, recording) = recorded(virtual_time(), folder.path());
        run_well(machine, options);
        let datagrams = recordings::datagrams(&recording);
        let sent: BTreeSet<_> = datagrams
            .iter()
            .filter(|d| d.sent && d.command == FPWR && is_configuration(d.register()))
            // Zeros switch off what runs, before and after.
            .filter(|d| d.data.len() > 1)
            .map(|d| {
                let data: String = d.data.iter().map(|byte| format!("{byte:02x}")).collect();
                (d.station(), d.register(), data)
            })
            .collect();
        assert!(sent.len() > 4, "{name}: {sent:?}");
        assert_eq!(written, sent, "{name}");
        let counters: BTreeSet<_> = datagrams
            .iter()
            .filter(|d| !d.sent && d.command == recordings::LRW)
            .map(|d| (d.address, d.data.len(), d.working_counter))
            .collect();
        let cyclic = all(&root, &["Config", "Cyclic", "Frame"]);
        assert_eq!(cyclic.len(), frames);
        let process_data: Vec<_> = all(&root, &["Config", "Cyclic", "Frame", "Cmd"]);
        let process_data = process_data.iter().filter(|cmd| text(cmd, "Cmd") == "12");
        let mut count = 0;
        for command in process_data {
            let number = |name| text(command, name).parse::<u32>().expect("a number");
            let expected = (
                number("Addr"),
                number("DataLength") as usize,
                number("Cnt") as u16,
            );
            assert!(
                counters.contains(&expected),
                "{name}: {expected:?} in {counters:?}"
            );
            count += 1;
        }
        assert!(count > 0, "{name}");
    }
}

#[test]
fn export_refuses_to_overwrite_and_reports_what_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("bus.xml");
    let output = output.to_str().unwrap();
    let ran = eni(&["configs/tool-changer.toml", "-o", output]).exits(0);
    assert_contains(
        &ran.err,
        &[
            "`drill`: optional here",
            "identification 11",
            "not part of an ENI",
        ],
    );
    eni(&["configs/demo.toml", "-o", output]).fails(2, &["exists already", "--force"]);
    let machine = std::fs::read_to_string(root().join("configs/copy.toml")).unwrap();
    let machine = ecaxis_test_support::with_our_esi(&machine);
    let short = folder.path().join("short.toml");
    std::fs::write(&short, machine.replace("\"1ms\"", "\"62.5us\"")).unwrap();
    eni(&[short.to_str().unwrap()]).fails(2, &["62500 ns", "whole microseconds"]);
}

/// `import` writes the machine that was exported, lists what is not sent, and the machine runs.
#[test]
fn imported_machine_passes_check_and_runs() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (bus, machine) = (path("bus.xml"), path("machine.toml"));
    for file in [
        "configs/copy.toml",
        "configs/terminals.toml",
        "configs/demo.toml",
    ] {
        eni(&[file, "-o", &bus, "--force"]).exits(0);
        let arguments = [
            "import",
            &bus,
            "-o",
            &machine,
            "--esi",
            "configs/esi",
            "--force",
        ];
        eni(&arguments).exits(0);
        program::run(["check", &machine]).exits(0);
        let run = ["run", &machine, "--sim", "--virtual", "--for", "200ms"];
        program::run(run).exits(0);
    }
    let text = std::fs::read_to_string(&machine).unwrap();
    assert!(!text.contains("device.axis]\n"), "{text}");
    let json = eni(&["import", &bus, "--esi", "configs/esi", "--json"])
        .exits(0)
        .json();
    assert_eq!(json["problems"], 0);
    let unsent = json["unsent"].as_array().unwrap();
    assert!(
        unsent
            .iter()
            .all(|u| u["reason"] == "Bootstrap is part of `ecaxis firmware`"),
        "{unsent:?}"
    );
    eni(&["import", &bus, "-o", &bus, "--force"]).fails(2, &["is the ENI file"]);
    eni(&["import", "configs/esi/EPOS4.xml"])
        .fails(2, &["EPOS4.xml:7:1:", "<EtherCATInfo>", "export it"]);
}

/// The recorded ENI of another tool: copies, SDOs and a changed register are kept or listed.
#[test]
fn changed_commands_are_listed_with_line_and_reason() {
    let folder = tempfile::tempdir().unwrap();
    let exported = eni::export(&load("copy.toml")).unwrap().text;
    // SyncManager 2 of the first device, another watchdog time, a register and a validation.
    let place = exported.find("<Comment>set SyncManager</Comment>").unwrap();
    let data = place + exported[place..].find("<Data>").unwrap() + 6;
    let mut changed = exported.clone();
    changed.replace_range(data..data + 2, "80");
    let added = "<InitCmds><InitCmd><Transition>PS</Transition><Cmd>5</Cmd><Adp>4096</Adp><Ado>#x0f10</Ado><Data>01</Data></InitCmd>\
        <InitCmd><Transition>PS</Transition><Cmd>4</Cmd><Adp>4096</Adp><Ado>#x0f18</Ado><Data>00</Data>\
        <Validate><Data>01</Data><Timeout>100</Timeout></Validate></InitCmd>\
        <InitCmd><Transition>IP</Transition><Cmd>2</Cmd><Adp>0</Adp><Ado>1282</Ado><Data>000104000000</Data></InitCmd>\
        <InitCmd><Transition>IP</Transition><Cmd>1</Cmd><Adp>0</Adp><Ado>1288</Ado><Data>00000000</Data>\
        <Validate><Data>07000000</Data><Timeout>100</Timeout></Validate></InitCmd>";
    let slave = changed.find("<Slave>").unwrap();
    let list = slave + changed[slave..].find("<InitCmds>").unwrap();
    changed.replace_range(list..list + 10, added);
    let bus = folder.path().join("bus.xml");
    std::fs::write(&bus, changed).unwrap();
    let bus = bus.to_str().unwrap();
    let json = eni(&["import", bus, "--esi", "configs/esi", "--json"])
        .exits(0)
        .json();
    let reasons: Vec<_> = json["unsent"]
        .as_array()
        .unwrap()
        .iter()
        .map(|unsent| unsent["reason"].as_str().unwrap())
        .collect();
    assert_eq!(reasons.len(), 4, "{json}");
    assert_contains(
        &reasons.join("; "),
        &[
            "ecaxis does not write this register",
            "does not wait for a value",
            "this word of the EEPROM",
            "ecaxis writes ",
        ],
    );
    let machine = json["machine"].as_str().unwrap();
    let copies = exported.matches("<CopyInfo>").count();
    assert!(copies > 1);
    assert_eq!(machine.matches("[[copy]]").count(), copies, "{machine}");
}

/// `compare` takes an ENI as what another tool expects of the bus.
#[test]
fn compare_takes_an_eni_as_the_expected_bus() {
    let folder = tempfile::tempdir().unwrap();
    let bus = folder.path().join("bus.xml");
    let bus = bus.to_str().unwrap();
    eni(&["configs/demo.toml", "-o", bus]).exits(0);
    let compare = |arguments: &[&str]| {
        program::run([&["compare", bus, "--esi", "configs/esi"], arguments].concat())
    };
    let same = compare(&["--sim", "configs/demo.toml"]).exits(0);
    assert_eq!(same.out, "as in the file\n");
    compare(&["--sim", "configs/copy.toml"])
        .fails(1, &["the bus is not as in", "export the file again"]);
    compare(&[]).fails(2, &["is an ENI file", "--nic"]);
    compare(&["--sim", "configs/demo.toml", "--apply"]).fails(2, &["is an ENI file", "eni import"]);
}

/// `scan --write` takes an ENI as the expected bus and writes its machine.
#[test]
fn scan_writes_the_machine_of_an_eni() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (bus, machine) = (path("bus.xml"), path("machine.toml"));
    eni(&["configs/demo.toml", "-o", &bus]).exits(0);
    let scan = |sim: &str, more: &[&str]| {
        let arguments = [
            "scan",
            "--sim",
            sim,
            "--write",
            &machine,
            "--esi",
            "configs/esi",
        ];
        program::run([&arguments, more].concat())
    };
    scan("configs/copy.toml", &["--eni", &bus])
        .fails(1, &["the bus is not as in", "export the file again"]);
    assert!(!folder.path().join("machine.toml").exists());
    scan("configs/demo.toml", &["--eni", &bus]).exits(0);
    program::run(["run", &machine, "--sim", "--virtual", "--for", "200ms"]).exits(0);
    scan("configs/demo.toml", &["--eni", &bus]).fails(2, &["is there already"]);
    scan("configs/demo.toml", &["--force", "--eni", &machine]).fails(2, &["is not an ENI file"]);
    let missing = path("missing.xml");
    scan("configs/demo.toml", &["--force", "--eni", &missing]).fails(2, &["cannot read"]);
}

/// The machine of a foreign ENI runs on the simulated bus.
#[test]
fn foreign_eni_runs_on_the_simulated_bus() {
    let (Some(bus), Some(esi)) = (
        fixture("eni/CherryECAT_CIA402_ENI.xml"),
        fixture("esi/hpmicro/ECAT_CIA402.xml"),
    ) else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let machine = folder.path().join("machine.toml");
    let machine = machine.to_str().unwrap();
    let [bus, esi] = [&bus, &esi].map(|path| path.to_str().unwrap());
    eni(&["import", bus, "--esi", esi, "-o", machine]).exits(0);
    program::run(["run", machine, "--sim", "--virtual", "--for", "500ms"]).exits(0);
}

/// Help texts and the list of commands match the reviewed snapshots.
#[test]
fn eni_output_matches_the_snapshots() {
    let folder = tempfile::tempdir().unwrap();
    let bus = folder.path().join("bus.xml");
    let path = bus.to_str().unwrap();
    eni(&["configs/demo.toml", "-o", path]).exits(0);
    for (name, arguments) in [
        ("help", &["--help"][..]),
        ("import-help", &["import", "--help"]),
        ("import-demo", &["import", path, "--esi", "configs/esi"]),
    ] {
        let ran = eni(arguments).exits(0);
        let now = format!("{}{}", ran.out, ran.err).replace(path, "bus.xml");
        assert_snapshot(&format!("eni/{name}.txt"), &now);
        if name != "import-demo" {
            assert_fits(&now);
        }
    }
}
