//! Two processes, the simulated bus and the master, on the two ends of a veth pair. Needs root.

#![allow(clippy::print_stdout, reason = "what was counted")]

mod common;

use std::process::{Command, Stdio};
use std::time::Duration;

use common::root;
use common::wire::{Told, over_a_pair};
use ecaxis::bench::veth::VethPair;
use ecaxis::link::BackEnd;

/// The demo's bus on one end of the pair, and the machine file for the other.
struct Served {
    _bus: Told,
    file: tempfile::NamedTempFile,
}

fn ecaxis() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ecaxis"));
    command.current_dir(root()).stdin(Stdio::null());
    command
}

/// A thread that spins with real-time priority leaves nothing to another on its processor, and the scheduler may let them
/// share one for seconds.
fn on_cpu_0() -> Command {
    let mut command = Command::new("taskset");
    command.args(["-c", "0", env!("CARGO_BIN_EXE_ecaxis")]);
    command.current_dir(root()).stdin(Stdio::null());
    command
}

fn can_be_kept_apart() -> bool {
    let taskset = Command::new("taskset").arg("--version").output();
    std::thread::available_parallelism().is_ok_and(|n| n.get() > 1)
        && taskset.is_ok_and(|output| output.status.success())
}

/// With `more` in the file's [bus].
fn serve(pair: &VethPair, more: &str) -> Served {
    let apart = can_be_kept_apart();
    // The demo, but patient: a busy test machine may hold either process up for long, and both ends share its processors.
    let demo = std::fs::read_to_string(root().join("configs/demo.toml")).expect("the demo");
    let file = tempfile::Builder::new()
        .prefix("test-veth-")
        .suffix(".toml")
        .tempfile_in(root().join("configs"))
        .expect("a temporary file");
    let cpu = if apart { "cpu = 1" } else { "" };
    let patient = format!("lost_frames = 1000\nwatchdog = \"6s\"\n{cpu}\n{more}");
    std::fs::write(file.path(), demo.replace("lost_frames = 20", &patient)).expect("written");
    let path = file.path().to_str().expect("a path in UTF-8");
    let mut command = if apart { on_cpu_0() } else { ecaxis() };
    command.args(["sim", path, "--nic", &pair.a]);
    let mut bus = Told::start(command.stdout(Stdio::null()));
    bus.says("answer");
    Served { _bus: bus, file }
}

#[test]
fn the_demo_over_a_real_interface() {
    over_a_pair(|pair| {
        let served = serve(&pair, "");
        let file = served.file.path().to_str().expect("a path in UTF-8");

        let output = ecaxis()
            .args(["run", file, "--nic", &pair.b, "--no-story", "--json"])
            .output()
            .expect("the binary runs");
        let errors = String::from_utf8_lossy(&output.stderr);
        let result: serde_json::Value =
            serde_json::from_slice(&output.stdout).unwrap_or_else(|e| {
                panic!("{e}: {}; {errors}", String::from_utf8_lossy(&output.stdout))
            });
        assert!(output.status.success(), "{errors}\n{result:#}");
        let summary = &result["summary"];
        let axes = summary["axes"].as_array().expect("axes");
        assert_eq!(axes.len(), 2);
        for axis in axes {
            let error = axis["final_error_counts"].as_i64().expect("CSP");
            assert!(error.abs() <= 1, "{axis:#}");
        }
        assert_eq!(summary["program_runs"], 2);
        let thread = &summary["thread"];
        assert!(
            thread["cpu_ns"].as_u64().is_some_and(|ns| ns > 0),
            "{thread:#}"
        );
        if !errors.contains("memory cannot be locked") {
            assert_eq!(thread["minor_faults"], 0, "{thread:#}");
            assert_eq!(thread["major_faults"], 0, "{thread:#}");
        }
    });
}

