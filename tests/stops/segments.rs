//! Hot-connect segments: an optional device with a number, and devices behind it without one.

use std::collections::BTreeSet;
use std::sync::Arc;

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::Machine;
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::session::{
    Attachments, Options, Outcome, Progress, run_attached, simulated_bus,
};
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::{Heard, faults};

use super::redundancy::swing_axes;
use super::returns::returned;

fn drive(name: &str, keys: &str) -> String {
    format!(
        "\n[[device]]\nname = \"{name}\"\nesi = \"esi/EPOS4.xml\"\nmode = \"csp\"\n{keys}\n\
         [device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 2000\n\
         limits = {{ position = [-100.0, 100.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }}\n"
    )
}

/// A drive with three ports and a segment of three at one of them.
fn text(port: u8) -> String {
    let mut text = "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n".to_owned();
    text += &drive("a0", "position = 0").replace("esi/EPOS4.xml", "junction.xml");
    let place = format!("id = 7\noptional = true\nsim = {{ after = \"a0\", port = {port} }}");
    text += &drive("head", &place);
    text += &drive("second", "behind = \"head\"");
    text += &drive("third", "behind = \"head\"");
    text + "\n[[stop.group]]\nname = \"segment\"\naxes = [\"head\", \"second\", \"third\"]\noutside = \"continue\"\n"
}

fn parse(text: &str) -> Machine {
    let bench = Bench::new();
    let junction = bench.read("esi/EPOS4.xml").replace("\"YY\"", "\"YYY\"");
    bench.write("junction.xml", &junction);
    bench.machine(text)
}

const STEPS: &str = "\n[[step]]\nenable = [\"a0\"]\n\n[[step]]\nmove = { a0 = 80.0 }\n\n[[step]]\nreset = [\"head\"]\n\
    \n[[step]]\nenable = [\"head\", \"second\", \"third\"]\n\n[[step]]\nmove = { a0 = 1.0, head = 2.0, second = 3.0, third = 4.0 }\n";

/// Runs a machine on a bus with a segment at another port.
fn run_at(port: u8, text: &str, options: Options) -> (Outcome, Heard) {
    options.clock.enter();
    let bus = parse(&self::text(port));
    let bus = simulated_bus(&bus, 1, options.faults.as_ref(), None).expect("a bus");
    let attachments = Attachments {
        link: Some(Box::new(SimLink::new(bus))),
        ..Attachments::default()
    };
    let (mut heard, stop) = (Heard::default(), Arc::<CancelToken>::default());
    let outcome = run_attached(parse(text), options, stop, &mut heard, attachments);
    (outcome, heard)
}

/// The devices of the bus that have no power until a time; 1 is the head.
fn absent(devices: &[usize], until: &str) -> String {
    let each = devices.iter().map(|device| {
        format!("[[fault]]\nkind = \"absent\"\ndevice = {device}\nfor = \"{until}\"\n")
    });
    each.collect()
}

fn names(heard: &Heard) -> Vec<String> {
    let mut names: Vec<_> = returned(heard).into_iter().map(|(name, ..)| name).collect();
    names.sort_unstable();
    names
}

#[test]
fn a_segment_appears_at_any_port_as_a_whole_or_piece_by_piece() {
    let all = ["head", "second", "third"];
    for port in [1, 2] {
        for (script, expected) in [
            (String::new(), &all[..0]),
            (absent(&[1, 2, 3], "1s"), &all),
            // The others are in reach once the head is there.
            (absent(&[1], "1s"), &all),
            (absent(&[3], "1s"), &all[2..]),
            (absent(&[2], "1s"), &all[1..]),
            (
                absent(&[1], "1s") + &absent(&[2], "1.5s") + &absent(&[3], "2s"),
                &all,
            ),
        ] {
            let text = text(1) + STEPS;
            let (outcome, heard) = run_at(port, &text, faults(&script));
            let warnings = heard.warnings();
            outcome
                .result
                .unwrap_or_else(|error| panic!("port {port}, {script}: {error}; {warnings:?}"));
            assert_eq!(
                names(&heard),
                expected,
                "port {port}, {script}: {warnings:?}"
            );
            let axes = outcome.summary.expect("a summary").axes;
            let targets: Vec<_> = axes.iter().map(|axis| axis.target_position).collect();
            assert_eq!(targets, [1.0, 2.0, 3.0, 4.0], "port {port}, {script}");
        }
    }
}

