//! Limits of a drive besides its set-points: the process data watchdog, the drive's own limits, and
//! outputs without an axis. Read from the wire.

use std::path::Path;

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::recordings::{FPRD, FPWR, LRW, datagrams};
use ecaxis_test_support::{Heard, assert_contains, faults, recorded, run, virtual_time};

const SV1_CSV: &str = r#"
[bus]
nic = "sim"
cycle = "1ms"
lost_frames = 50
[[device]]
name = "z"
esi = "esi/SV1.xml"
position = 0
mode = "csv"
[device.axis]
unit = "turn"
encoder = 131072
limits = { velocity = 20.0, acceleration = 100.0, torque = 100.0 }
[[step]]
velocity = { z = 15.0 }
[[step]]
dwell = "3s"
"#;

#[test]
fn an_axis_has_a_watchdog_with_any_esi() {
    let bench = Bench::new();
    bench.change("esi/SV1.xml", |text| {
        text.replace("ControlByte=\"#x64\"", "ControlByte=\"#x24\"")
    });
    let silent = "[[fault]]\nkind = \"silent\"\nat = \"2s\"\nfor = \"250ms\"\n";
    let (options, path) = recorded(faults(silent), bench.path());
    let (outcome, _) = run(bench.machine(SV1_CSV), options);
    outcome.result.expect_err("the bus was silent");
    let all = datagrams(&path);
    let written = |register: u16| {
        let mut each = all.iter().filter(|d| d.sent && d.command == FPWR);
        each.find(|d| d.register() == register).map(|d| &d.data[..])
    };
    let outputs = written(0x0810).expect("the outputs' SyncManager");
    assert_eq!(outputs[4], 0x64, "ControlByte with its watchdog trigger");
    for (register, value) in [(0x0400, 2498_u16), (0x0410, 1000), (0x0420, 1000)] {
        assert_eq!(written(register), Some(&value.to_le_bytes()[..]));
        let mut read = all.iter().filter(|d| d.command == FPRD && !d.sent);
        let back = read.find(|d| d.register() == register && d.data.len() == 2);
        let back = back.unwrap_or_else(|| panic!("0x{register:04x} is not read back"));
        assert_eq!(back.data, value.to_le_bytes());
    }
    // When frames return, the drive has left Op because of its watchdog.
    let states = |register: u16| {
        let read = all.iter().filter(move |d| !d.sent && d.working_counter > 0);
        read.filter(move |d| d.register() <= register && register - d.register() < 0x30)
            .filter_map(move |d| d.data.get(usize::from(register - d.register())).copied())
    };
    let found: Vec<u8> = states(0x0130).collect();
    assert!(found.contains(&0x14), "AL states {found:02x?}");
    let codes: Vec<u8> = states(0x0134).collect();
    assert!(codes.contains(&0x1b), "AL status codes {codes:02x?}");
    let expired: Vec<u8> = all
        .iter()
        .filter(|d| !d.sent && d.register() == 0x0400 && d.data.len() > 0x42)
        .map(|d| d.data[0x42])
        .collect();
    assert!(expired.contains(&1), "expirations in 0x0442: {expired:?}");
}

/// A drive whose firmware compares the ControlByte with that of its ESI, without the watchdog trigger.
fn exact_control_byte(key: &str) -> (Bench, String) {
    let bench = Bench::new();
    bench.change("esi/SV1.xml", |text| {
        text.replace("ControlByte=\"#x64\"", "ControlByte=\"#x24\"")
    });
    let axis = format!(
        "mode = \"csv\"\n{key}\n[device.sim]\nquirks = {{ exact_control_byte = true }}\n[device.axis]"
    );
    let text = SV1_CSV.replace("mode = \"csv\"\n[device.axis]", &axis);
    (bench, text.replace("dwell = \"3s\"", "dwell = \"200ms\""))
}

/// Returns the ControlBytes of the outputs that were written.
fn control_bytes(path: &Path) -> Vec<u8> {
    let all = datagrams(path);
    let written = all.iter().filter(|d| d.sent && d.command == FPWR);
    let outputs = written.filter(|d| d.register() == 0x0810);
    outputs.map(|d| d.data[4]).collect()
}

#[test]
fn a_drive_that_compares_its_control_byte_gets_that_of_its_esi() {
    let (bench, text) = exact_control_byte("");
    let (options, path) = recorded(faults(""), bench.path());
    let (outcome, heard) = run(bench.machine(&text), options);
    outcome.result.expect("the axis moved");
    assert_eq!(control_bytes(&path), [0x64, 0x24]);
    let warnings = heard.warnings();
    let about = warnings.iter().filter(|w| w.contains("watchdog"));
    let [warning] = about.collect::<Vec<_>>()[..] else {
        panic!("one warning: {warnings:?}");
    };
    assert_contains(warning, &["`z`", "0x001d", "watchdog_trigger = \"esi\""]);
}

