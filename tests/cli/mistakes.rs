//! Mistakes of new users. Each message says what is wrong, where, why, and what to do.

use std::path::Path;
use std::process::{Command, Stdio};

use ecaxis_test_support::program::{Ran, ecaxis};
use ecaxis_test_support::root;

/// Runs a line of the shell in a folder, with the program as `ecaxis`.
fn ran(folder: &Path, line: &str) -> Ran {
    let program = ecaxis();
    let programs = program.parent().expect("a folder").display();
    let path = std::env::var("PATH").unwrap_or_default();
    let mut command = Command::new("sh");
    command
        .args(["-c", line])
        .current_dir(folder)
        .stdin(Stdio::null());
    command.env("PATH", format!("{programs}:{path}"));
    command.env("XDG_CACHE_HOME", folder);
    Ran::new(&mut command)
}

/// Mistakes in the machine file of `ecaxis init`: text, its replacement, what is wrong, what to do.
#[rustfmt::skip] // one row per mistake
const IN_THE_FILE: [(&str, &str, &str, &str); 22] = [
    ("per_turn = 5.0 ", "per_trun = 5.0 ", "unknown key `per_trun` in [device.axis]", "did you mean `per_turn`?"),
    ("cycle = \"1ms\"", "cycle = 1", "a duration needs a unit", "write \"1ms\" or \"1us\", with the quotes"),
    ("cycle = \"1ms\"", "cycle = \"-1ms\"", "\"-1ms\" is not a duration", "a number and a unit"),
    ("cycle = \"1ms\"", "cycle = \"1mss\"", "unknown unit of time `mss`", "did you mean `ms`?"),
    ("[-60.0, 60.0]", "[60.0, -60.0]", "the range of positions is empty", "write the lower end first"),
    ("speed = 0.5", "speed = 50", "`speed` is 50, but it is a fraction", "a number above 0.0 and up to 1.0"),
    ("{ x = 50.0,", "{ z = 50.0,", "no device is named `z`", "axes: `x`, `y`"),
    ("{ x = 50.0,", "{ x = 61.0,", "61 mm is outside the axis' limits, -60 to 60 mm", "`limits.position`"),
    ("{ x = 50.0,", "{ x = 1e300,", "a number from -1e15 to 1e15, found 1e300", ""),
    ("move  = { x = 50.0,", "move_to = { x = 50.0,", "unknown key `move_to` in [[step]]", "did you mean `move`?"),
    ("move  = { x = 50.0, y = -20.0 }", "move_by = { x = 1e18 }", "a number from -1e15 to 1e15, found 1e18", ""),
    ("move  = { x = 50.0, y = -20.0 }", "move_by = { x = 200.0 }", "a way of 200 mm is longer than the axis' range", "`limits.position`"),
    ("esi/IDX.xml", "esi/IDY.xml", "cannot read esi/IDY.xml", "did you mean `IDX.xml`?"),
    ("\"esi/EPOS4.xml\"", "\"esi\\EPOS4.xml\"", "`\\` begins an escape", "write paths with `/`, or in single quotes"),
    ("esi/IDX.xml", "esi/IO8.xml", "offers no mode csp: no PDO has 0x6040", "an I/O device has no `mode`"),
    ("position = 1", "position = 0", "position 0 is taken", "line 25 has it"),
    ("repeat = 1 ", "enable = no ", "`no` is not a value", "write `false`"),
    ("per_turn = 5.0 ", "# per_turn ", "`unit` is mm, but nothing says how many", "add `per_turn = 5.0`"),
    ("encoder  = 2000 ", "# encoder ", "`encoder` is missing in [device.axis]", "add `encoder = 2000`"),
    ("mode     = \"csp\"", "mode     = \"cps\"", "unknown mode \"cps\"", "did you mean `csp`?"),
    ("velocity = 250.0", "velocity = -250.0", "`limits.velocity` is -250 mm/s, but must be above zero", ""),
    ("name     = \"y\"", "name     = \"x\"", "the name \"x\" is taken", "line"),
];

