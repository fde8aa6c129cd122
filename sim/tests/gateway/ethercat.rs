//! The EtherCAT side: sizes, PDOs, objects (manual §5.4, §7.3.4, §8).

use super::*;

#[test]
fn gateway_maps_the_configured_pdos_and_bytes() {
    for (size, pdos) in [
        (2, vec![2]),
        (16, vec![16]),
        (128, vec![128]),
        (129, vec![128, 1]),
        (130, vec![128, 2]),
        (384, vec![128; 3]),
        (511, vec![128, 128, 128, 127]),
        (512, vec![128; 4]),
    ] {
        let options = GatewayOptions {
            input_size: Some(size),
            output_size: Some(514 - size),
            ..GatewayOptions::default()
        };
        let mut bus = Bus::new(vec![build("GW16", options).unwrap()]);
        bus.address_all();
        let (learned, mapped) = bring_up(&mut bus, S).unwrap();
        assert_eq!(mapped.inputs, usize::from(size));
        assert_eq!(mapped.outputs, 514 - usize::from(size));
        assert_eq!(
            number(&bus.read(S, 0x81a, 2)),
            u64::from(size),
            "SM3 length"
        );
        let mut mailbox = Mailbox::new(S, &learned);
        let mut read = |index, sub| {
            mailbox
                .upload(&mut bus, index, sub)
                .map(|data| number(&data))
        };
        assert_eq!(read(0x1c13, 0), Ok(pdos.len() as u64));
        for (n, bytes) in (0..4).zip(pdos.iter().map(Some).chain(std::iter::repeat(None))) {
            let Some(bytes) = bytes else {
                assert!(read(0x1a00 + n, 0).unwrap_err().contains("06020000"));
                assert!(read(0x2000 + n, 0).unwrap_err().contains("06020000"));
                continue;
            };
            assert_eq!(read(0x1c13, n as u8 + 1), Ok(u64::from(0x1a00 + n)));
            assert_eq!(read(0x1a00 + n, 0), Ok(*bytes));
            assert_eq!(read(0x2000 + n, 0), Ok(*bytes));
            let last = *bytes as u8;
            let mapping = u64::from(0x2000 + n) << 16 | u64::from(last) << 8 | 8;
            assert_eq!(read(0x1a00 + n, last), Ok(mapping));
            assert_eq!(read(0x2000 + n, last), Ok(0));
            if last < 128 {
                assert!(read(0x2000 + n, last + 1).unwrap_err().contains("06090011"));
            }
        }
    }
}

#[test]
fn gateway_standard_objects_match_the_manual() {
    let mut bus = Bus::new(vec![build("GW512", GatewayOptions::default()).unwrap()]);
    bus.address_all();
    let (learned, mapped) = bring_up(&mut bus, S).unwrap();
    assert_eq!((mapped.outputs, mapped.inputs), (512, 512));
    let mut mailbox = Mailbox::new(S, &learned);
    for (index, sub, value) in [
        (0x1000, 0, 0),
        (0x1018, 0, 4),
        (0x1018, 1, 0x0e0a),
        (0x1018, 2, 0x4757_0200),
        (0x1600, 0, 128),
        (0x1603, 128, 0x2103_8008),
        (0x1a03, 1, 0x2003_0108),
        (0x1c00, 0, 4),
        (0x1c00, 1, 1),
        (0x1c00, 2, 2),
        (0x1c00, 3, 3),
        (0x1c00, 4, 4),
        (0x1c12, 0, 4),
        (0x1c12, 4, 0x1603),
        (0x1c13, 4, 0x1a03),
    ] {
        let found = mailbox
            .upload(&mut bus, index, sub)
            .map(|data| number(&data));
        assert_eq!(found, Ok(value), "{index:04x}:{sub:02x}");
    }
    assert_eq!(mailbox.upload(&mut bus, 0x1008, 0), Ok(b"GW512".to_vec()));
    // All PDOs are fixed; process data is read-only over SDO.
    for (index, sub, data) in [
        (0x1c12, 0, &[0][..]),
        (0x1600, 0, &[0]),
        (0x2100, 3, &[7]),
        (0x2000, 3, &[7]),
    ] {
        let error = mailbox.download(&mut bus, index, sub, data).unwrap_err();
        assert!(error.contains("06010002"), "{error}");
    }
    // The sizes are objects of the secondary network's dictionary.
    let error = mailbox.upload(&mut bus, 0x3000, 0).unwrap_err();
    assert!(error.contains("06020000"), "{error}");
}

#[test]
fn gateway_process_data_is_readable_by_sdo() {
    let mut line = Line::new("GW16", three_drives());
    line.outputs[40] = 0xa5;
    line.cycles(3);
    line.gateway_mut().configure(0x2100, 40, &[0x5a]).unwrap();
    line.cycles(3);
    assert_eq!(line.inputs[41], 0x5a, "the first byte of 0x2100 is byte 2");
    let mut mailbox = Mailbox::new(S, &line.learned);
    assert_eq!(mailbox.upload(&mut line.bus, 0x2100, 41), Ok(vec![0xa5]));
    assert_eq!(mailbox.upload(&mut line.bus, 0x2000, 42), Ok(vec![0x5a]));
    assert_eq!(line.gateway().configuration(0x2000, 39), Ok(vec![0xa5]));
    assert_eq!(line.gateway().configuration(0x2010, 20), Ok(vec![0xa5, 0]));
}

