//! Process RAM: SyncManagers that protect it, FMMUs that map it, accessed over the wire.

use crate::common::*;
use ecaxis_sim::frame::{self, FrameBuilder};
use proptest::prelude::*;

const S: u16 = 0x1001;
const OUT: u16 = 0x1000;
const IN: u16 = 0x1100;

/// Returns a terminal with 16 bits out and in, in this state.
fn terminal(state: u8) -> Bus {
    let mut bus = Bus::new(vec![sim(&io_device())]);
    bus.address_all();
    if state > INIT {
        bus.to(S, PREOP);
    }
    bus.sm(S, 0, OUT, 2, 0x44);
    bus.sm(S, 1, IN, 2, 0x00);
    for next in [SAFEOP, OP] {
        if state >= next {
            bus.to(S, next);
        }
    }
    bus
}

fn set_input(bus: &mut Bus, value: [i64; 2]) {
    let device = bus.segment.device_mut(0).unwrap();
    for (sub, value) in (1..).zip(value) {
        assert!(device.set_input(0x6000, sub, value));
    }
}

#[test]
fn inputs_read_in_two_frames_are_consistent() {
    let mut bus = terminal(OP);
    set_input(&mut bus, [1, 2]);
    assert_eq!(bus.read(S, IN, 2), [1, 2]);
    assert_eq!(bus.read(S, IN, 1), [1]);
    set_input(&mut bus, [3, 4]);
    assert_eq!(bus.read(S, 0x80d, 1)[0] & 0x40, 0x40, "in use");
    assert_eq!(bus.read(S, IN + 1, 1), [2], "from the same buffer");
    assert_eq!(bus.read(S, IN, 2), [3, 4]);
    assert_eq!(
        bus.datagram(4, S, IN + 1, &[0]).1,
        0,
        "not from the middle on"
    );
}

#[test]
fn outputs_written_in_two_frames_are_consistent() {
    let mut bus = terminal(OP);
    let outputs = |bus: &Bus| bus.segment.device(0).unwrap().outputs();
    bus.write(S, OUT, &[1, 2]);
    assert_eq!(outputs(&bus), [1, 2]);
    bus.write(S, OUT, &[3]);
    assert_eq!(bus.read(S, 0x805, 1)[0] & 0x80, 0x80, "in use");
    assert_eq!(outputs(&bus), [1, 2]);
    bus.write(S, OUT + 1, &[4]);
    assert_eq!(outputs(&bus), [3, 4]);
    assert_eq!(bus.datagram(5, S, OUT + 1, &[9]).1, 0);
    assert_eq!(bus.read(S, IN, 2), [3, 4], "the application mirrors them");
}

#[test]
fn sync_manager_status_shows_the_last_written_buffer() {
    let mut bus = terminal(SAFEOP);
    let buffer = |bus: &mut Bus| bus.read(S, 0x805, 1)[0] >> 4 & 3;
    assert_eq!(buffer(&mut bus), 3, "none");
    let seen: Vec<u8> = (0..4)
        .map(|n| {
            bus.write(S, OUT, &[n, n]);
            buffer(&mut bus)
        })
        .collect();
    // The device does not fetch outputs in SafeOp, so the writer alternates between two buffers.
    assert_eq!(seen, [0, 1, 0, 1]);
}

#[test]
fn process_data_is_closed_below_safe_op() {
    let mut bus = terminal(PREOP);
    for at in [OUT, IN] {
        assert_eq!(bus.datagram(4, S, at, &[0; 2]).1, 0);
        assert_eq!(bus.datagram(5, S, at, &[0; 2]).1, 0);
    }
    assert_eq!(bus.read(S, 0x807, 1), [1], "deactivated by the device");
    bus.to(S, SAFEOP);
    assert_eq!(bus.read(S, 0x807, 1), [0]);
    assert_eq!(bus.datagram(5, S, OUT, &[0; 2]).1, 1);
}

#[test]
fn disabled_sync_manager_leaves_plain_memory() {
    let mut bus = Bus::new(vec![sim(&coe_device())]);
    bus.address_all();
    bus.write(S, 0x800, &[0, 0x10, 16, 0, 0x26, 0, 0, 0]);
    for _ in 0..2 {
        bus.write(S, 0x1004, &[5]);
        assert_eq!(bus.read(S, 0x1004, 1), [5]);
    }
    bus.write(S, 0x806, &[1]);
    assert_eq!(bus.datagram(5, S, 0x1004, &[6]).1, 0, "not from the middle");
    assert_eq!(bus.datagram(4, S, 0x1000, &[0]).1, 0, "not this way");
    bus.write(S, 0x1000, &[0; 16]);
    assert_eq!(bus.datagram(5, S, 0x1000, &[0; 16]).1, 0, "full");
    bus.write(S, 0x806, &[0]);
    assert_eq!(bus.read(S, 0x805, 1), [0], "emptied");
    bus.write(S, 0x1004, &[7]);
}

