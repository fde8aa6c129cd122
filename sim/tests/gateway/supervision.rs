//! Booting and monitoring of nodes (manual §6.4, §7.2.3).

use super::*;

#[test]
fn silent_node_is_reported_after_its_heartbeat_time() {
    let mut line = Line::new("GW16", three_drives());
    line.command(0x01, 128);
    line.cycles(200);
    assert_eq!(line.status(), [0x81, 0]);
    let position = line.inputs[12..18].to_vec();
    line.gateway_mut().set_node_silent(2, true);
    // A heartbeat of 100 ms plus 20 ms of tolerance. The last heartbeat may just have come.
    line.cycles(15);
    assert_eq!(line.status()[1], 0);
    line.cycles(110);
    assert_eq!(line.status(), [0x81, 2], "error node");
    assert_eq!(line.command(0x10, 2), Some(0x16), "missing");
    assert_eq!(line.command(0x10, 128), Some(0x16));
    assert_eq!(line.command(0x20, 0), Some(0x24), "heartbeat error");
    assert_eq!(line.inputs[12..18], position, "frozen");
    assert_eq!(line.gateway().configuration(0x1f82, 2), Ok(vec![1]));
    // The emergency is on the bus and in the error list.
    let error = number(&line.gateway().configuration(0x1003, 1).unwrap());
    assert_eq!(error, 0x0002_8130);
    // The lowest of several nodes.
    line.gateway_mut().set_node_silent(1, true);
    line.cycles(200);
    assert_eq!(line.status()[1], 1);
    // A returning node boots, is configured and started, and sends again.
    line.gateway_mut().set_node_silent(1, false);
    line.gateway_mut().set_node_silent(2, false);
    line.cycles(400);
    assert_eq!(line.status()[1], 0);
    assert_eq!(line.command(0x10, 2), Some(0x11));
    assert_eq!(line.command(0x20, 0), Some(0x20));
    enable(&mut line, 12, 1);
    assert_eq!(line.input(12, 2) & 0x6f, 0x27);
}

#[test]
fn fault_script_silences_nodes() {
    let mut line = Line::new("GW16", three_drives());
    line.command(0x01, 128);
    let script = "[[fault]]\nkind = \"node-silent\"\nnode = 100\nfor = \"300ms\"\n";
    let script = ecaxis_sim::FaultScript::parse(script).unwrap();
    line.bus.segment.set_faults(script);
    line.cycles(250);
    assert_eq!(
        line.status(),
        [0x81, 0],
        "times count from the segment's first frame: long over"
    );
    let at = line.bus.segment.world_time(line.bus.now) / MS + 10;
    let script = format!(
        "[[fault]]\nkind = \"node-silent\"\nnode = 100\nat = \"{at}ms\"\nfor = \"300ms\"\n"
    );
    let script = ecaxis_sim::FaultScript::parse(&script).unwrap();
    line.bus.segment.set_faults(script);
    line.cycles(200);
    assert_eq!(line.status(), [0x81, 100]);
    line.cycles(500);
    assert_eq!(line.status(), [0x81, 0]);
    assert_eq!(line.node(100).nmt_state(), NmtState::Operational);
}

#[test]
fn mandatory_node_loss_acts_on_the_others_by_0x1f80() {
    let run = |start_up: u32, mandatory: bool| {
        let mut options = three_drives();
        options.start_up = start_up;
        options.nodes[1].mandatory = mandatory;
        options.nodes[1].restart = false;
        let mut line = Line::new("GW16", options);
        line.command(0x01, 128);
        line.gateway_mut().set_node_silent(2, true);
        line.cycles(400);
        (line.gateway().nmt_state(), line.node(1).nmt_state())
    };
    let (op, stopped) = (NmtState::Operational, NmtState::Stopped);
    assert_eq!(run(1, true), (op, op));
    assert_eq!(run(1 | 1 << 6, true), (stopped, stopped));
    assert_eq!(run(1 | 1 << 6, false), (op, op), "only for mandatory nodes");
    let pre = NmtState::PreOperational;
    assert_eq!(run(1 | 1 << 4, true), (pre, pre), "everything was reset");
}

#[test]
fn network_does_not_start_without_a_mandatory_node() {
    let mut options = three_drives();
    options.nodes[1].mandatory = true;
    let mut line = Line::new("GW16", options);
    line.gateway_mut().set_node_silent(2, true);
    line.command(0x02, 0);
    line.cycles(400);
    assert_eq!(line.command(0x01, 128), None);
    assert_eq!(line.gateway().nmt_state(), NmtState::PreOperational);
    // The command stays pending and runs as soon as possible.
    line.gateway_mut().set_node_silent(2, false);
    line.cycles(400);
    assert_eq!(line.gateway().nmt_state(), NmtState::Operational);
    assert_eq!(line.node(2).nmt_state(), NmtState::Operational);
}

