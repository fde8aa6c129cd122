//! Registers, working counters, FMMUs, EEPROM and states, accessed over the wire.

use crate::common::*;
use ecaxis_sim::frame::FrameBuilder;
use ecaxis_sim::{AlState, DeviceOptions, EscInfo, FaultScript};
use proptest::prelude::*;

fn three_io() -> Bus {
    let mut bus = Bus::new((0..3).map(|_| sim(&io_device())).collect());
    assert_eq!(bus.address_all(), 3);
    bus
}

#[test]
fn commands_count_as_in_the_standard() {
    let mut bus = three_io();
    let position = 0u16.wrapping_sub(1);
    // (command, address, expected working counter); 0x0e00 is not a register, 0x13e0 is free RAM.
    let ram = [
        (0, 0, 0),
        (1, position, 1),
        (2, position, 1),
        (3, position, 3),
        (4, 0x1002, 1),
        (5, 0x1002, 1),
        (6, 0x1002, 3),
        (7, 0, 3),
        (8, 0, 3),
        (9, 0, 9),
        (13, position, 3),
        (14, 0x1002, 3),
        (14, 0x7777, 3),
        (4, 0x7777, 0),
        (15, 0, 0),
    ];
    for (command, adp, expected) in ram {
        assert_eq!(
            bus.datagram(command, adp, 0x13e0, &[1, 2]).1,
            expected,
            "command {command}"
        );
        assert_eq!(
            bus.datagram(command, adp, 0x0e00, &[1, 2]).1,
            0,
            "command {command}"
        );
    }
}

#[test]
fn read_only_registers_do_not_count_writes() {
    let mut bus = three_io();
    assert_eq!(bus.datagram(8, 0, 0x130, &[0, 0]).1, 0);
    assert_eq!(bus.datagram(9, 0, 0x130, &[0, 0]).1, 3);
    // Without distributed clocks only the receive times exist.
    assert_eq!(bus.datagram(8, 0, 0x900, &[0; 4]).1, 3);
    assert_eq!(bus.datagram(7, 0, 0x910, &[0; 8]).1, 0);
}

#[test]
fn broadcast_read_ors_and_position_counts_up() {
    let mut bus = three_io();
    bus.write(0x1001, 0x13e0, &[0x01]);
    bus.write(0x1003, 0x13e0, &[0x80]);
    assert_eq!(bus.datagram(7, 0, 0x13e0, &[0]), (vec![0x81], 3));
    let bytes = bus
        .frame(FrameBuilder::default().datagram(1, 5, 0, &[0]).build())
        .unwrap();
    assert_eq!(bytes[18..20], 8u16.to_le_bytes());
    // The changed source address distinguishes the reply from the request.
    assert_eq!(bytes[6], 0x12);
}

#[test]
fn information_registers_describe_the_controller() {
    let mut bus = Bus::new(vec![
        sim(&coe_device()),
        sim_with(
            &io_device(),
            DeviceOptions {
                alias: 0x55,
                ..DeviceOptions::default()
            },
        ),
    ]);
    bus.address_all();
    assert_eq!(
        bus.read(0x1001, 0, 10),
        [0xc0, 2, 0, 0, 3, 4, 4, 0x1f, 0xcc, 1],
        "two MII ports, a clock, 4 SyncManagers: a LAN9252 does"
    );
    assert_eq!(
        bus.read(0x1002, 0, 10),
        [0x12, 0, 0, 0, 3, 4, 1, 0x4a, 0xfc, 0],
        "an E-bus terminal: an ET1200 does"
    );
    assert_eq!(bus.read_u16(0x1002, 0x12), 0x55);
    assert_eq!(
        bus.datagram(4, 0x55, 0, &[0]).1,
        0,
        "the alias is not enabled"
    );
    bus.write(0x1002, 0x103, &[1]);
    assert_eq!(bus.datagram(4, 0x55, 0, &[0]).1, 1);
    assert_eq!(bus.read_u16(0x1001, 0x110), 0x5a33, "linked on both ports");
    assert_eq!(bus.read_u16(0x1002, 0x110), 0x5613, "the line's end");
}

