//! Devices that are not in the machine file and appear during the run.

use std::sync::Arc;

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::Machine;
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::session::{self, Outcome, Progress, simulated_bus};
use ecaxis_test_support::recordings::{APWR, Datagram, FPWR, datagrams};
use ecaxis_test_support::{Heard, faults, machine, recorded};

use super::returns::{STEPS, line, line_text, returned};

/// The unknown devices that were reported, and whether their port was closed.
fn unknown(heard: &Heard) -> Vec<(String, bool)> {
    let each = heard.0.iter().filter_map(|progress| match progress {
        Progress::UnknownDevice(device) => Some((device.to_string(), device.closed)),
        _ => None,
    });
    each.collect()
}

/// Runs a machine of three drives on a bus of four. Returns also the datagrams.
fn run_on_four(machine: Machine, script: &str) -> (Outcome, Heard, Vec<Datagram>) {
    let folder = tempfile::tempdir().expect("a folder");
    let (options, recording) = recorded(faults(script), folder.path());
    options.clock.enter();
    let bus = simulated_bus(&line(4, ""), 1, options.faults.as_ref(), None).expect("a bus");
    let link = session::recorded(Box::new(SimLink::new(bus)), &options, "").expect("a recording");
    let (mut heard, stop) = (Heard::default(), Arc::<CancelToken>::default());
    let outcome = session::run_on(link, machine, options, stop, &mut heard);
    let datagrams = datagrams(&recording);
    (outcome, heard, datagrams)
}

const CALM: &str = "\n[[step]]\nenable = true\n\n[[step]]\nmove = { a0 = 80.0 }\n\n[[step]]\nmove = { a0 = -80.0 }\n";
/// Nothing is behind the third drive in this time.
const ABSENT: &str = "[[fault]]\nkind = \"absent\"\ndevice = 3\n";

/// Returns the registers that were written at the place of the fourth device and at the temporary
/// address.
fn written(datagrams: &[Datagram]) -> Vec<u16> {
    let to_it = |datagram: &&Datagram| match datagram.command {
        APWR => datagram.sent && datagram.station() == 3_u16.wrapping_neg(),
        FPWR => datagram.station() == 0x0fff,
        _ => false,
    };
    let mut registers: Vec<_> = datagrams
        .iter()
        .filter(to_it)
        .map(|d| d.register())
        .collect();
    registers.sort_unstable();
    registers.dedup();
    registers
}

#[test]
fn unknown_device_is_reported_once_and_its_port_is_closed() {
    let script = format!("{ABSENT}for = \"1.5s\"\n");
    for (rule, closes) in [("", true), ("unknown_devices = \"report\"\n", false)] {
        let text = line_text(3, CALM).replace("[bus]\n", &format!("[bus]\n{rule}"));
        let (outcome, heard, datagrams) = run_on_four(machine(&text), &script);
        outcome.result.expect("the three drives run");
        let summary = outcome.summary.expect("a summary");
        assert_eq!(summary.counters.wkc_errors, 0);
        assert_eq!(summary.group_stops.len(), 0);
        let found = unknown(&heard);
        let [(text, closed)] = &found[..] else {
            panic!("{found:?}");
        };
        assert_eq!(*closed, closes);
        let parts = [
            "port 1 of `a2`",
            "not in the machine file",
            "EPOS4",
            "serial number 1003",
        ];
        for part in parts {
            assert!(text.contains(part), "{part}: {text}");
        }
        // Its address, and the access to its EEPROM.
        let registers = written(&datagrams);
        let allowed = |register: &u16| *register == 0x0010 || (0x0500..0x0510).contains(register);
        assert!(registers.contains(&0x0010), "it was identified");
        assert!(registers.iter().all(allowed), "{registers:x?}");
        let loops = datagrams
            .iter()
            .filter(|d| d.sent && d.command == FPWR && d.register() == 0x0101);
        let values: Vec<_> = loops.map(|d| d.data[0]).collect();
        // Closed once, and open at the end.
        assert_eq!(values, if closes { vec![0x0c, 0] } else { vec![] });
    }
}

/// A port opens when its link goes down, so the next device is reported again.
#[test]
fn closed_port_opens_after_its_device_has_left() {
    let script = format!("{ABSENT}for = \"1.5s\"\n{ABSENT}at = \"2.5s\"\nfor = \"500ms\"\n");
    let (outcome, heard, _) = run_on_four(line(3, CALM), &script);
    outcome.result.expect("the three drives run");
    assert_eq!(unknown(&heard).len(), 2, "{:?}", unknown(&heard));
}

/// Another product at the place of a lost drive. Its port stays open while drives are behind it;
/// otherwise it opens from time to time, and the old drive returns.
#[test]
fn lost_drive_returns_after_an_unknown_one_has_left_its_place() {
    for (device, closes) in [(1, false), (2, true)] {
        let script = format!(
            "[[fault]]\nkind = \"swap\"\nproduct = 0x77\ndevice = {device}\nat = \"1.5s\"\nfor = \"1s\"\n\
             {ABSENT}"
        );
        let (outcome, heard, _) = run_on_four(line(3, STEPS), &script);
        let warnings = heard.warnings();
        outcome
            .result
            .unwrap_or_else(|error| panic!("{error}: {warnings:?}"));
        let found = unknown(&heard);
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!(found[0].1, closes, "{found:?}");
        assert_eq!(returned(&heard).len(), 1, "{warnings:?}");
    }
}
