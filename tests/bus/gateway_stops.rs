//! Failures on both sides of a gateway in motion, and the limits that hold on the CAN network: read
//! from the frames of the simulated CAN network and the outputs on EtherCAT.

use ecaxis_axis::State;
use ecaxis_ecat::index::DeviceIndex;
use ecaxis_master::config::Machine;
use ecaxis_master::session::Options;
use ecaxis_sim::gateway::{CanFrame, CanTrace};
use ecaxis_test_support::{
    assert_contains, faults, machine, run, run_badly, run_well, virtual_time,
};
use proptest::prelude::*;

use super::gateway_axes::{GATEWAY, mixed, with_program};

const MS: u64 = 1_000_000;
const MOVE: &str =
    "[[step]]\nmove = { feed = 50.0, lift = 50.0, table = 300.0, x = 50.0 }\nspeed = 0.3\n";
/// The time of each fault.
const AT: u64 = 2000 * MS;

/// Lets the machine's gateway collect its frames.
fn traced(machine: &mut Machine) -> CanTrace {
    let gateway = machine.devices[GATEWAY].sim.gateway.as_mut();
    let trace = &mut gateway.expect("a gateway").trace;
    trace.get_or_insert_default().clone()
}

/// Returns time and Controlword of each PDO 1 to a node.
fn controlwords(frames: &[(u64, CanFrame)], node: u16) -> Vec<(u64, u16)> {
    let own = frames.iter().filter(|(_, frame)| frame.id == 0x200 + node);
    own.map(|(at, frame)| (*at, u16::from_le_bytes([frame.data()[0], frame.data()[1]])))
        .collect()
}

/// Returns time and position of each PDO 1 of a node.
fn positions(frames: &[(u64, CanFrame)], node: u16) -> Vec<(u64, i32)> {
    let own = frames.iter().filter(|(_, frame)| frame.id == 0x180 + node);
    own.map(|(at, frame)| {
        let data = frame.data();
        (
            *at,
            i32::from_le_bytes([data[2], data[3], data[4], data[5]]),
        )
    })
    .collect()
}

/// Returns the time of the last change of a node's reported position, and the time for which it was
/// reported afterwards.
fn rest(frames: &[(u64, CanFrame)], node: u16) -> (u64, u64) {
    let positions = positions(frames, node);
    let (end, last) = *positions.last().expect("reports");
    // A drive that holds a position moves by a count.
    let moved = positions.iter().rev().find(|(_, p)| (p - last).abs() > 2);
    let moved = moved.expect("a motion").0;
    (moved, end - moved)
}

/// Whether the quick stop is seen on the CAN network or in the outputs on EtherCAT, after which the
/// network carries nothing.
#[derive(Clone, Copy, PartialEq)]
enum Seen {
    OnCan(u16),
    ByEvent,
}

/// Every failure stops the group of the nodes within 100 ms, and the report names node and cause.
#[test]
fn each_failure_stops_the_group_within_100_ms_and_is_named() {
    for (kind, keys, text, seen) in [
        (
            "node-silent",
            "node = 2\n",
            &["`lift`", "node 2", "in error"][..],
            Seen::OnCan(2),
        ),
        (
            "heartbeat-lost",
            "node = 2\n",
            &["`lift`", "node 2", "in error"],
            Seen::OnCan(2),
        ),
        (
            "node-error",
            "node = 3\n",
            &["`table`", "node 3", "in error"],
            Seen::OnCan(3),
        ),
        (
            "control-ignored",
            "",
            &["node 1", "does not acknowledge"],
            Seen::OnCan(1),
        ),
        (
            "gateway-reset",
            "",
            &["node 1", "in no known state"],
            Seen::ByEvent,
        ),
        ("can-open", "", &["node 1", "in error"], Seen::ByEvent),
    ] {
        let script = format!("[[fault]]\nkind = \"{kind}\"\ndevice = 2\n{keys}at = \"2s\"\n");
        let mut machine = with_program(MOVE);
        let trace = traced(&mut machine);
        let (error, summary) = run_badly(machine, faults(&script));
        println!("{kind}: {error}");
        assert_contains(&error, text);
        let summary = summary.expect("the cycle has run");
        let frames = trace.take();
        let took = if let Seen::OnCan(node) = seen {
            // The lost node, whose frames the others acknowledge.
            let stop = controlwords(&frames, node).into_iter();
            let mut stop = stop.filter(|(at, word)| *at > AT && *word == 0x0002);
            stop.next().expect("a quick stop").0 - AT
        } else {
            let stop = summary.events.iter().find(|event| event.failure);
            let last = positions(&frames, 1).into_iter();
            // The bus came up before the first cycle, so this time is too long, if anything.
            let begin = last.map(|(at, _)| at).filter(|at| *at < AT).max();
            println!("  last report at {begin:?}, stop at {stop:?}");
            let at = (stop.expect("a stop").at_s * 1e9) as u64 + first_cycle(&frames);
            at.saturating_sub(AT)
        };
        println!("{kind}: stopped {} ms after the fault", took / MS);
        assert!(took <= 100 * MS, "{kind}: {took} ns");
        for name in ["x", "y"] {
            let axis = summary.axes.iter().find(|axis| axis.name == name);
            let axis = axis.expect("an axis");
            assert_eq!(axis.final_state, State::SwitchOnDisabled.to_string());
            assert_eq!((&axis.fault, &axis.trip), (&None, &None));
        }
        let [gateway] = &summary.gateways[..] else {
            panic!("{:?}", summary.gateways)
        };
        assert!(
            gateway.nodes.iter().any(|node| node.losses > 0),
            "{gateway:?}"
        );
    }
}

