//! Distributed clocks, SYNC0 and repeatability.

mod common;

use common::*;
use ecaxis_sim::frame::FrameBuilder;
use ecaxis_sim::{DeviceOptions, Transit};

const CYCLE: u64 = 1_000_000;

fn four_drifting() -> Bus {
    let devices = [(0.0, 0), (50.0, 7_000), (-50.0, 123_456), (37.0, 99)].map(|(ppm, offset)| {
        let options = DeviceOptions {
            clock_drift_ppm: ppm,
            clock_offset_ns: offset,
            ..DeviceOptions::default()
        };
        sim_with(&coe_device(), options)
    });
    let mut bus = Bus::new(devices.to_vec());
    assert_eq!(bus.address_all(), 4);
    bus
}

/// Latches receive times, works out delays and writes offsets, as any MainDevice does.
fn measure(bus: &mut Bus) -> Vec<u32> {
    assert_eq!(bus.datagram(8, 0, 0x900, &[0; 4]).1, 4);
    let mut delays = Vec::new();
    let mut delay = 0;
    let mut outer = 0;
    for station in 0x1001..0x1005 {
        let times = bus.read(station, 0x900, 8);
        let port = |n: usize| u32::from_le_bytes(times[n * 4..n * 4 + 4].try_into().unwrap());
        let inner = if station == 0x1004 {
            0
        } else {
            port(1).wrapping_sub(port(0))
        };
        if station > 0x1001 {
            delay += (outer - inner) / 2;
        }
        outer = inner;
        delays.push(delay);
        let local = u64::from_le_bytes(bus.read(station, 0x918, 8).try_into().unwrap());
        bus.write(
            station,
            0x920,
            &1_000_000_000_u64.wrapping_sub(local).to_le_bytes(),
        );
        bus.write(station, 0x928, &delay.to_le_bytes());
    }
    delays
}

fn spread(bus: &Bus) -> u64 {
    let times = (0..4).map(|n| bus.segment.device(n).unwrap().system_time(bus.now).unwrap());
    let times: Vec<u64> = times.collect();
    times.iter().max().unwrap() - times.iter().min().unwrap()
}

fn frmw(bus: &mut Bus, seconds: u64) {
    let start = bus.now;
    for n in 0..seconds * 1000 {
        bus.now = start + n * CYCLE;
        assert_eq!(bus.datagram(14, 0x1001, 0x910, &[0; 8]).1, 4);
    }
}

#[test]
fn delays_come_out_of_the_receive_times() {
    let mut bus = four_drifting();
    // 500 ns through a device and 25 ns along a cable.
    for (measured, expected) in measure(&mut bus).into_iter().zip([0, 525, 1050, 1575]) {
        assert!(
            measured.abs_diff(expected) <= 3,
            "{measured} for {expected}"
        );
    }
}

#[test]
fn clocks_lock_under_frmw_and_drift_apart_without() {
    let mut bus = four_drifting();
    measure(&mut bus);
    frmw(&mut bus, 2);
    for _ in 0..1000 {
        frmw(&mut bus, 0);
        bus.wait(CYCLE);
        bus.datagram(14, 0x1001, 0x910, &[0; 8]);
        assert!(spread(&bus) < 100, "{} ns", spread(&bus));
    }
    for station in 0x1002..0x1005 {
        let difference = bus.read(station, 0x92c, 4);
        assert!(u32::from_le_bytes(difference.try_into().unwrap()) & 0x7fff_ffff < 100);
    }
    // Learnt rates last a while; a restarted loop runs on the bare crystal.
    bus.datagram(8, 0, 0x930, &[0, 0x10]);
    bus.wait(1_000_000_000);
    assert!(spread(&bus) > 80_000, "{} ns", spread(&bus));
}

#[test]
fn rarer_frames_lock_as_well() {
    let mut bus = four_drifting();
    measure(&mut bus);
    for _ in 0..500 {
        bus.wait(20_000_000);
        bus.datagram(14, 0x1001, 0x910, &[0; 8]);
    }
    assert!(spread(&bus) < 100, "{} ns", spread(&bus));
}

fn to_preop_with_sms(bus: &mut Bus, station: u16) {
    bus.preop(station);
    bus.sm(station, 2, 0x1100, 4, 0x24);
    bus.sm(station, 3, 0x1200, 4, 0x20);
}

fn activate(bus: &mut Bus, station: u16, start: u64) {
    bus.write(station, 0x9a0, &(CYCLE as u32).to_le_bytes());
    bus.write(station, 0x990, &start.to_le_bytes());
    bus.write(station, 0x980, &[0, 3]);
}

#[test]
fn sync0_pulses_together_from_the_start_time_on() {
    let mut bus = four_drifting();
    measure(&mut bus);
    frmw(&mut bus, 3);
    let now = bus.segment.device(0).unwrap().system_time(bus.now).unwrap();
    let start = (now / CYCLE + 50) * CYCLE;
    for station in 0x1001..0x1005 {
        activate(&mut bus, station, start);
        assert_eq!(bus.read(station, 0x990, 8), start.to_le_bytes());
    }
    bus.wait(20_000_000);
    assert!((0..4).all(|n| bus.segment.device(n).unwrap().sync0_count() == 0));
    frmw(&mut bus, 1);
    let log = |n: usize| {
        bus.segment
            .device(n)
            .unwrap()
            .sync0_log()
            .collect::<Vec<_>>()
    };
    let reference = log(0);
    assert_eq!(reference.len(), 64);
    for n in 1..4 {
        for (a, b) in reference.iter().zip(log(n)) {
            assert!(a.abs_diff(b) < 100, "device {n}: {a} {b}");
        }
    }
    for pair in reference.windows(2) {
        assert!((pair[1] - pair[0]).abs_diff(CYCLE) < 5);
    }
}

