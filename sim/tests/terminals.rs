//! A coupler and digital terminals: no mailbox, no application, single bits.

use crate::common::*;
use crate::main_device::bring_up;
use ecaxis_esi::model::{Device, EsiFile};
use ecaxis_sim::AlState;

/// The project's own coupler and terminals.
fn ours() -> EsiFile {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/esi/terminals.xml");
    ecaxis_esi::parse(&std::fs::read(path).unwrap()).unwrap()
}

fn device<'f>(file: &'f EsiFile, name: &str) -> &'f Device {
    let found = file.devices.iter().find(|d| d.type_name == name);
    found.unwrap_or_else(|| panic!("no {name}"))
}

fn chain(file: &EsiFile, names: &[&str]) -> Bus {
    let mut bus = Bus::new(names.iter().map(|name| sim(device(file, name))).collect());
    assert_eq!(usize::from(bus.address_all()), names.len());
    bus
}

/// Sets a bit FMMU: `bits` from bit `bit` of a logical byte to bit 0 of `physical`.
fn bit_fmmu(bus: &mut Bus, station: u16, logical: u32, bit: u8, bits: u8, physical: u16, kind: u8) {
    let [l0, l1, l2, l3] = logical.to_le_bytes();
    let [p0, p1] = physical.to_le_bytes();
    let last = bit + bits - 1;
    let r = [l0, l1, l2, l3, 1, 0, bit, last, p0, p1, 0, kind, 1, 0, 0, 0];
    bus.write(station, 0x600, &r);
}

/// Takes all devices to Op; terminals get the SyncManager of their kind.
fn operate(bus: &mut Bus, names: &[&str]) {
    for (station, name) in (0x1001..).zip(names) {
        match name.as_bytes() {
            [b'D', b'I', ..] => bus.sm(station, 0, 0x1000, 1, 0x00),
            [b'D', b'O', ..] => bus.sm(station, 0, 0x0f00, 1, 0x44),
            _ => {}
        }
        for state in [PREOP, SAFEOP, OP] {
            bus.to(station, state);
        }
    }
}

fn outputs(bus: &Bus, position: usize) -> Vec<i64> {
    let device = bus.segment.device(position).unwrap();
    (0..8)
        .map_while(|channel| device.object(0x7000 + channel * 0x10, 1))
        .map(|value| i64::from(value[0]))
        .collect()
}

#[test]
fn project_terminals_reach_op_with_their_bits() {
    let file = ours();
    for (name, outputs, inputs) in [
        ("CP0", 0, 0),
        ("DI8", 0, 8),
        ("DO8", 8, 0),
        ("DI4", 0, 4),
        ("DO4", 4, 0),
        ("DI2", 0, 2),
        ("DO2", 2, 0),
    ] {
        let mut bus = chain(&file, &[name]);
        let (learned, mapped) = bring_up(&mut bus, 0x1001).unwrap();
        assert_eq!(learned.mailbox, [(0, 0); 2], "{name}");
        let bits = |usage| {
            let sms = learned.sms.iter().filter(|sm| sm.usage == usage);
            sms.map(|sm| sm.bits).sum::<usize>()
        };
        assert_eq!((bits(3), bits(4)), (outputs, inputs), "{name}");
        let bytes = |bits: usize| bits.div_ceil(8);
        assert_eq!(
            (mapped.outputs, mapped.inputs),
            (bytes(outputs), bytes(inputs)),
            "{name}"
        );
    }
}

#[test]
fn terminals_of_four_and_two_bits_share_a_byte() {
    let names = ["CP0", "DO4", "DI4", "DO2", "DI2"];
    let mut bus = chain(&ours(), &names);
    let (out, inn) = (0x1_0000, 0x1_0001);
    bit_fmmu(&mut bus, 0x1002, out, 0, 4, 0x0f00, 2);
    bit_fmmu(&mut bus, 0x1003, inn, 0, 4, 0x1000, 1);
    bit_fmmu(&mut bus, 0x1004, out, 4, 2, 0x0f00, 2);
    bit_fmmu(&mut bus, 0x1005, inn, 4, 2, 0x1000, 1);
    operate(&mut bus, &names);
    for (position, channel) in [(2, 1), (2, 3), (4, 0)] {
        let terminal = bus.segment.device_mut(position).unwrap();
        assert!(terminal.set_input(0x6000 + channel * 0x10, 1, 1));
    }
    let (data, counter) = bus.logical(12, out, &[0b0010_1101, 0]);
    assert_eq!(counter, 2 + 1 + 2 + 1);
    assert_eq!(data, [0b0010_1101, 0b0001_1010]);
    assert_eq!(outputs(&bus, 1), [1, 0, 1, 1]);
    assert_eq!(outputs(&bus, 3), [0, 1]);
    assert!(bus.segment.device_mut(2).unwrap().set_input(0x6010, 1, 0));
    assert_eq!(bus.logical(12, out, &[0, 0]).0, [0, 0b0001_1000]);
    assert_eq!(outputs(&bus, 1), [0; 4]);
}

