//! The speed of simulated drives: segments in Op at 1 kHz with every axis in motion, on one core,
//! as multiples of real time.
//!
//! Each millisecond, frames with FRMW of the system time, LRW of all process data and BRD of the AL
//! status pass through the segment. A minimal MainDevice derives Controlwords from Statuswords and
//! moves the targets of CSP.

#![allow(clippy::print_stdout, reason = "the figures are what it is for")]

#[path = "../sim/tests/common/mod.rs"]
mod common;

use std::path::Path;
use std::time::{Duration, Instant};

use common::{Bus, SAFEOP};
use ecaxis_esi::model::{EsiFile, Pdo};
use ecaxis_sim::frame::{self, FrameBuilder};
use ecaxis_sim::{DeviceOptions, FrameOutcome, PlantParams, SimDevice};

const CYCLE_NS: u64 = 1_000_000;
const CSP: u32 = 0x0e0a_0008;
/// The bytes of process data in one datagram; a frame holds 1498.
const DATAGRAM: usize = 1400;
const ENABLED: u16 = 0x27;

struct Machine {
    bus: Bus,
    /// The process data of all drives, with outputs and inputs at the same place.
    image: Vec<u8>,
    /// The length of one drive's data.
    len: usize,
    frame: Vec<u8>,
    origins: Vec<i32>,
    cycle: u32,
}

fn bytes(pdos: &[Pdo]) -> usize {
    let bits: u32 = pdos.iter().map(Pdo::bit_len).sum();
    bits.div_ceil(8) as usize
}

impl Machine {
    /// Creates the segment in Op, with running clocks and enabled axes.
    fn new(file: &EsiFile, drives: u16) -> Self {
        let device = file.devices.first().expect("a device");
        let devices = (0..drives).map(|n| {
            let options = DeviceOptions {
                clock_drift_ppm: f64::from(n % 9) * 10.0 - 40.0,
                plant: PlantParams {
                    initial_position: i32::from(n) * 1000,
                    ..PlantParams::default()
                },
                ..DeviceOptions::default()
            };
            SimDevice::from_esi(device, &file.modules, options).expect("a device that fits")
        });
        let mut bus = Bus::new(devices.collect());
        let sm = |n: usize| {
            let sm = device.sync_managers.get(n).expect("four SyncManagers");
            (sm.start_address, sm.default_size)
        };
        bus.mailboxes = [sm(0), sm(1)];
        let (to_drive, from_drive) = (sm(2).0, sm(3).0);
        assert_eq!(bus.address_all(), drives);
        let module = file.modules.iter().find(|module| module.ident == CSP);
        let module = module.expect("a CSP module");
        let (outputs, inputs) = (bytes(&module.rx_pdos), bytes(&module.tx_pdos));
        let len = outputs.max(inputs);
        let short = |n: usize| u16::try_from(n).expect("a few bytes");
        for (n, station) in (0..drives).zip(0x1001..) {
            bus.preop(station);
            bus.download(station, 0x6060, 0, &[8]).expect("a mode");
            bus.download(station, 0x60c2, 1, &[1]).expect("a period");
            bus.sm(station, 2, to_drive, short(outputs), 0x64);
            bus.sm(station, 3, from_drive, short(inputs), 0x20);
            let logical = u32::from(n) * u32::from(short(len));
            bus.fmmu(station, 0, logical, short(outputs), to_drive, 2);
            bus.fmmu(station, 1, logical, short(inputs), from_drive, 1);
            bus.write(station, 0x9a0, &1_000_000_u32.to_le_bytes());
            let clock = bus.segment.device(n.into()).expect("it is there");
            let now = clock.system_time(bus.now).expect("it has a clock");
            bus.write(station, 0x990, &(now + 20_000_000).to_le_bytes());
            bus.write(station, 0x980, &[0, 3]);
            bus.to(station, SAFEOP);
            bus.request(station, 8);
        }
        let mut machine = Self {
            bus,
            image: vec![0; len * usize::from(drives)],
            len,
            frame: Vec::new(),
            origins: (0..i32::from(drives)).map(|n| n * 1000).collect(),
            cycle: 0,
        };
        for _ in 0..400 {
            machine.cycle();
        }
        machine
    }

