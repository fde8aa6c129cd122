//! SYNC0, SYNC1, latches and the clock registers, accessed over the wire.

use crate::common::*;
use ecaxis_sim::{DeviceOptions, EscInfo};

const S: u16 = 0x1001;
const MS: u64 = 1_000_000;

/// Returns a device whose system time is about true time.
fn clock() -> Bus {
    clock_of(None)
}

fn clock_of(esc: Option<EscInfo>) -> Bus {
    let options = DeviceOptions {
        esc,
        ..DeviceOptions::default()
    };
    let mut bus = Bus::new(vec![sim_with(&coe_device(), options)]);
    bus.address_all();
    bus
}

fn u64_at(bus: &mut Bus, at: u16) -> u64 {
    u64::from_le_bytes(bus.read(S, at, 8).try_into().unwrap())
}

/// Sets SYNC0 and SYNC1 cycle times and the start time.
fn set(bus: &mut Bus, cycles: [u32; 2], start: u64) {
    let cycles = cycles.map(u32::to_le_bytes).concat();
    bus.write(S, 0x9a0, &cycles);
    bus.write(S, 0x990, &start.to_le_bytes());
}

fn pulses(bus: &Bus) -> [Vec<u64>; 2] {
    let device = bus.segment.device(0).unwrap();
    [device.sync0_log().collect(), device.sync1_log().collect()]
}

#[test]
fn sync_outputs_show_their_next_times() {
    let mut bus = clock();
    set(&mut bus, [1_000_000, 1_500_000], 20 * MS);
    assert_eq!(u64_at(&mut bus, 0x990), 20 * MS);
    bus.write(S, 0x981, &[7]);
    assert_eq!(bus.read(S, 0x984, 1), [3], "both pending");
    assert_eq!(u64_at(&mut bus, 0x998), 21_500_000);
    bus.now = 24_700_000;
    assert_eq!(bus.read(S, 0x984, 1), [0]);
    assert_eq!(u64_at(&mut bus, 0x990), 25 * MS);
    assert_eq!(u64_at(&mut bus, 0x998), 25_500_000);
    let [sync0, sync1] = pulses(&bus);
    assert_eq!(sync0, [20, 21, 22, 23, 24].map(|ms| ms * MS));
    assert_eq!(sync1, [21_500_000, 23_500_000]);
    bus.write(S, 0x981, &[0]);
    bus.wait(10 * MS);
    assert_eq!(pulses(&bus)[0].len(), 5, "switched off");
}

#[test]
fn sync_outputs_switch_separately() {
    for (activation, expected) in [
        (0x01, [0, 0]),
        (0x03, [5, 0]),
        (0x05, [0, 5]),
        (0x06, [0, 0]),
    ] {
        let mut bus = clock();
        set(&mut bus, [1_000_000, 0], 20 * MS);
        bus.write(S, 0x981, &[activation]);
        bus.wait(24_500_000 - bus.now);
        assert_eq!(
            pulses(&bus).map(|log| log.len()),
            expected,
            "0x{activation:02x}"
        );
    }
}

#[test]
fn single_shot_is_one_pulse() {
    let mut bus = clock();
    set(&mut bus, [0, 0], 20 * MS);
    bus.write(S, 0x981, &[3]);
    bus.wait(1_000 * MS);
    assert_eq!(pulses(&bus)[0], [20 * MS]);
    let again = bus.now + 5 * MS;
    bus.write(S, 0x981, &[0]);
    set(&mut bus, [0, 0], again);
    bus.write(S, 0x981, &[3]);
    bus.wait(1_000 * MS);
    assert_eq!(pulses(&bus)[0], [20 * MS, again]);
}

