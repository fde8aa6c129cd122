//! Machines → ENI → machines, files of other tools, and damaged files.

#![allow(clippy::print_stdout, reason = "the tests count what they compare")]

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use ecaxis_ecat::mailbox::eoe::MacFilter;
use ecaxis_esi as esi;
use ecaxis_master::config::{self, Machine};
use ecaxis_master::esi_library::Library;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::{fixture, root};
use proptest::prelude::*;

use super::import::Import;
use super::*;

fn import_with(bytes: &[u8], esi: &Path) -> Import {
    let library = match esi.is_dir() {
        true => Library::open(esi, None),
        false => Library::of_file(esi),
    };
    let library = library.expect("a library");
    let path = root().join("configs/imported.toml");
    import(bytes, Some(&library), &path, "sim").unwrap_or_else(|e| panic!("{e}"))
}

/// Object, first bit and length.
type Place = (u16, u8, u32, u16);

/// Returns the outputs and inputs of each device.
fn layouts(machine: &Machine) -> Vec<[Vec<Place>; 2]> {
    let place = |f: &esi::Field| (f.index, f.sub, f.bit_offset, f.bit_len);
    let of = |fields: &[esi::Field]| fields.iter().map(place).collect();
    let devices = machine.devices.iter();
    let layouts = devices.map(|device| &device.selection.layout);
    layouts
        .map(|layout| [of(&layout.rx), of(&layout.tx)])
        .collect()
}

fn samples() -> Vec<PathBuf> {
    let folder = std::fs::read_dir(root().join("configs")).expect("our folder");
    let files = folder.map(|entry| entry.expect("an entry").path());
    let mut files: Vec<_> = files
        .filter(|path| path.extension().is_some_and(|e| e == "toml"))
        .collect();
    files.sort();
    files
}

#[test]
fn samples_keep_their_process_data() {
    let mut count = 0;
    for file in samples() {
        let name = file.display();
        let machine = config::load(&file).expect("our file");
        let exported = export(&machine).expect("an ENI");
        let back = import_with(exported.text.as_bytes(), &root().join("configs/esi"));
        let imported = back
            .machine
            .unwrap_or_else(|e| panic!("{name}: {e}\n{}", back.text));
        assert_eq!(back.other_layouts, [""; 0], "{name}\n{}", back.text);
        let mut by_position: Vec<_> = machine.devices.iter().zip(layouts(&machine)).collect();
        by_position.sort_by_key(|(device, _)| match device.at {
            config::Locator::Position(position) => (0, position),
            _ => (1, u16::from(device.optional)),
        });
        let expected: Vec<_> = by_position.into_iter().map(|(_, layout)| layout).collect();
        assert_eq!(layouts(&imported), expected, "{name}\n{}", back.text);
        // ecaxis sends every exported command, except those of firmware updates.
        let known = ["Bootstrap", "HotConnect"];
        let mut unsent = back.unsent.iter();
        let other = unsent.find(|unsent| {
            let all = format!("{} {}", unsent.command, unsent.reason);
            !known.iter().any(|known| all.contains(known))
        });
        assert_eq!(other, None, "{name}");
        count += machine.devices.len();
    }
    println!("{count} devices");
    assert!(count > 50);
}

/// Every device of every ESI file that a machine file can name keeps its process data.
#[test]
fn devices_of_vendors_keep_their_process_data() {
    let Some(folder) = fixture("esi") else {
        return;
    };
    let library = Library::open(&folder, None).expect("a library");
    let (mut kept, mut lost, mut unusable) = (0, Vec::new(), 0);
    let axis = "mode = \"csp\"\n[device.axis]\nencoder = 2000\nlimits = { velocity = 10.0, acceleration = 10.0 }";
    let entries = library.entries().iter();
    for (entry, axis) in entries.flat_map(|entry| [(entry, ""), (entry, axis)]) {
        let path = folder.join(&entry.file);
        let text = format!(
            "[bus]\nnic = \"sim\"\ncycle = \"2ms\"\n[[device]]\nname = \"d\"\nposition = 0\nesi = \"{}\"\nproduct = 0x{:x}\nrevision = 0x{:x}\n{axis}\n",
            path.display(),
            entry.product,
            entry.revision,
        );
        let machine = config::parse(&root().join("configs/vendor.toml"), &text);
        let Ok(exported) = machine.as_ref().map(export) else {
            unusable += 1;
            continue;
        };
        let what = format!("{} 0x{:08x}", entry.file.display(), entry.product);
        let exported = exported.unwrap_or_else(|e| panic!("{what}: {e}"));
        let back = import_with(exported.text.as_bytes(), &path);
        let same = back
            .machine
            .as_ref()
            .map(|imported| layouts(imported) == layouts(machine.as_ref().expect("loaded")));
        match same {
            Ok(true) => kept += 1,
            Ok(false) => lost.push(format!("{what}: another layout\n{}", back.text)),
            Err(error) => lost.push(format!("{what}: {error}\n{}", back.text)),
        }
    }
    println!(
        "{kept} kept, {unusable} without a default selection, {} lost",
        lost.len()
    );
    assert_eq!(lost, [""; 0], "{}", lost.join("\n"));
    assert!(kept > 20);
}

