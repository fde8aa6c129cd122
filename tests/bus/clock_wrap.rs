//! Clocks of 32 and 64 bits around the wrap of the low 32 bits: the bring-up and the first cycles,
//! as seen at the simulated devices.

use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::{self, Nanos};
use ecaxis_master::config::Machine;
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::link::{Link, LinkError, MAX_FRAME};
use ecaxis_master::rt::cycle::Engine;
use ecaxis_master::session::{Attachments, Prepared, RunBuilder};
use ecaxis_sim::chip::EscInfo;
use ecaxis_sim::{DeviceOptions, Segment, SegmentOptions, SimDevice};
use ecaxis_test_support::{machine, virtual_time};

/// The wrap of the low 32 bits of the system time.
const WRAP: Nanos = 1 << 32;
const DEVICES: usize = 2;
/// The bit of 0x0008 for a clock of 64 bits (Beckhoff ESC data sheet, section II, 2.1).
const DC_64_BIT: u16 = 0x0008;

/// The last frame at one device: the times from the last pulse of SYNC0 to the first bit, and from
/// the last bit to the next pulse.
#[derive(Debug, Clone, Copy, Default)]
struct Distances {
    before: i64,
    after: i64,
}

#[derive(Debug)]
struct Watched {
    bus: SimLink,
    start: Nanos,
    cycle: i64,
    seen: Arc<Mutex<[Distances; DEVICES]>>,
}

impl Link for Watched {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        self.bus.send(frame)?;
        if frame.get(11) == Some(&0x20) {
            let at = (clock::now() - self.start) as i64;
            // 100 Mbit/s; preamble, FCS and gap are 24 bytes.
            let length = (frame.len() as i64 + 24) * 80;
            let segment = self.bus.segment();
            let mut seen = self.seen.lock().expect("one thread");
            for (n, seen) in seen.iter_mut().enumerate() {
                let device = segment.device(n).expect("a device");
                let Some(pulse) = device.sync0_log().last() else {
                    continue;
                };
                let first = at + segment.delay_ns(n).expect("in reach") as i64;
                seen.before = (first - pulse as i64).rem_euclid(self.cycle);
                seen.after = self.cycle - (first + length - pulse as i64).rem_euclid(self.cycle);
            }
        }
        Ok(())
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        self.bus.recv(buf)
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.bus.next_arrival()
    }
}

fn drives(cycle: Nanos) -> Machine {
    let mut text = format!("[bus]\ncycle = \"{}us\"\n", cycle / 1_000);
    for n in 0..DEVICES {
        text += &format!(
            "[[device]]\nname = \"d{n}\"\nesi = \"esi/EPOS4.xml\"\nposition = {n}\nmode = \"csp\"\n\
             [device.axis]\nencoder = 2000\nlimits = {{ velocity = 10.0, acceleration = 100.0 }}\n"
        );
    }
    machine(&text)
}

/// Returns a bus of drives whose clocks have these widths, local offsets and drifts.
fn bus(machine: &Machine, bits: [u32; DEVICES], random: &mut impl FnMut() -> u64) -> Segment {
    let devices = machine.devices.iter().zip(bits).map(|(config, bits)| {
        let features = match bits {
            32 => EscInfo::LAN9252.features & !DC_64_BIT,
            _ => EscInfo::LAN9252.features,
        };
        let info = EscInfo {
            features,
            fmmus: 8,
            sync_managers: 8,
            ..EscInfo::LAN9252
        };
        let options = DeviceOptions {
            esc: Some(info),
            clock_offset_ns: random() % (2 * WRAP),
            clock_drift_ppm: (random() % 101) as f64 - 50.0,
            ..DeviceOptions::default()
        };
        SimDevice::from_esi(&config.device, &config.esi.modules, options).expect("a drive")
    });
    Segment::new(devices.collect(), SegmentOptions::default())
}

/// Brings the bus up at this time, runs until the phase is locked and some cycles more, and returns
/// the distances of the last frame.
fn lock(
    machine: &Machine,
    bits: [u32; DEVICES],
    start: Nanos,
    random: &mut impl FnMut() -> u64,
) -> Result<[Distances; DEVICES], String> {
    const MORE: u32 = 20;
    let options = virtual_time();
    options.clock.enter();
    options.clock.sleep_until(start, 0);
    let seen = Arc::default();
    let link = Watched {
        bus: SimLink::new(bus(machine, bits, random)),
        start,
        cycle: machine.bus.cycle_ns as i64,
        seen: Arc::clone(&seen),
    };
    let (progress, _reported) = channel();
    let job = RunBuilder {
        machine: &Arc::new(machine.clone()),
        options: &options,
        stop: Arc::<CancelToken>::default(),
        progress,
        attachments: Attachments::default(),
    };
    let Prepared {
        parts,
        mut supervisor,
    } = job
        .prepare_on(Box::new(link))
        .map_err(|error| error.to_string())?;
    let mut engine = Engine::new(parts);
    let mut left = MORE;
    for _ in 0..1_000 {
        engine.cycle();
        let snapshot = supervisor.outer.snapshots.read();
        left -= u32::from(snapshot.phase.is_some_and(|phase| phase.locked));
        if left == 0 {
            break;
        }
    }
    if left > 0 {
        return Err("the phase does not lock".to_owned());
    }
    let seen = *seen.lock().expect("one thread");
    Ok(seen)
}

/// The low 32 bits of the system time wrap during the bring-up, between it and the first cycle, or
/// after it (ETG.1000.4, 0x0910: clocks of 32 and of 64 bits; ETG.2000, `Unknown64Bit`). 2^32 ns is
/// no multiple of the cycles, so a phase that lost a wrap is off by 32.7 µs. Expected are equal
/// distances from SYNC0 to the first bit at the first device and from the last bit at the last
/// device to SYNC0.
#[test]
fn phase_is_right_wherever_the_system_time_wraps() {
    let trials = std::env::var("ECAXIS_TRIALS").map_or(1_000, |n| n.parse().expect("a number"));
    let cycles = [250_000, 500_000, 1_000_000, 2_000_000, 4_000_000];
    let machines = cycles.map(drives);
    let mut state = 1_u64;
    let mut random = || {
        // Knuth's MMIX generator.
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        state >> 20
    };
    let mut worst = 0;
    for trial in 0..trials {
        let machine = &machines[trial % machines.len()];
        let bits = [[32, 32], [64, 64], [32, 64], [64, 32]][trial / machines.len() % 4];
        let start = 2 * WRAP - random() % 700_000_000;
        let place = format!("trial {trial}: {bits:?} bits, start at {start} ns");
        let seen = lock(machine, bits, start, &mut random);
        let [first, last] = seen.unwrap_or_else(|error| panic!("{place}: {error}"));
        let off = (first.before - last.after) / 2;
        worst = worst.max(off.abs());
        assert!(
            off.abs() < 5_000,
            "{place}: {off} ns off, {first:?} {last:?}"
        );
    }
    println!("{trials} bring-ups, frames off by at most {worst} ns");
}
