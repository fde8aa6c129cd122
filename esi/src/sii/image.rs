//! ESI device → EEPROM image contents.

use ecaxis_ecat::data_type;

use super::{
    General, MailboxAreas, Protocols, Sii, SiiDc, SiiEntry, SiiFmmuDetail, SiiPdo, SiiSyncManager,
    category,
};
use crate::model::{
    Device, Direction, Identification, Mailbox, Module, Pdo, SmUse, SyncTime, SyncUnit,
};
use crate::select::default_pdos;

/// Values that are individual to each unit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SiiOptions {
    /// The station alias, word 4.
    pub alias: u16,
    /// The serial number, words 14 and 15.
    pub serial: u32,
}

impl Sii {
    /// Returns the contents of the image for a device, with the default modules.
    #[must_use]
    pub fn from_device(device: &Device, modules: &[Module], options: &SiiOptions) -> Self {
        let mut config = [0u8; 14];
        for (to, from) in config.iter_mut().zip(&device.eeprom.config_data) {
            *to = *from;
        }
        if let Some(field) = config.get_mut(8..10) {
            field.copy_from_slice(&options.alias.to_le_bytes());
        }
        let rx = pdos(device, modules, Direction::Rx);
        let tx = pdos(device, modules, Direction::Tx);
        Self {
            config,
            alias: options.alias,
            checksum_ok: true,
            identity: device.identity,
            serial: options.serial,
            bootstrap: bootstrap(&device.eeprom.bootstrap),
            mailbox: mailbox_areas(device),
            protocols: device.mailbox.as_ref().map(protocols).unwrap_or_default(),
            byte_size: device.eeprom.byte_size,
            general: Some(general(device)),
            fmmus: device.fmmus.iter().map(|fmmu| fmmu.usage).collect(),
            sync_managers: sync_managers(device, &rx, &tx),
            tx_pdos: tx.iter().filter(is_listed).map(pdo).collect(),
            rx_pdos: rx.iter().filter(is_listed).map(pdo).collect(),
            dc: device
                .dc_modes
                .iter()
                .map(|mode| SiiDc {
                    name: mode.name.clone(),
                    description: mode.description.clone(),
                    assign_activate: mode.assign_activate,
                    cycle0_ns: u32::try_from(mode.sync0.cycle_ns).unwrap_or(0),
                    shift0_ns: i32::try_from(mode.sync0.shift_ns).unwrap_or(0),
                    shift1_ns: i32::try_from(mode.sync1.shift_ns).unwrap_or(0),
                    sync0_factor: match mode.sync0 {
                        // A signal without cycle and factor follows the bus cycle. Vendors write
                        // this as factor 1.
                        SyncTime {
                            cycle_ns: 0,
                            factor: 0,
                            ..
                        } => 1,
                        SyncTime { factor, .. } => i16::try_from(factor).unwrap_or(0),
                    },
                    sync1_factor: i16::try_from(mode.sync1.factor).unwrap_or(0),
                })
                .collect(),
            fmmu_details: fmmu_details(device),
            sync_units: device.sync_units.iter().map(sync_unit).collect(),
            others: device
                .eeprom
                .categories
                .iter()
                .filter(|category| !GENERATED.contains(&category.number))
                .map(|category| (category.number, even(&category.data)))
                .collect(),
            ended: true,
            damage: Vec::new(),
        }
    }
}

/// Returns the selectable PDOs and, at their places, the PDOs that represent registers. Images list
/// both.
fn pdos(device: &Device, modules: &[Module], direction: Direction) -> Vec<Pdo> {
    let own = match direction {
        Direction::Rx => &device.rx_pdos,
        Direction::Tx => &device.tx_pdos,
    };
    let mut all = default_pdos(device, modules, direction);
    for pdo in own.iter().filter(|pdo| pdo.virtual_) {
        let mut pdo = pdo.clone();
        let names = |a: &Pdo, b: &Pdo| a.exclude.iter().any(|excluded| excluded.index == b.index);
        let shuts_out = |other: &&Pdo| names(other, &pdo) || names(&pdo, other);
        if all
            .iter()
            .filter(|other| other.sm.is_some())
            .any(|other| shuts_out(&other))
        {
            pdo.sm = None;
        }
        all.push(pdo);
    }
    let place = |pdo: &Pdo| own.iter().position(|other| other.index == pdo.index);
    // PDOs of modules come last.
    all.sort_by_key(|pdo| place(pdo).unwrap_or(usize::MAX));
    all
}

