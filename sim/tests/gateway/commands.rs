//! Control and status word (manual §6.2).

use super::*;

/// Commands of the manual's table on a master, row by row, and the answers.
#[test]
fn commands_and_node_states_row_by_row() {
    let mut options = three_drives();
    // The MainDevice starts the nodes itself.
    options.start_up = 1 | 1 << 3;
    let mut line = Line::new("GW16", options);
    let (pre, op, stopped) = (
        NmtState::PreOperational,
        NmtState::Operational,
        NmtState::Stopped,
    );
    let states = |line: &Line| {
        let nodes = [1, 2, 100].map(|id| line.node(id).nmt_state());
        (line.gateway().nmt_state(), nodes)
    };
    assert_eq!(states(&line), (pre, [pre; 3]));
    // Set NMT state: of one node, of the module, of the complete network.
    assert_eq!(line.command(0x01, 2), Some(0x01));
    assert_eq!(states(&line), (pre, [pre, op, pre]));
    assert_eq!(line.command(0x01, 0), Some(0x01));
    assert_eq!(states(&line), (op, [pre, op, pre]));
    assert_eq!(line.command(0x01, 128), Some(0x01));
    assert_eq!(states(&line), (op, [op; 3]));
    assert_eq!(line.command(0x04, 100), Some(0x04));
    assert_eq!(states(&line), (op, [op, op, stopped]));
    assert_eq!(line.command(0x00, 1), Some(0x00));
    assert_eq!(states(&line), (op, [pre, op, stopped]));
    // Get node state, after a heartbeat has reported it.
    line.cycles(120);
    for (target, state) in [(0, 1), (1, 0), (2, 1), (100, 4), (3, 5), (127, 5), (128, 5)] {
        assert_eq!(
            line.command(0x10, target),
            Some(0x10 | state),
            "node {target}"
        );
    }
    // Get general status: no errors.
    assert_eq!(line.command(0x20, 0), Some(0x20));
    // No operation reflects the command.
    assert_eq!(line.command(0x73, 5), Some(0x73));
    // Reserved commands, extensions and node numbers are not acknowledged.
    for (command, target) in [
        (0x05, 0),
        (0x0f, 0),
        (0x30, 0),
        (0x6f, 0),
        (0x01, 129),
        (0x01, 255),
    ] {
        assert_eq!(
            line.command(command, target),
            None,
            "{command:02x} {target}"
        );
        assert_eq!(line.inputs[0] & 0x7f, 0x73);
    }
    assert_eq!(states(&line), (op, [pre, op, stopped]));
    // Resets of a node: boot-up, then Pre-Operational.
    for command in [0x02, 0x03] {
        assert_eq!(line.command(command, 2), Some(command));
        line.cycles(200);
        assert_eq!(states(&line), (op, [pre, pre, stopped]));
        assert_eq!(line.command(0x10, 2), Some(0x10));
        line.command(0x01, 2);
    }
    // A reset of the module initialises the network and configures the nodes again.
    line.command(0x02, 0);
    line.cycles(400);
    assert_eq!(states(&line), (pre, [pre; 3]));
    assert_eq!(line.status()[1], 0);
}

#[test]
fn command_needs_a_new_toggle_bit() {
    let mut line = Line::new("GW16", three_drives());
    (line.outputs[0], line.outputs[1]) = (0x01, 128);
    line.cycles(50);
    assert_eq!(
        line.gateway().nmt_state(),
        NmtState::PreOperational,
        "no toggle, no command"
    );
    line.outputs[0] = 0x81;
    line.cycles(50);
    assert_eq!(line.gateway().nmt_state(), NmtState::Operational);
    assert_eq!(line.status(), [0x81, 0]);
    // The same command, and another one with the same toggle, repeatedly.
    line.outputs[0] = 0x80;
    line.cycles(50);
    assert_eq!(line.gateway().nmt_state(), NmtState::Operational);
    assert_eq!(line.status(), [0x81, 0]);
    line.outputs[0] = 0x00;
    line.cycles(50);
    assert_eq!(line.gateway().nmt_state(), NmtState::PreOperational);
    assert_eq!(line.status(), [0x00, 0]);
}