/// TwinCAT's ENI of a drive with a module: the layout and the SDOs of the ENI, found in the ESI.
#[test]
fn recorded_eni_becomes_the_same_machine() {
    let (Some(eni), Some(esi)) = (
        fixture("eni/CherryECAT_CIA402_ENI.xml"),
        fixture("esi/hpmicro/ECAT_CIA402.xml"),
    ) else {
        return;
    };
    let back = import_with(&std::fs::read(eni).expect("read"), &esi);
    let machine = back
        .machine
        .unwrap_or_else(|e| panic!("{e}\n{}", back.text));
    let unsent: Vec<_> = back.unsent.iter().map(|u| u.command.as_str()).collect();
    // The other commands configure what ecaxis configures as well.
    let registers = [
        "BWR 0x0200",
        "BWR 0x0300",
        "BWR 0x0103",
        "FPWR 0x0120 = 1300",
        "FPRD 0x0130 (check device state for BOOT)",
    ];
    assert_eq!(unsent.len(), registers.len(), "{unsent:?}");
    for (command, register) in unsent.iter().zip(registers) {
        assert!(command.starts_with(register), "{unsent:?}");
    }
    assert_eq!(machine.bus.cycle_ns, 2_000_000);
    let expected = [
        vec![(0x6040, 0, 0, 16), (0x60ff, 0, 16, 32)],
        vec![(0x6041, 0, 0, 16), (0x6064, 0, 16, 32)],
    ];
    assert_eq!(layouts(&machine), [expected], "{}", back.text);
    assert_eq!(back.other_layouts, [""; 0]);
}

/// SOEM's sample has no ESI: the file says so, and no command is dropped silently.
#[test]
fn eni_without_esi_names_what_is_missing() {
    let Some(eni) = fixture("eni/SOEM_sample-eni.xml") else {
        return;
    };
    let bytes = std::fs::read(eni).expect("read");
    let back = import(&bytes, None, Path::new("machine.toml"), "sim").expect("an ENI");
    assert_eq!(back.without_esi, 2);
    assert!(back.machine.is_err());
    assert_eq!(back.unsent.len(), 5, "{:?}", back.unsent);
    assert!(back.text.contains("\"Sample_device_A\""), "{}", back.text);
}

/// An ENI with copies, and one with start-up SDOs and clocks.
static TEXTS: LazyLock<[String; 2]> = LazyLock::new(|| {
    ["copy.toml", "demo.toml"].map(|name| {
        let machine = config::load(&root().join("configs").join(name)).expect("our file");
        export(&machine).expect("an ENI").text
    })
});

static LIBRARY: LazyLock<Library> =
    LazyLock::new(|| Library::open(&root().join("configs/esi"), None).expect("our files"));

