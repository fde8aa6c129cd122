//! Devices without LRW next to a device with LRW, on the whole bus.

use std::collections::BTreeMap;
use std::path::Path;

use ecaxis_master::config::Machine;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::recordings::{LRD, LRW, LWR, frames};
use ecaxis_test_support::{faults, recorded, run_badly, run_well, virtual_time};

/// Returns three drives that move; the ESI files of the named ones exclude LRW.
fn bus(without: &[&str], exchange: &str) -> Machine {
    let bench = Bench::new();
    let type_ = "<Type ProductCode=\"#x45500004\"";
    bench.write("no_lrw.xml", &bench.read("esi/EPOS4.xml"));
    bench.change("no_lrw.xml", |esi| {
        esi.replace(type_, &format!("{type_} UseLrdLwr=\"1\""))
    });
    let mut text = format!("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\nexchange = \"{exchange}\"\n");
    for (position, name) in ["x", "y", "z"].into_iter().enumerate() {
        let file = if without.contains(&name) {
            "no_lrw.xml"
        } else {
            "esi/EPOS4.xml"
        };
        text += &format!(
            "[[device]]\nname = \"{name}\"\nesi = \"{file}\"\nposition = {position}\nmode = \"csp\"\n\
             [device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 2000\n\
             limits = {{ position = [-100.0, 100.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }}\n"
        );
    }
    text += "[[step]]\nmove = { x = 20.0, y = -10.0, z = 5.0 }\n[[step]]\ndwell = \"1s\"\n";
    bench.machine(&text)
}

/// Returns the working counters of each logical command per cyclic frame. Datagrams of one command
/// are added up.
fn logical(recording: &Path) -> Vec<BTreeMap<u8, u16>> {
    let received = frames(recording).into_iter().filter(|frame| !frame.sent);
    let counters = received.map(|frame| {
        let mut counters = BTreeMap::new();
        for datagram in frame.datagrams {
            if (LRD..=LRW).contains(&datagram.command) {
                *counters.entry(datagram.command).or_default() += datagram.working_counter;
            }
        }
        counters
    });
    counters.filter(|frame| !frame.is_empty()).collect()
}

/// ETG.2000, `Type/@UseLrdLwr`, and ETG.1000.4, 0x0008 bit 9: the device does not support LRW.
/// ETG.1000.4, working counter: 1 for LRD, 1 for LWR, 3 for LRW.
#[test]
fn each_device_is_reached_by_a_supported_command() {
    // LRW counts 1 for reading and 2 for writing per device, LRD and LWR count 1. In every second
    // cycle, an LRD reads the status of all three mailboxes.
    const STATUS: u16 = 3;
    for (without, expected) in [
        (&[][..], vec![(LRD, 0), (LRW, 9)]),
        (&["y"], vec![(LRD, 1), (LWR, 1), (LRW, 6)]),
        (&["x", "z"], vec![(LRD, 2), (LWR, 2), (LRW, 3)]),
        (&["x", "y", "z"], vec![(LRD, 3), (LWR, 3)]),
    ] {
        for exchange in ["same-cycle", "pipelined"] {
            let folder = tempfile::tempdir().expect("a temporary folder");
            let (options, recording) = recorded(virtual_time(), folder.path());
            let summary = run_well(bus(without, exchange), options);
            let counters = summary.counters;
            assert_eq!(
                (counters.wkc_errors, counters.lost_frames),
                (0, 0),
                "{without:?}"
            );
            for (axis, target) in summary.axes.iter().zip([20.0, -10.0, 5.0]) {
                assert_eq!(axis.target_position, target, "{without:?}");
                assert!(
                    axis.final_error_counts.is_some_and(|e| e.abs() <= 1),
                    "{axis:?}"
                );
            }
            // The middle half of the frames is in Op.
            let frames = logical(&recording);
            let middle = &frames[frames.len() / 4..frames.len() / 4 * 3];
            assert!(middle.len() > 300, "{}", middle.len());
            let expected: BTreeMap<u8, u16> = expected.iter().copied().collect();
            let mut with_status = 0_usize;
            for frame in middle {
                let mut frame = frame.clone();
                let read = frame.entry(LRD).or_default();
                if *read == expected[&LRD] + STATUS {
                    *read -= STATUS;
                    with_status += 1;
                }
                assert_eq!(frame, expected, "{without:?}, {exchange}");
            }
            let share = with_status * 2;
            assert!(
                share.abs_diff(middle.len()) <= 2,
                "{share} of {}",
                middle.len()
            );
        }
    }
}

/// A missing device is detected by the working counter of its own datagrams, even if the other
/// counters are correct.
#[test]
fn a_missing_device_without_lrw_stops_the_machine() {
    for without in ["x", "z"] {
        let script = "[[fault]]\nkind = \"absent\"\ndevice = 2\nat = \"1200ms\"\n";
        let (error, _) = run_badly(bus(&[without], "same-cycle"), faults(script));
        assert!(
            error.contains("`z`") && error.contains("no longer answers"),
            "{error}"
        );
    }
}
