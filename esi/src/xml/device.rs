//! `Device`: identity, and the families below it.

use super::cursor::{Cursor, Element};
use super::text::Names;
use super::{datatype, dc, eeprom, mailbox, object, pdo, resolve, slots, sync};
use crate::error::{EsiError, EsiProblem};
use crate::model::{Device, Dictionary, Direction};

pub(super) fn read<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Device, EsiError> {
    let mut device = Device {
        position: element.position,
        physics: c.attribute(element, "Physics")?.unwrap_or_default(),
        ..Device::default()
    };
    let mut names = Names::default();
    let mut has_type = false;
    c.children(element, |c, el| {
        match el.name {
            "Type" => {
                let product = c.attribute_number(el, "ProductCode")?;
                device.identity.product = match product {
                    Some(code) => code,
                    None => {
                        return Err(c.error_at(
                            el,
                            EsiProblem::Missing {
                                what: "ProductCode",
                            },
                        ));
                    }
                };
                device.identity.revision =
                    c.attribute_number(el, "RevisionNo")?.unwrap_or_default();
                device.type_name = c.text(el)?;
                has_type = true;
            }
            "Name" => names.add(c, el)?,
            "Profile" => {
                let (number, dictionary) = profile(c, el)?;
                device.profile = device.profile.or(number);
                device.dictionary.objects.extend(dictionary.objects);
            }
            "Fmmu" => device.fmmus.push(sync::fmmu(c, el)?),
            "Sm" => device.sync_managers.push(sync::sync_manager(c, el)?),
            "RxPdo" => device.rx_pdos.push(pdo::read(c, el, Direction::Rx)?),
            "TxPdo" => device.tx_pdos.push(pdo::read(c, el, Direction::Tx)?),
            "Mailbox" => device.mailbox = Some(mailbox::read(c, el)?),
            "Dc" => device.dc_modes = dc::read(c, el)?,
            "Slots" => device.slots = Some(slots::read(c, el)?),
            "Eeprom" => device.eeprom = eeprom::read(c, el)?,
            _ => {}
        }
        Ok(())
    })?;
    if !has_type {
        return Err(c.error_at(
            element,
            EsiProblem::Missing {
                what: "Device/Type",
            },
        ));
    }
    device.name = names.take();
    if device.name.is_empty() {
        device.name = device.type_name.clone();
    }
    Ok(device)
}

/// `Profile`, of a device or of a module: the profile number and the resolved dictionary. The number stands in
/// `Profile` itself or, newer, in one `ChannelInfo` per axis; then the first axis counts.
pub(super) fn profile<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
) -> Result<(Option<u32>, Dictionary), EsiError> {
    let (mut number, mut of_channel) = (None, None);
    let mut dictionary = Dictionary::default();
    c.children(element, |c, el| {
        match el.name {
            "ProfileNo" => number = number.or(Some(c.number(el, "ProfileNo")?)),
            "ChannelInfo" => c.children(el, |c, el| {
                if el.name == "ProfileNo" {
                    of_channel = of_channel.or(Some(c.number(el, "ProfileNo")?));
                }
                Ok(())
            })?,
            "Dictionary" => {
                let mut types = datatype::DataTypes::default();
                let mut objects = Vec::new();
                c.children(el, |c, el| match el.name {
                    "DataTypes" => datatype::read(c, el, &mut types),
                    "Objects" => object::read(c, el, &mut objects),
                    _ => Ok(()),
                })?;
                // Objects may stand before the types they use, so they are joined at the end.
                for raw in objects {
                    dictionary
                        .objects
                        .push(resolve::object(c, el, &types, raw)?);
                }
            }
            "DictionaryFile" => c.warn(
                el,
                "the dictionary is in another file, which is not read".to_owned(),
            ),
            _ => {}
        }
        Ok(())
    })?;
    Ok((number.or(of_channel), dictionary))
}