#[test]
fn closed_port_cuts_the_line() {
    let mut bus = three_io();
    bus.write(0x1001, 0x101, &[0x0c]);
    assert_eq!(bus.datagram(7, 0, 0, &[0]).1, 1);
    // Closed although there is a link.
    assert_eq!(bus.read_u16(0x1001, 0x110), 0x5e33);
    bus.write(0x1001, 0x101, &[0]);
    bus.datagram(7, 0, 0, &[0]);
    assert_eq!(bus.datagram(7, 0, 0, &[0]).1, 3);
}

#[test]
fn bits_of_several_devices_share_a_logical_byte() {
    let mut bus = three_io();
    for (n, station) in (0..3u8).zip(0x1001..) {
        // Two bits each into RAM at bit 4; read back from the same place.
        let at = n * 2;
        let fmmu = |kind| {
            [
                0,
                0,
                1,
                0,
                1,
                0,
                at,
                at + 1,
                0xe0,
                0x13,
                4,
                kind,
                1,
                0,
                0,
                0,
            ]
        };
        bus.write(station, 0x600, &fmmu(2));
        bus.write(station, 0x610, &fmmu(1));
        bus.write(station, 0x13e0, &[0xc3]);
    }
    assert_eq!(bus.logical(11, 0x1_0000, &[0b10_01_11]).1, 3);
    let values = [0x1001, 0x1002, 0x1003].map(|s| bus.read(s, 0x13e0, 1)[0]);
    assert_eq!(values, [0xf3, 0xd3, 0xe3]);
    assert_eq!(bus.logical(10, 0x1_0000, &[0]), (vec![0b10_01_11], 3));
    // LRW: read first, then write; 3 for each device.
    assert_eq!(
        bus.logical(12, 0x1_0000, &[0b01_10_00]),
        (vec![0b10_01_11], 9)
    );
    assert_eq!(bus.logical(10, 0x1_0000, &[0]), (vec![0b01_10_00], 3));
    assert_eq!(bus.logical(12, 0x2_0000, &[0]).1, 0);
}

#[test]
fn eeprom_is_accessible_through_registers() {
    let options = DeviceOptions {
        alias: 0x1234,
        serial: 99,
        ..DeviceOptions::default()
    };
    let mut bus = Bus::new(vec![sim_with(&coe_device(), options)]);
    bus.address_all();
    let mut image = Vec::new();
    for word in (0..0x40u32).step_by(2) {
        let mut request = vec![0, 1];
        request.extend_from_slice(&word.to_le_bytes());
        bus.write(0x1001, 0x502, &request);
        assert_ne!(bus.read_u16(0x1001, 0x502) & 0x8000, 0, "busy");
        bus.wait(100_000);
        let status = bus.read_u16(0x1001, 0x502);
        assert_eq!(status & 0xff40, 0, "ready, 4 bytes, no checksum error");
        image.extend(bus.read(0x1001, 0x508, 4));
    }
    assert_eq!(image, bus.segment.device(0).unwrap().sii()[..0x80]);
    assert_eq!(image[8..10], [0x34, 0x12]);
    assert_eq!(image[16..20], 0x333u32.to_le_bytes());
    assert_eq!(image[28..32], 99u32.to_le_bytes());

    let write = |bus: &mut Bus, control: u8| {
        bus.write(0x1001, 0x508, &[0x78, 0x56]);
        bus.write(0x1001, 0x502, &[control, 2, 4, 0, 0, 0]);
        bus.wait(1_000_000);
        bus.read_u16(0x1001, 0x502)
    };
    assert_ne!(write(&mut bus, 0) & 0x4000, 0, "no write enable");
    assert_eq!(write(&mut bus, 1) & 0xe000, 0);
    assert_eq!(bus.segment.device(0).unwrap().sii()[8..10], [0x78, 0x56]);

    // The device owns the EEPROM: the interface ignores writes.
    bus.write(0x1001, 0x500, &[1]);
    assert_eq!(bus.datagram(5, 0x1001, 0x502, &[0, 1, 0, 0, 0, 0]).1, 0);
    bus.write(0x1001, 0x500, &[0]);
    bus.write(0x1001, 0x502, &[0, 1, 0, 0, 0, 0]);
}

