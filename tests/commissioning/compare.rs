//! `ecaxis compare` names every kind of difference, and `--apply` produces a valid file.

use std::sync::Arc;

use ecaxis_master::clock::Clock;
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::session::{Observer, Options, Progress, run_on, simulated_bus};
use serde_json::Value;

use ecaxis_test_support::assert_snapshot;
use ecaxis_test_support::bench::Bench;

/// A machine with every property that may differ.
const MACHINE: &str = r#"# The machine at the window.

[bus]
cycle = "1ms"              # as short as it must be

[[device]]
name     = "coupler"
esi      = "esi/terminals.xml"
type     = "CP0"
position = 0

[[device]]
name     = "doors"         # of the cabinet
esi      = "esi/terminals.xml"
type     = "DI8"
position = 1

[[device]]
name     = "x"             # left to right
esi      = "esi/EPOS4.xml"
position = 2
serial   = 1002
mode     = "csp"

[device.axis]
unit    = "turn"
encoder = 2000
limits  = { velocity = 10.0, acceleration = 100.0 }

[[device]]
name     = "y"             # front to back
esi      = "esi/IDX.xml"
position = 3
mode     = "csp"

[device.axis]
unit    = "turn"
encoder = 2000
limits  = { velocity = 10.0, acceleration = 100.0 }

[[device]]
name     = "block"
esi      = "esi/MIO2.xml"
position = 4
modules  = ["IN8", "OUT8"] # as they were plugged

[[device]]
name     = "lamp"
esi      = "esi/IO8.xml"
alias    = 20

[stop]
emergency = { doors."Channel 1" = false }   # a person is inside

[[stop.group]]
name    = "table"
axes    = ["x", "y"]

[[step]]                   # both at once
move = { x = 1.0, y = 2.0 }

[[step]]
set = { lamp."Output 1" = true }

[[step]]
repeat = 2

[[step.step]]
move = { y = 0.0 }

[[step.step]]
dwell = "10ms"
"#;

struct Case {
    name: &'static str,
    /// The kinds of differences in JSON.
    kinds: &'static [&'static str],
    /// Texts that the output must contain.
    reported: &'static [&'static str],
    /// Converts the machine file to that of the other bus.
    other: fn(&str) -> String,
}

/// Returns the text of one [[device]].
fn section<'t>(text: &'t str, name: &str) -> &'t str {
    let from = text.find(&format!("[[device]]\nname     = \"{name}\""));
    let rest = &text[from.expect("the device")..];
    match rest.find("\n[[") {
        Some(to) => &rest[..=to],
        None => rest,
    }
}

fn only_devices(text: &str) -> String {
    text[..text.find("[stop]").expect("[stop]")].to_owned()
}

fn without(text: &str, name: &str) -> String {
    let devices = only_devices(text);
    devices.replace(section(&devices, name), "")
}

fn cases() -> Vec<Case> {
    vec![
        Case {
            name: "missing",
            kinds: &["missing"],
            reported: &["`y` (position 3) is missing: no IDX is left on the bus for it"],
            other: |text| without(text, "y").replace("position = 4", "position = 3"),
        },
        Case {
            name: "missing-alias",
            kinds: &["missing"],
            reported: &["`lamp` (alias 20) is missing"],
            other: |text| without(text, "lamp"),
        },
        Case {
            name: "added",
            kinds: &["added"],
            reported: &["position 2 is not in the file: SV1, "],
            other: |text| {
                let text = only_devices(text)
                    .replace("position = 4", "position = 5")
                    .replace("position = 3", "position = 4")
                    .replace("position = 2", "position = 3");
                let esi = "[[device]]\nname = \"new\"\nesi = \"esi/SV1.xml\"\nposition = 2\nserial = 77\n";
                format!("{text}\n{esi}")
            },
        },
        Case {
            name: "swapped",
            kinds: &["swapped"],
            reported: &["`x` and `y` are swapped: `x` is at position 3, `y` at position 2"],
            other: |text| {
                only_devices(text)
                    .replace("position = 3", "position = 99")
                    .replace("position = 2", "position = 3")
                    .replace("position = 99", "position = 2")
            },
        },
        Case {
            name: "revision",
            kinds: &["revision"],
            reported: &["`y` (position 3) has revision 0x00010007, its ESI describes 0x00010000"],
            other: |text| only_devices(text).replace("esi/IDX.xml", "newer/IDX.xml"),
        },
        Case {
            name: "alias",
            kinds: &["alias"],
            reported: &["`lamp`: no device has alias 20; the IO8 at position 5 has alias 21"],
            other: |text| only_devices(text).replace("alias    = 20", "alias    = 21"),
        },
        Case {
            name: "serial",
            kinds: &["serial"],
            reported: &["`x` (position 2) has serial number 4711, the file says 1002"],
            other: |text| only_devices(text).replace("serial   = 1002", "serial   = 4711"),
        },
        Case {
            name: "modules",
            kinds: &["modules"],
            reported: &[
                "`block` (position 4) holds the modules [OUT8, OUT8], the file says [IN8, OUT8]",
            ],
            other: |text| only_devices(text).replace("[\"IN8\", \"OUT8\"]", "[\"OUT8\", \"OUT8\"]"),
        },
        Case {
            name: "replaced",
            kinds: &["missing", "added"],
            reported: &[
                "`doors` (position 1) is missing",
                "position 1 is not in the file: DO8",
            ],
            other: |text| only_devices(text).replace("\"DI8\"", "\"DO8\""),
        },
    ]
}

