//! Two processes, the simulated bus and the MainDevice, at the ends of a veth pair. Requires root.

use std::process::{Command, Stdio};
use std::time::Duration;

use ecaxis_master::link::SocketKind;
use ecaxis_test_support::host::over_a_pair;
use ecaxis_test_support::program::{self, ProgramOutput, ecaxis};
use ecaxis_test_support::{root, tolerant_demo};
use ecaxis_tools::bench::veth::VethPair;

/// The demo's bus at one end of the pair, and the machine file for the other end.
struct Served {
    _bus: ProgramOutput,
    file: tempfile::NamedTempFile,
}

/// A spinning real-time thread blocks other threads on its processor, and the scheduler may keep
/// two on one processor for seconds.
fn on_cpu_0() -> Command {
    let mut command = Command::new("taskset");
    command.args(["-c", "0"]).arg(ecaxis());
    command.current_dir(root()).stdin(Stdio::null());
    command
}

/// True if two processes can run on processors of their own.
pub(super) fn can_be_kept_apart() -> bool {
    let taskset = Command::new("taskset").arg("--version").output();
    std::thread::available_parallelism().is_ok_and(|n| n.get() > 1)
        && taskset.is_ok_and(|output| output.status.success())
}

/// Serves the bus, with `more` in the file's [bus].
fn serve(pair: &VethPair, more: &str) -> Served {
    let apart = can_be_kept_apart();
    let file = tempfile::Builder::new().suffix(".toml").tempfile();
    let file = file.expect("a temporary file");
    let cpu = if apart { "[bus]\ncpu = 1" } else { "[bus]" };
    let demo = tolerant_demo().replacen("[bus]", &format!("{cpu}\n{more}"), 1);
    std::fs::write(file.path(), demo).expect("written");
    let path = file.path().to_str().expect("a path in UTF-8");
    let mut command = if apart {
        on_cpu_0()
    } else {
        program::command()
    };
    command.args(["sim", path, "--nic", &pair.a]);
    let mut bus = ProgramOutput::start(command.stdout(Stdio::null()));
    bus.says("answer");
    Served { _bus: bus, file }
}

#[test]
fn the_demo_runs_over_a_real_interface() {
    over_a_pair(|pair| {
        let served = serve(&pair, "");
        let file = served.file.path().to_str().expect("a path in UTF-8");

        let output = program::command()
            .args(["run", file, "--nic", &pair.b, "--no-fault-report", "--json"])
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

/// The cable is disconnected and reconnected while the axes move: cycles are lost, link errors are
/// counted, and the run continues.
#[test]
fn a_run_survives_an_interface_that_goes_down_and_up() {
    over_a_pair(|pair| {
        for link in SocketKind::ALL {
            let served = serve(&pair, &format!("link = \"{link}\""));
            let file = served.file.path().to_str().expect("a path in UTF-8");
            let mut command = program::command();
            command.args(["run", file, "--nic", &pair.b, "--no-fault-report", "--json"]);
            let mut run = ProgramOutput::start(command.stdout(Stdio::piped()));
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

/// A firmware command on a bus with a running machine neither takes its frames nor hides the cause
/// from the user.
#[test]
fn firmware_commands_do_not_disturb_a_running_machine() {
    over_a_pair(|pair| {
        let served = serve(&pair, "");
        let file = served.file.path().to_str().expect("a path in UTF-8");
        let mut command = program::command();
        command.args([
            "run",
            file,
            "--nic",
            &pair.b,
            "--no-fault-report",
            "--json",
            "--for",
            "10min",
        ]);
        let mut run = ProgramOutput::start(command.stdout(Stdio::piped()));
        run.says("run 1, step 1: ");
        let during = |arguments: &[&str]| {
            let arguments = [arguments, &["--nic", &pair.b]].concat();
            let output = program::command()
                .args(arguments)
                .output()
                .expect("the binary runs");
            let reported = String::from_utf8_lossy(&output.stderr).into_owned();
            (output.status.code(), reported)
        };
        let another = "another MainDevice is active on this bus";
        for _ in 0..3 {
            let (code, reported) = during(&["firmware", "info", file, "x"]);
            assert_eq!(code, Some(0), "{reported}");
            assert!(reported.contains(another), "{reported}");
        }
        let (code, reported) = during(&["firmware", "info", "--position", "0"]);
        assert!(code == Some(0) && reported.contains(another), "{reported}");
        let program = "Cargo.toml";
        let (code, reported) = during(&["firmware", "update", file, "x", program, "--yes"]);
        assert_eq!(code, Some(1), "{reported}");
        // The command fails before its first request, because the machine owns the interface.
        assert!(reported.contains("another ecaxis (pid "), "{reported}");
        for command in [&["store", file, "x"][..], &["defaults", file, "x", "--yes"]] {
            let (code, reported) = during(&[&["sdo"], command].concat());
            assert_eq!(code, Some(1), "{reported}");
            assert!(reported.contains("is in Op: parameters are"), "{reported}");
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

/// Ctrl-C in the middle of an update leaves no device in Bootstrap and reports the interrupted
/// step.
#[test]
fn a_cancelled_update_leaves_its_device_in_init() {
    over_a_pair(|pair| {
        let served = serve(&pair, "");
        let file = served.file.path().to_str().expect("a path in UTF-8");
        let folder = tempfile::tempdir().expect("a folder");
        let program = folder.path().join("new.bin");
        let program = program.to_str().expect("a path in UTF-8");
        let run = |arguments: &[&str]| {
            program::command()
                .args(arguments)
                .output()
                .expect("the binary runs")
        };
        let sample = ["firmware", "sample", file, "x", "-o", program, "--size"];
        assert!(run(&[&sample[..], &["2MiB"]].concat()).status.success());

        let update = ["firmware", "update", file, "x", program, "--yes", "--nic"];
        let mut command = program::command();
        command.args(update).arg(&pair.b);
        let mut update = ProgramOutput::start(command.stdout(Stdio::null()));
        update.says("sending the file");
        update.interrupt();
        let output = update.end();
        let reported = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(130), "{reported}");
        for part in [
            "`x` (position 0",
            "sending the file: interrupted; the device is in Init",
            "the same command tries again",
        ] {
            assert!(reported.contains(part), "`{part}` is not in:\n{reported}");
        }
        let info = ["firmware", "info", file, "x", "--json", "--nic", &pair.b];
        let output = run(&info);
        let found: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
        assert_eq!(found["state"], "Init", "{found:#}");
    });
}
