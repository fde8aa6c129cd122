//! `Device`: identity and child elements.

use super::cursor::{Cursor, Element};
use super::text::Names;
use super::{dc, device_info, eeprom, mailbox, mapping, pdo, profile, slots, sync};
use crate::error::{EsiError, EsiProblem};
use crate::model::{Device, DeviceHeader, Direction, HiddenType, InitialRegisters, RevisionCheck};

pub(super) fn read<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Device, EsiError> {
    let mut device = Device {
        position: c.position(element),
        path: c.path_of(element),
        number: c.devices,
        physics: c.attribute(element, "Physics")?.unwrap_or_default(),
        invisible: c.attribute_flag(element, "Invisible")?,
        ..Device::default()
    };
    let mut names = Names::default();
    let mut has_type = false;
    c.children(element, |c, el| {
        match el.name {
            "Type" => {
                type_element(c, el, &mut device)?;
                has_type = true;
            }
            "HideType" => device.hides.push(hidden_type(c, el)?),
            "Name" => names.add(c, el)?,
            "Info" => device.info = device_info::read(c, el, &mut device.sm_mappings)?,
            "GroupType" => device.group = c.text(el)?,
            "Profile" => {
                let profile = profile::read(c, el)?;
                device.profile = device.profile.or(profile.number);
                device.dictionary.objects.extend(profile.objects);
                device.diag_messages.extend(profile.diag_messages);
            }
            "Fmmu" => device.fmmus.push(sync::fmmu(c, el)?),
            "Sm" => device.sync_managers.push(sync::sync_manager(c, el)?),
            "Su" => device.sync_units.push(sync::sync_unit(c, el)?),
            "RxPdo" => pdo::append(c, el, Direction::Rx, &mut device.rx_pdos)?,
            "TxPdo" => pdo::append(c, el, Direction::Tx, &mut device.tx_pdos)?,
            "Pdo" => pdo::append_reference(c, el, &mut device.rx_pdos, &mut device.tx_pdos)?,
            "Mailbox" => device.mailbox = Some(mailbox::read(c, el)?),
            "Dc" => device.dc_modes = dc::read(c, el)?,
            "Slots" => device.slots = Some(slots::read(c, el)?),
            "Eeprom" => device.eeprom = eeprom::read(c, el)?,
            "ESC" => device.registers = registers(c, el)?,
            "AlternativeSmMapping" => {
                device_info::append_sm_mapping(c, el, &mut device.sm_mappings)?;
            }
            "VendorSpecific" => device_info::vendor_specific(c, el, &mut device.sm_mappings)?,
            _ => {}
        }
        Ok(())
    })?;
    if !has_type {
        return Err(no_type(c, element));
    }
    (device.name, device.names) = names.take_all();
    for (number, text) in device.resolve_sync_managers() {
        if let Some(sm) = device.sync_managers.get(usize::from(number)) {
            let message = format!(
                "Sm {number} is called {text:?}; its PDOs are {:?}, which counts",
                sm.usage
            );
            c.warn_at(sm.position, element, message);
        }
    }
    mapping::complete(&mut device);
    device.number_drives();
    if device.name.is_empty() {
        device.name = device.type_name.clone();
    }
    Ok(device)
}

/// Reads the identity and the names, and skips the rest.
pub(super) fn header<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
) -> Result<DeviceHeader, EsiError> {
    let (mut typed, mut names) = (None, Names::default());
    c.children(element, |c, el| {
        match el.name {
            "Type" => {
                let mut device = Device::default();
                type_element(c, el, &mut device)?;
                typed = Some((device.identity, device.type_name));
            }
            "Name" => names.add(c, el)?,
            _ => {}
        }
        Ok(())
    })?;
    let (identity, type_name) = typed.ok_or_else(|| no_type(c, element))?;
    let name = names.take().into_owned();
    Ok(DeviceHeader {
        number: c.devices,
        identity,
        name: match name.is_empty() {
            true => type_name.clone(),
            false => name,
        },
        type_name,
    })
}

fn no_type(c: &Cursor<'_>, element: &Element<'_>) -> EsiError {
    let what = "Device/Type";
    c.error_at(element, EsiProblem::Missing { what })
}

/// Reads `Type`: the identity and its attributes.
fn type_element<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    device: &mut Device,
) -> Result<(), EsiError> {
    let Some(product) = c.attribute_number(element, "ProductCode")? else {
        return Err(c.error_at(
            element,
            EsiProblem::Missing {
                what: "ProductCode",
            },
        ));
    };
    device.identity.product = product;
    device.identity.revision = c
        .attribute_number(element, "RevisionNo")?
        .unwrap_or_default();
    device.use_lrd_lwr = c.attribute_flag(element, "UseLrdLwr")?;
    device.revision_check = match c.attribute(element, "CheckRevisionNo")?.as_deref() {
        None => RevisionCheck::Unstated,
        Some("NONE") => RevisionCheck::None,
        Some("EQ") => RevisionCheck::Equal,
        Some("EQ_OR_G") => RevisionCheck::EqualOrGreater,
        Some("LW_EQ") => RevisionCheck::LowEqual,
        Some("LW_EQ_HW_EQ_OR_G") => RevisionCheck::LowEqualHighEqualOrGreater,
        Some("HW_EQ") => RevisionCheck::HighEqual,
        Some("HW_EQ_LW_EQ_OR_G") => RevisionCheck::HighEqualLowEqualOrGreater,
        Some(_) => {
            c.warn(element, "CheckRevisionNo has an undefined value".to_owned());
            RevisionCheck::Unstated
        }
    };
    device.type_name = c.text(element)?;
    Ok(())
}

fn hidden_type<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<HiddenType, EsiError> {
    Ok(HiddenType {
        product: c.attribute_number(element, "ProductCode")?,
        revision: c
            .attribute_number(element, "RevisionNo")?
            .unwrap_or_default(),
    })
}

fn registers<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<InitialRegisters, EsiError> {
    let mut registers = InitialRegisters::default();
    c.children(element, |c, el| {
        let register = match el.name {
            "Reg0108" => &mut registers.reg0108,
            "Reg0400" => &mut registers.reg0400,
            "Reg0410" => &mut registers.reg0410,
            "Reg0420" => &mut registers.reg0420,
            _ => return Ok(()),
        };
        *register = c.optional_number(el, "register value")?;
        Ok(())
    })?;
    Ok(registers)
}
