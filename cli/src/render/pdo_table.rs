//! Tables that several subcommands use.

use ecaxis_ecat::mailbox::soe::Idn;
use ecaxis_esi::{Device, Field, IdnValue, Layout, Selection, SmLayout, SmUse, address};
use ecaxis_master::parameters::meaning::meaning;
use ecaxis_master::text::pluralize;
use ecaxis_tools::cells;
use ecaxis_tools::document::format::{hex_bytes, hex16};
use ecaxis_tools::document::{Document, Table};

/// Adds the SyncManagers and the offset of each object.
pub(crate) fn process_data(device: &Device, layout: &Layout, out: &mut Document) {
    let mut table = Table::new("SM|use|address|bytes|control|FMMU");
    for (number, sm) in device.sync_managers.iter().enumerate() {
        let mut planned = layout.outputs.iter().chain(&layout.inputs);
        let planned = planned.find(|planned| usize::from(planned.sm) == number);
        let usage = match (sm.usage, planned) {
            (SmUse::MBoxOut, _) => "mailbox out",
            (SmUse::MBoxIn, _) => "mailbox in",
            (SmUse::Outputs, Some(_)) => "outputs",
            (SmUse::Inputs, Some(_)) => "inputs",
            _ => "unused",
        };
        let own = (sm.start_address, sm.default_size, sm.control_byte);
        let of = |p: &SmLayout| (p.start_address, p.len, p.control());
        let (address, len, control) = planned.map_or(own, of);
        let fmmu = planned.map(|p| p.fmmu.map_or("next free".to_owned(), |f| f.to_string()));
        let (address, control) = (hex16(address), format!("0x{control:02x}"));
        table.row(cells![
            number,
            usage,
            address,
            len,
            control,
            fmmu.unwrap_or_default()
        ]);
    }
    out.gap();
    out.table(table);
    fields("outputs", layout.rx_bytes(), (&layout.rx, layout.idns), out);
    fields("inputs", layout.tx_bytes(), (&layout.tx, layout.idns), out);
}

/// Adds the offset of each object of one direction.
fn fields(what: &str, bytes: usize, (fields, idns): (&[Field], bool), out: &mut Document) {
    out.gap();
    out.line(format!("{what}: {}", pluralize(bytes, "byte")));
    if fields.is_empty() {
        return;
    }
    let mut table = Table::new("offset|bits|object|type|name|PDO");
    let place = |bit: u32| format!("{}.{}", bit / 8, bit % 8);
    let gap = |table: &mut Table, from: u32, to: u32| {
        if to > from {
            table.row(cells![place(from), to - from, "-", "", "padding", ""]);
        }
    };
    let mut end = 0;
    for field in fields {
        gap(&mut table, end, field.bit_offset);
        end = field.bit_offset + u32::from(field.bit_len);
        let object = match idns {
            true => Idn(field.index).to_string(),
            false => address(field.index, field.sub).to_string(),
        };
        let (at, pdo) = (place(field.bit_offset), hex16(field.pdo));
        table.row(cells![
            at,
            field.bit_len,
            object,
            field.data_type,
            field.name,
            pdo
        ]);
    }
    // Padding of the last byte is not shown.
    let whole = u32::try_from(8 * bytes).unwrap_or(end);
    if whole.saturating_sub(end) >= 8 {
        gap(&mut table, end, whole);
    }
    out.table(table);
}

/// Adds the start-up list with the origin of each command.
pub(crate) fn startup(selection: &Selection, out: &mut Document) {
    let startup = &selection.startup;
    out.gap();
    if selection.layout.idns {
        return startup_idns(selection, out);
    }
    if startup.is_empty() {
        out.line("no start-up SDOs");
        return;
    }
    let mut table = Table::new("at|object|value|name|from");
    for sdo in startup {
        let object = match sdo.complete_access {
            true => format!("0x{:04x} CA", sdo.index),
            false => address(sdo.index, sdo.sub).to_string(),
        };
        let text = meaning(sdo.index, sdo.sub, &sdo.data).filter(|_| !sdo.complete_access);
        let text = text.map_or(String::new(), |text| format!(" {text}"));
        let (value, name) = (value(&sdo.data) + &text, short_name(&sdo.name));
        table.row(cells![sdo.transition, object, value, name, sdo.origin]);
    }
    out.line("start-up SDOs, in this order (PS: between PreOp and SafeOp)");
    out.table(table);
}

/// Adds the start-up IDNs of a Sercos drive.
fn startup_idns(selection: &Selection, out: &mut Document) {
    let mut table = Table::new("at|drive|IDN|value|name|from");
    for idn in &selection.startup_idns {
        let value = match &idn.value {
            IdnValue::Bytes(bytes) => value(bytes),
            IdnValue::Text(text) => text.clone(),
        };
        let name = idn.idn.name().unwrap_or_default();
        table.row(cells![
            idn.transition,
            idn.drive,
            idn.idn,
            value,
            name,
            idn.origin
        ]);
    }
    out.line("start-up IDNs, in this order (IP: before PreOp, PS: between PreOp and SafeOp)");
    out.table(table);
}

/// Returns the entry's own name without the object's name, because the table shows the index.
pub(crate) fn short_name(name: &str) -> &str {
    match name.split_once(" / ") {
        Some((_, entry)) if !entry.starts_with("SubIndex") => entry,
        _ => name,
    }
}

/// Formats up to eight bytes as one number, more as bytes in wire order.
pub(crate) fn value(data: &[u8]) -> String {
    match data.len() {
        0 => String::new(),
        1..=8 => format!("0x{}", hex_bytes(data.iter().rev(), "")),
        9..=24 => hex_bytes(data, " "),
        n => format!("{} … ({n} bytes)", hex_bytes(data.iter().take(16), " ")),
    }
}
