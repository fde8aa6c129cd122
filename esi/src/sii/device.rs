//! EEPROM image contents → ESI device, for a device without an ESI file.

use std::fmt;

use ecaxis_ecat::data_type::DataType;

use super::image::mailbox_areas;
use super::{
    General, MailboxAreas, Protocols, Sii, SiiDc, SiiEntry, SiiFmmuDetail, SiiPdo, SiiSyncManager,
};
use crate::model::{
    Coe, DcMode, Device, Direction, Eeprom, Entry, Eoe, EsiFile, Fmmu, Identification, Info,
    Mailbox, Pdo, SmUse, Soe, SyncManager, SyncTime, SyncUnit, Vendor,
};

impl Sii {
    /// Returns the device as the image describes it. Missing in an image: start-up commands,
    /// modules, time-outs and the dictionary.
    #[must_use]
    pub fn to_device(&self) -> Device {
        let general = self.general.clone().unwrap_or_default();
        let pdos = |pdos: &[SiiPdo], direction| {
            let all = pdos.iter().map(|from| pdo(from, direction));
            all.collect()
        };
        let type_name = type_name(self, &general);
        let mut device = Device {
            identity: self.identity,
            name: match general.name.as_str() {
                "" => type_name.clone(),
                name => name.to_owned(),
            },
            type_name,
            group: general.group.clone(),
            info: Info {
                identification: identification(&general),
                ebus_current_ma: (general.ebus_ma != 0).then(|| general.ebus_ma.into()),
                ..Info::default()
            },
            physics: physics(general.ports),
            fmmus: fmmus(self),
            sync_units: self
                .sync_units
                .iter()
                .map(|flags| sync_unit(*flags))
                .collect(),
            rx_pdos: pdos(&self.rx_pdos, Direction::Rx),
            tx_pdos: pdos(&self.tx_pdos, Direction::Tx),
            mailbox: mailbox(self, &general),
            dc_modes: self.dc.iter().map(dc_mode).collect(),
            use_lrd_lwr: general.flags & General::NO_LRW != 0,
            sync_managers: sync_managers(self),
            eeprom: Eeprom {
                byte_size: self.byte_size,
                config_data: self.config.to_vec(),
                bootstrap: bootstrap(self.bootstrap),
                ..Eeprom::default()
            },
            ..Device::default()
        };
        // Older images leave the types open.
        device.resolve_sync_managers();
        set_mailbox_sizes(&mut device.sync_managers, self.mailbox);
        device.number_drives();
        device
    }

    /// Returns an ESI file with this device only.
    #[must_use]
    pub fn to_esi_file(&self) -> EsiFile {
        EsiFile {
            vendors: vec![Vendor {
                id: self.identity.vendor,
                name: String::new(),
            }],
            devices: vec![self.to_device()],
            ..EsiFile::default()
        }
    }
}

/// The mailboxes of one device, as its ESI and its EEPROM have them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MailboxDifference {
    /// The SyncManagers of the ESI.
    pub esi: MailboxAreas,
    /// Words 0x18 to 0x1B of the EEPROM.
    pub eeprom: MailboxAreas,
}

impl fmt::Display for MailboxDifference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { esi, eeprom } = self;
        write!(
            f,
            "the mailboxes differ: {esi} in the ESI, {eeprom} in the EEPROM"
        )
    }
}

impl fmt::Display for MailboxAreas {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "out 0x{:04x} ({} bytes), in 0x{:04x} ({} bytes)",
            self.receive_offset, self.receive_size, self.send_offset, self.send_size
        )
    }
}

impl Sii {
    /// Compares the mailboxes with those of an ESI device that has some.
    #[must_use]
    pub fn mailbox_difference(&self, device: &Device) -> Option<MailboxDifference> {
        device.mailbox.as_ref()?;
        let difference = MailboxDifference {
            esi: mailbox_areas(device),
            eeprom: self.mailbox,
        };
        (difference.esi != difference.eeprom).then_some(difference)
    }
}

