//! `ecaxis jog --lines`: scripts on standard input, in virtual time.

use std::io::Write;
use std::process::Stdio;

use serde_json::Value;

use ecaxis_test_support::{program, root};

/// Returns exit code, standard output and standard error.
fn script(lines: &str, more: &[&str]) -> (i32, String, String) {
    script_for("configs/demo.toml", lines, more)
}

fn script_for(file: &str, lines: &str, more: &[&str]) -> (i32, String, String) {
    let mut child = program::command()
        .args(["jog", file, "--sim", "--lines", "--virtual"])
        .args(more)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the binary runs");
    let mut stdin = child.stdin.take().expect("a pipe");
    // The program may exit at an invalid line.
    let _ = stdin.write_all(lines.as_bytes());
    drop(stdin);
    let output = child.wait_with_output().expect("it ends");
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("UTF-8");
    let code = output.status.code().expect("an exit code");
    (code, text(output.stdout), text(output.stderr))
}

#[test]
fn a_script_moves_a_machine() {
    let lines = "\
enable              # both
wait
speed 20
move x 10
by y -5
wait
status
disable x
wait
quit
";
    let (code, out, err) = script(lines, &[]);
    assert_eq!(code, 0, "{err}");
    let (status, news): (Vec<&str>, Vec<&str>) = out.lines().partition(|l| l.contains("CSP"));
    let reported = [
        "x: enabled",
        "y: enabled",
        "y: is there",
        "x: is there",
        "x: disabled",
    ];
    assert_eq!(news, reported);
    for (line, begins, place) in [
        (0, "x: Operation enabled, CSP, ", 10.0),
        (1, "y: Operation enabled, CSP, ", -5.0),
    ] {
        let rest = status[line].strip_prefix(begins).expect(status[line]);
        let (position, rest) = rest.split_once(" mm, ").expect("a position");
        let position: f64 = position.parse().expect("a number");
        assert!((position - place).abs() < 0.01, "{out}");
        assert!(rest.ends_with(" %, holds"), "{out}");
    }
    let (_, again, _) = script(lines, &[]);
    assert_eq!(again, out, "virtual time is the same every time");
}

/// The mode of a drive without 0x6061 in its process data is read over CoE. Enabling waits for it,
/// and the first move is not stopped by it.
#[test]
fn first_move_of_a_drive_with_a_hidden_mode_arrives() {
    let folder = tempfile::tempdir().expect("a folder");
    let esi = root().join("configs/esi/EPOS4.xml").display().to_string();
    let text = format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"a\"\nesi = \"{esi}\"\nposition = 0\n\
         mode = \"csp\"\npdo.rx = [\"0x6040\", \"0x607A\"]\npdo.tx = [\"0x6041\", \"0x6064\"]\n[device.axis]\n\
         encoder = 2000\nlimits = {{ velocity = 50.0, acceleration = 500.0 }}\n"
    );
    let file = folder.path().join("m.toml");
    std::fs::write(&file, text).expect("written");
    let lines = "enable a\nwait\nmove a 2\nwait\nstatus\nmove a 3\nwait\nstatus\n";
    let (code, out, err) = script_for(file.to_str().expect("text"), lines, &[]);
    assert_eq!(code, 0, "{err}");
    let all: Vec<&str> = out.lines().collect();
    assert_eq!(all[0], "a: enabled", "{out}");
    for (news, status, position) in [(1, 2, 2.0), (3, 4, 3.0)] {
        assert_eq!(all[news], "a: is there", "{out}");
        let (_, rest) = all[status].split_once("CSP, ").expect("a status");
        let reported: f64 = rest
            .split_once(' ')
            .expect("a unit")
            .0
            .parse()
            .expect("a number");
        assert!((reported - position).abs() < 0.01, "{out}");
    }
}

/// Behind a gateway, PP has no profile velocity in the process data.
#[test]
fn motion_by_hand_in_pp_is_refused_with_its_reason() {
    let folder = tempfile::tempdir().expect("a folder");
    let esi = root().join("configs/esi/gateway.xml").display().to_string();
    let text = format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"gateway\"\nesi = \"{esi}\"\n\
         type = \"GW64\"\nposition = 0\n[device.can]\nsync = \"4ms\"\n[[device.node]]\nid = 6\n\
         drive = \"EPOS 24/1\"\nmode = \"pp\"\n\
         outputs = [{{ pdo = 1, at = 12, objects = [\"0x6040\", \"0x607A\"] }}, {{ pdo = 3, at = 18 }}]\n\
         inputs = [{{ pdo = 1, at = 12, objects = [\"0x6041\", \"0x6064\"] }}, {{ pdo = 3, at = 18 }}]\n\
         [device.node.axis]\nname = \"b\"\nencoder = 2000\n\
         limits = {{ velocity = 50.0, acceleration = 250.0 }}\n"
    );
    let file = folder.path().join("m.toml");
    std::fs::write(&file, text).expect("written");
    for (line, part) in [
        ("jog b 5", "a jog needs CSP, CSV or PV; the axis is in PP"),
        ("move b 5", "move it by a program, or use it in CSP"),
    ] {
        let lines = format!("enable b\nwait\n{line}\nwait\nstatus\n");
        let (code, out, err) = script_for(file.to_str().expect("text"), &lines, &[]);
        assert_eq!(code, 1, "{out}{err}");
        assert!(err.contains(part), "{err}");
    }
}