#[test]
fn command_waits_for_the_end_of_the_initialisation() {
    let mut line = Line::at_once("GW16", three_drives());
    assert_eq!(line.gateway().nmt_state(), NmtState::Initialising);
    (line.outputs[0], line.outputs[1]) = (0x81, 128);
    line.cycle();
    assert_eq!(line.status(), [0x70, 0]);
    line.cycles(400);
    assert_eq!(line.status(), [0x81, 0]);
    for id in [1, 2, 100] {
        assert_eq!(line.node(id).nmt_state(), NmtState::Operational, "{id}");
    }
}

#[test]
fn status_word_shows_no_operation_outside_op() {
    let mut line = Line::new("GW16", three_drives());
    assert_eq!(line.command(0x01, 128), Some(0x01));
    line.bus.to(S, SAFEOP);
    line.bus.wait(5 * MS);
    assert_eq!(
        line.bus.logical(10, LOGICAL, &[0; 2]).0,
        [0xf0, 0],
        "toggle bit kept"
    );
    // The buffer's content is old when the fieldbus returns: same toggle.
    line.bus.to(S, OP);
    line.cycles(20);
    assert_eq!(line.gateway().nmt_state(), NmtState::Operational);
    assert_eq!(line.command(0x00, 0), Some(0x00));
    assert_eq!(line.gateway().nmt_state(), NmtState::PreOperational);
}

#[test]
fn nodes_start_with_the_module_unless_the_main_device_starts_them() {
    let mut line = Line::new("GW16", three_drives());
    assert_eq!(line.command(0x01, 0), Some(0x01));
    for id in [1, 2, 100] {
        assert_eq!(line.node(id).nmt_state(), NmtState::Operational, "{id}");
    }
}

#[test]
fn slave_module_commands_only_itself() {
    let mut options = three_drives();
    options.start_up = 0;
    let mut line = Line::new("GW16", options);
    assert_eq!(line.command(0x01, 128), None);
    assert_eq!(line.command(0x01, 2), None);
    assert_eq!(line.command(0x10, 2), None);
    assert_eq!(line.command(0x01, 0), Some(0x01));
    // It is permitted to become OPERATIONAL, and no NMT master has started it.
    assert_eq!(line.command(0x10, 0), Some(0x10));
    assert_eq!(line.node(2).nmt_state(), NmtState::PreOperational);
}

#[test]
fn gateway_runs_are_reproducible() {
    let run = || {
        let mut line = Line::new("GW16", three_drives());
        line.command(0x01, 128);
        enable(&mut line, 2, 1);
        line.gateway_mut().set_node_silent(100, true);
        line.cycles(200);
        (
            line.inputs.clone(),
            line.gateway().frames().collect::<Vec<_>>(),
        )
    };
    assert_eq!(run(), run());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]
    #[test]
    fn gateway_survives_random_outputs_and_requests(
        outputs in prop::collection::vec(prop::array::uniform16(any::<u8>()), 1..40),
        requests in prop::collection::vec(
            (prop_oneof![Just(0x2fu8), Just(0x2b), Just(0x23), Just(0x22), Just(0x40), any::<u8>()],
             prop_oneof![0x1000u16..0x1020, 0x1400u16..0x1410, 0x1600u16..0x1608, 0x1800u16..0x1808,
                         0x1a00u16..0x1a08, 0x1f20u16..0x1f8a, 0x2000u16..0x2122, 0x3000u16..0x3002],
             prop_oneof![0u8..4, any::<u8>()],
             any::<u32>()),
            0..60),
    ) {
        let mut line = Line::new("GW16", GatewayOptions {
            input_size: None,
            output_size: None,
            nodes: vec![NodeOptions::new(2, Epos::E24_5)],
            ..GatewayOptions::default()
        });
        for (command, index, sub, value) in requests {
            let [low, high] = index.to_le_bytes();
            let [a, b, c, d] = value.to_le_bytes();
            line.gateway_mut().serve_sdo(&[command, low, high, sub, a, b, c, d]);
        }
        for bytes in outputs {
            line.outputs = bytes.to_vec();
            line.cycle();
        }
        prop_assert_eq!(line.bus.read_u16(S, 0x130), 8);
    }
}
