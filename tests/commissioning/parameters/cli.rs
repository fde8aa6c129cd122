//! `ecaxis sdo` and `ecaxis eeprom` from the user's view.

use std::path::Path;
use std::process::Command;

use ecaxis_test_support::program::{self, Ran};
use ecaxis_test_support::{fixture, root};

/// Returns exit code, standard output and standard error.
fn ran(folder: &Path, arguments: &[&str]) -> (i32, String, String) {
    let mut command = program::command();
    command.current_dir(folder).env("XDG_CACHE_HOME", folder);
    let ran = Ran::new(command.args(arguments));
    (ran.code, ran.out, ran.err)
}

fn demo() -> String {
    let path = root().join("configs/demo.toml");
    path.to_str().expect("UTF-8").to_owned()
}

#[test]
fn sdo_reads_and_writes_values_of_every_type() {
    let folder = tempfile::tempdir().expect("a folder");
    let demo = demo();
    let sdo = |words: &[&str], more: &[&str]| {
        let (verb, words) = words.split_first().expect("a verb");
        let line = [&["sdo", verb, &demo, "x"], words, &["--sim"], more].concat();
        ran(folder.path(), &line)
    };
    for (words, out) in [
        (
            &["read", "0x6065"][..],
            "0x6065:00 Following error window (UDINT) = 2000 (0x000007d0)\n",
        ),
        (
            &["read", "following error window"],
            "0x6065:00 Following error window (UDINT) = 2000 (0x000007d0)\n",
        ),
        (
            &["write", "0x6065", "0x100"],
            "0x6065:00 Following error window (UDINT) = 256 (0x00000100)\n",
        ),
        (
            &["read", "0x6065", "--type", "bytes"],
            "0x6065:00 Following error window (bytes) = d0 07 00 00\n",
        ),
    ] {
        let (code, reported, err) = sdo(words, &[]);
        assert_eq!((code, reported.as_str()), (0, out), "{words:?}: {err}");
        assert!(
            reported.lines().all(|line| line.chars().count() <= 80),
            "{reported}"
        );
    }
    let (code, reported, err) = sdo(&["read", "0x1018"], &[]);
    assert_eq!(code, 0, "{err}");
    assert!(reported.contains("0x1018:01  UDINT"), "{reported}");
    let (code, reported, _) = sdo(&["read", "0x1018:1"], &["--json"]);
    let json: serde_json::Value = serde_json::from_str(&reported).expect("JSON");
    assert_eq!((code, &json[0]["hex"]), (0, &"0x00000e0a".into()));
    for (words, code, part) in [
        (
            &["read", "Folowing error window"][..],
            2,
            "did you mean `Following error window`?",
        ),
        (&["read"], 2, "which object?"),
        (&["read", "0x12345"], 2, "indices have 16 bits"),
        (&["read", "0x5fff"], 1, "the object does not exist"),
        (
            &["write", "0x6065", "-1"],
            2,
            "-1 does not fit; the object takes 0 to 4294967295",
        ),
        (&["write", "0x6041", "1"], 1, "the object is read-only"),
        (&["write", "0x6065"], 2, "one object and one value"),
        (&["write", "0x6065", "[01]"], 1, "too short"),
        (
            &["dump", "/nowhere/x.toml"],
            2,
            "cannot write /nowhere/x.toml",
        ),
        (&["restore", "missing.toml"], 2, "cannot read missing.toml"),
    ] {
        let (ended, reported, err) = sdo(words, &[]);
        assert_eq!((ended, reported.as_str()), (code, ""), "{words:?}: {err}");
        assert!(err.contains(part), "{words:?}: `{part}` is not in:\n{err}");
    }
    let (code, _, err) = ran(
        folder.path(),
        &["sdo", "read", &demo, "z", "0x6041", "--sim"],
    );
    assert_eq!(code, 2);
    assert!(err.contains("no device is called `z`"), "{err}");
    let (code, reported, _) = sdo(&["store"], &[]);
    assert_eq!((code, reported.as_str()), (0, ""));
    assert_eq!(sdo(&["defaults"], &["--yes", "--json"]).0, 0);
    for more in [&[][..], &["--json"]] {
        let (code, reported, err) = sdo(&["defaults"], more);
        assert_eq!((code, reported.as_str()), (2, ""), "{err}");
        assert!(err.contains("nothing was written: add `--yes`"), "{err}");
        assert!(err.contains("`ecaxis sdo dump` keeps"), "{err}");
    }
}

