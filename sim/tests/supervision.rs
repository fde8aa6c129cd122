//! A device with SYNC0: late outputs, a missing SYNC0, missing frames.

use crate::common::*;
use ecaxis_esi::model::{Object, Writable};
use ecaxis_sim::SimDevice;
use ecaxis_sim::drive::State;

const STATION: u16 = 0x1001;
const CYCLE: u64 = 1_000_000;
const CYCLIC_VELOCITY: u8 = 9;
const PROFILE_VELOCITY: u8 = 3;

/// Returns a drive with 0x10F1:02 and the two entries of 0x1C32 for late outputs.
fn drive(limit: u8) -> SimDevice {
    let mut device = coe_device();
    device.profile = Some(402);
    let entry = |sub, bits, offset, value| item(sub, bits, offset, Writable::Always, &[value]);
    let object = |index, items| Object {
        index,
        name: format!("object {index:04x}").into(),
        items,
        ..Object::default()
    };
    device.dictionary.objects.extend([
        object(
            0x10f1,
            vec![
                entry(0, 8, 0, 2),
                entry(1, 32, 16, 1),
                entry(2, 16, 48, limit),
            ],
        ),
        object(
            0x1c32,
            vec![
                entry(0, 8, 0, 32),
                entry(11, 16, 16, 0),
                entry(32, 1, 32, 0),
            ],
        ),
    ]);
    sim(&device)
}

/// Returns a bus in Op with SYNC0 and one process data frame in the middle of every cycle so far.
fn in_op(limit: u8) -> Bus {
    let mut bus = Bus::new(vec![drive(limit)]);
    bus.address_all();
    bus.preop(STATION);
    bus.sm(STATION, 2, 0x1100, 4, 0x64);
    bus.sm(STATION, 3, 0x1200, 4, 0x20);
    bus.fmmu(STATION, 0, 0, 4, 0x1100, 2);
    bus.fmmu(STATION, 1, 0, 4, 0x1200, 1);
    bus.write(STATION, 0x9a0, &(CYCLE as u32).to_le_bytes());
    let now = bus.segment.device(0).unwrap().system_time(bus.now).unwrap();
    bus.write(STATION, 0x990, &(now + 10 * CYCLE).to_le_bytes());
    bus.write(STATION, 0x980, &[0, 3]);
    bus.to(STATION, SAFEOP);
    bus.first_outputs(STATION);
    bus.request(STATION, u16::from(OP));
    bus.wait(20 * CYCLE);
    let pulse = bus.segment.device(0).unwrap().sync0_log().last().unwrap();
    bus.now = pulse + 10 * CYCLE + CYCLE / 2;
    run(&mut bus, &[true; 20]);
    assert_eq!(status(&mut bus), (8, 0));
    bus
}

/// Runs one cycle each, with a process data frame or without.
fn run(bus: &mut Bus, frames: &[bool]) {
    for frame in frames {
        let next = bus.now + CYCLE;
        if *frame {
            bus.logical(12, 0, &[0; 4]);
        }
        bus.now = next;
        bus.segment.advance(next);
    }
}

/// Returns AL status and code.
fn status(bus: &mut Bus) -> (u16, u16) {
    let now = bus.now;
    let status = (bus.read_u16(STATION, 0x130), bus.read_u16(STATION, 0x134));
    bus.now = now;
    status
}

fn object(bus: &Bus, index: u16, sub: u8) -> Vec<u8> {
    let device = bus.segment.device(0).unwrap();
    device.object(index, sub).unwrap()
}

/// Each missing frame adds three to the counter, each received frame subtracts one.
#[test]
fn missing_outputs_end_op_above_the_limit_of_0x10f1() {
    // Limit; received (+) and missing (-) frames; true if still in Op.
    let rows = [
        (4, "-", true),
        (4, "--", false),
        (4, "-+-", false),
        (4, "-++-", true),
        (4, "-+++-++-", true),
        (4, "-+++-+-", false),
        (2, "-", false),
        (9, "---", true),
        (9, "----", false),
        (9, "-+-+-+-", true),
        (9, "-+-+-+-+-", false),
        (0, "--------------------", true),
    ];
    for (limit, frames, stays) in rows {
        let mut bus = in_op(limit);
        let frames: Vec<bool> = frames.bytes().map(|frame| frame == b'+').collect();
        run(&mut bus, &frames);
        let missed = frames.iter().filter(|frame| !**frame).count() as u16;
        let expected = if stays { (8, 0) } else { (0x14, 0x1a) };
        assert_eq!(status(&mut bus), expected, "limit {limit}, {frames:?}");
        assert_eq!(object(&bus, 0x1c32, 11), missed.to_le_bytes());
        assert_eq!(object(&bus, 0x1c32, 32), [u8::from(!stays)]);
    }
}

#[test]
fn op_is_entered_again_after_an_acknowledge() {
    let mut bus = in_op(4);
    run(&mut bus, &[false; 2]);
    assert_eq!(status(&mut bus), (0x14, 0x1a));
    run(&mut bus, &[true; 5]);
    bus.write(STATION, 0x120, &0x14_u16.to_le_bytes());
    run(&mut bus, &[true; 5]);
    assert_eq!(status(&mut bus), (4, 0));
    bus.write(STATION, 0x120, &8_u16.to_le_bytes());
    run(&mut bus, &[true; 5]);
    assert_eq!(status(&mut bus), (8, 0));
    // The earlier errors no longer count.
    run(&mut bus, &[false, true, true, true]);
    assert_eq!(status(&mut bus), (8, 0));
}