#[test]
fn sizes_from_a_configuration_tool_apply_after_a_restart() {
    let mut line = Line::new("GW16", GatewayOptions::default());
    assert_eq!((line.outputs.len(), line.inputs.len()), (16, 16));
    for (index, value, expected) in [
        (0x3000, 1, Err(0x0609_0032)),
        (0x3000, 513, Err(0x0609_0031)),
        (0x3001, 0, Err(0x0609_0032)),
        (0x3000, 300, Ok(())),
        (0x3001, 20, Ok(())),
    ] {
        let written = line
            .gateway_mut()
            .configure(index, 0, &u16::to_le_bytes(value));
        assert_eq!(
            written.map_err(|abort| abort.0),
            expected,
            "{index:04x} = {value}"
        );
    }
    let restart = |line: &mut Line| {
        let script = "[[fault]]\nat = \"0ms\"\nfor = \"10ms\"\ndevice = 0\nkind = \"absent\"\n";
        line.bus
            .segment
            .set_faults(ecaxis_sim::FaultScript::parse(script).unwrap());
        line.bus.wait(20 * MS);
        line.bus.address_all();
        bring_up(&mut line.bus, S).unwrap().1
    };
    let mapped = restart(&mut line);
    assert_eq!((mapped.outputs, mapped.inputs), (16, 16), "not saved");
    line.gateway_mut()
        .configure(0x3000, 0, &300u16.to_le_bytes())
        .unwrap();
    line.gateway_mut()
        .configure(0x3001, 0, &20u16.to_le_bytes())
        .unwrap();
    let wrong = line.gateway_mut().configure(0x1010, 1, b"safe");
    assert_eq!(wrong.map_err(|abort| abort.0), Err(0x0800_0020));
    line.gateway_mut().configure(0x1010, 1, b"save").unwrap();
    let mapped = restart(&mut line);
    assert_eq!((mapped.outputs, mapped.inputs), (20, 300));
    // A MainDevice that still uses 16 bytes is refused.
    line.bus.to(S, PREOP);
    line.bus.write(S, 0x816, &[0]);
    line.bus.sm(S, 2, 0x1200, 16, 0x64);
    assert_eq!(line.bus.request(S, 4), (0x12, 0x1d));
    line.bus.request(S, 0x12);
    line.bus.write(S, 0x816, &[0]);
    line.bus.sm(S, 2, 0x1200, 20, 0x64);
    line.bus.write(S, 0x81e, &[0]);
    line.bus.sm(S, 3, 0x1800, 16, 0x20);
    assert_eq!(line.bus.request(S, 4), (0x12, 0x1e));
}

#[test]
fn sizes_beyond_the_fieldbus_are_not_stored() {
    let mut device = ours().devices[0].clone();
    device.sync_managers[3].max_size = Some(64);
    let sim = SimDevice::from_esi(&device, &[], DeviceOptions::default()).unwrap();
    let mut bus = Bus::new(vec![sim]);
    let gateway = bus.segment.device_mut(0).unwrap().gateway_mut().unwrap();
    let save = |gateway: &mut Gateway, size: u16| {
        gateway.configure(0x3000, 0, &size.to_le_bytes()).unwrap();
        gateway
            .configure(0x1010, 1, b"save")
            .map_err(|abort| abort.0)
    };
    assert_eq!(save(gateway, 64), Ok(()));
    assert_eq!(save(gateway, 65), Err(0x0800_0020));
    assert_eq!(gateway.configuration(0x1003, 1), Ok(vec![0x00, 0x66, 0, 0]));
    gateway.configure(0x1003, 0, &[0]).unwrap();
    assert_eq!(gateway.configuration(0x1003, 0), Ok(vec![0]));
}

#[test]
fn gateway_is_detected_from_its_eeprom_image() {
    let image = build("GW512", GatewayOptions::default())
        .unwrap()
        .sii()
        .to_vec();
    let sim = SimDevice::from_sii(&image, DeviceOptions::default()).unwrap();
    assert!(sim.gateway().is_some());
    let mut bus = Bus::new(vec![sim]);
    bus.address_all();
    let (_, mapped) = bring_up(&mut bus, S).unwrap();
    assert_eq!((mapped.outputs, mapped.inputs), (512, 512));
    // Nodes need a gateway.
    let options = DeviceOptions {
        gateway: Some(GatewayOptions::default()),
        ..DeviceOptions::default()
    };
    let error = SimDevice::from_esi(&coe_device(), &[], options).unwrap_err();
    assert!(
        error.to_string().contains("not a CANopen gateway"),
        "{error}"
    );
}
