//! Drives with several axes: the objects of each further axis are 0x800 later (CiA 402-1).

use std::fmt::Write as _;

use ecaxis_ecat::index::{AxisIndex, DeviceIndex};
use ecaxis_master::config::Machine;
use ecaxis_master::session::Summary;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::recordings::{FPWR, datagrams, process_images};
use ecaxis_test_support::{
    assert_contains, faults, fixture, recorded, run, run_well, virtual_time,
};

/// Returns the element from `open` to `close` behind `from`, and where it ends.
fn element<'t>(text: &'t str, open: &str, close: &str) -> Option<(usize, &'t str)> {
    let start = text.find(open)?;
    let end = start + text[start..].find(close)? + close.len();
    Some((start, &text[start..end]))
}

fn elements(text: &str, open: &str, close: &str) -> Vec<String> {
    let (mut rest, mut found) = (text, Vec::new());
    while let Some((at, one)) = element(rest, open, close) {
        found.push(one.to_owned());
        rest = &rest[at + one.len()..];
    }
    found
}

/// Moves all objects from 0x6000 on and the PDO to those of an axis.
fn of_axis(text: &str, axis: u16) -> String {
    let mut moved = String::new();
    let mut rest = text;
    while let Some(at) = rest.find("<Index>#x") {
        let digits = at + "<Index>#x".len();
        moved += &rest[..digits];
        let index = u16::from_str_radix(&rest[digits..digits + 4], 16).expect("an index");
        let index = match index {
            0x6000.. => index + axis * 0x800,
            _ => index + axis * 0x10,
        };
        let _ = write!(moved, "{index:04X}");
        rest = &rest[digits + 4..];
    }
    moved + rest
}

/// Returns the servo drive of `configs/esi` with several axes, each with PDOs of its own.
fn drive_of(bench: &Bench, axes: u16) {
    let sv1 = bench.read("esi/SV1.xml");
    let of_profile = |object: &String| object.contains("<Index>#x6");
    let objects: Vec<_> = elements(&sv1, "<Object>", "</Object>");
    let profile: String = objects.iter().filter(|o| of_profile(o)).cloned().collect();
    let rx = element(&sv1, "<RxPdo", "</RxPdo>").expect("an RxPdo").1;
    let tx = element(&sv1, "<TxPdo", "</TxPdo>").expect("a TxPdo").1;
    let more = |text: &str| -> String { (1..axes).map(|axis| of_axis(text, axis)).collect() };
    let (objects_end, rx_end, tx_end) = ("</Objects>", "</RxPdo>", "</TxPdo>");
    let text = sv1
        .replace(objects_end, &(more(&profile) + objects_end))
        .replace(rx_end, &(rx_end.to_owned() + &more(rx)))
        .replace(tx_end, &(tx_end.to_owned() + &more(tx)))
        .replace(
            "DefaultSize=\"12\"",
            &format!("DefaultSize=\"{}\"", 12 * axes),
        )
        .replace(
            "DefaultSize=\"13\"",
            &format!("DefaultSize=\"{}\"", 13 * axes),
        );
    bench.write("several.xml", &text);
}

fn axis(name: &str, number: u16) -> String {
    format!(
        "[[device.axis]]\nname = \"{name}\"\nnumber = {number}\nencoder = 131072\n\
         limits = {{ velocity = 50.0, acceleration = 500.0, following_error = 1.0 }}\n"
    )
}

/// Returns a machine with one drive, after a drive of one axis.
fn machine(bench: &Bench, axes: &[(&str, u16)], rest: &str) -> Machine {
    let mut text = String::from(
        "[bus]\ncycle = \"1ms\"\n[[device]]\nname = \"single\"\nesi = \"esi/SV1.xml\"\nposition = 0\nmode = \"csp\"\n\
         [device.axis]\nencoder = 131072\nlimits = { velocity = 50.0, acceleration = 500.0 }\n\
         [[device]]\nname = \"multi\"\nesi = \"several.xml\"\nposition = 1\nmode = \"csp\"\n",
    );
    for (name, number) in axes {
        text += &axis(name, *number);
    }
    bench.machine(&(text + rest))
}