#[test]
fn a_start_time_in_the_past_never_starts_and_refuses_op() {
    let mut bus = four_drifting();
    measure(&mut bus);
    to_preop_with_sms(&mut bus, 0x1001);
    activate(&mut bus, 0x1001, 1);
    bus.to(0x1001, SAFEOP);
    bus.wait(100_000_000);
    assert_eq!(bus.segment.device(0).unwrap().sync0_count(), 0);
    assert_eq!(bus.request(0x1001, 8), (0x14, 0x2d));
}

#[test]
fn op_waits_for_the_first_pulse() {
    let mut bus = four_drifting();
    measure(&mut bus);
    to_preop_with_sms(&mut bus, 0x1001);
    let now = bus.segment.device(0).unwrap().system_time(bus.now).unwrap();
    activate(&mut bus, 0x1001, now + 100_000_000);
    bus.to(0x1001, SAFEOP);
    assert_eq!(bus.request(0x1001, 8), (4, 0));
    bus.wait(110_000_000);
    assert_eq!(bus.read_u16(0x1001, 0x130), 8);
    bus.write(0x1001, 0x981, &[0]);
    bus.wait(1_000_000);
    assert_eq!(
        (bus.read_u16(0x1001, 0x130), bus.read_u16(0x1001, 0x134)),
        (0x14, 0x2c)
    );
}

#[test]
fn sync_settings_are_checked_on_the_way_to_safe_op() {
    let mut bus = four_drifting();
    to_preop_with_sms(&mut bus, 0x1001);
    bus.write(0x1001, 0x981, &[1]);
    assert_eq!(bus.request(0x1001, 4), (0x12, 0x30));
    bus.write(0x1001, 0x981, &[3]);
    assert_eq!(bus.request(0x1001, 0x14), (0x12, 0x35));
}

#[test]
fn outputs_take_effect_and_inputs_are_latched_at_sync0() {
    let mut bus = four_drifting();
    measure(&mut bus);
    let s = 0x1001;
    to_preop_with_sms(&mut bus, s);
    bus.fmmu(s, 0, 0, 4, 0x1100, 2);
    bus.fmmu(s, 1, 0, 4, 0x1200, 1);
    let now = bus.segment.device(0).unwrap().system_time(bus.now).unwrap();
    activate(&mut bus, s, now + 10_000_000);
    bus.to(s, SAFEOP);
    bus.request(s, 8);
    bus.wait(20_000_000);
    let pulse = bus.segment.device(0).unwrap().sync0_log().last().unwrap();
    bus.now = pulse + CYCLE * 2 + CYCLE / 2;
    bus.logical(12, 0, &[1, 0, 2, 0]);
    assert_eq!(
        bus.logical(12, 0, &[1, 0, 2, 0]),
        (vec![0; 4], 3),
        "no SYNC0 in between"
    );
    bus.wait(CYCLE);
    assert_eq!(bus.logical(12, 0, &[1, 0, 2, 0]), (vec![1, 0, 2, 0], 3));
}

fn run() -> Vec<u8> {
    let mut bus = four_drifting();
    let script = "seed = 5\n[[fault]]\nkind = \"frame-loss\"\nprobability = 0.1\n";
    measure(&mut bus);
    bus.segment
        .set_faults(ecaxis_sim::FaultScript::parse(script).unwrap());
    let mut seen = Vec::new();
    for n in 0..500 {
        let mut bytes = FrameBuilder::default()
            .datagram(14, 0x1001, 0x910, &[0; 8])
            .datagram(7, 0, 0x92c, &[0; 4])
            .datagram(4, 0x1003, 0x910, &[0; 8])
            .build();
        match bus.segment.transit(&mut bytes, bus.now + n * CYCLE) {
            Transit::Back { at, .. } => {
                seen.extend(bytes);
                seen.extend(at.to_le_bytes());
            }
            Transit::Lost => seen.push(0xee),
        }
    }
    seen
}

#[test]
fn the_same_seed_gives_the_same_bytes() {
    assert!(run() == run());
}

#[test]
fn frames_queue_up_on_the_wire() {
    let mut bus = four_drifting();
    let mut back = |len: usize| {
        let mut bytes = FrameBuilder::default()
            .datagram(7, 0, 0x1e00, &vec![0; len])
            .build();
        match bus.segment.transit(&mut bytes, bus.now) {
            Transit::Back { at, .. } => at - bus.now,
            Transit::Lost => panic!("lost"),
        }
    };
    // 84 byte times; out through four devices and back: 4 + 3 times 500 ns, 8 cables.
    assert_eq!(back(2), 6_720 + 3_700);
    assert_eq!(back(2), 6_720 * 2 + 3_700);
}