#[test]
fn states_change_only_by_standard_transitions() {
    let mut bus = Bus::new(vec![sim(&coe_device())]);
    bus.address_all();
    let s = 0x1001;
    assert_eq!(bus.request(s, 4), (0x11, 0x11));
    assert_eq!(bus.request(s, 2), (0x11, 0x11), "unacknowledged");
    assert_eq!(bus.request(s, 0x11), (1, 0));
    assert_eq!(bus.request(s, 7), (0x11, 0x12));
    assert_eq!(bus.request(s, 0x12), (0x11, 0x16), "mailbox not configured");
    bus.sm(s, 0, 0x1000, 48, 0x26);
    bus.sm(s, 1, 0x1030, 40, 0x22);
    assert_eq!(bus.request(s, 0x12), (0x11, 0x16), "mailbox too short");
    bus.write(s, 0x80e, &[0]);
    bus.sm(s, 1, 0x1030, 48, 0x22);
    assert_eq!(bus.request(s, 0x12), (2, 0));
    assert_eq!(bus.request(s, 8), (0x12, 0x11));
    assert_eq!(bus.request(s, 0x13), (0x12, 0x11));
    assert_eq!(bus.request(s, 0x11), (1, 0));
    assert_eq!(bus.request(s, 3), (0x11, 0x13), "no bootstrap");
    assert_eq!(bus.request(s, 0x12), (2, 0));
    assert_eq!(bus.request(s, 4), (0x12, 0x1d));
    bus.sm(s, 2, 0x1100, 3, 0x64);
    assert_eq!(bus.request(s, 0x14), (0x12, 0x1d), "one byte short");
    bus.write(s, 0x816, &[0]);
    bus.sm(s, 2, 0x1100, 4, 0x64);
    assert_eq!(bus.request(s, 0x14), (0x12, 0x1e));
    bus.sm(s, 3, 0x1108, 4, 0x20);
    assert_eq!(
        bus.request(s, 0x14),
        (0x12, 0x1d),
        "in the second of SM2's three buffers"
    );
    bus.write(s, 0x81e, &[0]);
    bus.sm(s, 3, 0x1200, 4, 0x20);
    assert_eq!(bus.request(s, 0x14), (4, 0));
    bus.first_outputs(s);
    assert_eq!(bus.request(s, 8), (8, 0));
    assert_eq!(bus.request(s, 4), (4, 0));
    assert_eq!(bus.request(s, 8), (8, 0));
    assert_eq!(bus.request(s, 2), (2, 0));
    assert_eq!(bus.request(s, 4), (4, 0));
    assert_eq!(bus.request(s, 1), (1, 0));
}

fn io_in_op() -> Bus {
    let mut bus = Bus::new(vec![sim(&io_device())]);
    bus.address_all();
    let s = 0x1001;
    bus.to(s, PREOP);
    bus.sm(s, 0, 0x1000, 2, 0x44);
    bus.sm(s, 1, 0x1100, 2, 0x00);
    bus.fmmu(s, 0, 0x1000, 2, 0x1000, 2);
    bus.fmmu(s, 1, 0x1000, 2, 0x1100, 1);
    assert_eq!(
        bus.logical(12, 0x1000, &[9, 9]).1,
        0,
        "process data are closed in PreOp"
    );
    bus.to(s, SAFEOP);
    assert_eq!(
        bus.logical(12, 0x1000, &[9, 9]),
        (vec![0, 0], 3),
        "outputs do not count in SafeOp"
    );
    bus.to(s, OP);
    bus
}

#[test]
fn inputs_mirror_outputs_unless_they_are_set() {
    let mut bus = io_in_op();
    assert_eq!(bus.logical(12, 0x1000, &[5, 6]).1, 3);
    assert_eq!(bus.logical(12, 0x1000, &[5, 6]).0, [5, 6]);
    assert_eq!(bus.segment.device(0).unwrap().outputs(), [5, 6]);
    assert!(
        bus.segment
            .device_mut(0)
            .unwrap()
            .set_input(0x6000, 2, 0x77)
    );
    bus.logical(12, 0x1000, &[8, 8]);
    assert_eq!(bus.logical(12, 0x1000, &[8, 8]).0, [8, 0x77]);
}

