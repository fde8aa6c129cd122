use std::path::PathBuf;

use super::super::{ConfigError, Machine, Problem, parse};
use super::*;

/// A drive with an axis and two I/O devices; the device with a dot has the brake's output.
const DEVICES: &str = r#"[bus]
nic = "sim"
cycle = "1ms"
[[device]]
name = "x"
esi = "esi/EPOS4.xml"
position = 0
mode = "csp"
[device.axis]
encoder = 2000
limits = { velocity = 50.0, acceleration = 500.0 }
brake = { output = "io.b.Output 8" }
[[device]]
name = "a"
esi = "esi/IO8.xml"
position = 1
[[device]]
name = "io.b"
esi = "esi/IO8.xml"
position = 2
[[step]]
set = { a."Output 5" = true }
"#;

fn with(copies: &[(&str, &str)]) -> Result<Machine, ConfigError> {
    let copies = copies
        .iter()
        .map(|(from, to)| format!("[[copy]]\nfrom = \"{from}\"\nto = \"{to}\"\n"));
    let text = DEVICES.to_owned() + &copies.collect::<String>();
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../configs");
    parse(&folder.join("m.toml"), &text)
}

#[track_caller]
fn problem(copies: &[(&str, &str)]) -> Problem {
    match with(copies) {
        Err(ConfigError::Problems(found)) if found.len() == 1 => found[0].clone(),
        other => panic!("{copies:?}: {other:?}"),
    }
}

#[test]
fn both_ends_name_entries_pdos_or_bytes() {
    let machine = with(&[
        ("a.Input 1", "io.b.Output 1"),
        ("a.0x6000:02", "io.b.0x7000:02"),
        ("a.Inputs/Input 3", "io.b.Output 3"),
        ("io.b.pdo.0x1A00", "a.bytes.0..1"),
    ]);
    // The step sets one of those outputs.
    assert!(machine.is_err());
    let machine = with(&[
        ("a.Input 1", "io.b.Output 1"),
        ("a.0x6000:02", "io.b.0x7000:02"),
        ("a.Inputs/Input 3", "io.b.Output 3"),
        ("a.Input 1", "a.Output 8"),
    ]);
    let copies = machine.expect("valid").copies;
    let found: Vec<_> = copies
        .iter()
        .map(|c| {
            (
                c.from.name.as_str(),
                c.from.bits.clone(),
                c.to.name.as_str(),
                c.to.bits.clone(),
            )
        })
        .collect();
    assert_eq!(
        found,
        [
            ("a.Input 1", 0..1, "io.b.Output 1", 0..1),
            ("a.Input 2", 1..2, "io.b.Output 2", 1..2),
            ("a.Input 3", 2..3, "io.b.Output 3", 2..3),
            ("a.Input 1", 0..1, "a.Output 8", 7..8),
        ]
    );
    assert_eq!(copies[1].line, 26);
}

