//! `ecaxis scan` on simulated buses.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::{self, Locator};
use ecaxis_master::session::run_on;
use ecaxis_sim::Segment;
use serde_json::Value;

use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::wire::{WatchedBus, Watcher};
use ecaxis_test_support::{Heard, assert_contains, assert_fits, assert_snapshot, virtual_time};

fn bench() -> Bench {
    let bench = Bench::new();
    bench.copy("commissioning.toml", "bench.toml");
    bench
}

#[test]
fn scan_output_matches_the_snapshots() {
    let bench = bench();
    for (name, arguments) in [
        ("tables.txt", &["scan", "--sim", "bench.toml"][..]),
        ("tree.txt", &["scan", "--sim", "bench.toml", "--tree"]),
        ("asked.txt", &["scan", "--sim", "bench.toml", "--ask"]),
        (
            "asked-tree.txt",
            &["scan", "--sim", "bench.toml", "--ask", "--tree"],
        ),
    ] {
        let out = bench.well(arguments);
        assert_fits(&out);
        assert_snapshot(&format!("scan/{name}"), &out);
    }
}

#[test]
fn scan_json_contains_every_device() {
    let bench = bench();
    let out = bench.well(&["scan", "--sim", "bench.toml", "--ask", "--json"]);
    let seen: Value = serde_json::from_str(&out).expect("JSON");
    assert_eq!(seen["other_master"], false);
    let devices = seen["devices"].as_array().expect("devices");
    assert_eq!(devices.len(), 9);
    let names: Vec<_> = devices.iter().map(|d| d["name"].as_str()).collect();
    let expected = [
        "CP0", "DI8", "DO8", "DI4", "DO4", "EPOS4", "IDX", "SV1", "GW64",
    ];
    assert_eq!(names, expected.map(Some));
    for (position, device) in devices.iter().enumerate() {
        assert_eq!(device["position"], position);
        assert_eq!(device["state"], "Init", "as it was");
        assert_eq!(device["serial"], 1000 + position);
        assert_eq!(device["esi"]["fits"], "equal");
    }
    let drive = &devices[7]["answers"]["drive"];
    assert_eq!(drive["encoder_resolution"][0], 131_072);
    assert_eq!(drive["velocity_unit"], 0x00b5_0300);
    assert_eq!(drive["software_limits"][1], 13_107_200);
    assert_eq!(devices[5]["drive"], true);
    assert_eq!(devices[8]["drive"], false);
    assert!(devices[1]["answers"].is_null(), "no mailbox");
    // Every cable has a delay.
    let delays: Vec<_> = devices
        .iter()
        .filter_map(|d| d["delay_ns"].as_u64())
        .collect();
    assert!(delays.len() > 3 && delays.is_sorted(), "{delays:?}");
}

/// The coupler has receive times but no clock. The clock of the first drive is the reference.
#[test]
fn drives_behind_a_coupler_without_a_clock_are_synchronised() {
    let bench = bench();
    let out = bench.well(&["run", "bench.toml", "--virtual", "--json"]);
    let run: Value = serde_json::from_str(&out).expect("JSON");
    assert_eq!(run["ok"], true, "{out}");
    assert_eq!(run["summary"]["program_runs"], 1);
}

#[test]
fn scan_write_keeps_an_existing_file() {
    let bench = bench();
    bench.write("mine.toml", "# mine\n");
    let write = ["scan", "--sim", "bench.toml", "--write", "mine.toml"];
    let ran = bench.ecaxis(&write);
    assert_eq!(ran.code, 2);
    assert!(
        ran.err.contains("mine.toml is there already"),
        "{}",
        ran.err
    );
    assert_eq!(bench.read("mine.toml"), "# mine\n");
    bench.well(&[&write[..], &["--force"]].concat());
    assert!(bench.read("mine.toml").contains("[[device]]"));
}

/// The written file is valid and matches its bus.
#[test]
fn scan_write_describes_every_bus_of_the_project() {
    let bench = Bench::new();
    for config in [
        "commissioning",
        "controller",
        "demo",
        "gateway",
        "groups",
        "loops",
        "modes",
        "probe",
        "profiles",
        "terminals",
        "tuned",
    ] {
        bench.copy(&format!("{config}.toml"), "bench.toml");
        let write = [
            "scan",
            "--sim",
            "bench.toml",
            "--write",
            "machine.toml",
            "--force",
        ];
        let ran = bench.ecaxis(&write);
        assert_eq!((ran.code, ran.err.as_str()), (0, ""), "{config}");
        let checked = bench.ecaxis(&["check", "machine.toml"]);
        assert_eq!(checked.code, 0, "{config}: {}", checked.err);
        let compared = bench.well(&["compare", "machine.toml", "--sim", "bench.toml"]);
        assert_eq!(compared, "as in the file\n", "{config}");
    }
}

/// The lowest and highest count of each drive's shaft, by the position of the drive.
type Travel = Arc<Mutex<BTreeMap<usize, (i64, i64)>>>;

struct Shafts(Travel);

