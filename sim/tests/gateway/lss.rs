//! Layer setting services (CiA 305), between master and nodes and from a master of our own.

use super::*;

const UNNUMBERED: u8 = 0xff;

/// Answers of nodes to layer setting services.
fn answers(line: &Line) -> Vec<[u8; 8]> {
    sent(line, 0x7e4).iter().map(CanFrame::padded).collect()
}

/// Sends one service and returns the answers to it.
fn ask(line: &mut Line, command: u8, data: [u8; 4]) -> Vec<[u8; 8]> {
    let before = line.gateway().frames().last().map(|(at, _)| at);
    let [a, b, c, d] = data;
    let frame = CanFrame::new(0x7e5, &[command, a, b, c, d, 0, 0, 0]);
    line.gateway_mut().inject(frame);
    line.cycles(5);
    let frames = line.gateway().frames();
    let new = frames.filter(|(at, frame)| Some(*at) > before && frame.id == 0x7e4);
    new.map(|(_, frame)| frame.padded()).collect()
}

/// Returns the nodes that take a number. The gateway keeps its last frames only.
fn numbered_within(line: &mut Line, cycles: usize) -> usize {
    let mut count = 0;
    for _ in 0..cycles {
        let before = line.gateway().frames().last().map(|(at, _)| at);
        line.cycle();
        let frames = line.gateway().frames();
        let new = frames.filter(|(at, frame)| Some(*at) > before && frame.id == 0x7e4);
        count += new.filter(|(_, frame)| frame.data()[0] == 0x11).count();
    }
    count
}

fn identity(line: &Line, id: u8) -> [u32; 4] {
    [1, 2, 3, 4].map(|sub| line.node(id).object(0x1018, sub) as u32)
}

fn select(line: &mut Line, address: [u32; 4]) -> Vec<[u8; 8]> {
    let parts = (0x40..).zip(address);
    let answers = parts.map(|(command, part)| ask(line, command, part.to_le_bytes()));
    answers.last().unwrap()
}

/// A gateway with two nodes in STOPPED.
fn stopped() -> Line {
    let mut options = three_drives();
    options.nodes.truncate(2);
    let mut line = Line::new("GW64", options);
    line.gateway_mut().inject(CanFrame::new(0, &[2, 0]));
    line.cycles(5);
    assert_eq!(line.node(2).nmt_state(), NmtState::Stopped);
    line
}

/// The gateway gives a drive without number its number after the boot time; the drive keeps it.
#[test]
fn the_gateway_numbers_a_missing_slave_by_its_identity() {
    let mut options = three_drives();
    options.nodes[1].lss = true;
    options.nodes[2].lss = true;
    let mut line = Line::new("GW64", options);
    assert_eq!(line.command(0x01, 0), Some(0x01));
    // Nothing is heard of the two within the boot time of 500 ms.
    assert!(sent(&line, 0x702).is_empty());
    assert_eq!(numbered_within(&mut line, 1500), 2);
    for id in [1, 2, 100] {
        assert_eq!(
            line.node(id).nmt_state(),
            NmtState::Operational,
            "node {id}"
        );
        assert_eq!(line.node(id).object(0x2000, 0), i64::from(id));
        assert_eq!(
            line.node(id).object(0x1400, 1) & 0x7ff,
            0x200 + i64::from(id)
        );
    }
    // The number is stored.
    line.gateway_mut().set_node_silent(2, true);
    line.cycles(200);
    line.gateway_mut().set_node_silent(2, false);
    assert_eq!(numbered_within(&mut line, 1500), 0);
    assert_eq!(line.node(2).nmt_state(), NmtState::Operational);
    // Its process data arrive.
    enable(&mut line, 12, 1);
    assert_eq!(line.input(12, 2) & 0x6f, 0x27);
}

/// Table 3-14: the services of state "Waiting" and "Configuration".
#[test]
fn each_service_answers_in_its_states_only() {
    let mut line = stopped();
    let own = identity(&line, 2);
    let in_configuration = [
        (0x11, [2, 0, 0, 0], vec![0x11, 0, 0]),
        (0x13, [0, 2, 0, 0], vec![0x13, 0, 0]),
        (0x17, [0; 4], vec![0x17, 0, 0]),
        (0x5a, [0; 4], [&[0x5a][..], &own[0].to_le_bytes()].concat()),
        (0x5b, [0; 4], [&[0x5b][..], &own[1].to_le_bytes()].concat()),
        (0x5c, [0; 4], [&[0x5c][..], &own[2].to_le_bytes()].concat()),
        (0x5d, [0; 4], [&[0x5d][..], &own[3].to_le_bytes()].concat()),
        (0x5e, [0; 4], vec![0x5e, 2]),
    ];
    for (command, data, _) in &in_configuration {
        assert!(ask(&mut line, *command, *data).is_empty(), "{command:x}");
    }
    assert_eq!(select(&mut line, own), [[0x44, 0, 0, 0, 0, 0, 0, 0]]);
    for (command, data, expected) in &in_configuration {
        let answers = ask(&mut line, *command, *data);
        let answer = answers.first().unwrap();
        assert_eq!(answer[..expected.len()], expected[..], "{command:x}");
        assert_eq!(answers.len(), 1);
    }
    // Numbers and bit timings that do not exist.
    assert_eq!(ask(&mut line, 0x11, [128, 0, 0, 0])[0][1], 1);
    assert_eq!(ask(&mut line, 0x13, [0, 5, 0, 0])[0][1], 1);
    assert_eq!(ask(&mut line, 0x13, [1, 2, 0, 0])[0][1], 1);
    // Selection is a service of "Waiting".
    let other = identity(&line, 1);
    assert!(ask(&mut line, 0x04, [0; 4]).is_empty());
    assert!(ask(&mut line, 0x5e, [0; 4]).is_empty());
    assert_eq!(select(&mut line, other).len(), 1);
    assert!(ask(&mut line, 0x04, [1, 0, 0, 0]).is_empty());
    assert_eq!(ask(&mut line, 0x5e, [0; 4]).len(), 2);
}