#[test]
fn each_mistake_is_reported_with_both_places() {
    for (from, to, message, hint) in [
        (
            "a.Input 9",
            "io.b.Output 1",
            "no input \"Input 9\"",
            "`Input",
        ),
        (
            "a.Output 1",
            "io.b.Output 1",
            "no input \"Output 1\"",
            "from inputs to outputs",
        ),
        (
            "a.Input 1",
            "io.b.Input 1",
            "no output \"Input 1\"",
            "from inputs to outputs",
        ),
        (
            "q.Input 1",
            "io.b.Output 1",
            "no device is named `q`",
            "devices: `x`, `a`, `io.b`",
        ),
        (
            "Input 1",
            "io.b.Output 1",
            "names no input",
            "\"io.Input 1\"",
        ),
        (
            "a.Input 1",
            "Output 1",
            "names no output",
            "\"io.Output 1\"",
        ),
        (
            "a.pdo.0x1A01",
            "io.b.Output 1",
            "no PDO \"0x1A01\" in its inputs",
            "its PDOs: 0x1a00",
        ),
        (
            "a.pdo.Inputs",
            "io.b.Output 1",
            "no PDO \"Inputs\"",
            "0x1a00",
        ),
        (
            "a.pdo.0x1600",
            "io.b.Output 1",
            "no PDO \"0x1600\" in its inputs",
            "0x1a00",
        ),
        (
            "a.bytes.0..2",
            "io.b.Output 1",
            "1 byte of inputs",
            "\"bytes.0..1\"",
        ),
        (
            "a.bytes.1..1",
            "io.b.Output 1",
            "not a range of bytes",
            "\"bytes.4..10\"",
        ),
        (
            "a.bytes.1",
            "io.b.Output 1",
            "not a range of bytes",
            "\"bytes.4..10\"",
        ),
        (
            "a.bytes.-1..1",
            "io.b.Output 1",
            "not a range of bytes",
            "\"bytes.4..10\"",
        ),
        (
            "a.Input 1",
            "x.0x6040",
            "`x.Controlword` is written by the axis `x` in line 4; the copy in line 23 may not",
            "command",
        ),
        (
            "x.Statusword",
            "x.0x6040",
            "`x.Controlword` is written by the axis `x` in line 4; the copy in line 23 may not",
            "command",
        ),
        (
            "x.bytes.0..4",
            "x.bytes.0..4",
            "`x.Controlword` in `x.bytes.0..4` is written by the axis `x` in line 4",
            "command",
        ),
        (
            "a.Input 1",
            "a.Output 5",
            "`a.Output 5` is set by the step in line 22; the copy in line 23 may not write it",
            "one owner",
        ),
        (
            "io.b.pdo.0x1A00",
            "a.pdo.0x1600",
            "`a.Output 5` in `a.pdo.0x1600` is set by the step in line 22",
            "one owner",
        ),
        (
            "a.Input 1",
            "io.b.Output 8",
            "`io.b.Output 8` opens the brake of `x` in line 12; the copy in line 23",
            "the axis opens and closes its brake",
        ),
        (
            "a.pdo.0x1A00",
            "io.b.Output 1",
            "`io.b.Output 1` has 1 bit, and `a.pdo.0x1a00` in line 24 has 1 byte",
            "one length",
        ),
    ] {
        let problem = problem(&[(from, to)]);
        assert!(problem.message.contains(message), "{problem}");
        assert!(
            problem.hint.as_deref().unwrap_or_default().contains(hint),
            "{problem}"
        );
        assert!((24..=25).contains(&problem.line), "{problem}");
    }
}

#[test]
fn an_output_is_the_target_of_one_copy() {
    let first = ("a.Input 1", "io.b.Output 1");
    let second = problem(&[first, ("a.Input 2", "io.b.Output 1")]);
    assert!(
        second
            .message
            .contains("is written by the copy in line 23; the copy in line 26"),
        "{second}"
    );
    assert_eq!(second.line, 28);
    let whole = [("a.Input 1", "a.Output 1"), ("io.b.Input 1", "a.Output 2")];
    with(&whole).expect("different outputs");
}

#[test]
fn a_copy_needs_both_ends() {
    let text = DEVICES.to_owned() + "[[copy]]\nfrom = \"a.Input 1\"\n";
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../configs");
    let Err(ConfigError::Problems(found)) = parse(&folder.join("m.toml"), &text) else {
        panic!("`to` is missing")
    };
    assert!(
        found[0].message.contains("`to` is missing in [[copy]]"),
        "{}",
        found[0]
    );
}

#[test]
fn a_controller_cannot_set_the_target_of_a_copy() {
    let mut machine = with(&[("a.Input 1", "io.b.Output 1")]).expect("valid");
    let error = machine
        .output("io.b", "Output 1")
        .expect_err("a copy writes it");
    assert_eq!(
        error.to_string(),
        "`io.b.Output 1` is written by the copy in line 23; a controller may not write it; an output has \
         one owner: remove one of both, or write another output"
    );
    machine.output("io.b", "Output 2").expect("free");
}

#[test]
fn copies_reach_the_settings_of_the_cycle() {
    let machine = with(&[("a.Input 3", "io.b.Output 6")]).expect("valid");
    let expected = ProcessDataCopy {
        from: (DeviceIndex(1), 2),
        to: (DeviceIndex(2), 5),
        bits: 1,
    };
    let config = machine.rt_config();
    assert_eq!((config.copies, config.repeats), (vec![expected], vec![]));
}
