//! `ecaxis analyze` on recordings of real buses and of our own runs, whole, cut and damaged; and recordings as a bus (replay).
//!
//! `ECAXIS_UPDATE_SNAPSHOTS=1` writes what is kept in `tests/snapshots/analyze` anew; the difference then wants reviewing.

#![allow(clippy::print_stdout, reason = "a skipped test says why")]

mod common;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use common::{axes, fixture, load, machine, root, run, run_well, virtual_time};
use ecaxis::analyze::{self, Known, Report};
use ecaxis::config::Machine;
use ecaxis::recording::Reader;
use ecaxis::session::{Options, Progress};
use proptest::prelude::*;

const CAPTURES: [&str; 11] = [
    "ethercrab-dumps/rs-example-sii-el2004.ecat-only.pcapng",
    "ethercrab-dumps/soem-sdinfo-ek1100-el1004.ecat-only.pcapng",
    "ethercrab-dumps/soem-sdinfo-ek1100-only.ecat-only.pcapng",
    "ethercrab-dumps/soem-sdinfo-no-slaves.ecat-only.pcapng",
    "ethercrab-dumps/soem-single-lan9252.ecat-only.pcapng",
    "ethercrab-dumps/twincat-run-ek1100-el1004.ecat-only.pcapng",
    "ethercrab-replay/replay-dc.pcapng",
    "ethercrab-replay/replay-ek1100-el2828-el2889.pcapng",
    "ethercrab-replay/replay-ek1914-el3004-configure.pcapng",
    "ethercrab-replay/replay-ek1914-el3004-mailbox.pcapng",
    "ethercrab-replay/replay-ek1914-segmented-upload.pcapng",
];

fn captures() -> Vec<PathBuf> {
    let all = CAPTURES
        .iter()
        .map(|name| fixture(&format!("frames/{name}")));
    all.flatten().collect()
}

fn analyzed(bytes: &[u8], known: Known) -> Report {
    analyze::analyze(vec![Reader::new(bytes)], None, known)
}

fn of_file(path: &Path) -> Report {
    analyzed(&std::fs::read(path).expect("readable"), Known::default())
}

fn ecaxis(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_ecaxis"))
        .arg("analyze")
        .args(arguments)
        .current_dir(root())
        .output()
        .expect("the binary runs")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).expect("UTF-8")
}

/// A run in virtual time, and its recording.
fn recorded(folder: &Path, machine: Machine, options: Options) -> PathBuf {
    let path = folder.join("run.pcapng");
    let options = Options {
        record: Some(path.clone()),
        ..options
    };
    run_well(machine, options);
    path
}

#[test]
fn the_story_of_every_capture() {
    let update = std::env::var_os("ECAXIS_UPDATE_SNAPSHOTS").is_some();
    let mut differ = Vec::new();
    for path in captures() {
        let output = ecaxis(&[path.to_str().expect("UTF-8")]);
        let now = text(&output.stdout);
        assert_eq!(
            output.status.code(),
            Some(0),
            "{now}{}",
            text(&output.stderr)
        );
        assert!(
            now.lines().all(|line| line.chars().count() <= 80),
            "80 columns:\n{now}"
        );
        let name = path.file_name().expect("a name").to_str().expect("UTF-8");
        let name = name.split('.').next().expect("a stem");
        let kept = root().join(format!("tests/snapshots/analyze/{name}.txt"));
        if update {
            std::fs::create_dir_all(kept.parent().expect("a folder")).expect("written");
            std::fs::write(&kept, &now).expect("written");
        } else if std::fs::read_to_string(&kept).unwrap_or_default() != now {
            differ.push(format!("{}, now:\n{now}", kept.display()));
        }
    }
    assert!(differ.is_empty(), "{}", differ.join("\n"));
}

/// One datagram as tshark dissects it.
struct Dissected {
    at_ns: u64,
    answer: bool,
    command: u8,
    /// Register, or logical address.
    address: u32,
    wkc: u16,
    /// Of the frame.
    source: String,
}

fn tshark(arguments: &[&str]) -> Option<String> {
    let output = match Command::new("tshark").args(arguments).output() {
        Ok(output) => output,
        Err(error) => {
            println!("skipped: tshark: {error}");
            return None;
        }
    };
    assert!(output.status.success(), "{}", text(&output.stderr));
    Some(text(&output.stdout))
}

