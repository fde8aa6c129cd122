//! Faults on the simulated bus, and the fault report of each. Virtual time.
//!
//! `ECAXIS_UPDATE_SNAPSHOTS=1` writes the first lines in `tests/snapshots/fault_reports.txt` again;
//! review the difference.

mod causes;

use std::fmt::Write;
use std::sync::Arc;

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::{self, Clock};
use ecaxis_master::config::Machine;
use ecaxis_master::post_mortem::{DiagnosedCause, FaultReport};
use ecaxis_master::rt::controller::{Controller, CycleContext};
use ecaxis_master::session::{Options, run_with};
use ecaxis_test_support::program::{self, Ran};
use ecaxis_test_support::{
    Heard, assert_contains, assert_fits, assert_snapshot, axes, faults, fixture, machine, root,
    run, run_well, virtual_time, with_our_esi,
};

/// Runs a machine that must fail and returns its fault report.
#[track_caller]
fn fault_report_of(machine: Machine, options: Options) -> FaultReport {
    let (outcome, heard) = run(machine, options);
    let Err(error) = outcome.result else {
        panic!("the run must fail; {:?}", heard.warnings());
    };
    match outcome.fault_report {
        Some(fault_report) => *fault_report,
        None => panic!("no fault report of {error}"),
    }
}

/// Returns name, machine file and fault script of each case.
fn staged() -> Vec<(&'static str, String, &'static str)> {
    let patient = axes(3).replace("cycle =", "lost_frames = 90\ncycle =");
    vec![
        (
            "cable break between two devices",
            axes(3),
            "[[fault]]\nkind = \"link-break\"\nat = \"1.5s\"\ndevice = 1\nport = 0\n",
        ),
        (
            "CRC errors on one port",
            axes(3),
            "[[fault]]\nkind = \"frame-corrupt\"\nat = \"1.5s\"\nprobability = 0.6\ndevice = 1\nport = 0\n",
        ),
        (
            "CRC errors on the way back",
            axes(3),
            "[[fault]]\nkind = \"frame-corrupt\"\nat = \"1.5s\"\nprobability = 0.6\ndevice = 1\nport = 1\n",
        ),
        (
            "drive undervoltage",
            axes(3),
            "[[fault]]\nkind = \"drive-fault\"\nat = \"1.5s\"\ndevice = 1\ncode = 0x3220\n",
        ),
        (
            "wrong ESI revision",
            axes(3),
            "[[fault]]\nkind = \"identity\"\ndevice = 1\nrevision = 0x00020000\n",
        ),
        (
            "PDO length refused",
            axes(3),
            "[[fault]]\nkind = \"refuse-state\"\ndevice = 1\nstate = \"safeop\"\ncode = 0x001e\n",
        ),
        (
            "PDO assignment too long",
            axes(3),
            "[[fault]]\nkind = \"sdo-abort\"\ndevice = 2\nindex = 0x1c13\nsub = 0\ncode = 0x06040042\n",
        ),
        (
            "watchdog",
            axes(3),
            "[[fault]]\nkind = \"watchdog\"\nat = \"1.5s\"\ndevice = 1\n",
        ),
        (
            "frames vanish for a while",
            patient.clone(),
            "[[fault]]\nkind = \"frame-loss\"\nat = \"1.5s\"\nfor = \"300ms\"\nprobability = 1.0\n",
        ),
        (
            "SYNC0 too late",
            axes(3),
            "[[fault]]\nkind = \"sync-late\"\ndevice = 2\ndelay = \"30s\"\n",
        ),
        (
            "mailbox dead",
            axes(3),
            "[[fault]]\nkind = \"mailbox-silent\"\ndevice = 1\n",
        ),
        (
            "another MainDevice takes the bus",
            axes(3),
            "[[fault]]\nkind = \"other-main-device\"\nat = \"1.2s\"\nprobability = 0.2\n\
             [[fault]]\nkind = \"other-main-device\"\nat = \"1.5s\"\ncount = 1\nstate = \"preop\"\n",
        ),
        (
            "device power-cycled",
            axes(3),
            "[[fault]]\nkind = \"power-off\"\nat = \"1.5s\"\nfor = \"300ms\"\ndevice = 1\n",
        ),
        (
            "last device without power",
            axes(3),
            "[[fault]]\nkind = \"power-off\"\nat = \"1.5s\"\ndevice = 2\n",
        ),
        (
            "cable of this computer unplugged",
            axes(3),
            "[[fault]]\nkind = \"silent\"\nat = \"1.5s\"\n",
        ),
        (
            "cable of this computer loose",
            patient,
            "[[fault]]\nkind = \"silent\"\nat = \"1.5s\"\nfor = \"300ms\"\n",
        ),
        (
            "frames come back too late",
            axes(3),
            "[[fault]]\nkind = \"frame-delay\"\nat = \"1.5s\"\nprobability = 1.0\ndelay = \"1.2ms\"\n",
        ),
        (
            "a device is missing from the start",
            axes(3),
            "[[fault]]\nkind = \"absent\"\ndevice = 1\n",
        ),
        (
            "a drive follows badly",
            axes(3),
            "[[fault]]\nkind = \"blocked\"\nat = \"1.5s\"\ndevice = 2\n",
        ),
    ]
}