#[test]
fn enabled_sync_manager_ignores_configuration_writes() {
    let mut bus = terminal(SAFEOP);
    let before = bus.read(S, 0x800, 8);
    assert_eq!(bus.datagram(5, S, 0x800, &[0, 0x11, 4, 0, 0]).1, 0);
    assert_eq!(
        bus.datagram(5, S, 0x800, &[0, 0x11, 4, 0, 0, 0, 1, 0]).1,
        1,
        "the activation byte"
    );
    assert_eq!(bus.read(S, 0x800, 8), before);
    assert_eq!(bus.datagram(5, S, 0x805, &[0]).1, 0, "status");
    assert_eq!(bus.datagram(5, S, 0x807, &[0]).1, 0, "the device's control");
}

#[test]
fn overlapping_sync_managers_use_the_lower_number() {
    let mut bus = Bus::new(vec![sim(&coe_device())]);
    bus.address_all();
    // Written 0x1000–0x100f, read 0x1008–0x1017.
    bus.sm(S, 0, 0x1000, 16, 0x26);
    bus.sm(S, 1, 0x1008, 16, 0x22);
    assert_eq!(bus.datagram(5, S, 0x1000, &[1; 24]).1, 1);
    assert_eq!(bus.read(S, 0x805, 1), [9], "the first is full");
    assert_eq!(bus.datagram(4, S, 0x1008, &[0; 16]).1, 0);
    assert_eq!(bus.datagram(5, S, 0x1010, &[0; 8]).1, 0, "the second's");
}

#[test]
fn fmmu_maps_bits_at_any_start_and_end() {
    let mut bus = terminal(SAFEOP);
    // The data sheet's example: 14 bits, logical 0x10011.3 to 0x10013.0, at 0x13e1.1 to 0x13e2.6.
    let fmmu = |kind| [0x11, 0, 1, 0, 3, 0, 3, 0, 0xe1, 0x13, 1, kind, 1, 0, 0, 0];
    bus.write(S, 0x600, &fmmu(3));
    bus.write(S, 0x13e0, &[0xff; 4]);
    assert_eq!(bus.logical(11, 0x1_0010, &[0; 5]).1, 1);
    assert_eq!(bus.read(S, 0x13e0, 4), [0xff, 0x01, 0x80, 0xff]);
    assert_eq!(
        bus.logical(10, 0x1_0010, &[0xff; 5]),
        (vec![0xff, 0x07, 0x00, 0xfe, 0xff], 1)
    );
    // The middle byte alone.
    assert_eq!(bus.logical(11, 0x1_0012, &[0xff]).1, 1);
    assert_eq!(bus.read(S, 0x13e0, 4), [0xff, 0xc1, 0xbf, 0xff]);
    assert_eq!(bus.logical(11, 0x1_0010, &[0xff]).1, 0, "in front of it");
    assert_eq!(bus.logical(11, 0x1_0014, &[0xff]).1, 0, "behind it");
    // Deactivated, or without a direction.
    bus.write(S, 0x60c, &[0]);
    assert_eq!(bus.logical(12, 0x1_0010, &[0; 5]).1, 0);
    bus.write(S, 0x600, &fmmu(0));
    assert_eq!(bus.logical(12, 0x1_0010, &[0; 5]).1, 0);
}

#[test]
fn fmmu_may_span_several_sync_managers() {
    let mut bus = Bus::new(vec![sim(&coe_device())]);
    bus.address_all();
    bus.preop(S);
    // Mailbox out 0x1000–0x102f, mailbox in 0x1030–0x105f, memory behind them.
    bus.fmmu(S, 0, 0, 0x70, 0x1000, 3);
    bus.write(S, 0x1060, &[0x55; 16]);
    let (data, wkc) = bus.logical(12, 0, &[0xaa; 0x70]);
    assert_eq!(wkc, 3, "the empty mailbox is not read, memory is");
    assert_eq!(data[..0x60], [0xaa; 0x60]);
    assert_eq!(data[0x60..], [0x55; 16]);
    assert_eq!(bus.read(S, 0x805, 1)[0] & 8, 8, "written to its end");
    assert_eq!(bus.read(S, 0x1060, 16), [0xaa; 16]);
}