fn dissected(path: &Path) -> Option<Vec<Dissected>> {
    let fields = [
        "frame.time_epoch",
        "eth.src",
        "ecat.cmd",
        "ecat.ado",
        "ecat.lad",
        "ecat.cnt",
    ];
    let mut arguments = vec!["-r", path.to_str()?, "-T", "fields", "-E", "separator=|"];
    arguments.extend(fields.iter().flat_map(|field| ["-e", *field]));
    let number = |text: &str| u32::from_str_radix(text.trim_start_matches("0x"), 16).expect("hex");
    let mut found = Vec::new();
    for line in tshark(&arguments)?.lines() {
        let parts: Vec<&str> = line.split('|').collect();
        let [time, source, commands, registers, logical, counters] = parts[..] else {
            panic!("{line}");
        };
        let (seconds, fraction) = time.split_once('.').expect("a fraction");
        let at_ns = seconds.parse::<u64>().expect("seconds") * 1_000_000_000
            + format!("{fraction:0<9}")[..9]
                .parse::<u64>()
                .expect("nanoseconds");
        let (mut registers, mut logical) = (registers.split(','), logical.split(','));
        for (command, wkc) in commands.split(',').zip(counters.split(',')) {
            let command = number(command) as u8;
            let of = if (10..=12).contains(&command) {
                &mut logical
            } else {
                &mut registers
            };
            found.push(Dissected {
                at_ns,
                answer: number(&source[..2]) & 2 != 0,
                command,
                address: number(of.next().expect("an address")),
                wkc: wkc.parse().expect("a working counter"),
                source: source.to_owned(),
            });
        }
    }
    Some(found)
}

/// Device count, states, SDO transfers, cycle time and working counters, by somebody else's dissector.
#[test]
fn every_capture_as_tshark_shows_it() {
    for path in captures() {
        let name = path.display();
        let report = of_file(&path);
        let Some(seen) = dissected(&path) else {
            return;
        };
        // Frames: a datagram's time and source tell frames apart well enough where there is one at a time.
        let sources: std::collections::BTreeSet<&str> = seen.iter().map(|d| &*d.source).collect();
        assert!(sources.len() <= 2, "{name}: {sources:?}");

        let broadcast = seen
            .iter()
            .filter(|d| d.answer && d.command == 7 && d.address < 0x10);
        let expected = broadcast.map(|d| d.wkc).max();
        assert_eq!(report.answering, expected, "{name}: devices");
        if let Some(count) = expected {
            assert_eq!(report.devices.len(), usize::from(count), "{name}: devices");
        }

        // Process data: how often, working counters, and the median interval.
        let mut groups: BTreeMap<u32, (Vec<u64>, BTreeMap<u16, u64>)> = BTreeMap::new();
        for d in seen.iter().filter(|d| (10..=12).contains(&d.command)) {
            let group = groups.entry(d.address).or_default();
            if d.answer {
                *group.1.entry(d.wkc).or_default() += 1;
            } else {
                group.0.push(d.at_ns);
            }
        }
        assert_eq!(report.cycle.len(), groups.len(), "{name}: process data");
        for cycle in &report.cycle {
            let (times, counters) = &groups[&cycle.logical_address];
            assert_eq!(cycle.count, times.len() as u64, "{name}");
            let expected: Vec<(u16, u64)> = counters.iter().map(|(w, n)| (*w, *n)).collect();
            assert_eq!(cycle.wkc, expected, "{name}: working counters");
            let mut intervals: Vec<u64> = times.windows(2).map(|w| w[1] - w[0]).collect();
            intervals.sort_unstable();
            let median = intervals[(intervals.len() - 1) / 2];
            let off = cycle.cycle_ns.abs_diff(median) as f64 / median as f64;
            assert!(off < 1e-3, "{name}: {} against {median}", cycle.cycle_ns);
            assert!(
                cycle.interval_max_ns.abs_diff(*intervals.last().unwrap()) < 2_000,
                "{name}"
            );
        }
        states_as_tshark(&path, &report);
        transfers_as_tshark(&path, &report);
    }
}

