//! Effects of the fault script on frames and devices: corruption, duplication, delay, exchange.

use crate::common::*;
use ecaxis_sim::frame::FrameBuilder;
use ecaxis_sim::{DeviceOptions, FaultScript, FrameOutcome};

const MS: u64 = 1_000_000;

fn line(n: usize, script: &str) -> Bus {
    let mut bus = Bus::new((0..n).map(|_| sim(&coe_device())).collect());
    bus.address_all();
    bus.segment.set_faults(FaultScript::parse(script).unwrap());
    bus
}

fn brd() -> Vec<u8> {
    FrameBuilder::default().datagram(7, 0, 0, &[0]).build()
}

/// Returns RX errors of each port, then forwarded errors, then those of the processing unit.
fn errors(bus: &Bus, device: usize) -> Vec<u8> {
    let device = bus.segment.device(device).unwrap();
    device.registers(0x300, 13).to_vec()
}

/// Returns the counters of [`errors`] from those that are not zero.
fn counters(counts: &[(usize, u8)]) -> Vec<u8> {
    let mut counters = vec![0; 13];
    for (at, count) in counts {
        counters[*at] = *count;
    }
    counters
}

#[test]
fn corrupted_frame_is_counted_by_the_detecting_device_and_those_behind_it() {
    // Data sheet section I, table 50: an RX error at port 0 counts in 0x0300, 0x0301 and 0x030C, a
    // forwarded one in 0x0308 and 0x030C.
    let mut bus = line(
        3,
        "[[fault]]\nkind = \"frame-corrupt\"\ncount = 1\ndevice = 1\n",
    );
    let write = FrameBuilder::default().datagram(8, 0, 0x102, &[5]).build();
    assert_eq!(bus.frame(write), None);
    // On the way back the frame enters at port 1.
    assert_eq!(errors(&bus, 0), counters(&[(9, 1)]));
    assert_eq!(
        errors(&bus, 1),
        counters(&[(0, 1), (1, 1), (9, 1), (12, 1)])
    );
    assert_eq!(errors(&bus, 2), counters(&[(8, 1), (12, 1)]));
    // Only the device before the error has applied the frame.
    let written = |n| bus.segment.device(n).unwrap().registers(0x102, 1)[0];
    assert_eq!([0, 1, 2].map(written), [5, 7, 7]);
    assert!(bus.frame(brd()).is_some(), "the next one is whole");
    bus.write(0x1002, 0x300, &[0]);
    assert_eq!(errors(&bus, 1), counters(&[(12, 1)]));
}

#[test]
fn error_on_the_return_path_affects_no_device() {
    let mut bus = line(
        3,
        "[[fault]]\nkind = \"frame-corrupt\"\ncount = 1\ndevice = 1\nport = 1\n",
    );
    let write = FrameBuilder::default().datagram(8, 0, 0x102, &[5]).build();
    assert_eq!(bus.frame(write), None);
    assert_eq!(errors(&bus, 2), counters(&[]));
    assert_eq!(errors(&bus, 1), counters(&[(2, 1), (3, 1)]));
    assert_eq!(errors(&bus, 0), counters(&[(9, 1)]));
    let written = |n| bus.segment.device(n).unwrap().registers(0x102, 1)[0];
    assert_eq!([0, 1, 2].map(written), [5, 5, 5]);
}

#[test]
fn random_corruption_hits_every_cable() {
    let mut bus = line(
        3,
        "seed = 3\n[[fault]]\nkind = \"frame-corrupt\"\nprobability = 1.0\n",
    );
    for _ in 0..200 {
        assert_eq!(bus.frame(brd()), None);
    }
    // A frame passes six cables. The last cable leads to the MainDevice; no device counts its
    // errors.
    let found: Vec<u8> = (0..3)
        .flat_map(|n| [errors(&bus, n)[0], errors(&bus, n)[2]])
        .collect();
    assert_eq!(found[5], 0, "nothing is behind the last device");
    assert!(found[..5].iter().all(|n| (15..60).contains(n)), "{found:?}");
    let all: u32 = found.iter().map(|n| u32::from(*n)).sum();
    assert!((150..200).contains(&all), "{all}");
    // Counters stop at 255.
    for _ in 0..4000 {
        bus.frame(brd());
    }
    assert_eq!(errors(&bus, 2)[12], 255);
}

