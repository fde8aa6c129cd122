//! Random networks under random operations.

use crate::common::*;
use ecaxis_esi::model::Device;
use ecaxis_sim::frame::{self, FrameBuilder};
use ecaxis_sim::network::topology::media;
use ecaxis_sim::{FrameOutcome, Nic, SecondPort, Segment, SegmentOptions, SimDevice, Topology};
use proptest::prelude::*;

const PHYSICS: [&str; 8] = ["YY", "KK", "YKY", "YYYY", "KYKY", "YY K", "K KY", "Y"];

fn devices(kinds: &[usize]) -> Vec<SimDevice> {
    let with_physics = |kind: &usize| {
        sim(&Device {
            physics: PHYSICS[*kind].into(),
            ..coe_device()
        })
    };
    kinds.iter().map(with_physics).collect()
}

/// Returns the devices as far as ports suffice, as a ring where one can be closed.
fn network(kinds: &[usize], ring: Option<SecondPort>) -> Segment {
    let devices = devices(kinds);
    let media = media(&devices);
    let connected = (0..=devices.len())
        .rev()
        .find_map(|n| Some((n, Topology::by_order(&media[..n]).ok()?)));
    let (n, topology) = connected.unwrap();
    let topology = match ring {
        Some(second) => topology
            .clone()
            .closed(&media[..n], second)
            .unwrap_or(topology),
        None => topology,
    };
    Segment::with_topology(devices[..n].to_vec(), topology, SegmentOptions::default())
}

/// Sends a broadcast from a port. Returns the port where it came out, and the number of devices.
fn broadcast(segment: &mut Segment, nic: Nic, now: u64) -> (Option<Nic>, usize) {
    let mut bytes = FrameBuilder::default().datagram(7, 0, 0, &[0]).build();
    let came = segment.transit_from(nic, &mut bytes, now);
    let met = usize::from(frame::next(&bytes, None).unwrap().wkc(&bytes));
    match came {
        FrameOutcome::Back { nic, .. } => (Some(nic), met),
        FrameOutcome::Lost => (None, met),
    }
}

#[derive(Debug, Clone)]
enum Deed {
    Plug(usize, u8, bool),
    Power(usize, bool),
    Swap(usize, usize),
    DlControl(u16, u16, Vec<u8>),
    Send(bool),
    Wait(u64),
}

fn deed() -> impl Strategy<Value = Deed> {
    let device = 0..9_usize;
    prop_oneof![
        (device.clone(), 0..5_u8, any::<bool>()).prop_map(|(d, p, on)| Deed::Plug(d, p, on)),
        (device.clone(), any::<bool>()).prop_map(|(d, on)| Deed::Power(d, on)),
        (device, 0..PHYSICS.len()).prop_map(|(d, kind)| Deed::Swap(d, kind)),
        (0..9_u16, 0..4_u16, prop::collection::vec(any::<u8>(), 1..4))
            .prop_map(|(d, at, data)| Deed::DlControl(d, at, data)),
        any::<bool>().prop_map(Deed::Send),
        (0..1_500_000_000_u64).prop_map(Deed::Wait),
    ]
}

fn ring() -> impl Strategy<Value = Option<SecondPort>> {
    prop_oneof![
        Just(None),
        Just(Some(SecondPort::Listens)),
        Just(Some(SecondPort::Reflects))
    ]
}