/// A controller whose computation takes far too long in one cycle.
struct Slow {
    at: u64,
    for_ns: u64,
}

impl Controller for Slow {
    fn cycle(&mut self, cycle: &mut CycleContext<'_>) {
        if cycle.number() == self.at {
            Clock::Virtual.sleep_until(clock::now() + self.for_ns, 0);
        }
    }
}

fn overloaded(for_ns: u64) -> FaultReport {
    let stop = Arc::<CancelToken>::default();
    let controller = Box::new(Slow { at: 1500, for_ns });
    let mut heard = Heard::default();
    let outcome = run_with(
        machine(&axes(3)),
        virtual_time(),
        stop,
        &mut heard,
        controller,
    );
    assert!(outcome.result.is_err());
    *outcome.fault_report.expect("a fault report")
}

#[test]
fn another_main_device_during_bring_up_is_reported_as_cause() {
    for at in [50, 70, 90, 110, 150, 200] {
        let script = format!(
            "[[fault]]\nkind = \"other-main-device\"\nat = \"{at}ms\"\ncount = 1\nstate = \"init\"\n"
        );
        let reported = fault_report_of(machine(&axes(2)), faults(&script));
        let names = reported
            .headline
            .contains("another MainDevice is on this wire");
        assert!(names, "{at} ms: {}", reported.headline);
        assert!(
            reported.headline.contains("`a0`"),
            "{at} ms: {}",
            reported.headline
        );
    }
}

#[test]
fn first_lines_match_the_snapshot() {
    let mut text = String::new();
    for (name, machine_file, script) in staged() {
        let fault_report = fault_report_of(machine(&machine_file), faults(script));
        let _ = write!(text, "{name}\n  {}\n", fault_report.headline);
        for also in &fault_report.also {
            let _ = writeln!(text, "  also: {also}");
        }
    }
    let fault_report = overloaded(250_000_000);
    let _ = write!(text, "overload of the host\n  {}\n", fault_report.headline);
    assert_snapshot("fault_reports.txt", &text);
}

/// A real drive's ESI. The drive confirms 0x60C2 but ignores its value. With the cycle as its
/// value, the drive follows closely enough.
#[test]
fn a_drive_without_the_cycle_time_is_reported() {
    let Some(esi) = fixture("esi/maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml") else {
        return;
    };
    let text = axes(1)
        .replace("esi/EPOS4.xml", esi.to_str().expect("UTF-8"))
        .replace("\"1ms\"", "\"4ms\"")
        .replace("following_error = 1.0", "following_error = 0.44");
    run_well(machine(&text), virtual_time());
    let script = "[[fault]]\nkind = \"sdo-ignored\"\nindex = 0x60c2\nsub = 1\n";
    let fault_report = fault_report_of(machine(&text), faults(script));
    let first = "`a0` (position 0): the drive did not receive the cycle of 4 ms (0x60C2 is 0); then: `a0`: following error ";
    assert!(
        fault_report.headline.starts_with(first),
        "{}",
        fault_report.headline
    );
}

/// The report contains cycles before the stop with its causes, and cycles after it with its
/// effects.
#[test]
fn the_cycles_around_the_stop_are_kept() {
    let script = "[[fault]]\nkind = \"drive-fault\"\nat = \"1.5s\"\ndevice = 1\ncode = 0x3220\n";
    let fault_report = fault_report_of(machine(&axes(2)), faults(script));
    let stop = fault_report.stop.expect("it ran").cycle;
    let numbers: Vec<u64> = fault_report
        .cycles
        .iter()
        .map(|page| page.cycle.number)
        .collect();
    assert_eq!(numbers.len(), 200);
    assert_eq!((numbers[0], numbers[199]), (stop - 150, stop + 49));
    let fault = |page: &ecaxis_master::post_mortem::report::CycleRecord| {
        page.axes[1].statusword & 0x08 != 0
    };
    let first = fault_report.cycles.iter().find(|page| fault(page));
    assert_eq!(first.map(|page| page.cycle.number), Some(stop));
    // The other axis is on its ramp, and its target changes within the limits.
    for pair in fault_report.cycles.windows(2) {
        let step = pair[1].axes[0].target_position - pair[0].axes[0].target_position;
        assert!(step.abs() <= 50.0 * 0.001 + 1e-9, "{step}");
    }
    assert_eq!(fault_report.axes.len(), 2);
    assert!(matches!(
        fault_report.cause,
        DiagnosedCause::Unexplained { .. }
    ));
    assert_eq!(fault_report.devices[1].error_code, Some(0x3220));
}