/// The cable is pulled and put back while the axes move: lost cycles, link errors, and on it goes.
#[test]
fn an_interface_goes_down_and_up_again_while_the_machine_runs() {
    over_a_pair(|pair| {
        for link in BackEnd::ALL {
            let served = serve(&pair, &format!("link = \"{link}\""));
            let file = served.file.path().to_str().expect("a path in UTF-8");
            let mut command = ecaxis();
            command.args(["run", file, "--nic", &pair.b, "--no-story", "--json"]);
            let mut run = Told::start(command.stdout(Stdio::piped()));
            run.says("run 1, step 1: ");
            pair.set(&pair.b, false).expect("down");
            std::thread::sleep(Duration::from_millis(100));
            pair.set(&pair.b, true).expect("up");
            let output = run.end();
            let errors = String::from_utf8_lossy(&output.stderr);
            let result: serde_json::Value =
                serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {errors}"));
            println!("{link}: {:#}\n{errors}", result["summary"]["counters"]);
            let counters = &result["summary"]["counters"];
            assert!(
                counters["link_errors"].as_u64().is_some_and(|n| n > 0),
                "{result:#}"
            );
            assert!(
                counters["lost_frames"].as_u64().is_some_and(|n| n > 0),
                "{result:#}"
            );
            assert!(output.status.success(), "{link}: {errors}\n{result:#}");
        }
    });
}

/// What works on one device of a bus that a machine drives neither takes its frames nor leaves it in the dark.
#[test]
fn firmware_beside_a_machine_disturbs_nothing() {
    over_a_pair(|pair| {
        let served = serve(&pair, "");
        let file = served.file.path().to_str().expect("a path in UTF-8");
        let mut command = ecaxis();
        command.args([
            "run",
            file,
            "--nic",
            &pair.b,
            "--no-story",
            "--json",
            "--for",
            "10min",
        ]);
        let mut run = Told::start(command.stdout(Stdio::piped()));
        run.says("run 1, step 1: ");
        let beside = |arguments: &[&str]| {
            let arguments = [arguments, &["--nic", &pair.b]].concat();
            let output = ecaxis().args(arguments).output().expect("the binary runs");
            let told = String::from_utf8_lossy(&output.stderr).into_owned();
            (output.status.code(), told)
        };
        let another = "another MainDevice is at work on this bus";
        for _ in 0..3 {
            let (code, told) = beside(&["firmware", "info", file, "x"]);
            assert_eq!(code, Some(0), "{told}");
            assert!(told.contains(another), "{told}");
        }
        let (code, told) = beside(&["firmware", "info", "--position", "0"]);
        assert!(code == Some(0) && told.contains(another), "{told}");
        let program = "Cargo.toml";
        let (code, told) = beside(&["firmware", "update", file, "x", program, "--yes"]);
        assert_eq!(code, Some(1), "{told}");
        // Before it has asked anything: the interface is the machine's.
        assert!(told.contains("another ecaxis (pid "), "{told}");
        for command in [&["store", file, "x"][..], &["defaults", file, "x", "--yes"]] {
            let (code, told) = beside(&[&["sdo"], command].concat());
            assert_eq!(code, Some(1), "{told}");
            assert!(told.contains("is in Op: parameters are"), "{told}");
        }

        run.interrupt();
        let output = run.end();
        let errors = String::from_utf8_lossy(&output.stderr);
        let result: serde_json::Value =
            serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {errors}"));
        let counters = &result["summary"]["counters"];
        assert_eq!(counters["refused_answers"], 0, "{counters:#}\n{errors}");
        assert!(errors.contains("all SubDevices in Init"), "{errors}");
    });
}

/// Ctrl-C in the middle of an update: no device is left in Bootstrap, and it is told what was under way.
#[test]
fn an_update_that_the_user_ends_leaves_its_device_in_init() {
    over_a_pair(|pair| {
        let served = serve(&pair, "");
        let file = served.file.path().to_str().expect("a path in UTF-8");
        let folder = tempfile::tempdir().expect("a folder");
        let program = folder.path().join("new.bin");
        let program = program.to_str().expect("a path in UTF-8");
        let run = |arguments: &[&str]| ecaxis().args(arguments).output().expect("the binary runs");
        let sample = ["firmware", "sample", file, "x", "-o", program, "--size"];
        assert!(run(&[&sample[..], &["2MiB"]].concat()).status.success());

        let update = ["firmware", "update", file, "x", program, "--yes", "--nic"];
        let mut command = ecaxis();
        command.args(update).arg(&pair.b);
        let mut update = Told::start(command.stdout(Stdio::null()));
        update.says("sending the file");
        update.interrupt();
        let output = update.end();
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(130), "{told}");
        for part in [
            "`x` (position 0",
            "sending the file: interrupted; the device is in Init",
            "the same command tries again",
        ] {
            assert!(told.contains(part), "`{part}` is not in:\n{told}");
        }
        let info = ["firmware", "info", file, "x", "--json", "--nic", &pair.b];
        let output = run(&info);
        let found: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
        assert_eq!(found["state"], "Init", "{found:#}");
    });
}
