//! The control word against a model of the gateway, and the phase against clocks that differ.

use super::*;
use proptest::prelude::*;

const NODES: [u8; 3] = [1, 2, 100];
const TIMEOUT: u32 = 20;

fn gateway() -> Gateway {
    Gateway::new(GatewayConfig {
        device: DeviceIndex(0),
        inputs: 4..12,
        outputs: 4..12,
        sync_cycles: 4,
        nodes: NODES.to_vec(),
        timeout_cycles: TIMEOUT,
    })
}

/// A gateway's end of the control word (manual §6.2.1, §6.2.2).
struct Peer {
    status: u8,
    error: u8,
    states: [u8; 3],
    /// The state of the module, and its general status.
    own: u8,
    general: u8,
    /// The executed commands, without toggle bit.
    commands: Vec<[u8; 2]>,
    silent: bool,
    /// Cycles until a new control word is seen, and those that have passed.
    delay: u32,
    waited: u32,
}

impl Peer {
    fn new() -> Self {
        Self {
            status: 0x70,
            error: 0,
            states: [1; 3],
            own: 1,
            general: 0,
            commands: Vec::new(),
            silent: false,
            delay: 0,
            waited: 0,
        }
    }

    fn cycle(&mut self, gateway: &mut Gateway) {
        let mut image = [0; 12];
        gateway.write(&mut image);
        let [byte, node] = [image[4], image[5]];
        let new = !self.silent && (byte ^ self.status) & 0x80 != 0;
        if new && self.waited < self.delay {
            self.waited += 1;
        } else if new {
            self.waited = 0;
            let extension = match byte & 0x70 {
                0x10 if node == 0 => self.own,
                0x10 => self.states[NODES.iter().position(|n| *n == node).unwrap()],
                0x20 => self.general,
                _ => byte & 0x0f,
            };
            self.status = byte & 0xf0 | extension;
            self.commands.push([byte & 0x7f, node]);
        }
        (image[4], image[5]) = (self.status, self.error);
        gateway.observe(&image, true, true, false);
    }
}

#[test]
fn gateway_is_started_then_each_node_is_asked() {
    let (mut gateway, mut peer) = (gateway(), Peer::new());
    assert_eq!(gateway.state(0), NodeState::Unknown);
    for _ in 0..10 {
        peer.cycle(&mut gateway);
    }
    assert_eq!(
        peer.commands[..4],
        [[0x01, 0], [0x10, 1], [0x10, 2], [0x10, 100]]
    );
    assert_eq!(peer.commands[4..7], [[0x20, 0], [0x10, 0], [0x10, 1]]);
    for node in 0..3 {
        assert_eq!(
            (gateway.state(node), gateway.lost(node)),
            (NodeState::Operational, None)
        );
    }
}

/// The table of responses to "Get Node state".
#[test]
fn node_states_match_the_manual() {
    for (code, expected) in [
        (0x0, NodeState::PreOperational),
        (0x1, NodeState::Operational),
        (0x2, NodeState::Resetting),
        (0x3, NodeState::Resetting),
        (0x4, NodeState::Stopped),
        (0x5, NodeState::Unknown),
        (0x6, NodeState::Missing),
        (0x7, NodeState::Other(7)),
        (0xf, NodeState::Other(15)),
    ] {
        let (mut gateway, mut peer) = (gateway(), Peer::new());
        peer.states[1] = code;
        for _ in 0..10 {
            peer.cycle(&mut gateway);
        }
        assert_eq!(gateway.state(1), expected, "{code:x}");
        // A node that was never Operational is not lost.
        assert_eq!(gateway.lost(1), None);
    }
}

#[test]
fn a_node_is_lost_by_its_state_and_by_the_error_node() {
    for (error, state, expected) in [
        (0, 6, NodeState::Missing),
        (2, 1, NodeState::InError),
        (0, 0, NodeState::PreOperational),
    ] {
        let (mut gateway, mut peer) = (gateway(), Peer::new());
        for _ in 0..10 {
            peer.cycle(&mut gateway);
        }
        (peer.error, peer.states[1]) = (error, state);
        for _ in 0..10 {
            peer.cycle(&mut gateway);
        }
        assert_eq!(gateway.lost(1), Some(expected));
        assert_eq!((gateway.lost(0), gateway.lost(2)), (None, None));
    }
}

#[test]
fn a_missing_acknowledgement_loses_all_nodes_after_the_time_out() {
    let (mut gateway, mut peer) = (gateway(), Peer::new());
    for _ in 0..10 {
        peer.cycle(&mut gateway);
    }
    peer.silent = true;
    for _ in 0..TIMEOUT {
        peer.cycle(&mut gateway);
    }
    assert_eq!(gateway.lost(0), None);
    peer.cycle(&mut gateway);
    peer.cycle(&mut gateway);
    for node in 0..3 {
        assert_eq!(gateway.lost(node), Some(NodeState::NoAcknowledgement));
    }
}

