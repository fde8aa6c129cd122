//! Axes of CANopen drives behind a gateway, on the simulated bus.

use ecaxis_axis::State;
use ecaxis_ecat::index::DeviceIndex;
use ecaxis_master::config::Machine;
use ecaxis_master::rt::image;
use ecaxis_master::session::Options;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::{
    assert_contains, faults, load, machine, recorded, root, run_badly, run_well, virtual_time,
};

pub(super) const GATEWAY: DeviceIndex = DeviceIndex(2);
/// The places of the three nodes in the gateway's process data: Controlword and 0x2062, or
/// Statusword and 0x6064. The Controlword of PDO 3 follows.
const NODES: [usize; 3] = [2, 11, 20];

pub(super) fn mixed() -> String {
    std::fs::read_to_string(root().join("configs/mixed.toml")).expect("our file")
}

/// Returns the mixed machine with another program.
pub(super) fn with_program(program: &str) -> Machine {
    let text = mixed();
    let end = text.find("[[step]]").expect("a program");
    machine(&format!("{}{program}", &text[..end]))
}

/// The process data of the gateway in one cycle.
struct Cycle {
    outputs: Vec<u8>,
    inputs: Vec<u8>,
}

impl Cycle {
    fn target(&self, node: usize) -> i32 {
        number(&self.outputs[NODES[node] + 2..])
    }

    fn actual(&self, node: usize) -> i32 {
        number(&self.inputs[NODES[node] + 2..])
    }

    /// Returns the Controlword in PDO 1 and in PDO 3.
    fn controlwords(&self, node: usize) -> [u8; 2] {
        let at = NODES[node];
        [self.outputs[at], self.outputs[at + 6]]
    }
}

fn number(bytes: &[u8]) -> i32 {
    i32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])
}

/// Returns the gateway's process data of every cycle of a recording.
fn cycles(machine: &Machine, recording: &std::path::Path) -> Vec<Cycle> {
    cycles_of(machine, recording, GATEWAY)
}

fn cycles_of(machine: &Machine, recording: &std::path::Path, device: DeviceIndex) -> Vec<Cycle> {
    let plan = image::of(&machine.rt_config()).expect("fits");
    let region = plan.regions[device].expect("process data");
    let images = process_images(recording).into_iter();
    let images = images.filter(|(sent, _)| sent.len() >= region.offset + region.out_len);
    images
        .map(|(sent, back)| Cycle {
            outputs: sent[region.offset..region.offset + region.out_len].to_vec(),
            inputs: back[region.offset..region.offset + region.in_len].to_vec(),
        })
        .collect()
}

#[test]
fn axes_of_both_networks_run_one_program() {
    let summary = run_well(load("mixed.toml"), virtual_time());
    assert_eq!(summary.counters.wkc_errors, 0);
    let names: Vec<&str> = summary.axes.iter().map(|a| a.name.as_str()).collect();
    assert_eq!(names, ["x", "y", "feed", "lift", "table"]);
    for axis in &summary.axes {
        println!("{}: {} at the end", axis.name, axis.final_position);
        assert!(axis.final_position.abs() < 0.2, "{axis:?}");
        assert_eq!(axis.final_state, State::SwitchOnDisabled.to_string());
        assert_eq!((&axis.fault, &axis.trip), (&None, &None));
    }
}

/// The mixed machine whose first node has the set-points of both position modes.
fn with_profiles(program: &str) -> String {
    let text = mixed();
    let end = text.find("[[step]]").expect("a program");
    // 0x607A arrives with the Controlword whose bit 4 validates it; 0x2062 has a PDO of its own.
    let outputs =
        "objects = [\"0x6040\", \"0x607A\"] }, { pdo = 2, at = 29, objects = [\"0x2062\"] }, ";
    let text = text[..end].replacen("objects = [\"0x6040\", \"0x2062\"] }, ", outputs, 1);
    format!("{text}{program}")
}