/// Categories that are generated from the rest of the ESI. Copies of them in the file are ignored.
const GENERATED: [u16; 9] = [
    category::STRINGS,
    category::GENERAL,
    category::FMMU,
    category::SYNC_MANAGER,
    category::FMMU_DETAILS,
    category::SYNC_UNIT,
    category::TX_PDO,
    category::RX_PDO,
    category::DC,
];

/// Pads to whole words, because categories consist of words.
fn even(data: &[u8]) -> Vec<u8> {
    let mut data = data.to_vec();
    data.resize(data.len().next_multiple_of(2), 0);
    data
}

/// Returns FMMU details only if the file contains more than the order of the FMMUs.
fn fmmu_details(device: &Device) -> Vec<SiiFmmuDetail> {
    let details = device.fmmus.iter().map(|fmmu| SiiFmmuDetail {
        op_only: fmmu.op_only,
        sm: fmmu.sm,
        su: fmmu.su,
    });
    let reported = |detail: &SiiFmmuDetail| *detail != SiiFmmuDetail::default();
    let details: Vec<_> = details.collect();
    if details.iter().any(reported) {
        details
    } else {
        Vec::new()
    }
}

fn sync_unit(unit: &SyncUnit) -> u8 {
    let flags = [
        (unit.separate, 1),
        (unit.separate_frame, 2),
        (unit.depends_on_input_state, 4),
        (unit.frame_repeat, 8),
    ];
    flags
        .into_iter()
        .filter(|(on, _)| *on)
        .map(|(_, bit)| bit)
        .sum()
}

/// Returns `false` for an empty mapping object that only the dictionary describes.
fn is_listed(pdo: &&Pdo) -> bool {
    !pdo.entries.is_empty() || pdo.sm.is_some() || pdo.fixed
}

fn bootstrap(bytes: &[u8]) -> MailboxAreas {
    let word = |number: usize| {
        let pair = bytes
            .get(number * 2..number * 2 + 2)
            .and_then(|pair| pair.try_into().ok());
        pair.map_or(0, u16::from_le_bytes)
    };
    MailboxAreas {
        receive_offset: word(0),
        receive_size: word(1),
        send_offset: word(2),
        send_size: word(3),
    }
}

pub(super) fn mailbox_areas(device: &Device) -> MailboxAreas {
    let area = |usage| {
        let sm = device.sync_managers.iter().find(|sm| sm.usage == usage);
        sm.map_or((0, 0), |sm| (sm.start_address, sm.default_size))
    };
    let (receive_offset, receive_size) = area(SmUse::MBoxOut);
    let (send_offset, send_size) = area(SmUse::MBoxIn);
    MailboxAreas {
        receive_offset,
        receive_size,
        send_offset,
        send_size,
    }
}

fn protocols(mailbox: &Mailbox) -> Protocols {
    let bits = [
        (mailbox.aoe, Protocols::AOE),
        (mailbox.eoe.is_some(), Protocols::EOE),
        (mailbox.coe.is_some(), Protocols::COE),
        (mailbox.foe, Protocols::FOE),
        (mailbox.soe.is_some(), Protocols::SOE),
        (mailbox.voe, Protocols::VOE),
    ];
    Protocols(
        bits.into_iter()
            .filter(|(on, _)| *on)
            .fold(0, |word, (_, bit)| word | bit),
    )
}

