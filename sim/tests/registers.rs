//! Registers with effects: write protection, reset, events, watchdogs, application layer.

use crate::common::*;
use ecaxis_esi::model::Device;
use ecaxis_sim::frame::{self, FrameBuilder};
use ecaxis_sim::{AlState, DeviceOptions, SimDevice};

const S: u16 = 0x1001;

fn one(device: SimDevice) -> Bus {
    let mut bus = Bus::new(vec![device]);
    assert_eq!(bus.address_all(), 1);
    bus
}

fn drive_like() -> Bus {
    one(sim(&coe_device()))
}

/// Sends several datagrams in one frame. Returns their working counters.
fn together(bus: &mut Bus, datagrams: &[(u8, u16, &[u8])]) -> Vec<u16> {
    let frame = datagrams
        .iter()
        .fold(FrameBuilder::default(), |frame, (command, ado, data)| {
            frame.datagram(*command, S, *ado, data)
        });
    let bytes = bus.frame(frame.build()).unwrap();
    let mut counters = Vec::new();
    let mut at = frame::next(&bytes, None);
    while let Some(datagram) = at {
        counters.push(datagram.wkc(&bytes));
        at = frame::next(&bytes, Some(&datagram));
    }
    counters
}

/// Returns the IRQ field of a datagram without effect.
fn irq(bus: &mut Bus) -> u16 {
    let bytes = bus
        .frame(FrameBuilder::default().datagram(0, 0, 0, &[0]).build())
        .unwrap();
    u16::from_le_bytes([bytes[24], bytes[25]])
}

#[test]
fn protected_registers_accept_writes_in_the_enabling_frame() {
    let mut bus = drive_like();
    let divider: (u8, u16, &[u8]) = (5, 0x400, &[1, 2]);
    let ram: (u8, u16, &[u8]) = (5, 0x1e00, &[1]);
    bus.write(S, 0x21, &[1]);
    assert_eq!(together(&mut bus, &[divider, ram]), [0, 1]);
    let enable: (u8, u16, &[u8]) = (5, 0x20, &[0]);
    assert_eq!(together(&mut bus, &[enable, divider]), [1, 1]);
    assert_eq!(together(&mut bus, &[divider]), [0], "for that frame only");
    assert_eq!(bus.read_u16(S, 0x400), 0x0201);
    assert_eq!(together(&mut bus, &[enable, (5, 0x21, &[0])]), [1, 1]);
    assert_eq!(together(&mut bus, &[divider]), [1]);
    // Everything but 0x0030.
    bus.write(S, 0x31, &[1]);
    let enable: (u8, u16, &[u8]) = (5, 0x30, &[0]);
    assert_eq!(together(&mut bus, &[divider, ram, (5, 0x20, &[0])]), [0; 3]);
    assert_eq!(together(&mut bus, &[enable, divider, ram]), [1; 3]);
    assert_eq!(together(&mut bus, &[enable, (5, 0x31, &[0])]), [1, 1]);
    assert_eq!(together(&mut bus, &[ram]), [1]);
}

#[test]
fn three_frames_with_res_reset_the_controller() {
    let mut bus = drive_like();
    bus.preop(S);
    bus.write(S, 0x400, &[1, 2]);
    for (byte, progress) in [(b'R', 1), (b'E', 2)] {
        bus.write(S, 0x40, &[byte]);
        assert_eq!(
            bus.segment.device(0).unwrap().registers(0x40, 1),
            [progress]
        );
    }
    // Another frame in between restarts the sequence.
    assert_eq!(bus.read(S, 0x40, 1), [2]);
    bus.write(S, 0x40, b"S");
    assert_eq!(bus.read_u16(S, 0x130), 2);
    for byte in [b'R', b'E', b'S'] {
        bus.write(S, 0x40, &[byte]);
    }
    assert_eq!(bus.datagram(4, S, 0, &[0]).1, 0, "no station address");
    assert_eq!(bus.datagram(1, 0, 0x130, &[0, 0]), (vec![1, 0], 1));
    assert_eq!(bus.datagram(1, 0, 0x400, &[0, 0]).0, [0xc2, 0x09]);
    assert_eq!(
        bus.segment.device(0).unwrap().al_state(),
        AlState::Init,
        "the application too"
    );
}

