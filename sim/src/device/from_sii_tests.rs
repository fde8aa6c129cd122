use ecaxis_esi::model::SmUse;
use ecaxis_esi::sii::{General, MailboxAreas, Protocols, Sii, SiiPdo, SiiSyncManager};
use proptest::prelude::*;

use super::*;
use crate::{AlState, EscInfo};

/// Returns the image of a small device with mailbox and process data in both directions.
fn image() -> Sii {
    let sm = |usage, start_address, len, control| SiiSyncManager {
        start_address,
        len,
        control,
        enable: 1,
        usage,
    };
    let pdo = |index, sm, entry| SiiPdo {
        index,
        name: "PDO".into(),
        sm: Some(sm),
        entries: vec![sii::SiiEntry {
            index: entry,
            sub: 1,
            bit_len: 16,
            ..sii::SiiEntry::default()
        }],
        ..SiiPdo::default()
    };
    let areas = MailboxAreas {
        receive_offset: 0x1000,
        receive_size: 64,
        send_offset: 0x1080,
        send_size: 64,
    };
    Sii {
        config: [0x05, 0x0e, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
        identity: ecaxis_esi::model::Identity {
            vendor: 0xabc,
            product: 0x123,
            revision: 7,
        },
        serial: 99,
        mailbox: areas,
        protocols: Protocols(Protocols::COE),
        byte_size: 2048,
        general: Some(General {
            order: "IO-32".into(),
            name: "IO-32 in and out".into(),
            coe_details: 0x27,
            ports: 0x0031,
            ..General::default()
        }),
        sync_managers: vec![
            sm(SmUse::MBoxOut, 0x1000, 64, 0x26),
            sm(SmUse::MBoxIn, 0x1080, 64, 0x22),
            sm(SmUse::Outputs, 0x1100, 2, 0x64),
            sm(SmUse::Inputs, 0x1180, 2, 0x20),
        ],
        rx_pdos: vec![pdo(0x1600, 2, 0x7000)],
        tx_pdos: vec![pdo(0x1a00, 3, 0x6000)],
        ..Sii::default()
    }
}

fn build(sii: &Sii) -> SimDevice {
    SimDevice::from_sii(&sii.to_bytes(), DeviceOptions::default()).unwrap()
}

#[test]
fn dictionary_holds_the_objects_of_the_image() {
    let device = build(&image());
    assert_eq!(device.name(), "IO-32");
    assert_eq!(device.object(0x1008, 0).unwrap(), b"IO-32");
    for (sub, value) in (1..).zip([0xabc_u32, 0x123, 7, 99]) {
        assert_eq!(device.object(0x1018, sub).unwrap(), value.to_le_bytes());
    }
    let types: Vec<_> = (0..=4).map(|sub| device.object(0x1c00, sub)).collect();
    assert_eq!(types, [4, 1, 2, 3, 4].map(|n: u8| Some(vec![n])));
    assert_eq!(device.object(0x1c12, 1).unwrap(), 0x1600_u16.to_le_bytes());
    assert_eq!(
        device.object(0x1a00, 1).unwrap(),
        0x6000_0110_u32.to_le_bytes()
    );
    assert_eq!(device.object(0x1000, 0).unwrap(), [0; 4]);
    assert_eq!((device.pdo_len(2), device.pdo_len(3)), (2, 2));
}

#[test]
fn image_without_mailbox_builds_a_plain_terminal() {
    let mut sii = image();
    sii.protocols = Protocols::default();
    sii.sync_managers.drain(..2);
    for pdo in sii.rx_pdos.iter_mut().chain(&mut sii.tx_pdos) {
        pdo.sm = pdo.sm.map(|sm| sm - 2);
    }
    let device = build(&sii);
    assert_eq!(device.object(0x1018, 1), None);
    assert_eq!(device.object(0x1008, 0), None);
    assert_eq!((device.pdo_len(0), device.pdo_len(1)), (2, 2));
    assert_eq!(device.al_state(), AlState::Init);
}

#[test]
fn information_registers_show_the_chip_and_its_ports() {
    let image = image().to_bytes();
    for (esc, ports) in [
        (EscInfo::ET1100, 0x0b),
        (
            EscInfo {
                ports: Some(0x4a),
                ..EscInfo::ET1200
            },
            0x4a,
        ),
    ] {
        let options = DeviceOptions {
            esc: Some(esc),
            ..DeviceOptions::default()
        };
        let device = SimDevice::from_sii(&image, options).unwrap();
        let info = device.esc().bytes(0, 8);
        assert_eq!(info[0], esc.kind);
        assert_eq!(
            info[4..],
            [esc.fmmus, esc.sync_managers, esc.ram_kib, ports]
        );
    }
}

#[test]
fn from_sii_names_the_missing_part_of_a_short_image() {
    let error = |bytes: &[u8]| {
        SimDevice::from_sii(bytes, DeviceOptions::default())
            .unwrap_err()
            .to_string()
    };
    assert_eq!(
        error(&[0; 100]),
        "EEPROM image: the image has 100 bytes, the header alone needs 128"
    );
    let good = image().to_bytes();
    let end = 0x80 + 4 + usize::from(u16::from_le_bytes([good[0x82], good[0x83]])) * 2;
    assert_eq!(
        error(&good[..end + 8]),
        format!(
            "EEPROM image: byte 0x{end:x}, category 30: the category claims 32 bytes, 4 are left"
        )
    );
    let mut sii = image();
    sii.sync_managers[3].start_address = 0xfff0;
    sii.sync_managers[3].len = 8;
    assert_eq!(
        error(&sii.to_bytes()),
        "device `IO-32`: SyncManager 3 (0xfff0, 8 bytes) does not lie in process RAM"
    );
}

/// Builds the device and performs every kind of access.
fn exercise(bytes: &[u8]) {
    let Ok(device) = SimDevice::from_sii(bytes, DeviceOptions::default()) else {
        return;
    };
    let sms: Vec<_> = device.sii().to_vec();
    assert_eq!(sms, bytes);
    let mut segment = crate::Segment::new(vec![device], crate::SegmentOptions::default());
    let mut now = 0;
    for state in [1_u8, 2, 4, 8, 1] {
        let mut frame = crate::frame::FrameBuilder::default()
            .datagram(8, 0, 0x120, &[state, 0])
            .datagram(7, 0, 0x130, &[0; 6])
            .datagram(7, 0, 0x1000, &[0; 64])
            .datagram(8, 0, 0x800, &[0, 0x10, 64, 0, 0x26, 0, 1, 0])
            .build();
        segment.transit(&mut frame, now);
        now += 10_000_000;
        segment.advance(now);
    }
}

proptest! {
    #[test]
    fn random_images_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..700)) {
        exercise(&bytes);
    }

    #[test]
    fn mutated_images_never_panic(
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..12),
        cut in any::<Option<prop::sample::Index>>(),
    ) {
        let mut bytes = image().to_bytes();
        let used = 0x180.min(bytes.len());
        for (at, value) in changes {
            bytes[at.index(used)] = value;
        }
        if let Some(cut) = cut {
            bytes.truncate(cut.index(used));
        }
        exercise(&bytes);
    }
}
