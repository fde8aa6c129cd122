//! Evidence must belong to the stop: events long before or after it are not its cause. Only
//! connected devices count as neighbours.

use super::*;

const GROUP: &str = "\n[[stop.group]]\nname = \"g\"\naxes = [\"a1\"]\noutside = \"continue\"\n";
const POWER_OFF: &str = "[[fault]]\nkind = \"power-off\"\nat = \"1.5s\"\ndevice = 1\n";

fn fault(kind: &str, at: &str, rest: &str) -> String {
    format!("[[fault]]\nkind = \"{kind}\"\nat = \"{at}\"\n{rest}\n")
}

/// A coupler with a terminal on its E-bus, and a drive at its second port.
fn tree() -> String {
    let drive = axes(1)
        .replace("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n", "")
        .replace("position = 0", "position = 2");
    let terminal = |name: &str, kind: &str, position: u16| {
        format!(
            "\n[[device]]\nname = \"{name}\"\nesi = \"esi/terminals.xml\"\ntype = \"{kind}\"\nposition = {position}\n"
        )
    };
    format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n{}{}{drive}",
        terminal("coupler", "CP0", 0),
        terminal("di", "DI8", 1)
    )
}

/// Two axes; the program moves only the first.
fn one_moves() -> String {
    axes(2).replace(", a1 = 80", "").replace(", a1 = 0", "")
}

#[track_caller]
fn first_line(machine_file: &str, script: &str, expected: &str) {
    let fault_report = fault_report_of(machine(machine_file), faults(script));
    assert!(
        fault_report.headline.starts_with(expected),
        "{}\n  expected {expected}\n  also {:?}\n  {script}",
        fault_report.headline,
        fault_report.also
    );
}

#[test]
fn evidence_long_before_the_stop_is_ignored() {
    let patient = axes(3).replace("cycle =", "lost_frames = 20\ncycle =");
    let loss = fault("frame-loss", "1.8s", "count = 60");
    for at in ["300ms", "1.49s"] {
        let script = fault("frame-duplicate", at, "count = 5")
            + &fault("watchdog", "1500600us", "device = 1");
        let expected = "`a1` (position 1) left Op by its process data watchdog of 100 ms, though";
        first_line(&axes(2), &script, expected);
    }
    for before in [
        fault("frame-delay", "500ms", "delay = \"1.2ms\"\ncount = 12"),
        fault("frame-corrupt", "500ms", "count = 12\ndevice = 1\nport = 0"),
        fault("other-main-device", "500ms", "count = 1"),
        fault("other-main-device", "1.4s", "count = 1"),
    ] {
        first_line(&patient, &(before + &loss), "no frame came back for ");
    }
    let script = fault("other-main-device", "1.4s", "count = 1") + POWER_OFF;
    first_line(
        &axes(2),
        &script,
        "`a1` (position 1) is out of reach: port 1 of `a0`",
    );
}

#[test]
fn evidence_after_the_stop_is_ignored() {
    let script = POWER_OFF.to_owned() + &fault("other-main-device", "1.6s", "count = 1");
    first_line(
        &axes(2),
        &script,
        "`a1` (position 1) is out of reach: port 1 of `a0`",
    );
    for later in [
        fault("link-break", "1.6s", "for = \"5ms\"\ndevice = 1\nport = 0"),
        fault("power-off", "1.6s", "device = 1"),
        fault("frame-corrupt", "1.6s", "count = 20\ndevice = 1\nport = 0"),
    ] {
        let script = fault("frame-loss", "1.5s", "count = 10") + &later;
        first_line(&axes(2), &script, "no frame came back for ");
    }
}

#[test]
fn a_stop_long_after_a_group_stop_has_its_own_cause() {
    let text = one_moves() + GROUP + "\n[[step]]\ndwell = \"4s\"\n";
    let script = fault("drive-fault", "1s", "device = 1\ncode = 12832")
        + &fault("frame-loss", "4s", "count = 8");
    first_line(&text, &script, "no frame came back for ");
}

#[test]
fn a_missing_device_in_a_tree_is_named() {
    let script = fault("power-off", "1.5s", "device = 1");
    let fault_report = fault_report_of(machine(&tree()), faults(&script));
    assert!(
        fault_report
            .headline
            .starts_with("`di` (position 1) is out of reach: port ")
            && fault_report.headline.contains("of `coupler`"),
        "{}",
        fault_report.headline
    );
    let answers: Vec<bool> = fault_report
        .devices
        .iter()
        .map(|device| device.answers)
        .collect();
    assert_eq!(answers, [true, false, true]);
    assert_eq!(fault_report.devices[2].station, Some(0x1002));
    // The report does not attribute the drive's answers to the terminal.
    assert!(fault_report.devices[1].state.is_none() && fault_report.devices[2].state.is_some());
}