fn positions(summary: &Summary) -> Vec<(String, f64)> {
    let axes = summary.axes.iter();
    axes.map(|axis| (axis.name.clone(), axis.final_position.round()))
        .collect()
}

/// CiA 402-1: 0x6840, 0x7040, … are the Controlwords of the further axes.
#[test]
fn all_axes_of_a_drive_move_by_themselves() {
    for count in [2, 6] {
        let bench = Bench::new();
        drive_of(&bench, count);
        let names: Vec<_> = (1..=count).map(|n| (format!("m{n}"), n)).collect();
        let axes: Vec<_> = names.iter().map(|(name, n)| (name.as_str(), *n)).collect();
        let targets: Vec<_> = axes
            .iter()
            .map(|(name, n)| format!("{name} = {n}.0"))
            .collect();
        let steps = format!(
            "[[step]]\nmove = {{ single = -3.0, {} }}\n",
            targets.join(", ")
        );
        let summary = run_well(machine(&bench, &axes, &steps), virtual_time());
        let mut expected = vec![("single".to_owned(), -3.0)];
        expected.extend(names.into_iter().map(|(name, n)| (name, f64::from(n))));
        assert_eq!(positions(&summary), expected);
        for axis in &summary.axes {
            assert!(
                axis.final_error_counts.is_some_and(|e| e.abs() <= 10),
                "{axis:?}"
            );
        }
    }
}

/// CiA 402-2, Controlword: with 0, a drive stays in Switch on disabled. An axis that the machine
/// does not use receives zeros: no power, and no limit is held.
#[test]
fn an_unused_axis_receives_nothing() {
    let bench = Bench::new();
    drive_of(&bench, 2);
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(virtual_time(), folder.path());
    let steps = "[[step]]\nmove = { second = 2.0 }\n";
    let machine = machine(&bench, &[("second", 2)], steps);
    let notes = machine.devices.iter().flat_map(|d| &d.selection.notes);
    let unused: Vec<_> = notes.filter(|note| note.contains("not used")).collect();
    assert_eq!(unused.len(), 1, "{unused:?}");
    assert_contains(unused[0], &["axis 1 of the drive", "0x6040"]);
    let layout = &machine.devices[machine.axes[AxisIndex(1)].device]
        .selection
        .layout;
    let second = layout.rx_field(0x6840, 0).expect("mapped").bit_offset / 8;
    assert_eq!(second, 12);
    let summary = run_well(machine, options);
    assert_eq!(positions(&summary)[1], ("second".to_owned(), 2.0));
    // The first drive has 13 bytes, then the first axis has twelve.
    let images = process_images(&path);
    assert!(images.iter().all(|(sent, _)| sent[13..25] == [0; 12]));
    assert!(images.iter().any(|(sent, _)| sent[25..37] != [0; 12]));
}

/// CiA 402-1: 0x60C2 and 0x6060 of each axis; the second axis of this drive homes by itself.
#[test]
fn start_up_sdos_and_homing_are_those_of_the_axis() {
    let bench = Bench::new();
    drive_of(&bench, 2);
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(virtual_time(), folder.path());
    let steps = "[[step]]\nmove = { m1 = 1.0, m2 = -1.0 }\n";
    run_well(machine(&bench, &[("m1", 1), ("m2", 2)], steps), options);
    // Mailbox header, CoE header, download request; then index and subindex.
    let sent = datagrams(&path)
        .into_iter()
        .filter(|d| d.sent && d.command == FPWR);
    let downloads: Vec<(u16, u8)> = sent
        .filter(|d| d.data.len() > 12 && d.data[5] & 0x0f == 3 && d.data[8] >> 5 == 1)
        .map(|d| (u16::from_le_bytes([d.data[9], d.data[10]]), d.data[11]))
        .collect();
    for index in [0x60c2, 0x68c2] {
        assert!(downloads.contains(&(index, 1)), "{index:#x}: {downloads:?}");
    }
    assert!(downloads.contains(&(0x6860, 0)), "{downloads:?}");
}