    fn cycle(&mut self) {
        self.cycle += 1;
        let start = self.bus.now;
        let per_frame = (DATAGRAM / self.len) * self.len;
        for (n, part) in (0..).zip((0..self.image.len()).step_by(per_frame)) {
            let end = (part + per_frame).min(self.image.len());
            let mut frame = FrameBuilder::default();
            if n == 0 {
                frame = frame.datagram(14, 0x1001, 0x910, &[0; 8]);
            }
            let address = u32::try_from(part).expect("a small image");
            self.frame = frame
                .logical(12, address, &self.image[part..end])
                .datagram(7, 0, 0x130, &[0; 2])
                .build();
            let now = start + 200_000 * n;
            let transit = self.bus.segment.transit(&mut self.frame, now);
            assert!(matches!(transit, FrameOutcome::Back { .. }));
            let mut datagram = frame::next(&self.frame, None).expect("a datagram");
            if n == 0 {
                datagram = frame::next(&self.frame, Some(&datagram)).expect("another");
            }
            self.image[part..end].copy_from_slice(&self.frame[datagram.data]);
        }
        self.bus.now = start + CYCLE_NS;
        // Half a turn forth and back in half a second.
        let phase = f64::from(self.cycle) * std::f64::consts::TAU / 500.0;
        #[expect(clippy::cast_possible_truncation)]
        let way = (1000.0 * (1.0 - phase.cos())) as i32;
        for (drive, origin) in self.image.chunks_mut(self.len).zip(&mut self.origins) {
            let statusword = u16::from_le_bytes([drive[0], drive[1]]);
            let position = i32::from_le_bytes([drive[2], drive[3], drive[4], drive[5]]);
            let controlword: u16 = match statusword & 0x6f {
                0x21 => 0x07,
                0x23 | ENABLED => 0x0f,
                _ => 0x06,
            };
            let target = if statusword & 0x6f == ENABLED {
                *origin + way
            } else {
                *origin = position - way;
                position
            };
            drive[..2].copy_from_slice(&controlword.to_le_bytes());
            drive[2..6].copy_from_slice(&target.to_le_bytes());
            drive[6..].fill(0);
        }
    }

    /// True if every axis is enabled and turns.
    fn moves(&self) -> bool {
        (0..self.origins.len()).all(|n| {
            let drive = self.bus.segment.device(n).and_then(SimDevice::drive);
            drive.is_some_and(|drive| drive.power_on() && drive.velocity_rev_s() != 0.0)
        })
    }
}

/// Returns the core time of this thread, without the time of other programs. Without Linux's
/// accounting, returns wall-clock time.
fn core_time(start: Instant) -> Duration {
    std::fs::read_to_string("/proc/thread-self/schedstat")
        .ok()
        .and_then(|text| text.split_whitespace().next()?.parse().ok())
        .map_or_else(|| start.elapsed(), Duration::from_nanos)
}

/// Returns simulated time divided by real time: the best of several runs, because shared caches
/// only slow a run down.
fn times_real_time(machine: &mut Machine, cycles: u32) -> f64 {
    let (mut best, started) = (Duration::MAX, Instant::now());
    for _ in 0..20 {
        let start = core_time(started);
        for _ in 0..cycles {
            machine.cycle();
        }
        best = best.min(core_time(started).saturating_sub(start));
        assert!(machine.moves(), "an axis stands");
    }
    f64::from(cycles) * 1e-3 / best.as_secs_f64()
}

fn main() {
    // `cargo test --benches` only checks that the benchmark runs.
    let short = !std::env::args().any(|argument| argument == "--bench");
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/esi/EPOS4.xml");
    let file = std::fs::read(path).expect("the project's own ESI file");
    let file = ecaxis_esi::parse(&file).expect("it parses");
    let figures = [(16, 1000), (100, 200)].map(|(drives, cycles)| {
        let mut machine = Machine::new(&file, drives);
        let cycles = if short { 20 } else { cycles };
        let times = times_real_time(&mut machine, cycles);
        format!("{drives} drives: {times:.0} times real time")
    });
    println!("{}", figures.join("; "));
}