/// Every state that some device is seen in, by reads of AL status.
fn states_as_tshark(path: &Path, report: &Report) {
    let filter = "ecat.ado == 0x130 && (eth.src[0] & 2)";
    let fields = [
        "-e",
        "ecat.cmd",
        "-e",
        "ecat.ado",
        "-e",
        "ecat.adp",
        "-e",
        "ecat.cnt",
        "-e",
        "ecat.reg.alstatus.status",
    ];
    let mut arguments = vec![
        "-r",
        path.to_str().unwrap(),
        "-Y",
        filter,
        "-T",
        "fields",
        "-E",
        "separator=|",
    ];
    arguments.extend(fields);
    let mut expected: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
    let number = |text: &str| u32::from_str_radix(text.trim_start_matches("0x"), 16).unwrap();
    for line in tshark(&arguments).unwrap_or_default().lines() {
        let parts: Vec<&str> = line.split('|').collect();
        let [commands, registers, stations, counters, states] = parts[..] else {
            panic!("{line}");
        };
        // Where every datagram is such a read, states belong to stations one by one.
        let all = |list: &str, wanted: &str| list.split(',').all(|one| one == wanted);
        if !all(commands, "0x04") || !all(registers, "0x0130") || !all(counters, "1") {
            continue;
        }
        for (station, state) in stations.split(',').zip(states.split(',')) {
            expected
                .entry(number(station))
                .or_default()
                .push(number(state));
        }
    }
    for (station, states) in expected {
        let device = report
            .devices
            .iter()
            .find(|d| d.station.map(u32::from) == Some(station));
        let device = device.unwrap_or_else(|| panic!("{}: 0x{station:04x}", path.display()));
        for state in states {
            let name = match state & 0x0f {
                1 => "Init",
                2 => "PreOp",
                4 => "SafeOp",
                8 => "Op",
                other => panic!("state {other}"),
            };
            assert!(
                device.states.iter().any(|s| s == name),
                "{}: {name} of {device:?}",
                path.display()
            );
        }
    }
}

/// Objects in the order in which they were asked for.
fn transfers_as_tshark(path: &Path, report: &Report) {
    // Initiating requests: downloads and uploads, but no segments.
    let filter = "ecat_mailbox.coe.sdoccsid || ecat_mailbox.coe.sdoccsiu";
    let both = format!("({filter}) && !(eth.src[0] & 2)");
    let fields = [
        "-e",
        "ecat_mailbox.coe.sdoidx",
        "-e",
        "ecat_mailbox.coe.sdosub",
        "-e",
        "ecat_mailbox.coe.sdoreq",
    ];
    let mut arguments = vec![
        "-r",
        path.to_str().unwrap(),
        "-Y",
        &both,
        "-T",
        "fields",
        "-E",
        "separator=|",
    ];
    arguments.extend(fields);
    let number = |text: &str| u32::from_str_radix(text.trim_start_matches("0x"), 16).unwrap();
    let mut expected = Vec::new();
    for line in tshark(&arguments).unwrap_or_default().lines() {
        let parts: Vec<&str> = line.split('|').collect();
        // 1: download, 2: upload.
        expected.push((
            number(parts[0]) as u16,
            number(parts[1]) as u8,
            parts[2] == "1",
        ));
    }
    let found = report
        .transfers
        .iter()
        .map(|t| (t.index, t.sub, t.write))
        .collect::<Vec<_>>();
    assert_eq!(found, expected, "{}", path.display());
    assert!(
        report.transfers.iter().all(|t| t.ended == "done"),
        "{:?}",
        report.transfers
    );
}