#[test]
fn registers_can_be_mapped() {
    let mut bus = Bus::new(vec![sim(&coe_device())]);
    bus.address_all();
    bus.preop(S);
    // The mailbox's full bit as one bit of the process image, as MainDevices poll mailboxes.
    let full = [0, 0, 0, 0, 1, 0, 5, 5, 0x0d, 8, 3, 1, 1, 0, 0, 0];
    bus.write(S, 0x600, &full);
    assert_eq!(bus.logical(10, 0, &[0]), (vec![0], 1));
    bus.send_mailbox(S, 3, &[0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0]);
    bus.wait(1_000_000);
    assert_eq!(bus.logical(10, 0, &[0]), (vec![0x20], 1));
    assert!(bus.fetch(S).is_some());
    assert_eq!(bus.logical(10, 0, &[0]), (vec![0], 1));
    // Mapped register writes take effect like any other; unmapped bits keep their value.
    let divider = [8, 0, 0, 0, 1, 0, 0, 3, 0, 4, 4, 2, 1, 0, 0, 0];
    bus.write(S, 0x610, &divider);
    assert_eq!(bus.logical(11, 8, &[0x05]).1, 1);
    assert_eq!(bus.read_u16(S, 0x400), 0x0952);
    // Read-only registers do not count.
    let status = [9, 0, 0, 0, 1, 0, 0, 7, 0x30, 1, 0, 2, 1, 0, 0, 0];
    bus.write(S, 0x610, &status);
    assert_eq!(bus.logical(11, 9, &[8]).1, 0);
}

#[test]
fn overlapping_fmmus_use_the_lower_number() {
    let mut bus = terminal(SAFEOP);
    bus.write(S, 0x13e0, &[1, 2, 3, 4]);
    bus.fmmu(S, 0, 0x100, 2, 0x13e0, 1);
    bus.fmmu(S, 1, 0x101, 2, 0x13e2, 1);
    assert_eq!(bus.logical(10, 0x100, &[0; 4]), (vec![1, 2, 4, 0], 1));
}

#[test]
fn digital_output_registers_and_user_ram_count_accesses() {
    let mut bus = terminal(INIT);
    for (at, len, reads, writes) in [
        (0x0f00, 4, 1, 1),
        (0x0f04, 12, 0, 0),
        (0x0f10, 8, 1, 1),
        (0x0f18, 8, 1, 0),
        (0x0f20, 96, 0, 0),
        (0x0f80, 128, 1, 1),
    ] {
        let zeros = vec![0; len];
        let counters = [4, 5].map(|code| bus.datagram(code, S, at, &zeros).1);
        assert_eq!(counters, [reads, writes], "0x{at:04x}");
    }
    // A single byte of outputs with a SyncManager, as in simple output terminals.
    let mut device = io_device();
    device.eeprom.config_data = vec![4, 1, 0, 0x44];
    let mut bus = Bus::new(vec![sim(&device)]);
    bus.address_all();
    bus.sm(S, 1, 0x0f00, 1, 0x44);
    bus.write(S, 0x0f00, &[0xa5]);
    assert_eq!(bus.read(S, 0x0f00, 1), [0xa5]);
    assert_eq!(bus.read(S, 0x440, 1), [1], "it triggers the watchdog");
}

proptest! {
    /// With any SyncManager and FMMU settings, answers keep their length and the device its memory.
    #[test]
    fn memory_survives_any_configuration(
        sms in prop::collection::vec(any::<[u8; 8]>(), 4),
        fmmus in prop::collection::vec(any::<[u8; 16]>(), 3),
        accesses in prop::collection::vec(
            (prop_oneof![Just(4u8), Just(5), Just(10), Just(11), Just(12)],
             any::<u16>(), 0u16..3, 0usize..1400),
            1..20),
    ) {
        let mut bus = Bus::new(vec![sim(&coe_device())]);
        bus.address_all();
        for (n, r) in (0..).zip(&sms) {
            // Enabled, and near the end of the memory.
            let r = [r[0], r[1] & 0x1f, r[2], r[3] & 0x0f, r[4], 0, 1, 0];
            bus.datagram(5, S, 0x800 + n * 8, &r);
        }
        for (n, r) in (0..).zip(&fmmus) {
            let mut r = *r;
            r[2..4].fill(0);
            (r[5], r[9], r[12]) = (r[5] & 7, r[9] & 0x1f, 1);
            bus.datagram(5, S, 0x600 + n * 16, &r);
        }
        for (code, low, high, len) in accesses {
            let (adp, ado) = if code < 10 { (S, low) } else { (low, high & 1) };
            let request = FrameBuilder::default().datagram(code, adp, ado, &vec![0x5a; len]);
            // A write to DL control may have closed the ports.
            let Some(bytes) = bus.frame(request.build()) else {
                return Ok(());
            };
            let datagram = frame::next(&bytes, None).unwrap();
            prop_assert_eq!(datagram.data.len(), len);
            prop_assert!(datagram.wkc(&bytes) <= 3);
        }
    }
}
