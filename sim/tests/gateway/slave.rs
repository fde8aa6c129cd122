//! The gateway as a slave of another NMT master, and the options of a node's boot.

use super::*;

fn slave() -> GatewayOptions {
    GatewayOptions {
        start_up: 0,
        ..GatewayOptions::default()
    }
}

fn start(line: &mut Line) {
    line.gateway_mut().inject(CanFrame::new(0, &[1, 0]));
    line.cycles(5);
}

/// The codes of the emergencies of the gateway.
fn emergencies(line: &Line) -> Vec<u16> {
    let frames = line.gateway().frames();
    let own = frames.filter(|(_, frame)| frame.id == 0x80 + 99 && frame.data().len() == 8);
    own.map(|(_, frame)| u16::from_le_bytes([frame.data()[0], frame.data()[1]]))
        .collect()
}

/// Manual §6.2.1, note b: the control word permits OPERATIONAL, and FF10h reports a refusal and a
/// permission that ends.
#[test]
fn a_slave_needs_the_permission_of_the_control_word() {
    let mut options = slave();
    // A node acknowledges the frames of the gateway.
    options.nodes = vec![NodeOptions::new(1, Epos::E24_5)];
    let mut line = Line::new("GW64", options);
    start(&mut line);
    assert_eq!(line.gateway().nmt_state(), NmtState::PreOperational);
    assert_eq!(emergencies(&line), [0xff10]);
    assert_eq!(line.command(0x01, 0), Some(0x01));
    assert_eq!(line.gateway().nmt_state(), NmtState::PreOperational);
    start(&mut line);
    assert_eq!(line.gateway().nmt_state(), NmtState::Operational);
    assert_eq!(line.command(0x00, 0), Some(0x00));
    line.cycles(5);
    assert_eq!(line.gateway().nmt_state(), NmtState::PreOperational);
    assert_eq!(emergencies(&line), [0xff10, 0xff10]);
}

/// Returns the SDO downloads to node 1: index and subindex.
fn downloads(line: &Line) -> Vec<(u16, u8)> {
    let frames = line.gateway().frames();
    let own = frames.filter(|(_, frame)| frame.id == 0x601 && frame.data()[0] & 0xe0 == 0x20);
    own.map(|(_, frame)| {
        let data = frame.data();
        (u16::from_le_bytes([data[1], data[2]]), data[3])
    })
    .collect()
}

fn node() -> NodeOptions {
    let mut node = NodeOptions::new(1, Epos::E24_5);
    node.objects = vec![(0x6081, 0, 77_u32.to_le_bytes().to_vec())];
    node
}

fn with(node: NodeOptions) -> GatewayOptions {
    GatewayOptions {
        nodes: vec![node],
        sync_period_us: 0,
        ..GatewayOptions::default()
    }
}

/// 0x1F81 bit 7: factory values first, then the configuration.
#[test]
fn a_node_is_reset_to_factory_values_before_its_configuration() {
    let mut own = node();
    own.factory = true;
    let line = Line::new("GW64", with(own));
    let done = downloads(&line);
    assert_eq!(done.first(), Some(&(0x1011, 1)), "{done:x?}");
    assert_eq!(done.iter().filter(|object| object.0 == 0x1011).count(), 1);
    assert!(done.contains(&(0x6081, 0)), "{done:x?}");
    assert_eq!(
        line.gateway().node(1).map(|node| node.object(0x6081, 0)),
        Some(77)
    );
}

/// 0x1F26 and 0x1F27: a node with the expected date and time keeps its configuration.
#[test]
fn a_node_with_the_expected_configuration_is_not_configured_again() {
    let mut own = node();
    own.configured = [11_000, 42];
    own.objects.extend([
        (0x1020, 1, 11_000_u32.to_le_bytes().to_vec()),
        (0x1020, 2, 42_u32.to_le_bytes().to_vec()),
        (0x1010, 1, b"save".to_vec()),
    ]);
    let mut line = Line::new("GW64", with(own));
    assert!(downloads(&line).contains(&(0x6081, 0)));
    // Frames of the first boot leave the log.
    line.gateway_mut().set_node_silent(1, true);
    line.cycles(3000);
    let before = downloads(&line).len();
    line.gateway_mut().set_node_silent(1, false);
    line.cycles(300);
    let done = downloads(&line);
    assert!(done.len() <= before, "{done:x?}");
    assert_eq!(
        line.gateway().node(1).map(|node| node.object(0x6081, 0)),
        Some(77)
    );
}

/// A gateway with exactly one node starts it, whatever its model.
#[test]
fn one_node_of_each_model_is_started() {
    for drive in Epos::ALL {
        let mut line = Line::new("GW64", with(NodeOptions::new(5, drive)));
        assert_eq!(line.command(0x01, 0), Some(0x01));
        line.cycles(200);
        let state = line.gateway().node(5).map(Node::nmt_state);
        assert_eq!(state, Some(NmtState::Operational), "{}", drive.name());
    }
}
