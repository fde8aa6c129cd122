//! A ring of simulated SubDevices between two veth pairs. Requires root.

use std::process::Stdio;
use std::time::Duration;

use ecaxis_test_support::host::over_a_pair;
use ecaxis_test_support::program::{self, ProgramOutput};
use ecaxis_test_support::tolerant_demo;
use ecaxis_tools::bench::veth::VethPair;

/// Serves the demonstration as a ring at one end of both pairs. Returns the machine file for the other
/// end, and the bus.
fn serve(first: &VethPair, second: &VethPair) -> (tempfile::NamedTempFile, ProgramOutput) {
    let file = tempfile::Builder::new().suffix(".toml").tempfile();
    let file = file.expect("a temporary file");
    let bus = format!("[bus]\nredundant = \"{}\"\n", second.b);
    let text = tolerant_demo().replacen("[bus]", &bus, 1);
    std::fs::write(file.path(), text).expect("written");
    let path = file.path().to_str().expect("a path in UTF-8");
    let ring = ["sim", path, "--nic", &first.a, "--nic2", &second.a];
    let mut bus = ProgramOutput::start(program::command().args(ring).stdout(Stdio::null()));
    bus.says("answer");
    (file, bus)
}

/// An interface without a link is a warning at one end of a ring, and an error at both.
#[test]
fn a_ring_starts_with_one_interface() {
    over_a_pair(|first| {
        let second = VethPair::new().expect("a second pair");
        let (file, _bus) = serve(&first, &second);
        let path = file.path().to_str().expect("a path in UTF-8");
        for down in [&first, &second] {
            down.set(&down.a, false).expect("down");
            let run = ["run", path, "--nic", &first.b, "--no-fault-report"];
            let mut run = ProgramOutput::start(program::command().args(run).stdout(Stdio::piped()));
            run.says("has no link: the ring is open at this end");
            run.says("the ring is broken between");
            let output = run.end();
            let errors = String::from_utf8_lossy(&output.stderr);
            assert_eq!(output.status.code(), Some(0), "{errors}");
            down.set(&down.a, true).expect("up");
        }
    });
}

/// Each interface goes down and comes up again while the axes move.
#[test]
fn a_ring_outlasts_each_of_its_interfaces() {
    over_a_pair(|first| {
        let second = VethPair::new().expect("a second pair");
        let (file, _bus) = serve(&first, &second);
        let path = file.path().to_str().expect("a path in UTF-8");
        let run = [
            "run",
            path,
            "--nic",
            &first.b,
            "--no-fault-report",
            "--repeat",
            "100",
        ];
        let mut run = ProgramOutput::start(program::command().args(run).stdout(Stdio::piped()));
        run.says("the ring is closed");
        run.says("Operation enabled");
        for (pair, place) in [
            (&first, "between the first interface (`nic`) and `x`"),
            (
                &second,
                "between `y` and the second interface (`redundant`)",
            ),
        ] {
            pair.set(&pair.b, false).expect("down");
            run.says(&format!("`{}` has no link", pair.b));
            assert!(run.heard().contains(place), "{}", run.heard());
            std::thread::sleep(Duration::from_millis(300));
            pair.set(&pair.b, true).expect("up");
            run.says("the ring is closed");
        }
        run.interrupt();
        let output = run.end();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(130), "{errors}");
        println!("{}", String::from_utf8_lossy(&output.stdout));
    });
}

/// The output of a command that ends by itself: exit code, standard output and errors.
fn outcome(arguments: &[&str]) -> (Option<i32>, String, String) {
    let output = program::command().args(arguments).output();
    let output = output.expect("the binary runs");
    let text = |bytes| String::from_utf8_lossy(bytes).into_owned();
    (
        output.status.code(),
        text(&output.stdout),
        text(&output.stderr),
    )
}

/// With one interface, the bus looked silent: "no SubDevice answers", and is it the right
/// interface? The frames arrive at the other one.
#[test]
fn one_interface_of_a_ring_names_the_other() {
    over_a_pair(|first| {
        let second = VethPair::new().expect("a second pair");
        let (file, _bus) = serve(&first, &second);
        let line = tempfile::Builder::new().suffix(".toml").tempfile();
        let line = line.expect("a temporary file");
        std::fs::write(line.path(), tolerant_demo()).expect("written");
        let line = line.path().to_str().expect("a path in UTF-8");
        let ring = file.path().to_str().expect("a path in UTF-8");
        let (a, b) = (first.b.as_str(), second.b.as_str());
        let forwards = [
            format!("no SubDevice answers; the frames of `{a}` arrive at `{b}`, "),
            "processed by 2 SubDevices".to_owned(),
            format!("write `redundant = \"{b}\"` into [bus], or name both: `{a},{b}`"),
        ];
        for arguments in [
            &["scan", a][..],
            &["run", line, "--nic", a, "--no-fault-report"],
            &["compare", line, "--nic", a],
            &["eeprom", "verify", "--nic", a, "--position", "0"],
            &["sdo", "read", line, "x", "0x1018:01", "--nic", a],
        ] {
            let (code, _, errors) = outcome(arguments);
            assert_eq!(code, Some(1), "{arguments:?}: {errors}");
            for text in &forwards {
                assert!(errors.contains(text), "{arguments:?}: {errors}");
            }
        }
        let (code, _, errors) = outcome(&["scan", b]);
        assert_eq!(code, Some(1), "{errors}");
        assert!(
            errors.contains("no SubDevice has processed them"),
            "{errors}"
        );
        assert!(errors.contains(&format!("`{a},{b}`")), "{errors}");

        let both = format!("{a},{b}");
        let written = tempfile::tempdir().expect("a folder");
        let written = written.path().join("m.toml");
        let path = written.to_str().expect("a path in UTF-8");
        for arguments in [
            &["scan", &both][..],
            &["scan", &both, "--write", path],
            &["compare", line, "--nic", &both],
            &["compare", ring, "--nic", a],
            &["eeprom", "verify", "--nic", &both, "--position", "0"],
            &["sdo", "read", line, "x", "0x1018:01", "--nic", &both],
            &["run", line, "--nic", &both, "--no-fault-report"],
        ] {
            let (code, out, errors) = outcome(arguments);
            assert_eq!(code, Some(0), "{arguments:?}: {out}\n{errors}");
        }
        let written = std::fs::read_to_string(&written).expect("a machine file");
        let redundant = format!("redundant   = \"{b}\"");
        assert!(written.contains(&redundant), "{written}");
    });
}
