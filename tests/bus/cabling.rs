//! Cables: IN and OUT swapped at a device, propagation delays.

use std::fmt::Write as _;

use ecaxis_master::config::Machine;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::recordings::{FPWR, datagrams};
use ecaxis_test_support::{axes, faults, machine, recorded, run, run_badly, virtual_time};

/// Returns four drives, one with swapped cables.
fn with_reversed(device: usize) -> String {
    let place = format!("position = {device}\n");
    axes(4).replace(&place, &format!("{place}sim = {{ reversed = true }}\n"))
}

/// Beckhoff ESC data sheet, section I, 3.1: the processing unit is between port 0 and port 3. A frame
/// that enters at port 1 passes the devices behind the device before it is processed.
#[test]
fn device_with_swapped_in_and_out_is_named_with_its_port() {
    let text = with_reversed(1);
    let other = text.replacen("EPOS4.xml\"\nposition = 1", "IDX.xml\"\nposition = 1", 1);
    for (text, named) in [
        (&other, "swapped at `a1` (position 1): frames"),
        (
            &text,
            "swapped at one of `a0` (position 0), `a1` (position 1), `a2` (position 2)",
        ),
    ] {
        let (error, summary) = run_badly(machine(text), virtual_time());
        assert!(error.contains(named), "{error}");
        let place = "frames enter at its port 1 instead of port 0 and reach it at position 3";
        assert!(error.contains(place), "{error}");
        assert!(summary.is_none(), "no cycle has run");
    }
}

/// SOEM reaches Op on such a segment. Here too, if nothing depends on clocks and on the order.
#[test]
fn swapped_cables_do_not_matter_without_clocks_and_positions() {
    let by_alias = |mut text: String| {
        for device in 0..4 {
            let place = format!("position = {device}\n");
            text = text.replace(&place, &format!("alias = {}\n", 100 + device));
        }
        text
    };
    let without_clocks =
        |text: String| text.replace("mode = \"csp\"", "mode = \"csp\"\ndc = \"off\"");
    for swapped in 0..3 {
        let text = without_clocks(with_reversed(swapped));
        let (outcome, heard) = run(machine(&by_alias(text.clone())), virtual_time());
        let summary = outcome.summary.expect("comes up");
        outcome.result.expect("moves");
        for axis in &summary.axes {
            assert!(
                axis.final_error_counts
                    .is_some_and(|error| error.abs() <= 1),
                "{axis:?}"
            );
        }
        let warning = "swapped at the device at position 3: frames enter at its port 1";
        assert!(
            heard.warnings().iter().any(|w| w.contains(warning)),
            "{:?}",
            heard.warnings()
        );
        // A position would mean another drive, and SYNC0 needs the delays.
        for text in [text, by_alias(with_reversed(swapped))] {
            let (error, _) = run_badly(machine(&text), virtual_time());
            assert!(error.contains("IN and OUT are swapped at"), "{error}");
        }
    }
}

/// Behind the last device there is nothing that frames could pass before it.
#[test]
fn swapped_cables_of_the_last_device_change_nothing() {
    let (outcome, heard) = run(machine(&with_reversed(3)), virtual_time());
    outcome.result.expect("comes up and moves");
    let warnings = heard.warnings();
    assert!(
        !warnings.iter().any(|w| w.contains("swapped")),
        "{warnings:?}"
    );
}

const LIMITS: &str = "limits = { position = [-1000.0, 1000.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }";