#[test]
fn watchdog_takes_a_device_from_op_to_safe_op() {
    let mut bus = io_in_op();
    bus.logical(12, 0x1000, &[1, 2]);
    bus.wait(99_000_000);
    assert_eq!(bus.read_u16(0x1001, 0x130), 8);
    bus.logical(12, 0x1000, &[1, 2]);
    bus.wait(101_000_000);
    assert_eq!(
        (bus.read_u16(0x1001, 0x130), bus.read_u16(0x1001, 0x134)),
        (0x14, 0x1b)
    );
    assert_eq!(bus.read(0x1001, 0x440, 4), [0, 0, 1, 0]);
    assert_eq!(bus.segment.device(0).unwrap().al_state(), AlState::SafeOp);
    bus.logical(12, 0x1000, &[1, 2]);
    assert_eq!(bus.request(0x1001, 0x18), (8, 0));
}

#[test]
fn disabling_a_sync_manager_in_op_raises_an_error() {
    let mut bus = io_in_op();
    bus.write(0x1001, 0x806, &[0]);
    bus.wait(1_000_000);
    assert_eq!(
        (bus.read_u16(0x1001, 0x130), bus.read_u16(0x1001, 0x134)),
        (0x12, 0x1d)
    );
}

#[test]
fn absent_device_ends_the_line_and_returns_in_init() {
    let mut bus = three_io();
    let script = "[[fault]]\nat = \"1s\"\nfor = \"1s\"\ndevice = 1\nkind = \"absent\"\n";
    bus.segment.set_faults(FaultScript::parse(script).unwrap());
    bus.to(0x1002, PREOP);
    assert_eq!(bus.datagram(7, 0, 0, &[0]).1, 3);
    bus.wait(1_000_000_000);
    assert_eq!(bus.datagram(7, 0, 0, &[0]).1, 1);
    assert_eq!(bus.read_u16(0x1001, 0x110), 0x5613);
    bus.wait(1_000_000_000);
    assert_eq!(bus.datagram(7, 0, 0, &[0]).1, 3);
    assert_eq!(
        bus.datagram(4, 0x1002, 0, &[0]).1,
        0,
        "no station address any more"
    );
    assert_eq!(
        bus.datagram(4, 0x1003, 0, &[0]).1,
        0,
        "the one in front of it fed it"
    );
}

#[test]
fn frames_are_lost_as_scripted() {
    let mut bus = three_io();
    let script = "[[fault]]\nkind = \"frame-loss\"\ncount = 2\n";
    bus.segment.set_faults(FaultScript::parse(script).unwrap());
    let brd = || FrameBuilder::default().datagram(7, 0, 0, &[0]).build();
    let came_back: Vec<bool> = (0..4).map(|_| bus.frame(brd()).is_some()).collect();
    assert_eq!(came_back, [false, false, true, true]);
    bus.segment
        .set_faults(FaultScript::parse("[[fault]]\nkind = \"silent\"\n").unwrap());
    assert!(bus.frame(brd()).is_none());
    bus.segment.set_faults(FaultScript::default());
    assert!(bus.frame(brd()).is_some());
}

#[test]
fn identity_and_refusals_follow_the_script() {
    let mut bus = three_io();
    let script = "[[fault]]\ndevice = 0\nkind = \"identity\"\nproduct = 0xabcd\n\
                  [[fault]]\ndevice = 1\nkind = \"refuse-state\"\nstate = \"preop\"\ncode = 0x16\n";
    bus.segment.set_faults(FaultScript::parse(script).unwrap());
    assert_eq!(bus.request(0x1002, 2), (0x11, 0x16));
    bus.to(0x1001, PREOP);
    assert_eq!(
        bus.segment.device(0).unwrap().sii()[20..24],
        0xabcdu32.to_le_bytes()
    );
}

fn random_devices() -> Bus {
    let mut bus = Bus::new(vec![sim(&coe_device()), sim(&io_device())]);
    bus.address_all();
    bus.preop(0x1001);
    bus
}

proptest! {
    #[test]
    fn segment_survives_random_bytes(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let mut bus = random_devices();
        let len = bytes.len();
        if let Some(back) = bus.frame(bytes) {
            prop_assert_eq!(back.len(), len);
        }
    }

    #[test]
    fn segment_survives_random_datagrams(
        datagrams in prop::collection::vec(
            (0u8..16, prop_oneof![Just(0u16), Just(0x1001), Just(0x1002), any::<u16>()],
             prop_oneof![0u16..0x1400, any::<u16>()],
             prop::collection::vec(any::<u8>(), 0..64)),
            1..20),
    ) {
        let mut bus = random_devices();
        for (command, adp, ado, data) in datagrams {
            let frame = FrameBuilder::default().datagram(command, adp, ado, &data).build();
            let len = frame.len();
            // A datagram that opens a port without a link loses frames.
            if let Some(back) = bus.frame(frame) {
                prop_assert_eq!(back.len(), len);
            }
            bus.wait(300_000);
        }
    }
}

