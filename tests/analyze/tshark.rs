//! Compares the analysis of each capture with tshark's dissector. Without tshark, the test is
//! skipped.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;

use ecaxis_test_support::skip;
use ecaxis_tools::analyze::Report;

use super::{captures, of_file};

/// One datagram as tshark dissects it.
struct Dissected {
    at_ns: u64,
    answer: bool,
    command: u8,
    /// A register or logical address.
    address: u32,
    wkc: u16,
    /// The source address of the frame.
    source: String,
}

fn tshark(arguments: &[&str]) -> Option<String> {
    match Command::new("tshark").args(arguments).output() {
        Ok(output) => {
            let reported = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success(), "{reported}");
            Some(String::from_utf8(output.stdout).expect("UTF-8"))
        }
        Err(error) => {
            skip(&format!("no tshark: {error}"));
            None
        }
    }
}

fn dissected(path: &Path) -> Option<Vec<Dissected>> {
    let fields = [
        "frame.time_epoch",
        "eth.src",
        "ecat.cmd",
        "ecat.ado",
        "ecat.lad",
        "ecat.cnt",
    ];
    let mut arguments = vec![
        "-r",
        path.to_str().expect("UTF-8"),
        "-T",
        "fields",
        "-E",
        "separator=|",
    ];
    arguments.extend(fields.iter().flat_map(|field| ["-e", *field]));
    let number = |text: &str| u32::from_str_radix(text.trim_start_matches("0x"), 16).expect("hex");
    let mut found = Vec::new();
    for line in tshark(&arguments)?.lines() {
        let parts: Vec<&str> = line.split('|').collect();
        let [time, source, commands, registers, logical, counters] = parts[..] else {
            panic!("{line}");
        };
        let (seconds, fraction) = time.split_once('.').expect("a fraction");
        let at_ns = seconds.parse::<u64>().expect("seconds") * 1_000_000_000
            + format!("{fraction:0<9}")[..9]
                .parse::<u64>()
                .expect("nanoseconds");
        let (mut registers, mut logical) = (registers.split(','), logical.split(','));
        for (command, wkc) in commands.split(',').zip(counters.split(',')) {
            let command = number(command) as u8;
            let of = if (10..=12).contains(&command) {
                &mut logical
            } else {
                &mut registers
            };
            found.push(Dissected {
                at_ns,
                answer: number(&source[..2]) & 2 != 0,
                command,
                address: number(of.next().expect("an address")),
                wkc: wkc.parse().expect("a working counter"),
                source: source.to_owned(),
            });
        }
    }
    Some(found)
}

/// Compares device count, states, SDO transfers, cycle time and working counters.
#[test]
fn every_capture_agrees_with_tshark() {
    for path in captures() {
        let name = path.display();
        let report = of_file(&path);
        let Some(seen) = dissected(&path) else {
            return;
        };
        // Frames: with one frame in flight, a datagram's time and source identify its frame.
        let sources: BTreeSet<&str> = seen.iter().map(|d| &*d.source).collect();
        assert!(sources.len() <= 2, "{name}: {sources:?}");

        let broadcast = seen
            .iter()
            .filter(|d| d.answer && d.command == 7 && d.address < 0x10);
        let expected = broadcast.map(|d| d.wkc).max();
        assert_eq!(report.answering, expected, "{name}: devices");
        if let Some(count) = expected {
            assert_eq!(report.devices.len(), usize::from(count), "{name}: devices");
        }

        // Process data: count, working counters, and median interval.
        let mut groups: BTreeMap<u32, (Vec<u64>, BTreeMap<u16, u64>)> = BTreeMap::new();
        for d in seen.iter().filter(|d| (10..=12).contains(&d.command)) {
            let group = groups.entry(d.address).or_default();
            if d.answer {
                *group.1.entry(d.wkc).or_default() += 1;
            } else {
                group.0.push(d.at_ns);
            }
        }
        assert_eq!(report.cycle.len(), groups.len(), "{name}: process data");
        for cycle in &report.cycle {
            let (times, counters) = &groups[&cycle.logical_address];
            assert_eq!(cycle.count, times.len() as u64, "{name}");
            let expected: Vec<(u16, u64)> = counters.iter().map(|(w, n)| (*w, *n)).collect();
            assert_eq!(cycle.wkc, expected, "{name}: working counters");
            let mut intervals: Vec<u64> = times.windows(2).map(|w| w[1] - w[0]).collect();
            intervals.sort_unstable();
            let median = intervals[(intervals.len() - 1) / 2];
            let off = cycle.cycle_ns.abs_diff(median) as f64 / median as f64;
            assert!(off < 1e-3, "{name}: {} against {median}", cycle.cycle_ns);
            assert!(
                cycle.interval_max_ns.abs_diff(*intervals.last().unwrap()) < 2_000,
                "{name}"
            );
        }
        states_as_tshark(&path, &report);
        transfers_as_tshark(&path, &report);
    }
}