/// The watchdog is not given up for a refusal that has another reason.
#[test]
fn a_refusal_that_the_control_byte_does_not_explain_is_an_error_without_advice() {
    let (bench, text) = exact_control_byte("");
    let text = text.replace("exact_control_byte = true", "mailbox_slow = \"1ms\"");
    let refuse =
        "[[fault]]\nkind = \"refuse-state\"\ndevice = 0\nstate = \"safe-op\"\ncode = 0x1d\n";
    let (outcome, heard) = run(bench.machine(&text), faults(refuse));
    let error = outcome.result.expect_err("it refuses SafeOp").to_string();
    assert_contains(&error, &["`z`", "0x001d"]);
    let warnings = heard.warnings();
    assert!(
        !warnings.iter().any(|w| w.contains("watchdog")),
        "{warnings:?}"
    );
}

/// Another drive in the place of one without the trigger may have it.
#[test]
fn an_exchanged_drive_is_asked_for_the_watchdog_trigger_again() {
    let (bench, text) = exact_control_byte("");
    let (bus, _) = text.split_once("[[step]]").expect("steps");
    let text = format!(
        "{bus}[[device]]\nname = \"first\"\nesi = \"esi/EPOS4.xml\"\nposition = 1\nmode = \"csp\"\n\
         [device.axis]\nencoder = 2000\nlimits = {{ velocity = 10.0, acceleration = 100.0 }}\n\
         [[stop.group]]\nname = \"gz\"\naxes = [\"z\"]\noutside = \"continue\"\n[[step]]\ndwell = \"4s\"\n"
    );
    // The drive is behind another one with SYNC0, so that it can return.
    let text = text.replacen("position = 0", "position = 9", 1);
    let text = text.replacen("position = 1", "position = 0", 1);
    let text = text.replacen("position = 9", "position = 1", 1);
    let script = "[[fault]]\nkind = \"power-off\"\ndevice = 1\nat = \"1s\"\nfor = \"500ms\"\n\
        [[fault]]\nkind = \"swap\"\ndevice = 1\nat = \"1200ms\"\nserial = 777\n";
    let (options, path) = recorded(faults(script), bench.path());
    let (_, heard) = run(bench.machine(&text), options);
    // The first one is that of the other drive.
    assert_eq!(control_bytes(&path), [0x64, 0x64, 0x24, 0x64, 0x24]);
    let warnings = heard.warnings();
    let named = warnings.iter().filter(|w| w.contains("watchdog trigger"));
    assert_eq!(named.count(), 2, "{warnings:?}");
}

/// Some devices set the AL status code of a refusal, and not the error bit.
#[test]
fn an_al_status_code_without_the_error_bit_is_read_at_the_time_out() {
    for (key, fails) in [("", false), ("watchdog_trigger = \"required\"", true)] {
        let (bench, text) = exact_control_byte(key);
        let quirks = "exact_control_byte = true, error_bit_missing = true";
        let text = text.replace("exact_control_byte = true", quirks);
        let (outcome, _) = run(bench.machine(&text), virtual_time());
        let error = outcome.result.err().map(|error| error.to_string());
        assert_eq!(error.is_some(), fails, "{error:?}");
        if let Some(error) = error {
            let parts = [
                "SafeOp",
                "0x001d (invalid output configuration)",
                "without the error bit",
            ];
            assert_contains(&error, &parts);
        }
    }
}

#[test]
fn the_watchdog_trigger_is_required_or_left_to_the_esi_by_a_key() {
    let (bench, text) = exact_control_byte("watchdog_trigger = \"required\"");
    let (options, path) = recorded(faults(""), bench.path());
    let (outcome, _) = run(bench.machine(&text), options);
    let error = outcome.result.expect_err("it refuses SafeOp").to_string();
    assert_contains(&error, &["`z`", "SafeOp", "0x001d"]);
    assert_eq!(control_bytes(&path), [0x64]);

    let (bench, text) = exact_control_byte("watchdog_trigger = \"esi\"");
    let (options, path) = recorded(faults(""), bench.path());
    let (outcome, heard) = run(bench.machine(&text), options);
    outcome.result.expect("the axis moved");
    assert_eq!(control_bytes(&path), [0x24]);
    assert!(!heard.warnings().iter().any(|w| w.contains("0x001d")));
}

