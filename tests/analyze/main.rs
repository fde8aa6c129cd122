//! `ecaxis analyze` on recordings of real buses and of ecaxis runs: complete, cut and damaged. Also
//! recordings as a bus (replay).
//!
//! `ECAXIS_UPDATE_SNAPSHOTS=1` writes `tests/snapshots/analyze` again; review the difference.

mod absences;
mod al_status;
mod hostile;
mod mcap;
mod replay;
mod tshark;

use std::path::{Path, PathBuf};

use ecaxis_master::config::Machine;
use ecaxis_master::recording::Reader;
use ecaxis_master::recording::frame::{Content, Frame, content};
use ecaxis_master::session::Options;
use ecaxis_test_support::program::{self, Ran};
use ecaxis_test_support::{
    assert_contains, assert_fits, assert_snapshot, assert_well_formed, axes, faults, fixture, load,
    machine, root, run, run_well, virtual_time,
};
use ecaxis_tools::analyze::{self, Context, Report};

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

fn analyzed(bytes: &[u8], known: Context) -> Report {
    analyze::analyze(vec![Reader::new(bytes)], None, known)
}

fn of_file(path: &Path) -> Report {
    analyzed(&std::fs::read(path).expect("readable"), Context::default())
}

fn ecaxis(arguments: &[&str]) -> Ran {
    program::run([&["analyze"], arguments].concat())
}

/// Runs a machine in virtual time and returns its recording.
fn recorded(folder: &Path, machine: Machine, options: Options) -> PathBuf {
    let (options, path) = ecaxis_test_support::recorded(options, folder);
    run_well(machine, options);
    path
}

#[test]
fn analyze_matches_the_snapshot_of_every_capture() {
    for path in captures() {
        let now = ecaxis(&[path.to_str().expect("UTF-8")]).exits(0).out;
        assert_fits(&now);
        let name = path.file_name().expect("a name").to_str().expect("UTF-8");
        let name = name.split('.').next().expect("a stem");
        assert_snapshot(&format!("analyze/{name}.txt"), &now);
    }
}

#[test]
fn analyze_reports_bring_up_cycle_and_motion_of_an_own_run() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options = Options {
        repeat: Some(1),
        ..virtual_time()
    };
    let path = recorded(folder.path(), load("demo.toml"), options);
    let bytes = std::fs::read(&path).expect("the recording");
    let report = analyzed(&bytes, Context::default().with_machine(&load("demo.toml")));
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
    let [cycle, mailboxes] = &report.cycle[..] else {
        panic!("{:?}", report.cycle);
    };
    assert_eq!((mailboxes.command, mailboxes.bytes), ("LRD", 2));
    assert_eq!((mailboxes.usual_wkc, mailboxes.lost), (Some(2), 0));
    // The cycle of SYNC0 is 1 ms, and the reference clock is 18 ppm fast.
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
            ["Position", "Following error", "Velocity", "Torque"]
        );
    }
    assert_eq!(report.axes.len(), 2);

    // The recording contains the PDOs. Without the machine file, only names and units are missing.
    let alone = analyzed(&bytes, Context::default());
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

    let html = analyze::document("run.pcapng", &report, &[], true).html();
    assert!(html.contains("<th>states</th>"), "{html}");
    let states = report.devices[0].states.join(" → ");
    assert!(html.contains(&format!("<td>{states}</td>")), "{states}");
    let (charts, _) = assert_well_formed(&html);
    assert_eq!(
        charts,
        2 * 5,
        "state, position, following error, velocity and torque of each"
    );
}

#[test]
fn analyze_reports_injected_faults() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let reported = |script: &str| {
        let path = folder.path().join("run.pcapng");
        let options = Options {
            record: Some(path.clone()),
            ..faults(script)
        };
        let (outcome, _) = run(machine(&axes(2)), options);
        assert!(outcome.result.is_err(), "a fault that stops the machine");
        of_file(&path)
    };
    let report = reported(
        "[[fault]]\nkind = \"frame-loss\"\nat = \"1s\"\ncount = 2\n\
         [[fault]]\nkind = \"drive-fault\"\nat = \"1500ms\"\ndevice = 1\ncode = 0x3210\n",
    );
    assert_eq!(report.file.lost, 2, "{:?}", report.trouble);
    let all = report.trouble.join("\n");
    assert!(all.contains("2 frames of"), "{all}");
    assert!(all.contains("Fault reaction active"), "{all}");
    assert!(
        !all.contains("interval"),
        "a lost frame was sent in time:\n{all}"
    );
    let faulted = |n: usize| {
        report.axes[n]
            .states
            .iter()
            .any(|(_, state)| state == "Fault")
    };
    assert!(faulted(1) && !faulted(0));

    let report = reported(
        "[[fault]]\nkind = \"refuse-state\"\ndevice = 0\nstate = \"safeop\"\ncode = 0x001e\n",
    );
    let first = &report.trouble[0];
    assert!(
        first.contains("PreOp with error 0x001e, invalid input configuration"),
        "{first}"
    );
    assert_eq!(report.devices[0].al_errors, [0x1e]);
    // The way back to Init acknowledges the error.
    assert!(!report.devices[0].al_error && !report.devices[1].al_error);
    let path = folder.path().join("run.pcapng");
    let page = ecaxis(&[path.to_str().expect("UTF-8")]).out;
    assert!(
        page.contains("help: EPOS4, 0x001e: the length of the inputs'"),
        "{page}"
    );

    let report = reported(
        "[[fault]]\nkind = \"sdo-abort\"\ndevice = 1\nindex = 0x6060\nsub = 0\ncode = 0x06090030\n",
    );
    let first = &report.trouble[0];
    for part in [
        "write 0x6060:00 (Modes of operation)",
        "0x06090030, the value is out of range",
    ] {
        assert!(first.contains(part), "{:?}", report.trouble);
    }
    let failed = report
        .transfers
        .iter()
        .find(|t| t.write && t.ended == "aborted");
    let failed = failed.expect("the transfer");
    assert_eq!(
        (failed.device, failed.index, failed.code),
        (1, 0x6060, Some(0x0609_0030))
    );
}

