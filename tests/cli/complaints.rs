//! Exit codes and messages for user mistakes and failed operations.

use std::path::Path;

use ecaxis_test_support::{program, root};

/// Runs a command line, split at blanks; `~` stands for a temporary folder. Returns exit code,
/// stdout and stderr.
fn ran(line: &str, folder: &Path) -> (i32, String, String) {
    let folder = folder.to_str().expect("UTF-8");
    let words: Vec<String> = line.split(' ').map(|w| w.replace('~', folder)).collect();
    let ran = program::run(words);
    (ran.code, ran.out, ran.err)
}

#[test]
fn mistakes_have_an_exit_code_and_a_hint() {
    let folder = tempfile::tempdir().expect("a folder");
    let write = |name: &str, bytes: &[u8]| {
        std::fs::write(folder.path().join(name), bytes).expect("written");
    };
    write("empty.bin", b"");
    write("empty.pcapng", b"\n\r\r\n");
    write("typo.toml", TYPO.as_bytes());
    let whole = std::fs::read(root().join("configs/esi/EPOS4.xml")).expect("our ESI");
    write("esi.xml", &whole);
    let nonsense: String = (0..500).map(|n| format!("{n} ] = [ =\n")).collect();
    write("nonsense.toml", nonsense.as_bytes());

    for (line, code, parts) in [
        // Files that are missing, of the wrong type, or not writable.
        (
            "run configs/demo.toml --replay ~/none.pcapng",
            2,
            &["none.pcapng"][..],
        ),
        (
            "run configs/demo.toml --replay ~/empty.pcapng",
            2,
            &["the replay"],
        ),
        (
            "scan --sim configs/demo.toml --write /nonexistent/m.toml",
            2,
            &["cannot write /nonexistent/m.toml"],
        ),
        (
            "firmware sample configs/demo.toml x -o /nonexistent/n",
            2,
            &["cannot write /nonexistent/n", "= help"],
        ),
        ("man --out /proc/self/xx", 2, &["cannot write"]),
        (
            "bench --sim --seconds 60 --html /nonexistent/x.html",
            2,
            &["cannot write /nonexistent/x.html"],
        ),
        (
            "bench --sim --seconds 60 --save /nonexistent/x.json",
            2,
            &["cannot write /nonexistent/x.json"],
        ),
        (
            "bench --sim --cpu 999",
            2,
            &["there is no CPU 999; this computer has 0"],
        ),
        (
            "firmware update configs/demo.toml x ~/empty.bin --sim --yes",
            2,
            &["empty.bin is empty"],
        ),
        // Named items that are rejected.
        (
            "sdo read configs/demo.toml x 0x6064 0x5fff 0x6041 --sim",
            1,
            &["error: the device refused 0x5fff"],
        ),
        (
            "sdo read configs/demo.toml x 0x6065 --type u16 --sim",
            2,
            &["0x6065:00 has 4 bytes, a UINT has 2"],
        ),
        (
            "eeprom alias configs/demo.toml x 99999 --yes --sim",
            2,
            &["`99999`: a number of 16 bits"],
        ),
        // Values on the command line.
        (
            "doctor --seconds abc",
            2,
            &["'abc' for '--seconds <N>': whole seconds, such as 10"],
        ),
        (
            "run configs/demo.toml --repeat -1",
            2,
            &["'-1' for '--repeat <N>'"],
        ),
        (
            "run configs/demo.toml --for -5s",
            2,
            &["'-5s' for '--for <DURATION>'"],
        ),
        (
            "esi list configs/esi --vendor 77",
            2,
            &["describes no such device", "its vendors are 0x00000e0a"],
        ),
        // No machine file.
        (
            "check ~/esi.xml",
            2,
            &["this is XML, not a machine file", "ecaxis esi check"],
        ),
        ("check ~/nonsense.toml", 2, &["more mistakes from here on"]),
        (
            "check ~/typo.toml",
            2,
            &["error: unknown key `devise`", "did you mean `device`?"],
        ),
    ] {
        let (got, out, err) = ran(line, folder.path());
        assert_eq!(got, code, "{line}: {out}{err}");
        for part in parts {
            assert!(err.contains(part), "{line}: `{part}` is not in:\n{err}");
        }
    }
    let (_, out, _) = ran(
        "sdo read configs/demo.toml x 0x6064 0x5fff 0x6041 --sim",
        folder.path(),
    );
    assert!(out.contains("0x6041:00"), "the others are reported:\n{out}");
    let (_, _, err) = ran("check ~/typo.toml", folder.path());
    assert!(!err.contains("duplicate"), "only what is the cause:\n{err}");
    let (_, _, err) = ran("check ~/nonsense.toml", folder.path());
    assert!(err.lines().count() < 100, "not all of it:\n{err}");
    let (_, _, err) = ran("check configs/no-such.toml", folder.path());
    assert!(err.matches(".toml").count() <= 5, "{err}");
}

/// Both devices have other names.
const TYPO: &str = r#"
[bus]
cycle = "1ms"

[[devise]]
name = "x"
esi = "esi/EPOS4.xml"
position = 0
mode = "csp"
[device.axis]
encoder = 2000
limits = { velocity = 10.0, acceleration = 100.0 }

[[devise]]
name = "y"
esi = "esi/EPOS4.xml"
position = 1
mode = "csp"
[device.axis]
encoder = 2000
limits = { velocity = 10.0, acceleration = 100.0 }
"#;

