//! Two drives from a vendor's ESI file: brought to Op, enabled and moved, and the computing time of
//! a cycle.

use std::time::Instant;

use crate::common::*;
use ecaxis_sim::frame::{self, FrameBuilder};
use ecaxis_sim::{DeviceOptions, FaultScript, FrameOutcome, PlantParams, SimDevice};

const EPOS4: &str = "esi/maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml";
const CYCLE: u64 = 1_000_000;
const CSP: u32 = 0x6800_000c;

/// Returns two EPOS4 in Op with distributed clocks, and (output bytes, input bytes) of each.
fn two_drives() -> Option<(Bus, usize, usize)> {
    let file = ecaxis_esi::parse(&fixture(EPOS4)?).unwrap();
    let device = &file.devices[0];
    let drive = |drift: f64, position: i32| {
        let plant = PlantParams {
            initial_position: position,
            ..PlantParams::default()
        };
        let options = DeviceOptions {
            clock_drift_ppm: drift,
            plant,
            ..DeviceOptions::default()
        };
        SimDevice::from_esi(device, &file.modules, options).unwrap()
    };
    let mut bus = Bus::new(vec![drive(0.0, 1000), drive(30.0, -500)]);
    assert_eq!(bus.address_all(), 2);
    let module = file.modules.iter().find(|m| m.ident == CSP).unwrap();
    let bytes = |pdos: &[ecaxis_esi::model::Pdo]| pdos[0].bit_len().div_ceil(8) as usize;
    let (out, inp) = (bytes(&module.rx_pdos), bytes(&module.tx_pdos));
    bus.datagram(8, 0, 0x900, &[0; 4]);
    for station in [0x1001, 0x1002] {
        let local = u64::from_le_bytes(bus.read(station, 0x918, 8).try_into().unwrap());
        bus.write(
            station,
            0x920,
            &1_000_000_u64.wrapping_sub(local).to_le_bytes(),
        );
        bus.write(
            station,
            0x928,
            &[if station == 0x1001 { 0 } else { 525 % 256 } as u8, 0, 0, 0],
        );
        bus.preop(station);
        assert_eq!(bus.upload(station, 0xf030, 1).unwrap(), CSP.to_le_bytes());
        bus.download(station, 0x6060, 0, &[8]).unwrap();
        bus.sm(station, 2, 0x1060, out as u16, 0x64);
        bus.sm(station, 3, 0x10f0, inp as u16, 0x20);
        let logical = u32::from(station - 0x1001) * 0x100;
        bus.fmmu(station, 0, logical, out as u16, 0x1060, 2);
        bus.fmmu(station, 1, logical, inp as u16, 0x10f0, 1);
        bus.write(station, 0x9a0, &(CYCLE as u32).to_le_bytes());
        let now = bus.segment.device(0).unwrap().system_time(bus.now).unwrap();
        bus.write(station, 0x990, &(now + 20_000_000).to_le_bytes());
        bus.write(station, 0x980, &[0, 3]);
        bus.to(station, SAFEOP);
        bus.first_outputs(station);
        bus.request(station, 8);
    }
    bus.wait(30_000_000);
    for station in [0x1001, 0x1002] {
        assert_eq!(bus.read_u16(station, 0x130), 8);
    }
    Some((bus, out, inp))
}

/// Sends FRMW and one LRW per drive; returns the inputs.
fn cyclic(outputs: &[Vec<u8>; 2]) -> Vec<u8> {
    FrameBuilder::default()
        .datagram(14, 0x1001, 0x910, &[0; 8])
        .logical(12, 0, &outputs[0])
        .logical(12, 0x100, &outputs[1])
        .build()
}

fn inputs(bytes: &[u8]) -> [Vec<u8>; 2] {
    let clock = frame::next(bytes, None).unwrap();
    let first = frame::next(bytes, Some(&clock)).unwrap();
    let second = frame::next(bytes, Some(&first)).unwrap();
    assert_eq!(
        (clock.wkc(bytes), first.wkc(bytes), second.wkc(bytes)),
        (2, 3, 3)
    );
    [first, second].map(|d| bytes[d.data.clone()].to_vec())
}

#[test]
fn two_drives_enable_and_follow_their_targets() {
    let Some((mut bus, out, inp)) = two_drives() else {
        return;
    };
    let len = out.max(inp);
    let mut outputs = [vec![0; len], vec![0; len]];
    let mut seen = inputs(&bus.frame(cyclic(&outputs)).unwrap());
    let start = bus.now;
    let mut targets = [0_i32; 2];
    for n in 1..2_000 {
        bus.now = start + n * CYCLE;
        seen = inputs(&bus.frame(cyclic(&outputs)).unwrap());
        for (axis, (output, input)) in outputs.iter_mut().zip(&seen).enumerate() {
            let statusword = u16::from_le_bytes([input[0], input[1]]);
            let position = i32::from_le_bytes(input[2..6].try_into().unwrap());
            let controlword: u16 = match statusword & 0x6f {
                0x21 => 0x07,
                0x23 | 0x27 => 0x0f,
                _ => 0x06,
            };
            if statusword & 0x6f == 0x27 && n > 500 {
                targets[axis] += 2;
            } else {
                targets[axis] = position;
            }
            output[..2].copy_from_slice(&controlword.to_le_bytes());
            output[2..6].copy_from_slice(&targets[axis].to_le_bytes());
        }
    }
    for (axis, input) in seen.iter().enumerate() {
        assert_eq!(u16::from_le_bytes([input[0], input[1]]) & 0x6f, 0x27);
        let position = i32::from_le_bytes(input[2..6].try_into().unwrap());
        let moved = position - [1000, -500][axis];
        assert!((2_900..3_010).contains(&moved), "axis {axis} moved {moved}");
    }
    // The watchdog expires: SafeOp with an error, an emergency, no torque.
    bus.wait(200_000_000);
    assert_eq!(
        (bus.read_u16(0x1002, 0x130), bus.read_u16(0x1002, 0x134)),
        (0x14, 0x1b)
    );
    let (kind, emergency) = bus.fetch(0x1002).expect("an emergency");
    assert_eq!((kind, &emergency[..2]), (3, &[0, 0x10][..]));
    assert!(!bus.segment.device(1).unwrap().drive().unwrap().power_on());
}