#[test]
fn inputs_are_sampled_when_the_frame_arrives() {
    let mut bus = chain(&ours(), &["DI8"]);
    bus.fmmu(0x1001, 0, 0x1_0000, 1, 0x1000, 1);
    operate(&mut bus, &["DI8"]);
    let terminal = bus.segment.device_mut(0).unwrap();
    assert!(terminal.set_input(0x6070, 1, 1));
    assert!(!terminal.set_input(0x6080, 1, 1), "only eight channels");
    assert_eq!(bus.logical(10, 0x1_0000, &[0]), (vec![0x80], 1));
}

#[test]
fn outputs_are_off_outside_op_and_after_watchdog_expiry() {
    let mut bus = chain(&ours(), &["DO8"]);
    bus.sm(0x1001, 0, 0x0f00, 1, 0x44);
    bus.fmmu(0x1001, 0, 0x1_0000, 1, 0x0f00, 2);
    let write = |bus: &mut Bus, value: u8| assert_eq!(bus.logical(11, 0x1_0000, &[value]).1, 1);
    let on = |bus: &Bus| outputs(bus, 0).iter().filter(|bit| **bit != 0).count();
    for state in [PREOP, SAFEOP] {
        bus.to(0x1001, state);
        write(&mut bus, 0xff);
        assert_eq!(on(&bus), 0, "state {state}");
    }
    bus.to(0x1001, OP);
    write(&mut bus, 0x7f);
    assert_eq!(on(&bus), 7);
    bus.wait(99_000_000);
    assert_eq!(on(&bus), 7);
    bus.wait(2_000_000);
    assert_eq!(on(&bus), 0, "100 ms without process data");
    // With device emulation no application can leave Op.
    assert_eq!(
        (bus.read_u16(0x1001, 0x130), bus.read_u16(0x1001, 0x134)),
        (8, 0)
    );
    assert_eq!(bus.read(0x1001, 0x440, 4), [0, 0, 1, 0]);
    write(&mut bus, 0x03);
    assert_eq!(on(&bus), 2);
    assert_eq!(bus.read(0x1001, 0x440, 1), [1]);
    bus.to(0x1001, SAFEOP);
    assert_eq!(on(&bus), 0);
}

/// AL status copies AL control including the acknowledge bit, as recordings of EK1100, EL1004 and
/// EL2828 show.
#[test]
fn device_emulation_copies_al_control_with_acknowledge() {
    let mut bus = chain(&ours(), &["CP0", "DO8"]);
    for station in [0x1001, 0x1002] {
        for (control, state) in [
            (0x11, AlState::Init),
            (0x12, AlState::PreOp),
            (0x08, AlState::Op),
            (0x02, AlState::PreOp),
            (0x07, AlState::PreOp),
            (0x01, AlState::Init),
        ] {
            bus.write(station, 0x120, &[control, 0]);
            assert_eq!(bus.read(station, 0x130, 6), [control, 0, 0, 0, 0, 0]);
            let position = usize::from(station - 0x1001);
            assert_eq!(bus.segment.device(position).unwrap().al_state(), state);
        }
    }
}

#[test]
fn vendor_coupler_and_terminals_exchange_bits() {
    let read = |path| Some(ecaxis_esi::parse(&fixture(path)?).unwrap());
    let (Some(couplers), Some(terminals)) = (
        read("esi/beckhoff/Beckhoff EK11xx.xml"),
        read("esi/beckhoff/Beckhoff EL1xxx.xml"),
    ) else {
        return;
    };
    let names = ["EK1100", "EL1004", "EL1018", "EL1002"];
    let devices = names.map(|name| {
        let mut all = couplers.devices.iter().chain(&terminals.devices);
        all.find(|d| d.type_name == name).unwrap()
    });
    let mut bus = Bus::new(devices.map(sim).into());
    assert_eq!(bus.address_all(), 4);
    for station in 0x1001..0x1005 {
        bring_up(&mut bus, station).unwrap();
    }
    // 4, 8 and 2 inputs, packed.
    bit_fmmu(&mut bus, 0x1002, 0x2_0000, 0, 4, 0x1000, 1);
    bit_fmmu(&mut bus, 0x1004, 0x2_0000, 4, 2, 0x1000, 1);
    bus.fmmu(0x1003, 0, 0x2_0001, 1, 0x1000, 1);
    for (position, channel) in [(1, 3), (2, 0), (2, 7), (3, 1)] {
        let entry = &devices[position].tx_pdos[channel].entries[0];
        let terminal = bus.segment.device_mut(position).unwrap();
        assert!(terminal.set_input(entry.index, entry.sub, 1));
    }
    assert_eq!(
        bus.logical(10, 0x2_0000, &[0, 0]),
        (vec![0b0010_1000, 0x81], 3)
    );
}
