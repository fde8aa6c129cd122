//! The drives behind the gateway: objects, PDOs, motion (application note "CANopen Basic
//! Information").

use super::*;

/// A node without a partner repeats its boot-up message until the gateway listens. The gateway's
/// reset must drop that message.
#[test]
fn single_node_starts_for_every_model() {
    for (id, drive) in [(1, Epos::E24_1), (2, Epos::E24_5), (100, Epos::E70_10)] {
        for supervision in [
            Supervision::None,
            Supervision::Heartbeat { period_ms: 50 },
            Supervision::Guarding {
                period_ms: 100,
                retries: 3,
            },
        ] {
            let alone = NodeOptions {
                supervision,
                mandatory: true,
                ..node(id, drive, 2)
            };
            let options = GatewayOptions {
                nodes: vec![alone],
                ..GatewayOptions::default()
            };
            let mut line = Line::new("GW16", options);
            assert_eq!(line.command(0x01, 0x80), Some(0x01), "{drive:?}");
            line.cycles(100);
            // The Statusword that the drive sends in its PDO.
            assert_eq!(line.input(2, 2) & 0x4f, 0x40, "{drive:?} {supervision:?}");
        }
    }
}

#[test]
fn epos_models_report_their_hardware() {
    let mut line = Line::new("GW16", three_drives());
    for (id, hardware) in [(1, 0x6010), (2, 0x6210), (100, 0x6410)] {
        let mut read = |index, sub| line.sdo(id, index, sub, None);
        assert_eq!(read(0x1000, 0), Ok(0x0002_0192));
        assert_eq!(read(0x1008, 0), Ok(number(b"EPOS")));
        assert_eq!(read(0x1018, 1), Ok(0xfb));
        assert_eq!(read(0x1018, 2), Ok(hardware << 16));
        assert_eq!(read(0x2003, 2), Ok(hardware));
        assert_eq!(read(0x2000, 0), Ok(id.into()));
        assert_eq!(read(0x2001, 0), Ok(0), "1 Mbit/s");
        assert_eq!(read(0x1014, 0), Ok(0x80 + u64::from(id)));
        // The application note's example.
        assert_eq!(read(0x60f6, 1), Ok(0x190));
        assert_eq!(read(0x60f7, 1), Err(0x0602_0000));
        assert_eq!(read(0x60f6, 3), Err(0x0609_0011));
    }
    assert_eq!(line.sdo(1, 0x60f6, 1, Some(&[0x12, 0x34])), Ok(0));
    assert_eq!(line.sdo(1, 0x60f6, 1, None), Ok(0x3412));
    assert_eq!(
        line.sdo(1, 0x60f6, 1, Some(&[1, 2, 3, 4])),
        Err(0x0607_0012)
    );
    assert_eq!(line.sdo(1, 0x6041, 0, Some(&[1, 2])), Err(0x0601_0002));
    assert_eq!(line.sdo(7, 0x1000, 0, None), Err(0x0504_0000), "no node");
    let too_high = NodeOptions::new(16, Epos::E24_1);
    let options = GatewayOptions {
        nodes: vec![too_high],
        ..GatewayOptions::default()
    };
    assert!(build("GW16", options).unwrap_err().contains("up to 15"));
}