#[test]
fn a_profile_move_passes_the_handshake_over_the_dead_time() {
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(virtual_time(), folder.path());
    let machine = machine(&with_profiles(
        "[[step]]\nmove = { feed = 5.0 }\n[[step]]\nmode = { feed = \"pp\" }\n\
         [[step]]\nmove = { feed = 25.0, lift = 10.0 }\n[[step]]\nmove_by = { feed = -12.0 }\n\
         [[step]]\nmode = { feed = \"csp\" }\n[[step]]\nmove = { feed = 3.0 }\nspeed = 0.5\n",
    ));
    let summary = run_well(machine.clone(), options);
    let feed = summary.axes.iter().find(|axis| axis.name == "feed");
    assert!((feed.expect("an axis").final_position - 3.0).abs() < 0.05);
    let cycles = cycles(&machine, &path);
    let raised = |cycle: &Cycle| cycle.controlwords(0)[0] & 0x10 != 0;
    let edges = cycles.windows(2).enumerate();
    let edges: Vec<_> = edges
        .filter(|(_, pair)| !raised(&pair[0]) && raised(&pair[1]))
        .map(|(n, pair)| (n, pair[1].target(0)))
        .collect();
    assert_eq!(
        edges.iter().map(|edge| edge.1).collect::<Vec<_>>(),
        [10_000, 5_200]
    );
    // Each edge waits for the answer to the one before: at least one SYNC each.
    for (n, _) in edges {
        let length = cycles[n + 1..]
            .iter()
            .take_while(|cycle| raised(cycle))
            .count();
        println!("bit 4 for {length} ms");
        assert!((4..=40).contains(&length), "{length} ms");
    }
    // The drive's own profile holds the limits of the axis: 50 mm/s are 20 counts a ms.
    let (first, last) = (
        cycles.iter().position(raised),
        cycles.iter().rposition(raised),
    );
    let own = &cycles[first.expect("an edge")..=last.expect("an edge")];
    let fastest = own
        .windows(5)
        .map(|w| (w[4].actual(0) - w[0].actual(0)).abs())
        .max();
    let fastest = fastest.unwrap_or(0);
    assert!((60..=160).contains(&fastest), "{fastest} counts in 4 ms");
}

#[test]
fn a_stop_halts_a_profile_of_the_drive() {
    let machine = machine(&with_profiles(
        "[[step]]\nmode = { feed = \"pp\" }\n[[step]]\nmove = { feed = 50.0 }\n",
    ));
    let options = Options {
        limit: Some(1_000_000_000),
        ..virtual_time()
    };
    let summary = run_well(machine, options);
    let feed = summary.axes.iter().find(|axis| axis.name == "feed");
    let feed = feed.expect("an axis");
    println!("stopped at {}", feed.final_position);
    assert!((1.0..49.0).contains(&feed.final_position), "{feed:?}");
    assert_eq!(feed.final_state, State::SwitchOnDisabled.to_string());
}

/// The drives have no interpolation: every step that they receive is within the limits at the
/// period of SYNC, and no SYNC sees two steps.
#[test]
fn set_points_change_once_per_sync_within_the_limits() {
    const SYNC: usize = 4;
    // Of `feed`: 50 mm/s, 250 mm/s², 400 counts a mm, 4 ms.
    let (step, change) = (50.0 * 400.0 * 4e-3 + 1.0, 250.0 * 400.0 * 16e-6 + 2.0);
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(virtual_time(), folder.path());
    let machine = with_program(
        "[[step]]\nmove = { feed = 30.0, table = 180.0 }\n[[step]]\nmove = { feed = -20.0 }\nspeed = 0.7\n",
    );
    run_well(machine.clone(), options);
    let cycles = cycles(&machine, &path);
    let powered = |cycle: &&Cycle| cycle.controlwords(0) == [0x0f, 0x0f];
    let on: Vec<&Cycle> = cycles.iter().filter(powered).collect();
    let (mut since, mut last, mut moved, mut checked) = (SYNC, 0, on[0].target(0), 0);
    for cycle in &on {
        let target = cycle.target(0);
        since += 1;
        if target == moved {
            continue;
        }
        let now = target - moved;
        assert!(since + 1 >= SYNC, "{since} cycles after the last step");
        assert!(f64::from(now.abs()) <= step, "a step of {now} counts");
        // A pause of a whole SYNC is a step of 0.
        let before = if since <= SYNC + 1 { last } else { 0 };
        let difference = f64::from((now - before).abs());
        assert!(difference <= change, "{before} counts, then {now}");
        (since, last, moved) = (0, now, target);
        checked += 1;
    }
    println!("{checked} steps of `feed`");
    assert!(checked > 200, "{checked}");
}

