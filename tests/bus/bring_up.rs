//! The bring-up of many devices at the same time.

use std::collections::BTreeMap;
use std::sync::Arc;

use ecaxis_master::bringup::StepTime;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::{self, Machine};
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::session::{Progress, run_on, simulated_bus};
use ecaxis_test_support::recordings::{FPWR, datagrams};
use ecaxis_test_support::{Heard, axes, machine, recorded, root, run, virtual_time};

/// Runs a machine without power and returns the steps of its bring-up.
fn bring_up(mut machine: Machine) -> Vec<StepTime> {
    machine.enable = false;
    machine.steps.clear();
    let mut options = virtual_time();
    options.limit = Some(20_000_000);
    let (outcome, heard) = run(machine, options);
    outcome.result.expect("comes up");
    let summary = outcome.summary.expect("a summary");
    assert_eq!(summary.counters.wkc_errors, 0);
    let mut steps = heard.0.into_iter().filter_map(|progress| match progress {
        Progress::BringUpTimes(steps) => Some(steps),
        _ => None,
    });
    steps.next().expect("the steps")
}

fn took(steps: &[StepTime], name: &str) -> u64 {
    let step = steps.iter().find(|step| step.name == name);
    step.unwrap_or_else(|| panic!("no step {name}: {steps:?}"))
        .took_ns
}

/// ETG.1000.4: a frame carries several datagrams, and devices process their mailboxes independently.
/// So eight drives take little longer than one, whose transfers are bounded by its own mailbox.
#[test]
fn start_up_sdos_of_all_drives_take_little_longer_than_those_of_one() {
    let [one, eight] = [1, 8].map(|drives| bring_up(machine(&axes(drives))));
    for step in [
        "start-up SDOs",
        "mapping read back",
        "units and limits",
        "SafeOp",
        "Op",
    ] {
        let (one, eight) = (took(&one, step), took(&eight, step));
        assert!(eight < 2 * one, "{step}: {one} ns, {eight} ns");
    }
    let sdos = eight.iter().find(|step| step.name == "start-up SDOs");
    let slowest = sdos.and_then(|step| step.slowest.as_ref());
    assert!(slowest.is_some_and(|(name, ns)| name.starts_with('a') && *ns > 0));
}

/// ETG.1000.6, mailbox: requests to one device keep their order, whatever the other devices do.
#[test]
fn each_drive_receives_its_start_up_sdos_in_the_order_of_the_list() {
    let machine = machine(&axes(4));
    let expected: Vec<Vec<(u16, u8)>> = machine
        .devices
        .iter()
        .map(|d| {
            d.selection
                .startup
                .iter()
                .map(|s| (s.index, s.sub))
                .collect()
        })
        .collect();
    let folder = tempfile::tempdir().expect("a folder");
    let (options, recording) = recorded(virtual_time(), folder.path());
    let (outcome, _) = run(machine, options);
    outcome.result.expect("runs");
    let mut written: BTreeMap<u16, Vec<(u16, u8)>> = BTreeMap::new();
    for datagram in datagrams(&recording) {
        let data = &datagram.data;
        // A mailbox with CoE (3), service SDO request (2), expedited download (0x23 without size).
        let download = datagram.sent
            && datagram.command == FPWR
            && data.len() > 12
            && data[5] & 0x0f == 3
            && data[7] >> 4 == 2
            && data[8] & 0xe2 == 0x22;
        if download {
            let object = (u16::from_le_bytes([data[9], data[10]]), data[11]);
            written.entry(datagram.station()).or_default().push(object);
        }
    }
    for (station, (written, expected)) in written.into_values().zip(expected).enumerate() {
        assert_eq!(
            written.get(..expected.len()),
            Some(&expected[..]),
            "{station}"
        );
    }
}

/// More devices than ethercrab has by default (128), up to the limit that `check` states.
#[test]
fn up_to_512_devices_come_up_and_check_refuses_more() {
    let text = |devices: usize| {
        let mut text = "[bus]\nnic = \"sim\"\ncycle = \"4ms\"\n".to_owned();
        for n in 0..devices {
            text +=
                &format!("[[device]]\nname = \"io{n}\"\nesi = \"esi/IO8.xml\"\nposition = {n}\n");
        }
        text
    };
    for devices in [130, 512] {
        let steps = bring_up(machine(&text(devices)));
        assert!(took(&steps, "SafeOp") > 0, "{devices}");
    }
    let error = config::parse(&root().join("configs/test.toml"), &text(513)).expect_err("too many");
    assert!(
        error
            .to_string()
            .contains("a bus has at most 512 SubDevices"),
        "{error}"
    );
}

/// A device in the place of another one was reported as missing if the file has its kind elsewhere.
#[test]
fn another_device_in_a_place_is_named() {
    let terminals = |kinds: &[&str]| {
        let mut text = "enable = false\n[bus]\nnic = \"sim\"\ncycle = \"4ms\"\n".to_owned();
        for (position, kind) in kinds.iter().enumerate() {
            text += &format!(
                "[[device]]\nname = \"t{position}\"\nesi = \"esi/terminals.xml\"\n\
                 type = \"{kind}\"\nposition = {position}\n"
            );
        }
        machine(&text)
    };
    let file = ["CP0", "DI8", "DO8", "DI4", "DO4"];
    for (bus, place, parts) in [
        (
            &["CP0", "DO8", "DO8", "DI4", "DO4"][..],
            Some("`t1` (position 1"),
            ["DI8", "DO8"],
        ),
        (
            &["CP0", "DI8", "DO8", "DO4", "DO4"],
            Some("`t3` (position 3"),
            ["DI4", "DO4"],
        ),
        // The last one is missing as well.
        (
            &["CP0", "DO8", "DO8", "DI4"],
            Some("`t1` (position 1"),
            ["DI8", "DO8"],
        ),
        // One is missing in the middle.
        (
            &["CP0", "DO8", "DI4", "DO4"],
            None,
            ["missing: `t1` (position 1)", "4 of 5 SubDevices answer"],
        ),
        (
            &["CP0", "DI8", "DO8"],
            None,
            ["missing: `t3` (position 3)", "3 of 5 SubDevices answer"],
        ),
    ] {
        let options = virtual_time();
        options.clock.enter();
        let segment = simulated_bus(&terminals(bus), 1, None, None).expect("a bus");
        let mut heard = Heard::default();
        let link = Box::new(SimLink::new(segment));
        let stop = Arc::<CancelToken>::default();
        let outcome = run_on(link, terminals(&file), options, stop, &mut heard);
        let error = outcome.result.expect_err("another bus").to_string();
        assert!(
            error.contains(place.unwrap_or("missing")),
            "{bus:?}: {error}"
        );
        let names = |part: &str| match part {
            "DI8" => "8 digital inputs".to_owned(),
            "DO8" => "8 digital outputs".to_owned(),
            "DI4" => "4 digital inputs".to_owned(),
            "DO4" => "4 digital outputs".to_owned(),
            other => other.to_owned(),
        };
        for part in parts {
            assert!(error.contains(&names(part)), "{bus:?}: {error}");
        }
    }
}