/// The cause for leaving Op.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Loss {
    Outputs,
    /// The MainDevice switches SYNC0 off.
    Sync0Off,
    /// SYNC0 becomes a single shot.
    Sync0Stays,
    Frames,
    Request,
}

/// Writes the mode and enables the drive over SDO.
fn enable(bus: &mut Bus, mode: u8) {
    bus.download(STATION, 0x6060, 0, &[mode]).unwrap();
    for word in [0x06_u16, 0x07, 0x0f] {
        bus.download(STATION, 0x6040, 0, &word.to_le_bytes())
            .unwrap();
        run(bus, &[true; 20]);
    }
    let drive = bus.segment.device(0).unwrap().drive().unwrap();
    assert_eq!(drive.state(), State::OperationEnabled);
}

#[test]
fn sync_losses_have_their_al_status_code_and_emergency() {
    // In a cyclic mode, in a profile mode.
    let rows = [
        (Loss::Outputs, 0x1a, 0x8250, 0x8180),
        (Loss::Sync0Off, 0x2c, 0x8280, 0x8280),
        (Loss::Sync0Stays, 0x2c, 0x8280, 0x8280),
        (Loss::Frames, 0x1b, 0x8250, 0x8180),
        (Loss::Request, 0, 0x8180, 0x8180),
    ];
    for (loss, code, cyclic, profile) in rows {
        for (mode, emergency) in [(CYCLIC_VELOCITY, cyclic), (PROFILE_VELOCITY, profile)] {
            let what = format!("{loss:?} in mode {mode}");
            // The mailbox takes longer than a cycle, so supervision starts only here.
            let mut bus = in_op(0);
            enable(&mut bus, mode);
            if loss == Loss::Outputs {
                let device = bus.segment.device_mut(0).unwrap();
                assert!(device.set_input(0x10f1, 2, 4));
            }
            match loss {
                Loss::Outputs => run(&mut bus, &[false; 2]),
                Loss::Sync0Off => bus.write(STATION, 0x981, &[0]),
                Loss::Sync0Stays => bus.write(STATION, 0x9a0, &[0; 4]),
                Loss::Frames => run(&mut bus, &[false; 150]),
                Loss::Request => bus.write(STATION, 0x120, &4_u16.to_le_bytes()),
            }
            if loss != Loss::Frames {
                run(&mut bus, &[true; 10]);
            }
            let al = if loss == Loss::Request { 4 } else { 0x14 };
            assert_eq!(status(&mut bus), (al, code), "{what}");
            let (kind, data) = bus.fetch(STATION).expect(&what);
            let sent = u16::from_le_bytes([data[2], data[3]]);
            assert_eq!((kind, data[0], data[1]), (3, 0, 0x10), "{what}");
            assert_eq!(sent, emergency, "{what}: 0x{sent:04x}");
            assert!(bus.fetch(STATION).is_none(), "{what}: only one");
            run(&mut bus, &[true; 300]);
            let drive = bus.segment.device(0).unwrap().drive().unwrap();
            assert_eq!(drive.state(), State::Fault, "{what}");
        }
    }
}

/// ETG.1020: a device with outputs enters Op only once they have come, and names their absence with
/// AL status code 0x0019. A device without outputs has nothing to wait for.
#[test]
fn op_waits_for_the_first_outputs() {
    const REFUSED: (u16, u16) = (0x14, 0x19);
    const REQUEST: u16 = OP as u16;
    let mut device = coe_device();
    let in_safe_op = |device: &ecaxis_esi::model::Device| {
        let mut bus = Bus::new(vec![sim(device)]);
        bus.address_all();
        bus.preop(STATION);
        if !device.rx_pdos.is_empty() {
            bus.sm(STATION, 2, 0x1100, 4, 0x64);
        }
        bus.sm(STATION, 3, 0x1200, 4, 0x20);
        bus.to(STATION, SAFEOP);
        bus
    };
    let mut bus = in_safe_op(&device);
    assert_eq!(bus.request(STATION, REQUEST), (4, 0));
    bus.wait(1_000_000_000);
    assert_eq!(status(&mut bus), REFUSED);
    // Outputs that come while the device waits.
    assert_eq!(bus.request(STATION, REQUEST | 0x10), (4, 0));
    bus.write(STATION, 0x1100, &[1, 0, 2, 0]);
    assert_eq!(status(&mut bus), (8, 0));
    // The watchdog ends their validity.
    bus.wait(200_000_000);
    assert_eq!(status(&mut bus), (0x14, 0x1b));
    assert_eq!(bus.request(STATION, REQUEST | 0x10), (4, 0));
    bus.wait(1_000_000_000);
    assert_eq!(status(&mut bus), REFUSED);
    // Those of an earlier SafeOp do not count.
    bus.request(STATION, u16::from(PREOP) | 0x10);
    bus.to(STATION, SAFEOP);
    assert_eq!(bus.request(STATION, REQUEST), (4, 0));

    device.rx_pdos.clear();
    let mut bus = in_safe_op(&device);
    assert_eq!(bus.request(STATION, REQUEST), (8, 0));
}