/// The first cycle in the time of the CAN network: the gateway is started in one of the next
/// cycles.
fn first_cycle(frames: &[(u64, CanFrame)]) -> u64 {
    let started = frames
        .iter()
        .find(|(_, f)| f.id == 0 && f.data().first() == Some(&1));
    started.expect("the nodes are started").0
}

/// Whatever ends the connection in motion, every node is at rest soon.
#[test]
fn every_node_comes_to_rest_after_the_end_and_after_a_lost_cable() {
    let cable = "[[fault]]\nkind = \"silent\"\nat = \"2s\"\n";
    let ctrl_c = Options {
        limit: Some(2000 * MS),
        ..virtual_time()
    };
    for (cause, options, ends) in [
        ("time limit", ctrl_c, true),
        ("cable lost", faults(cable), false),
    ] {
        let mut machine = with_program(MOVE);
        let trace = traced(&mut machine);
        let (outcome, _) = run(machine, options);
        assert_eq!(outcome.result.is_ok(), ends, "{:?}", outcome.result);
        let frames = trace.take();
        for node in 1..=3 {
            let (moved, rest) = rest(&frames, node);
            let after = moved.saturating_sub(AT) / MS;
            println!(
                "{cause}: node {node} at rest {after} ms later, seen for {} ms",
                rest / MS
            );
            assert!(after <= 1000 && rest >= 10 * MS, "{cause}, node {node}");
        }
        // The last command to the network, if there still is one: PRE-OPERATIONAL for all nodes.
        let nmt = frames.iter().rev().find(|(_, frame)| frame.id == 0);
        let last = nmt.map(|(_, frame)| frame.data().to_vec());
        assert_eq!(last == Some(vec![0x80, 0]), ends, "{cause}: {last:x?}");
    }
}

/// Returns the largest step of a node's set-point, its largest change from step to step, and the
/// shortest time between two steps, with power.
fn largest(frames: &[(u64, CanFrame)], node: u16, sync_ns: u64) -> (i32, i32, u64) {
    let (mut last, mut before) = (None::<(u64, i32)>, 0);
    let (mut step, mut change, mut shortest) = (0, 0, u64::MAX);
    for (at, frame) in frames.iter().filter(|(_, f)| f.id == 0x200 + node) {
        let data = frame.data();
        // Without power, the set-point follows the drive.
        if data[0] & 0x0f != 0x0f {
            (last, before) = (None, 0);
            continue;
        }
        let target = i32::from_le_bytes([data[2], data[3], data[4], data[5]]);
        let Some((then, previous)) = last else {
            last = Some((*at, target));
            continue;
        };
        if target == previous {
            continue;
        }
        let (now, passed) = (target - previous, at - then);
        // A pause of a whole SYNC is a step of 0.
        if passed > sync_ns * 8 / 5 {
            before = 0;
        } else {
            shortest = shortest.min(passed);
        }
        step = step.max(now.abs());
        change = change.max((now - before).abs());
        (last, before) = (Some((*at, target)), now);
    }
    (step, change, shortest)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, ..ProptestConfig::default() })]

    /// The limits of the axes hold in every SYNC period on the CAN network, for random moves.
    #[test]
    fn limits_hold_on_the_can_network_from_sync_to_sync(
        sync_ms in prop::sample::select(vec![3u32, 4, 5, 8, 10, 20]),
        moves in prop::collection::vec((-50.0f64..50.0, -300.0f64..300.0, 0.05f64..=1.0), 1..4),
    ) {
        let program: String = moves.iter().map(|(feed, table, speed)| {
            format!("[[step]]\nmove = {{ feed = {feed:.2}, table = {table:.1} }}\nspeed = {speed:.2}\n")
        }).collect();
        let text = mixed();
        let end = text.find("[[step]]").expect("a program");
        let text = text[..end].replace("\"4ms\"", &format!("\"{sync_ms}ms\""));
        let mut machine = machine(&format!("{text}{program}"));
        let trace = traced(&mut machine);
        run_well(machine, virtual_time());
        let frames = trace.take();
        let period = f64::from(sync_ms) * 1e-3;
        // Counts a unit, velocity and acceleration limits.
        for (node, counts, velocity, acceleration) in
            [(1, 400.0, 50.0, 250.0), (3, 2000.0 / 36.0, 360.0, 1800.0)]
        {
            let (step, change, shortest) = largest(&frames, node, u64::from(sync_ms) * MS);
            let (v, a) = (velocity * counts * period, acceleration * counts * period * period);
            // A step may be one cycle early, and one frame of another node late.
            let least = u64::from(sync_ms) * MS - 1_600_000;
            prop_assert!(shortest >= least, "node {}: {} ns from step to step", node, shortest);
            prop_assert!(f64::from(step) <= v + 1.0, "node {}: a step of {} of {:.1}", node, step, v);
            prop_assert!(
                f64::from(change) <= a + 2.0,
                "node {}: a step that changes by {} of {:.1}", node, change, a
            );
        }
    }
}

