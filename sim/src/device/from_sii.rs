//! Builds devices from an EEPROM image alone, like a MainDevice without the ESI sees them.
//!
//! The image is converted to the ESI model, so both sources share one way to build a device.
//! Missing in an image: start-up commands, modules, and objects except identification and PDOs.

use ecaxis_esi::model::{
    Access, Coe, DcMode, Device, Dictionary, Direction, Eeprom, Entry, Mailbox, Object, ObjectItem,
    Pdo, SmUse, SyncManager, SyncTime, Text,
};
use ecaxis_esi::sii::{self, General, MailboxAreas, Protocols, Sii, SiiDc, SiiPdo, SiiSyncManager};

use super::{DeviceOptions, SimDevice, SimError};

impl SimDevice {
    /// Creates the device that the EEPROM image describes, powered on and in Init. Serial number
    /// and alias come from the image. The chip is `options.esc`, or the smallest chip that fits the
    /// device.
    ///
    /// A device with a CoE mailbox has the objects 0x1000, 0x1008, 0x1018, 0x1C00, PDO assignment
    /// and mapping. Other mailboxes report an unknown protocol. A device without a mailbox is a
    /// plain I/O terminal.
    ///
    /// # Errors
    ///
    /// Fails if a category or a PDO is longer than its image or category, or a SyncManager lies
    /// outside the address space.
    pub fn from_sii(image: &[u8], options: DeviceOptions) -> Result<Self, SimError> {
        let sii = sii::parse(image)?;
        if let Some(damage) = sii.damage.first() {
            return Err(SimError::DamagedImage(damage.clone()));
        }
        let options = DeviceOptions {
            serial: sii.serial,
            alias: sii.alias,
            sii: Some(image.to_vec()),
            ..options
        };
        Self::from_esi(&device(&sii), &[], options)
    }
}

fn device(sii: &Sii) -> Device {
    let general = sii.general.clone().unwrap_or_default();
    let pdos = |pdos: &[SiiPdo], direction| pdos.iter().map(|from| pdo(from, direction)).collect();
    let sync_managers = sync_managers(sii);
    Device {
        identity: sii.identity,
        type_name: type_name(sii, &general),
        name: general.name.clone(),
        physics: physics(general.ports),
        fmmus: sii.fmmus.iter().map(|usage| (*usage).into()).collect(),
        rx_pdos: pdos(&sii.rx_pdos, Direction::Rx),
        tx_pdos: pdos(&sii.tx_pdos, Direction::Tx),
        mailbox: mailbox(sii, &general),
        dc_modes: sii.dc.iter().map(dc_mode).collect(),
        dictionary: dictionary(sii, &general),
        use_lrd_lwr: general.flags & General::NO_LRW != 0,
        sync_managers,
        eeprom: Eeprom {
            byte_size: sii.byte_size,
            config_data: sii.config.to_vec(),
            bootstrap: bootstrap(sii.bootstrap),
            ..Eeprom::default()
        },
        ..Device::default()
    }
}

fn type_name(sii: &Sii, general: &General) -> String {
    if general.order.is_empty() {
        sii.identity.to_string()
    } else {
        general.order.clone()
    }
}

/// Converts four bits per port to the letters of the ESI. Empty if the image describes no port.
fn physics(ports: u16) -> String {
    let letters = (0..4).map(|n| match ports >> (4 * n) & 0x0f {
        1 => 'Y',
        3 => 'K',
        4 => 'H',
        _ => ' ',
    });
    letters.collect::<String>().trim_end().to_owned()
}

fn has_mailbox(sii: &Sii) -> bool {
    sii.protocols != Protocols::default() && sii.mailbox.receive_size > 0
}

/// Returns the SyncManagers of the category, or the standard mailboxes of the header without a
/// category.
fn sync_managers(sii: &Sii) -> Vec<SyncManager> {
    if !sii.sync_managers.is_empty() {
        return sii.sync_managers.iter().map(sync_manager).collect();
    }
    let areas = sii.mailbox;
    let standard = |usage, start_address, len, control| SiiSyncManager {
        start_address,
        len,
        control,
        enable: 1,
        usage,
    };
    let (out, back) = (areas.receive_offset, areas.send_offset);
    let pair = [
        standard(SmUse::MBoxOut, out, areas.receive_size, 0x26),
        standard(SmUse::MBoxIn, back, areas.send_size, 0x22),
    ];
    let pair = pair.iter().filter(|_| has_mailbox(sii));
    pair.map(sync_manager).collect()
}