impl Watcher for Shafts {
    fn after(&mut self, segment: &mut Segment) {
        let mut travel = self.0.lock().expect("no panic");
        for n in 0..segment.len() {
            if let Some(drive) = segment.device(n).and_then(|device| device.drive()) {
                let now = drive.position_counts();
                let (low, high) = travel.entry(n).or_insert((now, now));
                (*low, *high) = ((*low).min(now), (*high).max(now));
            }
        }
    }
}

/// Without an ESI file, the EEPROM describes the device (ETG.1500, feature 301). The bus is
/// simulated from the ESI files, the machine file knows the EEPROM images only.
#[test]
fn scan_write_includes_a_device_without_esi() {
    let bench = bench();
    let write = [
        "scan",
        "--sim",
        "bench.toml",
        "--esi",
        "few",
        "--write",
        "machine.toml",
    ];
    std::fs::create_dir(bench.path().join("few")).expect("a folder");
    bench.write("few/EPOS4.xml", &bench.read("esi/EPOS4.xml"));
    let ran = bench.ecaxis(&write).exits(0);
    assert_contains(&ran.err, &["no ESI file describes 8 devices", "(`sii`)"]);
    let text = bench.read("machine.toml");
    assert_eq!(text.matches("\nsii ").count(), 8, "{text}");
    assert_eq!(text.matches("\nesi ").count(), 1, "{text}");
    let images: Vec<_> = std::fs::read_dir(bench.path())
        .expect("a folder")
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .filter(|name| name.ends_with(".sii"))
        .collect();
    assert_eq!(images.len(), 8, "{images:?}");
    bench.well(&["check", "machine.toml"]);
    let compared = bench.well(&["compare", "machine.toml", "--sim", "bench.toml"]);
    assert_eq!(compared, "as in the file\n");
    let explained = bench.well(&["explain", "machine.toml"]);
    assert!(!explained.contains("line 0"), "{explained}");

    let [mut machine, bus] = ["machine.toml", "bench.toml"]
        .map(|name| config::load(&bench.path().join(name)).expect("a machine"));
    machine.enable = true;
    let turn: Vec<(usize, f64)> = machine
        .axes
        .iter()
        .map(|axis| match machine.devices[axis.device].at {
            Locator::Position(n) => (usize::from(n), axis.config.scale.counts_per_turn()),
            _ => unreachable!("no aliases"),
        })
        .collect();
    assert_eq!(turn.len(), 3);
    let travel = Travel::default();
    let options = virtual_time();
    let link = Box::new(WatchedBus::new(&bus, &options, Shafts(Arc::clone(&travel))));
    let stop = Arc::<CancelToken>::default();
    let outcome = run_on(link, machine, options, stop, &mut Heard::default());
    outcome.result.expect("runs");
    let summary = outcome.summary.expect("a summary");
    assert_eq!((summary.counters.wkc_errors, summary.program_runs), (0, 1));
    // A tenth of a turn there and back, in CSP.
    for (position, counts) in turn {
        let (low, high) = travel.lock().expect("no panic")[&position];
        let turned = (high - low) as f64 / counts;
        assert!((0.095..0.11).contains(&turned), "{position}: {turned}");
    }

    // The simulated bus takes the images, too.
    bench.well(&["run", "machine.toml", "--virtual", "--enable"]);

    // A damaged image does not describe the device: its process data would differ.
    let image = std::fs::read(bench.path().join("axis2.sii")).expect("an image");
    std::fs::write(bench.path().join("axis2.sii"), &image[..image.len() - 40]).expect("written");
    let refused = bench.ecaxis(&["check", "machine.toml"]);
    refused.fails(
        2,
        &["damaged EEPROM image", "axis2.sii", "category", "ESI file"],
    );
    std::fs::write(bench.path().join("axis2.sii"), image).expect("written");

    // The images are kept.
    let kept = std::fs::read(bench.path().join("axis2.sii")).expect("an image");
    std::fs::remove_file(bench.path().join("machine.toml")).expect("removed");
    bench
        .ecaxis(&write)
        .fails(2, &["cp0.sii is there already", "--force"]);
    assert!(!bench.path().join("machine.toml").exists());
    bench.well(&[&write[..], &["--force"]].concat());
    assert_eq!(
        std::fs::read(bench.path().join("axis2.sii")).ok(),
        Some(kept)
    );
}

#[test]
fn scan_rejects_wrong_arguments() {
    let bench = bench();
    for (arguments, expected) in [
        (&["scan"][..], "this computer has"),
        (&["scan", "--sim", "missing.toml"], "missing.toml"),
        (&["scan", "no-such-if"], "no-such-if"),
        (
            &["scan", "--sim", "bench.toml", "--esi", "nowhere"],
            "nowhere",
        ),
        (
            &["compare", "bench.toml", "--sim", "missing.toml"],
            "missing.toml",
        ),
    ] {
        let ran = bench.ecaxis(arguments);
        assert_ne!(ran.code, 0, "{arguments:?}");
        assert_eq!(ran.out, "", "{arguments:?}");
        assert!(ran.err.contains(expected), "{arguments:?}: {}", ran.err);
    }
}