#[test]
fn duplicated_frame_returns_twice() {
    let mut bus = line(2, "[[fault]]\nkind = \"frame-duplicate\"\ncount = 1\n");
    let mut send = || bus.segment.transit(&mut brd(), bus.now + MS);
    let FrameOutcome::Back {
        at,
        again: Some(again),
        ..
    } = send()
    else {
        panic!("once");
    };
    assert_eq!(again - at, 6_720, "behind the first one");
    assert!(matches!(send(), FrameOutcome::Back { again: None, .. }));
}

#[test]
fn delayed_frame_is_overtaken() {
    let mut bus = line(
        2,
        "[[fault]]\nkind = \"frame-delay\"\ncount = 1\ndelay = \"200us\"\n",
    );
    let mut back = |after: u64| match bus.segment.transit(&mut brd(), bus.now + after) {
        FrameOutcome::Back { at, .. } => at - bus.now,
        FrameOutcome::Lost => panic!("lost"),
    };
    let (first, second) = (back(0), back(50_000));
    assert_eq!(first, second - 50_000 + 200_000);
}

#[test]
fn frame_faults_last_for_their_duration() {
    let mut bus = line(
        1,
        "[[fault]]\nat = \"10ms\"\nfor = \"10ms\"\nkind = \"frame-duplicate\"\nprobability = 1\n",
    );
    let twice = [5, 15, 25].map(|ms| {
        let transit = bus.segment.transit(&mut brd(), ms * MS);
        matches!(transit, FrameOutcome::Back { again: Some(_), .. })
    });
    assert_eq!(twice, [false, true, false]);
}

#[test]
fn replaced_device_is_restored() {
    let mut bus = line(
        3,
        "[[fault]]\nat = \"10ms\"\nfor = \"10ms\"\nkind = \"swap\"\ndevice = 1\n\
         product = 0x999\nserial = 77\n",
    );
    let original = bus.segment.device(1).unwrap().sii().to_vec();
    bus.preop(0x1002);
    bus.wait(15 * MS);
    let device = bus.segment.device(1).unwrap();
    assert_eq!(device.station_address(), 0);
    assert_eq!(device.al_state(), ecaxis_sim::AlState::Init);
    let word = |at: usize| u32::from_le_bytes(device.sii()[at..at + 4].try_into().unwrap());
    assert_eq!([16, 20, 24, 28].map(word), [0x333, 0x999, 2, 77]);
    let number = |sub| device.object(0x1018, sub).unwrap();
    assert_eq!(number(2), 0x999_u32.to_le_bytes());
    assert_eq!(number(4), 77_u32.to_le_bytes());
    // The neighbours lost the link for a moment.
    let lost = |n: usize| bus.segment.device(n).unwrap().registers(0x310, 4).to_vec();
    assert_eq!(lost(0), [0, 1, 0, 0]);
    assert_eq!(lost(2), [1, 0, 0, 0]);
    assert_eq!(lost(1), [0; 4]);
    bus.wait(10 * MS);
    let device = bus.segment.device(1).unwrap();
    assert_eq!(device.sii(), original);
    assert_eq!(device.object(0x1018, 2).unwrap(), 0x444_u32.to_le_bytes());
    assert_eq!(bus.datagram(7, 0, 0, &[0]).1, 3);
}

#[test]
fn replacement_device_has_no_alias_by_default() {
    for (line, alias) in [("", 0), ("alias = 0x1234\n", 0x1234_u16)] {
        let options = DeviceOptions {
            alias: 0x55,
            ..DeviceOptions::default()
        };
        let mut bus = Bus::new(vec![sim_with(&coe_device(), options)]);
        bus.address_all();
        let script = format!("[[fault]]\nat = \"1ms\"\nkind = \"swap\"\n{line}");
        bus.segment.set_faults(FaultScript::parse(&script).unwrap());
        assert_eq!(bus.read_u16(0x1001, 0x12), 0x55);
        bus.wait(2 * MS);
        bus.address_all();
        assert_eq!(bus.read_u16(0x1001, 0x12), alias);
        // The checksum is right again.
        assert_eq!(bus.read_u16(0x1001, 0x502) & 0x0800, 0);
    }
}