fn general(device: &Device) -> General {
    let mailbox = device.mailbox.as_ref();
    let coe = mailbox.and_then(|mailbox| mailbox.coe.as_ref());
    let coe_details = coe.map_or(0, |coe| {
        let bits = [
            true,
            coe.sdo_info,
            coe.pdo_assign,
            coe.pdo_config,
            coe.pdo_upload,
            coe.complete_access,
        ];
        bits.into_iter()
            .rev()
            .fold(0, |byte, bit| byte << 1 | u8::from(bit))
    });
    let flags = [
        (device.use_lrd_lwr, General::NO_LRW),
        (
            mailbox.is_some_and(|mailbox| mailbox.data_link_layer),
            General::DATA_LINK_LAYER,
        ),
        (
            device.info.identification == Identification::Reg134,
            General::IDENTIFICATION_AL_STATUS,
        ),
        (
            matches!(device.info.identification, Identification::Ado(_)),
            General::IDENTIFICATION_ADDRESS,
        ),
    ];
    General {
        group: match device.group.as_str() {
            "" => device.type_name.clone(),
            group => group.to_owned(),
        },
        image: String::new(),
        order: device.type_name.clone(),
        name: device.name.clone(),
        coe_details,
        foe: mailbox.is_some_and(|mailbox| mailbox.foe),
        eoe: mailbox.is_some_and(|mailbox| mailbox.eoe.is_some()),
        flags: flags
            .into_iter()
            .filter(|(on, _)| *on)
            .map(|(_, bit)| bit)
            .sum(),
        ebus_ma: device
            .info
            .ebus_current_ma
            .and_then(|current| i16::try_from(current).ok())
            .unwrap_or(0),
        ports: ports(&device.physics),
        identification_address: match device.info.identification {
            Identification::Ado(address) => address,
            _ => 0,
        },
    }
}

/// Encodes `Physics`; first letter = port 0.
fn ports(physics: &str) -> u16 {
    physics
        .chars()
        .take(4)
        .enumerate()
        .fold(0, |word, (port, letter)| {
            let code: u16 = match letter.to_ascii_uppercase() {
                'Y' => 1,
                'K' => 3,
                'H' => 4,
                _ => 0,
            };
            word | code << (4 * port)
        })
}

/// Returns the SyncManagers. A size that is missing in the ESI comes from the default PDOs;
/// registers have size 0.
fn sync_managers(device: &Device, rx: &[Pdo], tx: &[Pdo]) -> Vec<SiiSyncManager> {
    (0..=u8::MAX)
        .zip(&device.sync_managers)
        .map(|(number, sm)| {
            let bits: u32 = rx
                .iter()
                .chain(tx)
                .filter(|pdo| pdo.sm == Some(number))
                .map(Pdo::bit_len)
                .fold(0, u32::saturating_add);
            let len = match sm.default_size {
                0 if sm.virtual_ => 0,
                0 => u16::try_from(bits.div_ceil(8)).unwrap_or(u16::MAX),
                size => size,
            };
            SiiSyncManager {
                start_address: sm.start_address,
                len,
                control: sm.control_byte,
                enable: u8::from(sm.enable)
                    | u8::from(sm.virtual_) << 2
                    | u8::from(sm.op_only) << 3,
                usage: sm.usage,
            }
        })
        .collect()
}

fn pdo(pdo: &Pdo) -> SiiPdo {
    let flags = [
        (pdo.mandatory, 0x01),
        (pdo.fixed, 0x10),
        (pdo.virtual_, 0x20),
    ];
    SiiPdo {
        index: pdo.index,
        name: pdo.name.clone(),
        sm: pdo.sm,
        synchronization: 0,
        flags: flags
            .into_iter()
            .filter(|(on, _)| *on)
            .fold(0, |word, (_, bit)| word | bit),
        entries: pdo
            .entries
            .iter()
            .map(|entry| SiiEntry {
                index: entry.index,
                sub: entry.sub,
                name: entry.name.to_string(),
                data_type: u8::try_from(data_type::code(&entry.data_type)).unwrap_or(0),
                bit_len: u8::try_from(entry.bit_len).unwrap_or(u8::MAX),
                flags: 0,
            })
            .collect(),
    }
}
