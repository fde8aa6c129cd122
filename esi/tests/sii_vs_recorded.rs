//! Recorded EEPROM images compared with the ESI files of the same devices. Each real difference is
//! listed here. A listed difference that no longer exists fails as well.

use crate::common;
use ecaxis_esi::sii::{self, Difference, DifferenceKind, SiiOptions};
use ecaxis_esi::{DeviceQuery, find_device, parse};

struct Pair {
    esi: &'static str,
    image: &'static str,
    product: Option<u32>,
    revision: Option<u32>,
    /// (start of the field, reason for the difference)
    differs: &'static [(&'static str, &'static str)],
    /// The same for display texts: names, data types and sizes.
    described: &'static [(&'static str, &'static str)],
}

const NO_PDOS: &str =
    "the image was made without PDO categories; the device reports its PDOs over CoE";
const NO_FLAG: &str = "the image's tool never sets the data link layer flag, the ESI has it";
const NO_PORTS: &str = "the image's tool leaves the ports open";
const NO_LENGTH: &str =
    "the image leaves the length of process data open, ours has the default PDOs'";
const NO_DC: &str = "the image was made without the clock category";
const OTHER: &str = "the image belongs to another build of the device than the ESI";

const GERMAN: &str = "the image holds the ESI's German name";
const WORDS: &str = "the image's tool writes WORD as UINT";
const NO_DESCRIPTION: &str = "the image's tool leaves descriptions of modes out";
const ICON: &str = "the image names an icon that the ESI does not";
const ROOM: &str = "ours lists PDOs and needs the room";
const BOOL: &str = "the image's tool writes every type as BOOL and counts paddings otherwise";

/// Fixtures without an ESI of the same device.
const ALONE: &[&str] = &[
    "ethercrab/akd.hex",
    "ethercrab/el2004-eeprom-dump.bin",
    "ethercrab/el2262.bin",
    "kickcat/arduino-due_eeprom.bin",
    "kickcat/sim_simple_slave.bin",
    // The .bin file contains the same bytes.
    "metalmusings/EaserCAT_3000_eeprom.hex",
];

/// Further fields that are missing in images of tools that write no PDOs.
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
        described: &[],
    }
}

const PAIRS: &[Pair] = &[
    Pair {
        described: &[("name", GERMAN)],
        product: Some(0x044c_2c52),
        revision: Some(0x0012_0000),
        ..pair("beckhoff/Beckhoff EK11xx.xml", "ethercrab/ek1100.hex", &[])
    },
    Pair {
        described: &[("TxPdo", WORDS), ("DC mode", NO_DESCRIPTION)],
        revision: Some(1),
        ..pair("ni/NI9144.xml", "ni/ni_9144_rev_1.bin", &[])
    },
    Pair {
        described: &[("TxPdo", WORDS), ("DC mode", NO_DESCRIPTION)],
        revision: Some(2),
        ..pair("ni/NI9144.xml", "ni/ni_9144_rev_2.bin", &[])
    },
    Pair {
        described: &[
            ("EEPROM size", OTHER),
            ("group", OTHER),
            ("image", OTHER),
            ("order code", OTHER),
            ("name", OTHER),
        ],
        ..pair(
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
        )
    },
    Pair {
        described: &[
            ("image", ICON),
            ("order code", "the image's ends in a space"),
        ],
        ..pair(
            "kubabuda/STMBL_ECAT.xml",
            "kubabuda/STMBL_ECAT_eeprom.bin",
            WITHOUT_PDOS_AND_DC,
        )
    },
    Pair {
        described: &[("image", ICON)],
        ..pair(
            "metalmusings/MetalMusings_EaserCAT_3000.xml",
            "metalmusings/EaserCAT_3000_eeprom.bin",
            WITHOUT_PDOS_AND_DC,
        )
    },
    Pair {
        described: &[("EEPROM size", OTHER), ("order code", OTHER)],
        ..pair(
            "soes/RTL_ATO.xml",
            "soes/RTL_ATO_eeprom.bin",
            &[
                ("CoE details", OTHER),
                ("general flags", NO_FLAG),
                ("ports", NO_PORTS),
                ("DC mode", NO_DC),
            ],
        )
    },
    pair(
        "soes/am335xice.xml",
        "soes/am335xice.bin",
        WITHOUT_PDOS_AND_PORTS,
    ),
    Pair {
        described: &[("EEPROM size", ROOM)],
        ..pair(
            "soes/rtl_lwip_eoe_slave30.xml",
            "soes/rtl_lwip_eoe_slave30.bin",
            WITHOUT_PDOS_AND_PORTS,
        )
    },
    Pair {
        described: &[("EEPROM size", ROOM)],
        ..pair(
            "soes/rtl_xmc4_dynpdo_slave.xml",
            "soes/rtl_xmc4_dynpdo_sii_eeprom.bin",
            WITHOUT_PDOS_AND_PORTS,
        )
    },
    Pair {
        described: &[
            ("group", OTHER),
            ("order code", OTHER),
            ("DC mode 0", OTHER),
        ],
        ..pair(
            "soes/xmc4300_esi.xml",
            "soes/xmc4300_sii_eeprom.bin",
            &[
                ("general flags", NO_FLAG),
                (
                    "DC mode 1",
                    "the image's clock category has room for a second mode, without a name",
                ),
            ],
        )
    },
    Pair {
        described: &[
            ("group", OTHER),
            ("order code", OTHER),
            ("DC mode", OTHER),
            ("RxPdo 0x1600 / entry", BOOL),
            ("TxPdo 0x1a00 / entry", BOOL),
        ],
        ..pair(
            "synapticon/SOMANET_CiA_402_2015.xml",
            "synapticon/somanet_cia402_veysiadn.sii",
            &[
                ("general flags", NO_FLAG),
                ("SyncManager 3", OTHER),
                ("RxPdo 0x1600 / flags", OTHER),
                ("TxPdo 0x1a00 / flags", OTHER),
                ("DC mode", OTHER),
            ],
        )
    },
];

/// Checks that each difference has a reason, and each reason a difference.
fn explained(image: &str, differences: &[&Difference], reasons: &[(&str, &str)]) {
    let mut counts = vec![0; reasons.len()];
    for d in differences {
        let reason = reasons
            .iter()
            .position(|(field, _)| d.field.starts_with(field));
        match reason {
            Some(reason) => counts[reason] += 1,
            None => panic!("{image}: {d:?} is not explained"),
        }
    }
    for ((field, why), count) in reasons.iter().zip(counts) {
        assert!(count > 0, "{image}: {field} agrees now, no longer: {why}");
        println!("{image}: {field}: {why} ({count})");
    }
}

#[test]
fn every_image_has_an_esi_or_is_listed_without_one() {
    let Some(root) = common::fixtures() else {
        return;
    };
    let root = root.join("sii");
    for path in common::files("sii", &["bin", "hex", "sii"]) {
        let image = path.strip_prefix(&root).unwrap().to_str().unwrap();
        let paired = PAIRS.iter().any(|pair| pair.image == image);
        assert!(paired != ALONE.contains(&image), "{image}");
    }
}

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
        let (description, behaviour): (Vec<_>, Vec<_>) = differences
            .iter()
            .filter(|d| d.aspect != DifferenceKind::Instance)
            .partition(|d| d.aspect == DifferenceKind::Description);
        explained(pair.image, &behaviour, pair.differs);
        explained(pair.image, &description, pair.described);
    }
}
