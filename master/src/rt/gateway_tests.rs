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
    /// The executed commands, without toggle bit.
    commands: Vec<[u8; 2]>,
    silent: bool,
}

impl Peer {
    fn new() -> Self {
        Self {
            status: 0x70,
            error: 0,
            states: [1; 3],
            commands: Vec::new(),
            silent: false,
        }
    }

    fn cycle(&mut self, gateway: &mut Gateway) {
        let mut image = [0; 12];
        gateway.write(&mut image);
        let [byte, node] = [image[4], image[5]];
        if !self.silent && (byte ^ self.status) & 0x80 != 0 {
            let extension = match byte & 0x70 {
                0x10 => self.states[NODES.iter().position(|n| *n == node).unwrap()],
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
    assert_eq!(peer.commands[4], [0x10, 1]);
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