#[test]
fn power_cut_restarts_a_device() {
    let mut bus = line(
        1,
        "[[fault]]\nat = \"1ms\"\nfor = \"1ms\"\nkind = \"power-off\"\n",
    );
    bus.wait(MS);
    assert_eq!(bus.frame(brd()), None);
    bus.wait(MS);
    assert!(bus.frame(brd()).is_some());
    assert_eq!(bus.segment.device(0).unwrap().station_address(), 0);
}

/// Returns the times from port 0 to port 1 by the receive times, over many latches.
fn trips(jitter: u32, seed: u64) -> Vec<i64> {
    let options = DeviceOptions {
        clock_jitter_ns: jitter,
        jitter_seed: seed,
        ..DeviceOptions::default()
    };
    let device = sim_with(&coe_device(), options);
    let mut bus = Bus::new(vec![device.clone(), device]);
    bus.address_all();
    let mut trips = Vec::new();
    for _ in 0..400 {
        bus.datagram(8, 0, 0x900, &[0; 4]);
        let times = bus.read(0x1001, 0x900, 8);
        let port = |n: usize| u32::from_le_bytes(times[n * 4..n * 4 + 4].try_into().unwrap());
        // One reading, shown in two registers.
        assert_eq!(bus.read(0x1001, 0x918, 4), times[..4]);
        trips.push(i64::from(port(1).wrapping_sub(port(0))));
    }
    trips
}

#[test]
fn receive_times_jitter_within_the_option() {
    assert!(trips(0, 1).iter().all(|trip| *trip == 1_050));
    let jittery = trips(20, 1);
    let (least, most) = (jittery.iter().min().unwrap(), jittery.iter().max().unwrap());
    // Two readings, each off by up to 20 ns.
    assert!((1_010..1_025).contains(least), "{least}");
    assert!((1_076..=1_090).contains(most), "{most}");
    let mean = jittery.iter().sum::<i64>() / 400;
    assert!(mean.abs_diff(1_050) < 4, "{mean}");
    assert_eq!(trips(20, 1), jittery, "the seed decides");
    assert_ne!(trips(20, 2), jittery);
}

/// Returns all observations of a bus with many faults.
fn everything() -> Vec<u8> {
    let script = "seed = 11\n\
        [[fault]]\nkind = \"frame-loss\"\nprobability = 0.05\n\
        [[fault]]\nkind = \"frame-corrupt\"\nprobability = 0.05\n\
        [[fault]]\nkind = \"frame-duplicate\"\nprobability = 0.05\n\
        [[fault]]\nkind = \"frame-delay\"\nprobability = 0.05\ndelay = \"1ms\"\n\
        [[fault]]\nat = \"50ms\"\nfor = \"20ms\"\nkind = \"link-break\"\ndevice = 2\n\
        [[fault]]\nat = \"90ms\"\nfor = \"20ms\"\nkind = \"power-off\"\ndevice = 1\n\
        [[fault]]\nat = \"150ms\"\nkind = \"swap\"\ndevice = 3\nserial = 5\n";
    let mut bus = line(4, script);
    let mut seen = Vec::new();
    for n in 0..300 {
        let mut bytes = FrameBuilder::default()
            .datagram(7, 0, 0x300, &[0; 20])
            .datagram(8, 0, 0x900, &[0; 4])
            .datagram(7, 0, 0x900, &[0; 16])
            .build();
        let transit = bus.segment.transit(&mut bytes, n * MS);
        seen.extend(format!("{transit:?}").bytes());
        seen.extend(bytes);
    }
    seen
}

#[test]
fn fault_runs_are_reproducible() {
    assert!(everything() == everything());
}
