//! Rings with branches, with optional devices and with a pipelined exchange.

use std::sync::{Arc, Mutex};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::Machine;
use ecaxis_master::link::redundant::RedundantLink;
use ecaxis_master::link::sim::{SimLink, SimRing};
use ecaxis_master::session::{run_on, simulated_bus};
use ecaxis_sim::SecondPort;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::{Heard, axes, faults, machine, run, virtual_time};

use super::redundancy::{WatchedRing, break_at, break_at_port, reports, swing_axes};
use super::returns::returned;

const CYCLE_NS: u64 = 1_000_000;
const DRIVES: usize = 4;

/// Breaks each place of a ring in each phase of the cycle. Returns the most cycles that one break or
/// repair has cost.
fn break_each(machine: &Machine, drives: usize, places: &[(usize, u8)]) -> usize {
    const FIRST: u64 = 2_000_000_000;
    const EACH: u64 = 300_000_000;
    const OUTAGE: u64 = 150_000_000;
    const PHASES: u64 = 100;
    let cycles = 2_500 + places.len() * 300;
    let (calm, _) = swing_axes(machine.clone(), drives, virtual_time(), cycles);
    assert_eq!(calm.stale, [0; 0]);
    let mut most = 0;
    for phase in 0..PHASES {
        let times = (0..).map(|n| FIRST + n * EACH + phase * CYCLE_NS / PHASES);
        let breaks = places.iter().zip(times.clone());
        let script: String = breaks
            .map(|(place, at)| break_at_port(*place, at, OUTAGE))
            .collect();
        let (seen, heard) = swing_axes(machine.clone(), drives, faults(&script), cycles);
        let both = seen.commanded.iter().zip(&calm.commanded);
        let other: Vec<_> = both
            .enumerate()
            .filter(|(_, (a, b))| a != b)
            .map(|(n, _)| n)
            .collect();
        assert!(
            other.is_empty(),
            "phase {phase}: {} cycles from {:?}; stale {:?}, began {}",
            other.len(),
            other.first(),
            seen.stale,
            seen.began
        );
        let reports = reports(&heard);
        assert_eq!(reports.len(), 2 * places.len(), "{reports:#?}");
        for at in times.take(places.len()).flat_map(|at| [at, at + OUTAGE]) {
            let during = |s: &&u64| **s + CYCLE_NS > at && **s < at + OUTAGE;
            most = most.max(seen.stale.iter().filter(during).count());
        }
    }
    most
}

/// The answers of a cycle are taken in the next one.
#[test]
fn a_pipelined_ring_outlasts_each_break() {
    let text = axes(DRIVES).replacen(
        "nic = \"sim\"\n",
        "nic = \"sim\"\nredundant = \"sim2\"\nexchange = \"pipelined\"\n",
        1,
    );
    let places = [(0, 0), (1, 0), (2, 0), (3, 0), (3, 1)];
    let most = break_each(&machine(&text), DRIVES, &places);
    println!("at most {most} cycles lost");
    assert!(most <= 1, "{most}");
}

/// The drive `a1` leads to `a2` at port 3, a branch, and to `a3` at port 1.
fn branched() -> Machine {
    let bench = Bench::new();
    let junction = bench.read("esi/EPOS4.xml").replace("\"YY\"", "\"YY Y\"");
    bench.write("junction.xml", &junction);
    let text = axes(DRIVES).replacen(
        "nic = \"sim\"\n",
        "nic = \"sim\"\nredundant = \"sim2\"\n",
        1,
    );
    let at = text.find("name = \"a1\"").expect("a drive");
    let (head, tail) = text.split_at(at);
    let tail = tail.replacen("esi/EPOS4.xml", "junction.xml", 1);
    let tail = tail.replacen(
        "position = 2\n",
        "position = 2\nsim = { after = \"a1\", port = 3 }\n",
        1,
    );
    let tail = tail.replacen(
        "position = 3\n",
        "position = 3\nsim = { after = \"a1\", port = 1 }\n",
        1,
    );
    bench.machine(&(head.to_owned() + &tail))
}

#[test]
fn a_ring_with_a_branch_outlasts_each_break() {
    let machine = branched();
    let places = [(0, 0), (1, 0), (3, 0), (3, 1)];
    let most = break_each(&machine, DRIVES, &places);
    println!("at most {most} cycles lost");
    assert!(most <= 1, "{most}");
    for (place, text) in [
        ((1, 0), "between `a0` and `a1`"),
        ((3, 0), "between `a1` and `a3`"),
        ((3, 1), "between `a3` and the second interface"),
    ] {
        let script = break_at_port(place, 2_000_000_000, 500_000_000);
        let (seen, heard) = swing_axes(machine.clone(), DRIVES, faults(&script), 3_000);
        assert!(seen.stale.len() <= 2, "{:?}", seen.stale);
        let reports = reports(&heard);
        assert!(reports[0].contains(text), "{reports:?}");
    }
}