#[test]
fn our_own_run_tells_its_story() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options = Options {
        repeat: Some(1),
        ..virtual_time()
    };
    let path = recorded(folder.path(), load("demo.toml"), options);
    let bytes = std::fs::read(&path).expect("the recording");
    let report = analyzed(&bytes, Known::default().with_machine(&load("demo.toml")));
    let names: Vec<_> = report
        .devices
        .iter()
        .filter_map(|d| d.name.as_deref())
        .collect();
    assert_eq!(names, ["x", "y"]);
    for device in &report.devices {
        assert_eq!(
            device.states.iter().map(String::as_str).collect::<Vec<_>>(),
            ["Init", "PreOp", "SafeOp", "Op", "SafeOp", "PreOp", "Init"]
        );
        assert_eq!(device.sync0_ns, Some(1_000_000));
        assert!(device.reads > 0 && device.writes > 20);
    }
    assert_eq!((report.file.lost, report.file.without_request), (0, 0));
    let [cycle] = &report.cycle[..] else {
        panic!("{:?}", report.cycle);
    };
    // SYNC0's millisecond, and the reference clock is 18 ppm fast.
    assert!(cycle.cycle_ns.abs_diff(999_982) < 200, "{cycle:?}");
    assert_eq!((cycle.usual_wkc, cycle.lost), (Some(6), 0));
    assert!(
        report
            .trouble
            .iter()
            .all(|line| !line.contains("working counter")),
        "{:?}",
        report.trouble
    );
    let ppm = report.clocks.rate_ppm.expect("a reference clock");
    assert!((ppm - 18.0).abs() < 0.5, "{ppm}");
    for axis in &report.axes {
        let states: Vec<&str> = axis
            .states
            .iter()
            .map(|(_, state)| state.as_str())
            .collect();
        assert_eq!(
            states[..4],
            [
                "Switch on disabled",
                "Ready to switch on",
                "Switched on",
                "Operation enabled"
            ]
        );
        let (low, high) = axis.travelled.expect("it moved");
        assert_eq!(axis.unit, "mm");
        assert!(
            low.abs() < 0.01 && (high - 50.0).abs() < 0.01,
            "{low} to {high}"
        );
        assert!(
            axis.largest_following_error
                .is_some_and(|error| error > 0.0 && error < 2.0)
        );
        assert_eq!(
            axis.modes.last().map(|(_, mode)| mode.as_str()),
            Some("CSP")
        );
        assert_eq!(
            axis.plots.iter().map(|plot| plot.title).collect::<Vec<_>>(),
            ["Position", "Velocity", "Torque"]
        );
    }
    assert_eq!(report.axes.len(), 2);

    // The recording shows the PDOs by itself: without the file only names and units are missing.
    let alone = analyzed(&bytes, Known::default());
    let counts: Vec<_> = alone
        .axes
        .iter()
        .map(|axis| (axis.cycles, axis.unit.as_str()))
        .collect();
    assert_eq!(
        counts,
        report
            .axes
            .iter()
            .map(|axis| (axis.cycles, "counts"))
            .collect::<Vec<_>>()
    );

    let html = analyze::html("run.pcapng", &report);
    well_formed(&html);
    assert_eq!(
        html.matches("<svg").count(),
        2 * 4,
        "state, position, velocity and torque of each"
    );
}

fn well_formed(html: &str) {
    let mut reader = quick_xml::Reader::from_str(html);
    loop {
        match reader.read_event() {
            Ok(quick_xml::events::Event::Eof) => return,
            Ok(_) => {}
            Err(error) => panic!("{error} at {}", reader.buffer_position()),
        }
    }
}

#[test]
fn faults_stand_out() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("run.pcapng");
    let script = "[[fault]]\nkind = \"frame-loss\"\nat = \"1s\"\ncount = 2\n\
                  [[fault]]\nkind = \"drive-fault\"\nat = \"1500ms\"\ndevice = 1\ncode = 0x3210\n";
    let options = Options {
        record: Some(path.clone()),
        ..common::faults(script)
    };
    let (outcome, _) = run(machine(&axes(2)), options);
    assert!(outcome.result.is_err(), "a drive fault stops the machine");
    let report = of_file(&path);
    assert_eq!(report.file.lost, 2, "{:?}", report.trouble);
    let told = report.trouble.join("\n");
    assert!(told.contains("2 frames of"), "{told}");
    assert!(
        told.contains("Fault") || told.contains("emergency 0x3210"),
        "{told}"
    );
    let emergencies: Vec<u64> = report.devices.iter().map(|d| d.emergencies).collect();
    assert!(
        report.axes[1]
            .states
            .iter()
            .any(|(_, state)| state == "Fault"),
        "{:?}",
        report.axes[1].states
    );
    assert!(
        report.axes[0]
            .states
            .iter()
            .all(|(_, state)| state != "Fault")
    );
    println!("emergencies {emergencies:?}\n{told}");
}