/// Returns an axis of 2000 counts per turn on `configs/esi/EPOS4.xml`, with additional keys of its
/// device.
fn epos4(device: &str, limits: &str) -> String {
    format!(
        r#"
[bus]
nic = "sim"
cycle = "1ms"
[[device]]
name = "x"
esi = "esi/EPOS4.xml"
position = 0
mode = "csp"
{device}
[device.axis]
unit = "turn"
encoder = 2000
limits = {{ {limits} }}
[[step]]
dwell = "50ms"
"#
    )
}

/// Replaces the default of one of the ESI's objects, after its index.
fn default(text: &str, index: &str, from: &str, to: &str) -> String {
    let at = text
        .find(&format!("<Index>#x{index}</Index>"))
        .expect(index);
    let from = format!("<DefaultValue>{from}</DefaultValue>");
    let at = at + text[at..].find(&from).expect("its default");
    let to = format!("<DefaultValue>{to}</DefaultValue>");
    format!("{}{to}{}", &text[..at], &text[at + from.len()..])
}

#[test]
fn a_limit_above_a_startup_sdo_is_rejected() {
    let bench = Bench::new();
    let wide = "position = [-20.0, 20.0], velocity = 40.0, acceleration = 200.0, torque = 120.0, following_error = 0.5";
    for (sdo, expected) in [
        (
            "{ index = 0x6080, value = 600 }",
            "0x6080:00 (Max motor speed) = 600 rpm allows 10 turn/s, `limits.velocity` is 40 turn/s",
        ),
        (
            "{ index = 0x607D, sub = 2, value = 2000 }",
            "0x607d:02 (Max position limit) = 2000 is 1 turn, `limits.position` goes to 20 turn",
        ),
        (
            "{ index = 0x607D, sub = 1, value = -2000 }",
            "0x607d:01 (Min position limit) = -2000 is -1 turn, `limits.position` goes to -20 turn",
        ),
        (
            "{ index = 0x6065, value = 900 }",
            "0x6065:00 (Following error window) = 900 is 0.45 turn, `limits.following_error` is 0.5 turn",
        ),
        (
            "{ index = 0x60C5, value = 6000 }",
            "0x60c5:00 (Max acceleration) = 6000 rpm/s allows 100 turn/s², `limits.acceleration` is 200 turn/s²",
        ),
        (
            "{ index = 0x6072, value = 1000 }",
            "0x6072:00 (Max torque) = 1000 ‰ of rated torque allows 100 %, `limits.torque` is 120 %",
        ),
    ] {
        let error = bench.parse(&epos4(&format!("sdo = [{sdo}]"), wide));
        let error = error.expect_err(sdo);
        assert!(error.contains(expected), "{sdo}: {error}");
        // Limits within the drive's limits are accepted.
        let narrow = "position = [-0.9, 0.9], velocity = 9.0, acceleration = 90.0, torque = 99.0, following_error = 0.4";
        bench.machine(&epos4(&format!("sdo = [{sdo}]"), narrow));
    }
}

#[test]
fn a_drive_that_ignores_a_lost_connection_causes_a_warning() {
    let bench = Bench::new();
    let limits =
        "position = [-20.0, 20.0], velocity = 10.0, acceleration = 200.0, following_error = 0.2";
    let [none, reacts] =
        [0, 1].map(|value| format!("sdo = [{{ index = 0x6007, value = {value} }}]"));
    for (device, expected) in [("", false), (&none, true), (&reacts, false)] {
        let (outcome, heard) = run(bench.machine(&epos4(device, limits)), virtual_time());
        outcome.result.expect("nothing moves");
        let warnings = heard.warnings();
        let text = "0x6007:00 (Abort connection option code) = 0: the drive does not stop";
        let warned = warnings
            .iter()
            .any(|w| w.contains(text) && w.contains(&reacts));
        assert_eq!(warned, expected, "{warnings:?}");
    }
}

/// `limits.torque` is not in the file. The ESI writes 0 at start-up.
#[test]
fn a_drive_without_torque_causes_a_warning() {
    let bench = Bench::new();
    bench.change("esi/EPOS4.xml", |text| {
        let from = "CompleteAccess=\"0\" SegmentedSdo=\"1\"/>";
        let command = "<InitCmd><Transition>PS</Transition><Index>#x6072</Index>\
            <SubIndex>0</SubIndex><Data>0000</Data></InitCmd>";
        assert!(text.contains(from));
        let to = format!("{}>{command}</CoE>", from.trim_end_matches("/>"));
        text.replacen(from, &to, 1)
    });
    let limits =
        "position = [-20.0, 20.0], velocity = 10.0, acceleration = 200.0, following_error = 0.2";
    for (device, expected) in [
        ("", true),
        ("sdo = [{ index = 0x6072, value = 900 }]", false),
    ] {
        let (_, heard) = run(bench.machine(&epos4(device, limits)), virtual_time());
        let warnings = heard.warnings();
        let text = "0x6072:00 (Max torque) = 0 leaves the drive without torque";
        let warned = warnings
            .iter()
            .any(|w| w.contains("`x`") && w.contains(text));
        assert_eq!(warned, expected, "{warnings:?}");
    }
}