#[test]
fn sdo_saves_and_restores_a_parameter_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let demo = demo();
    let run = |words: &[&str]| ran(folder.path(), words);
    let (code, out, err) = run(&["sdo", "dump", &demo, "x", "x.toml", "--sim"]);
    assert_eq!((code, out.as_str()), (0, ""), "{err}");
    let (code, _, err) = run(&["sdo", "dump", &demo, "x", "x.toml", "--sim"]);
    assert_eq!(code, 2);
    assert!(err.contains("x.toml exists already"), "{err}");
    assert_eq!(
        run(&["sdo", "compare", &demo, "x", "x.toml", "--sim"]),
        (0, String::new(), String::new())
    );
    assert_eq!(
        run(&["sdo", "compare", "x.toml", "x.toml"]),
        (0, String::new(), String::new())
    );

    let text = std::fs::read_to_string(folder.path().join("x.toml")).expect("the file");
    let line = "\"0x6065:00\" = { name = \"Following error window\", type = \"UDINT\", access = \"rw\", value = 2000 }";
    assert!(text.contains(line), "{text}");
    std::fs::write(
        folder.path().join("y.toml"),
        text.replacen("value = 2000 }", "value = 2001 }", 1),
    )
    .expect("written");
    let (code, out, err) = run(&["sdo", "compare", "x.toml", "y.toml"]);
    assert_eq!(code, 1, "{err}");
    assert!(
        out.contains("2000") && out.contains("2001") && err.contains("1 settings differ"),
        "{out}{err}"
    );
    let (code, out, err) = run(&["sdo", "restore", &demo, "x", "y.toml", "--sim", "--json"]);
    let json: serde_json::Value = serde_json::from_str(&out).expect("JSON");
    assert_eq!((code, &json["written"]), (0, &1.into()), "{out}{err}");
    // The file belongs to another product.
    let (code, _, err) = run(&["sdo", "restore", &demo, "y", "x.toml", "--sim"]);
    assert_eq!(code, 1);
    assert!(err.contains("--other-device"), "{err}");
}

/// Saves the parameters of an EPOS4, and again as those of another unit.
#[test]
fn restore_names_each_write_and_keeps_unit_data() {
    let Some(esi) = fixture("esi/maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml") else {
        return;
    };
    let esi = esi.canonicalize().expect("a path").display().to_string();
    let folder = tempfile::tempdir().expect("a folder");
    let text = format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"x\"\nesi = \"{esi}\"\nposition = 0\n\
         mode = \"csp\"\n[device.axis]\nencoder = 2000\nlimits = {{ velocity = 50.0, acceleration = 500.0 }}\n"
    );
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("m.toml"), text).expect("written");
    let run = |words: &[&str]| ran(folder.path(), words);
    let (code, _, err) = run(&["sdo", "dump", "m.toml", "x", "x.toml"]);
    assert_eq!(code, 0, "{err}");
    let mut dump = std::fs::read_to_string(at("x.toml")).expect("the file");
    for (object, value) in [
        ("0x3001:01", 3300),
        ("0x30a1:01", 77),
        ("0x3241:06", 60),
        ("0x30b5:02", 1),
    ] {
        let (before, after) = dump
            .split_once(&format!("\"{object}\""))
            .expect("an object");
        let (head, tail) = after.split_once("value = ").expect("a value");
        let tail = tail.split_once(" }").expect("an end").1;
        dump = format!("{before}\"{object}\"{head}value = {value} }}{tail}");
    }
    std::fs::write(at("own.toml"), &dump).expect("written");
    let serial = dump.lines().find(|line| line.starts_with("serial = "));
    let other = dump.replace(serial.expect("a number"), "serial = 4711");
    std::fs::write(at("other.toml"), other).expect("written");

    let (code, out, err) = run(&["sdo", "restore", "m.toml", "x", "other.toml"]);
    assert_eq!(code, 0, "{err}");
    for part in ["0x3001:01", "machine", "0x30a1:01", "tuned"] {
        assert!(out.contains(part), "`{part}` is not in:\n{out}");
    }
    assert!(!out.contains("0x3241") && !out.contains("0x30b5"), "{out}");
    for part in [
        "2 settings written",
        "not written (unit): ",
        "0x3241:06 (rotor angle): 0 kept, 60 in the file",
        "0x30b5:02 (home reference and its state): 0 kept, 1 in the file",
        "not written (command): ",
    ] {
        assert!(err.contains(part), "`{part}` is not in:\n{err}");
    }
    let restored = |words: &[&str]| {
        let (code, out, err) =
            run(&[&["sdo", "restore", "m.toml", "x"], words, &["--json"]].concat());
        assert_eq!(code, 0, "{err}");
        let json: serde_json::Value = serde_json::from_str(&out).expect("JSON");
        let objects = |key: &str| -> Vec<String> {
            let all = json[key].as_array().expect("a list").iter();
            all.map(|one| format!("{} {}", one["object"].as_str().expect("text"), one["class"]))
                .collect()
        };
        (objects("writes"), objects("skipped"))
    };
    let (writes, skipped) = restored(&["other.toml"]);
    assert_eq!(writes, ["0x3001:01 \"machine\"", "0x30a1:01 \"tuned\""]);
    assert!(
        skipped.contains(&"0x3241:06 \"unit\"".to_owned()),
        "{skipped:?}"
    );
    let (writes, _) = restored(&["own.toml"]);
    assert_eq!(writes.len(), 4, "{writes:?}");
    let (writes, _) = restored(&["own.toml", "--class", "machine,tuned"]);
    assert_eq!(writes.len(), 2, "{writes:?}");
    let (code, _, err) = run(&[
        "sdo",
        "restore",
        "m.toml",
        "x",
        "other.toml",
        "--class",
        "unit",
    ]);
    assert!(code == 2 && err.contains("serial number 4711"), "{err}");
    // Data of different units is not a difference of settings.
    let (_, out, _) = run(&["sdo", "compare", "m.toml", "x", "other.toml"]);
    assert!(
        out.contains("0x30a1:01") && !out.contains("0x3241"),
        "{out}"
    );
    let (_, out, _) = run(&["sdo", "compare", "m.toml", "x", "own.toml"]);
    assert!(out.contains("0x3241:06"), "{out}");
}

