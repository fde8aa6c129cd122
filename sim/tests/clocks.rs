//! Distributed clocks, SYNC0 and repeatability.

use crate::common::*;
use ecaxis_sim::frame::FrameBuilder;
use ecaxis_sim::{DeviceOptions, FrameOutcome};

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

/// Latches receive times, computes delays and writes offsets, as every MainDevice does.
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
fn delays_follow_from_the_receive_times() {
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
    // Learnt rates last for a while. A restarted loop runs at the bare crystal's rate.
    bus.datagram(8, 0, 0x930, &[0, 0x10]);
    bus.wait(1_000_000_000);
    assert!(spread(&bus) > 80_000, "{} ns", spread(&bus));
}

#[test]
fn clocks_lock_with_rare_frames() {
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
fn sync0_pulses_are_simultaneous_from_the_start_time() {
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
fn start_time_in_the_past_never_starts_sync0_and_refuses_op() {
    let mut bus = four_drifting();
    measure(&mut bus);
    to_preop_with_sms(&mut bus, 0x1001);
    activate(&mut bus, 0x1001, 1);
    bus.to(0x1001, SAFEOP);
    bus.wait(100_000_000);
    assert_eq!(bus.segment.device(0).unwrap().sync0_count(), 0);
    // The device cannot detect this; it waits for a pulse until a time-out.
    assert_eq!(bus.request(0x1001, 8), (4, 0));
    bus.wait(4_900_000_000);
    assert_eq!(bus.read_u16(0x1001, 0x130), 4);
    bus.wait(200_000_000);
    assert_eq!(
        (bus.read_u16(0x1001, 0x130), bus.read_u16(0x1001, 0x134)),
        (0x14, 0x2d)
    );
}

#[test]
fn op_waits_for_the_first_pulse() {
    let mut bus = four_drifting();
    measure(&mut bus);
    to_preop_with_sms(&mut bus, 0x1001);
    let now = bus.segment.device(0).unwrap().system_time(bus.now).unwrap();
    activate(&mut bus, 0x1001, now + 100_000_000);
    bus.to(0x1001, SAFEOP);
    bus.first_outputs(0x1001);
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

/// Crystal deviation in ppm, and system time at power-on in ns.
const EIGHT: [(f64, u64); 8] = [
    (12.0, 5_000),
    (50.0, 7_000_000),
    (-50.0, 123_456_789),
    (37.5, 99),
    (-43.0, 1_000_000_000),
    (4.0, 0),
    (-21.0, 77_777_777_777),
    (29.0, 4_294_967_000),
];

/// A bus with this test as its MainDevice: it measures delays, sets offsets and distributes the
/// reference time.
struct Eight {
    bus: Bus,
    next: u64,
}

impl Eight {
    fn new(jitter: u32) -> Self {
        let devices = (1..).zip(EIGHT).map(|(seed, (ppm, offset))| {
            let options = DeviceOptions {
                clock_drift_ppm: ppm,
                clock_offset_ns: offset,
                clock_jitter_ns: jitter,
                jitter_seed: seed,
                ..DeviceOptions::default()
            };
            sim_with(&coe_device(), options)
        });
        let mut bus = Bus::new(devices.collect());
        assert_eq!(bus.address_all(), 8);
        let mut eight = Self { bus, next: 0 };
        eight.set_up();
        eight
    }

    fn stations() -> std::ops::Range<u16> {
        0x1001..0x1009
    }

    fn device(&self, n: usize) -> &ecaxis_sim::SimDevice {
        self.bus.segment.device(n).unwrap()
    }

    fn set_up(&mut self) {
        let bus = &mut self.bus;
        // Delays are averaged over several measurements, because time stamps may be noisy.
        let mut spans = [0_u64; 8];
        for _ in 0..16 {
            assert_eq!(bus.datagram(8, 0, 0x900, &[0; 4]).1, 8);
            for (span, station) in spans[..7].iter_mut().zip(Self::stations()) {
                let times = bus.read(station, 0x900, 8);
                let port = |n: usize| u32::from_le_bytes(times[n..n + 4].try_into().unwrap());
                *span += u64::from(port(4).wrapping_sub(port(0)));
            }
        }
        let mut delay = 0;
        for (n, station) in Self::stations().enumerate() {
            if n > 0 {
                delay += (spans[n - 1] - spans[n]) / 2;
            }
            let total = u32::try_from(delay / 16).unwrap();
            bus.write(station, 0x928, &total.to_le_bytes());
        }
        assert_eq!(bus.datagram(8, 0, 0x900, &[0; 4]).1, 8);
        let epoch = 800_000_000_000_000_000_u64;
        for station in Self::stations() {
            let local = u64::from_le_bytes(bus.read(station, 0x918, 8).try_into().unwrap());
            bus.write(station, 0x920, &epoch.wrapping_sub(local).to_le_bytes());
        }
        assert_eq!(bus.datagram(8, 0, 0x930, &[0, 0x10]).1, 8, "restarts");
        self.next = (bus.now / CYCLE + 1) * CYCLE;
    }

    /// Runs one cycle: distributes the reference time and returns each device's 0x092C.
    fn cycle(&mut self) -> Vec<u32> {
        self.bus.now = self.next;
        self.next += CYCLE;
        let frame = Self::stations().fold(
            FrameBuilder::default().datagram(14, 0x1001, 0x910, &[0; 8]),
            |frame, station| frame.datagram(4, station, 0x92c, &[0; 4]),
        );
        let bytes = self.bus.frame(frame.build()).unwrap();
        let first = ecaxis_sim::frame::next(&bytes, None).unwrap();
        assert_eq!(first.wkc(&bytes), 8);
        let mut differences = Vec::new();
        let mut at = ecaxis_sim::frame::next(&bytes, Some(&first));
        while let Some(datagram) = at {
            let raw = bytes[datagram.data.clone()].try_into().unwrap();
            differences.push(u32::from_le_bytes(raw) & 0x7fff_ffff);
            at = ecaxis_sim::frame::next(&bytes, Some(&datagram));
        }
        assert_eq!(differences.len(), 8);
        differences
    }

    /// Returns the system times of all devices at one instant of true time, relative to the
    /// reference.
    fn apart(&self) -> Vec<i64> {
        let time = |n| self.device(n).system_time(self.bus.now).unwrap();
        (0..8)
            .map(|n| time(n).wrapping_sub(time(0)).cast_signed())
            .collect()
    }

    fn spread(&self) -> i64 {
        let apart = self.apart();
        apart.iter().max().unwrap() - apart.iter().min().unwrap()
    }

    /// Returns the largest difference in true time between the pulses of one cycle, over the logged
    /// pulses.
    fn pulses_apart(&self) -> u64 {
        let logs: Vec<Vec<u64>> = (0..8)
            .map(|n| self.device(n).sync0_log().collect())
            .collect();
        let len = logs[0].len();
        assert!(len >= 32 && logs.iter().all(|log| log.len() == len));
        let spread = |n: usize| {
            let pulses = || logs.iter().map(|log| log[n]);
            pulses().max().unwrap() - pulses().min().unwrap()
        };
        (0..len).map(spread).max().unwrap()
    }

    fn start_sync0(&mut self) {
        let now = self.device(0).system_time(self.bus.now).unwrap();
        let start = (now / CYCLE + 100) * CYCLE + CYCLE / 2;
        for station in Self::stations() {
            activate(&mut self.bus, station, start);
        }
        self.next = (self.bus.now / CYCLE + 1) * CYCLE;
    }
}

/// The time until the clocks must be locked.
const LOCK_MS: u64 = 1_000;

/// Distributes system time at 1 kHz for ten seconds. Returns, after the time to lock, the largest
/// 0x092C, true difference and difference of pulses.
fn ten_seconds(eight: &mut Eight) -> (u32, i64, u64) {
    const MS: u64 = 10_000;
    let (mut worst, mut apart, mut pulses) = (0, 0, 0);
    for ms in 0..MS {
        let largest = eight.cycle().into_iter().max().unwrap();
        if ms < LOCK_MS {
            continue;
        }
        worst = worst.max(largest);
        apart = apart.max(eight.spread());
        if ms == 3_000 {
            eight.start_sync0();
        }
        // The log keeps 64 pulses; reading it every 60 cycles covers every pulse.
        if ms > 3_300 && ms % 60 == 0 {
            pulses = pulses.max(eight.pulses_apart());
        }
    }
    (worst, apart, pulses)
}

#[test]
fn eight_clocks_lock_and_drift_at_their_crystal_rates() {
    let mut eight = Eight::new(0);
    let (worst, apart, pulses) = ten_seconds(&mut eight);
    assert!(worst < 100, "0x092C: {worst} ns");
    assert!(apart < 100, "clocks: {apart} ns");
    assert!(pulses < 200, "SYNC0: {pulses} ns");

    // Without system times the clocks continue at their learnt rates.
    eight.bus.wait(1_000_000_000);
    let spread = eight.spread();
    assert!(spread < 300, "{spread} ns after a second without FRMW");

    // Without the learnt rates each clock runs at its crystal's rate.
    assert_eq!(eight.bus.datagram(8, 0, 0x930, &[0, 0x10]).1, 8);
    let before = eight.apart();
    eight.bus.wait(1_000_000_000);
    let after = eight.apart();
    for n in 1..8 {
        let ppm = (after[n] - before[n]) as f64 * 1e-3;
        let expected = EIGHT[n].0 - EIGHT[0].0;
        let error = (ppm - expected).abs() / expected.abs();
        assert!(error < 0.02, "device {n}: {ppm} ppm instead of {expected}");
    }
}

#[test]
fn eight_clocks_lock_with_noisy_time_stamps() {
    let mut eight = Eight::new(10);
    let (worst, apart, pulses) = ten_seconds(&mut eight);
    assert!(worst < 100 && apart < 100, "{worst} ns, {apart} ns");
    assert!((1..200).contains(&pulses), "SYNC0: {pulses} ns");
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
            FrameOutcome::Back { at, .. } => {
                seen.extend(bytes);
                seen.extend(at.to_le_bytes());
            }
            FrameOutcome::Lost => seen.push(0xee),
        }
    }
    seen
}

#[test]
fn runs_with_the_same_seed_are_equal() {
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
            FrameOutcome::Back { at, .. } => at - bus.now,
            FrameOutcome::Lost => panic!("lost"),
        }
    };
    // 84 byte times; out through four devices and back: 4 + 3 times 500 ns, 8 cables.
    assert_eq!(back(2), 6_720 + 3_700);
    assert_eq!(back(2), 6_720 * 2 + 3_700);
}