/// Covers modules, an alias, and a firmware newer than its ESI.
#[test]
fn scan_write_records_modules_alias_and_newer_firmware() {
    let bench = Bench::new();
    let esi = bench.read("esi/EPOS4.xml");
    let newer = esi.replace("RevisionNo=\"#x00010000\"", "RevisionNo=\"#x00010005\"");
    std::fs::create_dir(bench.path().join("newer")).expect("a folder");
    bench.write("newer/EPOS4.xml", &newer);
    bench.write(
        "bench.toml",
        r#"
[bus]
cycle = "1ms"

[[device]]
name = "block"
esi = "esi/MIO2.xml"
position = 0
modules = ["OUT8", "IN8"]

[[device]]
name = "x"
esi = "newer/EPOS4.xml"
alias = 77
mode = "csp"

[device.axis]
encoder = 2000
limits = { velocity = 10.0, acceleration = 100.0 }

[[device]]
name = "io"
esi = "esi/IO8.xml"
alias = 78

[[device]]
name = "more"
esi = "esi/IO8.xml"
position = 3
"#,
    );
    let arguments = [
        "scan",
        "--sim",
        "bench.toml",
        "--esi",
        "esi",
        "--write",
        "machine.toml",
    ];
    let reported = bench.well(&arguments);
    assert!(reported.contains("4 devices"), "{reported}");
    let text = bench.read("machine.toml");
    assert_snapshot("scan/modules.toml", &text);
    bench.well(&["check", "machine.toml"]);
    // The file matches its own bus, and this bus has the newer firmware.
    let compared = bench.well(&["compare", "machine.toml", "--sim", "bench.toml"]);
    assert_eq!(compared, "as in the file\n");
    let run = ["run", "machine.toml", "--virtual", "--for", "100ms"];
    let ran = bench.ecaxis(&run);
    assert_eq!(ran.code, 0, "{}", ran.err);
    assert!(ran.out.contains("4 SubDevices"), "{}", ran.out);
}

/// Slots that are empty on the bus were written as a list that gave them their default modules.
#[test]
fn scan_write_keeps_slots_empty() {
    let bench = Bench::new();
    for (modules, written) in [
        ("[\"-\", \"-\"]", "modules = [] # no module is plugged"),
        ("[]", "modules = [] # no module is plugged"),
        ("[\"IN8\"]", "modules = [\"IN8\"] # as they are plugged"),
        ("[\"-\", \"IN8\"]", "modules = [\"-\", \"IN8\"]"),
    ] {
        let device = "name = \"block\"\nesi = \"esi/MIO2.xml\"\nposition = 0\n";
        let text = format!(
            "enable = false\n[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\n{device}modules = {modules}\n"
        );
        bench.write("bench.toml", &text);
        let scan = ["scan", "--sim", "bench.toml", "--esi", "esi", "--force"];
        bench.well(&[&scan[..], &["--write", "machine.toml"]].concat());
        let text = bench.read("machine.toml");
        // The columns depend on the other keys.
        let words: Vec<&str> = text.split_whitespace().collect();
        assert!(words.join(" ").contains(written), "{modules}: {text}");
        for (file, bus) in [
            ("machine.toml", "bench.toml"),
            ("bench.toml", "machine.toml"),
        ] {
            let compared = bench.well(&["compare", file, "--sim", bus]);
            assert_eq!(compared, "as in the file\n", "{modules}");
        }
        let ran = bench.ecaxis(&["run", "machine.toml", "--virtual", "--for", "50ms"]);
        assert_eq!(ran.code, 0, "{modules}: {}", ran.err);
    }
}

/// A truncated ESI file does not hide the others, and is named.
#[test]
fn scan_names_esi_files_that_it_cannot_read() {
    let bench = Bench::new();
    bench.write("esi/broken.xml", "<EtherCATInfo><Vendor>");
    bench.copy("demo.toml", "bench.toml");
    let ran = bench.ecaxis(&["scan", "--sim", "bench.toml", "--esi", "esi"]);
    assert_eq!(ran.code, 0, "{}", ran.err);
    assert!(ran.err.contains("ESI file not read: "), "{}", ran.err);
    assert!(ran.err.contains("broken.xml"), "{}", ran.err);
    assert!(ran.out.contains("EPOS4"), "{}", ran.out);
}

/// Two files of one folder describe the same revision, as those of two firmwares do.
#[test]
fn scan_write_names_another_file_of_the_same_revision() {
    let bench = bench();
    let write = ["scan", "--sim", "bench.toml", "--write"];
    bench.well(&[&write[..], &["one.toml"]].concat());
    assert!(!bench.read("one.toml").contains("has the same revision"));
    bench.write("esi/EPOS4-second.xml", &bench.read("esi/EPOS4.xml"));
    bench.well(&[&write[..], &["two.toml"]].concat());
    let text = bench.read("two.toml");
    let comment = "CHECK: EPOS4.xml has the same revision: take the file of this firmware";
    let drives = text
        .lines()
        .filter(|line| line.contains("EPOS4-second.xml"));
    assert_eq!(
        drives.filter(|line| line.contains(comment)).count(),
        1,
        "{text}"
    );
}
