//! Effects of signals on a run with a moving axis, with real processes. The recording shows the
//! motion.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::thread::sleep;
use std::time::Duration;

use ecaxis_test_support::host::retry_if_host_stalled;
use ecaxis_test_support::program::{ProgramOutput, ecaxis};
use ecaxis_test_support::recordings::comes_to_rest;
use ecaxis_test_support::{axes, root, skip, tolerant, with_our_esi};
use rustix::process::Signal;

/// The maximum set-point change per cycle: 5 turns/s of 2000 counts, plus rounding.
const STEP: i32 = 11;
/// The axis moves after this time in its step.
const IN_MOTION: Duration = Duration::from_millis(400);

struct Bench {
    folder: tempfile::TempDir,
}

impl Bench {
    /// Creates an axis that moves for half a minute, on a bus that tolerates a stalling test
    /// computer.
    fn new() -> Self {
        let bench = Self {
            folder: tempfile::tempdir().expect("a folder"),
        };
        let text = tolerant(&with_our_esi(&axes(1))).replace("\nmove =", "\nspeed = 0.1\nmove =");
        std::fs::write(bench.path("m.toml"), text).expect("written");
        bench
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn recording(&self) -> PathBuf {
        self.path("run.pcapng")
    }

    fn file(&self, name: &str, text: &str) -> String {
        std::fs::write(self.path(name), text).expect("written");
        self.path(name).display().to_string()
    }

    /// Returns the command for `ecaxis run` with this axis. With `before`, a shell runs that text
    /// first.
    fn command(&self, before: &str, more: &[&str]) -> Command {
        let mut command = Command::new("sh");
        command
            .args(["-c", &format!("{before} exec \"$0\" \"$@\"")])
            .arg(ecaxis())
            .args(["run", "m.toml", "--sim", "--json", "--record"])
            .arg(self.recording())
            .args(more)
            .current_dir(self.folder.path())
            .stdin(Stdio::null())
            .stdout(Stdio::piped());
        command
    }

    fn run(&self, before: &str, more: &[&str]) -> ProgramOutput {
        let _ = std::fs::remove_file(self.recording());
        ProgramOutput::start(&mut self.command(before, more))
    }
}

/// Waits until the axis moves.
fn moving(run: &mut ProgramOutput) {
    run.says("step 1: ");
    sleep(IN_MOTION);
}

/// Returns exit code and result.
#[track_caller]
fn ended(output: &Output) -> (i32, serde_json::Value, String) {
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    let json = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|e| panic!("{e}: {:?}: {errors}", output.status));
    let code = output.status.code();
    (
        code.unwrap_or_else(|| panic!("{:?}: {errors}", output.status)),
        json,
        errors,
    )
}

#[track_caller]
fn interrupted(output: &Output, recording: Option<&Path>) {
    let (code, json, errors) = ended(output);
    assert_eq!(code, 130, "{errors}");
    assert_eq!(
        (&json["ok"], &json["error"]),
        (&false.into(), &"interrupted".into())
    );
    assert!(errors.ends_with("interrupted\n"), "{errors}");
    if let Some(recording) = recording {
        comes_to_rest(recording, STEP);
        assert_eq!(json["summary"]["interrupted"], true);
    }
}

#[test]
fn signals_stop_a_run_in_motion() {
    retry_if_host_stalled(|| {
        let bench = Bench::new();
        for signals in [
            &[Signal::INT][..],
            &[Signal::TERM],
            &[Signal::HUP],
            // timeout(1) does this, and so may a closing terminal.
            &[Signal::TERM, Signal::TERM],
            &[Signal::HUP, Signal::HUP],
        ] {
            let mut run = bench.run("", &[]);
            moving(&mut run);
            for &signal in signals {
                run.signal(signal);
                sleep(Duration::from_millis(20));
            }
            interrupted(&run.end(), Some(&bench.recording()));
        }
    });
}

#[test]
fn an_interrupted_run_in_bring_up_or_at_rest_has_the_same_exit_code() {
    retry_if_host_stalled(|| {
        let bench = Bench::new();
        for (line, more) in [
            ("scanning", &[][..]),
            ("in PreOp", &[]),
            ("in SafeOp", &[]),
            ("SubDevices in Op", &["--no-enable"]),
        ] {
            let mut run = bench.run("", more);
            run.says(line);
            run.interrupt();
            interrupted(&run.end(), None);
        }
    });
}