#[test]
fn a_drive_limit_below_the_file_limit_causes_a_warning() {
    let bench = Bench::new();
    // The 0x6080 of the simulated motor is 6000 rpm.
    bench.change("esi/EPOS4.xml", |text| default(text, "6065", "2000", "400"));
    let limits =
        "position = [-20.0, 20.0], velocity = 1000.0, acceleration = 200.0, following_error = 0.5";
    let machine = bench.machine(&epos4("", limits));
    let notes = machine.devices[DeviceIndex(0)].selection.notes.join("\n");
    assert!(notes.contains("0x6080:00 (Max motor speed)"), "{notes}");
    let (outcome, heard) = run(machine, virtual_time());
    outcome.result.expect("nothing moves");
    let warned = |heard: &Heard, text: &str| {
        let all = heard.warnings();
        all.iter().any(|w| w.contains("`x`") && w.contains(text))
    };
    for expected in [
        "0x6080:00 (Max motor speed) = 6000 rpm allows 100 turn/s, `limits.velocity` is 1000 turn/s",
        "0x6065:00 (Following error window) = 400 is 0.2 turn, `limits.following_error` is 0.5 turn",
    ] {
        assert!(warned(&heard, expected), "{:?}", heard.warnings());
    }
    let modest =
        "position = [-20.0, 20.0], velocity = 10.0, acceleration = 200.0, following_error = 0.2";
    let (outcome, heard) = run(bench.machine(&epos4("", modest)), virtual_time());
    outcome.result.expect("nothing moves");
    assert_eq!(heard.warnings(), Vec::<String>::new());
}

#[test]
fn a_trip_names_the_drive_limit_that_held_the_axis_back() {
    let bench = Bench::new();
    let limits = "velocity = 150.0, acceleration = 1500.0, following_error = 0.5";
    let text = epos4("", limits) + "[[step]]\nmove_by = { x = 80.0 }\n";
    bench.write("machine.toml", &text);
    let run = ["run", "machine.toml", "--sim", "--virtual"];
    let said = bench.ecaxis(&run).exits(1).err;
    let hint = said.split("help:").nth(1).unwrap_or_default();
    let hint = hint.split_whitespace().collect::<Vec<_>>().join(" ");
    let limit = ["0x6080:00", "allows 100 turn/s", "`limits.velocity`"];
    assert_contains(&hint, &[&limit[..], &["the drive allows less"]].concat());
}

/// Returns the sent outputs of a device, cycle by cycle.
fn outputs(recording: &Path) -> Vec<Vec<u8>> {
    let all = datagrams(recording).into_iter();
    let sent = all.filter(|d| d.sent && d.command == LRW);
    sent.map(|d| d.data).collect()
}

const OFFSET_AND_SECOND_AXIS: &str = "\
pdo.rx = [\"0x6040\", \"0x607A\", \"0x60B0\", \"0x6840\", \"0x68FF\"]\n\
pdo.tx = [\"0x6041\", \"0x6061\", \"0x6064\"]";

/// Returns a drive with an offset, and with power and velocity for a second axis.
fn two_axes(text: &str) -> String {
    let object = |index: &str, name: &str, kind: &str, bits: u8, value: u32| {
        format!(
            "<Object><Index>#x{index}</Index><Name>{name}</Name><Type>{kind}</Type><BitSize>{bits}</BitSize>\
             <Info><DefaultValue>{value}</DefaultValue></Info>\
             <Flags><Access>rw</Access><PdoMapping>R</PdoMapping></Flags></Object>"
        )
    };
    let text = default(text, "60B0", "0", "1900");
    let more = object("6840", "Controlword 2", "UINT", 16, 0x0f)
        + &object("68FF", "Target velocity 2", "DINT", 32, 5000);
    text.replacen("</Objects>", &(more + "</Objects>"), 1)
}

const LIMITS: &str =
    "position = [-10.0, 10.0], velocity = 10.0, acceleration = 50.0, following_error = 1.0";