/// Returns the cycles from the last new position of a node to its quick stop.
fn stop_cycles(cycles: &[Cycle], node: usize) -> usize {
    let stopped = |cycle: &Cycle| cycle.controlwords(node) == [0x02, 0x02];
    let stop = cycles.iter().position(stopped).expect("a quick stop");
    let moves = |pair: &[Cycle]| pair[0].actual(node) != pair[1].actual(node);
    let last = cycles[..stop].windows(2).rposition(moves);
    stop - last.expect("a motion")
}

/// One node without power, and all of them, as behind a broken CAN cable.
#[test]
fn a_lost_node_stops_its_group_within_100_ms() {
    lose(&[2], "`lift`", "node 2");
    lose(&[1, 2, 3], "`feed`", "node 1");
}

fn lose(nodes: &[u8], axis: &str, node: &str) {
    let folder = tempfile::tempdir().expect("a folder");
    let silent = |node: &u8| {
        format!("[[fault]]\nkind = \"node-silent\"\ndevice = 2\nnode = {node}\nat = \"2s\"\n")
    };
    let silent: String = nodes.iter().map(silent).collect();
    let (options, path) = recorded(faults(&silent), folder.path());
    let machine = with_program(
        "[[step]]\nmove = { feed = 50.0, lift = 50.0, table = 300.0, x = 50.0 }\nspeed = 0.3\n",
    );
    let (error, summary) = run_badly(machine.clone(), options);
    println!("{error}");
    assert_contains(&error, &[axis, node, "in error"]);
    let cycles = cycles(&machine, &path);
    let took = stop_cycles(&cycles, 1);
    println!("quick stop {took} ms after the last position of `lift`");
    assert!(took <= 100, "{took} ms");
    // The others come to rest within their limits and lose their power.
    let summary = summary.expect("the cycle has run");
    let there = |name: &str| !["feed", "lift", "table"].contains(&name) || nodes.len() == 1;
    let others = summary.axes.iter();
    for axis in others.filter(|axis| axis.name != "lift" && there(&axis.name)) {
        assert_eq!(
            axis.final_state,
            State::SwitchOnDisabled.to_string(),
            "{axis:?}"
        );
        assert_eq!((&axis.fault, &axis.trip), (&None, &None));
    }
}

