//! Sercos drives (SoE) as axes, next to a CiA 402 drive on the simulated bus.

use std::path::Path;

use ecaxis_axis::State;
use ecaxis_ecat::index::DeviceIndex;
use ecaxis_ecat::mailbox::soe::Idn;
use ecaxis_master::config::Machine;
use ecaxis_master::mailbox::EmergencySource;
use ecaxis_master::rt::image;
use ecaxis_master::session::Progress;
use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::{
    Heard, assert_contains, faults, load, machine, recorded, root, run, run_badly, run_well,
    virtual_time,
};

const SERCOS: DeviceIndex = DeviceIndex(0);

/// Returns the sample machine with another program.
pub(crate) fn with_program(program: &str) -> String {
    let text = std::fs::read_to_string(root().join("configs/sercos.toml")).expect("our file");
    let end = text.find("[[step]]").expect("a program");
    format!("{}{program}", &text[..end])
}

pub(crate) const MOVE: &str = "[[step]]\nmove = { x = 50.0, y = -50.0, z = 50.0 }\nspeed = 0.5\n";

/// The words and values of one cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Cycle {
    /// S-0-0134 of both drives, without the toggle bit.
    pub(crate) control: [u16; 2],
    /// S-0-0047 of both drives.
    pub(crate) command: [i32; 2],
    /// S-0-0135 of both drives.
    pub(crate) status: [u16; 2],
    /// S-0-0051 of both drives.
    pub(crate) feedback: [i32; 2],
    /// 0x6040 of the CiA 402 drive.
    pub(crate) controlword: u16,
}