#[test]
fn what_cannot_be_analyzed_is_told() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let file = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).expect("written");
        path.to_str().expect("UTF-8").to_owned()
    };
    for (path, code, part) in [
        (file("notes.txt", b"dear diary"), 1, "a text file"),
        (file("empty", b""), 1, "an empty file"),
        (
            folder.path().to_str().expect("UTF-8").to_owned(),
            2,
            "directory",
        ),
        ("nothere.pcapng".to_owned(), 2, "nothere.pcapng"),
    ] {
        let output = ecaxis(&[&path]);
        let all = text(&output.stdout) + &text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{all}");
        assert!(all.contains(part), "{all}");
        let json = ecaxis(&[&path, "--json"]);
        if code == 1 {
            let json: serde_json::Value = serde_json::from_slice(&json.stdout).expect("JSON");
            assert_eq!(json["file"]["ethercat_frames"], 0);
        }
    }
}

#[test]
fn parts_of_a_recording_are_one() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options = Options {
        record_limit: Some(2_000_000),
        limit: Some(8_000_000_000),
        ..virtual_time()
    };
    let first = recorded(folder.path(), load("demo.toml"), options);
    let parts = ecaxis::link::capture::parts_of(&first).expect("a folder");
    assert_eq!(parts.len(), 3);
    // As a shell sorts them, the first is the last.
    let mut arguments: Vec<&str> = parts.iter().filter_map(|path| path.to_str()).collect();
    arguments.push(first.to_str().expect("UTF-8"));
    arguments.push("--json");
    let output = ecaxis(&arguments);
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(
        json["devices"].as_array().map(Vec::len),
        Some(2),
        "the first part knows the devices"
    );
    assert_eq!(json["axes"].as_array().map(Vec::len), Some(2));
    let states = json["devices"][0]["states"].as_array().expect("states");
    assert_eq!(
        states.first().zip(states.last()),
        Some((&"Init".into(), &"Init".into())),
        "from the first to the last"
    );
    let lost = json["file"]["lost"].as_u64().expect("a number");
    assert_eq!(lost, 0, "what the gap cut off is not lost");
}

// A recording in the place of a bus.

fn moved(options: Options) -> (String, Vec<String>) {
    let (outcome, heard) = run(load("demo.toml"), options);
    if let Err(error) = outcome.result {
        panic!("{error}; {:?}", heard.warnings());
    }
    let mut summary = serde_json::to_value(outcome.summary.expect("a summary")).expect("JSON");
    // Of the recording itself.
    for key in ["recorded_frames", "recorded_frames_dropped"] {
        summary.as_object_mut().expect("an object").remove(key);
    }
    let told = heard
        .0
        .iter()
        .filter(|progress| !matches!(progress, Progress::Status(_)));
    (
        summary.to_string(),
        told.map(|progress| format!("{progress:?}")).collect(),
    )
}

#[test]
fn a_replayed_run_has_the_same_outcome() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("run.pcapng");
    let once = Options {
        repeat: Some(1),
        ..virtual_time()
    };
    let first = moved(Options {
        record: Some(path.clone()),
        ..once.clone()
    });
    // Recorded again, the replay has the same bytes at the same times.
    let again = folder.path().join("again.pcapng");
    let second = moved(Options {
        replay: Some(path.clone()),
        record: Some(again.clone()),
        ..once
    });
    assert_eq!(first, second);
    assert!(
        std::fs::read(path).expect("a recording") == std::fs::read(again).expect("a recording")
    );
}

#[test]
fn a_run_that_deviates_is_told_where() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let once = Options {
        repeat: Some(1),
        ..virtual_time()
    };
    let path = recorded(folder.path(), load("demo.toml"), once.clone());
    let replay = || Options {
        replay: Some(path.clone()),
        ..once.clone()
    };
    // Another target: the same frames with other set-points. Axes that do not obey are noticed.
    let text =
        std::fs::read_to_string(root().join("configs/demo.toml")).expect("the demonstration");
    let other = machine(&text.replace("x = 50.0, y = 50.0", "x = 40.0, y = 50.0"));
    let (outcome, heard) = run(other, replay());
    assert!(outcome.result.is_err());
    let told = heard.warnings().join("\n");
    assert!(
        told.contains("of the data is 0x") && told.contains("frame "),
        "{told}"
    );
    // More devices than were there: the recording ends, or has something else; nothing hangs.
    let (outcome, heard) = run(machine(&axes(3)), replay());
    let error = outcome
        .result
        .expect_err("the recording has two devices")
        .to_string();
    let told = heard.warnings().join("\n");
    assert!(told.contains("recording"), "{error}\n{told}");
    // A recording without answers is none.
    let empty = folder.path().join("empty.pcapng");
    std::fs::write(&empty, b"\n\r\r\n").expect("written");
    let (outcome, _) = run(
        load("demo.toml"),
        Options {
            replay: Some(empty),
            ..once
        },
    );
    assert!(
        outcome
            .result
            .expect_err("refused")
            .to_string()
            .contains("the replay"),
        "says what"
    );
}

