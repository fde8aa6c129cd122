//! Devices whose EEPROM is damaged, on the simulated bus: `sii` gives the device the image, `esi`
//! describes it. ETG.1000.6, table 17: a category has a type, a length in words, and data; 0xffff
//! ends the list.

use ecaxis_esi::sii::{self, SiiOptions};
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::{assert_contains, run, virtual_time};

const STRINGS: u16 = 10;
const GENERAL: u16 = 30;
const SYNC_MANAGER: u16 = 41;
const TX_PDO: u16 = 50;
const DC: u16 = 60;
const END: u16 = 0xffff;

fn image(bench: &Bench) -> Vec<u8> {
    let file = ecaxis_esi::parse(bench.read("esi/EPOS4.xml").as_bytes()).expect("our file");
    sii::emit(&file.devices[0], &file.modules, &SiiOptions::default())
}

/// Returns the offset of a category's type.
fn head(image: &[u8], kind: u16) -> usize {
    let word = |at: usize| u16::from_le_bytes([image[at], image[at + 1]]);
    let mut at = 0x80;
    while word(at) != kind {
        at += 4 + 2 * usize::from(word(at + 2));
    }
    at
}

/// Sets the length of a category in words.
fn set_length(image: &mut [u8], kind: u16, words: u16) {
    let at = head(image, kind) + 2;
    image[at..at + 2].copy_from_slice(&words.to_le_bytes());
}

/// Writes a machine whose second device, a drive, has this EEPROM.
fn bench(change: impl FnOnce(&mut Vec<u8>)) -> Bench {
    let bench = Bench::new();
    let mut image = image(&bench);
    change(&mut image);
    std::fs::write(bench.path().join("x.sii"), image).expect("written");
    bench.write(
        "machine.toml",
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 0\n\
         [[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nsii = \"x.sii\"\nposition = 1\nmode = \"csp\"\n\
         [device.axis]\nunit = \"turn\"\nencoder = 2000\n\
         limits = { velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }\n\
         [[step]]\nmove = { x = 1.0 }\n",
    );
    bench
}

fn run_drive(bench: &Bench) -> Result<(), String> {
    let machine = bench.machine(&bench.read("machine.toml"));
    let (outcome, _) = run(machine, virtual_time());
    outcome.result.map_err(|error| error.to_string())?;
    let moved = outcome.summary.expect("a summary").axes[0].final_position;
    assert!((moved - 1.0).abs() < 0.01, "{moved}");
    Ok(())
}

/// Returns what `scan` warns of. It always knows who is there.
#[track_caller]
fn scan(bench: &Bench) -> String {
    let ran = bench.ecaxis(&["scan", "--sim", "machine.toml"]).exits(0);
    // Vendor and product of the drive.
    assert_contains(&ran.out, &["0x00000e0a", "0x45500004"]);
    ran.err
}

#[test]
fn missing_end_mark_changes_nothing() {
    let bench = bench(|image| {
        let end = head(image, END);
        image[end..].fill(0);
    });
    assert_eq!(scan(&bench), "");
    run_drive(&bench).expect("runs");
}

/// Categories that ethercrab and ecaxis do not need before PreOp.
#[test]
fn damaged_later_category_does_not_keep_a_device_from_running() {
    for (kind, words) in [(TX_PDO, 0xffff), (DC, 0xffff), (DC, 0x2000), (DC, 0x7fff)] {
        let bench = bench(|image| set_length(image, kind, words));
        let bytes = u32::from(words) * 2;
        let claims = format!("category {kind}: the category claims {bytes} bytes");
        assert_contains(&scan(&bench), &["position 1: its EEPROM: byte 0x", &claims]);
        let checked = bench.well(&["check", "machine.toml"]);
        assert_contains(&checked, &["the EEPROM image is damaged: "]);
        run_drive(&bench).unwrap_or_else(|error| panic!("{kind} {words:#x}: {error}"));
    }
}

/// ethercrab looks for these categories, and its search could end with a panic or not at all. The run
/// names the device and the damage before.
#[test]
fn damaged_earlier_category_is_named() {
    for kind in [STRINGS, GENERAL, SYNC_MANAGER] {
        for words in [0xffff, 0xfffe, 0x7fff, 0x4000, 0x0400] {
            let bench = bench(|image| set_length(image, kind, words));
            let claims = format!("category {kind}: the category claims");
            assert_contains(&scan(&bench), &["position 1: its EEPROM: byte 0x", &claims]);
            let error = run_drive(&bench).expect_err("damaged");
            let device = "`x` (position 1, station 0x1001)";
            assert_contains(&error, &[device, "its EEPROM is damaged", &claims]);
        }
    }
    let bench = bench(|image| set_length(image, STRINGS, 0xffff));
    let ran = bench.ecaxis(&["run", "machine.toml", "--virtual"]);
    let parts = [
        "`x` (position 1",
        "its EEPROM is damaged",
        "ecaxis eeprom verify",
    ];
    ran.fails(1, &parts);
}

/// The size word 0x3E bounds the list if it has no end mark. The first of two equal categories
/// counts (SOEM, `ec_siifind`).
#[test]
fn remains_of_other_images_and_repeated_categories_do_no_harm() {
    let remains = bench(|image| {
        let end = head(image, END);
        let size = end.next_multiple_of(128);
        image[end..].fill(0);
        let kib = u16::try_from(size / 128 - 1).expect("small");
        image[0x7c..0x7e].copy_from_slice(&kib.to_le_bytes());
        let another = [SYNC_MANAGER, 4, 1, 2, 3, 4, DC, 0xffff];
        let another = another.map(u16::to_le_bytes).concat();
        image.resize(image.len().max(size + another.len()), 0);
        image[size..size + another.len()].copy_from_slice(&another);
    });
    let repeated = bench(|image| {
        let (at, end) = (head(image, SYNC_MANAGER), head(image, END));
        let mut again = image[at..at + 36].to_vec();
        again[4..12].fill(0x55);
        let length = image.len();
        image.splice(end..end, again);
        image.truncate(length);
    });
    for bench in [remains, repeated] {
        assert_eq!(scan(&bench), "");
        run_drive(&bench).expect("runs");
    }
}