#[test]
fn drive_fault_sends_an_emergency_and_sets_the_statusword() {
    let Some((mut bus, ..)) = two_drives() else {
        return;
    };
    let script = "[[fault]]\ndevice = 1\nkind = \"drive-fault\"\ncode = 0x8611\n";
    bus.segment.set_faults(FaultScript::parse(script).unwrap());
    bus.wait(10_000_000);
    let (kind, emergency) = bus.fetch(0x1002).expect("an emergency");
    assert_eq!((kind, &emergency[..4]), (3, &[0, 0x10, 0x11, 0x86][..]));
    assert_eq!(bus.upload(0x1002, 0x603f, 0).unwrap(), [0x11, 0x86]);
    assert_eq!(bus.upload(0x1002, 0x6041, 0).unwrap()[0] & 0x4f, 0x08);
}

#[test]
fn module_selects_its_pdos() {
    let Some((mut bus, ..)) = two_drives() else {
        return;
    };
    bus.request(0x1001, 2);
    let csv = 0x6900_000c_u32.to_le_bytes();
    let before = bus.upload_with(0x1001, 0x50, 0x1600, 0).unwrap();
    bus.download(0x1001, 0xf030, 1, &csv).unwrap();
    assert_eq!(bus.upload(0x1001, 0xf050, 1).unwrap(), csv);
    assert_ne!(bus.upload_with(0x1001, 0x50, 0x1600, 0).unwrap(), before);
    let unknown = 0x1234_u32.to_le_bytes();
    assert!(bus.download(0x1001, 0xf030, 1, &unknown).is_err());
}

/// Prints the computing time of a cycle of two drives. Only an optimised build must meet the limit.
#[test]
fn cycle_of_two_drives_is_far_faster_than_real_time() {
    let Some((mut bus, out, inp)) = two_drives() else {
        return;
    };
    let outputs = [vec![0; out.max(inp)], vec![0; out.max(inp)]];
    let template = cyclic(&outputs);
    let mut bytes = template.clone();
    let cycles = 20_000;
    let begin = Instant::now();
    for n in 1..=cycles {
        bytes.copy_from_slice(&template);
        let sent = bus.segment.transit(&mut bytes, bus.now + n * CYCLE);
        assert!(matches!(sent, FrameOutcome::Back { .. }));
    }
    let each = begin.elapsed().as_nanos() as u64 / cycles;
    eprintln!("{each} ns per cycle of two drives");
    if !cfg!(debug_assertions) {
        assert!(each < 40_000, "{each} ns per cycle");
    }
}

/// Voltage enabled (Statusword bit 4) is the supply in most drives. A maxon drive reports its power
/// stage (EPOS4 firmware specification, Statusword).
#[test]
fn only_a_maxon_drive_clears_voltage_enabled_without_power() {
    let own = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/esi/SV1.xml");
    let own = std::fs::read(own).unwrap();
    for (bytes, expected) in [(Some(own), 0x0010), (fixture(EPOS4), 0x0000)] {
        let Some(bytes) = bytes else { continue };
        let file = ecaxis_esi::parse(&bytes).unwrap();
        let mut bus = Bus::new(vec![sim(&file.devices[0])]);
        bus.address_all();
        bus.wait(10_000_000);
        let word = bus.segment.device(0).unwrap().object(0x6041, 0).unwrap();
        let word = u16::from_le_bytes([word[0], word[1]]);
        assert_eq!(word & 0x0050, 0x0040 | expected, "0x{word:04x}");
    }
}

/// ETG.5001 part 1: a modular device starts with its configured modules; their PDOs with `Sm` are
/// assigned (ETG.2000, `RxPdo/@Sm`).
#[test]
fn modular_device_powers_on_with_the_assignment_of_its_default_modules() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/esi/MIO2.xml");
    let file = ecaxis_esi::parse(&std::fs::read(path).unwrap()).unwrap();
    let device = &file.devices[0];
    let sim = SimDevice::from_esi(device, &file.modules, DeviceOptions::default()).unwrap();
    // IN8 in slot 1, OUT8 in slot 2.
    for (index, pdo) in [(0x1c13, 0x1a00_u16), (0x1c12, 0x1601)] {
        assert_eq!(sim.object(index, 0), Some(vec![1]), "0x{index:04x}");
        assert_eq!(sim.object(index, 1), Some(pdo.to_le_bytes().to_vec()));
    }
    // The process data of the power-on assignment are one byte each.
    let mut bus = Bus::new(vec![sim]);
    assert_eq!(bus.address_all(), 1);
    let station = 0x1001;
    bus.sm(station, 0, 0x1000, 128, 0x26);
    bus.sm(station, 1, 0x1100, 128, 0x22);
    bus.to(station, PREOP);
    bus.sm(station, 2, 0x1200, 1, 0x64);
    bus.sm(station, 3, 0x1300, 1, 0x20);
    bus.to(station, SAFEOP);
}
