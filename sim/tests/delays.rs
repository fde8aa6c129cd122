//! Propagation delays as a MainDevice computes them, against the simulator's own. Topology comes
//! from DL status, delays from the receive times of each port (Beckhoff ESC hardware data sheet,
//! section I, 9.1.2).

use crate::common::*;
use ecaxis_esi::model::Device;
use ecaxis_sim::network::topology::media;
use ecaxis_sim::{DeviceOptions, PortRequest, Segment, SegmentOptions, SimDevice, Topology};

/// The order in which frames pass the ports.
const ORDER: [usize; 4] = [0, 3, 1, 2];

struct Found {
    /// Open ports in the order in which frames pass them, port 0 first.
    open: Vec<usize>,
    times: [u32; 4],
    /// The parent, and the index of its open port that leads here.
    parent: Option<(usize, usize)>,
}

impl Found {
    fn last(&self) -> usize {
        *self.open.last().unwrap()
    }
    /// The time from the first receive time to the last.
    fn inner(&self) -> i64 {
        self.between(0, self.last())
    }
    fn between(&self, from: usize, to: usize) -> i64 {
        i64::from(self.times[to].wrapping_sub(self.times[from]))
    }
}

fn scan(bus: &mut Bus) -> Vec<Found> {
    let n = bus.address_all();
    assert_eq!(bus.datagram(8, 0, 0x900, &[0; 4]).1, n);
    let mut found: Vec<Found> = Vec::new();
    for station in 0x1001..=0x1000 + n {
        let status = bus.read_u16(station, 0x110);
        let times = bus.read(station, 0x900, 16);
        let times =
            [0, 1, 2, 3].map(|p| u32::from_le_bytes(times[p * 4..p * 4 + 4].try_into().unwrap()));
        let open = |port: &usize| status >> (8 + 2 * port) & 3 == 2;
        let open: Vec<usize> = ORDER.into_iter().filter(open).collect();
        assert_eq!(open.first(), Some(&0));
        // The deepest earlier device that still has a port without a branch.
        let parent = (0..found.len()).rev().find_map(|p| {
            let branches = found
                .iter()
                .filter(|f| f.parent.is_some_and(|(q, _)| q == p));
            let nth = branches.count() + 1;
            (nth < found[p].open.len()).then_some((p, nth))
        });
        found.push(Found {
            open,
            times,
            parent,
        });
    }
    found
}

/// Returns twice the time from the first device's processing unit to each device's. Doubling avoids
/// rounding.
fn twice_the_delays(found: &[Found], t_diff: i64) -> Vec<i64> {
    // The time from port 0 of a device to the processing unit of its child at the nth open port,
    // and back.
    let mut down = vec![0_i64; found.len()];
    let mut whole = vec![0_i64; found.len()];
    for (n, device) in found.iter().enumerate() {
        let Some((p, nth)) = device.parent else {
            continue;
        };
        let parent = &found[p];
        let round = parent.between(parent.open[nth - 1], parent.open[nth]);
        let both = round - device.inner();
        // The correction depends on which directions pass the processing unit of parent and child.
        let leaves_processed = nth == 1;
        let returns_processed = device.open.len() == 1;
        let correction = match (leaves_processed, returns_processed) {
            (true, false) => t_diff,
            (false, true) => -t_diff,
            _ => 0,
        };
        whole[n] = both;
        down[n] = both + correction;
    }
    let mut delays = vec![0; found.len()];
    for n in 1..found.len() {
        let Some((p, nth)) = found[n].parent else {
            continue;
        };
        let before = found[p].between(0, found[p].open[nth - 1]);
        delays[n] = delays[p] + 2 * before + down[n];
    }
    delays
}

fn device(physics: &str, ppm: f64, t_diff: u64) -> SimDevice {
    let device = Device {
        physics: physics.into(),
        ..coe_device()
    };
    let options = DeviceOptions {
        clock_drift_ppm: ppm,
        clock_offset_ns: 0xffff_fe00,
        processing_ns: t_diff,
        ..DeviceOptions::default()
    };
    sim_with(&device, options)
}

