//! `Eeprom`.

use super::cursor::{Cursor, Element};
use crate::error::{EsiError, EsiProblem};
use crate::model::{Eeprom, EepromCategory};

/// The maximum image size. Word 0x3E contains the size in units of 128 bytes, minus one.
const MAX_BYTES: u32 = 0x1_0000 * 128;

pub(super) fn read<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Eeprom, EsiError> {
    let mut eeprom = Eeprom {
        assign_to_pdi: c.attribute_flag(element, "AssignToPdi")?,
        ..Eeprom::default()
    };
    c.children(element, |c, el| {
        match el.name {
            "ByteSize" => {
                eeprom.byte_size = c.number(el, "ByteSize")?;
                if eeprom.byte_size > MAX_BYTES {
                    let limit = usize::try_from(MAX_BYTES).unwrap_or(usize::MAX);
                    let what = "the bytes of an EEPROM (ByteSize)";
                    return Err(c.error_at(el, EsiProblem::TooLarge { what, limit }));
                }
            }
            "ConfigData" => eeprom.config_data = c.hex_bytes(el, "ConfigData")?,
            "BootStrap" => eeprom.bootstrap = c.hex_bytes(el, "BootStrap")?,
            "Data" => eeprom.image = c.hex_bytes(el, "Data")?,
            "Category" => eeprom.categories.push(category(c, el)?),
            _ => {}
        }
        Ok(())
    })?;
    Ok(eeprom)
}

fn category<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<EepromCategory, EsiError> {
    let mut category = EepromCategory {
        preserve: c.attribute_flag(element, "PreserveOnlineData")?,
        ..EepromCategory::default()
    };
    c.children(element, |c, el| {
        match el.name {
            "CatNo" => category.number = c.number(el, "CatNo")?,
            "Data" => category.data = c.hex_bytes(el, "Data")?,
            "DataString" => category.data = c.text(el)?.into_bytes(),
            "DataUINT" => {
                let value: u16 = c.number(el, "DataUINT")?;
                category.data = value.to_le_bytes().to_vec();
            }
            "DataUDINT" => {
                let value: u32 = c.number(el, "DataUDINT")?;
                category.data = value.to_le_bytes().to_vec();
            }
            _ => {}
        }
        Ok(())
    })?;
    Ok(category)
}