#[test]
fn smaller_chip_lacks_the_upper_units_and_reads_four_bytes() {
    let options = DeviceOptions {
        esc: Some(EscInfo::LAN9252),
        ..DeviceOptions::default()
    };
    let mut bus = Bus::new(vec![sim_with(&io_device(), options)]);
    bus.address_all();
    assert_eq!(
        bus.read(0x1001, 0, 10),
        [0xc0, 2, 0, 0, 3, 4, 4, 0x0a, 0xcc, 1]
    );
    for (ado, len, wkc) in [
        (0x620, 16, 1),
        (0x630, 16, 0),
        (0x620, 32, 1),
        (0x818, 8, 1),
        (0x820, 8, 0),
    ] {
        assert_eq!(
            bus.datagram(8, 0, ado, &vec![0; len]).1,
            wkc,
            "0x{ado:04x}, {len} bytes"
        );
    }
    bus.write(0x1001, 0x502, &[0, 1, 8, 0, 0, 0]);
    bus.wait(1_000_000);
    assert_eq!(bus.read_u16(0x1001, 0x502) & 0x00c0, 0x0080);
    assert_eq!(bus.read(0x1001, 0x508, 8), [0x11, 1, 0, 0, 0, 0, 0, 0]);
}

#[test]
fn application_delays_state_changes() {
    let options = DeviceOptions {
        state_change_ns: 5_000_000,
        ..DeviceOptions::default()
    };
    let mut bus = Bus::new(vec![sim_with(&io_device(), options)]);
    bus.address_all();
    bus.write(0x1001, 0x120, &[PREOP, 0]);
    bus.wait(4_900_000);
    assert_eq!(bus.read_u16(0x1001, 0x130), u16::from(INIT));
    bus.wait(100_000);
    assert_eq!(bus.read_u16(0x1001, 0x130), u16::from(PREOP));
}

#[test]
fn application_reads_al_control_before_it_follows() {
    let options = DeviceOptions {
        state_change_ns: 4_000_000,
        ..DeviceOptions::default()
    };
    let mut bus = Bus::new(vec![sim_with(&coe_device(), options)]);
    bus.address_all();
    bus.start_mailboxes(0x1001);
    // SOEM reconfigures a device like this: Init, the present state, then PreOp at once.
    bus.write(0x1001, 0x120, &[INIT, 0]);
    bus.wait(500_000);
    assert_eq!(bus.datagram(5, 0x1001, 0x120, &[PREOP, 0]).1, 0, "unread");
    bus.wait(600_000);
    bus.write(0x1001, 0x120, &[PREOP, 0]);
    bus.wait(2_000_000);
    assert_eq!(bus.datagram(5, 0x1001, 0x120, &[PREOP, 0]).1, 0, "busy");
    bus.wait(8_000_000);
    assert_eq!(bus.read_u16(0x1001, 0x130), u16::from(PREOP));
}

#[test]
fn error_does_not_drop_a_request() {
    let mut bus = Bus::new(vec![sim(&coe_device())]);
    bus.address_all();
    bus.preop(0x1001);
    bus.sm(0x1001, 2, 0x1100, 4, 0x64);
    bus.sm(0x1001, 3, 0x1200, 4, 0x20);
    bus.to(0x1001, SAFEOP);
    bus.write(0x1001, 0x1100, &[0; 4]);
    bus.to(0x1001, OP);
    // The watchdog of 100 ms expires after a request and before the device reads it.
    let now = bus.now;
    bus.write(0x1001, 0x1100, &[0; 4]);
    bus.wait(99_980_000 - (bus.now - now));
    bus.write(0x1001, 0x120, &[PREOP | 0x10, 0]);
    bus.wait(20_000_000);
    assert_eq!(bus.read_u16(0x1001, 0x130), u16::from(PREOP));
    bus.to(0x1001, INIT);
}