#[test]
fn node_guarding_fails_after_unanswered_requests() {
    // Without PDOs the frame log reaches further back.
    let nodes = [1, 2].map(|id| NodeOptions::new(id, Epos::E24_1));
    let mut options = GatewayOptions {
        nodes: nodes.into(),
        sync_period_us: 0,
        ..GatewayOptions::default()
    };
    options.nodes[0].supervision = Supervision::Guarding {
        period_ms: 50,
        retries: 3,
    };
    options.nodes[1].supervision = Supervision::None;
    let mut line = Line::new("GW16", options);
    line.command(0x01, 128);
    line.cycles(300);
    assert_eq!(line.gateway().configuration(0x1f83, 1), Ok(vec![1]));
    assert_eq!(line.command(0x10, 1), Some(0x11));
    assert_eq!(line.command(0x10, 2), Some(0x15), "unknown: not watched");
    // Answers alternate in their toggle bit.
    let answers = sent(&line, 0x701);
    let toggles: Vec<bool> = answers
        .iter()
        .filter(|frame| !frame.remote && frame.data() != [0])
        .map(|frame| frame.data()[0] & 0x80 != 0)
        .collect();
    assert!(
        toggles.len() >= 5 && toggles.windows(2).all(|pair| pair[0] != pair[1]),
        "{toggles:?}"
    );
    line.gateway_mut().set_node_silent(1, true);
    line.gateway_mut().set_node_silent(2, true);
    line.cycles(120);
    assert_eq!(line.status()[1], 0);
    line.cycles(130);
    assert_eq!(line.status()[1], 1, "node 2 is not monitored");
    assert_eq!(line.command(0x10, 1), Some(0x16));
}

#[test]
fn node_with_a_wrong_identity_stays_in_pre_operational() {
    let mut options = three_drives();
    let revision = |minor: u32| (0x2033_0000 + minor).to_le_bytes().to_vec();
    options.objects = vec![
        (0x1f84, 1, 0x0002_0192_u32.to_le_bytes().to_vec()),
        (0x1f85, 1, 0xfb_u32.to_le_bytes().to_vec()),
        (0x1f87, 1, revision(0)),
        (0x1f86, 2, 0x6410_0000_u32.to_le_bytes().to_vec()),
        (0x1f87, 100, revision(1)),
    ];
    let mut line = Line::new("GW16", options);
    line.command(0x01, 0);
    let (pre, op) = (NmtState::PreOperational, NmtState::Operational);
    let states = [1, 2, 100].map(|id| line.node(id).nmt_state());
    assert_eq!(
        states,
        [op, pre, pre],
        "product code; minor revision too low"
    );
}

#[test]
fn refused_configuration_is_a_software_error() {
    let mut options = three_drives();
    options.nodes[1].objects = vec![(0x6041, 0, vec![0, 0])];
    let line = Line::new("GW16", options);
    let error = number(&line.gateway().configuration(0x1003, 1).unwrap());
    assert_eq!(error, 0x0802_6161, "SDO error, node 2");
}

#[test]
fn node_lost_during_boot_causes_a_timeout() {
    let mut line = Line::at_once("GW16", three_drives());
    // The gateway resets the communication of all nodes when it starts; they boot a second time.
    while sent(&line, 0x764).len() < 2 {
        line.cycle();
    }
    line.gateway_mut().set_node_silent(100, true);
    line.cycles(700);
    let error = number(&line.gateway().configuration(0x1003, 1).unwrap());
    assert_eq!(error, 0x0764_6161, "SDO timeout, node 100");
    // The other nodes are not blocked.
    assert_eq!(line.command(0x01, 0), Some(0x01));
    let states = [1, 2].map(|id| line.node(id).nmt_state());
    assert_eq!(states, [NmtState::Operational; 2]);
}

#[test]
fn gateway_alone_becomes_error_passive() {
    let mut line = Line::new("GW16", GatewayOptions::default());
    assert_eq!(line.command(0x20, 0), Some(0x22));
    assert_eq!(line.gateway().configuration(0x1003, 0), Ok(vec![1]));
    assert_eq!(
        line.gateway().configuration(0x1003, 1),
        Ok(vec![0x20, 0x81, 0, 0])
    );
    // When a node appears, the waiting frames are sent, including the emergency.
    assert_eq!(line.command(0x10, 128), Some(0x15));
    let mut line = Line::new("GW16", three_drives());
    assert_eq!(line.command(0x20, 0), Some(0x20));
    // A node at another bit rate neither receives nor acknowledges.
    line.sdo(2, 0x2001, 0, Some(&[2, 0])).unwrap();
    line.sdo(2, 0x1010, 1, Some(b"save")).unwrap();
    line.command(0x02, 2);
    line.cycles(300);
    assert_eq!(line.sdo(2, 0x1000, 0, None), Err(0x0504_0000));
    assert!(line.sdo(1, 0x1000, 0, None).is_ok());
}
