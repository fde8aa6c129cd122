//! What `ecaxis check` finds before the run: devices that a bus would refuse, drives that could not
//! move.

use std::path::Path;

use ecaxis_test_support::program::{self, Ran};
use ecaxis_test_support::root;

const AXIS: &str = "mode = \"csp\"\n[device.axis]\nunit = \"mm\"\nper_turn = 5.0\nencoder = 2000\n\
    limits = { position = [-60.0, 60.0], velocity = 250.0, acceleration = 2500.0, torque = 100.0 }\n";

/// Runs `ecaxis check` on a machine of one device with this ESI file and these keys.
fn checked(folder: &Path, esi: &str, keys: &str) -> Ran {
    std::fs::write(folder.join("d.xml"), esi).expect("written");
    let bus = "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\nlost_frames = 20\n";
    let text = format!("{bus}[[device]]\nname = \"d\"\nesi = \"d.xml\"\nposition = 0\n{keys}");
    let file = folder.join("m.toml");
    std::fs::write(&file, text).expect("written");
    program::run(["check", file.to_str().expect("a path in UTF-8")])
}

fn esi(name: &str) -> String {
    let path = root().join("configs/esi").join(name);
    std::fs::read_to_string(path).expect("an ESI file")
}

/// ESI file, its text and the replacement, further keys, exit code, what `check` says.
type Finding = (
    &'static str,
    [&'static str; 2],
    &'static str,
    i32,
    &'static [&'static str],
);

#[rustfmt::skip] // one row per finding
const FINDINGS: [Finding; 11] = [
    ("SV1.xml", ["DefaultSize=\"128\" StartAddress=\"#x1000\"", "DefaultSize=\"0\" StartAddress=\"#x1000\""], "", 2,
        &["the mailbox of ", "(SyncManager 0) has no size", "`mailbox = \"eeprom\"`"]),
    ("SV1.xml", ["DefaultSize=\"128\" StartAddress=\"#x1000\"", "DefaultSize=\"12\" StartAddress=\"#x1000\""], "", 2,
        &["(SyncManager 0) has 12 bytes, an SDO needs 16"]),
    ("SV1.xml", ["DefaultSize=\"128\" StartAddress=\"#x1000\"", "DefaultSize=\"2000\" StartAddress=\"#x1000\""], "", 2,
        &["(SyncManager 0) has 2000 bytes, a frame carries 1486"]),
    ("SV1.xml", ["DefaultSize=\"128\" StartAddress=\"#x1000\"", "DefaultSize=\"300\" StartAddress=\"#x1000\""], "", 2,
        &["overlap: SyncManager 0 ends at 0x112C, SyncManager 1 begins at 0x1100"]),
    ("SV1.xml", ["<RxPdo Fixed=\"1\" Mandatory=\"1\" Sm=\"2\">", "<RxPdo Fixed=\"1\" Mandatory=\"1\" Sm=\"9\">"], "", 0,
        &["RxPdo 0x1600 is assigned to SyncManager 9, which the device does not have: SyncManager 2 carries it"]),
    ("SV1.xml", ["", ""], "sdo = [{ index = 0x6072, value = 0 }]\n", 2,
        &["leaves the drive without torque: it cannot move", "such as 1000"]),
    ("SV1.xml", ["<DefaultValue>2000</DefaultValue>", "<DefaultValue>0</DefaultValue>"], "", 0,
        &["0x6072", "leaves the drive without torque: it cannot move; write the largest"]),
    ("SV1.xml", ["Factor=\"1\">0</CycleTimeSync0>", "Factor=\"0\">300000</CycleTimeSync0>"], "", 0,
        &["fixes the cycle of SYNC0 at 300 µs", "must be a multiple of it"]),
    ("SV1.xml", ["<ShiftTimeSync0>0<", "<ShiftTimeSync0>1500000<"], "", 0,
        &["shifts SYNC0 by 1.5 ms, and its cycle is 1 ms"]),
    ("SV1.xml", ["<RxPdo Fixed=\"1\" Mandatory=\"1\" Sm=\"2\">", "<RxPdo Fixed=\"1\" Mandatory=\"1\" Sm=\"3\">"], "", 0,
        &["RxPdo 0x1600 is assigned to SyncManager 3, which carries inputs"]),
    ("SV1.xml", ["<Index>#x607A</Index>", "<Index>#x2000</Index>"], "", 2,
        &["offers no mode csp: no PDO has 0x607A"]),
];

/// `check` said "no problems", and the run failed or the drive did not move.
#[test]
fn check_finds_what_a_bus_or_a_drive_would_refuse() {
    let folder = tempfile::tempdir().expect("a folder");
    let sound = checked(folder.path(), &esi("SV1.xml"), AXIS).exits(0);
    for (name, [from, to], keys, code, texts) in FINDINGS {
        let text = esi(name);
        assert!(text.contains(from), "{name}: {from}");
        let ran = checked(
            folder.path(),
            &text.replace(from, to),
            &format!("{keys}{AXIS}"),
        );
        let printed = format!("{}{}", ran.out, ran.err);
        for part in texts {
            assert!(printed.contains(part), "{part}\n{printed}");
            assert!(!sound.out.contains(part), "{part}\n{}", sound.out);
        }
        ran.exits(code);
    }
}

#[test]
fn check_finds_an_eeprom_image_with_a_wrong_checksum() {
    let folder = tempfile::tempdir().expect("a folder");
    let image = folder.path().join("d.bin");
    let source = root().join("configs/esi/SV1.xml");
    let [from, to] = [&source, &image].map(|path| path.to_str().expect("a path in UTF-8"));
    program::run(["esi", "sii", from, "--output", to]).exits(0);
    let keys = format!("sii = \"d.bin\"\n{AXIS}");
    let sound = checked(folder.path(), &esi("SV1.xml"), &keys).exits(0);
    let text = "the checksum of the EEPROM image is wrong";
    assert!(!sound.out.contains(text), "{}", sound.out);
    let mut bytes = std::fs::read(&image).expect("an image");
    bytes[14] ^= 0xff;
    std::fs::write(&image, bytes).expect("written");
    let damaged = checked(folder.path(), &esi("SV1.xml"), &keys).exits(0);
    assert!(damaged.out.contains(text), "{}", damaged.out);
}