#[test]
fn a_jog_lasts_for_its_requested_time() {
    let jog = "jog x 10\nwait 100ms\n".repeat(10);
    let lines = format!("enable x\nwait\n{jog}wait\nstatus\n");
    let (code, out, err) = script(&lines, &["--json"]);
    assert_eq!(code, 0, "{err}");
    let answers: Vec<Value> = out
        .lines()
        .map(|line| serde_json::from_str(line).expect("an object a line"))
        .collect();
    let what: Vec<_> = answers.iter().filter_map(|a| a["what"].as_str()).collect();
    assert_eq!(what, ["enabled", "let go, brakes", "stopped"]);
    // One second, plus the time until the missing request is detected.
    let status = answers
        .iter()
        .find(|a| a["axis"] == "x" && a["state"].is_string());
    let position = status.expect("a status")["position"]
        .as_f64()
        .expect("a number");
    assert!((11.5..12.5).contains(&position), "{position} mm");
}

#[test]
fn a_script_ends_at_the_first_failing_line() {
    for (lines, code, parts) in [
        (
            "wiggle x\nenable\n",
            2,
            &["`wiggle x`", "not understood", "help"][..],
        ),
        (
            "# by hand\nenabel x\n",
            2,
            &["line 2: `enabel x`", "did you mean `enable`?"],
        ),
        ("enable z\n", 2, &["no axis is named `z`", "x, y"]),
        (
            "move x\n",
            2,
            &["`move` takes the name of an axis and a number"],
        ),
        ("jog x NaN\n", 2, &["`NaN` is not a number"]),
        ("mode x warp\n", 2, &["`warp` is not a mode", "csp"]),
        ("speed 26\n", 2, &["up to 25"]),
        ("wait 5\n", 2, &["unit"]),
        (
            "move x 10\nwait\nstatus\n",
            1,
            &["x: refused", "not enabled"],
        ),
        (
            "enable x\nwait\njog x 200\nwait\n",
            1,
            &["x: refused", "62.5 mm/s"],
        ),
        (
            "enable x\nwait\nmove x 61\nwait\n",
            1,
            &["x: refused", "range"],
        ),
        ("home x\nwait\n", 1, &["x: refused", "homing"]),
        (
            "estop\nenable x\nwait\n",
            1,
            &["x: refused", "emergency stop"],
        ),
    ] {
        let (exit, out, err) = script(lines, &[]);
        assert_eq!(exit, code, "{lines}{out}{err}");
        for part in parts {
            assert!(err.contains(part), "`{part}` is not in:\n{err}");
        }
    }
}

#[test]
fn the_end_of_input_ends_the_run() {
    for lines in ["", "# nothing\n\n", "enable x\nwait\njog x 10\n"] {
        let (code, _, err) = script(lines, &[]);
        assert_eq!(code, 0, "{lines:?}: {err}");
    }
    let (code, out, _) = script("help\n", &[]);
    assert_eq!(code, 0);
    assert!(out.contains("estop"), "{out}");
    let (code, _, err) = script(&"x".repeat(100_000), &[]);
    assert_eq!(code, 2);
    assert!(err.contains("too long"), "{err}");
}

/// The others could go on after a reset, so the run does not fail; the report is kept all the same.
#[test]
fn a_missing_device_leaves_a_fault_report() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_owned();
    let cut = "[[fault]]\nkind = \"absent\"\ndevice = 1\nat = \"1s\"\n";
    std::fs::write(at("cut.toml"), cut).expect("written");
    let (faults, report) = (at("cut.toml"), at("report.txt"));
    let lines = "enable\nwait\nwait 3s\nquit\n";
    let options = ["--faults", &faults, "--fault-report", &report];
    let (code, _, err) = script(lines, &options);
    assert_eq!(code, 0, "{err}");
    assert!(err.contains("full fault report: "), "{err}");
    let text = std::fs::read_to_string(&report).expect("a report");
    assert!(text.contains("`y` (position 1"), "{text}");
    let (code, _, err) = script(lines, &options);
    assert_eq!(code, 2, "{err}");
    assert!(err.contains("report.txt exists already"), "{err}");
}

/// Inputs of the simulated bus are pressed, released and set; wrong ones are refused.
#[test]
fn a_script_presses_inputs() {
    let file = "configs/pick-and-place.toml";
    let lines =
        "press start\nwait 10ms\nstatus\nrelease start\nset io.Input 6 = 1\nwait 10ms\nstatus\n";
    let (code, out, err) = script_for(file, lines, &[]);
    assert_eq!(code, 0, "{err}");
    let inputs: Vec<_> = out
        .lines()
        .filter(|line| line.starts_with("io.Input"))
        .collect();
    let value = |at: usize, name: &str| {
        let mut all = inputs.iter().filter(|line| line.starts_with(name));
        all.nth(at).and_then(|line| line.split(" = ").nth(1))
    };
    assert_eq!(
        [value(0, "io.Input 5"), value(0, "io.Input 6")],
        [Some("1"), Some("0")],
        "{out}"
    );
    assert_eq!(
        [value(1, "io.Input 5"), value(1, "io.Input 6")],
        [Some("0"), Some("1")],
        "{out}"
    );
    for (line, part) in [
        ("press begin", "inputs of [signals]: `closed`"),
        ("press x.Statusword", "which the drive sets"),
        ("set start = 2", "not a value"),
        ("set start", "write `set"),
        ("press", "takes the name of an input"),
    ] {
        let (code, _, err) = script_for(file, &format!("{line}\n"), &[]);
        assert!(code == 2 && err.contains(part), "{line}: {code} {err}");
    }
}