#[test]
fn a_break_at_each_place_of_a_line_is_located() {
    for device in 0..4 {
        for kind in ["link-break", "power-off"] {
            let script = fault(kind, "1.5s", &format!("device = {device}"));
            let expected = match device {
                0 => "no frame comes back: the cable from this computer to `a0` (position 0)"
                    .to_owned(),
                3 => "`a3` (position 3) is out of reach: port 1 of `a2` has no link".to_owned(),
                n => format!(
                    "`a{n}` (position {n}) is out of reach, with {} behind it: port 1 of `a{}`",
                    3 - n,
                    n - 1
                ),
            };
            first_line(&axes(4), &script, &expected);
        }
    }
}

#[test]
fn sync0_after_op_is_awaited() {
    let text = axes(1).replace("cycle =", "op_timeout = \"2s\"\ncycle =");
    let script = "[[fault]]\nkind = \"sync-late\"\ndevice = 0\ndelay = \"30s\"\n";
    let expected = "`a0` (position 0) did not reach Op: its SYNC0 ";
    first_line(&text, script, expected);
}

#[test]
fn an_axis_of_a_line_stops_because_of_its_missing_partner() {
    let text = axes(2).replace("move = {", "line = {") + GROUP;
    let (outcome, _) = run(machine(&text), faults(POWER_OFF));
    let error = outcome.result.expect_err("the line is broken").to_string();
    assert!(error.contains("no longer answers"), "{error}");
    let fault_report = outcome.fault_report.expect("a fault report");
    let expected = "`a1` (position 1) is out of reach: port 1 of `a0` has no link";
    assert!(
        fault_report.headline.starts_with(expected),
        "{}",
        fault_report.headline
    );
}

/// The run succeeds except for the group, so the report describes the stop of the group.
#[test]
fn a_group_without_reset_is_reported() {
    let text = one_moves() + GROUP;
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("machine.toml");
    std::fs::write(&file, with_our_esi(&text)).expect("written");
    let script = folder.path().join("faults.toml");
    // The drive is missing when the group stops, and is back when the run ends.
    let off = fault("power-off", "1.5s", "for = \"300ms\"\ndevice = 1");
    for (faults, expected) in [
        (POWER_OFF.to_owned(), "`a1` (position 1) is out of reach"),
        (
            fault("drive-fault", "1.5s", "device = 1\ncode = 0x3220")
                + &off.replace("1.5s", "2.5s"),
            "0x3220",
        ),
        (off, "`a1` (position 1)"),
    ] {
        std::fs::write(&script, &faults).expect("written");
        let mut command = program::command();
        command.args(["run", "--virtual", "--sim", "--json", "--faults"]);
        let json = Ran::new(command.args([&script, &file])).exits(1).json();
        let headline = json["fault_report"]["headline"]
            .as_str()
            .unwrap_or_default();
        assert!(headline.contains(expected), "{headline}; {faults}");
        let error = json["error"].as_str().unwrap_or_default();
        assert!(error.contains("was not reset"), "{error}");
    }
}

/// A cable or a supply fails during the count of devices. The error of the scan names neither the
/// device nor the cause.
#[test]
fn a_device_missing_during_the_scan_is_named() {
    for (script, name) in [
        (fault("link-break", "0.2ms", "device = 1\nport = 0"), "`a1`"),
        (fault("power-off", "2.5ms", "device = 2"), "`a2`"),
        (
            fault("power-off", "10ms", "for = \"1.4ms\"\ndevice = 1"),
            "`a1`",
        ),
    ] {
        let fault_report = fault_report_of(machine(&axes(3)), faults(&script));
        let headline = &fault_report.headline;
        assert!(headline.contains(name), "{script}: {headline}");
    }
}

/// The report says what disappeared where, and what came back when.
#[test]
fn devices_that_come_and_go_are_in_the_report() {
    let script = fault("power-off", "1.5s", "for = \"300ms\"\ndevice = 1");
    let (outcome, _) = run(machine(&(one_moves() + GROUP)), faults(&script));
    let report = outcome.fault_report.expect("of the group");
    let events: Vec<_> = report.events.iter().map(|event| &event.what).collect();
    let place = |what: &str| events.iter().position(|event| event.contains(what));
    let lost = place("`a1` (position 1, station 0x1001) is lost, behind port 1 of `a0`");
    let back = place("`a1` (position 1, station 0x1001) is in Op again after 0.");
    assert!(lost.is_some() && lost < back, "{events:#?}");
    let at = |place: Option<usize>| report.events[place.expect("there")].at_s;
    assert!(at(back) > at(lost) + 0.3, "{events:#?}");
}