/// A node that the gateway leaves in PRE-OPERATIONAL is started alone, and so is a module that has
/// been reset.
#[test]
fn a_waiting_node_and_a_reset_module_are_started() {
    let (mut gateway, mut peer) = (gateway(), Peer::new());
    peer.states[2] = 0;
    for _ in 0..30 {
        peer.cycle(&mut gateway);
    }
    let starts = |peer: &Peer, node: u8| peer.commands.iter().filter(|c| **c == [1, node]).count();
    assert!(starts(&peer, 100) >= 1, "{:x?}", peer.commands);
    assert_eq!(
        (starts(&peer, 1), starts(&peer, 2), starts(&peer, 0)),
        (0, 0, 1)
    );
    peer.own = 0;
    for _ in 0..10 {
        peer.cycle(&mut gateway);
    }
    let again = starts(&peer, 0);
    assert!(again >= 2, "{:x?}", peer.commands);
    peer.own = 1;
    for _ in 0..20 {
        peer.cycle(&mut gateway);
    }
    assert!(starts(&peer, 0) <= again + 1, "{:x?}", peer.commands);
}

#[test]
fn the_end_leads_all_nodes_to_pre_operational_and_loses_none() {
    let (mut gateway, mut peer) = (gateway(), Peer::new());
    peer.general = 0x6;
    for _ in 0..20 {
        peer.cycle(&mut gateway);
    }
    gateway.end();
    assert!(!gateway.has_ended());
    for _ in 0..5 {
        peer.cycle(&mut gateway);
    }
    assert!(gateway.has_ended());
    assert_eq!(peer.commands.last(), Some(&[0x00, 128]));
    let all: Vec<_> = gateway.nodes().collect();
    let expected = NODES.map(|id| (id, NodeState::PreOperational, 0));
    assert_eq!(all, expected);
    assert_eq!(gateway.lost(0), None);
    let texts: Vec<_> = gateway.general_seen().texts().collect();
    assert_eq!(
        texts,
        ["CAN error passive", "node guarding or heartbeat error"]
    );
    // The summary still has the states when the bus has left Op.
    gateway.observe(&[0; 12], true, false, false);
    assert_eq!(gateway.state(1), NodeState::PreOperational);
}

/// The end may come while the acknowledgement of any command is under way, or never comes.
#[test]
fn the_end_is_acknowledged_by_a_slow_gateway_at_any_moment() {
    for (delay, before) in (0..8).flat_map(|d| (60..80).map(move |b| (d, b))) {
        let (mut gateway, mut peer) = (gateway(), Peer::new());
        peer.delay = delay;
        for _ in 0..before {
            peer.cycle(&mut gateway);
        }
        gateway.end();
        for _ in 0..2 * delay + 4 {
            peer.cycle(&mut gateway);
        }
        assert!(gateway.has_ended(), "delay {delay}, end in cycle {before}");
        assert_eq!(peer.commands.last(), Some(&[0x00, 128]));
    }
}

#[test]
fn a_gateway_without_acknowledgement_receives_the_end() {
    let (mut gateway, mut peer) = (gateway(), Peer::new());
    for _ in 0..20 {
        peer.cycle(&mut gateway);
    }
    peer.silent = true;
    peer.cycle(&mut gateway);
    gateway.end();
    let mut image = [0; 12];
    for _ in 0..TIMEOUT + 2 {
        peer.cycle(&mut gateway);
        gateway.write(&mut image);
    }
    assert_eq!((image[4] & 0x7f, image[5]), (0x00, 128));
}

/// START and the end differ in the extension only. The acknowledgement of START arrives after the
/// end has replaced it, so the gateway has not seen the end yet.
#[test]
fn a_late_acknowledgement_of_start_is_not_that_of_the_end() {
    for late in [1, 2, 5] {
        let (mut gateway, mut peer) = (gateway(), Peer::new());
        peer.own = 0;
        let mut image = [0; 12];
        while image[4] & 0x7f != 0x01 || image[5] != 0 || peer.commands.is_empty() {
            peer.cycle(&mut gateway);
            gateway.write(&mut image);
        }
        let start = image[4];
        peer.silent = true;
        gateway.end();
        while image[5] != 128 {
            peer.cycle(&mut gateway);
            gateway.write(&mut image);
        }
        assert_eq!(image[4] & 0x80, start & 0x80, "the toggle bit of START");
        for _ in 1..late {
            peer.cycle(&mut gateway);
        }
        peer.commands.clear();
        peer.status = start;
        peer.silent = false;
        peer.cycle(&mut gateway);
        assert!(!gateway.has_ended());
        for _ in 0..3 {
            peer.cycle(&mut gateway);
        }
        assert!(gateway.has_ended());
        assert_eq!(peer.commands, [[0x00, 128]]);
    }
}