#[test]
fn events_set_the_masked_irq_field_until_read() {
    let mut bus = drive_like();
    assert_eq!(bus.read_u16(S, 0x210), 0x0004, "DL status since power-on");
    assert_eq!(irq(&mut bus), 0, "masked");
    bus.write(S, 0x200, &[0x0c, 0]);
    assert_eq!(irq(&mut bus), 0x0004);
    bus.read(S, 0x111, 1);
    assert_eq!(irq(&mut bus), 0, "any byte of it acknowledges");
    bus.preop(S);
    // `preop` has read AL status last.
    assert_eq!(irq(&mut bus), 0);
    bus.write(S, 0x120, &[1]);
    bus.wait(1_000_000);
    assert_eq!(irq(&mut bus), 0x0008, "AL status");
    bus.read(S, 0x134, 2);
    assert_eq!(irq(&mut bus), 0x0008, "the code does not acknowledge");
    bus.datagram(7, 0, 0x130, &[0, 0]);
    assert_eq!(irq(&mut bus), 0);
    bus.write(S, 0x120, &[0x11]);
    bus.wait(1_000_000);
    assert_eq!(irq(&mut bus), 0, "the state did not change");
}

#[test]
fn events_of_all_devices_are_ored() {
    let mut bus = Bus::new(vec![sim(&coe_device()), sim(&coe_device())]);
    bus.address_all();
    bus.write(0x1001, 0x200, &[0x04, 0]);
    bus.write(0x1002, 0x200, &[0x08, 0]);
    assert_eq!(irq(&mut bus), 0x0004);
    bus.preop(0x1002);
    bus.write(0x1002, 0x120, &[1]);
    bus.wait(1_000_000);
    assert_eq!(irq(&mut bus), 0x000c);
}

#[test]
fn sync_managers_set_their_enabled_event_registers() {
    let mut bus = drive_like();
    // Bit 4 of the control byte enables the ECAT event, bit 5 the PDI event.
    bus.sm(S, 0, 0x1000, 48, 0x36);
    bus.sm(S, 1, 0x1030, 48, 0x32);
    bus.to(S, PREOP);
    bus.write(S, 0x200, &[0xf0, 0x0f]);
    let events = |bus: &mut Bus| (bus.read_u16(S, 0x210) >> 4, bus.read(S, 0x221, 1)[0]);
    assert_eq!(events(&mut bus), (0, 0));
    bus.send_mailbox(S, 3, &[0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0]);
    assert_eq!(
        events(&mut bus),
        (0, 0b01),
        "the device has something to read"
    );
    bus.wait(1_000_000);
    assert_eq!(events(&mut bus), (0b11, 0), "it has read and answered");
    assert_eq!(irq(&mut bus), 0x0030);
    assert!(bus.fetch(S).is_some());
    assert_eq!(events(&mut bus), (0b01, 0b10), "fetched");
    assert_eq!(bus.read(S, 0x204, 4), [0x0f, 0xff, 0xff, 0], "reset value");
    assert_eq!(bus.datagram(5, S, 0x204, &[0; 4]).1, 0, "the device's own");
}

#[test]
fn device_sees_al_control_and_sync_manager_events() {
    let mut bus = drive_like();
    bus.write(S, 0x120, &[1, 0]);
    assert_eq!(bus.read(S, 0x220, 1)[0] & 1, 1);
    assert_eq!(
        bus.datagram(5, S, 0x120, &[2, 0]).1,
        0,
        "nothing more until the device has read it"
    );
    bus.wait(1_000_000);
    assert_eq!(bus.read(S, 0x220, 1)[0] & 1, 0);
    bus.write(S, 0x80e, &[0]);
    assert_eq!(bus.read(S, 0x220, 1)[0] & 0x10, 0x10);
}