/// The end of the time limit stops as Ctrl-C does.
#[test]
fn a_stop_in_motion_brings_nodes_to_rest_before_their_power_ends() {
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(virtual_time(), folder.path());
    let options = Options {
        limit: Some(2_000_000_000),
        ..options
    };
    let machine = with_program("[[step]]\nmove = { feed = 50.0, table = 350.0 }\nspeed = 0.3\n");
    run_well(machine.clone(), options);
    let cycles = cycles(&machine, &path);
    for (node, step) in [(0, 80), (2, 80)] {
        let powered = |cycle: &Cycle| cycle.controlwords(node) == [0x0f, 0x0f];
        let last = cycles.iter().rposition(powered).expect("it had power");
        let first = cycles.iter().position(powered).expect("it had power");
        let targets = cycles[first..=last].windows(2);
        let largest = targets.map(|pair| (pair[1].target(node) - pair[0].target(node)).abs());
        let largest = largest.max().unwrap_or_default();
        assert!(0 < largest && largest <= step, "a step of {largest} counts");
        let end = &cycles[last - 40..=last];
        let moved = end.iter().map(|cycle| cycle.actual(node));
        let moved = moved.clone().max().unwrap_or(0) - moved.min().unwrap_or(0);
        assert!(
            moved <= 4,
            "it moved by {moved} counts when it lost its power"
        );
        let over = cycles.last().expect("cycles").controlwords(node);
        assert_eq!(over[0] & 0x08, 0, "{over:x?}");
    }
}

/// Returns the mean time in cycles from the computation of a set-point to the cycle that reports
/// its position, in the middle third of a motion.
fn measured_dead_time(cycles: &[Cycle]) -> f64 {
    let pairs = || cycles.windows(2).enumerate();
    // A set-point that is sent in a cycle was computed in the cycle before.
    let sent = pairs().filter(|(_, pair)| pair[0].target(0) != pair[1].target(0));
    let sent: Vec<_> = sent
        .map(|(n, pair)| (n as f64, pair[1].target(0)))
        .collect();
    let seen = pairs().filter(|(_, pair)| pair[0].actual(0) != pair[1].actual(0));
    let lags: Vec<f64> = seen
        .filter_map(|(n, pair)| {
            let at = pair[1].actual(0);
            let mut steps = sent.windows(2);
            let step = steps.find(|step| (step[0].1..step[1].1).contains(&at))?;
            let [(begin, from), (end, to)] = [step[0], step[1]];
            let part = f64::from(at - from) / f64::from(to - from);
            Some((n + 1) as f64 - (begin + part * (end - begin)))
        })
        .collect();
    let middle = &lags[lags.len() / 3..2 * lags.len() / 3];
    middle.iter().sum::<f64>() / middle.len() as f64
}

#[test]
fn the_dead_time_is_the_expected_one() {
    for sync_ms in [2, 3, 4, 5, 10, 20] {
        let text = mixed();
        // One node: three would occupy the network for too long at 2 ms.
        let end = text
            .find("[[device.node]]\nid      = 2")
            .expect("a second node");
        let text = text[..end].replace("\"4ms\"", &format!("\"{sync_ms}ms\""));
        let machine = machine(&format!("{text}[[step]]\nmove = {{ feed = 50.0 }}\n"));
        let gateway = machine.devices[GATEWAY]
            .gateway
            .as_ref()
            .expect("a gateway");
        let expected = gateway.dead_time_ns(machine.bus.cycle_ns) as f64 * 1e-6;
        let folder = tempfile::tempdir().expect("a folder");
        let (options, path) = recorded(virtual_time(), folder.path());
        run_well(machine.clone(), options);
        let measured = measured_dead_time(&cycles(&machine, &path));
        println!("SYNC {sync_ms} ms: {measured:.2} ms, expected {expected:.2} ms");
        assert!((measured - expected).abs() <= 1.0, "SYNC {sync_ms} ms");
    }
}

/// A gateway steps its nodes in cycles of its own: a path shares them with nodes of the same gateway
/// only.
#[test]
fn a_path_has_axes_of_one_network() {
    let text = mixed();
    let end = text.find("[[step]]").expect("a program");
    let with = |axes: &str| {
        let path = format!(
            "[[path]]\nname = \"p\"\naxes = {axes}\ntolerance = 1.0\npoints = [[0.0, 0.0], [5.0, 0.0], [5.0, 5.0]]\n\
             [[step]]\nenable = true\n[[step]]\npath = \"p\"\n"
        );
        let file = root().join("configs/m.toml");
        ecaxis_master::config::parse(&file, &format!("{}{path}", &text[..end]))
    };
    let mixed = with("[\"x\", \"feed\"]").expect_err("two networks");
    assert_contains(
        &mixed.to_string(),
        &["different networks", "behind the same one"],
    );
    let machine = with("[\"feed\", \"lift\"]").expect("one gateway");
    let summary = run_well(machine, virtual_time());
    for axis in summary
        .axes
        .iter()
        .filter(|axis| ["feed", "lift"].contains(&axis.name.as_str()))
    {
        assert_eq!(axis.target_position, 5.0, "{}", axis.name);
    }
}