fn check(physics: &[&str], requests: &[Option<PortRequest>], t_diff: u64) -> Vec<u64> {
    let ppm = [30.0, -40.0, 0.0, 50.0, -7.0];
    let devices: Vec<SimDevice> = physics
        .iter()
        .zip(ppm.into_iter().cycle())
        .map(|(physics, ppm)| device(physics, ppm, t_diff))
        .collect();
    let mut topology = Topology::connect(&media(&devices), requests).unwrap();
    for n in 0..devices.len() {
        // All cables have different lengths.
        topology = topology.with_cable(n, 10 + 37 * n as u64);
    }
    let segment = Segment::with_topology(devices, topology, SegmentOptions::default());
    let mut bus = Bus::over(segment);
    let found = scan(&mut bus);
    let delays = twice_the_delays(&found, t_diff as i64);
    let mut truth = Vec::new();
    for (n, twice) in delays.iter().enumerate() {
        let first = bus.segment.delay_ns(0).unwrap();
        let expected = bus.segment.delay_ns(n).unwrap() - first;
        // Receive times are whole nanoseconds. Drift over some microseconds is below 1 ns.
        let off = (twice / 2).abs_diff(expected as i64);
        assert!(
            off <= 2 + n as u64 / 2,
            "{physics:?} device {n}: {twice}/2, true {expected}"
        );
        truth.push(expected);
    }
    truth
}

#[test]
fn delays_match_on_a_line() {
    let truth = check(&["YY", "YY", "YY", "YY"], &[], 0);
    assert_eq!(truth, [0, 547, 1131, 1752]);
    check(&["YY"; 20], &[], 40);
}

#[test]
fn delays_match_behind_a_coupler() {
    check(&["YKY", "KK", "KK", "KK"], &[], 20);
    check(&["YKY", "KK", "KK", "YY", "YY"], &[], 20);
    check(&["YY", "YKY", "KK", "YKY", "KK", "KK", "YY"], &[], 40);
}

#[test]
fn delays_match_in_a_tree() {
    let request = |after, port| {
        Some(PortRequest {
            after,
            port,
            shared: false,
        })
    };
    let star = [
        None,
        request(0, Some(3)),
        request(1, None),
        request(2, None),
        request(0, Some(1)),
        request(0, Some(2)),
        request(5, None),
    ];
    let physics = ["YYYY", "YY", "YY", "YY", "YY", "YY", "YY"];
    check(&physics, &star, 0);
    check(&physics, &star, 40);
    // A star behind a star.
    let nested = [
        None,
        request(0, Some(3)),
        request(1, Some(3)),
        request(1, Some(2)),
        request(0, Some(1)),
        request(0, Some(2)),
    ];
    check(&["YYYY", "YYYY", "YY", "YY", "YY", "YY"], &nested, 40);
}

#[test]
fn ignoring_the_processing_unit_shifts_delays_by_half_of_it_per_device() {
    let devices = (0..4).map(|_| device("YY", 0.0, 40)).collect();
    let mut bus = Bus::new(devices);
    let found = scan(&mut bus);
    let delays = twice_the_delays(&found, 0);
    let first = bus.segment.delay_ns(0).unwrap();
    let off = (0..4).map(|n| (bus.segment.delay_ns(n).unwrap() - first) as i64 - delays[n] / 2);
    // The last device returns through its processing unit too, so its own hop is measured
    // correctly.
    assert_eq!(off.collect::<Vec<_>>(), [0, 20, 40, 40]);
}

#[test]
fn closed_ports_keep_their_receive_time() {
    let mut bus = Bus::new(vec![device("YY", 0.0, 0), device("YY", 0.0, 0)]);
    bus.address_all();
    bus.datagram(8, 0, 0x900, &[0; 4]);
    let before = bus.read(0x1001, 0x900, 16);
    bus.segment.plug(1, 0, false);
    bus.datagram(8, 0, 0x900, &[0; 4]);
    let after = bus.read(0x1001, 0x900, 16);
    assert_ne!(before[..4], after[..4]);
    assert_eq!(before[4..], after[4..]);
    // The processing unit received the frame at port 0: 0x0918 holds the same time in 64 bits.
    assert_eq!(bus.read(0x1001, 0x918, 8)[..4], after[..4]);
}

#[test]
fn smaller_receive_fifo_forwards_frames_sooner() {
    let mut bus = Bus::new(["YKY", "KK", "YY"].map(|p| device(p, 0.0, 0)).to_vec());
    bus.address_all();
    let drive = bus.segment.delay_ns(2).unwrap();
    bus.write(0x1001, 0x102, &[0]);
    // The frame passes the coupler twice: in at an MII port, 40 ns less, then at an E-bus port, 50
    // ns less.
    assert_eq!(drive - bus.segment.delay_ns(2).unwrap(), 90);
    bus.write(0x1001, 0x102, &[3]);
    assert_eq!(drive - bus.segment.delay_ns(2).unwrap(), 60);
    bus.write(0x1001, 0x102, &[7]);
    assert_eq!(drive, bus.segment.delay_ns(2).unwrap());
}
