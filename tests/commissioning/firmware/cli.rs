//! `ecaxis firmware` from the user's view.

use std::path::Path;

use serde_json::Value;

use ecaxis_test_support::{assert_contains, assert_fits, program};

const MACHINE: &str = "configs/demo.toml";

fn ran(arguments: &[&str]) -> (i32, String, String) {
    let ran = program::run([&["firmware"], arguments].concat());
    (ran.code, ran.out, ran.err)
}

/// Checks the parts of a text, and that its tables fit a terminal.
#[track_caller]
fn has(text: &str, parts: &[&str]) {
    assert_contains(text, parts);
    let tabular = |line: &&str| line.starts_with("  ") && !line.starts_with("  = help");
    text.lines().filter(tabular).for_each(assert_fits);
}

/// Runs `firmware update` for a simulated device of the demonstration.
fn update(device: &str, file: &Path, more: &[&str]) -> (i32, String, String) {
    let file = file.to_str().expect("UTF-8");
    let words = ["update", MACHINE, device, file, "--sim", "--virtual"];
    ran(&[&words[..], more].concat())
}

fn sample(folder: &Path, device: &str) -> std::path::PathBuf {
    let file = folder.join(format!("{device}.bin"));
    let path = file.to_str().expect("UTF-8");
    let (code, _, err) = ran(&["sample", MACHINE, device, "-o", path, "--size", "100KiB"]);
    assert_eq!(code, 0, "{err}");
    assert_eq!(std::fs::read(&file).expect("written").len(), 102_400 + 32);
    file
}

#[test]
fn an_update_from_a_sample_file_runs_on_the_drive() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = sample(folder.path(), "x");

    let (code, out, err) = ran(&["info", MACHINE, "x", "--sim", "--virtual"]);
    assert_eq!(code, 0, "{err}");
    has(
        &out,
        &[
            "`x` (position 0",
            "0x00010000",
            "its program",
            "mailboxes of 100",
        ],
    );

    let (code, out, err) = update("x", &file, &["--dry-run"]);
    assert_eq!(code, 0, "{err}");
    has(
        &out,
        &["would be written by FoE in Bootstrap", "102432 bytes"],
    );

    let (code, out, err) = update("x", &file, &[]);
    assert_eq!(code, 2);
    has(&out, &["would be written"]);
    has(&err, &["nothing was written", "`--yes`"]);

    for (via, step) in [("foe", "going to Bootstrap"), ("program", "0x1F50")] {
        let (code, out, err) = update("x", &file, &["--yes", "--via", via, "--read-back"]);
        assert_eq!(code, 0, "{err}");
        has(
            &out,
            &["0x00020000", "2.00", "It runs its program and is in Init."],
        );
        has(&err, &[step, "40 %", "100 %, 102432 of 102432 bytes"]);
        assert_eq!(out.contains("byte for byte"), via == "foe", "{out}");

        let (code, out, _) = update("x", &file, &["--yes", "--via", via, "--json"]);
        let report: Value = serde_json::from_str(&out).expect("JSON");
        assert_eq!((code, &report["ok"]), (0, &Value::Bool(true)));
        assert_eq!(report["before"]["identity"]["revision"], 0x0001_0000);
        assert_eq!(report["after"]["identity"]["revision"], 0x0002_0000);
        assert_eq!(report["after"]["runs"], "program");
        assert_eq!(report["via"], via);
    }
}

#[test]
fn every_update_failure_has_code_device_step_cause_and_hint() {
    let folder = tempfile::tempdir().expect("a folder");
    let (x, y) = (sample(folder.path(), "x"), sample(folder.path(), "y"));
    let empty = folder.path().join("empty.bin");
    std::fs::write(&empty, []).expect("written");
    let off = folder.path().join("off.toml");
    let script = "[[fault]]\nkind = \"power-off\"\ndevice = 0\nat = \"800ms\"\n";
    std::fs::write(&off, script).expect("written");
    let off = off.to_str().expect("UTF-8");
    let name = "n".repeat(200);
    for (device, file, more, code, parts) in [
        (
            "x",
            &y,
            &["--yes"][..],
            1,
            &[
                "`x`",
                "sending the file",
                "0x800d",
                "Bootstrap",
                "same command",
            ][..],
        ),
        (
            "x",
            &y,
            &["--yes", "--via", "program"],
            1,
            &["`x`", "0x1F50", "0x06090030", "PreOp", "same command"],
        ),
        (
            "x",
            &x,
            &["--yes", "--expect-product", "0x45500005"],
            1,
            &[
                "`x`",
                "0x45500004",
                "0x45500005 is meant",
                "--expect-product",
            ],
        ),
        (
            "x",
            &x,
            &["--yes", "--faults", off],
            1,
            &["`x`", "does not answer", "power", "same command"],
        ),
        (
            "y",
            &y,
            &["--yes", "--via", "program"],
            1,
            &["`y`", "does not offer", "0x1F51", "--via foe"],
        ),
        ("x", &empty, &["--dry-run"], 2, &["empty"]),
        (
            "x",
            &x,
            &["--dry-run", "--name", &name],
            2,
            &["1 to 88 bytes", "--name"],
        ),
        (
            "z",
            &x,
            &["--yes"],
            2,
            &["no device is called `z`", "there are x, y"],
        ),
    ] {
        let (found, _, err) = update(device, file, more);
        assert_eq!(found, code, "{more:?}: {err}");
        has(&err, parts);
        has(&err, &["error:", "= help:"]);
    }
    let (code, _, err) = ran(&["update", "no.bin", "--yes"]);
    assert_eq!(code, 2);
    has(&err, &["which device", "--position"]);
    let (code, _, err) = ran(&["info", MACHINE, "--sim"]);
    assert_eq!(code, 2);
    has(&err, &["which device", "--position", "--id"]);
    let (_, out, _) = update("x", &y, &["--yes", "--json"]);
    let report: Value = serde_json::from_str(&out).expect("JSON");
    assert_eq!(report["ok"], false);
    assert!(
        report["error"]
            .as_str()
            .is_some_and(|e| e.contains("0x800d"))
    );
    assert!(
        report["hints"]
            .as_array()
            .is_some_and(|hints| hints.len() == 2)
    );
}