/// Finds the devices with a link to the MainDevice's first port, by flooding.
fn connected(segment: &Segment, plugged: &[[bool; 4]], powered: &[bool]) -> Vec<bool> {
    let n = segment.len();
    let mut reached = vec![false; n];
    let mut supplied = powered.to_vec();
    for device in 0..n {
        // Port 0 of the port descriptor: 2 is E-bus.
        let ebus = segment.device(device).unwrap().registers(7, 1)[0] & 3 == 2;
        if let (true, Some(up)) = (ebus, segment.topology().uplink(device)) {
            supplied[device] &= supplied[up.device];
        }
    }
    for device in 0..n {
        let above = match segment.topology().uplink(device) {
            None => true,
            Some(up) => {
                reached[up.device]
                    && supplied[up.device]
                    && plugged[up.device][usize::from(up.port)]
            }
        };
        reached[device] = above && supplied[device] && plugged[device][0];
    }
    reached
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn every_frame_ends_after_any_operations(
        kinds in prop::collection::vec(0..PHYSICS.len(), 1..9),
        ring in ring(),
        deeds in prop::collection::vec(deed(), 1..60),
    ) {
        let mut segment = network(&kinds, ring);
        let mut now = 0;
        for deed in deeds {
            match deed {
                Deed::Plug(device, port, on) => {
                    prop_assert_eq!(
                        segment.plug(device, port, on),
                        segment.topology().has_cable(device, port)
                    );
                }
                Deed::Power(device, on) => segment.power(device, on),
                Deed::Swap(device, kind) => {
                    let new = devices(&[kind]).remove(0);
                    prop_assert_eq!(segment.swap(device, new).is_some(), device < segment.len());
                }
                Deed::DlControl(position, at, data) => {
                    let mut bytes = FrameBuilder::default()
                        .datagram(2, 0_u16.wrapping_sub(position), 0x100 + at, &data)
                        .build();
                    segment.transit(&mut bytes, now);
                }
                Deed::Send(first) => {
                    let nic = if first { Nic::Primary } else { Nic::Secondary };
                    let (_, met) = broadcast(&mut segment, nic, now);
                    prop_assert!(met <= segment.len());
                }
                Deed::Wait(ns) => {
                    now += ns;
                    segment.advance(now);
                }
            }
        }
        // A frame reaches the devices whose delay is known before it. It may itself open an
        // auto-closed port for the devices after it.
        segment.advance(now);
        let known = (0..segment.len()).filter(|n| segment.delay_ns(*n).is_some()).count();
        let (_, met) = broadcast(&mut segment, Nic::Primary, now);
        prop_assert_eq!(known, met);
    }

    #[test]
    fn tree_reaches_every_linked_and_powered_device(
        kinds in prop::collection::vec(0..PHYSICS.len(), 1..9),
        deeds in prop::collection::vec((0..9_usize, 0..4_u8, any::<bool>(), any::<bool>()), 0..12),
    ) {
        let mut segment = network(&kinds, None);
        let n = segment.len();
        let mut plugged = vec![[true; 4]; n];
        let mut powered = vec![true; n];
        for (device, port, on, power) in deeds {
            let device = device % n;
            if power {
                segment.power(device, on);
                powered[device] = on;
            } else if segment.plug(device, port, on) {
                // Either end names the cable.
                plugged[device][usize::from(port)] = on;
                let uplink = segment.topology().uplink(device);
                if let (0, Some(up)) = (port, uplink) {
                    plugged[up.device][usize::from(up.port)] = on;
                }
                for (below, ports) in plugged.iter_mut().enumerate() {
                    let up = segment.topology().uplink(below);
                    if up.is_some_and(|up| (up.device, up.port) == (device, port)) {
                        ports[0] = on;
                    }
                }
            }
            let reached = connected(&segment, &plugged, &powered);
            let (came, met) = broadcast(&mut segment, Nic::Primary, 0);
            prop_assert_eq!(met, reached.iter().filter(|r| **r).count());
            prop_assert_eq!(came, reached[0].then_some(Nic::Primary));
        }
    }

    #[test]
    fn ring_with_one_break_reaches_every_device(
        n in 1..9_usize,
        broken in prop::option::of(0..10_usize),
    ) {
        let mut segment = network(&vec![0; n], Some(SecondPort::Listens));
        if let Some(broken) = broken {
            let broken = broken % (n + 1);
            if broken == n {
                segment.plug(n - 1, 1, false);
            } else {
                segment.plug(broken, 0, false);
            }
        }
        let (_, first) = broadcast(&mut segment, Nic::Primary, 0);
        let (_, second) = broadcast(&mut segment, Nic::Secondary, 0);
        prop_assert_eq!(first + second, n);
    }
}
