//! The stop table of Sercos drives (docs/soe.md, Stops) that the machine file configures, read from
//! recordings.

use ecaxis_test_support::{assert_contains, faults, machine, recorded, run_badly, virtual_time};

use crate::soe::{Cycle, MOVE, cycles, with_program, words};

/// From the end of "drive on" the drive decelerates by itself.
const QUICK_STOP: [u16; 5] = [0x0000, 0x6000, 0xe000, 0x6000, 0x0000];
/// The torque leaves in motion.
const NO_POWER: [u16; 4] = [0x0000, 0x6000, 0xe000, 0x0000];

/// Runs the sample with a reaction of both channels until it fails.
fn stopped(key: &str, reaction: &str, stop: &str, script: &str) -> (String, Vec<Cycle>) {
    let unit = "velocity_unit = \"mrpm\"";
    let text = with_program(MOVE).replace(unit, &format!("{unit}\n{key} = \"{reaction}\""));
    let folder = tempfile::tempdir().expect("a folder");
    let options = if script.is_empty() {
        virtual_time()
    } else {
        faults(script)
    };
    let (options, path) = recorded(options, folder.path());
    let machine = machine(&format!("{stop}\n{text}"));
    let (error, _) = run_badly(machine.clone(), options);
    (error, cycles(&machine, &path))
}

/// Checks the words of a drive, and that they change while it moves fast.
fn assert_stop(cycles: &[Cycle], drive: usize, expected: &[u16], fast: i32) {
    assert_eq!(words(cycles, drive), expected, "drive {drive}");
    let last = cycles
        .iter()
        .rposition(|cycle| cycle.control[drive] == 0xe000)
        .expect("enabled");
    let speed = (cycles[last].feedback[drive] - cycles[last - 1].feedback[drive]).abs();
    println!("drive {drive}: {speed} counts in the last cycle of \"drive on\"");
    assert!(speed >= fast, "{speed} counts a cycle");
}

#[test]
fn an_emergency_stop_uses_the_method_of_the_axis() {
    let stop = "[stop]\nemergency = { z.\"0x6064\" = { above = 300000 } }\n";
    for (reaction, expected) in [("quick-stop", &QUICK_STOP[..]), ("no-power", &NO_POWER)] {
        let (error, cycles) = stopped("on_emergency", reaction, stop, "");
        assert_contains(&error, &["emergency stop", "z.Position actual value"]);
        // 50 mm/s are 655 counts a cycle.
        for drive in 0..2 {
            assert_stop(&cycles, drive, expected, 500);
        }
    }
}

#[test]
fn a_trip_uses_the_method_of_its_axis() {
    // The first channel's shaft is blocked. The other channel decelerates by set-points.
    let script = "[[fault]]\nkind = \"blocked\"\ndevice = 0\nat = \"1s\"\nfor = \"1s\"\n";
    for (reaction, expected) in [("quick-stop", &QUICK_STOP[..]), ("no-power", &NO_POWER)] {
        let (error, cycles) = stopped("on_trip", reaction, "", script);
        assert_contains(&error, &["following error"]);
        println!("{error}");
        assert_stop(&cycles, 0, expected, 0);
        assert_eq!(words(&cycles, 1), QUICK_STOP);
        let off = cycles.iter().rposition(|c| c.control[1] == 0xe000);
        let off = off.expect("enabled");
        let last = (cycles[off].command[1] - cycles[off - 1].command[1]).abs();
        assert!(last <= 2, "{last} counts a cycle");
    }
}

/// The frames that return after the loss carry the reaction.
#[test]
fn a_lost_bus_uses_the_method_of_the_machine() {
    let script =
        "[[fault]]\nkind = \"frame-loss\"\nprobability = 1.0\nat = \"1s\"\nfor = \"60ms\"\n";
    for (reaction, expected) in [("quick-stop", &QUICK_STOP[..]), ("no-power", &NO_POWER)] {
        let stop = format!("[stop]\nbus_lost = \"{reaction}\"\n");
        let (error, cycles) = stopped("on_trip", "ramp", &stop, script);
        assert_contains(&error, &["cycles in a row"]);
        for drive in 0..2 {
            let words = words(&cycles, drive);
            println!("{words:04x?}");
            assert_eq!(words, expected, "drive {drive}");
        }
    }
}
