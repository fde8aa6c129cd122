//! What is printed and what is logged: `--quiet`, `--log-file`, `explain` of one device, texts of
//! words, vendors and limits.

use ecaxis_test_support::program::run;
use ecaxis_test_support::{assert_contains, root};

fn config(name: &str) -> String {
    format!("{}/configs/{name}", root().display())
}

/// A run of the demonstration in virtual time.
fn demo(demo: &str) -> [&str; 6] {
    ["run", demo, "--sim", "--virtual", "--repeat", "1"]
}

/// Before, only the result could be kept apart from messages, by their streams.
#[test]
fn quiet_prints_only_errors_and_the_result() {
    let file = config("demo.toml");
    let line = [&demo(&file)[..], &["--quiet"]].concat();
    let ran = run(line.clone()).exits(0);
    assert_eq!(ran.err, "");
    assert!(ran.out.contains("complete run"), "{}", ran.out);

    let folder = tempfile::tempdir().expect("a folder");
    let faults = folder.path().join("f.toml");
    let script = "[[fault]]\nkind = \"drive-fault\"\nat = \"1s\"\ndevice = 1\ncode = 0x3220\n";
    std::fs::write(&faults, script).expect("written");
    let faults = faults.to_str().expect("UTF-8");
    let ran = run([&line[..], &["--faults", faults]].concat()).exits(1);
    assert_contains(&ran.err, &["error: `y`", ": Fault", "help: "]);
    assert!(!ran.err.contains("Operation enabled\n"), "{}", ran.err);
}

#[test]
fn log_file_has_messages_and_log_lines() {
    let folder = tempfile::tempdir().expect("a folder");
    let (file, log) = (config("demo.toml"), folder.path().join("run.log"));
    let path = log.to_str().expect("UTF-8");
    let line = [&demo(&file)[..], &["-q", "--log-file", path]].concat();
    run(line.clone()).exits(0);
    let first = std::fs::read_to_string(&log).expect("the log");
    assert_contains(&first, &["Z  NOTE 2 axes in Operation enabled\n"]);
    // A second run appends.
    run(line.clone()).exits(0);
    let both = std::fs::read_to_string(&log).expect("the log");
    assert!(both.starts_with(&first) && both.len() > first.len());
    let nowhere = [&line[..8], &["/nonexistent/x.log"]].concat();
    assert_contains(
        &run(nowhere).exits(2).err,
        &["cannot write /nonexistent/x.log"],
    );
}

#[test]
fn explain_shows_one_device_by_name_or_position() {
    let demo = config("demo.toml");
    let by_name = run(["explain", &demo, "y"]).exits(0).out;
    assert_contains(&by_name, &["device `y`", "0x6060:00", "0x08 CSP"]);
    assert!(
        !by_name.contains("device `x`") && !by_name.contains("program"),
        "{by_name}"
    );
    assert_eq!(run(["explain", &demo, "1"]).exits(0).out, by_name);
    assert_contains(
        &run(["explain", &demo, "z"]).exits(2).err,
        &["no device is called `z`"],
    );

    let json = |words: &[&str]| -> serde_json::Value {
        let out = run([&["explain", &demo, "--json"], words].concat())
            .exits(0)
            .out;
        serde_json::from_str(&out).expect("JSON")
    };
    let one = json(&["0"]);
    let devices = one["devices"].as_array().expect("devices");
    assert_eq!(devices.len(), 1);
    assert_eq!(devices[0]["name"], "x");
    assert_eq!(devices[0]["axes"][0]["limits"]["velocity"], 250.0);
    let startup = devices[0]["configuration"]["startup"]
        .as_array()
        .expect("SDOs");
    let mode = startup
        .iter()
        .find(|sdo| sdo["index"] == 0x6060)
        .expect("the mode");
    assert_eq!(mode["text"], "CSP");
    assert_eq!(json(&[])["devices"].as_array().map(Vec::len), Some(2));
}

#[test]
fn check_warns_of_a_velocity_above_the_limit_of_the_drive() {
    let folder = tempfile::tempdir().expect("a folder");
    let demo = std::fs::read_to_string(config("demo.toml")).expect("the file");
    let fast = demo.replacen("velocity = 250.0", "velocity = 9000.0", 1);
    let fast = fast.replace("\"esi/", &format!("\"{}/configs/esi/", root().display()));
    let path = folder.path().join("m.toml");
    std::fs::write(&path, fast).expect("written");
    let path = path.to_str().expect("UTF-8");
    let out = run(["check", path]).exits(0).out;
    let words = out.split_whitespace().collect::<Vec<_>>().join(" ");
    for object in [
        "0x607f:00 (Max profile velocity)",
        "0x6080:00 (Max motor speed)",
    ] {
        let text = format!("warning: {object} = 50000");
        assert!(words.contains(&text), "{words}");
    }
    assert!(words.contains("`limits.velocity` is 9000 mm/s"), "{words}");
}