#[test]
fn control_word_stays_untouched_outside_op() {
    let mut gateway = gateway();
    let mut image = [0xa5; 12];
    gateway.observe(&image, true, false, false);
    gateway.write(&mut image);
    assert_eq!(image, [0xa5; 12]);
}

proptest! {
    /// With clocks that differ, powered axes step at most a cycle early or late, and the steps stay
    /// with the inputs.
    #[test]
    fn steps_follow_the_sync(cycles in 2u32..20, ppm in -500i32..500, start in 0u32..20) {
        let mut phase = SyncPhase::new(cycles);
        let period = f64::from(cycles) * (1.0 + f64::from(ppm) * 1e-6);
        let mut edge = f64::from(start);
        let (mut last, mut late) = (None::<u32>, 0);
        for now in 0..20_000u32 {
            let changed = f64::from(now) >= edge;
            if changed {
                edge += period;
            }
            phase.step(changed, now > 100);
            if phase.is_due() {
                if let Some(last) = last.filter(|_| now > 100) {
                    let interval = now - last;
                    prop_assert!(interval.abs_diff(cycles) <= 1, "{interval} of {cycles}");
                }
                last = Some(now);
            }
            let distance = last.map_or(0, |last| now - last);
            if changed && now > 100 && !(distance <= 1 || distance + 1 >= cycles) {
                late += 1;
            }
        }
        prop_assert_eq!(late, 0);
    }
}

/// A node that is stopped by command rests; it is neither lost nor started again.
#[test]
fn commanded_node_rests_until_it_is_started() {
    for (command, code, state) in [
        (NodeCommand::Stop, 4, NodeState::Stopped),
        (NodeCommand::PreOperational, 0, NodeState::PreOperational),
    ] {
        let (mut gateway, mut peer) = (gateway(), Peer::new());
        for _ in 0..10 {
            peer.cycle(&mut gateway);
        }
        gateway.command(1, command);
        for _ in 0..3 {
            peer.cycle(&mut gateway);
            assert_eq!(gateway.lost(1), None);
        }
        assert!(peer.commands.contains(&[code, 2]), "{:?}", peer.commands);
        peer.states[1] = code;
        peer.commands.clear();
        for _ in 0..60 {
            peer.cycle(&mut gateway);
            assert_eq!(gateway.lost(1), None);
        }
        assert_eq!(gateway.state(1), state);
        assert!(!peer.commands.contains(&[1, 2]), "{:?}", peer.commands);
        gateway.command(1, NodeCommand::Start);
        for _ in 0..3 {
            peer.cycle(&mut gateway);
        }
        assert!(peer.commands.contains(&[1, 2]), "{:?}", peer.commands);
        peer.states[1] = 1;
        for _ in 0..20 {
            peer.cycle(&mut gateway);
        }
        assert_eq!(
            (gateway.state(1), gateway.lost(1)),
            (NodeState::Operational, None)
        );
        // From now on it is supervised again.
        peer.states[1] = 0;
        for _ in 0..20 {
            peer.cycle(&mut gateway);
        }
        assert_eq!(gateway.lost(1), Some(NodeState::PreOperational));
        assert_eq!(gateway.nodes().map(|n| n.2).collect::<Vec<_>>(), [0, 1, 0]);
    }
}

/// A reset is sent once, and the node is started as after its power-on.
#[test]
fn reset_node_is_supervised_again_once_it_is_operational() {
    let (mut gateway, mut peer) = (gateway(), Peer::new());
    for _ in 0..10 {
        peer.cycle(&mut gateway);
    }
    gateway.command(2, NodeCommand::Reset);
    peer.states[2] = 2;
    for _ in 0..30 {
        peer.cycle(&mut gateway);
        assert_eq!(gateway.lost(2), None);
    }
    let resets = peer.commands.iter().filter(|command| **command == [2, 100]);
    assert_eq!(resets.count(), 1, "{:?}", peer.commands);
    peer.states[2] = 1;
    for _ in 0..20 {
        peer.cycle(&mut gateway);
    }
    peer.states[2] = 6;
    for _ in 0..20 {
        peer.cycle(&mut gateway);
    }
    assert_eq!(gateway.lost(2), Some(NodeState::Missing));
}
