//! `ecaxis run --wait`: devices that are switched on after the command has started.

use std::process::Stdio;
use std::time::Duration;

use ecaxis_test_support::host::{over_a_pair, retry_if_host_stalled};
use ecaxis_test_support::program::{self, ProgramOutput};
use ecaxis_test_support::tolerant_demo;

fn file(folder: &tempfile::TempDir, name: &str, text: &str) -> String {
    let path = folder.path().join(name);
    std::fs::write(&path, text).expect("written");
    path.display().to_string()
}

/// Nothing answers, then one of two devices, then both: the machine runs as soon as both do.
#[test]
fn wait_starts_as_soon_as_all_devices_answer() {
    over_a_pair(|pair| {
        let folder = tempfile::tempdir().expect("a folder");
        let machine = file(&folder, "m.toml", &tolerant_demo());
        let fault = "[[fault]]\nkind = \"absent\"\ndevice = 1\n";
        let fault = file(&folder, "f.toml", fault);
        let serve = |more: &[&str]| {
            let arguments = [&["sim", &machine, "--nic", &pair.a], more].concat();
            let mut command = program::command();
            let mut bus = ProgramOutput::start(command.args(arguments).stdout(Stdio::null()));
            bus.says("answer");
            bus
        };
        let run = [
            "run",
            &machine,
            "--nic",
            &pair.b,
            "--wait",
            "--no-fault-report",
        ];
        let mut run = ProgramOutput::start(program::command().args(run).stdout(Stdio::piped()));
        run.says("waiting (Ctrl-C ends it): bring-up: no SubDevice answers");
        let half = serve(&["--faults", &fault]);
        run.says(
            "waiting (Ctrl-C ends it): bring-up: scanning: 1 of 2 SubDevices answers; missing: `y`",
        );
        half.interrupt();
        half.end();
        let _bus = serve(&[]);
        run.says("run 1, step 1: ");
        let output = run.end();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{errors}");
    });
}

/// Ctrl-C ends the waiting. So does an error of a device that a second attempt confirms.
#[test]
fn wait_ends_with_ctrl_c_and_other_errors() {
    retry_if_host_stalled(|| {
        let folder = tempfile::tempdir().expect("a folder");
        let machine = file(&folder, "m.toml", &tolerant_demo());
        let start = |fault: &str| {
            let fault = file(&folder, "f.toml", fault);
            let run = ["run", &machine, "--sim", "--faults", &fault, "--wait"];
            let mut command = program::command();
            let more = ["--no-fault-report", "--json"];
            ProgramOutput::start(command.args(run).args(more).stdout(Stdio::piped()))
        };
        let mut run = start("[[fault]]\nkind = \"absent\"\ndevice = 1\n");
        run.says("missing: `y`");
        std::thread::sleep(Duration::from_millis(1500));
        assert!(run.runs());
        run.interrupt();
        let output = run.end();
        assert_eq!(output.status.code(), Some(130), "{output:?}");
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(errors.matches("missing: `y`").count(), 1, "{errors}");

        let refused =
            "[[fault]]\nkind = \"refuse-state\"\ndevice = 0\nstate = \"SafeOp\"\ncode = 0x1d\n";
        let output = start(refused).end();
        assert_eq!(output.status.code(), Some(1), "{output:?}");
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(!errors.contains("waiting"), "{errors}");
        let again = errors.matches("bring-up begins once more").count();
        assert_eq!(again, 1, "{errors}");
    });
}
