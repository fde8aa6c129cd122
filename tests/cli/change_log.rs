//! The log of what changed a machine.

use std::path::Path;

use ecaxis_test_support::program::{self, Ran};
use serde_json::Value;

fn entries(log: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(log).unwrap_or_default();
    let value = |line| serde_json::from_str(line).expect("JSON");
    text.lines().map(value).collect()
}

#[test]
fn each_change_has_an_entry_with_its_user_and_outcome() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("changes.jsonl");
    let run = |line: &str| {
        let folder = folder.path().to_str().unwrap();
        let words = line.split(' ').map(|word| word.replace('~', folder));
        let mut command = program::command();
        command.env("ECAXIS_CHANGE_LOG", &log);
        Ran::new(command.args(words))
    };
    // What only reads leaves no trace.
    for line in [
        "sdo read configs/demo.toml x 0x6065:00 --sim",
        "sdo dump configs/demo.toml x ~/x.toml --sim",
        "eeprom read configs/demo.toml x ~/x.bin --sim",
        "check configs/demo.toml",
        "firmware sample configs/demo.toml x -o ~/new.bin",
    ] {
        run(line).exits(0);
    }
    assert_eq!(entries(&log), [] as [Value; 0]);
    let changes = [
        ("sdo write configs/demo.toml x 0x6065:00 1000 --sim", 0),
        ("sdo write configs/demo.toml x 0x6041:00 1 --sim", 1),
        ("sdo restore configs/demo.toml x ~/x.toml --sim", 0),
        ("sdo store configs/demo.toml x --sim", 0),
        ("sdo defaults configs/demo.toml x --sim --yes", 0),
        (
            "eeprom write configs/demo.toml x ~/x.bin --sim --yes --backup ~/a.bin",
            0,
        ),
        (
            "eeprom alias configs/demo.toml x 7 --sim --yes --backup ~/b.bin",
            0,
        ),
        (
            "firmware update configs/demo.toml x ~/new.bin --sim --yes --password 0x5ec",
            0,
        ),
        ("run configs/demo.toml --virtual --no-enable --for 10ms", 0),
    ];
    for (line, code) in changes {
        let ran = run(line);
        assert_eq!(ran.code, code, "{line}: {}{}", ran.out, ran.err);
    }
    let mut entries = entries(&log);
    // Before its first frame, an update enters which file it is about to write.
    let is_begin =
        |entry: &Value| entry["command"][0] == "firmware" && entry["outcome"] == "begins";
    let begins: Vec<_> = entries.extract_if(.., |entry| is_begin(entry)).collect();
    assert_eq!(begins.len(), 1);
    assert!(begins[0]["file"].as_str().unwrap().ends_with("/new.bin"));
    assert_eq!(begins[0]["sha256"].as_str().unwrap().len(), 64);
    assert_eq!(begins[0]["signed_by"], Value::Null);
    // A run has two entries.
    assert_eq!(entries.len(), changes.len() + 1, "{entries:#?}");
    let uid = rustix::process::getuid().as_raw();
    for (entry, (line, code)) in entries.iter().zip(changes) {
        assert_eq!(entry["uid"], uid);
        assert!(entry["unix_time"].as_f64().is_some_and(|time| time > 1.7e9));
        let command: Vec<_> = entry["command"].as_array().unwrap().iter().collect();
        let first: Vec<_> = line.split(' ').take(3).collect();
        assert_eq!(command[..3], first, "{line}");
        let outcome = entry["outcome"].as_str().unwrap();
        match (first[0], code) {
            ("run", _) => assert_eq!(outcome, "begins"),
            (_, 0) => assert_eq!(outcome, "done", "{line}"),
            _ => assert!(outcome.contains("0x6041"), "{outcome}"),
        }
    }
    let text = std::fs::read_to_string(&log).unwrap();
    assert!(!text.contains("0x5ec"), "the password is in the log");
    assert_eq!(entries.last().unwrap()["outcome"], "done");
}

#[test]
fn a_log_that_cannot_be_written_is_a_warning() {
    let mut command = program::command();
    command.env("ECAXIS_CHANGE_LOG", "/nonexistent/changes.jsonl");
    command.args(["sdo", "store", "configs/demo.toml", "x", "--sim"]);
    let ran = Ran::new(&mut command).exits(0);
    assert!(
        ran.err.contains("warning: the change log /nonexistent"),
        "{}",
        ran.err
    );
}