fn word(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn number(bytes: &[u8], at: usize) -> i32 {
    i32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

/// Returns every cycle of a recording. MDT: word and command of each drive. AT: word, feedback and
/// following distance of each drive.
pub(crate) fn cycles(machine: &Machine, recording: &Path) -> Vec<Cycle> {
    const TOGGLE: u16 = 1 << 10;
    let plan = image::of(&machine.rt_config()).expect("fits");
    // Devices are in the order of their positions.
    let region = |idns: bool| {
        let mut devices = machine.devices.enumerate();
        let found = devices.find(|(_, device)| device.selection.layout.idns == idns);
        plan.regions[found.expect("a device").0].expect("process data")
    };
    let (sercos, z) = (region(true), region(false));
    assert_eq!((sercos.out_len, sercos.in_len), (12, 20));
    let end = (sercos.offset + sercos.in_len).max(z.offset + z.out_len);
    let images = process_images(recording).into_iter();
    let images = images.filter(|(sent, _)| sent.len() >= end);
    images
        .map(|(sent, back)| {
            let (out, inp) = (&sent[sercos.offset..], &back[sercos.offset..]);
            Cycle {
                control: [0, 6].map(|at| word(out, at) & !TOGGLE),
                command: [2, 8].map(|at| number(out, at)),
                status: [0, 10].map(|at| word(inp, at)),
                feedback: [2, 12].map(|at| number(inp, at)),
                controlword: word(&sent[z.offset..], 0),
            }
        })
        .collect()
}

/// Returns the different control words of a drive in order.
pub(crate) fn words(cycles: &[Cycle], drive: usize) -> Vec<u16> {
    let mut words: Vec<u16> = cycles.iter().map(|cycle| cycle.control[drive]).collect();
    words.dedup();
    words
}

/// Returns source and code of each emergency and notification.
fn sources(heard: &Heard) -> Vec<(EmergencySource, u16)> {
    let each = heard.0.iter().filter_map(|progress| match progress {
        Progress::Emergency(report) => Some((report.emergency.source, report.emergency.code)),
        _ => None,
    });
    each.collect()
}

/// Runs a machine into a fault and returns the error, the cycles and the reports.
fn stopped(script: &str) -> (String, Vec<Cycle>, Heard) {
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(faults(script), folder.path());
    let machine = machine(&with_program(MOVE));
    let (outcome, heard) = run(machine.clone(), options);
    let error = outcome.result.expect_err("the fault stops the run");
    (error.to_string(), cycles(&machine, &path), heard)
}

#[test]
fn sercos_axes_and_a_cia_402_axis_move_together() {
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(virtual_time(), folder.path());
    let machine = load("sercos.toml");
    let summary = run_well(machine.clone(), options);
    assert_eq!(summary.counters.wkc_errors, 0);
    let names: Vec<&str> = summary.axes.iter().map(|a| a.name.as_str()).collect();
    assert_eq!(names, ["x", "y", "z"]);
    for axis in &summary.axes {
        println!("{}: {} at the end", axis.name, axis.final_position);
        assert!(axis.final_position.abs() < 0.01, "{axis:?}");
        assert_eq!(axis.final_state, State::SwitchOnDisabled.to_string());
        assert_eq!((&axis.fault, &axis.trip), (&None, &None));
    }
    let cycles = cycles(&machine, &path);
    // 30 mm are 6 turns of 65536 counts; y goes half as far, the other way.
    let farthest = |drive: usize| cycles.iter().map(|c| c.feedback[drive].abs()).max();
    assert!((farthest(0).unwrap() - 6 * 65_536).abs() < 300);
    assert!((farthest(1).unwrap() - 3 * 65_536).abs() < 300);
    for drive in 0..2 {
        // Enable, without and with "drive on"; at the end the torque leaves at rest.
        let words = words(&cycles, drive);
        println!("drive {drive}: {words:04x?}");
        assert_eq!(words, [0x0000, 0x6000, 0xe000, 0x6000, 0x0000]);
        let off = cycles
            .iter()
            .rposition(|c| c.control[drive] == 0xe000)
            .unwrap();
        let moved = (cycles[off].feedback[drive] - cycles[off - 20].feedback[drive]).abs();
        assert!(
            moved < 30,
            "{moved} counts in 20 ms at the end of the torque"
        );
        // Before "drive on", the command is the feedback: no step.
        let on = cycles
            .iter()
            .position(|c| c.status[drive] >> 14 == 3)
            .unwrap();
        let step = cycles[on].command[drive] - cycles[on].feedback[drive];
        assert!(step.abs() < 30, "{step}");
    }
}

/// The toggle bit changes in every cycle (IEC 61800-7-204, S-0-0134 bit 10).
#[test]
fn control_unit_synchronization_toggles_in_each_cycle() {
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(virtual_time(), folder.path());
    let machine = machine(&with_program("[[step]]\nmove = { x = 1.0 }\n"));
    run_well(machine.clone(), options);
    let plan = image::of(&machine.rt_config()).expect("fits");
    let at = plan.regions[SERCOS].expect("process data").offset;
    let images = process_images(&path);
    let bits: Vec<bool> = images
        .iter()
        .map(|(sent, _)| word(sent, at) >> 10 & 1 != 0)
        .collect();
    let first = bits.iter().position(|bit| *bit).expect("a first cycle");
    let toggles = bits[first..]
        .windows(2)
        .filter(|pair| pair[0] != pair[1])
        .count();
    let all = bits.len() - first - 1;
    assert!(all > 100 && toggles + 3 >= all, "{toggles} of {all}");
}

/// A fault of one drive stops all: the others by set-points, as docs/stops.md says.
#[test]
fn a_fault_of_either_drive_stops_both() {
    let script = |device: u32, code: u16| {
        format!(
            "[[fault]]\nkind = \"drive-fault\"\ndevice = {device}\ncode = {code:#06x}\nat = \"1s\"\n"
        )
    };
    let (error, of_z, _) = stopped(&script(1, 0x8611));
    println!("{error}");
    assert_contains(&error, &["`z`", "0x8611"]);
    for drive in 0..2 {
        let words = words(&of_z, drive);
        assert_eq!(
            words,
            [0x0000, 0x6000, 0xe000, 0x6000, 0x0000],
            "drive {drive}"
        );
        // The set-points end before the torque does.
        let off = of_z
            .iter()
            .rposition(|c| c.control[drive] == 0xe000)
            .unwrap();
        let last: Vec<i32> = of_z[off - 20..off]
            .iter()
            .map(|c| c.command[drive])
            .collect();
        assert!(
            last.windows(2).all(|pair| (pair[1] - pair[0]).abs() <= 2),
            "{last:?}"
        );
    }
    let (error, of_x, heard) = stopped(&script(0, 0x7305));
    let sources = sources(&heard);
    assert!(
        sources.contains(&(EmergencySource::Soe { drive: 0 }, 0x7305)),
        "{sources:?}"
    );
    println!("{error}");
    assert_contains(
        &error,
        &[
            "`x`",
            "drive fault",
            "0xf7305",
            "S-0-0390",
            "feedback error",
            "S-0-0095",
            "S-0-0011",
        ],
    );
    let faulted = of_x
        .iter()
        .position(|c| c.status[0] & 1 << 13 != 0)
        .expect("class 1");
    // The faulted drive decelerates by itself: it keeps "enable" until it has no torque.
    let after = &of_x[faulted..];
    println!("x {:04x?} y {:04x?}", words(after, 0), words(after, 1));
    assert_eq!(words(after, 0).last(), Some(&0));
    assert!(!words(&after[3..], 0).contains(&0xe000));
    // The other channel decelerates by set-points.
    assert_eq!(words(after, 1), [0xe000, 0x6000, 0x0000]);
    let last = after
        .iter()
        .rposition(|c| c.controlword & 0x0f == 0x0f)
        .expect("z was enabled");
    assert!(last > 20, "z decelerates as well: {last}");
}

/// `stop.others = "quick-stop"`: the word loses "drive on" in motion, and the drive's own ramp ends it.
#[test]
fn a_quick_stop_is_the_ramp_of_the_drive() {
    let folder = tempfile::tempdir().expect("a folder");
    let script = "[[fault]]\nkind = \"drive-fault\"\ndevice = 1\ncode = 0x8611\nat = \"1s\"\n";
    let (options, path) = recorded(faults(script), folder.path());
    let text = format!("[stop]\nothers = \"quick-stop\"\n\n{}", with_program(MOVE));
    let machine = machine(&text);
    let (error, _) = run_badly(machine.clone(), options);
    assert_contains(&error, &["`z`"]);
    let cycles = cycles(&machine, &path);
    assert_eq!(words(&cycles, 0), [0x0000, 0x6000, 0xe000, 0x6000, 0x0000]);
    let off = cycles
        .iter()
        .rposition(|c| c.control[0] == 0xe000)
        .expect("enabled")
        + 1;
    let speed = |at: usize| (cycles[at].feedback[0] - cycles[at - 1].feedback[0]).abs();
    // 50 mm/s are 655 counts a cycle.
    assert!(
        speed(off) > 500,
        "{} counts in the cycle of the quick stop",
        speed(off)
    );
    let ramp = cycles[off..]
        .iter()
        .take_while(|c| c.status[0] >> 14 == 3)
        .count();
    println!("the drive keeps its torque for {ramp} cycles");
    assert!((5..2000).contains(&ramp));
    assert!(
        speed(off + ramp) < 60,
        "{} at the end of the ramp",
        speed(off + ramp)
    );
    // The commands follow the feedback: no set-point of before comes back.
    let behind = cycles[off + 5].command[0] - cycles[off + 5].feedback[0];
    assert!(behind.abs() < 3000, "{behind}");
}

/// Fewer lost frames than the limit change nothing; more stop all axes by the drives' own means.
#[test]
fn lost_frames_are_borne_or_stop_all_axes() {
    let script =
        |count: u32| format!("[[fault]]\nkind = \"frame-loss\"\ncount = {count}\nat = \"1s\"\n");
    let summary = run_well(machine(&with_program(MOVE)), faults(&script(5)));
    assert!(summary.counters.lost_frames >= 5);
    let (error, _) = run_badly(
        machine(&with_program(MOVE)),
        faults("[[fault]]\nkind = \"frame-loss\"\nprobability = 1.0\nat = \"1s\"\nfor = \"10s\"\n"),
    );
    println!("{error}");
    assert_contains(&error, &["cycles in a row"]);
}

/// Without power of the Sercos drive at the end of the line, the CiA 402 drive decelerates by
/// set-points.
#[test]
fn power_loss_of_the_drive_stops_the_other() {
    let text = with_program(MOVE)
        .replacen("position = 0", "position = 9", 1)
        .replacen("position = 1", "position = 0", 1)
        .replacen("position = 9", "position = 1", 1);
    let script = "[[fault]]\nkind = \"power-off\"\ndevice = 1\nat = \"1s\"\nfor = \"20s\"\n";
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(faults(script), folder.path());
    let machine = machine(&text);
    let (error, summary) = run_badly(machine.clone(), options);
    println!("{error}");
    assert_contains(&error, &["`sercos`"]);
    let cycles = cycles(&machine, &path);
    let enabled = cycles.iter().rposition(|c| c.controlword & 0x0f == 0x0f);
    let gone = cycles.iter().rposition(|c| c.status[0] >> 14 == 3);
    let (enabled, gone) = (enabled.expect("enabled"), gone.expect("torque"));
    println!(
        "z has power for {} cycles more",
        enabled.saturating_sub(gone)
    );
    assert!(enabled > gone + 50, "{enabled} {gone}");
    assert_eq!(cycles.last().expect("cycles").control, [0, 0]);
    let axes = summary.expect("the cycle ran").axes;
    let z = axes.iter().find(|axis| axis.name == "z").expect("an axis");
    assert_eq!(z.trip, None);
}

/// An error from before the run is cleared by S-0-0099.
#[test]
fn an_earlier_error_is_cleared_by_the_procedure_command() {
    let script = "[[fault]]\nkind = \"drive-fault\"\ndevice = 0\ncode = 0x7305\nat = \"50ms\"\n";
    let (outcome, heard) = run(machine(&with_program(MOVE)), faults(script));
    println!("{:?}", heard.warnings());
    outcome.result.expect("the reset clears it");
    let end = EmergencySource::Notification {
        drive: 0,
        idn: Idn::RESET_CLASS_1,
    };
    let sources = sources(&heard);
    assert!(
        sources.contains(&(end, 3)),
        "S-0-0099 ends as executed: {sources:?}"
    );
}

/// Returns the sample machine in another mode of the Sercos drive, with further keys of its axes.
fn in_mode(mode: &str, keys: &str, program: &str) -> Machine {
    let unit = "velocity_unit = \"mrpm\"";
    let text = with_program(program)
        .replacen("\"csp\"            #", &format!("\"{mode}\" #"), 1)
        .replace(unit, &format!("{unit}\n{keys}"));
    machine(&text)
}

/// Velocity control by S-0-0032, with S-0-0036 in the MDT. The position loop is that of ecaxis.
#[test]
fn velocity_control_is_another_operation_mode() {
    let summary = run_well(in_mode("csv", "csv = { kv = 20.0 }", MOVE), virtual_time());
    for axis in &summary.axes {
        println!("{}: {}", axis.name, axis.final_position);
        assert!((axis.final_position.abs() - 50.0).abs() < 0.5, "{axis:?}");
    }
}

/// Torque control by S-0-0032, with S-0-0080 in the MDT and S-0-0084 in the AT.
#[test]
fn torque_control_is_another_operation_mode() {
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(virtual_time(), folder.path());
    let program = "[[step]]\ntorque = { x = 5.0 }\nramp = \"20ms\"\n[[step]]\ndwell = \"50ms\"\n\
        [[step]]\ntorque = { x = 0.0 }\nramp = \"0ms\"\n[[step]]\ndwell = \"3s\"\n";
    let machine = in_mode("cst", "", program);
    run_well(machine.clone(), options);
    let plan = image::of(&machine.rt_config()).expect("fits");
    let sercos = plan.regions[SERCOS].expect("process data");
    // MDT: word and torque of each drive. AT: word, position, following distance, torque.
    assert_eq!((sercos.out_len, sercos.in_len), (8, 24));
    let images = process_images(&path);
    let most = |at: usize, sent: bool| {
        let of = images
            .iter()
            .map(|(out, back)| if sent { out } else { back });
        of.map(|image| {
            i16::from_le_bytes([image[sercos.offset + at], image[sercos.offset + at + 1]])
        })
        .max()
    };
    // 5 % are 50 in units of 0.1 %.
    assert_eq!(most(2, true), Some(50));
    let felt = most(10, false).expect("cycles");
    println!("S-0-0084 is at most {felt}");
    assert!((40..=60).contains(&felt), "{felt}");
    assert_eq!(
        most(6, true),
        Some(0),
        "the other drive has no torque command"
    );
}

/// An IDN that follows from other keys would give the process data another meaning.
#[test]
fn derived_idns_and_a_missing_unit_are_refused() {
    let text = with_program(MOVE);
    let refused = |from: &str, to: &str, parts: &[&str]| {
        assert!(text.contains(from));
        let path = root().join("configs/sercos.toml");
        let text = text.replacen(from, to, 1);
        let error = ecaxis_master::config::parse(&path, &text).expect_err(to);
        assert_contains(&error.to_string(), parts);
    };
    for (idn, from) in [
        ("S-0-0032", "`mode`"),
        ("S-0-0024", "`pdo.rx`"),
        ("S-0-0002", "`bus.cycle`"),
        ("S-0-0134", "the cycle"),
    ] {
        let own = format!("\"{idn}\"");
        refused("\"S-0-0091\"", &own, &[idn, from, "remove it"]);
    }
    refused(
        "velocity_unit = \"mrpm\"",
        "",
        &["S-0-0044", "velocity_unit"],
    );
}