#[test]
fn the_same_run_gives_the_same_report() {
    let (_, text, script) = staged().swap_remove(1);
    let report =
        || serde_json::to_string(&fault_report_of(machine(&text), faults(script))).expect("JSON");
    assert_eq!(report(), report());
}

/// The user gets the cause on stderr, the page in a file, and the data next to the page and in
/// `--json`.
#[test]
fn a_failed_run_writes_its_report() {
    let folder = tempfile::tempdir().expect("a folder");
    let script = folder.path().join("faults.toml");
    let page = folder.path().join("why.txt");
    let text = "[[fault]]\nkind = \"link-break\"\nat = \"1.5s\"\ndevice = 1\n";
    std::fs::write(&script, text).expect("written");
    let run = |more: &[&str]| {
        let mut command = program::command();
        command.args(["run", "configs/demo.toml", "--virtual", "--faults"]);
        Ran::new(command.arg(&script).args(more))
    };
    let reports = || {
        let left = std::fs::read_dir(root()).expect("the folder").flatten();
        let names = left.map(|e| e.file_name().to_string_lossy().into_owned());
        let reports = names.filter(|name| name.starts_with("ecaxis-stop"));
        reports.collect::<std::collections::BTreeSet<_>>()
    };
    let before = reports();
    let cause = "`y` (position 1) is out of reach: port 1 of `x` has no link";
    let output = run(&["--fault-report", page.to_str().expect("UTF-8")]);
    let stderr = output.exits(1).err;
    let reported: Vec<&str> = stderr
        .lines()
        .skip_while(|line| !line.starts_with("cause: "))
        .take_while(|line| !line.starts_with("error: "))
        .collect();
    assert!(
        reported.first().is_some_and(|l| l.contains(cause)),
        "{stderr}"
    );
    assert!(reported.len() <= 20, "{stderr}");
    assert_contains(&stderr, &["= help: look at the link lights"]);
    let text = std::fs::read_to_string(&page).expect("a page");
    assert!(text.starts_with(cause), "{text}");
    let sections = [
        "What to do",
        "in order",
        "SubDevices",
        "lost links",
        "cycles",
    ];
    assert_contains(&text, &sections);
    assert_fits(&text);
    assert_fits(&reported.join("\n"));
    let json = std::fs::read(page.with_extension("json")).expect("the JSON file");
    let json: serde_json::Value = serde_json::from_slice(&json).expect("JSON");
    assert_eq!(json["cause"]["cause"], "out-of-reach");
    assert_eq!(json["cycles"].as_array().map(Vec::len), Some(200));

    // Only `--force` replaces the page, or a file in the place of the data.
    let again = ["--fault-report", page.to_str().expect("UTF-8"), "--force"];
    run(&again).exits(1);
    run(&again[..2]).exits(2);
    std::fs::write(folder.path().join("package.json"), "{\"name\": 1}").expect("written");
    for (name, refused) in [
        ("package.txt", "package.json exists already"),
        ("why.json", "is the file of the JSON data"),
    ] {
        let name = folder.path().join(name);
        run(&["--fault-report", name.to_str().expect("UTF-8")]).fails(2, &[refused]);
    }

    // A run on the simulated bus is repeatable, so its report is stored only on request.
    let json = run(&["--json"]).json();
    assert_eq!(json["ok"], false);
    assert!(
        json["fault_report"]["headline"]
            .as_str()
            .is_some_and(|h| h.starts_with(cause))
    );
    assert_eq!(reports(), before);
}

#[test]
fn a_successful_or_interrupted_run_has_no_report() {
    let (outcome, _) = run(machine(&axes(1)), virtual_time());
    assert!(outcome.result.is_ok() && outcome.fault_report.is_none());
    let stop = Arc::<CancelToken>::default();
    stop.cancel();
    let mut heard = Heard::default();
    let outcome = ecaxis_master::session::run(machine(&axes(1)), virtual_time(), stop, &mut heard);
    assert!(outcome.result.is_err() && outcome.fault_report.is_none());
}