fn identification(general: &General) -> Identification {
    if general.flags & General::IDENTIFICATION_AL_STATUS != 0 {
        Identification::Reg134
    } else if general.flags & General::IDENTIFICATION_ADDRESS != 0 {
        Identification::Ado(general.identification_address)
    } else {
        Identification::No
    }
}

/// Returns the FMMUs with the details that the image has of them.
fn fmmus(sii: &Sii) -> Vec<Fmmu> {
    let details = sii.fmmu_details.iter().copied();
    let details = details.chain(std::iter::repeat(SiiFmmuDetail::default()));
    let all = sii.fmmus.iter().zip(details);
    all.map(|(&usage, detail)| Fmmu {
        usage,
        sm: detail.sm,
        su: detail.su,
        op_only: detail.op_only,
    })
    .collect()
}

fn sync_unit(flags: u8) -> SyncUnit {
    SyncUnit {
        name: String::new(),
        separate: flags & 1 != 0,
        separate_frame: flags & 2 != 0,
        depends_on_input_state: flags & 4 != 0,
        frame_repeat: flags & 8 != 0,
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
    let areas = sii.mailbox;
    if !sii.sync_managers.is_empty() {
        return sii.sync_managers.iter().map(sync_manager).collect();
    }
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

/// Takes the sizes of the mailboxes from the header, as other MainDevices do (SOEM, ethercrab).
fn set_mailbox_sizes(sync_managers: &mut [SyncManager], areas: MailboxAreas) {
    for sm in sync_managers {
        match sm.usage {
            SmUse::MBoxOut if areas.receive_size > 0 => sm.default_size = areas.receive_size,
            SmUse::MBoxIn if areas.send_size > 0 => sm.default_size = areas.send_size,
            _ => {}
        }
    }
}

fn sync_manager(sm: &SiiSyncManager) -> SyncManager {
    SyncManager {
        position: Default::default(),
        usage: sm.usage,
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
                data_type: data_type(entry).as_str().into(),
                depends_on: Default::default(),
            })
            .collect(),
    }
}

/// Returns the name of the type, or an unsigned type of the same length for an unknown code.
fn data_type(entry: &SiiEntry) -> String {
    if entry.index == 0 {
        return String::new();
    }
    DataType::coded(entry.data_type.into(), entry.bit_len.into()).to_string()
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
        eoe: protocols.has(Protocols::EOE).then(Eoe::default),
        soe: protocols.has(Protocols::SOE).then(Soe::default),
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mailbox_without_category_uses_the_header_addresses() {
        let sii = Sii {
            mailbox: MailboxAreas {
                receive_offset: 0x1000,
                receive_size: 64,
                send_offset: 0x1080,
                send_size: 64,
            },
            protocols: Protocols(Protocols::COE),
            ..Sii::default()
        };
        let sms = sync_managers(&sii);
        let seen: Vec<_> = sms
            .iter()
            .map(|sm| (sm.usage, sm.start_address, sm.default_size, sm.control_byte))
            .collect();
        let expected = [
            (SmUse::MBoxOut, 0x1000, 64, 0x26),
            (SmUse::MBoxIn, 0x1080, 64, 0x22),
        ];
        assert_eq!(seen, expected);
    }

    #[test]
    fn an_open_usage_follows_from_mode_and_direction() {
        let of = |control, enable| {
            let sii = Sii {
                sync_managers: vec![SiiSyncManager {
                    start_address: 0x1000,
                    len: 2,
                    control,
                    enable,
                    usage: SmUse::Other,
                }],
                ..Sii::default()
            };
            sii.to_device().sync_managers[0].usage
        };
        for (control, expected) in [
            (0x20, SmUse::Inputs),
            (0x64, SmUse::Outputs),
            (0x22, SmUse::MBoxIn),
            (0x26, SmUse::MBoxOut),
            (0x23, SmUse::Other),
        ] {
            assert_eq!(of(control, 1), expected);
            assert_eq!(of(control, 0), SmUse::Other);
        }
    }
}
