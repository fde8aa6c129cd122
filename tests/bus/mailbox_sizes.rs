//! A device whose EEPROM has other mailboxes than its ESI, and `mailbox`, which selects them. The
//! EEPROM of the simulated device is an image in a file (`sii`).

use ecaxis_esi::sii::{self, MailboxAreas, Sii, SiiOptions};
use ecaxis_master::config::Machine;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::recordings::{Datagram, FPWR, datagrams};
use ecaxis_test_support::{assert_contains, recorded, run, virtual_time};

/// The drive's mailboxes have 48 bytes in its ESI.
const ESI: [u16; 2] = [48, 48];
/// The sizes of `smaller`.
const EEPROM: [u16; 2] = [40, 44];

fn smaller(areas: &mut MailboxAreas) {
    [areas.receive_size, areas.send_size] = EEPROM;
}

/// Writes a drive's ESI and the image of its EEPROM with other mailboxes. `min`: the smallest
/// mailboxes that the device accepts.
fn bench(min: u16, change: fn(&mut MailboxAreas)) -> Bench {
    let bench = Bench::new();
    if min < 48 {
        bench.change("esi/EPOS4.xml", |esi| {
            esi.replace("MinSize=\"48\"", &format!("MinSize=\"{min}\""))
        });
    }
    let file = ecaxis_esi::parse(bench.read("esi/EPOS4.xml").as_bytes()).expect("our file");
    let mut image = Sii::from_device(&file.devices[0], &file.modules, &SiiOptions::default());
    change(&mut image.mailbox);
    for (sm, len) in image
        .sync_managers
        .iter_mut()
        .zip([image.mailbox.receive_size, image.mailbox.send_size])
    {
        sm.len = len;
    }
    std::fs::write(bench.path().join("x.sii"), image.to_bytes()).expect("written");
    bench
}

fn text(keys: &str) -> String {
    format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\n\
         sii = \"x.sii\"\n{keys}position = 0\nmode = \"csp\"\n[device.axis]\nunit = \"turn\"\nencoder = 2000\n\
         limits = {{ velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }}\n\
         [[step]]\nmove = {{ x = 1.0 }}\n"
    )
}

/// A run that reached its target: its warnings, and the lengths of the mailboxes that it used.
struct Done {
    warnings: Vec<String>,
    lengths: [u16; 2],
}

fn run_drive(machine: Machine) -> Result<Done, String> {
    let folder = tempfile::tempdir().expect("a folder");
    let (options, recording) = recorded(virtual_time(), folder.path());
    let (outcome, heard) = run(machine, options);
    outcome.result.map_err(|error| error.to_string())?;
    let summary = outcome.summary.expect("a summary");
    assert_eq!(summary.counters.wkc_errors, 0);
    assert!((summary.axes[0].final_position - 1.0).abs() < 0.01);
    let sent = datagrams(&recording);
    // The last write of each SyncManager that enables it: its length.
    let length = |register: u16| {
        let writes = |d: &&Datagram| {
            d.sent && d.command == FPWR && d.register() == register && d.data.get(6) == Some(&1)
        };
        let last = sent.iter().rfind(writes).expect("configured");
        u16::from_le_bytes([last.data[2], last.data[3]])
    };
    Ok(Done {
        warnings: heard.warnings(),
        lengths: [length(0x0800), length(0x0808)],
    })
}

/// ETG.2100: a configuration tool takes the mailboxes from the ESI. SOEM, the IgH master and
/// ethercrab take words 0x18 to 0x1B of the EEPROM. This device accepts both (`MinSize`).
#[test]
fn mailbox_key_selects_the_mailboxes_of_esi_or_eeprom() {
    for (keys, used, expected) in [
        ("", "ESI", ESI),
        ("mailbox = \"esi\"\n", "ESI", ESI),
        ("mailbox = \"eeprom\"\n", "EEPROM", EEPROM),
    ] {
        let bench = bench(32, smaller);
        let machine = bench.machine(&text(keys));
        let notes = machine.devices.iter().flat_map(|d| &d.selection.notes);
        let notes: Vec<_> = notes
            .filter(|note| note.contains("mailboxes differ"))
            .collect();
        let used = format!("those of the {used} are used");
        assert_eq!(notes.len(), 1, "{notes:?}");
        let areas = "0x1000 (48 bytes), in 0x1040 (48 bytes) in the ESI, out 0x1000 (40 bytes)";
        assert_contains(notes[0], &[areas, &used]);
        let done = run_drive(machine).expect("runs");
        assert_eq!(done.lengths, expected, "{keys}");
        let warnings: Vec<_> = done.warnings.iter().filter(|w| w.contains(&used)).collect();
        assert_eq!(warnings.len(), 1, "{:?}", done.warnings);
        assert_contains(warnings[0], &["`x` (position 0, station 0x1000)", areas]);
    }
}

/// ETG.1000.6, 6.4: a device refuses PreOp with 0x0016 if its mailbox is not as it needs it. With
/// the ESI's it comes up, as in TwinCAT (SOEM issue 459: an EEPROM without mailbox).
#[test]
fn device_that_refuses_the_mailbox_of_its_eeprom_comes_up_with_that_of_the_esi() {
    let none = |areas: &mut MailboxAreas| *areas = MailboxAreas::default();
    for change in [smaller, none] {
        let bench = bench(48, change);
        let done = run_drive(bench.machine(&text(""))).expect("runs");
        assert_eq!(done.lengths, ESI);
        let refused = run_drive(bench.machine(&text("mailbox = \"eeprom\"\n")));
        let error = refused.err().expect("refuses");
        assert_contains(&error, &["`x` (position 0", "PreOp", "0x0016"]);
    }
}

#[test]
fn equal_mailboxes_are_not_reported() {
    let done = run_drive(bench(48, |_| {}).machine(&text(""))).expect("runs");
    assert_eq!((done.warnings, done.lengths), (Vec::new(), ESI));
}

#[test]
fn scan_reports_mailboxes_that_differ() {
    let bench = bench(32, smaller);
    bench.write("bench.toml", &text("mailbox = \"eeprom\"\n"));
    let scan = ["scan", "--sim", "bench.toml", "--write", "machine.toml"];
    let ran = bench.ecaxis(&scan).exits(0);
    assert_contains(
        &ran.err,
        &["position 0: the mailboxes differ", "40 bytes", "`mailbox`"],
    );
    let written = bench.read("machine.toml");
    assert_contains(
        &written,
        &["mailbox ", "\"esi\"", "CHECK: the mailboxes differ"],
    );
    let check = bench.well(&["check", "bench.toml"]);
    assert_contains(
        &check,
        &["the mailboxes differ", "those of the EEPROM are used"],
    );
    let sii = std::fs::read(bench.path().join("x.sii")).expect("an image");
    assert_eq!(sii::parse(&sii).expect("an image").mailbox.receive_size, 40);
}