fn bench() -> Bench {
    let bench = Bench::new();
    bench.write("machine.toml", MACHINE);
    std::fs::create_dir(bench.path().join("newer")).expect("a folder");
    let esi = bench.read("esi/IDX.xml");
    let newer = esi.replace("RevisionNo=\"#x00010000\"", "RevisionNo=\"#x00010007\"");
    bench.write("newer/IDX.xml", &newer);
    bench
}

#[test]
fn compare_reports_equal_buses_as_equal() {
    let bench = bench();
    let compare = ["compare", "machine.toml", "--sim", "machine.toml"];
    let ran = bench.ecaxis(&compare);
    assert_eq!(
        (ran.code, ran.out.as_str()),
        (0, "as in the file\n"),
        "{}",
        ran.err
    );
    assert_eq!(ran.err, "");
    let json = bench.well(&[&compare[..], &["--json"]].concat());
    let json: Value = serde_json::from_str(&json).expect("JSON");
    assert_eq!(json["equal"], true);
    // Without differences, `--apply` changes no byte.
    bench.well(&[&compare[..], &["--apply"]].concat());
    assert_eq!(bench.read("machine.toml"), MACHINE);
}

#[test]
fn compare_names_and_applies_every_difference() {
    let bench = bench();
    for case in cases() {
        let name = case.name;
        bench.write("machine.toml", MACHINE);
        bench.write("other.toml", &(case.other)(MACHINE));
        let compare = ["compare", "machine.toml", "--sim", "other.toml"];
        let ran = bench.ecaxis(&compare);
        assert_eq!(ran.code, 1, "{name}: {}{}", ran.out, ran.err);
        for part in case.reported {
            assert!(
                ran.out.contains(part),
                "{name}: `{part}` is not in:\n{}",
                ran.out
            );
        }
        assert_eq!(
            ran.out.lines().count(),
            case.kinds.len(),
            "{name}: {}",
            ran.out
        );
        let ran = bench.ecaxis(&[&compare[..], &["--json"]].concat());
        let json: Value = serde_json::from_str(&ran.out).expect("JSON");
        let kinds: Vec<_> = json["differences"]
            .as_array()
            .expect("a list")
            .iter()
            .filter_map(|d| d["kind"].as_str())
            .collect();
        assert_eq!(kinds, case.kinds, "{name}");
        assert_eq!(bench.read("machine.toml"), MACHINE, "{name}: only compared");

        let ran = bench.ecaxis(&[&compare[..], &["--apply"]].concat());
        assert_eq!(ran.code, 0, "{name}: {}", ran.err);
        assert!(
            ran.err.contains("the old text is in machine.toml.old"),
            "{name}: {}",
            ran.err
        );
        assert_eq!(bench.read("machine.toml.old"), MACHINE, "{name}");
        let applied = bench.read("machine.toml");
        assert_snapshot(&format!("scan/apply/{name}.toml"), &applied);
        let check = bench.ecaxis(&["check", "machine.toml"]);
        assert_eq!(check.code, 0, "{name}: {}\n{applied}", check.err);
        let ran = bench.ecaxis(&compare);
        assert_eq!(ran.code, 0, "{name}: {}{}\n{applied}", ran.out, ran.err);
        for comment in [
            "# The machine at the window.",
            "# as short as it must be",
            "# left to right",
        ] {
            assert!(applied.contains(comment), "{name}: `{comment}` is gone");
        }
    }
}

struct Silent;

impl Observer for Silent {
    fn progress(&mut self, _: &Progress) {}
}