fn terminal_in_op(control: u8) -> Bus {
    let mut bus = one(sim(&io_device()));
    bus.to(S, PREOP);
    bus.sm(S, 0, 0x1000, 2, control);
    bus.sm(S, 1, 0x1100, 2, 0x00);
    bus.to(S, SAFEOP);
    assert_eq!(bus.read(S, 0x440, 1), [0], "not yet triggered");
    bus.to(S, OP);
    bus
}

#[test]
fn process_data_watchdog_follows_divider_and_time() {
    // (divider, time, nanoseconds until it expires)
    for (divider, time, ns) in [
        (0x09c2_u16, 10_u16, 1_000_000),
        (0x09c2, 1_000, 100_000_000),
        (498, 100, 2_000_000),
        (48, 500, 1_000_000),
    ] {
        let mut bus = terminal_in_op(0x44);
        bus.write(S, 0x400, &divider.to_le_bytes());
        bus.write(S, 0x420, &time.to_le_bytes());
        bus.write(S, 0x1000, &[1, 2]);
        let sent = bus.now;
        assert_eq!(bus.read(S, 0x440, 1), [1]);
        bus.wait(sent + ns - bus.now - 20_000);
        assert_eq!(bus.read(S, 0x440, 1), [1], "{divider} {time}");
        bus.wait(40_000);
        assert_eq!(bus.read(S, 0x440, 4), [0, 0, 1, 0]);
        assert_eq!(bus.read(S, 0x130, 6), [0x14, 0, 0, 0, 0x1b, 0]);
    }
}

#[test]
fn watchdog_of_zero_or_without_trigger_never_expires() {
    let mut bus = terminal_in_op(0x44);
    bus.write(S, 0x1000, &[1, 2]);
    bus.write(S, 0x420, &[0, 0]);
    bus.wait(1_000_000_000);
    assert_eq!(bus.read(S, 0x440, 4), [1, 0, 0, 0], "switched off");
    assert_eq!(bus.read_u16(S, 0x130), 8);
    let mut bus = terminal_in_op(0x04);
    bus.write(S, 0x1000, &[1, 2]);
    bus.wait(1_000_000_000);
    assert_eq!(bus.read(S, 0x440, 4), [0, 0, 0, 0], "never triggered");
    assert_eq!(bus.read_u16(S, 0x130), 8);
}

#[test]
fn watchdog_counters_stop_at_255_and_are_cleared_by_any_write() {
    let mut bus = terminal_in_op(0x44);
    bus.write(S, 0x420, &[1, 0]);
    for n in 1..=300_u16 {
        bus.write(S, 0x1000, &[1, 2]);
        bus.wait(200_000);
        assert_eq!(u16::from(bus.read(S, 0x442, 1)[0]), n.min(255));
    }
    bus.write(S, 0x443, &[7]);
    assert_eq!(bus.read(S, 0x442, 2), [0, 0]);
}

#[test]
fn crashed_application_lets_its_pdi_watchdog_expire() {
    let mut bus = drive_like();
    bus.preop(S);
    bus.write(S, 0x200, &[0x04, 0]);
    bus.read(S, 0x110, 2);
    let now = bus.now;
    bus.segment.device_mut(0).unwrap().set_hanging(true, now);
    bus.wait(99_000_000);
    assert_eq!(bus.read(S, 0x443, 1), [0]);
    assert_eq!(bus.read(S, 0x110, 1)[0] & 2, 2);
    bus.wait(2_000_000);
    assert_eq!(bus.read(S, 0x443, 1), [1]);
    assert_eq!(irq(&mut bus), 4, "DL status changed");
    assert_eq!(bus.read(S, 0x110, 1)[0] & 2, 0);
    // The controller answers, the application does not.
    bus.write(S, 0x120, &[1, 0]);
    bus.wait(1_000_000_000);
    assert_eq!(bus.read_u16(S, 0x130), 2);
    assert_eq!(bus.read(S, 0x443, 1), [1], "once");
    let now = bus.now;
    bus.segment.device_mut(0).unwrap().set_hanging(false, now);
    bus.wait(1_000_000);
    assert_eq!(bus.read_u16(S, 0x130), 1);
    assert_eq!(bus.read(S, 0x110, 1)[0] & 2, 2);
}