fn sync_manager(sm: &SiiSyncManager) -> SyncManager {
    SyncManager {
        position: Default::default(),
        usage: usage(sm),
        start_address: sm.start_address,
        default_size: sm.len,
        min_size: None,
        max_size: None,
        control_byte: sm.control,
        enable: sm.enable & 1 != 0,
        virtual_: sm.enable & 4 != 0,
        op_only: sm.enable & 8 != 0,
        watchdog: None,
    }
}

/// Returns the usage. Older images leave it open; it then follows from mode and direction.
fn usage(sm: &SiiSyncManager) -> SmUse {
    if sm.usage != SmUse::Other || sm.enable & 1 == 0 {
        return sm.usage;
    }
    match sm.control & 0x0f {
        0x00 => SmUse::Inputs,
        0x04 => SmUse::Outputs,
        0x02 => SmUse::MBoxIn,
        0x06 => SmUse::MBoxOut,
        _ => SmUse::Other,
    }
}

fn pdo(pdo: &SiiPdo, direction: Direction) -> Pdo {
    Pdo {
        position: Default::default(),
        direction,
        index: pdo.index,
        name: pdo.name.clone(),
        sm: pdo.sm,
        su: None,
        excluded_sm: Vec::new(),
        fixed: pdo.flags & 0x10 != 0,
        mandatory: pdo.flags & 0x01 != 0,
        virtual_: pdo.flags & 0x20 != 0,
        overwritten_by_module: false,
        depends_on: Default::default(),
        oversampling: None,
        exclude: Vec::new(),
        entries: pdo
            .entries
            .iter()
            .map(|entry| Entry {
                position: Default::default(),
                index: entry.index,
                sub: entry.sub,
                bit_len: u16::from(entry.bit_len),
                name: entry.name.as_str().into(),
                data_type: Text::default(),
                depends_on: Default::default(),
            })
            .collect(),
    }
}

fn mailbox(sii: &Sii, general: &General) -> Option<Mailbox> {
    let protocols = sii.protocols;
    let details = |bit: u8| general.coe_details >> bit & 1 != 0;
    has_mailbox(sii).then(|| Mailbox {
        data_link_layer: general.flags & 0x04 != 0,
        coe: protocols.has(Protocols::COE).then(|| Coe {
            sdo_info: details(1),
            pdo_assign: details(2),
            pdo_config: details(3),
            pdo_upload: details(4),
            complete_access: details(5),
            segmented_sdo: true,
            ..Coe::default()
        }),
        foe: protocols.has(Protocols::FOE),
        eoe: protocols.has(Protocols::EOE),
        soe: protocols.has(Protocols::SOE),
        aoe: protocols.has(Protocols::AOE),
        voe: protocols.has(Protocols::VOE),
    })
}

fn dc_mode(dc: &SiiDc) -> DcMode {
    let time = |cycle_ns, factor: i16, shift_ns: i32| SyncTime {
        cycle_ns,
        factor: i32::from(factor),
        shift_ns: i64::from(shift_ns),
        ..SyncTime::default()
    };
    DcMode {
        name: dc.name.clone(),
        description: dc.description.clone(),
        assign_activate: dc.assign_activate,
        sync0: time(i64::from(dc.cycle0_ns), dc.sync0_factor, dc.shift0_ns),
        sync1: time(0, dc.sync1_factor, dc.shift1_ns),
        ..DcMode::default()
    }
}

fn bootstrap(areas: MailboxAreas) -> Vec<u8> {
    let words = [
        areas.receive_offset,
        areas.receive_size,
        areas.send_offset,
        areas.send_size,
    ];
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

/// Returns the dictionary with the device name. Identity, SyncManagers and PDOs are added for every
/// device.
fn dictionary(sii: &Sii, general: &General) -> Dictionary {
    if !has_mailbox(sii) || !sii.protocols.has(Protocols::COE) {
        return Dictionary::default();
    }
    let name = type_name(sii, general).into_bytes();
    let text = format!("STRING({})", name.len());
    Dictionary {
        objects: vec![Object {
            index: 0x1008,
            name: "Device name".into(),
            items: vec![item(0, &text, 0, name)],
            ..Object::default()
        }],
    }
}

fn item(sub: u8, type_name: &str, bit_offset: u32, default: Vec<u8>) -> ObjectItem {
    ObjectItem {
        sub,
        name: format!("SubIndex {sub:03}").into(),
        type_name: type_name.into(),
        bit_len: u32::try_from(default.len() * 8).unwrap_or(0),
        bit_offset,
        default: default.into(),
        has_default: true,
        access: Access::default(),
        ..ObjectItem::default()
    }
}

#[cfg(test)]
#[path = "from_sii_tests.rs"]
mod tests;