#[test]
fn start_time_write_may_activate() {
    let mut bus = clock();
    bus.write(S, 0x9a0, &1_000_000_u32.to_le_bytes());
    bus.write(S, 0x981, &[0x0a]);
    bus.write(S, 0x990, &(20 * MS).to_le_bytes());
    assert_eq!(bus.read(S, 0x981, 1), [0x0b]);
    bus.wait(25_500_000 - bus.now);
    assert_eq!(pulses(&bus)[0].len(), 6);
    // A start time of 32 bits is completed from the present time.
    bus.wait(5_000_000_000);
    bus.write(S, 0x981, &[0]);
    bus.write(S, 0x981, &[0x1a]);
    let start = bus.now + 10 * MS;
    bus.write(S, 0x990, &(start as u32).to_le_bytes());
    assert_eq!(u64_at(&mut bus, 0x990), start);
    bus.wait(11 * MS);
    assert!(pulses(&bus)[0].contains(&start));
}

#[test]
fn implausible_start_time_starts_at_once_and_is_reported() {
    let mut bus = clock();
    bus.wait(100 * MS);
    set(&mut bus, [1_000_000, 0], 50 * MS);
    bus.write(S, 0x981, &[0x23]);
    assert_eq!(bus.read(S, 0x984, 1)[0] & 4, 4);
    assert!(!pulses(&bus)[0].is_empty());
    // A chip without the enhanced activation does not support this.
    let mut bus = clock_of(Some(EscInfo::ET1100));
    bus.wait(100 * MS);
    set(&mut bus, [1_000_000, 0], 50 * MS);
    bus.write(S, 0x981, &[0x23]);
    assert_eq!(bus.read(S, 0x981, 1), [3]);
    assert_eq!(bus.datagram(4, S, 0x984, &[0]).1, 0);
    bus.wait(100 * MS);
    assert!(pulses(&bus)[0].is_empty(), "the start time has gone by");
}

#[test]
fn debug_pulse_is_one_immediate_pulse() {
    let mut bus = clock();
    bus.write(S, 0x981, &[0x86]);
    assert_eq!(bus.read(S, 0x981, 1), [0x06]);
    bus.wait(10 * MS);
    assert_eq!(pulses(&bus).map(|log| log.len()), [1, 1]);
}

#[test]
fn acknowledge_mode_gives_a_crashed_application_one_pulse() {
    // No pulse length in the EEPROM: acknowledge mode.
    let mut bus = clock();
    set(&mut bus, [1_000_000, 0], 20 * MS);
    bus.write(S, 0x981, &[3]);
    bus.wait(22_500_000 - bus.now);
    assert_eq!(bus.read(S, 0x98e, 1), [0], "acknowledged each time");
    assert_eq!(pulses(&bus)[0].len(), 3);
    let now = bus.now;
    bus.segment.device_mut(0).unwrap().set_hanging(true, now);
    bus.wait(10 * MS);
    assert_eq!(bus.read(S, 0x98e, 1), [1]);
    assert_eq!(pulses(&bus)[0].len(), 4);
    let now = bus.now;
    bus.segment.device_mut(0).unwrap().set_hanging(false, now);
    assert_eq!(bus.read(S, 0x98e, 1), [0], "served when it is back");
    bus.wait(2 * MS);
    assert_eq!(pulses(&bus)[0].len(), 6);
}

#[test]
fn cyclic_unit_is_assignable_to_the_device() {
    let mut bus = clock();
    // (0x0980, address, length, accepted from the MainDevice)
    for (control, at, len, accepted) in [
        (0x00, 0x981, 1, 1),
        (0x01, 0x981, 1, 0),
        (0x01, 0x990, 8, 0),
        (0x01, 0x9a0, 4, 0),
        (0x01, 0x9a4, 4, 0),
        (0x03, 0x9a4, 4, 1),
        (0x02, 0x9a4, 4, 0),
        (0x02, 0x9a0, 4, 1),
        (0x00, 0x9a8, 2, 1),
        (0x10, 0x9a8, 1, 0),
        (0x10, 0x9a9, 1, 1),
        (0x20, 0x9a9, 1, 0),
    ] {
        bus.write(S, 0x980, &[control]);
        assert_eq!(
            bus.datagram(5, S, at, &vec![0; len]).1,
            accepted,
            "0x0980 = 0x{control:02x}, 0x{at:04x}"
        );
    }
    // Assigned and activated with one datagram, as AssignActivate does.
    bus.write(S, 0x980, &[0, 0]);
    set(&mut bus, [1_000_000, 0], 20 * MS);
    bus.write(S, 0x980, &[1, 3]);
    bus.wait(21_500_000 - bus.now);
    assert_eq!(pulses(&bus)[0].len(), 2);
}