#[test]
fn damaged_files_have_a_position_and_a_remedy() {
    let deep = "<a>".repeat(100_000);
    let wide = format!(
        "<EtherCATConfig>{}</EtherCATConfig>",
        "<a/>".repeat(600_000)
    );
    let mut bomb = "<!DOCTYPE b [<!ENTITY a \"aaaaaaaaaa\">".to_owned();
    for n in 0..20 {
        let _ = write!(bomb, "<!ENTITY a{n} \"&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;\">");
    }
    bomb += "]>\n<EtherCATConfig>&a9;</EtherCATConfig>";
    let slave = |info: &str| {
        format!("<EtherCATConfig><Config>\n<Slave>{info}</Slave></Config></EtherCATConfig>")
    };
    let sdo = |inner: &str| {
        let commands = format!("<InitCmds><InitCmd>{inner}</InitCmd></InitCmds>");
        slave(&format!("<Info/><Mailbox><CoE>{commands}</CoE></Mailbox>"))
    };
    for (text, position, message) in [
        (String::new(), (1, 1), "no XML element"),
        ("machine = 1".to_owned(), (1, 12), "no XML element"),
        (
            "<EtherCATInfo/>".to_owned(),
            (1, 1),
            "root element is <EtherCATInfo>",
        ),
        (
            "<EtherCATConfig/>".to_owned(),
            (1, 1),
            "<Config> is missing",
        ),
        (
            "<EtherCATConfig><Config>".to_owned(),
            (1, 25),
            "ends inside <Config>",
        ),
        (
            "<EtherCATConfig>\n</Config>".to_owned(),
            (2, 1),
            "not well-formed",
        ),
        (deep, (1, 97), "nested deeper than 32"),
        (wide, (1, 2_000_013), "more than 500000 elements"),
        (bomb, (1, 1), "document type"),
        (
            "<EtherCATConfig>&x;</EtherCATConfig>".to_owned(),
            (1, 17),
            "unknown entity &x;",
        ),
        (slave(""), (2, 1), "<Slave> has no <Info>"),
        (
            slave("<Info><VendorId>99999999999</VendorId></Info>"),
            (2, 14),
            "does not fit 32 bits",
        ),
        (
            slave("<Info><VendorId>two</VendorId></Info>"),
            (2, 14),
            "not a number that fits",
        ),
        (sdo("<SubIndex>1</SubIndex>"), (2, 39), "has no <Index>"),
        (
            sdo("<Index>65536</Index>"),
            (2, 48),
            "not a number that fits",
        ),
        (
            sdo("<Index>1</Index><Data>0g</Data>"),
            (2, 64),
            "hexadecimal bytes",
        ),
    ] {
        let head: String = text.chars().take(60).collect();
        let error = import(text.as_bytes(), None, Path::new("m.toml"), "sim").expect_err(&head);
        assert!(error.message.contains(message), "{head}: {error}");
        let found = (error.position.line, error.position.column);
        assert_eq!(found, position, "{head}: {error}");
        assert!(!error.help.is_empty());
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    /// Bytes that change, vanish or repeat are an error with a position, or another machine.
    #[test]
    fn mutated_files_neither_panic_nor_hang(
        text in 0..2_usize,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), 0..4_u8), 1..12),
    ) {
        let mut bytes = TEXTS[text].clone().into_bytes();
        for (index, byte, kind) in changes {
            let at = index.index(bytes.len());
            match kind {
                0 => bytes[at] = byte,
                1 => { bytes.remove(at); }
                2 => {
                    let end = (at + usize::from(byte) * 8).min(bytes.len());
                    let part = bytes[at..end].to_vec();
                    bytes.splice(at..at, part);
                }
                // Digits become long or negative numbers.
                _ => { bytes.splice(at..at, *b"-9"); }
            }
        }
        let path = root().join("configs/imported.toml");
        match import(&bytes, Some(&LIBRARY), &path, "sim") {
            Ok(back) => prop_assert!(back.text.len() < 100_000),
            Err(error) => prop_assert!(error.position.line > 0),
        }
    }
}