#[test]
fn mistakes_in_a_machine_file_name_place_reason_and_remedy() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = folder.path();
    ran(at, "ecaxis init .").exits(0);
    std::fs::copy(root().join("configs/esi/IO8.xml"), at.join("esi/IO8.xml")).expect("copied");
    let good = std::fs::read_to_string(at.join("machine.toml")).expect("written");
    for (from, to, message, help) in IN_THE_FILE {
        assert!(good.contains(from), "{from}");
        let text = good.replacen(from, to, 1);
        std::fs::write(at.join("bad.toml"), &text).expect("written");
        let said = ran(at, "ecaxis check bad.toml");
        said.fails(2, &[message, " --> bad.toml:", help]);
        assert!(
            help.is_empty() || said.err.contains("= help: "),
            "{}",
            said.err
        );
        // Nothing is sent before the file is right.
        ran(at, "ecaxis run bad.toml --virtual").fails(2, &[message]);
    }
}

#[test]
#[rustfmt::skip] // one row per mistake
fn mistakes_on_the_command_line_name_reason_and_remedy() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = folder.path();
    ran(at, "ecaxis init . && ecaxis eeprom read machine.toml y y.bin --sim --all").exits(0);
    let utf16 = [0xff, 0xfe, b'[', 0, b'b', 0];
    std::fs::write(at.join("utf16.toml"), utf16).expect("written");
    std::fs::write(at.join("noise.bin"), [0x5a; 1000]).expect("written");
    std::fs::write(at.join("gone.toml"), "[[fault]]\nkind = \"absent\"\ndevice = 1\n").expect("written");
    let demo = root().join("configs/modes.toml");
    let other = format!("ecaxis compare machine.toml --sim {}", demo.display());
    for (line, code, parts) in [
        ("ecaxis chek machine.toml", 2, &["unrecognized subcommand 'chek'", "'check'"][..]),
        ("ecaxis run machin.toml", 2, &["cannot read machin.toml", "machine files nearby: machine.toml"]),
        ("ecaxis run esi", 2, &["esi is a folder", "name the machine file in it"]),
        ("ecaxis check utf16.toml", 2, &["utf16.toml is not text", "in UTF-8"]),
        ("ecaxis run machine.toml --nic nonet7", 2, &["the interface `nonet7` does not exist", "this computer has"]),
        ("ecaxis run machine.toml --nic lo", 2, &["the interface `lo` is the loopback", "this computer has"]),
        ("ecaxis run --nic nonet7", 2, &["--nic: which machine file?", "ecaxis scan IF --write FILE"]),
        ("ecaxis scan", 2, &["which network interface?", "this computer has", "`--sim FILE`"]),
        ("ecaxis scan --sim machine.toml --write machine.toml", 2, &["machine.toml is there already", "`--force`"]),
        ("ecaxis run machine.toml --virtual --record no/such/x.pcapng", 2, &["cannot write no/such/x.pcapng", "= help"]),
        ("ecaxis eeprom write machine.toml x y.bin --sim --yes", 1, &["`x` (position 0", "y.bin is an image of", "`--other-device`"]),
        ("ecaxis firmware update machine.toml x noise.bin --sim --yes", 1, &["`x` (position 0", "was refused at packet 1", "the device is in Init", "use the file that its vendor specifies"]),
        ("ecaxis run machine.toml --virtual --faults gone.toml", 1, &["missing: `y` (position 1)", "= help"]),
        (&other, 1, &["the bus is not as in machine.toml: 3 differences", "`--apply`"]),
        ("ecaxis jog machine.toml --sim", 2, &["not a terminal", "`--lines`"]),
        ("ecaxis init .", 2, &["machine.toml exists already", "`--force`"]),
        // Not mistakes.
        ("ecaxis explain machine.toml | head -1", 0, &[]),
        ("{ printf '\\357\\273\\277'; sed 's/$/\\r/' machine.toml; } > bom.toml && ecaxis check bom.toml", 0, &[]),
        ("mkdir links && ln -s ../esi links/esi && ln -s ../machine.toml links && ecaxis check links/machine.toml", 0, &[]),
    ] {
        let said = ran(at, line);
        assert_eq!(said.code, code, "{line}: {}{}", said.out, said.err);
        for part in parts {
            assert!(said.err.contains(part), "{line}: `{part}` is not in:\n{}", said.err);
        }
    }
    let out = ran(at, "ecaxis eeprom verify machine.toml x --sim").exits(0).out;
    assert!(out.contains("its EEPROM is right"), "{out}");
}