#[test]
fn services_need_the_state_stopped() {
    let mut line = stopped();
    line.gateway_mut().inject(CanFrame::new(0, &[0x80, 0]));
    line.cycles(5);
    let own = identity(&line, 2);
    assert!(select(&mut line, own).is_empty());
}

/// A binary search over serial numbers finds each node.
#[test]
fn nodes_are_identified_by_ranges() {
    let mut line = stopped();
    let [vendor, product, revision, serial] = identity(&line, 2);
    let mut identify = |low: u32, high: u32| {
        let parts = [vendor, product, revision, revision, low, high];
        let asked = (0x46..).zip(parts);
        let all = asked.map(|(command, part)| ask(&mut line, command, part.to_le_bytes()));
        all.last().unwrap().len()
    };
    assert_eq!(identify(0, u32::MAX), 1);
    assert_eq!(identify(serial, serial), 1);
    assert_eq!(identify(serial + 1, u32::MAX), 0);
    assert_eq!(identify(0, serial - 1), 0);
    // All nodes have a number.
    assert!(ask(&mut line, 0x4c, [0; 4]).is_empty());
}

/// Two missing slaves with one identity: neither is numbered.
#[test]
fn a_missing_slave_that_two_nodes_may_be_stays_missing() {
    let mut options = three_drives();
    options.nodes[1].lss = true;
    let range = [(0x1f88, 2, 77u32.to_le_bytes().to_vec())];
    options.objects.extend(range);
    let mut line = Line::new("GW64", options);
    line.cycles(1500);
    assert!(answers(&line).is_empty());
    assert_eq!(ask(&mut line, 0x4c, [0; 4]), [[0x50, 0, 0, 0, 0, 0, 0, 0]]);
    assert_eq!(line.node(2).nmt_state(), NmtState::Initialising);
}

/// A node with a number takes the new one at the next reset, and without "store" loses it with its
/// power.
#[test]
fn a_new_number_takes_effect_at_a_reset() {
    let mut line = stopped();
    let own = identity(&line, 2);
    select(&mut line, own);
    assert_eq!(ask(&mut line, 0x11, [9, 0, 0, 0])[0][1], 0);
    assert_eq!(ask(&mut line, 0x5e, [0; 4])[0][1], 2);
    ask(&mut line, 0x04, [0; 4]);
    line.gateway_mut().inject(CanFrame::new(0, &[0x82, 2]));
    line.cycles(20);
    assert_eq!(sent(&line, 0x709).len(), 1);
    assert_eq!(line.node(2).object(0x1014, 0), 0x89);
    line.gateway_mut().set_node_silent(2, true);
    line.gateway_mut().set_node_silent(2, false);
    line.cycles(100);
    assert_eq!(line.node(2).object(0x1014, 0), 0x82);
}

/// The node is silent for two delays; afterwards it has the other bit rate and hears nothing.
#[test]
fn a_new_bit_rate_is_activated_after_its_delay() {
    let mut line = stopped();
    let own = identity(&line, 2);
    select(&mut line, own);
    assert_eq!(ask(&mut line, 0x13, [0, 0, 0, 0])[0][1], 0);
    // The rate of the network: it comes back.
    ask(&mut line, 0x15, [50, 0, 0, 0]);
    line.cycles(80);
    assert!(ask(&mut line, 0x5e, [0; 4]).is_empty());
    line.cycles(20);
    assert_eq!(ask(&mut line, 0x5e, [0; 4]).len(), 1);
    assert_eq!(ask(&mut line, 0x13, [0, 4, 0, 0])[0][1], 0);
    ask(&mut line, 0x15, [10, 0, 0, 0]);
    line.cycles(100);
    assert!(ask(&mut line, 0x5e, [0; 4]).is_empty());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    /// Any sequence of services: no panic, and the other node keeps its number.
    #[test]
    fn any_services_leave_the_other_node_alone(
        services in prop::collection::vec(
            (prop_oneof![0x00u8..0x20, 0x40u8..0x60], any::<[u8; 4]>(), any::<bool>()),
            1..40,
        )
    ) {
        let mut line = stopped();
        let own = identity(&line, 2);
        select(&mut line, own);
        for (command, data, reset) in services {
            if command != 0x04 && !(0x40..0x44).contains(&command) {
                ask(&mut line, command, data);
            }
            if reset {
                line.gateway_mut().inject(CanFrame::new(0, &[0x82, 2]));
                line.cycles(10);
                line.gateway_mut().inject(CanFrame::new(0, &[2, 0]));
                line.cycles(2);
            }
        }
        prop_assert_eq!(line.node(1).object(0x2000, 0), 1);
        let number = line.node(2).object(0x2000, 0);
        prop_assert!(number > 0 && number != i64::from(UNNUMBERED));
    }
}