#[test]
fn ignored_signals_do_not_stop_a_run() {
    retry_if_host_stalled(|| {
        let bench = Bench::new();
        for (before, signals) in [
            ("trap '' HUP;", &[Signal::HUP][..]),
            (
                "",
                &[
                    Signal::USR1,
                    Signal::USR2,
                    Signal::PIPE,
                    Signal::TTIN,
                    Signal::TTOU,
                    Signal::TSTP,
                ],
            ),
        ] {
            let mut run = bench.run(before, &["--for", "2s"]);
            moving(&mut run);
            for &signal in signals {
                run.signal(signal);
            }
            let (code, json, errors) = ended(&run.end());
            assert_eq!(code, 0, "{errors}");
            assert_eq!(json["ok"], true);
            let suspended = signals.contains(&Signal::TSTP);
            assert_eq!(errors.contains("Ctrl-Z is ignored"), suspended, "{errors}");
            comes_to_rest(&bench.recording(), STEP);
        }
    });
}

/// The terminal or the reading program has ended: output stops, and the machine continues.
#[test]
fn a_run_without_readers_continues() {
    retry_if_host_stalled(|| {
        let bench = Bench::new();
        let _ = std::fs::remove_file(bench.recording());
        let mut command = bench.command("", &["--for", "2s", "-vv"]);
        let mut run = command.stderr(Stdio::piped()).spawn().expect("it starts");
        sleep(Duration::from_millis(700));
        drop((run.stdout.take(), run.stderr.take()));
        let status = run.wait().expect("it ends");
        assert_eq!(status.code(), Some(0), "{status:?}");
        comes_to_rest(&bench.recording(), STEP);
    });
}

/// The drive stays in Operation enabled, so the exit code reports the failure instead of the
/// interruption. A second signal ends the program at once.
#[test]
fn a_failed_stop_exits_as_a_failure() {
    retry_if_host_stalled(|| {
        let bench = Bench::new();
        let stuck =
            "[[fault]]\nkind = \"stuck\"\ndevice = 0\nat = \"1s\"\nstate = \"operation-enabled\"\n";
        let faults = bench.file("f.toml", stuck);
        for again in [false, true] {
            let mut run = bench.run("", &["--faults", &faults]);
            moving(&mut run);
            sleep(Duration::from_secs(1));
            run.interrupt();
            if again {
                run.says("stopping; once more");
                sleep(Duration::from_millis(600));
                run.interrupt();
            }
            let output = run.end();
            let errors = String::from_utf8_lossy(&output.stderr);
            assert_eq!(output.status.code(), Some(1), "{errors}");
            let left = "left without stopping the machine";
            assert_eq!(errors.contains(left), again, "{errors}");
        }
    });
}

/// With the library's own stop, and with an observer that panics, the axis comes to rest before the
/// process ends.
#[test]
fn the_example_stops_at_a_signal() {
    retry_if_host_stalled(|| {
        let Some(example) = example() else { return };
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("m.toml");
        let text = std::fs::read_to_string(root().join("configs/controller.toml")).expect("ours");
        std::fs::write(&file, tolerant(&with_our_esi(&text))).expect("written");
        for (signal, code) in [(Signal::TERM, 130), (Signal::HUP, 130)] {
            let mut command = Command::new(&example);
            command.arg(&file);
            command.stdin(Stdio::null()).stdout(Stdio::null());
            let mut run = ProgramOutput::start(&mut command);
            run.says("Enabled");
            sleep(IN_MOTION);
            run.signal(signal);
            run.says("Stopping");
            run.says("State(Init)");
            let output = run.end();
            let errors = String::from_utf8_lossy(&output.stderr);
            assert_eq!(output.status.code(), Some(code), "{errors}");
        }
    });
}

/// Returns `examples/controller`, which cargo builds together with all tests.
fn example() -> Option<PathBuf> {
    let example = ecaxis().with_file_name("examples/controller");
    if !example.exists() {
        skip("examples/controller is not built: run `cargo test -p ecaxis`");
        return None;
    }
    Some(example)
}