/// The nodes of two gateways step in cycles of their own, so that no cycle may see both. A hold acts
/// on their tables, which keep their common time.
#[test]
fn a_hold_acts_on_tables_behind_two_gateways() {
    for syncs in [["4ms", "4ms"], ["3ms", "7ms"]] {
        let bench = Bench::new();
        bench.write("points.csv", "0, 0, 0\n0.5, 6, 20\n2.5, 46, 20\n3, 52, 0\n");
        let text = mixed();
        let at = text
            .find("[[device]]\nname     = \"gateway\"")
            .expect("a gateway");
        let end = text
            .find("[[device.node]]\nid      = 2")
            .expect("a second node");
        let gateway = text[at..end].replace("\"4ms\"", &format!("\"{}\"", syncs[0]));
        let other = gateway
            .replace("\"gateway\"", "\"other\"")
            .replace("position = 2", "position = 3")
            .replace("\"feed\"", "\"second\"")
            .replace(syncs[0], syncs[1]);
        let terminal = "[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 4\n";
        let override_ = "[override]\nhold = { io.\"Input 1\" = true }\n[sim]\ninputs = [\n\
            { at = \"2s\", set = { io.\"Input 1\" = true } }, { at = \"4s\", set = { io.\"Input 1\" = false } }]\n";
        let steps = "[[step]]\nenable = true\n[[step]]\nparallel = [{ step = [{ table = { feed = \"points.csv\" } }] }, { step = [{ table = { second = \"points.csv\" } }] }]\n";
        let machine = bench.machine(&format!(
            "{}{override_}{gateway}{other}{terminal}{steps}",
            &text[..at]
        ));
        let (options, path) = recorded(virtual_time(), bench.path());
        let summary = run_well(machine.clone(), options);
        for axis in summary
            .axes
            .iter()
            .filter(|axis| axis.name != "x" && axis.name != "y")
        {
            assert_eq!(axis.target_position, 52.0, "{}", axis.name);
        }
        let targets = [GATEWAY, DeviceIndex(3)].map(|device| {
            let cycles = cycles_of(&machine, &path, device).into_iter();
            let powered = cycles.filter(|cycle| cycle.controlwords(0) == [0x0f, 0x0f]);
            powered.map(|cycle| cycle.target(0)).collect::<Vec<_>>()
        });
        for targets in &targets {
            let stays = targets.chunk_by(|a, b| a == b).map(<[i32]>::len);
            let inner = targets
                .chunk_by(|a, b| a == b)
                .filter(|stay| stay.len() > 1000);
            let held: Vec<_> = inner.map(|stay| stay[0]).collect();
            println!("{syncs:?}: held at {held:?}, {:?}", stays.max());
            let held = held.iter().any(|at| (400 * 6..400 * 46).contains(at));
            assert!(held, "{syncs:?}: no hold on the way");
        }
        // 20 counts in 1 ms: both are at the same place within a step of either.
        let ends = targets.map(|targets| {
            let held = targets.chunk_by(|a, b| a == b);
            held.filter(|stay| stay.len() > 1000 && stay[0] != 0)
                .map(|stay| stay[0])
                .min()
        });
        let [Some(first), Some(second)] = ends else {
            panic!("{ends:?}")
        };
        assert!((first - second).abs() <= 7 * 8, "{first} {second}");
    }
}
