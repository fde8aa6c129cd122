//! Recorded EEPROM images against the ESI files of the same devices: they agree, or the difference is real and listed
//! here. A listed difference that is gone fails as well.

#![allow(clippy::print_stdout)]

mod common;

use ecaxis_esi::sii::{self, Aspect, SiiOptions};
use ecaxis_esi::{DeviceQuery, find_device, parse};

struct Pair {
    esi: &'static str,
    image: &'static str,
    product: Option<u32>,
    revision: Option<u32>,
    /// (beginning of the field, why the image is another)
    differs: &'static [(&'static str, &'static str)],
}

const NO_PDOS: &str =
    "the image was made without PDO categories; the device tells its PDOs over CoE";
const NO_FLAG: &str = "the image's tool never sets the data link layer flag, the ESI has it";
const NO_PORTS: &str = "the image's tool leaves the ports open";
const NO_LENGTH: &str =
    "the image leaves the length of process data open, ours has the default PDOs'";
const NO_DC: &str = "the image was made without the clock category";
const OTHER: &str = "the image belongs to another build of the device than the ESI";

/// What tools that write no PDOs leave out besides.
const WITHOUT_PDOS_AND_PORTS: &[(&str, &str)] = &[
    ("general flags", NO_FLAG),
    ("ports", NO_PORTS),
    ("SyncManager 2", NO_LENGTH),
    ("SyncManager 3", NO_LENGTH),
    ("RxPdo", NO_PDOS),
    ("TxPdo", NO_PDOS),
];

const WITHOUT_PDOS_AND_DC: &[(&str, &str)] = &[
    ("general flags", NO_FLAG),
    ("SyncManager 2", NO_LENGTH),
    ("SyncManager 3", NO_LENGTH),
    ("RxPdo", NO_PDOS),
    ("TxPdo", NO_PDOS),
    ("DC mode", NO_DC),
];

const fn pair(
    esi: &'static str,
    image: &'static str,
    differs: &'static [(&'static str, &'static str)],
) -> Pair {
    Pair {
        esi,
        image,
        product: None,
        revision: None,
        differs,
    }
}

const PAIRS: &[Pair] = &[
    Pair {
        product: Some(0x044c_2c52),
        revision: Some(0x0012_0000),
        ..pair("beckhoff/Beckhoff EK11xx.xml", "ethercrab/ek1100.hex", &[])
    },
    Pair {
        revision: Some(1),
        ..pair("ni/NI9144.xml", "ni/ni_9144_rev_1.bin", &[])
    },
    Pair {
        revision: Some(2),
        ..pair("ni/NI9144.xml", "ni/ni_9144_rev_2.bin", &[])
    },
    pair(
        "kickcat/freedom-k64f.xml",
        "kickcat/freedom-k64f_eeprom.bin",
        &[
            ("vendor", OTHER),
            ("PDI configuration", OTHER),
            ("mailbox", OTHER),
            ("CoE details", OTHER),
            ("general flags", NO_FLAG),
            ("FMMU 2", OTHER),
            ("SyncManager 0", OTHER),
            ("SyncManager 1", OTHER),
            ("SyncManager 2", OTHER),
            ("SyncManager 3", OTHER),
            ("RxPdo", NO_PDOS),
            ("TxPdo", NO_PDOS),
        ],
    ),
    pair(
        "kubabuda/STMBL_ECAT.xml",
        "kubabuda/STMBL_ECAT_eeprom.bin",
        WITHOUT_PDOS_AND_DC,
    ),
    pair(
        "metalmusings/MetalMusings_EaserCAT_3000.xml",
        "metalmusings/EaserCAT_3000_eeprom.bin",
        WITHOUT_PDOS_AND_DC,
    ),
    pair(
        "soes/RTL_ATO.xml",
        "soes/RTL_ATO_eeprom.bin",
        &[
            ("CoE details", OTHER),
            ("general flags", NO_FLAG),
            ("ports", NO_PORTS),
            ("DC mode", NO_DC),
        ],
    ),
    pair(
        "soes/am335xice.xml",
        "soes/am335xice.bin",
        WITHOUT_PDOS_AND_PORTS,
    ),
    pair(
        "soes/rtl_lwip_eoe_slave30.xml",
        "soes/rtl_lwip_eoe_slave30.bin",
        WITHOUT_PDOS_AND_PORTS,
    ),
    pair(
        "soes/rtl_xmc4_dynpdo_slave.xml",
        "soes/rtl_xmc4_dynpdo_sii_eeprom.bin",
        WITHOUT_PDOS_AND_PORTS,
    ),
    pair(
        "soes/xmc4300_esi.xml",
        "soes/xmc4300_sii_eeprom.bin",
        &[
            ("general flags", NO_FLAG),
            (
                "DC mode 1",
                "the image's clock category has room for a second mode, without a name",
            ),
        ],
    ),
    pair(
        "synapticon/SOMANET_CiA_402_2015.xml",
        "synapticon/somanet_cia402_veysiadn.sii",
        &[
            ("general flags", NO_FLAG),
            ("SyncManager 3", OTHER),
            ("RxPdo 0x1600 / flags", OTHER),
            ("TxPdo 0x1a00 / flags", OTHER),
            ("DC mode", OTHER),
        ],
    ),
];

#[test]
fn images_and_esi_files_agree_or_differ_for_a_reason() {
    for pair in PAIRS {
        let read = |folder: &str, name: &str| common::read(&format!("{folder}/{name}"));
        let (Some(esi), Some(image)) = (read("esi", pair.esi), read("sii", pair.image)) else {
            return;
        };
        let file = parse(&esi).unwrap();
        let query = DeviceQuery {
            product: pair.product,
            revision: pair.revision,
            ..DeviceQuery::default()
        };
        let device = find_device(&file, &query).unwrap();
        let own = sii::emit(device, &file.modules, &SiiOptions::default());
        let differences = sii::compare(&sii::parse(&own).unwrap(), &sii::parse(&image).unwrap());
        let mut explained = vec![0; pair.differs.len()];
        for d in &differences {
            if matches!(d.aspect, Aspect::Description | Aspect::Instance) {
                continue;
            }
            let reason = pair
                .differs
                .iter()
                .position(|(field, _)| d.field.starts_with(field));
            match reason {
                Some(reason) => explained[reason] += 1,
                None => panic!("{}: {d:?} is not explained", pair.image),
            }
        }
        for ((field, why), count) in pair.differs.iter().zip(explained) {
            assert!(
                count > 0,
                "{}: {field} agrees now, no longer: {why}",
                pair.image
            );
            println!("{}: {field}: {why} ({count})", pair.image);
        }
    }
}
