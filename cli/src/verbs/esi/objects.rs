//! `ecaxis esi objects`: shows the object dictionary of a device.

use ecaxis_ecat::data_type::{DataType, Kind};
use ecaxis_esi::{
    Dictionary, Mode, ObjectItem, PdoMapping, SelectOptions, Writable, address, select,
};
use ecaxis_tools::cells;
use ecaxis_tools::document::Table;
use ecaxis_tools::document::format::hex_bytes;
use serde::Serialize;

use super::DeviceArgs;
use crate::hints::{self, Failure};
use crate::render::{print_json, print_table};

const EXAMPLES: &str = "\
Examples:
  ecaxis esi objects f.xml --device EPOS4
  ecaxis esi objects f.xml --mode csp       with the objects of a module
  ecaxis esi objects f.xml --json           for a script";

/// Show the object dictionary: types, access, defaults, ranges, PDO mapping
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    #[command(flatten)]
    which: DeviceArgs,
    /// Include the objects of this mode's module: pp, pv, hm, csp, csv, cst
    #[arg(long, value_parser = super::mode)]
    mode: Option<Mode>,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let file = args.which.load()?;
    let device = args.which.device(&file)?;
    let choice = SelectOptions {
        mode: args.mode,
        cycle_ns: 1_000_000,
        ..SelectOptions::default()
    };
    // If the default configuration is invalid, use the device's own objects.
    let dictionary = match (select(&file, device, &choice), args.mode) {
        (Ok(selection), _) => selection.dictionary,
        (Err(error), Some(_)) => return Err(Failure::new(hints::WRONG, error.to_string())),
        (Err(_), None) => device.dictionary.clone(),
    };
    if dictionary.objects.is_empty() && !args.json {
        let message = format!("the ESI of {} has no object dictionary", device.name);
        return Err(Failure::new(hints::WRONG, message)
            .hint("`ecaxis esi show` has the objects in its PDOs"));
    }
    list(&dictionary, args.json)
}

/// One subindex.
#[derive(Debug, Serialize)]
struct Entry<'d> {
    index: u16,
    sub: u8,
    name: &'d str,
    object: &'d str,
    #[serde(rename = "type")]
    type_name: &'d str,
    bits: u32,
    access: String,
    pdo: &'static str,
    default: String,
    min: String,
    max: String,
}

/// Prints every subindex as a table or as JSON.
pub(crate) fn list(dictionary: &Dictionary, json: bool) -> Result<(), Failure> {
    let mut table = Table::new("object|type|bits|access|PDO|default|min|max|name");
    let mut all = Vec::new();
    for object in &dictionary.objects {
        for item in &object.items {
            let shown = |bytes: &[u8]| value(&item.type_name, bytes);
            let shown = |bytes: Option<&[u8]>| bytes.map_or_else(String::new, shown);
            let e = Entry {
                index: object.index,
                sub: item.sub,
                name: &item.name,
                object: &object.name,
                type_name: &item.type_name,
                bits: item.bit_len,
                access: access(item),
                pdo: mapping(item.pdo_mapping),
                default: shown(item.has_default.then_some(&item.default)),
                min: shown(item.min.as_deref()),
                max: shown(item.max.as_deref()),
            };
            let name = match object.items.len() > 1 && item.sub > 0 {
                true => format!("  {}", item.name),
                false => object.name.to_string(),
            };
            let at = address(e.index, e.sub);
            let (ty, bits) = (e.type_name, e.bits);
            table.row(cells![
                at, ty, bits, e.access, e.pdo, e.default, e.min, e.max, name
            ]);
            all.push(e);
        }
    }
    if json {
        print_json(&all)
    } else {
        print_table(&table)
    }
}

fn access(item: &ObjectItem) -> String {
    let write = match item.access.write {
        Writable::Never => "",
        Writable::Always => "w",
        Writable::Only {
            pre_op: true,
            safe_op: false,
            op: false,
        } => "w in PreOp",
        Writable::Only { op: false, .. } => "w below Op",
        Writable::Only { .. } => "w in some states",
    };
    match (item.access.read, write) {
        (true, "") => "ro".to_owned(),
        (true, write) => format!("r{write}"),
        (false, "") => "none".to_owned(),
        (false, write) => format!("{write}o"),
    }
}

fn mapping(mapping: PdoMapping) -> &'static str {
    match (mapping.rx, mapping.tx) {
        (true, true) => "rx tx",
        (true, false) => "rx",
        (false, true) => "tx",
        (false, false) => "",
    }
}

/// Formats numbers by type, text as text, everything else as bytes.
fn value(type_name: &str, bytes: &[u8]) -> String {
    let bits = u32::try_from(8 * bytes.len()).unwrap_or(u32::MAX);
    let data_type = DataType::named(type_name, bits).unwrap_or(DataType::BYTES);
    match data_type.kind {
        Kind::Text => {
            let text = String::from_utf8_lossy(bytes);
            format!("{:?}", text.trim_end_matches('\0'))
        }
        Kind::Unicode => data_type.show(bytes),
        Kind::Signed | Kind::Real if data_type.width() == Some(bytes.len()) => {
            data_type.show(bytes)
        }
        Kind::Unsigned if (1..=8).contains(&bytes.len()) => {
            let number = bytes
                .iter()
                .rev()
                .fold(0, |n, &byte| n << 8 | u64::from(byte));
            match number {
                0..=0xffff => number.to_string(),
                _ => format!("0x{number:x}"),
            }
        }
        _ => {
            let more = if bytes.len() > 8 { " …" } else { "" };
            hex_bytes(bytes.iter().take(8), " ") + more
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn value_formats_bytes_by_type() {
        for (type_name, bytes, text) in [
            ("USINT", &[200][..], "200"),
            ("SINT", &[0xfd], "-3"),
            ("DINT", &[0xfe, 0xff, 0xff, 0xff], "-2"),
            ("UDINT", &[0, 0, 1, 0], "0x10000"),
            // 24 to 56 bits: ETG.1020, "Base Data Types".
            ("INT24", &[0xfe, 0xff, 0xff], "-2"),
            ("INT40", &[0xfd, 0xff, 0xff, 0xff, 0xff], "-3"),
            ("INT48", &[0, 0, 0, 0, 0, 0x80], "-140737488355328"),
            ("UINT24", &[0, 0, 1], "0x10000"),
            ("REAL", &[0, 0, 0xc0, 0x3f], "1.5"),
            ("LREAL", &[0, 0, 0, 0, 0, 0, 0xf8, 0x3f], "1.5"),
            ("OCTET_STRING(2)", &[1, 2], "01 02"),
            ("STRING(5)", b"EPOS4", "\"EPOS4\""),
            (
                "ARRAY [0..9] OF BYTE",
                &[1; 10],
                "01 01 01 01 01 01 01 01 …",
            ),
            ("LREAL", &[], ""),
        ] {
            assert_eq!(value(type_name, bytes), text, "{type_name}");
        }
    }
}