/// With bit 3 of 0x1F80 the gateway starts no node: ecaxis starts one after the other.
#[test]
fn nodes_that_the_gateway_does_not_start_are_started_one_by_one() {
    let text = mixed();
    let end = text.find("[[step]]").expect("a program");
    let text = text[..end].replace("sync     = \"4ms\"", "sync = \"4ms\"\nstart_up = 9");
    let mut machine = machine(&format!(
        "{text}[[step]]\nmove = {{ feed = 5.0, table = 20.0 }}\n"
    ));
    let trace = traced(&mut machine);
    run_well(machine, virtual_time());
    let frames = trace.take();
    for node in 1..=3 {
        let started = frames
            .iter()
            .any(|(_, f)| f.id == 0 && f.data() == [1, node]);
        assert!(started, "node {node}");
    }
}

/// A machine with one gateway without nodes.
fn sized(type_name: &str, can: &str) -> String {
    format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"gateway\"\n\
         esi = \"esi/gateway.xml\"\ntype = \"{type_name}\"\nposition = 0\n[device.can]\n{can}\n\
         [[step]]\ndwell = \"50ms\"\n"
    )
}

#[test]
fn gateways_of_all_sizes_reach_op() {
    for size in [2, 16, 64, 130, 512] {
        let machine = machine(&sized(
            "GW64",
            &format!("inputs = {size}\noutputs = {size}"),
        ));
        let layout = &machine.devices[DeviceIndex(0)].selection.layout;
        assert_eq!((layout.rx_bytes(), layout.tx_bytes()), (size, size));
        let summary = run_well(machine, virtual_time());
        assert_eq!(summary.counters.wkc_errors, 0, "{size} bytes");
    }
}

/// The gateway has other sizes than the file: both are named.
#[test]
fn a_gateway_of_another_size_is_refused_with_both_sizes() {
    let mut machine = machine(&sized("GW64", "inputs = 130\noutputs = 130"));
    let gateway = machine.devices[DeviceIndex(0)].sim.gateway.as_mut();
    let gateway = gateway.expect("a gateway");
    (gateway.input_size, gateway.output_size) = (Some(16), Some(130));
    let (error, _) = run_badly(machine, virtual_time());
    println!("{error}");
    assert_contains(&error, &["gateway", "130", "16"]);
}

/// The node refuses an object of its configuration, so the gateway does not start it.
#[test]
fn a_node_that_is_not_configured_is_named() {
    let machine = machine(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"gateway\"\nesi = \"esi/gateway.xml\"\n\
         type = \"GW64\"\nposition = 0\n[device.can]\nsync = \"4ms\"\n[[device.node]]\nid = 6\n\
         drive = \"EPOS 24/1\"\nguarding = \"50ms\"\n\
         outputs = [{ pdo = 1, at = 12, objects = [\"0x6040\", \"0x2062\"] }, { pdo = 3, at = 18 }]\n\
         inputs = [{ pdo = 1, at = 12, objects = [\"0x6041\", \"0x6064\"] }, { pdo = 3, at = 18 }]\n\
         objects = [{ index = 0x1400, sub = 2, value = 0xFD, type = \"u8\" }]\n\
         [device.node.axis]\nname = \"b\"\nencoder = 2000\n\
         limits = { velocity = 50.0, acceleration = 250.0 }\n[[step]]\nmove = { b = 5.0 }\n",
    );
    let (error, _) = run_badly(machine, virtual_time());
    println!("{error}");
    let parts = [
        "`b`",
        "does not reach Operation enabled",
        "node 6 on its CAN network is",
    ];
    assert_contains(&error, &parts);
}