#[test]
fn the_object_list_is_the_same_from_esi_and_device() {
    let folder = tempfile::tempdir().expect("a folder");
    let demo = demo();
    let list = |more: &[&str]| {
        let line = [&["sdo", "list", &demo, "x", "--sim", "--json"], more].concat();
        let (code, out, err) = ran(folder.path(), &line);
        assert_eq!(code, 0, "{err}");
        let all: Vec<serde_json::Value> = serde_json::from_str(&out).expect("JSON");
        all
    };
    let (described, own) = (list(&[]), list(&["--ask"]));
    assert!(described.len() > 100);
    for item in &described {
        let same = |other: &&serde_json::Value| {
            other["index"] == item["index"] && other["sub"] == item["sub"]
        };
        let other = own.iter().find(same).unwrap_or_else(|| panic!("{item}"));
        assert_eq!(other["bits"], item["bits"], "{item}");
    }
}

#[test]
fn eeprom_reads_compares_and_writes_images() {
    let folder = tempfile::tempdir().expect("a folder");
    let demo = demo();
    let run = |words: &[&str]| {
        let (verb, words) = words.split_first().expect("a verb");
        let line = [&["eeprom", verb, &demo, "x"], words, &["--sim"]].concat();
        ran(folder.path(), &line)
    };
    let at = |name: &str| folder.path().join(name);
    let (code, out, err) = run(&["read", "x.bin"]);
    assert_eq!((code, out.as_str()), (0, ""), "{err}");
    let image = std::fs::read(at("x.bin")).expect("the image");
    let sii = ecaxis_esi::sii::parse(&image).expect("an image");
    assert!(sii.checksum_ok && sii.ended);
    let right = format!("its EEPROM is right: {} bytes\n", image.len());
    let (code, out, err) = run(&["verify"]);
    assert_eq!((code, err.as_str()), (0, ""));
    assert!(out.ends_with(&right), "{out}");
    assert_eq!(run(&["verify", "x.bin"]).0, 0);
    assert_eq!(run(&["read", "general.bin", "--category", "30"]).0, 0);
    // The whole chip differs from the image only after the image's end.
    assert_eq!(run(&["read", "all.bin", "--all"]).0, 0);
    let all = std::fs::read(at("all.bin")).expect("the chip");
    assert!(all.len() > image.len() && all.starts_with(&image));
    let (code, out, err) = run(&["verify", "all.bin"]);
    assert_eq!(code, 0, "{err}");
    assert!(out.ends_with("bytes, as in all.bin\n"), "{out}");
    let mut other = all.clone();
    *other.last_mut().expect("a byte") ^= 1;
    std::fs::write(at("end.bin"), other).expect("written");
    let (code, out, _) = run(&["verify", "end.bin"]);
    let last = all.len() - 1;
    let reported = format!("1 bytes are not those of end.bin, the first at 0x{last:04x}\n");
    assert_eq!((code, out), (1, reported));
    // The file is longer than the chip.
    std::fs::write(at("long.bin"), [&all[..], &[0xff; 100]].concat()).expect("written");
    let (code, out, _) = run(&["verify", "long.bin"]);
    assert_eq!(code, 1);
    assert!(
        out.starts_with("100 bytes are not those of long.bin"),
        "{out}"
    );
    assert!(
        !std::fs::read(at("general.bin"))
            .expect("the category")
            .is_empty()
    );

    // Rejected: writes without confirmation, damaged images, and images of other devices.
    let refused = |words: &[&str], code: i32, part: &str| {
        let (ended, out, err) = run(words);
        assert_eq!((ended, out.as_str()), (code, ""), "{words:?}: {err}");
        assert!(err.contains(part), "{words:?}: {err}");
        assert!(!at("kept.bin").exists());
    };
    refused(&["alias", "1001"], 2, "nothing was written: add `--yes`");
    refused(&["write", "x.bin"], 2, "nothing was written: add `--yes`");
    refused(&["alias", "70000", "--yes"], 2, "a number of 16 bits");
    refused(&["read", "x.bin"], 2, "x.bin exists already");
    refused(
        &["read", "none.bin", "--category", "77"],
        2,
        "the image has no category 77",
    );
    let spoilt = |name: &str, place: usize| {
        let mut other = image.clone();
        other[place] ^= 1;
        std::fs::write(at(name), other).expect("written");
    };
    // A category that makes the rest of the image unreadable.
    let entries = [0x00, 0x1a, 255, 3, 0, 0, 0, 0];
    std::fs::write(at("absurd.bin"), entries).expect("written");
    let line = [
        "write",
        "absurd.bin",
        "--category",
        "50",
        "--yes",
        "--backup",
    ];
    refused(&[&line[..], &["kept.bin"]].concat(), 2, "absurd.bin: ");
    spoilt("sum.bin", 14);
    spoilt("other.bin", 0x14);
    refused(
        &["write", "sum.bin", "--yes", "--backup", "kept.bin"],
        2,
        "the checksum",
    );
    refused(
        &["write", "other.bin", "--yes", "--backup", "kept.bin"],
        1,
        "--other-device",
    );
    let (code, out, _) = run(&["verify", "other.bin"]);
    assert_eq!(
        (code, out.as_str()),
        (
            1,
            "1 bytes are not those of other.bin, the first at 0x0014\n"
        )
    );

    let (code, out, err) = run(&[
        "write",
        "other.bin",
        "--yes",
        "--other-device",
        "--backup",
        "kept.bin",
    ]);
    assert_eq!((code, out.as_str()), (0, ""), "{err}");
    assert!(err.contains("1 word written and read back"), "{err}");
    assert_eq!(std::fs::read(at("kept.bin")).expect("kept"), image);
    let (code, _, err) = run(&["alias", "0x3e9", "--yes"]);
    assert_eq!(code, 0, "{err}");
    assert!(
        err.contains("2 words written") && err.contains("switched on again"),
        "{err}"
    );
    // The file name is derived from the device's name.
    let name = format!("eeprom-x-{}-1.bin", sii.serial);
    assert_eq!(std::fs::read(at(&name)).expect("kept"), image);
}