#[test]
fn clock_times_freeze_at_their_first_byte() {
    let mut bus = clock();
    set(&mut bus, [1_000_000, 500_000], 20 * MS);
    bus.write(S, 0x981, &[7]);
    bus.wait(21_400_000 - bus.now);
    let low = bus.read(S, 0x990, 1)[0];
    assert_eq!(low, (22 * MS).to_le_bytes()[0]);
    bus.wait(5 * MS);
    assert_eq!(bus.read(S, 0x991, 7), (22 * MS).to_le_bytes()[1..]);
    assert_eq!(u64_at(&mut bus, 0x990), 27 * MS);
    // The system time is that of the frame that reads it.
    let now = bus.now + 25;
    assert_eq!(bus.read(S, 0x914, 4), ((now >> 32) as u32).to_le_bytes());
    let now = bus.now + 25;
    assert_eq!(u64_at(&mut bus, 0x910), now);
}

fn edge(bus: &mut Bus, latch: usize, level: bool) -> u64 {
    bus.wait(12_345);
    let now = bus.now;
    let device = bus.segment.device_mut(0).unwrap();
    device.set_latch(latch, level, now);
    device.system_time(now).unwrap()
}

#[test]
fn latches_take_the_time_of_edges() {
    let mut bus = clock();
    bus.write(S, 0x920, &1_000_000_000_000_u64.to_le_bytes());
    bus.write(S, 0x200, &[1, 0]);
    for (latch, base) in [(0, 0x9b0), (1, 0x9c0)] {
        let status = 0x9ae + latch as u16;
        // Continuous: the last edge, and no events.
        edge(&mut bus, latch, true);
        edge(&mut bus, latch, false);
        let rising = edge(&mut bus, latch, true);
        let falling = edge(&mut bus, latch, false);
        assert_eq!(u64_at(&mut bus, base), rising);
        assert_eq!(u64_at(&mut bus, base + 8), falling);
        assert_eq!(bus.read(S, status, 1), [0]);
        assert_eq!(bus.read_u16(S, 0x210) & 1, 0);
        // Single event: the first edge until it has been read.
        bus.write(S, 0x9a8 + latch as u16, &[3]);
        let rising = edge(&mut bus, latch, true);
        assert_eq!(bus.read(S, status, 1), [5], "level, positive edge");
        let falling = edge(&mut bus, latch, false);
        edge(&mut bus, latch, true);
        assert_eq!(bus.read(S, status, 1), [7]);
        assert_eq!(bus.read_u16(S, 0x210) & 1, 1);
        assert_eq!(u64_at(&mut bus, base), rising);
        assert_eq!(bus.read(S, status, 1), [6], "one is read");
        assert_eq!(bus.read_u16(S, 0x210) & 1, 1, "one is not");
        assert_eq!(u64_at(&mut bus, base + 8), falling);
        assert_eq!(bus.read_u16(S, 0x210) & 1, 0);
        assert_eq!(bus.datagram(5, S, base, &[0; 8]).1, 0, "read only");
        bus.write(S, 0x9a8 + latch as u16, &[0]);
        edge(&mut bus, latch, false);
    }
}

