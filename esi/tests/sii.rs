//! EEPROM images: recorded images parse, and emitted images parse to the same contents.

use crate::common;
use ecaxis_esi::sii::{
    self, General, MailboxAreas, Protocols, Sii, SiiDc, SiiEntry, SiiFmmuDetail, SiiOptions,
    SiiPdo, SiiSyncManager,
};
use ecaxis_esi::{FmmuUse, Identity, SmUse, parse};
use proptest::prelude::*;

fn image(path: &str) -> Option<Sii> {
    common::read(path).map(|bytes| sii::parse(&bytes).unwrap())
}

#[test]
fn every_recorded_image_parses() {
    for path in common::files("sii", &["bin", "hex", "sii"]) {
        let bytes = std::fs::read(&path).unwrap();
        if bytes.first() == Some(&b':') {
            continue; // Intel HEX; the .bin file contains the same bytes.
        }
        let sii = sii::parse(&bytes).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert!(sii.identity.vendor != 0, "{}", path.display());
        assert!(sii.general.is_some(), "{}", path.display());
        println!(
            "{}: {} checksum {}",
            path.file_name().unwrap().to_string_lossy(),
            sii.identity,
            sii.checksum_ok
        );
    }
}

#[test]
fn image_of_a_digital_output_terminal_has_the_recorded_contents() {
    let Some(sii) = image("sii/ethercrab/el2004-eeprom-dump.bin") else {
        return;
    };
    assert!(sii.checksum_ok && sii.ended);
    assert_eq!(
        (sii.identity.vendor, sii.identity.product),
        (2, 0x07d4_3052)
    );
    assert_eq!(sii.fmmus, [FmmuUse::Outputs]);
    assert_eq!(sii.sync_managers.len(), 1);
    let sm = sii.sync_managers[0];
    assert_eq!(
        (sm.start_address, sm.control, sm.usage),
        (0x0f00, 0x44, SmUse::Outputs)
    );
    assert_eq!(sii.general.unwrap().order, "EL2004");
    assert_eq!(sii.rx_pdos.len(), 4);
    assert!(
        sii.rx_pdos
            .iter()
            .all(|pdo| pdo.bit_len() == 1 && pdo.sm == Some(0))
    );
}

#[test]
fn image_of_a_servo_drive_has_the_recorded_contents() {
    let Some(sii) = image("sii/ethercrab/akd.hex") else {
        return;
    };
    assert!(sii.checksum_ok && sii.ended);
    let expected = Identity {
        vendor: 0x6a,
        product: 0x0041_4b44,
        revision: 2,
    };
    assert_eq!(sii.identity, expected);
    assert_eq!(
        sii.fmmus,
        [FmmuUse::Outputs, FmmuUse::Inputs, FmmuUse::MBoxState]
    );
    let mailbox = MailboxAreas {
        receive_offset: 0x1800,
        receive_size: 1024,
        send_offset: 0x1c00,
        send_size: 1024,
    };
    assert_eq!(sii.mailbox, mailbox);
    assert!(
        sii.protocols.has(Protocols::COE)
            && sii.protocols.has(Protocols::FOE)
            && sii.protocols.has(Protocols::EOE)
    );
    assert_eq!(sii.sync_managers.len(), 4);
    assert_eq!(sii.dc.len(), 2);
    assert_eq!(
        sii.dc[0].assign_activate,
        0x300 | sii.dc[0].assign_activate & 0xff
    );
}

#[test]
fn image_of_the_vendor_drive_reads_back() {
    let Some(bytes) = common::read(common::EPOS4) else {
        return;
    };
    let file = parse(&bytes).unwrap();
    let options = SiiOptions {
        alias: 1001,
        serial: 0x1234_5678,
    };
    let image = sii::emit(&file.devices[0], &file.modules, &options);
    assert_eq!(image.len(), 2048);
    let sii = sii::parse(&image).unwrap();
    assert!(sii.checksum_ok && sii.ended);
    assert_eq!(sii.identity, file.devices[0].identity);
    assert_eq!(
        (sii.alias, sii.serial, sii.byte_size),
        (1001, 0x1234_5678, 2048)
    );
    assert_eq!(sii.protocols, Protocols(Protocols::COE | Protocols::FOE));
    assert_eq!(
        (sii.bootstrap.receive_offset, sii.bootstrap.receive_size),
        (0x1000, 100)
    );
    assert_eq!(
        (sii.mailbox.send_offset, sii.mailbox.send_size),
        (0x1030, 48)
    );
    // The file contains no sizes; the default module (CSP) maps 17 bytes in each direction.
    let lengths: Vec<u16> = sii.sync_managers.iter().map(|sm| sm.len).collect();
    assert_eq!(lengths, [48, 48, 17, 17]);
    let assigned: Vec<u16> = sii
        .rx_pdos
        .iter()
        .filter(|pdo| pdo.sm == Some(2))
        .map(|pdo| pdo.index)
        .collect();
    assert_eq!(assigned, [0x1600]);
    let general = sii.general.unwrap();
    assert_eq!((general.order.as_str(), general.ports), ("EPOS4", 0x11));
    assert_eq!(general.coe_details, 0b10_1101);
    assert_eq!(sii.dc[0].assign_activate, 0x300);
}