/// The disk is full: an incomplete backup must not remain.
#[test]
fn an_incomplete_file_is_removed() {
    let folder = tempfile::tempdir().expect("a folder");
    let line = format!(
        "trap '' XFSZ; ulimit -f 0; exec {} eeprom read {} x x.bin --sim",
        program::ecaxis().display(),
        demo()
    );
    let output = Command::new("sh")
        .args(["-c", &line])
        .current_dir(folder.path())
        .output()
        .expect("a shell");
    let err = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{err}");
    assert!(err.contains("cannot write x.bin: "), "{err}");
    assert!(!folder.path().join("x.bin").exists());
}

#[test]
fn sdo_read_watches_until_it_is_interrupted() {
    use std::io::{BufRead, BufReader};
    use std::process::Stdio;

    let demo = demo();
    let mut command = program::command();
    command.args(["sdo", "read", &demo, "0", "0x6041", "0x1018:01", "--sim"]);
    command
        .args(["--watch", "20ms", "--json"])
        .stdout(Stdio::piped());
    let mut child = command.stderr(Stdio::null()).spawn().expect("it starts");
    let lines = BufReader::new(child.stdout.take().expect("piped")).lines();
    let objects: Vec<serde_json::Value> = lines
        .take(2)
        .map(|line| serde_json::from_str(&line.expect("a line")).expect("JSON"))
        .collect();
    let text = objects[0]["text"].as_str().expect("a text");
    assert!(text.starts_with("Switch on disabled"), "{text}");
    assert_eq!(objects[1]["index"], 0x1018);
    assert!(
        objects[1]["time"]
            .as_str()
            .is_some_and(|time| time.ends_with('Z'))
    );
    // Nothing changes afterwards.
    std::thread::sleep(std::time::Duration::from_millis(300));
    assert!(child.try_wait().expect("a state").is_none(), "it goes on");
    let id = rustix::process::Pid::from_child(&child);
    rustix::process::kill_process(id, rustix::process::Signal::INT).expect("it runs");
    assert_eq!(child.wait().expect("it ends").code(), Some(130));
}
