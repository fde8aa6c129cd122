//! Reads the ESI file as a stream of XML tags; one source file per ETG.2000 element family.
//!
//! `decode` turns bytes into text, `scan` finds tags in the text, and `lines` computes line and
//! column. `cursor` walks elements with position and path, and `number` reads literals.
//!
//! `info` is the root. Below it are `device`, `device_info`, `sync` (Fmmu, Sm, Su), `pdo`,
//! `mailbox`, `dc`, `slots`, `module`, `eeprom` and `profile` with the dictionary. `datatype` and
//! `object` read the dictionary as written, and `resolve` joins both. `mapping` derives PDOs from
//! the dictionary if a file has no PDO elements.
//!
//! Rules: Unknown elements are skipped. A PDO, object, data type, OpMode or alternative assignment
//! with an unreadable value is skipped. Any other element with an unreadable value, or damaged text, removes its device or
//! module. No file may cause a panic, unbounded recursion, or allocation beyond a fixed multiple of
//! the need of real files.

mod cursor;
mod datatype;
mod dc;
mod decode;
mod device;
mod device_info;
mod eeprom;
mod info;
mod lines;
pub(crate) mod literal;
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

use std::borrow::Cow;

use crate::error::EsiError;
use crate::model::{DeviceHeader, EsiFile, Warning};
use pdo::PdoDefinitions;

/// Reads an ESI file (`EtherCATInfo`), a module file (`EtherCATModule`), or the output of `ethercat
/// xml` (`EtherCATInfoList`).
pub fn parse(bytes: &[u8]) -> Result<EsiFile, EsiError> {
    read(bytes, None)
}

/// Same as [`parse`], but builds only the devices that `filter` accepts. The others are in
/// [`EsiFile::skipped`], and their content is not checked. The vendor of the header is not set
/// when `filter` sees it.
///
/// ```
/// # let bytes = include_bytes!("../../../configs/esi/SV1.xml");
/// let file = ecaxis_esi::parse_where(bytes, &|device| device.type_name == "other")?;
/// assert!(file.devices.is_empty() && !file.skipped.is_empty());
/// # Ok::<(), ecaxis_esi::EsiError>(())
/// ```
pub fn parse_where(
    bytes: &[u8],
    filter: &dyn Fn(&DeviceHeader) -> bool,
) -> Result<EsiFile, EsiError> {
    read(bytes, Some(filter))
}

/// Decodes an XML file by its byte order mark and its declaration: UTF-8, UTF-16, ISO-8859-1 or
/// windows-1252.
///
/// ```
/// let text = ecaxis_esi::decode_text(b"<?xml version='1.0' encoding='ISO-8859-1'?><\xfc/>");
/// assert!(text.ends_with("<ü/>"));
/// ```
#[must_use]
pub fn decode_text(bytes: &[u8]) -> Cow<'_, str> {
    decode::decode(bytes).text
}

/// The longest chain of PDOs that refer to each other forwards.
const MAX_REFERENCE_DEPTH: usize = 4;

fn read(bytes: &[u8], filter: info::DeviceFilter<'_>) -> Result<EsiFile, EsiError> {
    let decoded = decode::decode(bytes);
    let mut definitions = PdoDefinitions::default();
    // A `Ref` may stand before the `RefName` that it names, which may refer to another.
    let has_references = memchr::memmem::find(decoded.text.as_bytes(), b"RefName").is_some();
    for _ in 0..if has_references {
        MAX_REFERENCE_DEPTH
    } else {
        0
    } {
        let known = definitions.len();
        let mut cursor = cursor::Cursor::new(&decoded.text);
        cursor.pdo_definitions = definitions;
        info::read(&mut cursor, &mut EsiFile::default(), None)?;
        definitions = cursor.pdo_definitions;
        if definitions.len() == known {
            break;
        }
    }
    let mut cursor = cursor::Cursor::new(&decoded.text);
    cursor.pdo_definitions = definitions;
    let mut file = EsiFile::default();
    info::read(&mut cursor, &mut file, filter)?;
    if let Some(error) = cursor.first_left_out.take()
        && file.devices.is_empty()
        && file.skipped.is_empty()
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