#[test]
fn every_device_of_every_vendor_gets_an_image() {
    for path in common::files("esi", &["xml"]) {
        let file = parse(&std::fs::read(&path).unwrap()).unwrap();
        for device in &file.devices {
            let image = sii::emit(device, &file.modules, &SiiOptions::default());
            let sii = sii::parse(&image).unwrap();
            assert!(
                sii.checksum_ok && sii.ended && image.len().is_multiple_of(128),
                "{}",
                device.name
            );
            assert_eq!(sii.identity, device.identity);
            assert_eq!(sii.sync_managers.len(), device.sync_managers.len());
            let usages: Vec<_> = device.fmmus.iter().map(|fmmu| fmmu.usage).collect();
            assert_eq!(sii.fmmus, usages, "{}", device.name);
            assert_eq!(sii, sii::parse(&sii.to_bytes()).unwrap(), "{}", device.name);
        }
    }
}

/// Vendor images list PDOs for registers behind a virtual SyncManager, but no length.
#[test]
fn virtual_pdos_are_listed_in_file_order() {
    let xml = br##"<EtherCATInfo><Vendor><Id>1</Id></Vendor><Descriptions><Devices><Device>
        <Type ProductCode="#x1">Oversampler</Type><Name>Oversampler</Name>
        <Sm StartAddress="#x1000" ControlByte="#x20" Enable="1">Inputs</Sm>
        <Sm StartAddress="#x0990" Virtual="1">Inputs</Sm>
        <TxPdo Sm="1" Virtual="1" Fixed="1"><Index>#x1A10</Index><Exclude>#x1A11</Exclude><Name>Start</Name>
            <Entry><Index>#x990</Index><BitLen>64</BitLen></Entry></TxPdo>
        <TxPdo Sm="1" Virtual="1" Fixed="1"><Index>#x1A11</Index><Exclude>#x1A10</Exclude><Name>Stop</Name>
            <Entry><Index>#x998</Index><BitLen>64</BitLen></Entry></TxPdo>
        <TxPdo Sm="0"><Index>#x1A00</Index><Name>Value</Name>
            <Entry><Index>#x6000</Index><SubIndex>1</SubIndex><BitLen>16</BitLen></Entry></TxPdo>
        </Device></Devices></Descriptions></EtherCATInfo>"##;
    let file = parse(xml).unwrap();
    let image = sii::emit(&file.devices[0], &[], &SiiOptions::default());
    let sii = sii::parse(&image).unwrap();
    let listed: Vec<_> = sii
        .tx_pdos
        .iter()
        .map(|p| (p.index, p.sm, p.flags))
        .collect();
    let expected = [
        (0x1a10, Some(1), 0x30),
        (0x1a11, None, 0x30),
        (0x1a00, Some(0), 0),
    ];
    assert_eq!(listed, expected);
    let lengths: Vec<_> = sii
        .sync_managers
        .iter()
        .map(|sm| (sm.len, sm.enable))
        .collect();
    assert_eq!(lengths, [(2, 1), (0, 4)]);
}

fn text() -> impl Strategy<Value = String> {
    "[ -~]{0,20}"
}

fn entry() -> impl Strategy<Value = SiiEntry> {
    (
        any::<u16>(),
        any::<u8>(),
        text(),
        any::<u8>(),
        any::<u8>(),
        any::<u16>(),
    )
        .prop_map(|(index, sub, name, data_type, bit_len, flags)| SiiEntry {
            index,
            sub,
            name,
            data_type,
            bit_len,
            flags,
        })
}

fn pdo() -> impl Strategy<Value = SiiPdo> {
    (
        any::<u16>(),
        text(),
        proptest::option::of(0..16u8),
        any::<u8>(),
        any::<u16>(),
        prop::collection::vec(entry(), 0..6),
    )
        .prop_map(
            |(index, name, sm, synchronization, flags, entries)| SiiPdo {
                index,
                name,
                sm,
                synchronization,
                flags,
                entries,
            },
        )
}