#[test]
fn offsets_and_outputs_of_a_second_axis_stay_zero() {
    let bench = Bench::new();
    bench.change("esi/EPOS4.xml", two_axes);
    let text = epos4(OFFSET_AND_SECOND_AXIS, LIMITS);
    let machine = bench.machine(&(text.clone() + "[[step]]\nmove = { x = 2.0 }\n"));
    let notes = machine.devices[DeviceIndex(0)].selection.notes.join("\n");
    assert!(notes.contains("axis 2 of the drive"), "{notes}");
    let (options, path) = recorded(virtual_time(), bench.path());
    run(machine, options).0.result.expect("it moves");
    let cycles = outputs(&path);
    assert!(cycles.len() > 100, "{} cycles", cycles.len());
    for (number, data) in cycles.iter().enumerate() {
        assert_eq!(data[6..16], [0; 10], "cycle {number}: {data:02x?}");
    }
    for name in ["0x60B0", "0x6840", "0x68FF"] {
        let step = format!("[[step]]\nset = {{ x.\"{name}\" = 1 }}\n");
        let error = bench.parse(&(text.clone() + &step)).expect_err(name);
        let message = "give the axis a command instead";
        assert!(error.contains(message), "{name}: {error}");
    }
}

#[test]
fn offsets_of_targets_are_rejected_or_set_to_zero() {
    let bench = Bench::new();
    bench.change("esi/EPOS4.xml", two_axes);
    for index in ["0x60B0", "0x60B1", "0x60B2"] {
        let sdo = |value: i32| {
            epos4(
                &format!("sdo = [{{ index = {index}, value = {value} }}]"),
                LIMITS,
            )
        };
        let error = bench.parse(&sdo(5)).expect_err(index);
        assert!(error.contains("adds to every target"), "{error}");
        bench.machine(&sdo(0));
    }
    // The drive holds the offset, but the object is not in its process data.
    let (options, path) = recorded(virtual_time(), bench.path());
    let (outcome, heard) = run(bench.machine(&epos4("", LIMITS)), options);
    outcome.result.expect("nothing moves");
    let warnings = heard.warnings();
    let warned = |w: &String| w.contains("0x60b0:00 (Position offset)");
    assert!(warnings.iter().any(warned), "{warnings:?}");
    // An expedited download of 0 to 0x60B0, as in the drive's mailbox.
    let download = [0x23, 0xb0, 0x60, 0x00, 0, 0, 0, 0];
    let all = datagrams(&path);
    let mut written = all.iter().filter(|d| d.sent && d.command == FPWR);
    assert!(written.any(|d| d.data.windows(8).any(|part| part == download)));
}

#[test]
fn interpolation_time_equals_the_cycle_if_csp_or_csv_is_possible() {
    let bench = Bench::new();
    let csp = "pdo.rx = [\"0x6040\", \"0x6060\", \"0x607A\", \"0x6071\"]\n\
               pdo.tx = [\"0x6041\", \"0x6061\", \"0x6064\", \"0x606C\", \"0x6077\"]";
    let alone = "";
    for (pdo, expected) in [(csp, (2, -3)), (alone, (0, 0))] {
        let text = epos4(pdo, "velocity = 40.0, acceleration = 200.0");
        let text = text.replace("\"csp\"", "\"cst\"").replace("1ms", "2ms");
        let (options, path) = recorded(virtual_time(), bench.path());
        let (outcome, _) = run(bench.machine(&text), options);
        outcome.result.expect("nothing moves");
        let all = datagrams(&path);
        let downloads = |sub: u8| {
            let request = [0x2f, 0xc2, 0x60, sub];
            let mut sent = all.iter().filter(|d| d.sent && d.command == FPWR);
            sent.find_map(|d| {
                let mut parts = d.data.windows(5);
                parts
                    .find(|part| part[..4] == request)
                    .map(|part| part[4] as i8)
            })
        };
        assert_eq!(downloads(1), Some(expected.0), "{pdo}");
        assert_eq!(downloads(2).unwrap_or(0), expected.1, "{pdo}");
    }
}

fn terminals(count: usize) -> String {
    let mut text = String::from("[bus]\nnic = \"sim\"\ncycle = \"4ms\"\n");
    for n in 0..count {
        text += &format!("[[device]]\nname = \"io{n}\"\nesi = \"esi/IO8.xml\"\nposition = {n}\n");
    }
    text + "[[step]]\ndwell = \"20ms\"\n"
}

#[test]
fn bring_up_supports_more_than_128_devices_and_rejects_more_than_512() {
    let bench = Bench::new();
    let (outcome, _) = run(bench.machine(&terminals(130)), virtual_time());
    outcome.result.expect("it runs");
    let error = bench.parse(&terminals(513)).expect_err("one too many");
    assert!(error.contains("at most 512 SubDevices"), "{error}");
}
