//! Long segments: hundreds of SubDevices on one simulated bus.

use std::fmt::Write as _;
use std::time::Instant;

use ecaxis_master::session::Progress;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::recordings::{FRMW, Frame, frames};
use ecaxis_test_support::{assert_contains, machine, recorded, run, virtual_time};

/// A segment of drives among I/O blocks: every `1 / share` device is a drive with SYNC0.
fn mixed(devices: usize, share: usize) -> (String, usize) {
    let mut text = "[bus]\nnic = \"sim\"\ncycle = \"4ms\"\n".to_owned();
    let mut moves = Vec::new();
    for n in 0..devices {
        if n % share > 0 {
            let _ = write!(
                text,
                "[[device]]\nname = \"io{n}\"\nesi = \"esi/IO8.xml\"\nposition = {n}\n"
            );
            continue;
        }
        let _ = write!(
            text,
            "[[device]]\nname = \"a{n}\"\nesi = \"esi/EPOS4.xml\"\nposition = {n}\nmode = \"csp\"\n\
             [device.axis]\nunit = \"turn\"\nencoder = 2000\n\
             limits = {{ velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }}\n"
        );
        moves.push(format!("a{n} = {}.0", n % 7 + 1));
    }
    let _ = write!(text, "[[step]]\nmove = {{ {} }}\n", moves.join(", "));
    (text, moves.len())
}

/// Returns the bytes of a frame's datagrams, with their headers and working counters.
fn datagram_bytes(frame: &Frame) -> usize {
    frame.datagrams.iter().map(|d| d.data.len() + 12).sum()
}

/// ETG.1000.4: a segment has up to 65,535 SubDevices. A frame carries 1,498 bytes of datagrams, so a
/// long image takes several frames.
#[test]
fn drives_among_500_devices_come_up_and_move() {
    let (text, drives) = mixed(500, 10);
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(virtual_time(), folder.path());
    let begin = Instant::now();
    let (outcome, heard) = run(machine(&text), options);
    let host = begin.elapsed();
    outcome.result.expect("runs");
    let summary = outcome.summary.expect("a summary");

    let steps = heard.0.iter().find_map(|progress| match progress {
        Progress::BringUpTimes(steps) => Some(steps),
        _ => None,
    });
    let steps = steps.expect("the steps of the bring-up");
    let virtual_ns = steps.iter().map(|step| step.began_ns + step.took_ns).max();
    let sent: Vec<Frame> = frames(&path).into_iter().filter(|f| f.sent).collect();
    let is_image = |frame: &Frame| frame.image().is_some();
    let bring_up = sent.iter().position(is_image).expect("cyclic frames");
    let cyclic: Vec<&Frame> = sent.iter().filter(|frame| frame.cyclic).collect();
    // The cycles are equal but for the diagnostics.
    let first = cyclic.iter().rposition(|f| f.datagrams[0].command == FRMW);
    let cycle = &cyclic[first.expect("the system time in every cycle")..];
    let datagrams: usize = cycle.iter().map(|frame| frame.datagrams.len()).sum();
    let bytes: usize = cycle.iter().map(|frame| datagram_bytes(frame)).sum();
    println!(
        "{} devices, {drives} of them drives: in Op after {} ms of virtual time; \
         {bring_up} frames before the first process data; a cycle has {} frames with {datagrams} \
         datagrams, {bytes} bytes; the whole run took {} ms, {} cycles",
        summary.devices,
        virtual_ns.unwrap_or_default() / 1_000_000,
        cycle.len(),
        host.as_millis(),
        summary.counters.cycles,
    );
    for step in steps {
        println!("  {:28} {:>8} µs", step.name, step.took_ns / 1_000);
    }
    assert_eq!(summary.counters.wkc_errors, 0);
    assert_eq!(summary.counters.lost_frames, 0);
    assert_eq!(summary.axes.len(), drives);
    for axis in &summary.axes {
        let n: usize = axis.name[1..].parse().expect("its position");
        assert_eq!(axis.final_position.round(), (n % 7 + 1) as f64, "{axis:?}");
    }
    for frame in &sent {
        assert!(frame.len <= 1514, "a frame of {} bytes", frame.len);
    }
}

/// More devices than ethercrab's default of 128.
#[test]
fn a_segment_of_130_blocks_without_axes_comes_up() {
    let mut text = "[bus]\nnic = \"sim\"\ncycle = \"4ms\"\n".to_owned();
    for n in 0..130 {
        let _ = write!(
            text,
            "[[device]]\nname = \"io{n}\"\nesi = \"esi/IO8.xml\"\nposition = {n}\n"
        );
    }
    let bench = Bench::new();
    bench.write("machine.toml", &text);
    let run = ["run", "machine.toml", "--sim", "--virtual", "--for", "1s"];
    let ran = bench.ecaxis(&run).exits(0);
    assert_contains(&ran.out, &["130 SubDevices"]);
}