/// A broken cable of the branch stops the machine, which needs the drive there.
#[test]
fn a_broken_branch_of_a_ring_is_no_broken_ring() {
    let script = break_at_port((2, 0), 2_000_000_000, 500_000_000);
    let (outcome, heard) = run(branched(), faults(&script));
    let error = outcome.result.expect_err("a drive is lost").to_string();
    assert!(error.contains("a2"), "{error}");
    assert_eq!(reports(&heard), [""; 0]);
}

/// The ring of a0, a1, t, a2 and a3. The tool `t` is optional.
fn with_tool(keys: &str) -> Machine {
    let text = axes(DRIVES).replacen(
        "nic = \"sim\"\n",
        "nic = \"sim\"\nredundant = \"sim2\"\n",
        1,
    );
    let text = text.replace("position = 2\n", "alias = 2\n");
    let text = text.replace("position = 3\n", "alias = 3\n");
    let at = text.find("[[device]]\nname = \"a2\"").expect("a drive");
    let (before, behind) = text.split_at(at);
    let limits = "limits = { position = [-100.0, 100.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }";
    let tool = format!(
        "[[device]]\nname = \"t\"\nesi = \"esi/EPOS4.xml\"\nid = 7\noptional = true\nmode = \"csp\"\n{keys}\
         [device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 2000\n{limits}\n\
         \n[[stop.group]]\nname = \"t\"\naxes = [\"t\"]\noutside = \"continue\"\n\n"
    );
    machine(&format!("{before}{tool}{behind}"))
}

/// An optional device in a ring gets a propagation delay of its own, and those behind it new ones.
#[test]
fn clocks_keep_in_step_with_an_optional_device_of_a_ring() {
    let appears = "[[fault]]\nkind = \"absent\"\ndevice = 2\nfor = \"2s\"\n";
    let leaves = "[[fault]]\nkind = \"absent\"\ndevice = 2\nat = \"5s\"\nfor = \"2s\"\n";
    // One of its cables is broken as it appears.
    let broken = break_at_port((2, 0), 0, 3_500_000_000);
    // The delay of the broken cable is taken to be that of the others.
    let long = "sim = { cable = \"2us\" }\n";
    for (name, keys, script) in [
        ("appears", long, appears.to_owned()),
        ("returns", long, leaves.to_owned()),
        ("appears in a broken ring", "", format!("{appears}{broken}")),
    ] {
        let machine = with_tool(keys);
        let options = ecaxis_master::session::Options {
            repeat: Some(5),
            ..faults(&script)
        };
        options.clock.enter();
        let parsed = options.faults.as_ref();
        let bus = simulated_bus(&machine, 1, parsed, Some(SecondPort::Listens)).expect("a ring");
        let spreads = Arc::<Mutex<_>>::default();
        let ends = WatchedRing {
            ring: SimRing(SimLink::new(bus)),
            spreads: Arc::clone(&spreads),
        };
        let link = Box::new(RedundantLink::new(Box::new(ends), CYCLE_NS / 2));
        let (mut heard, stop) = (Heard::default(), Arc::<CancelToken>::default());
        let outcome = run_on(link, machine, options, stop, &mut heard);
        let (warnings, reports) = (heard.warnings(), reports(&heard));
        outcome
            .result
            .unwrap_or_else(|error| panic!("{name}: {error}; {warnings:?}; {reports:?}"));
        let open = reports
            .iter()
            .find(|text| text.contains("second interface"));
        assert_eq!(open, None, "{name}: a measurement breaks no cable");
        let names: Vec<_> = returned(&heard)
            .into_iter()
            .map(|(name, ..)| name)
            .collect();
        assert_eq!(names, ["t"], "{name}: {warnings:?}");
        let short = warnings.iter().find(|text| text.contains("for short"));
        assert_eq!(short, None, "{name}");
        let spreads = spreads.lock().expect("one thread");
        let last = spreads.last().expect("cycles").0;
        let settled = spreads.iter().filter(|(at, _)| *at > last - 500_000_000);
        let most = settled.map(|(_, ns)| *ns).max().expect("cycles");
        println!("{name}: {most} ns apart at the end; {reports:?}");
        assert!(most < 200, "{name}: {most} ns");
    }
}

/// A cable breaks while the delays are measured, which takes 2 ms of the bring-up.
#[test]
fn a_break_during_the_measurement_of_delays_is_outlasted() {
    let text = axes(8).replacen(
        "nic = \"sim\"\n",
        "nic = \"sim\"\nredundant = \"sim2\"\n",
        1,
    );
    let machine = machine(&text);
    let (outcome, heard) = run(machine.clone(), virtual_time());
    outcome.result.expect("an undisturbed run");
    let _ = heard;
    for cable in [0, 4, 8] {
        for at_us in (30_000..60_000).step_by(500) {
            let script = break_at(cable, at_us * 1_000, 60_000_000_000);
            let (outcome, heard) = run(machine.clone(), faults(&script));
            let warnings = heard.warnings();
            outcome.result.unwrap_or_else(|error| {
                panic!("cable {cable} at {at_us} µs: {error}; {warnings:?}")
            });
        }
    }
}