/// PDO configuration, the application note step by step.
#[test]
fn node_pdos_are_configured_as_in_the_application_note() {
    let mut line = Line::new("GW16", three_drives());
    let u32_ = u32::to_le_bytes;
    let mut write = |index, sub, data: &[u8]| line.sdo(2, index, sub, Some(data)).map(drop);
    // COB-IDs have a range.
    assert_eq!(write(0x1401, 1, &u32_(0x333)), Ok(()));
    assert_eq!(write(0x1401, 1, &u32_(0x300)), Err(0x0609_0032));
    assert_eq!(write(0x1401, 1, &u32_(0x380)), Err(0x0609_0031));
    // Types 1 and 255.
    assert_eq!(write(0x1401, 2, &[1]), Ok(()));
    assert_eq!(write(0x1401, 2, &[255]), Ok(()));
    assert_eq!(write(0x1401, 2, &[2]), Err(0x0609_0030));
    // Disabled, filled, enabled by the count.
    assert_eq!(write(0x1601, 1, &u32_(0x60ff_0020)), Err(0x0800_0022));
    assert_eq!(write(0x1601, 0, &[0]), Ok(()));
    for mapping in [
        0x6040_0010,
        0x607a_0020,
        0x60ff_0020,
        0x2078_0110,
        0x2030_0010,
        0x206b_0020,
        0x2062_0020,
    ] {
        assert_eq!(write(0x1601, 1, &u32_(mapping)), Ok(()), "{mapping:08x}");
    }
    assert_eq!(write(0x1601, 1, &u32_(0x6041_0010)), Err(0x0604_0041));
    assert_eq!(write(0x1601, 2, &u32_(0x60ff_0020)), Ok(()));
    assert_eq!(write(0x1601, 3, &u32_(0x607a_0020)), Ok(()));
    assert_eq!(write(0x1601, 0, &[3]), Err(0x0604_0042));
    assert_eq!(write(0x1601, 0, &[5]), Err(0x0609_0031));
    assert_eq!(write(0x1601, 0, &[2]), Ok(()));
    // The third PDO is static.
    assert_eq!(write(0x1602, 0, &[0]), Err(0x0601_0002));
    assert_eq!(write(0x1a02, 1, &u32_(0x6041_0010)), Err(0x0601_0002));
    for mapping in [
        0x6041_0010,
        0x6064_0020,
        0x606c_0020,
        0x2071_0110,
        0x6078_0010,
        0x207c_0110,
        0x207c_0210,
        0x2020_0010,
        0x2021_0010,
    ] {
        assert_eq!(write(0x1a01, 0, &[0]), Ok(()));
        assert_eq!(write(0x1a01, 1, &u32_(mapping)), Ok(()), "{mapping:08x}");
        assert_eq!(write(0x1a01, 0, &[1]), Ok(()));
    }
    // In Operational the mapping is fixed.
    line.command(0x01, 128);
    assert_eq!(line.sdo(2, 0x1a01, 0, Some(&[0])), Err(0x0800_0022));
}

#[test]
fn drives_move_through_the_gateway_buffers() {
    let mut line = Line::new("GW16", three_drives());
    line.command(0x01, 128);
    for (at, id) in [(2, 1), (12, 2), (22, 100)] {
        assert_eq!(
            line.input(at, 2) & 0x6f,
            0x40,
            "Switch on disabled, node {id}"
        );
        assert_ne!(line.input(at, 2) & 0x200, 0, "remote");
        enable(&mut line, at, 1);
        assert_eq!(
            line.input(at, 2) & 0x6f,
            0x27,
            "Operation enabled, node {id}"
        );
        assert_eq!(line.input(at + 8, 1), 1, "modes of operation display");
        // Profile position: target, then the new set-point bit.
        let target = 4000 + i64::from(id);
        line.output(at + 2, target, 4);
        line.cycles(20);
        line.output(at, 0x1f, 2);
        line.output(at + 6, 0x1f, 2);
        line.cycles(20);
        assert_ne!(line.input(at, 2) & 0x1000, 0, "set-point acknowledged");
        line.cycles(800);
        let position = line.input(at + 2, 4);
        assert!((position - target).abs() <= 2, "node {id}: {position}");
        assert_ne!(line.input(at, 2) & 0x400, 0, "target reached");
        let truth = line.node(id).drive().position_counts();
        assert!((truth - position).abs() <= 1);
    }
}

#[test]
fn maxon_modes_follow_their_own_set_points() {
    let mut options = three_drives();
    options.nodes[1].outputs[0].contents = vec![(0x6040, 0, 16), (0x206b, 0, 32)];
    options.nodes[1].inputs[0].contents = vec![(0x6041, 0, 16), (0x606c, 0, 32)];
    options.nodes[2].outputs[0].contents = vec![(0x6040, 0, 16), (0x2030, 0, 16)];
    options.nodes[2].inputs[0].contents = vec![(0x6041, 0, 16), (0x6078, 0, 16)];
    options.nodes[0].outputs[0].contents = vec![(0x6040, 0, 16), (0x2062, 0, 32)];
    let mut line = Line::new("GW16", options);
    line.command(0x01, 128);
    // Position mode: the set-point itself, without a profile.
    enable(&mut line, 2, -1);
    line.output(4, 500, 4);
    line.cycles(200);
    assert!((line.input(4, 4) - 500).abs() <= 2, "{}", line.input(4, 4));
    assert_eq!(line.input(10, 1), -1);
    // Velocity mode: rpm.
    enable(&mut line, 12, -2);
    line.output(14, 1500, 4);
    line.cycles(400);
    assert!(
        (line.input(14, 4) - 1500).abs() <= 15,
        "{}",
        line.input(14, 4)
    );
    // Current mode: mA. The blocked shaft keeps the current constant.
    line.gateway_mut()
        .node_mut(100)
        .unwrap()
        .drive_mut()
        .set_blocked(true);
    enable(&mut line, 22, -3);
    line.output(24, 2000, 2);
    line.cycles(100);
    assert!(
        (line.input(24, 2) - 2000).abs() <= 40,
        "{}",
        line.input(24, 2)
    );
    assert_eq!(line.input(30, 1), -3);
}

