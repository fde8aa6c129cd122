//! The binary as a user meets it: exit codes, and messages that name the trouble.

mod common;

use std::process::{Command, Output};

use common::{axes, root};

fn ecaxis(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_ecaxis"))
        .args(arguments)
        .current_dir(root())
        .output()
        .expect("the binary runs")
}

/// Runs `check` or `run` on a machine file given as text.
fn with_file(verb: &str, text: &str, more: &[&str]) -> (i32, String) {
    // Beside the other machine files, because paths in a machine file are relative to it.
    let file = tempfile::Builder::new()
        .prefix("test-")
        .suffix(".toml")
        .tempfile_in(root().join("configs"))
        .expect("a temporary file");
    std::fs::write(file.path(), text).expect("written");
    let path = file.path().to_str().expect("a path in UTF-8");
    let output = ecaxis(&[&[verb, path], more].concat());
    (
        output.status.code().expect("an exit code"),
        String::from_utf8_lossy(&output.stderr).into_owned(),
    )
}

#[track_caller]
fn fails((code, text): (i32, String), expected: i32, parts: &[&str]) {
    assert_eq!(code, expected, "{text}");
    for part in parts {
        assert!(text.contains(part), "`{part}` is not in:\n{text}");
    }
}

#[test]
fn a_key_nobody_knows() {
    let text = axes(1).replace("cycle =", "cicle =");
    fails(with_file("check", &text, &[]), 2, &["cicle", "cycle", "^"]);
}

#[test]
fn a_misspelt_unit_of_time() {
    let text = axes(1).replace("\"1ms\"", "\"1mss\"");
    fails(with_file("check", &text, &[]), 2, &["1mss", "ms"]);
}

#[test]
fn an_esi_file_that_is_not_there() {
    let text = axes(1).replace("esi/EPOS4.xml", "esi/EPOS5.xml");
    fails(with_file("check", &text, &[]), 2, &["EPOS5.xml"]);
}

#[test]
fn a_truncated_esi_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let whole = std::fs::read(root().join("configs/esi/EPOS4.xml")).expect("our ESI");
    let cut = folder.path().join("cut.xml");
    std::fs::write(&cut, &whole[..whole.len() / 2]).expect("written");
    let text = axes(1).replace("esi/EPOS4.xml", cut.to_str().expect("UTF-8"));
    fails(with_file("check", &text, &[]), 2, &["cut.xml", ":"]);
}

#[test]
fn a_mode_the_esi_does_not_offer() {
    let text = axes(1).replace("\"csp\"", "\"cxp\"");
    fails(with_file("check", &text, &[]), 2, &["cxp", "csp"]);
    let text = axes(1)
        .replace("\"csp\"", "\"hm\"")
        .replace("move =", "dwell = \"1s\" #");
    fails(with_file("check", &text, &[]), 2, &["hm"]);
}

#[test]
fn a_cycle_that_0x60c2_cannot_express() {
    let text = axes(1).replace("\"1ms\"", "\"333333ns\"");
    fails(with_file("check", &text, &[]), 2, &["0x60C2"]);
}

#[test]
fn an_interface_that_does_not_exist() {
    let output = with_file("run", &axes(1), &["--nic", "nonet7"]);
    fails(output, 2, &["nonet7", "does not exist"]);
}

#[test]
fn every_problem_of_a_file_at_once() {
    let text = axes(2)
        .replace("cycle =", "cicle =")
        .replace("name = \"a1\"", "name = \"a0\"")
        .replace("velocity = 50.0", "velocity = -50.0");
    fails(
        with_file("check", &text, &[]),
        2,
        &["cicle", "a0", "velocity"],
    );
}

#[test]
fn errors_on_the_command_line() {
    assert_eq!(ecaxis(&["run", "--cycles"]).status.code(), Some(2));
    assert_eq!(
        ecaxis(&["run", "configs/no-such.toml"]).status.code(),
        Some(2)
    );
    assert_eq!(
        ecaxis(&["check", "configs/demo.toml"]).status.code(),
        Some(0)
    );
}

#[test]
fn explain_prints_the_modules_pdo_contents() {
    let output = ecaxis(&["explain", "configs/modes.toml"]);
    assert!(output.status.success());
    let text = String::from_utf8_lossy(&output.stdout);
    for part in [
        "0x6040", "0x607A", "0x60FF", "0x6071", "0x6041", "0x6064", "0x60C2", "0x1C12",
    ] {
        assert!(
            text.to_uppercase().contains(&part.to_uppercase()),
            "`{part}` is not in:\n{text}"
        );
    }
}