/// Returns the error of a run of `MACHINE` on the bus of another machine file.
fn run_error(bench: &Bench, other: &str) -> String {
    let bus = simulated_bus(&bench.machine(other), 1, None, None).expect("a bus");
    let options = Options {
        clock: Clock::Virtual,
        limit: Some(100_000_000),
        ..Options::default()
    };
    let machine = bench.machine(MACHINE);
    let link = Box::new(SimLink::new(bus));
    let outcome = run_on(link, machine, options, Arc::default(), &mut Silent);
    outcome.result.expect_err("another bus").to_string()
}

/// ETG.1500, feature 302: the configuration is compared at start. Identities are those of the
/// EEPROMs (ETG.1000.6, words 8 to 15).
#[test]
fn run_names_a_device_missing_in_the_middle_as_compare() {
    let bench = bench();
    let at = |text: String, from: u16| {
        text.replace(
            &format!("position = {from}"),
            &format!("position = {}", from - 1),
        )
    };
    let without_doors = [2, 3, 4].into_iter().fold(without(MACHINE, "doors"), at);
    for (other, expected) in [
        (
            at(without(MACHINE, "y"), 4),
            "scanning: 5 of 6 SubDevices answer; missing: `y` (position 3)",
        ),
        (
            without_doors,
            "scanning: 5 of 6 SubDevices answer; missing: `doors` (position 1)",
        ),
        (
            at(
                without(&format!("{}[stop]\n", without(MACHINE, "doors")), "y"),
                2,
            )
            .replace("position = 4", "position = 2"),
            "scanning: 4 of 6 SubDevices answer; missing: `doors` (position 1), `y` (position 3)",
        ),
    ] {
        assert_eq!(run_error(&bench, &other), format!("bring-up: {expected}"));
        bench.write("other.toml", &other);
        bench.write("machine.toml", MACHINE);
        let ran = bench.ecaxis(&["compare", "machine.toml", "--sim", "other.toml"]);
        let (_, missing) = expected.split_once("missing: ").expect("a list");
        for device in missing.split(", ") {
            assert!(
                ran.out.contains(&format!("{device} is missing")),
                "{}",
                ran.out
            );
        }
    }
}

/// Consequences for the program and for positions are reported, both for marked and for removed
/// parts of the file.
#[test]
fn compare_reports_consequences_for_program_and_positions() {
    let bench = bench();
    bench.write("machine.toml", MACHINE);
    bench.write(
        "other.toml",
        &without(MACHINE, "y").replace("position = 4", "position = 3"),
    );
    let apply = ["compare", "machine.toml", "--sim", "other.toml", "--apply"];
    let ran = bench.ecaxis(&apply);
    assert_eq!(ran.code, 0, "{}", ran.err);
    for part in [
        "`block` has `position = 3` now, it was 4",
        "step 3.1 is removed",
        "machine.toml matches the bus now",
        "2 lines are marked \"CHECK:\" and need a check",
    ] {
        assert!(ran.err.contains(part), "`{part}` is not in:\n{}", ran.err);
    }
    // A serial number alone has no consequences to check.
    bench.write("machine.toml", MACHINE);
    let other = only_devices(MACHINE).replace("serial   = 1002", "serial   = 4711");
    bench.write("other.toml", &other);
    let ran = bench.ecaxis(&apply);
    assert_eq!(ran.code, 0, "{}", ran.err);
    assert!(!ran.err.contains("CHECK"), "{}", ran.err);
}

/// A deviation that `identity` permits is not a difference, and the bus comes up.
#[test]
fn identity_policies_permit_deviations() {
    let bench = bench();
    for (policy, newer, older) in [
        ("equal", false, false),
        (">=", true, false),
        ("high-word", true, true),
        ("low-word", false, false),
        ("ignore", true, true),
    ] {
        for (esi, other, expected) in [
            ("esi/IDX.xml", "newer/IDX.xml", newer),
            ("newer/IDX.xml", "esi/IDX.xml", older),
        ] {
            let text = MACHINE.replace(
                "esi      = \"esi/IDX.xml\"",
                &format!("esi      = \"{esi}\"\nidentity = \"{policy}\""),
            );
            bench.write("machine.toml", &text);
            bench.write(
                "other.toml",
                &only_devices(&MACHINE.replace("esi/IDX.xml", other)),
            );
            let ran = bench.ecaxis(&["compare", "machine.toml", "--sim", "other.toml"]);
            assert_eq!(
                ran.code == 0,
                expected,
                "{policy} {esi}: {}{}",
                ran.out,
                ran.err
            );
        }
    }
    bench.write(
        "machine.toml",
        &MACHINE.replace(
            "mode     = \"csp\"",
            "mode = \"csp\"\nidentity = \"newest\"",
        ),
    );
    let check = bench.ecaxis(&["check", "machine.toml"]);
    assert_eq!(check.code, 2);
    assert!(
        check.err.contains("unknown identity \"newest\""),
        "{}",
        check.err
    );
}