fn dc() -> impl Strategy<Value = SiiDc> {
    (
        text(),
        text(),
        any::<u16>(),
        any::<u32>(),
        any::<[i32; 2]>(),
        any::<[i16; 2]>(),
    )
        .prop_map(
            |(name, description, assign_activate, cycle0_ns, shifts, factors)| SiiDc {
                name,
                description,
                assign_activate,
                cycle0_ns,
                shift0_ns: shifts[0],
                shift1_ns: shifts[1],
                sync0_factor: factors[0],
                sync1_factor: factors[1],
            },
        )
}

fn sync_manager() -> impl Strategy<Value = SiiSyncManager> {
    let usage = prop_oneof![
        Just(SmUse::MBoxOut),
        Just(SmUse::MBoxIn),
        Just(SmUse::Outputs),
        Just(SmUse::Inputs),
        Just(SmUse::Other)
    ];
    (any::<u16>(), any::<u16>(), any::<u8>(), any::<u8>(), usage).prop_map(
        |(start_address, len, control, enable, usage)| SiiSyncManager {
            start_address,
            len,
            control,
            enable,
            usage,
        },
    )
}

fn any_image() -> impl Strategy<Value = Sii> {
    let fmmu = prop_oneof![
        Just(FmmuUse::Outputs),
        Just(FmmuUse::Inputs),
        Just(FmmuUse::MBoxState),
        Just(FmmuUse::Other)
    ];
    let general = (
        text(),
        text(),
        text(),
        text(),
        any::<(u8, bool, bool, u8, i16, u16, u16)>(),
    )
        .prop_map(
            |(
                group,
                image,
                order,
                name,
                (coe_details, foe, eoe, flags, ebus_ma, ports, identification_address),
            )| General {
                group,
                image,
                order,
                name,
                coe_details,
                foe,
                eoe,
                flags,
                ebus_ma,
                ports,
                identification_address,
            },
        );
    let detail = (
        any::<bool>(),
        proptest::option::of(any::<u8>()),
        proptest::option::of(any::<u8>()),
    )
        .prop_map(|(op_only, sm, su)| SiiFmmuDetail { op_only, sm, su });
    let details = prop::collection::vec(detail, 0..9);
    let units = prop::collection::vec(0..16_u8, 0..4);
    let even_bytes =
        || prop::collection::vec(any::<[u8; 2]>(), 0..5).prop_map(|pairs| pairs.concat());
    let other = (0x0800..0x3000_u16, even_bytes());
    let areas = any::<[u16; 4]>().prop_map(|w| MailboxAreas {
        receive_offset: w[0],
        receive_size: w[1],
        send_offset: w[2],
        send_size: w[3],
    });
    (
        any::<([u8; 14], [u32; 4], u16)>(),
        [areas.clone(), areas],
        proptest::option::of(general),
        prop::collection::vec(fmmu, 0..9),
        prop::collection::vec(sync_manager(), 0..9),
        [
            prop::collection::vec(pdo(), 0..5),
            prop::collection::vec(pdo(), 0..5),
        ],
        prop::collection::vec(dc(), 0..4),
        (details, units, prop::collection::vec(other, 0..4)),
    )
        .prop_map(
            |(
                (config, words, protocols),
                areas,
                general,
                fmmus,
                sync_managers,
                [tx_pdos, rx_pdos],
                dc,
                (fmmu_details, sync_units, others),
            )| Sii {
                config,
                alias: u16::from_le_bytes([config[8], config[9]]),
                checksum_ok: true,
                identity: Identity {
                    vendor: words[0],
                    product: words[1],
                    revision: words[2],
                },
                serial: words[3],
                bootstrap: areas[0],
                mailbox: areas[1],
                protocols: Protocols(protocols),
                byte_size: 32768,
                general,
                fmmus,
                sync_managers,
                tx_pdos,
                rx_pdos,
                dc,
                fmmu_details,
                sync_units,
                others,
                ended: true,
                damage: Vec::new(),
            },
        )
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn emitted_images_read_back(sii in any_image()) {
        prop_assert_eq!(sii::parse(&sii.to_bytes()), Ok(sii));
    }

    #[test]
    fn parse_never_panics_on_any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..1024)) {
        let _ = sii::parse(&bytes);
    }

    #[test]
    fn parse_never_panics_on_damaged_images(sii in any_image(), cuts in prop::collection::vec((any::<u16>(), any::<u8>()), 1..8), end in any::<u16>()) {
        let mut bytes = sii.to_bytes();
        for (at, value) in cuts {
            let at = usize::from(at) % bytes.len();
            bytes[at] = value;
        }
        bytes.truncate(usize::from(end) % bytes.len());
        let _ = sii::parse(&bytes);
    }
}