#[test]
fn errors_end_by_acknowledge_or_init() {
    let mut bus = drive_like();
    bus.preop(S);
    assert_eq!(bus.request(S, 8), (0x12, 0x11));
    assert_eq!(bus.request(S, 2), (0x12, 0x11), "not acknowledged");
    assert_eq!(bus.request(S, 4), (0x12, 0x11));
    assert_eq!(bus.request(S, 1), (1, 0), "Init needs no acknowledgement");
    bus.to(S, PREOP);
    assert_eq!(bus.request(S, 8), (0x12, 0x11));
    assert_eq!(bus.request(S, 0x12), (2, 0));
    assert_eq!(bus.request(S, 8), (0x12, 0x11));
    assert_eq!(
        bus.request(S, 0x18),
        (0x12, 0x11),
        "acknowledged, refused again"
    );
}

#[test]
fn bootstrap_is_entered_from_init_and_left_to_init() {
    let mut device = coe_device();
    device.eeprom.bootstrap = vec![0, 0x10, 0x80, 0, 0x80, 0x10, 0x80, 0];
    let mut bus = one(sim(&device));
    assert_eq!(bus.request(S, 3), (0x11, 0x15), "mailbox not set up");
    bus.sm(S, 0, 0x1000, 0x80, 0x26);
    bus.sm(S, 1, 0x1080, 0x80, 0x22);
    assert_eq!(bus.request(S, 0x13), (3, 0));
    assert_eq!(bus.request(S, 2), (0x13, 0x11));
    assert_eq!(bus.request(S, 0x14), (0x13, 0x11));
    assert_eq!(bus.request(S, 1), (1, 0));
    let mut bus = drive_like();
    assert_eq!(
        bus.request(S, 3),
        (0x11, 0x13),
        "Bootstrap is not supported"
    );
}

#[test]
fn device_shows_its_identification_on_request() {
    let options = DeviceOptions {
        alias: 77,
        ..DeviceOptions::default()
    };
    let mut bus = one(sim_with(&coe_device(), options));
    bus.preop(S);
    assert_eq!(bus.request(S, 0x22), (0x22, 77));
    assert_eq!(bus.request(S, 2), (2, 0));
    assert_eq!(bus.request(S, 0x28), (0x12, 0x11), "an error goes first");
}

/// Returns a terminal with device emulation (bit 8 of the EEPROM's first word).
fn emulated() -> Device {
    let mut device = io_device();
    device.eeprom.config_data = vec![4, 1, 0, 0x44];
    device
}

#[test]
fn device_emulation_copies_al_control_to_al_status() {
    let mut bus = one(sim(&emulated()));
    for control in [0x0002_u16, 0x0008, 0x0011, 0x0004, 0x0001, 0x0007, 0x0014] {
        bus.write(S, 0x120, &control.to_le_bytes());
        assert_eq!(
            bus.read_u16(S, 0x130),
            control,
            "at once, error bit and all"
        );
        assert_eq!(bus.read_u16(S, 0x134), 0);
    }
    // With device emulation no application closes SyncManagers or reacts to the watchdog.
    bus.write(S, 0x120, &[1, 0]);
    bus.sm(S, 0, 0x1000, 2, 0x44);
    assert_eq!(bus.datagram(5, S, 0x1000, &[1, 2]).1, 1);
    bus.write(S, 0x120, &[8, 0]);
    bus.sm(S, 1, 0x1100, 2, 0x00);
    bus.write(S, 0x1000, &[5, 6]);
    assert_eq!(bus.read(S, 0x1100, 2), [5, 6], "outputs count in Op");
    bus.wait(1_000_000_000);
    assert_eq!(
        (bus.read_u16(S, 0x130), bus.read(S, 0x440, 3)),
        (8, vec![0, 0, 1])
    );
}