/// The export has the IDNs that need no attribute, the IP parameters and MAC filters; the import keeps other
/// IDNs, and lists those that follow from keys.
#[test]
fn idns_and_settings_of_eoe_are_init_commands() {
    let sercos = std::fs::read_to_string(root().join("configs/sercos.toml")).expect("our file");
    let entry = "{ idn = \"S-0-0091\", drive = 1, value = \"1500\" }";
    let bytes = "{ idn = \"P-0-0100\", drive = 1, value = [4, 0, 8, 0, 1, 0, 0, 0] }";
    assert!(sercos.contains(entry));
    let text = sercos.replacen(entry, &format!("{entry}, {bytes}"), 1);
    let folder = root().join("configs");
    let machine = config::parse(&folder.join("sercos.toml"), &text).expect("a machine");
    let exported = export(&machine).expect("an ENI");
    let missing: Vec<_> = exported
        .notes
        .iter()
        .filter(|n| n.contains("S-0-"))
        .collect();
    assert_eq!(missing.len(), 2, "{:?}", exported.notes);
    // S-0-0016 of channel 0: S-0-0051 and what the ESI adds, behind both lengths of the list.
    let at_list = "<OpCode>3</OpCode><DriveNo>0</DriveNo><IDN>16</IDN><Elements>64</Elements><Attribute>0</Attribute><Data>";
    let dense: String = exported.text.lines().map(str::trim).collect();
    let place = dense.find(at_list).expect("S-0-0016") + at_list.len();
    let data = dense[place..].split('<').next().expect("data");
    assert_eq!(&data[8..12], "3300", "{data}");

    let back = import_with(exported.text.as_bytes(), &folder.join("esi"));
    assert!(back.text.contains(bytes), "{}", back.text);
    assert!(!back.text.contains("S-0-0016"), "{}", back.text);
    let changed = data.replacen("3300", "2800", 1);
    let (data, changed) = (format!(">{data}<"), format!(">{changed}<"));
    let other = exported.text.replacen(&data, &changed, 1);
    let back = import_with(other.as_bytes(), &folder.join("esi"));
    let unsent: Vec<_> = back
        .unsent
        .iter()
        .map(|u| (&u.command, &u.reason))
        .collect();
    assert_eq!(unsent.len(), 1, "{unsent:?}");
    assert_eq!(unsent[0].0, "SoE write of S-0-0016, drive 0");
    assert!(unsent[0].1.contains("`mode`"), "{unsent:?}");

    let bench = Bench::new();
    bench.change("esi/SV1.xml", |esi| {
        esi.replace("DefaultSize=\"128\"", "DefaultSize=\"160\"")
    });
    let web = std::fs::read_to_string(folder.join("web.toml")).expect("our file");
    let mut web = bench.machine(&web);
    let filter = MacFilter {
        filters: vec![[1, 0x80, 0xc2, 0, 0, 0x0e], [2, 0, 0, 0, 0, 1]],
        masks: vec![[0xff, 0xff, 0xff, 0, 0, 0]],
        no_broadcasts: true,
    };
    for device in &mut web.devices {
        device.eoe.as_mut().expect("EoE").filter = Some(filter.clone());
    }
    let exported = export(&web).expect("an ENI");
    let back = import_with(exported.text.as_bytes(), &bench.path().join("esi"));
    let imported = back.machine.expect("a machine");
    let ethernet = |machine: &Machine| {
        let devices = machine.devices.iter();
        devices.map(|d| d.eoe.clone()).collect::<Vec<_>>()
    };
    assert!(
        ethernet(&web)
            .iter()
            .flatten()
            .all(|eoe| eoe.parameters.is_some())
    );
    assert_eq!(ethernet(&imported), ethernet(&web));
    // Each request twice, as for two transitions.
    let twice = exported
        .text
        .replace("<EoE>", "\u{1}")
        .replace("</EoE>", "\u{2}");
    let parts = twice
        .split('\u{1}')
        .map(|part| match part.split_once('\u{2}') {
            Some((eoe, rest)) => {
                let begin = eoe.find("<InitCmd>").expect("a request");
                let end = eoe.rfind("</InitCmds>").expect("the last one");
                let requests = &eoe[begin..end];
                let head = &eoe[..begin];
                format!("{head}{requests}{requests}{}</EoE>{rest}", &eoe[end..])
            }
            None => part.to_owned(),
        });
    let twice = parts.collect::<Vec<_>>().join("<EoE>");
    assert!(twice.len() > exported.text.len() + 200);
    let back = import_with(twice.as_bytes(), &bench.path().join("esi"));
    assert_eq!(ethernet(&back.machine.expect("a machine")), ethernet(&web));
}

/// ETG.2100: `CycleTime` is optional. Then the cycle is that of most SYNC0 signals, from the element
/// `DC` or from the command for 0x09A0.
#[test]
fn eni_without_cycle_time_takes_the_cycle_of_sync0() {
    let slave = |n: u16, clock: &str| {
        format!(
            "<Slave><Info><Name>D{n}</Name><PhysAddr>{}</PhysAddr><AutoIncAddr>{}</AutoIncAddr>\
             <VendorId>1</VendorId><ProductCode>1</ProductCode><RevisionNo>1</RevisionNo>\
             <SerialNo>0</SerialNo></Info>{clock}</Slave>",
            1001 + n,
            0_u16.wrapping_sub(n)
        )
    };
    let element = |ns: u32| {
        format!(
            "<DC><CycleTime0>{ns}</CycleTime0><CycleTime1>0</CycleTime1><ShiftTime>0</ShiftTime></DC>"
        )
    };
    let command = "<InitCmds><InitCmd><Transition>PS</Transition><Cmd>5</Cmd><Adp>1002</Adp>\
        <Ado>2464</Ado><Data>00093d0000000000</Data></InitCmd></InitCmds>";
    for (slaves, time, cycle) in [
        (vec![element(4_000_000)], "", "\"4ms\""),
        (vec![String::new(), command.to_owned()], "", "\"4ms\""),
        // The second one takes several samples in a cycle.
        (vec![element(2_000_000), element(500_000)], "", "\"2ms\""),
        (
            vec![element(4_000_000)],
            "<CycleTime>2000</CycleTime>",
            "\"2ms\"",
        ),
        (vec![element(0)], "", "\"1ms\""),
    ] {
        let slaves = (0..).zip(&slaves).map(|(n, clock)| slave(n, clock));
        let slaves: String = slaves.collect();
        let eni = format!(
            "<EtherCATConfig><Config><Master/>{slaves}<Cyclic>{time}</Cyclic></Config></EtherCATConfig>"
        );
        let back = import(eni.as_bytes(), None, Path::new("machine.toml"), "sim").expect("an ENI");
        let line = back.text.lines().find(|line| line.starts_with("cycle"));
        let line = line.expect("a cycle");
        assert!(line.contains(cycle), "{line}");
        assert_eq!(line.contains("CHECK"), time.is_empty(), "{line}");
    }
}
