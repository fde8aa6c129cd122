//! Every recorded vendor file parses; the contents of the EPOS4 file are checked in detail.

use crate::common;
use ecaxis_esi::{FmmuUse, ObjectCode, SmUse, Writable, parse};

#[test]
fn every_vendor_file_parses() {
    let files = common::files("esi", &["xml"]);
    let others = common::vendor_files("esi", &["xml"]);
    for path in files.iter().chain(&others) {
        let bytes = std::fs::read(path).unwrap();
        let file = parse(&bytes).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert!(!file.devices.is_empty(), "{}", path.display());
        for object in file.devices.iter().flat_map(|d| &d.dictionary.objects) {
            for item in &object.items {
                assert_eq!(
                    item.default.len(),
                    item.bit_len.div_ceil(8) as usize,
                    "{:04x}",
                    object.index
                );
            }
        }
        println!(
            "{}: {} devices, {} modules, {} objects, {} warnings",
            path.file_name().unwrap().to_string_lossy(),
            file.devices.len(),
            file.modules.len(),
            file.devices
                .iter()
                .map(|d| d.dictionary.objects.len())
                .sum::<usize>()
                + file
                    .modules
                    .iter()
                    .map(|m| m.dictionary.objects.len())
                    .sum::<usize>(),
            file.warnings.len(),
        );
        for warning in file.warnings.iter().take(4) {
            println!(
                "    {} {}: {}",
                warning.position, warning.path, warning.message
            );
        }
    }
    if common::fixtures().is_some() {
        assert!(files.len() >= 30, "only {} files", files.len());
    }
}

#[test]
fn every_bus_dump_parses() {
    for path in common::files("igh_xml", &["xml"]) {
        let file = parse(&std::fs::read(&path).unwrap())
            .unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert!(file.devices.len() >= 3, "{}", path.display());
    }
}

/// The expected values were read from the file by hand.
#[test]
fn the_epos4_file_is_read_exactly() {
    let Some(bytes) = common::read(common::EPOS4) else {
        return;
    };
    let file = parse(&bytes).unwrap();
    assert_eq!(
        (file.vendors[0].id, file.vendors[0].name.as_str()),
        (0xfb, "maxon motor ag")
    );
    assert_eq!(
        (file.devices.len(), file.modules.len(), file.warnings.len()),
        (1, 5, 0)
    );
    let device = &file.devices[0];
    assert_eq!((device.position.line, device.position.column), (18, 7));
    assert_eq!(
        (device.identity.product, device.identity.revision),
        (0x6950_0000, 0x0170_0000)
    );
    assert_eq!(
        (device.type_name.as_str(), device.name.as_str()),
        ("EPOS4", "EPOS4 Micro 24/5 EtherCAT")
    );
    assert_eq!((device.physics.as_str(), device.profile), ("YY", Some(402)));
    assert_eq!(
        device
            .fmmus
            .iter()
            .map(|fmmu| fmmu.usage)
            .collect::<Vec<_>>(),
        [FmmuUse::Outputs, FmmuUse::Inputs, FmmuUse::MBoxState]
    );
    let sms: Vec<_> = device
        .sync_managers
        .iter()
        .map(|sm| (sm.usage, sm.start_address, sm.default_size, sm.control_byte))
        .collect();
    assert_eq!(
        sms,
        [
            (SmUse::MBoxOut, 0x1000, 48, 0x26),
            (SmUse::MBoxIn, 0x1030, 48, 0x22),
            (SmUse::Outputs, 0x1060, 0, 0x64),
            (SmUse::Inputs, 0x10f0, 0, 0x20),
        ]
    );
    assert_eq!((device.rx_pdos.len(), device.tx_pdos.len()), (4, 4));
    assert!(
        device
            .rx_pdos
            .iter()
            .all(|pdo| pdo.overwritten_by_module && pdo.exclude.len() == 3 && !pdo.fixed)
    );
    let coe = device.mailbox.as_ref().unwrap().coe.as_ref().unwrap();
    assert!(
        !coe.sdo_info
            && coe.complete_access
            && coe.pdo_assign
            && coe.pdo_config
            && coe.segmented_sdo
    );
    let modes: Vec<_> = device
        .dc_modes
        .iter()
        .map(|mode| (mode.name.as_str(), mode.assign_activate))
        .collect();
    assert_eq!(modes, [("DC", 0x300), ("Synchron", 0)]);
    let slots = device.slots.as_ref().unwrap();
    assert!(slots.download_module_ident_list && slots.max_count == Some(1));
    assert_eq!(
        (slots.slots.len(), slots.slots[0].name.as_str()),
        (1, "Axis 1")
    );
    assert_eq!(
        slots.slots[0].module_idents.iter().find(|m| m.1),
        Some(&(0x6800_000c, true))
    );
    let modules: Vec<_> = file
        .modules
        .iter()
        .map(|m| (m.ident, m.init_cmds[0].data.clone()))
        .collect();
    let expected = [
        (0x6100_000c, 1),
        (0x6300_000c, 3),
        (0x6800_000c, 8),
        (0x6900_000c, 9),
        (0x6a00_000c, 10),
    ];
    assert_eq!(modules, expected.map(|(ident, mode)| (ident, vec![mode])));
    let objects = file
        .modules
        .iter()
        .map(|m| m.dictionary.objects.len())
        .sum::<usize>();
    assert_eq!(device.dictionary.objects.len() + objects, 440);
    assert_eq!(
        (
            device.eeprom.byte_size,
            device.eeprom.config_data.len(),
            device.eeprom.bootstrap.len()
        ),
        (2048, 14, 8)
    );

    let assigned = device.dictionary.object(0x1c12).unwrap();
    assert_eq!(assigned.code, ObjectCode::Array);
    assert_eq!(assigned.items[0].max, Some([1].into()));
    assert_eq!(assigned.items[1].default, [0x00, 0x16]);
    assert_eq!(
        assigned.items[1].access.write,
        Writable::Only {
            pre_op: true,
            safe_op: false,
            op: false
        }
    );
    // Subindices 2 and 3 do not exist and stay missing.
    let restore: Vec<_> = device
        .dictionary
        .object(0x1011)
        .unwrap()
        .items
        .iter()
        .map(|i| (i.sub, i.bit_offset))
        .collect();
    assert_eq!(restore, [(0, 0), (1, 16), (4, 48)]);
    assert_eq!(
        device.dictionary.item(0x60a9, 0).unwrap().default,
        0x00b4_4700u32.to_le_bytes()
    );
    assert_eq!(device.dictionary.item(0x1008, 0).unwrap().default, b"EPOS4");
    let csp = &file.modules[2].dictionary;
    let (value, exponent) = (csp.item(0x60c2, 1).unwrap(), csp.item(0x60c2, 2).unwrap());
    assert_eq!(
        (value.default.as_slice(), value.max.as_deref()),
        (&[0][..], Some(&[100][..]))
    );
    assert_eq!(exponent.default, [0xfd]);
    assert!(
        csp.item(0x607a, 0).unwrap().pdo_mapping.rx && csp.item(0x6064, 0).unwrap().pdo_mapping.tx
    );
}
