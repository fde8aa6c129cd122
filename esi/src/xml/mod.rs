//! The ESI file as a stream of XML tags, one file per ETG.2000 element family.
//!
//! `decode` turns bytes into text, `scan` finds tags in it, `lines` their line and column, `cursor`
//! walks elements with position and path, `number` reads literals.
//! `info` is the root; below it `device`, `device_info`, `sync` (Fmmu, Sm, Su), `pdo`, `mailbox`, `dc`, `slots`,
//! `module`, `eeprom` and `profile` with the dictionary: `datatype` and `object` read it as written, `resolve` joins
//! the two, and `mapping` takes PDOs from there where a file has no other.
//!
//! Rules here: unknown elements are skipped. A PDO, object, data type or OpMode with a value that cannot be read is left
//! out; any other element with such a value, or damaged text, costs its device or module; nothing in a file may make the reader panic, recurse without bound or
//! allocate more than a fixed multiple of what real files need.

mod cursor;
mod datatype;
mod dc;
mod decode;
mod device;
mod device_info;
mod eeprom;
mod info;
mod lines;
mod literal;
mod mailbox;
mod mapping;
mod module;
mod number;
mod object;
mod pdo;
mod profile;
mod resolve;
mod scan;
#[cfg(test)]
mod scan_tests;
mod slots;
mod sync;
mod text;

use crate::error::EsiError;
use crate::model::{EsiFile, Warning};

/// Reads an ESI file (`EtherCATInfo`), a file of modules alone (`EtherCATModule`), or what `ethercat xml` prints
/// (`EtherCATInfoList`).
pub fn parse(bytes: &[u8]) -> Result<EsiFile, EsiError> {
    let decoded = decode::decode(bytes);
    let mut cursor = cursor::Cursor::new(&decoded.text);
    let mut file = EsiFile::default();
    info::read(&mut cursor, &mut file)?;
    if let Some(error) = cursor.first_left_out.take()
        && file.devices.is_empty()
        && file.modules.is_empty()
    {
        return Err(error);
    }
    if let Some((at, message)) = decoded.remark {
        let position = cursor.at(at);
        file.warnings.push(Warning {
            file: None,
            position,
            path: "EtherCATInfo".to_owned(),
            left_out: false,
            message,
        });
    }
    file.warnings.append(&mut cursor.warnings);
    Ok(file)
}