/// `--verbose` is accepted before and after the verb.
#[test]
fn verbose_is_accepted_anywhere() {
    let folder = tempfile::tempdir().expect("a folder");
    for line in [
        "sdo -v read configs/demo.toml x 0x6064 --sim",
        "sdo read -v configs/demo.toml x 0x6064 --sim",
        "firmware info configs/demo.toml x --sim -v",
    ] {
        let (code, out, err) = ran(line, folder.path());
        assert_eq!(code, 0, "{line}: {err}");
        assert!(err.contains("DEBUG"), "{line}: {out}{err}");
    }
}

/// Subindices are hexadecimal in every input and output.
#[test]
fn subindices_are_hexadecimal() {
    let folder = tempfile::tempdir().expect("a folder");
    let read = |object: &str| {
        let line = format!("sdo read configs/demo.toml x {object} --sim --json");
        let (code, out, err) = ran(&line, folder.path());
        assert_eq!(code, 0, "{object}: {err}");
        let json: serde_json::Value = serde_json::from_str(&out).expect("JSON");
        json[0]["sub"].as_u64()
    };
    let (_, list, _) = ran("sdo list configs/demo.toml x --sim --json", folder.path());
    let list: Vec<serde_json::Value> = serde_json::from_str(&list).expect("JSON");
    let mut high = list.iter().filter(|item| item["sub"].as_u64() > Some(15));
    let item = high.next().expect("an object of many subindices");
    let (index, sub) = (
        item["index"].as_u64().expect("a number"),
        item["sub"].as_u64(),
    );
    let shown = format!("0x{index:04x}:{:02x}", sub.expect("a number"));
    assert_eq!(read(&shown), sub, "{shown}");
    let (_, out, _) = ran("sdo list configs/demo.toml x --sim", folder.path());
    assert!(out.contains(&shown), "{shown} is not in\n{out}");
    assert_eq!(read("0x1018:01"), Some(1));
}

/// A failed replay gives no advice for repairs, because a recording is not repairable.
#[test]
fn a_replay_that_deviates_gives_no_repair_hint() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = "run configs/demo.toml --sim --virtual --repeat 1";
    let (code, _, err) = ran(&format!("{run} --record ~/whole.pcapng"), folder.path());
    assert_eq!(code, 0, "{err}");
    let whole = std::fs::read(folder.path().join("whole.pcapng")).expect("recorded");
    let cut = &whole[..whole.len() / 50];
    std::fs::write(folder.path().join("cut.pcapng"), cut).expect("written");
    for (line, code, parts) in [
        (
            "run configs/demo.toml --replay ~/cut.pcapng",
            2,
            &[
                "error: the replay: the recording ends before",
                "further deviation",
            ][..],
        ),
        (
            "run configs/commissioning.toml --replay ~/whole.pcapng",
            1,
            &[
                "of another machine",
                "it shows 2 SubDevices, the file has 9",
            ],
        ),
    ] {
        let (got, _, err) = ran(line, folder.path());
        assert_eq!(got, code, "{line}: {err}");
        for part in parts {
            assert!(err.contains(part), "{line}: `{part}` is not in:\n{err}");
        }
        assert!(!err.contains("check power"), "{line}: {err}");
        assert!(err.matches("deviat").count() <= 2, "{line}: {err}");
    }
    // A recording of another machine does not match the file either.
    let (_, _, err) = ran(
        "analyze ~/whole.pcapng --machine configs/commissioning.toml",
        folder.path(),
    );
    assert!(err.contains("is it of this machine?"), "{err}");
    let (_, _, err) = ran(
        "analyze ~/whole.pcapng --machine configs/demo.toml",
        folder.path(),
    );
    assert_eq!(err, "");
}

/// The last known position is not the final position.
#[test]
fn an_axis_without_answers_has_no_final_position() {
    let folder = tempfile::tempdir().expect("a folder");
    let script = "[[fault]]\nkind = \"power-off\"\nat = \"1s\"\ndevice = 1\n";
    std::fs::write(folder.path().join("off.toml"), script).expect("written");
    let line = "run configs/demo.toml --sim --virtual --faults ~/off.toml";
    let (code, out, _) = ran(line, folder.path());
    assert_eq!(code, 1);
    let row = |name: &str| {
        let mut rows = out.lines();
        let row = rows.find(|line| line.starts_with(&format!("  {name} ")));
        row.unwrap_or_else(|| panic!("{name} is not in:\n{out}"))
            .to_owned()
    };
    assert!(row("y").contains("not heard since 0."), "{out}");
    let (_, out, _) = ran(&format!("{line} --json"), folder.path());
    let json: serde_json::Value = serde_json::from_str(&out).expect("JSON");
    let heard = json["summary"]["axes"][1]["last_heard_s"].as_f64();
    assert!(heard.is_some_and(|s| s < 1.0), "{heard:?}");
    // Axes with answers until the end have no such time.
    let (_, out, _) = ran(
        "run configs/demo.toml --sim --virtual --repeat 1 --json",
        folder.path(),
    );
    let json: serde_json::Value = serde_json::from_str(&out).expect("JSON");
    assert!(json["summary"]["axes"][1]["last_heard_s"].is_null());
}

#[test]
fn fractions_of_a_percent_are_reported() {
    let folder = tempfile::tempdir().expect("a folder");
    let (code, out, _) = ran("explain configs/demo.toml", folder.path());
    assert_eq!(code, 0);
    let percent = |line: &str| {
        let (before, _) = line.split_once(" %")?;
        before.rsplit(' ').next().map(str::to_owned)
    };
    let reported: Vec<String> = out
        .lines()
        .filter(|l| l.contains("µs"))
        .filter_map(percent)
        .collect();
    assert!(reported.len() >= 2, "{out}");
    assert!(
        reported.iter().all(|number| number.contains('.')),
        "{reported:?}"
    );
}