/// Compares every reported state of the devices, from reads of AL status.
fn states_as_tshark(path: &Path, report: &Report) {
    let filter = "ecat.ado == 0x130 && (eth.src[0] & 2)";
    let fields = [
        "-e",
        "ecat.cmd",
        "-e",
        "ecat.ado",
        "-e",
        "ecat.adp",
        "-e",
        "ecat.cnt",
        "-e",
        "ecat.reg.alstatus.status",
    ];
    let mut arguments = vec![
        "-r",
        path.to_str().unwrap(),
        "-Y",
        filter,
        "-T",
        "fields",
        "-E",
        "separator=|",
    ];
    arguments.extend(fields);
    let mut expected: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
    let number = |text: &str| u32::from_str_radix(text.trim_start_matches("0x"), 16).unwrap();
    for line in tshark(&arguments).unwrap_or_default().lines() {
        let parts: Vec<&str> = line.split('|').collect();
        let [commands, registers, stations, counters, states] = parts[..] else {
            panic!("{line}");
        };
        // If every datagram is such a read, states belong to single stations.
        let all = |list: &str, wanted: &str| list.split(',').all(|one| one == wanted);
        if !all(commands, "0x04") || !all(registers, "0x0130") || !all(counters, "1") {
            continue;
        }
        for (station, state) in stations.split(',').zip(states.split(',')) {
            expected
                .entry(number(station))
                .or_default()
                .push(number(state));
        }
    }
    for (station, states) in expected {
        let device = report
            .devices
            .iter()
            .find(|d| d.station.map(u32::from) == Some(station));
        let device = device.unwrap_or_else(|| panic!("{}: 0x{station:04x}", path.display()));
        for state in states {
            let name = match state & 0x0f {
                1 => "Init",
                2 => "PreOp",
                4 => "SafeOp",
                8 => "Op",
                other => panic!("state {other}"),
            };
            assert!(
                device.states.iter().any(|s| s == name),
                "{}: {name} of {device:?}",
                path.display()
            );
        }
    }
}

/// Compares the transferred objects in request order.
fn transfers_as_tshark(path: &Path, report: &Report) {
    // Initiate requests only: downloads and uploads, no segments.
    let filter = "ecat_mailbox.coe.sdoccsid || ecat_mailbox.coe.sdoccsiu";
    let both = format!("({filter}) && !(eth.src[0] & 2)");
    let fields = [
        "-e",
        "ecat_mailbox.coe.sdoidx",
        "-e",
        "ecat_mailbox.coe.sdosub",
        "-e",
        "ecat_mailbox.coe.sdoreq",
    ];
    let mut arguments = vec![
        "-r",
        path.to_str().unwrap(),
        "-Y",
        &both,
        "-T",
        "fields",
        "-E",
        "separator=|",
    ];
    arguments.extend(fields);
    let number = |text: &str| u32::from_str_radix(text.trim_start_matches("0x"), 16).unwrap();
    let mut expected = Vec::new();
    for line in tshark(&arguments).unwrap_or_default().lines() {
        let parts: Vec<&str> = line.split('|').collect();
        // 1 is a download, 2 an upload.
        expected.push((
            number(parts[0]) as u16,
            number(parts[1]) as u8,
            parts[2] == "1",
        ));
    }
    let found = report
        .transfers
        .iter()
        .map(|t| (t.index, t.sub, t.write))
        .collect::<Vec<_>>();
    assert_eq!(found, expected, "{}", path.display());
    assert!(
        report.transfers.iter().all(|t| t.ended == "done"),
        "{:?}",
        report.transfers
    );
}