/// A drive with three ports; `first` at its port 1, `second` at its port 2. Frames pass `first`
/// before `second`.
fn branches() -> Machine {
    let bench = Bench::new();
    bench.write("junction.xml", &bench.read("esi/EPOS4.xml"));
    bench.change("junction.xml", |esi| esi.replace("\"YY\"", "\"YYY\""));
    let mut text = String::from("[bus]\ncycle = \"1ms\"\n");
    for (position, name, esi, sim) in [
        (0, "junction", "junction.xml", ""),
        (
            1,
            "first",
            "esi/EPOS4.xml",
            "after = \"junction\"\nport = 1",
        ),
        (
            2,
            "second",
            "esi/EPOS4.xml",
            "after = \"junction\"\nport = 2",
        ),
    ] {
        let _ = write!(
            text,
            "[[device]]\nname = \"{name}\"\nesi = \"{esi}\"\nposition = {position}\nmode = \"csp\"\n\
             [device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 2000\n{LIMITS}\n\
             [device.sim]\n{sim}\n"
        );
    }
    text += "[[stop.group]]\nname = \"own\"\naxes = [\"first\"]\noutside = \"continue\"\n";
    text += "[[step]]\nenable = [\"second\"]\n[[step]]\ndwell = \"4s\"\n";
    bench.machine(&text)
}

/// ETG.1500, feature 1102. Without it, the clock of `second` would be 1,050 ns off: twice 500 ns
/// through the drive in the first branch, and 25 ns for its cable (`docs/network.md`).
#[test]
fn delays_are_measured_again_when_a_branch_disappears_and_returns() {
    let folder = tempfile::tempdir().expect("a folder");
    let off = "[[fault]]\nkind = \"power-off\"\ndevice = 1\nat = \"1s\"\nfor = \"1s\"\n";
    let (options, recording) = recorded(faults(off), folder.path());
    run(branches(), options).0.result.expect("the others run");
    let mut delays = Vec::new();
    for datagram in datagrams(&recording)
        .iter()
        .filter(|datagram| datagram.sent)
    {
        let delay = <[u8; 4]>::try_from(&datagram.data[..]).map(u32::from_le_bytes);
        if let (FPWR, 0x0928, Ok(delay)) = (datagram.command, datagram.register(), delay)
            && datagram.station() == 0x1002
        {
            delays.push(delay);
        }
    }
    // Bring-up may write it several times; afterwards it is written when it has changed.
    let [.., before, without, again] = delays[..] else {
        panic!("{delays:?}");
    };
    for (delay, expected) in [(without, before - 1_050), (again, before)] {
        assert!(delay.abs_diff(expected) <= 20, "{delays:?}");
    }
}

/// Returns the delays (0x0928) that a run writes, by station.
fn written_delays(text: &str) -> Vec<u32> {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut options, recording) = recorded(virtual_time(), folder.path());
    let mut machine = machine(text);
    machine.enable = false;
    machine.steps.clear();
    options.limit = Some(20_000_000);
    run(machine, options).0.result.expect("comes up");
    let mut delays = vec![None; 3];
    for datagram in datagrams(&recording) {
        let delay = <[u8; 4]>::try_from(&datagram.data[..]);
        if let (true, FPWR, 0x0928, Ok(delay)) =
            (datagram.sent, datagram.command, datagram.register(), delay)
        {
            delays[usize::from(datagram.station() - 0x1000)] = Some(u32::from_le_bytes(delay));
        }
    }
    delays
        .into_iter()
        .map(|delay| delay.expect("written"))
        .collect()
}

/// Beckhoff ESC data sheet, section I, 9.1.2: the delay of a device is the time that a frame takes
/// from the reference clock to it. Every start measures it, so that a changed cable is considered.
#[test]
fn each_start_measures_the_delays_again() {
    let text = axes(3);
    let before = written_delays(&text);
    // `docs/network.md`: 500 ns through a device, 25 ns for a cable.
    for (delay, expected) in before.iter().zip([0, 525, 1050]) {
        assert!(delay.abs_diff(expected) <= 20, "{before:?}");
    }
    let place = "position = 1\n";
    let longer = text.replace(place, &format!("{place}sim = {{ cable = \"2025ns\" }}\n"));
    let after = written_delays(&longer);
    for (delay, expected) in after.iter().zip([0, 2525, 3050]) {
        assert!(delay.abs_diff(expected) <= 20, "{after:?}");
    }
}
