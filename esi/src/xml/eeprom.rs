//! `Eeprom`.

use super::cursor::{Cursor, Element};
use crate::error::EsiError;
use crate::model::Eeprom;

pub(super) fn read<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Eeprom, EsiError> {
    let mut eeprom = Eeprom::default();
    c.children(element, |c, el| {
        match el.name {
            "ByteSize" => eeprom.byte_size = c.number(el, "ByteSize")?,
            "ConfigData" => eeprom.config_data = c.hex_bytes(el, "ConfigData")?,
            "BootStrap" => eeprom.bootstrap = c.hex_bytes(el, "BootStrap")?,
            _ => {}
        }
        Ok(())
    })?;
    Ok(eeprom)
}
