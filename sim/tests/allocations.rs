//! A cycle allocates nothing: frames, SYNC0, process data, drives.

use crate::counting::allocations;
use crate::main_device;

use crate::common::*;
use ecaxis_esi::model::Device;
use ecaxis_sim::frame::FrameBuilder;
use ecaxis_sim::gateway::{Epos, GatewayOptions, NodeOptions, PdoLink};
use ecaxis_sim::{DeviceOptions, FrameOutcome};

/// Turns the device into a drive. The drive adds the objects that it needs.
fn as_drive(mut device: Device) -> Device {
    device.profile = Some(402);
    device
}

#[test]
fn cycling_does_not_allocate() {
    let mut bus = Bus::new(vec![sim(&as_drive(coe_device())), sim(&coe_device())]);
    bus.address_all();
    for (station, logical) in [(0x1001, 0), (0x1002, 16)] {
        bus.preop(station);
        bus.sm(station, 2, 0x1100, 4, 0x64);
        bus.sm(station, 3, 0x1200, 4, 0x20);
        bus.fmmu(station, 0, logical, 4, 0x1100, 2);
        bus.fmmu(station, 1, logical, 4, 0x1200, 1);
        bus.write(station, 0x9a0, &1_000_000_u32.to_le_bytes());
        let now = bus.segment.device(0).unwrap().system_time(bus.now).unwrap();
        bus.write(station, 0x990, &(now + 10_000_000).to_le_bytes());
        bus.write(station, 0x980, &[0, 3]);
        bus.to(station, SAFEOP);
        bus.request(station, 8);
    }
    bus.wait(20_000_000);
    let template = FrameBuilder::default()
        .datagram(14, 0x1001, 0x910, &[0; 8])
        .logical(12, 0, &[0; 32])
        .datagram(7, 0, 0x130, &[0; 2])
        .build();
    let mut bytes = template.clone();
    let before = allocations();
    for n in 1..2_000 {
        bytes.copy_from_slice(&template);
        let result = bus.segment.transit(&mut bytes, bus.now + n * 1_000_000);
        if result == FrameOutcome::Lost {
            break;
        }
    }
    assert_eq!(allocations() - before, 0);
    assert_eq!(bytes[bytes.len() - 2..], [2, 0], "both answered to the end");
    assert_eq!(bytes[bytes.len() - 4], 8, "both in Op");
}

#[test]
fn forwarding_between_two_networks_does_not_allocate() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/esi/gateway.xml");
    let file = ecaxis_esi::parse(&std::fs::read(path).unwrap()).unwrap();
    let link = |at| PdoLink {
        pdo: 2,
        at,
        contents: Vec::new(),
        synchronous: true,
    };
    let nodes = [(1, 2), (2, 8)].map(|(id, at)| NodeOptions {
        inputs: vec![link(at)],
        outputs: vec![link(at)],
        ..NodeOptions::new(id, Epos::E24_5)
    });
    let gateway = GatewayOptions {
        nodes: nodes.into(),
        heartbeat_ms: 20,
        ..GatewayOptions::default()
    };
    let options = DeviceOptions {
        gateway: Some(gateway),
        ..DeviceOptions::default()
    };
    let mut bus = Bus::new(vec![sim_with(&file.devices[0], options)]);
    bus.address_all();
    let (_, mapped) = main_device::bring_up(&mut bus, 0x1001).unwrap();
    let command = |n: u64| {
        let mut outputs = [0; 16];
        outputs[0] = 0x81;
        outputs[1] = 0x80;
        outputs[2] = if n < 10 { 6 } else { 15 };
        outputs[8] = outputs[2];
        FrameBuilder::default()
            .logical(12, mapped.logical, &outputs)
            .build()
    };
    for n in 0..300 {
        bus.frame(command(n)).unwrap();
        bus.wait(1_000_000);
    }
    let frames = |bus: &Bus| {
        let gateway = bus.segment.device(0).unwrap().gateway().unwrap();
        gateway.frames().last().unwrap()
    };
    let (sent, template) = (frames(&bus), command(20));
    let mut bytes = template.clone();
    let before = allocations();
    for n in 1..2_000 {
        bytes.copy_from_slice(&template);
        bus.segment.transit(&mut bytes, bus.now + n * 1_000_000);
    }
    assert_eq!(allocations() - before, 0);
    assert_eq!(bytes[bytes.len() - 2..], [3, 0]);
    let ran = frames(&bus).0 - sent.0;
    assert!(ran > 1_990_000_000, "the network ran all the time: {ran}");
}