// Nothing that is in a file may be more than a remark.

/// The first part of a run, configuration and some cycles.
fn sample() -> &'static [u8] {
    static SAMPLE: std::sync::OnceLock<Vec<u8>> = std::sync::OnceLock::new();
    SAMPLE.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let options = Options {
            repeat: Some(1),
            ..virtual_time()
        };
        let path = recorded(folder.path(), machine(&axes(1)), options);
        let mut bytes = std::fs::read(path).expect("the recording");
        bytes.truncate(120_000);
        bytes
    })
}

fn survives(bytes: &[u8]) {
    let report = analyzed(bytes, Known::default());
    well_formed(&analyze::html("x", &report));
    serde_json::to_string(&report).expect("JSON");
}

#[test]
fn every_capture_cut_anywhere() {
    let mut tried = 0;
    for path in captures() {
        let bytes = std::fs::read(&path).expect("readable");
        let whole = of_file(&path);
        // Every byte of short ones and of the ends, some of the others.
        let step = if bytes.len() < 2_000 {
            1
        } else {
            bytes.len() / 60
        };
        let ends = (0..bytes.len())
            .step_by(step)
            .chain(bytes.len() - 120..bytes.len());
        for end in ends {
            let report = analyzed(&bytes[..end], Known::default());
            assert!(report.file.ethercat_frames <= whole.file.ethercat_frames);
            assert!(report.devices.len() <= whole.devices.len(), "cut at {end}");
            tried += 1;
        }
    }
    println!("{tried} cuts");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    #[test]
    fn damage_is_a_remark(
        cut in 0_usize..120_000,
        flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..60),
        noise in prop::collection::vec(any::<u8>(), 0..300),
        at in any::<prop::sample::Index>(),
    ) {
        let mut bytes = sample().to_vec();
        bytes.truncate(cut.max(100));
        for (place, value) in flips {
            let place = place.index(bytes.len());
            bytes[place] = value;
        }
        let at = at.index(bytes.len());
        bytes.splice(at..at, noise);
        survives(&bytes);
    }

    /// Sound files with hostile frames: what is inside is noise.
    #[test]
    fn hostile_frames(seed in prop::collection::vec(any::<(u8, u16, u16, Vec<u8>, u16)>(), 1..40)) {
        let mut file = Vec::new();
        for word in [0xa1b2_3c4d_u32, 0x0004_0002, 0, 0, 65_535, 1] {
            file.extend(word.to_le_bytes());
        }
        for (n, (command, adp, ado, data, wkc)) in seed.iter().enumerate() {
            for way in [0x10_u8, 0x12] {
                let data = &data[..data.len().min(200)];
                let len = data.len() as u16;
                let mut frame = vec![0xff; 6];
                frame.extend([way, 1, 1, 1, 1, 1, 0x88, 0xa4]);
                frame.extend((0x1000 | (len + 12)).to_le_bytes());
                // Registers and mailboxes that mean something are met more often than not.
                let ado = [0x10, 0x120, 0x130, 0x502, 0x508, 0x600, 0x800, 0x910, 0x92c, 0x1000, 0x1800, *ado];
                frame.extend([command % 16, n as u8]);
                frame.extend((adp % 4).to_le_bytes());
                frame.extend(ado[usize::from(*wkc) % ado.len()].to_le_bytes());
                frame.extend(len.to_le_bytes());
                frame.extend([0, 0]);
                frame.extend(data);
                frame.extend(if way == 0x10 { 0 } else { wkc % 4 }.to_le_bytes());
                let kept = frame.len() as u32;
                for word in [1, n as u32 * 1000, kept, kept] {
                    file.extend(word.to_le_bytes());
                }
                file.extend(frame);
            }
        }
        survives(&file);
    }
}
