//! `ecaxis bench` as a process: its output, its files, and its clean-up. No time is asserted.

#![allow(clippy::print_stdout, reason = "a skipped test says why")]

#[path = "common/wire.rs"]
mod wire;

use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;

const PATIENCE: Duration = Duration::from_secs(20);

fn ecaxis(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ecaxis"));
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    command
        .arg("bench")
        .args(arguments)
        .current_dir(root)
        .stdin(Stdio::null());
    command
}

fn run(arguments: &[&str]) -> Output {
    ecaxis(arguments).output().expect("the binary runs")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn json_contains_every_value_with_its_unit() {
    let folder = tempfile::tempdir().expect("a folder");
    let page = folder.path().join("report.html");
    let page = page.to_str().expect("UTF-8");
    let line = "--sim --axes 3 --cycle 2ms --seconds 1 --rounds 1 --against sleep --json --html";
    let arguments: Vec<&str> = line.split(' ').chain([page]).collect();
    let output = run(&arguments);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    for list in ["facts", "settings", "variants", "ratios", "remarks"] {
        assert!(report[list].is_array(), "{list}: {report:#}");
    }
    let variants = report["variants"].as_array().expect("variants");
    let names: Vec<_> = variants.iter().map(|v| v["name"].as_str()).collect();
    assert_eq!(names, [Some("ecaxis"), Some("sleeping")]);
    for variant in variants {
        let cycles = variant["cycles"].as_u64().expect("a number");
        assert!(cycles > 0);
        assert_eq!(variant["counters"]["cycles"], variant["cycles"]);
        for measure in ["wake_up_lateness", "work"] {
            let dist = &variant[measure];
            assert_eq!(dist["count"].as_u64(), Some(cycles), "{measure}");
            let (p50, max) = (dist["p50_ns"].as_u64(), dist["max_ns"].as_u64());
            assert!(p50.is_some() && p50 <= max, "{dist}");
            let steps = dist["histogram"].as_array().expect("steps");
            let sum: u64 = steps.iter().filter_map(|step| step[1].as_u64()).sum();
            assert_eq!(sum, cycles);
        }
        for number in [
            "cpu_ns_per_cycle",
            "cpu_percent",
            "context_switches_per_cycle",
        ] {
            assert!(variant[number].is_f64(), "{number}");
        }
        assert!(variant["used"]["minor_faults"].is_u64());
        assert!(variant["taken"]["steal_ns"].is_u64());
    }
    let ratio = &report["ratios"][0];
    assert_eq!(ratio["measure"], "wake_up_lateness");
    assert_eq!(
        (&ratio["of"], &ratio["to"]),
        (&"ecaxis".into(), &"sleeping".into())
    );
    assert!(ratio["p50"].is_f64());
    well_formed(&std::fs::read_to_string(page).expect("written"));
}

/// Checks that the page is well-formed XML without external references.
fn well_formed(page: &str) {
    use quick_xml::events::Event;
    let mut reader = quick_xml::Reader::from_str(page);
    reader.config_mut().check_end_names = true;
    let (mut open, mut charts, mut paths) = (0, 0, 0);
    loop {
        match reader.read_event().expect("well-formed") {
            Event::Start(e) => {
                open += 1;
                charts += usize::from(e.name().as_ref() == "svg");
                e.attributes().for_each(|a| {
                    a.expect("an attribute");
                });
            }
            Event::Empty(e) => paths += usize::from(e.name().as_ref() == "path"),
            Event::End(_) => open -= 1,
            Event::Eof => break,
            _ => {}
        }
    }
    assert_eq!(open, 0);
    // The charts: lateness, release to input, work; also the phase if it locked.
    assert!(charts >= 3, "{charts}");
    assert!(paths >= 2 * 3, "{paths}");
    for elsewhere in ["src=", "href=", "url(", "@import"] {
        assert!(!page.contains(elsewhere), "{elsewhere}");
    }
}

#[test]
fn the_table_fits_a_terminal() {
    let line = "--sim --axes 1 --cycle 2ms --seconds 1";
    let output = run(&line.split(' ').collect::<Vec<_>>());
    assert!(output.status.success(), "{}", text(&output.stderr));
    let table = text(&output.stdout);
    for line in table.lines() {
        assert!(line.chars().count() <= 80, "{line}");
    }
    for reported in [
        "Wake-up lateness",
        "Release to input",
        "Work",
        "p99.9",
        "Counted",
    ] {
        assert!(table.contains(reported), "{reported} in {table}");
    }
}

/// A machine file's simulated bus runs through a whole session.
#[test]
fn bench_runs_a_machine_file_on_its_simulated_bus() {
    let line = "--machine configs/demo.toml --sim --seconds 1 --json";
    let output = run(&line.split(' ').collect::<Vec<_>>());
    assert!(output.status.success(), "{}", text(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert!(report["variants"][0]["cycles"].as_u64() > Some(0));
    let settings = report["settings"].to_string();
    assert!(settings.contains("axes not enabled"), "{settings}");
}

#[test]
fn invalid_command_lines_exit_with_2() {
    for line in [
        "--cycle 1",
        "--against nothing-of-the-kind",
        "--axes 0",
        "--machine nowhere.toml",
        "--cycle 1ms --spin 2ms",
        "--sim --against Cargo.toml",
        "--machine configs/demo.toml --sim --cycle 123us",
        "--enable",
    ] {
        let output = run(&line.split(' ').collect::<Vec<_>>());
        let reported = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{line}: {reported}");
        assert!(reported.contains("error: "), "{reported}");
    }
}

struct Killed(Child);

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn soon(what: impl Fn() -> bool) -> bool {
    let start = Instant::now();
    while !what() {
        if start.elapsed() > PATIENCE {
            return false;
        }
        thread::sleep(Duration::from_millis(20));
    }
    true
}

/// Every end of a bench removes its interfaces.
#[test]
fn a_bench_leaves_no_interface_behind() {
    wire::over_a_pair(|_| {
        for signal in ["-INT", "-KILL"] {
            let line = "--axes 1 --cycle 5ms --seconds 100";
            let mut command = ecaxis(&line.split(' ').collect::<Vec<_>>());
            command.stdout(Stdio::null()).stderr(Stdio::null());
            let mut bench = Killed(command.spawn().expect("starts"));
            let nic = format!("/sys/class/net/ecx{}-0a", bench.0.id());
            let nic = Path::new(&nic);
            assert!(soon(|| nic.exists()), "an interface of its own");
            thread::sleep(Duration::from_millis(500));
            let kill = Command::new("kill")
                .args([signal, &bench.0.id().to_string()])
                .status();
            assert!(kill.expect("kill").success());
            let ended = bench.0.wait().expect("ended");
            let interrupted = ended.code() == Some(130);
            assert_eq!(interrupted, signal == "-INT", "{signal}: {ended}");
            assert!(soon(|| !nic.exists()), "{signal}");
        }
    });
}
