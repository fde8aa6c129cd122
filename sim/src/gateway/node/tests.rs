//! Frames that no well-behaved master sends.

use proptest::prelude::*;

use super::super::can::{CanBus, CanFrame};
use super::super::nmt::NmtState;
use super::{BOOT_NS, Epos, Node, Settings};

fn node() -> (Node, CanBus) {
    let drive = Epos::E24_5;
    let mut node = Node::new(Settings {
        id: 3,
        drive,
        plant: drive.plant(),
        serial: 1,
        bit_rate: 500_000,
        lss: false,
    });
    let mut bus = CanBus::new(500_000);
    while node.due() <= BOOT_NS {
        let at = node.due();
        node.step(at, &mut bus);
    }
    assert_eq!(node.nmt_state(), NmtState::PreOperational);
    (node, bus)
}

fn frame() -> impl Strategy<Value = CanFrame> {
    let id = prop_oneof![
        Just(0u16),
        Just(0x80),
        Just(0x203),
        Just(0x303),
        Just(0x403),
        Just(0x603),
        Just(0x703),
        any::<u16>(),
    ];
    let first = prop_oneof![any::<u8>(), Just(0x22), Just(0x40), Just(1), Just(0x81)];
    let index = prop_oneof![
        Just(0x1400u16),
        0x1000u16..0x1020,
        0x1600u16..0x1a04,
        0x6040u16..0x6100
    ];
    (
        id,
        any::<bool>(),
        first,
        index,
        prop::collection::vec(any::<u8>(), 0..6),
    )
        .prop_map(|(id, remote, first, index, rest)| {
            if remote {
                return CanFrame::request(id);
            }
            let [low, high] = index.to_le_bytes();
            let mut data = vec![first, low, high];
            data.extend_from_slice(&rest);
            // Often a network command for this node.
            let data = if id == 0 {
                vec![first, rest.len() as u8]
            } else {
                data
            };
            CanFrame::new(id, &data)
        })
}

proptest! {
    #[test]
    fn node_survives_random_frames(frames in prop::collection::vec(frame(), 1..60)) {
        let (mut node, mut bus) = node();
        let mut now = BOOT_NS;
        for frame in frames {
            node.receive(&frame, now, &mut bus);
            let until = now + 1_000_000;
            while node.due() <= until {
                now = now.max(node.due());
                node.step(now, &mut bus);
            }
            now = until;
            bus.forget(3);
        }
        // The node still boots.
        node.receive(&CanFrame::new(0, &[0x81, 0]), now, &mut bus);
        while node.due() <= now + BOOT_NS {
            let at = node.due();
            node.step(at, &mut bus);
        }
        prop_assert_eq!(node.nmt_state(), NmtState::PreOperational);
    }
}
