//! What signals do to a run whose axis moves, with real processes. The axis is judged by the recording.

mod common;

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::thread::sleep;
use std::time::Duration;

use common::wire::{Told, calmly};
use common::{axes, root, script};
use rustix::process::Signal;

/// Set-points change by so much a cycle at most: 5 turns a second of 2000 counts, and rounding.
const STEP: i32 = 11;
/// After this long in its step the axis moves.
const IN_MOTION: Duration = Duration::from_millis(400);

struct Bench {
    folder: tempfile::TempDir,
}

impl Bench {
    /// An axis that moves for half a minute, on a bus that a stalling test computer does not break.
    fn new() -> Self {
        let bench = Self {
            folder: tempfile::tempdir().expect("a folder"),
        };
        let calm = "lost_frames = 1000\nwatchdog = \"6s\"\ncycle =";
        let esi = root().join("configs/esi");
        let text = axes(1)
            .replace("cycle =", calm)
            .replace("\"esi/", &format!("\"{}/", esi.display()))
            .replace("\nmove =", "\nspeed = 0.1\nmove =");
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

    /// `ecaxis run` of this axis; by a shell where `before` is what the shell does first.
    fn command(&self, before: &str, more: &[&str]) -> Command {
        let mut command = Command::new("sh");
        command
            .args(["-c", &format!("{before} exec \"$0\" \"$@\"")])
            .arg(env!("CARGO_BIN_EXE_ecaxis"))
            .args(["run", "m.toml", "--sim", "--json", "--record"])
            .arg(self.recording())
            .args(more)
            .current_dir(self.folder.path())
            .stdin(Stdio::null())
            .stdout(Stdio::piped());
        command
    }

    fn run(&self, before: &str, more: &[&str]) -> Told {
        let _ = std::fs::remove_file(self.recording());
        Told::start(&mut self.command(before, more))
    }
}

/// Until its axis moves.
fn moving(run: &mut Told) {
    run.says("step 1: ");
    sleep(IN_MOTION);
}

/// Its exit code, and its result.
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
        script::comes_to_rest(recording, STEP);
        assert_eq!(json["summary"]["interrupted"], true);
    }
}

#[test]
fn interrupt_terminate_and_hang_up_stop_a_run_in_motion() {
    calmly(|| {
        let bench = Bench::new();
        for signals in [
            &[Signal::INT][..],
            &[Signal::TERM],
            &[Signal::HUP],
            // As timeout(1) does, and as a terminal that closes may do.
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
fn a_run_interrupted_in_bring_up_or_at_rest_exits_likewise() {
    calmly(|| {
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
fn signals_that_stop_nothing() {
    calmly(|| {
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
            script::comes_to_rest(&bench.recording(), STEP);
        }
    });
}

/// The terminal or the program that reads is gone: nothing is said any more, and the machine goes on.
#[test]
fn a_run_without_readers_goes_on() {
    calmly(|| {
        let bench = Bench::new();
        let _ = std::fs::remove_file(bench.recording());
        let mut command = bench.command("", &["--for", "2s", "-vv"]);
        let mut run = command.stderr(Stdio::piped()).spawn().expect("it starts");
        sleep(Duration::from_millis(700));
        drop((run.stdout.take(), run.stderr.take()));
        let status = run.wait().expect("it ends");
        assert_eq!(status.code(), Some(0), "{status:?}");
        script::comes_to_rest(&bench.recording(), STEP);
    });
}

/// The drive does not leave Operation enabled: what failed goes before what was interrupted. The second signal leaves at once.
#[test]
fn a_stop_that_fails_is_a_failure() {
    calmly(|| {
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

/// The library's own stop, and an observer that panics: the axis comes to rest before the process ends.
#[test]
fn the_example_stops_at_a_signal() {
    calmly(|| {
        let Some(example) = example() else { return };
        for (signal, code) in [(Signal::TERM, 130), (Signal::HUP, 130)] {
            let mut command = Command::new(&example);
            command.stdin(Stdio::null()).stdout(Stdio::null());
            let mut run = Told::start(&mut command);
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

/// `examples/controller`, which cargo builds together with the tests.
fn example() -> Option<PathBuf> {
    let binary = Path::new(env!("CARGO_BIN_EXE_ecaxis"));
    let example = binary.parent()?.join("examples/controller");
    File::open(&example).is_ok().then_some(example)
}
