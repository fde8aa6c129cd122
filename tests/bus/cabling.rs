//! Cables: IN and OUT swapped at a device, propagation delays.

use ecaxis_test_support::recordings::{FPWR, datagrams};
use ecaxis_test_support::{axes, machine, recorded, run, run_badly, virtual_time};

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