/// The device at a place of the segment is another one than in the file.
#[test]
fn a_segment_with_another_device_is_not_driven() {
    let calm = STEPS.split("\n[[step]]\nreset").next().expect("a part");
    for (device, name) in [(2, "second"), (3, "third")] {
        let script = absent(&[1, 2, 3], "500ms")
            + &format!("[[fault]]\nkind = \"swap\"\nproduct = 0x77\ndevice = {device}\n");
        let (outcome, heard) = run_at(1, &(text(1) + calm), faults(&script));
        let warnings = heard.warnings();
        outcome
            .result
            .unwrap_or_else(|error| panic!("{name}: {error}; {warnings:?}"));
        assert!(!names(&heard).contains(&name.to_owned()), "{warnings:?}");
        let refused = warnings
            .iter()
            .find(|text| text.contains(&format!("`{name}` does not return")));
        assert!(refused.is_some(), "{warnings:?}");
        let released = |progress: &Progress| matches!(progress, Progress::GroupReleased { .. });
        assert!(!heard.0.iter().any(released), "{name}");
    }
    // It is there as the machine starts.
    let script = "[[fault]]\nkind = \"swap\"\nproduct = 0x77\ndevice = 2\n";
    let (outcome, _) = run_at(1, &text(1), faults(script));
    let error = outcome.result.expect_err("another device").to_string();
    assert!(error.contains("`second`"), "{error}");
}

/// Devices of a segment lose their power or their cables at random. The drive outside receives what it
/// receives in an undisturbed run, and the segment is in Op again at the end. `ECAXIS_TRIALS` sets the
/// number of seeds.
#[test]
fn a_segment_comes_and_goes_without_any_effect_on_the_others() {
    const CYCLES: usize = 16_000;
    let trials = std::env::var("ECAXIS_TRIALS").map_or(16, |n| n.parse().expect("a number"));
    let machine = parse(&text(2));
    let swing = |script: &str, seed| {
        let options = Options {
            seed,
            ..faults(script)
        };
        swing_axes(machine.clone(), 1, options, CYCLES)
    };
    let (calm, _) = swing(&absent(&[1, 2, 3], "60s"), 1);
    for seed in 1..=trials {
        let mut state = 0x9e37_79b9_7f4a_7c15_u64.wrapping_mul(seed) | 1;
        let mut random = |below: u64| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            state % below
        };
        let mut script = String::new();
        let mut at = random(2_000);
        while at < 7_000 {
            let (device, lasts) = (1 + random(3), 20 + random(1_500));
            let kind =
                ["kind = \"power-off\"", "kind = \"link-break\"\nport = 0"][random(2) as usize];
            script += &format!(
                "[[fault]]\n{kind}\ndevice = {device}\nat = \"{at}ms\"\nfor = \"{lasts}ms\"\n"
            );
            at += random(2_500);
        }
        let (seen, heard) = swing(&script, seed);
        // A lost frame shows in the next cycles.
        let same = seen.commanded.iter().zip(&calm.commanded).enumerate();
        let other = same.filter(|(_, (a, b))| a != b).map(|(n, _)| n);
        let mut other = other.filter(|n| !seen.is_stale_before(*n));
        assert_eq!(other.next(), None, "seed {seed}: {script}");
        let events: Vec<String> = heard
            .0
            .iter()
            .filter_map(|progress| match progress {
                Progress::DeviceLost { device, .. } => Some(format!("{} lost", device.name)),
                Progress::DeviceReturned {
                    device, after_ns, ..
                } => Some(format!("{} after {after_ns}", device.name)),
                Progress::UnknownDevice(device) => Some(device.to_string()),
                _ => None,
            })
            .collect();
        let mut lost = BTreeSet::new();
        for progress in &heard.0 {
            match progress {
                Progress::DeviceLost { device, .. } => lost.insert(&device.name),
                Progress::DeviceReturned { device, .. } => lost.remove(&device.name),
                _ => continue,
            };
        }
        assert!(
            lost.is_empty(),
            "seed {seed}: {lost:?}: {events:?} {:?}; {script}",
            heard.warnings()
        );
    }
}