/// Returns a pcap of the packets that `keep` accepts.
fn filtered(bytes: &[u8], keep: impl Fn(&Frame) -> bool) -> Vec<u8> {
    let mut reader = Reader::new(bytes);
    let mut file = Vec::new();
    for word in [0xa1b2_3c4d_u32, 0x0004_0002, 0, 0, 65_535, 1] {
        file.extend(word.to_le_bytes());
    }
    while let Some(packet) = reader.next() {
        let (at, data) = (packet.at.expect("a time"), packet.data.clone());
        let Content::Frame(frame) = content(packet) else {
            continue;
        };
        if keep(&frame) {
            let len = u32::try_from(data.len()).expect("a frame");
            let (seconds, nanos) = (at / 1_000_000_000, at % 1_000_000_000);
            for word in [seconds as u32, nanos as u32, len, len] {
                file.extend(word.to_le_bytes());
            }
            file.extend(data);
        }
    }
    file
}

/// A recording without the start-up SDOs does not show the PDO contents.
#[test]
fn missing_pdo_contents_come_from_the_machine_file_or_esi_files() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let once = Options {
        repeat: Some(1),
        ..virtual_time()
    };
    let path = recorded(folder.path(), load("demo.toml"), once);
    let bytes = std::fs::read(path).expect("the recording");
    let mailbox = |frame: &Frame| {
        frame
            .datagrams
            .iter()
            .any(|d| !d.command.is_logical() && d.ado() >= 0x1000)
    };
    let without = filtered(&bytes, |frame| !mailbox(frame));
    let alone = analyzed(&without, Context::default());
    assert!(alone.transfers.is_empty() && alone.axes.is_empty());
    let whole = analyzed(&bytes, Context::default());
    let known = Context::default().with_machine(&load("demo.toml"));
    let report = analyzed(&without, known);
    let moved = |report: &Report| -> Vec<_> {
        report
            .axes
            .iter()
            .map(|a| (a.cycles, a.states.clone()))
            .collect()
    };
    assert_eq!(moved(&report), moved(&whole));
    let library = analyze::library(&root().join("configs/esi")).expect("our ESI files");
    let by_esi = analyzed(&without, Context::default().with_library(library));
    let names: Vec<_> = by_esi
        .devices
        .iter()
        .filter_map(|d| d.name.as_deref())
        .collect();
    assert_eq!(names, ["EPOS4", "IDX"]);

    // Each direction alone still yields its part of the report.
    let answers = analyzed(
        &filtered(&bytes, |frame| frame.source[0] & 2 != 0),
        Context::default(),
    );
    assert_eq!(
        (answers.file.sent, answers.file.without_request),
        (0, whole.file.answered)
    );
    let stations =
        |report: &Report| -> Vec<_> { report.devices.iter().map(|d| d.station).collect() };
    assert_eq!(stations(&answers), stations(&whole));
    assert_eq!(answers.transfers.len(), whole.transfers.len());
    assert_eq!(answers.cycle[0].wkc, whole.cycle[0].wkc);
    let requests = analyzed(
        &filtered(&bytes, |frame| frame.source[0] & 2 == 0),
        Context::default(),
    );
    assert!(
        requests.trouble[0].contains("no frame came back"),
        "{:?}",
        requests.trouble
    );
    assert_eq!(requests.cycle[0].count, whole.cycle[0].count);
}

#[test]
fn analyze_rejects_unusable_input_with_a_reason() {
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
        let ran = ecaxis(&[&path]).exits(code);
        assert_contains(&(ran.out + &ran.err), &[part]);
        let json = ecaxis(&[&path, "--json"]);
        if code == 1 {
            let json = json.json();
            assert_eq!(json["file"]["ethercat_frames"], 0);
        }
    }
}

#[test]
fn parts_of_a_recording_are_joined() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options = Options {
        record_limit: Some(2_000_000),
        limit: Some(8_000_000_000),
        ..virtual_time()
    };
    let first = recorded(folder.path(), load("demo.toml"), options);
    let parts = ecaxis_master::link::capture::parts_of(&first).expect("a folder");
    assert_eq!(parts.len(), 3);
    // In shell sort order, the first part is the last argument.
    let mut arguments: Vec<&str> = parts.iter().filter_map(|path| path.to_str()).collect();
    arguments.push(first.to_str().expect("UTF-8"));
    arguments.push("--json");
    let json = ecaxis(&arguments).json();
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
