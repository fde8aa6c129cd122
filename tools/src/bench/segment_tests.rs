use ecaxis_sim::frame::FrameBuilder;
use proptest::prelude::*;

use super::*;

const BASE: u32 = 0x0001_0000;

fn segment(devices: u32) -> BenchSegment {
    let len = u32::try_from(DRIVE_BYTES).unwrap();
    BenchSegment::new((0..devices).map(|n| BASE + n * len), 0)
}

fn datagrams(frame: &[u8]) -> Vec<Datagram> {
    let mut all = Vec::new();
    let mut next = frame::next(frame, None);
    while let Some(datagram) = next {
        next = frame::next(frame, Some(&datagram));
        all.push(datagram);
    }
    all
}

/// Exchanges one LRW over all drives. Returns inputs and working counter.
fn exchange(segment: &mut BenchSegment, outputs: &[u8]) -> (Vec<u8>, u16) {
    let mut frame = FrameBuilder::default().logical(12, BASE, outputs).build();
    assert_eq!(segment.answer(&mut frame, 0), Kind::EtherCat);
    let lrw = &datagrams(&frame)[0];
    (frame[lrw.data.clone()].to_vec(), lrw.wkc(&frame))
}

fn outputs(controlword: u16, target: i32) -> [u8; DRIVE_BYTES] {
    let mut outputs = [0; DRIVE_BYTES];
    outputs[..2].copy_from_slice(&controlword.to_le_bytes());
    outputs[2..6].copy_from_slice(&target.to_le_bytes());
    outputs[6] = 8;
    outputs
}

#[test]
fn segment_answers_a_cyclic_frame_like_a_bus() {
    let mut segment = segment(3);
    segment.drift_ppm = 100;
    let mut frame = FrameBuilder::default()
        .datagram(14, FIRST_STATION, 0x0910, &[0; 8])
        .logical(12, BASE, &[0; 3 * DRIVE_BYTES])
        .datagram(7, 0, 0x0130, &[0; 2])
        .datagram(4, FIRST_STATION + 2, 0x0130, &[0xaa; 6])
        .datagram(4, FIRST_STATION + 3, 0x0130, &[0xaa; 6])
        .build();
    let sent = frame.clone();
    assert_eq!(segment.answer(&mut frame, 2_000_000), Kind::EtherCat);
    assert_eq!(frame[6], sent[6] | 0x02, "the first SubDevice's mark");
    let all = datagrams(&frame);
    let wkcs: Vec<u16> = all.iter().map(|d| d.wkc(&frame)).collect();
    // FRMW: one reads, two are written. LRW: two for outputs and one for inputs, per drive.
    assert_eq!(wkcs, [3, 9, 3, 1, 0]);
    let data = |n: usize| &frame[all[n].data.clone()];
    assert_eq!(data(0), 2_000_200_u64.to_le_bytes());
    assert_eq!(data(2), [8, 0]);
    assert_eq!(all[2].adp(&frame), 3, "counted by the devices");
    assert_eq!(data(3), [8, 0, 0, 0, 0, 0]);
    assert_eq!(data(4), [0xaa; 6], "of no device");
}

/// ETG.1000.4: working counter increments of LRD, LWR and LRW.
#[test]
fn logical_commands_add_standard_working_counters() {
    for (command, each) in [(10, 1), (11, 1), (12, 3)] {
        for (devices, covered, len) in [(2, 2, 24), (2, 1, 23), (2, 0, 11), (4, 3, 40)] {
            let mut segment = segment(devices);
            let mut frame = FrameBuilder::default()
                .logical(command, BASE, &vec![0; len])
                .build();
            segment.answer(&mut frame, 0);
            let wkc = datagrams(&frame)[0].wkc(&frame);
            assert_eq!(wkc, covered * each, "{command} {devices} {len}");
        }
        let mut frame = FrameBuilder::default()
            .logical(command, BASE + 0x1000, &[0; 24])
            .build();
        segment(2).answer(&mut frame, 0);
        assert_eq!(datagrams(&frame)[0].wkc(&frame), 0, "elsewhere");
    }
}

#[test]
fn drive_follows_the_controlword() {
    let mut segment = segment(1);
    // Controlword and the Statusword that follows it one cycle later.
    for (controlword, statusword) in [
        (0x0000, 0x0250),
        (0x000f, 0x0250),
        (0x0006, 0x0231),
        (0x0007, 0x0233),
        (0x000f, 0x1237),
        (0x0007, 0x0233),
        (0x000f, 0x1237),
        (0x0002, 0x0217),
        (0x000f, 0x0217),
        (0x0006, 0x0231),
        (0x000f, 0x0233),
        (0x0000, 0x0250),
    ] {
        exchange(&mut segment, &outputs(controlword, 0));
        let (inputs, wkc) = exchange(&mut segment, &outputs(controlword, 0));
        let seen = u16::from_le_bytes([inputs[0], inputs[1]]);
        if controlword != 0x000f || statusword & 0x20 == 0 {
            assert_eq!(seen, statusword, "{controlword:#06x}");
        }
        assert_eq!(wkc, 3);
    }
}

#[test]
fn only_an_enabled_drive_reaches_its_target() {
    let mut segment = segment(2);
    for controlword in [6, 7, 15] {
        let both = [outputs(controlword, -5), outputs(0, 99)].concat();
        exchange(&mut segment, &both);
    }
    let (inputs, _) = exchange(&mut segment, &[outputs(15, 1234), outputs(0, 99)].concat());
    assert_eq!(inputs[2..6], (-5_i32).to_le_bytes());
    let (inputs, _) = exchange(&mut segment, &[outputs(15, 0), outputs(0, 99)].concat());
    assert_eq!(inputs[2..6], 1234_i32.to_le_bytes());
    assert_eq!(inputs[6], 8);
    assert_eq!(inputs[14..18], [0; 4]);
}

#[test]
fn foreign_frames_stay_unchanged() {
    let mut segment = segment(1);
    let good = FrameBuilder::default()
        .datagram(7, 0, 0x130, &[0; 2])
        .build();
    let mut other = good.clone();
    other[12..14].copy_from_slice(&[0x08, 0x00]);
    let mut long = good.clone();
    long[14] += 1;
    let mut more = good.clone();
    more[23] |= 0x80;
    let mut mailbox = good.clone();
    mailbox[15] = 0x50;
    for (frame, seen) in [
        (other, Kind::Foreign),
        (long, Kind::Malformed),
        (more, Kind::Malformed),
        (mailbox, Kind::Malformed),
        (good[..20].to_vec(), Kind::Malformed),
        (good[..15].to_vec(), Kind::Malformed),
        (good[..13].to_vec(), Kind::Foreign),
    ] {
        let mut answered = frame.clone();
        assert_eq!(segment.answer(&mut answered, 0), seen);
        assert_eq!(answered, frame);
    }
}

/// Bytes on the wire with preamble and gap, plus 1 µs per device.
#[test]
fn wire_time_matches_100_mbit() {
    assert_eq!(segment(8).wire_ns(144), 168 * 80 + 8_000);
    assert_eq!(segment(1).wire_ns(20), 84 * 80 + 1_000, "padded");
}

proptest! {
    #[test]
    fn answer_accepts_any_frame(mut frame: Vec<u8>, ethercat: bool, devices in 0_u32..5) {
        if ethercat && frame.len() > 14 {
            frame[12..14].copy_from_slice(&[0x88, 0xa4]);
        }
        let len = frame.len();
        segment(devices).answer(&mut frame, 7);
        prop_assert_eq!(frame.len(), len);
    }
}