/// ETG.1000.4: working counter and watchdog belong to FMMUs and SyncManagers, not to axes. The
/// drive has one set of FMMUs, so its axes stop together.
#[test]
fn a_fault_of_one_axis_stops_the_group_of_the_drive() {
    let bench = Bench::new();
    drive_of(&bench, 2);
    let rest = "[[stop.group]]\nname = \"pair\"\naxes = [\"m2\", \"m1\"]\noutside = \"continue\"\n\
         [[step]]\nenable = true\n[[step]]\nvelocity = { m1 = 5.0, m2 = 5.0 }\n[[step]]\nmove = { single = 40.0 }\n";
    let fault = "[[fault]]\nkind = \"drive-fault\"\ndevice = 1\nat = \"1s\"\ncode = 0x8611\n";
    let (outcome, heard) = run(
        machine(&bench, &[("m1", 1), ("m2", 2)], rest),
        faults(fault),
    );
    outcome.result.expect("the rest goes on");
    let summary = outcome.summary.expect("a summary");
    assert_eq!(positions(&summary)[0], ("single".to_owned(), 40.0));
    assert!(summary.axes[1].fault.is_some(), "{:?}", summary.axes[1]);
    assert!(summary.axes[2].fault.is_none(), "{:?}", summary.axes[2]);
    let _ = heard;
}

#[test]
fn mistakes_with_several_axes_are_explained() {
    let bench = Bench::new();
    drive_of(&bench, 2);
    let text = |axes: &str, rest: &str| {
        format!(
            "[bus]\ncycle = \"1ms\"\n[[device]]\nname = \"multi\"\nesi = \"several.xml\"\nposition = 0\nmode = \"csp\"\n{axes}{rest}"
        )
    };
    let nameless = axis("m2", 2).replace("name = \"m2\"\n", "");
    let both = axis("m1", 1) + &axis("m2", 2);
    for (text, parts) in [
        (
            text(&(axis("m1", 1) + &nameless), ""),
            &["needs a `name`"][..],
        ),
        (
            text(&(axis("m1", 1) + &axis("m2", 1)), ""),
            &["has axis 1 once"],
        ),
        (
            text(&(axis("m1", 1) + &axis("m1", 2)), ""),
            &["\"m1\" is taken"],
        ),
        (text(&axis("m3", 3), ""), &["axis 3", "0x7040"]),
        (
            text(&both, "[[step]]\nmove = { multi = 1.0 }\n"),
            &["`multi` has several axes", "`m1`, `m2`"],
        ),
        (
            text(
                &both,
                "[[stop.group]]\nname = \"g\"\naxes = [\"m1\", \"m1\"]\n",
            ),
            &["named twice"],
        ),
    ] {
        let error = bench.parse(&text).expect_err("a mistake");
        assert_contains(&error, parts);
    }
}

/// ETG.2000: `MinInstances="0"` makes the second slot of this vendor's device optional. It holds the
/// second axis: `SlotIndexIncrement` is 0x800.
#[test]
fn an_axis_in_an_optional_slot_moves() {
    let Some(esi) = fixture("esi/hpmicro/ECAT_CIA402.xml") else {
        return;
    };
    let text = format!(
        "[bus]\ncycle = \"1ms\"\n[[device]]\nname = \"d\"\nesi = \"{}\"\nposition = 0\nmode = \"csp\"\n\
         {}{}[[step]]\nmove = {{ first = 1.0, second = -2.0 }}\n",
        esi.display(),
        axis("first", 1),
        axis("second", 2),
    );
    let machine = Bench::new().machine(&text);
    assert_eq!(machine.devices[DeviceIndex(0)].selection.modules.len(), 2);
    let summary = run_well(machine, virtual_time());
    let expected = [("first".to_owned(), 1.0), ("second".to_owned(), -2.0)];
    assert_eq!(positions(&summary), expected);
}