#[test]
fn latch_unit_of_the_device_sets_pdi_events() {
    let mut bus = clock();
    bus.write(S, 0x9a8, &[1]);
    bus.write(S, 0x980, &[0x10]);
    let rising = edge(&mut bus, 0, true);
    let events = |bus: &mut Bus| (bus.read_u16(S, 0x210) & 1, bus.read(S, 0x220, 1)[0] & 2);
    assert_eq!(events(&mut bus), (0, 2));
    assert_eq!(u64_at(&mut bus, 0x9b0), rising);
    assert_eq!(
        events(&mut bus),
        (0, 2),
        "the MainDevice's reading does not count"
    );
    bus.segment.device_mut(0).unwrap().acknowledge_latch(0);
    assert_eq!(events(&mut bus), (0, 0));
}

#[test]
fn sync_manager_accesses_store_their_time() {
    let mut bus = clock();
    bus.write(S, 0x800, &[0, 0x10, 48, 0, 0x26, 0, 0x41, 0]);
    bus.sm(S, 1, 0x1030, 48, 0x22);
    bus.to(S, PREOP);
    let sent = bus.now + 25;
    bus.send_mailbox(S, 3, &[0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0]);
    assert_eq!(bus.read(S, 0x9f0, 4), (sent as u32).to_le_bytes());
}

#[test]
fn port_receive_times_latch_only_on_bwr_and_fpwr() {
    let mut bus = clock();
    // (command, address, taken at the port, taken at the processing unit)
    for (command, address, port, unit) in [
        (8, 0, true, true),
        (5, S, true, true),
        (2, 0, false, true),
        (6, S, false, true),
        (4, S, false, false),
    ] {
        bus.wait(MS);
        let at = bus.now + 25;
        assert!(bus.datagram(command, address, 0x900, &[0; 4]).1 > 0);
        let seen = (
            bus.read(S, 0x900, 4) == (at as u32).to_le_bytes(),
            u64_at(&mut bus, 0x918) == at,
        );
        assert_eq!(seen, (port, unit), "command {command}");
    }
}

#[test]
fn clock_of_32_bits_lacks_the_upper_halves_and_wraps() {
    let narrow = EscInfo {
        features: EscInfo::LAN9252.features & !0x0008,
        ..EscInfo::LAN9252
    };
    let mut bus = clock_of(Some(narrow));
    assert_eq!(bus.read_u16(S, 8), 0x01c4);
    for at in [0x914, 0x924, 0x994, 0x99c, 0x9b4] {
        assert_eq!(bus.datagram(4, S, at, &[0; 4]).1, 0, "0x{at:04x}");
    }
    assert_eq!(bus.read(S, 0x910, 8)[4..], [0; 4]);
    // A past start time recurs after 4.3 s.
    bus.wait(100 * MS);
    bus.write(S, 0x9a0, &1_000_000_u32.to_le_bytes());
    bus.write(S, 0x990, &(50 * MS as u32).to_le_bytes());
    bus.write(S, 0x981, &[3]);
    bus.wait((1 << 32) - 60 * MS);
    assert!(pulses(&bus)[0].is_empty());
    bus.wait(20 * MS);
    assert_eq!(pulses(&bus)[0].first(), Some(&((1 << 32) + 50 * MS)));
    assert_eq!(bus.datagram(14, S, 0x910, &[0; 4]).1, 1);
}

#[test]
fn huge_start_time_does_not_hang() {
    let mut bus = clock();
    for (cycle, start) in [
        (1, 20 * MS),
        (59, 0),
        (u32::MAX, u64::MAX),
        (0, u64::MAX / 2),
    ] {
        bus.write(S, 0x981, &[0]);
        set(&mut bus, [cycle, 1], start);
        bus.write(S, 0x981, &[0x27]);
        bus.wait(50 * MS);
        bus.write(S, 0x920, &u64::MAX.wrapping_sub(5).to_le_bytes());
        bus.wait(50 * MS);
        bus.write(S, 0x920, &[0; 8]);
    }
}