/// `--parameters` reports start-up SDOs with values that the device does not hold.
#[test]
fn compare_reports_parameters_on_request() {
    let bench = bench();
    let text = MACHINE.replace(
        "mode     = \"csp\"\n\n[device.axis]\nunit    = \"turn\"\nencoder = 2000\nlimits  = { velocity = 10.0, acceleration = 100.0 }\n\n[[device]]\nname     = \"y\"",
        "mode     = \"csp\"\nsdo      = [{ index = 0x6065, value = 1234 }]\n\n[device.axis]\nunit    = \"turn\"\nencoder = 2000\nlimits  = { velocity = 10.0, acceleration = 100.0 }\n\n[[device]]\nname     = \"y\"",
    );
    assert_ne!(text, MACHINE);
    bench.write("machine.toml", &text);
    let compare = ["compare", "machine.toml", "--sim", "machine.toml"];
    assert_eq!(bench.well(&compare), "as in the file\n");
    let ran = bench.ecaxis(&[&compare[..], &["--parameters"]].concat());
    assert_eq!(ran.code, 1, "{}", ran.err);
    let expected = "`x` (position 2): 0x6065:00 Following error window is 2000 (0x000007d0), start-up writes 1234 (0x000004d2)";
    assert!(ran.out.lines().any(|line| line == expected), "{}", ran.out);
    // Parameters are not part of the topology.
    let ran = bench.ecaxis(&[&compare[..], &["--parameters", "--apply"]].concat());
    assert_eq!(ran.code, 1);
    assert_eq!(bench.read("machine.toml"), text);
}

#[test]
fn compare_reports_another_machine() {
    let bench = bench();
    bench.copy("commissioning.toml", "other.toml");
    let text = "[bus]\ncycle = \"1ms\"\n\n[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 0\n";
    bench.write("machine.toml", text);
    let ran = bench.ecaxis(&["compare", "machine.toml", "--sim", "other.toml"]);
    assert_eq!(ran.code, 1);
    assert_eq!(ran.out.lines().count(), 10, "{}", ran.out);
    let ran = bench.ecaxis(&[
        "compare",
        "machine.toml",
        "--sim",
        "other.toml",
        "--apply",
        "--esi",
        "newer",
    ]);
    assert_eq!(ran.code, 1);
    assert!(ran.err.contains("no ESI file describes it"), "{}", ran.err);
    assert_eq!(bench.read("machine.toml"), text);
}

/// Of the three tools at one port, one is there.
#[test]
fn absent_optional_devices_are_shown_and_are_no_difference() {
    let bench = Bench::new();
    bench.copy("tool-changer.toml", "m.toml");
    let absent = "`mill` (id 12) is absent; it is optional\n\
        `tilt` (place 1 behind id 12) is absent; it is optional\n\
        `gripper` (id 13) is absent; it is optional\n";
    let equal = bench.well(&["compare", "m.toml"]);
    assert_eq!(equal, format!("as in the file\n{absent}"));
    let json = bench.ecaxis(&["compare", "m.toml", "--json"]).json();
    assert_eq!(json["equal"], true);
    assert_eq!(
        json["absent"],
        serde_json::json!(["mill", "tilt", "gripper"])
    );
    let scanned = bench.ecaxis(&["scan", "--sim", "m.toml"]).exits(0);
    assert!(scanned.err.contains(absent), "{}", scanned.err);

    // The mill is there without its second drive.
    let text = bench.read("m.toml");
    let devices = only_devices(&text.replace("[[stop.group]]", "[stop]"));
    let drill = section(&devices, "drill");
    let short = devices
        .replace(section(&devices, "tilt"), "")
        .replace(drill, "");
    let group = "\n[[stop.group]]\nname = \"tools\"\naxes = [\"mill\", \"gripper\"]\noutside = \"continue\"\n";
    bench.write("short.toml", &(short + group));
    let found = bench.ecaxis(&["compare", "m.toml", "--sim", "short.toml"]);
    assert_eq!(found.code, 1, "{}{}", found.out, found.err);
    let missing = "`tilt` (place 1 behind id 12) is missing";
    assert!(found.out.contains(missing), "{}", found.out);
    assert!(
        found.out.contains("`drill` (id 11) is absent"),
        "{}",
        found.out
    );
}