#[test]
fn faulted_drive_sends_its_emergency() {
    let mut line = Line::new("GW16", three_drives());
    line.command(0x01, 128);
    enable(&mut line, 12, 1);
    let drive = line.gateway_mut().node_mut(2).unwrap().drive_mut();
    drive.inject_fault(0x4210);
    line.cycles(60);
    assert_eq!(line.input(12, 2) & 0x4f, 0x08, "fault");
    let frames = sent(&line, 0x82);
    assert_eq!(frames.last().unwrap().data()[..2], [0x10, 0x42]);
    assert_eq!(line.sdo(2, 0x1003, 1, None), Ok(0x4210));
    assert_eq!(
        line.status()[1],
        0,
        "only error control shows in the status word"
    );
}

#[test]
fn can_frames_keep_their_order_and_timing() {
    let mut line = Line::new("GW16", three_drives());
    line.command(0x01, 128);
    line.cycles(100);
    let frames: Vec<_> = line.gateway().frames().collect();
    let mut syncs = 0;
    for pair in frames.windows(2) {
        let ((before, first), (after, second)) = (pair[0], pair[1]);
        let least = second.wire_bits() * 1000;
        assert!(after - before >= least, "{first:?} {second:?}");
        // PDOs of one SYNC follow each other directly, ordered by identifier.
        if first.id >= 0x181 && second.id < 0x500 && second.id > 0x180 && after - before == least {
            assert!(first.id < second.id, "{first:?} {second:?}");
        }
        syncs += u32::from(first.id == 0x80);
    }
    assert!(syncs > 5);
    let periods: Vec<u64> = frames
        .iter()
        .filter(|(_, f)| f.id == 0x80)
        .map(|(at, _)| *at)
        .collect();
    for pair in periods.windows(2) {
        assert!((pair[1] - pair[0]).abs_diff(4 * MS) < 150_000, "{pair:?}");
    }
}

#[test]
fn sdo_client_of_the_secondary_network_reads_texts_in_segments() {
    let mut line = Line::new("GW16", GatewayOptions::default());
    let mut ask = |request: [u8; 8]| line.gateway_mut().serve_sdo(&request).unwrap();
    let first = ask([0x40, 0x08, 0x10, 0, 0, 0, 0, 0]);
    assert_eq!(first, [0x41, 0x08, 0x10, 0, 15, 0, 0, 0]);
    let mut text = ask([0x60, 0, 0, 0, 0, 0, 0, 0])[1..].to_vec();
    text.extend_from_slice(&ask([0x70, 0, 0, 0, 0, 0, 0, 0])[1..]);
    let last = ask([0x60, 0, 0, 0, 0, 0, 0, 0]);
    assert_eq!(last[0], 0x0d, "one byte, the last");
    text.push(last[1]);
    assert_eq!(text, b"CANopen gateway");
}

/// With a single node, no third controller acknowledges the frames of either side.
#[test]
fn a_gateway_with_one_node_boots_it() {
    for (id, drive) in [(1, Epos::E24_1), (2, Epos::E24_5), (100, Epos::E70_10)] {
        let options = GatewayOptions {
            nodes: vec![NodeOptions::new(id, drive)],
            ..GatewayOptions::default()
        };
        let mut line = Line::new("GW16", options);
        assert_eq!(line.command(0x01, 0), Some(0x01), "{drive:?}");
        line.cycles(150);
        assert_eq!(
            line.node(id).nmt_state(),
            NmtState::Operational,
            "{drive:?}"
        );
        assert_eq!(line.command(0x10, id), Some(0x11), "{drive:?}");
    }
}
