//! The captured buses: their devices, and the state in which each capture starts.

use ecaxis_sim::chip::{EscInfo, eeprom};

pub struct Device {
    pub name: &'static str,
    /// The station address in the capture.
    pub station: u16,
    /// An image of the same product and revision. `None`: the image is built from the capture.
    pub image: Option<&'static str>,
    /// Word 0 of an image built from the capture, from register 0x0140 or else from working
    /// counters. Device emulation (0x0100) where AL status copies the acknowledge bit; SYNC unit
    /// (0x0400) where 0x0910 answers.
    pub pdi_control: u16,
    pub esc: EscInfo,
    /// The firmware's time for a state change and for a mailbox answer. It lies between the last
    /// poll that found the firmware busy and the first that did not, and never exceeds any poll.
    pub firmware_ns: Firmware,
}

#[derive(Clone, Copy)]
pub struct Firmware {
    pub state_change: u64,
    pub mailbox: u64,
}

/// The chip alone follows AL control.
const NO_FIRMWARE: Firmware = Firmware {
    state_change: 0,
    mailbox: 0,
};

pub struct Bus {
    pub file: &'static str,
    pub devices: &'static [Device],
    /// Register contents from before the capture: (command, ADP, ADO, data).
    pub before: &'static [(u8, u16, u16, &'static [u8])],
}

const EK1100: Device = Device {
    name: "EK1100",
    station: 0x1000,
    image: Some("sii/ethercrab/ek1100.hex"),
    pdi_control: 0,
    esc: EscInfo::ET1100,
    firmware_ns: NO_FIRMWARE,
};

/// Port 3 of the chip exists but is not configured, which no image shows.
const ET1200: EscInfo = EscInfo {
    ports: Some(0x4a),
    ..EscInfo::ET1200
};

/// The next revision reports one more feature and one more EEPROM bit.
const ET1200_REVISION_1: EscInfo = EscInfo {
    revision: 1,
    features: 0x01fc,
    eeprom: eeprom::EIGHT_BYTES | 0x10,
    ..ET1200
};

const EL1004: Device = Device {
    name: "EL1004",
    station: 0x1002,
    image: None,
    pdi_control: 0x0104,
    esc: ET1200_REVISION_1,
    firmware_ns: NO_FIRMWARE,
};

const EL2004: Device = Device {
    name: "EL2004",
    image: Some("sii/ethercrab/el2004-eeprom-dump.bin"),
    esc: ET1200,
    ..EL1004
};

const EK1100_EL1004: &[Device] = &[
    Device {
        station: 0x1001,
        ..EK1100
    },
    EL1004,
];

const EK1100_EL2828_EL2889: &[Device] = &[
    EK1100,
    Device {
        name: "EL2828",
        station: 0x1001,
        image: None,
        pdi_control: 0x0104,
        esc: ET1200_REVISION_1,
        firmware_ns: NO_FIRMWARE,
    },
    Device {
        name: "EL2889",
        station: 0x1002,
        image: None,
        pdi_control: 0x0504,
        esc: ET1200,
        firmware_ns: NO_FIRMWARE,
    },
];

const EK1914_EL3004: &[Device] = &[
    Device {
        name: "EK1914",
        station: 0x1000,
        image: None,
        pdi_control: 0x0005,
        esc: EscInfo::ET1100,
        firmware_ns: Firmware {
            state_change: 1_470_000,
            mailbox: 700_000,
        },
    },
    Device {
        name: "EL3004",
        station: 0x1001,
        image: None,
        pdi_control: 0x0005,
        esc: ET1200_REVISION_1,
        firmware_ns: Firmware {
            state_change: 295_500,
            mailbox: 580_000,
        },
    },
];

pub const BUSES: &[Bus] = &[
    Bus {
        file: "ethercrab-dumps/rs-example-sii-el2004.ecat-only.pcapng",
        devices: &[
            EK1100,
            Device {
                station: 0x1001,
                ..EL2004
            },
            EL2004,
        ],
        before: &[],
    },
    Bus {
        file: "ethercrab-dumps/soem-sdinfo-ek1100-el1004.ecat-only.pcapng",
        devices: EK1100_EL1004,
        before: &[],
    },
    Bus {
        file: "ethercrab-dumps/soem-sdinfo-ek1100-only.ecat-only.pcapng",
        devices: &[Device {
            station: 0x1001,
            ..EK1100
        }],
        // DL status was read since it last changed.
        before: &[(7, 0, 0x110, &[0, 0])],
    },
    Bus {
        file: "ethercrab-dumps/soem-sdinfo-no-slaves.ecat-only.pcapng",
        devices: &[],
        before: &[],
    },
    Bus {
        file: "ethercrab-dumps/soem-single-lan9252.ecat-only.pcapng",
        devices: &[Device {
            name: "LAN9252-EVB-HBI",
            station: 0x1001,
            image: None,
            pdi_control: 0x0e89,
            esc: EscInfo {
                ports: Some(0x1f),
                ..EscInfo::LAN9252
            },
            firmware_ns: Firmware {
                state_change: 17_500_000,
                mailbox: 38_300_000,
            },
        }],
        // The mask of an earlier run is still set.
        before: &[(8, 0, 0x200, &[4, 0])],
    },
    Bus {
        file: "ethercrab-dumps/twincat-run-ek1100-el1004.ecat-only.pcapng",
        devices: EK1100_EL1004,
        // Recorded long after the bring-up: addressed, in PreOp.
        before: &[
            (2, 0, 0x10, &[0xe9, 0x03]),
            (2, 0xffff, 0x10, &[0xea, 0x03]),
            (8, 0, 0x120, &[2, 0]),
        ],
    },
    Bus {
        file: "ethercrab-replay/replay-dc.pcapng",
        devices: EK1100_EL2828_EL2889,
        before: &[],
    },
    Bus {
        file: "ethercrab-replay/replay-ek1100-el2828-el2889.pcapng",
        devices: EK1100_EL2828_EL2889,
        before: &[],
    },
    Bus {
        file: "ethercrab-replay/replay-ek1914-el3004-configure.pcapng",
        devices: EK1914_EL3004,
        before: &[],
    },
    Bus {
        file: "ethercrab-replay/replay-ek1914-el3004-mailbox.pcapng",
        devices: EK1914_EL3004,
        before: &[],
    },
    Bus {
        file: "ethercrab-replay/replay-ek1914-segmented-upload.pcapng",
        devices: EK1914_EL3004,
        before: &[],
    },
];
