//! Tables that several subcommands use.

use std::fmt::Write;

use ecaxis_esi::{Field, StartupSdo, address};

use crate::render::report::Table;

/// Formats the offset of each object of one direction.
pub(crate) fn fields(
    what: &str,
    bytes: usize,
    fields: &[Field],
    out: &mut String,
) -> std::fmt::Result {
    let unit = if bytes == 1 { "byte" } else { "bytes" };
    writeln!(out, "\n  {what}: {bytes} {unit}")?;
    if fields.is_empty() {
        return Ok(());
    }
    let mut table = Table::new(&["offset", "bits", "object", "type", "name", "PDO"]);
    let place = |bit: u32| format!("{}.{}", bit / 8, bit % 8);
    let gap = |table: &mut Table, from: u32, to: u32| {
        if to > from {
            table.row([
                &place(from),
                &(to - from).to_string(),
                "-",
                "",
                "padding",
                "",
            ]);
        }
    };
    let mut end = 0;
    for field in fields {
        gap(&mut table, end, field.bit_offset);
        end = field.bit_offset + u32::from(field.bit_len);
        table.row([
            &place(field.bit_offset),
            &field.bit_len.to_string(),
            &address(field.index, field.sub).to_string(),
            &field.data_type,
            &field.name,
            &format!("0x{:04x}", field.pdo),
        ]);
    }
    // Padding of the last byte is not shown.
    let whole = u32::try_from(8 * bytes).unwrap_or(end);
    if whole.saturating_sub(end) >= 8 {
        gap(&mut table, end, whole);
    }
    writeln!(out, "{}", table.shown(2))
}

/// Formats the start-up list with the origin of each command.
pub(crate) fn startup(startup: &[StartupSdo], out: &mut String) -> std::fmt::Result {
    if startup.is_empty() {
        return writeln!(out, "\n  no start-up SDOs");
    }
    let mut table = Table::new(&["at", "object", "value", "name", "from"]);
    for sdo in startup {
        let object = match sdo.complete_access {
            true => format!("0x{:04x} CA", sdo.index),
            false => address(sdo.index, sdo.sub).to_string(),
        };
        table.row([
            sdo.transition,
            &object,
            &value(&sdo.data),
            short_name(&sdo.name),
            &sdo.origin,
        ]);
    }
    writeln!(
        out,
        "\n  start-up SDOs, in this order (PS: between PreOp and SafeOp)\n{}",
        table.shown(2)
    )
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
    let hex = |bytes: &mut dyn Iterator<Item = &u8>, gap: &str| {
        let bytes: Vec<String> = bytes.map(|b| format!("{b:02x}")).collect();
        bytes.join(gap)
    };
    match data.len() {
        0 => String::new(),
        1..=8 => format!("0x{}", hex(&mut data.iter().rev(), "")),
        9..=24 => hex(&mut data.iter(), " "),
        n => format!("{} … ({n} bytes)", hex(&mut data.iter().take(16), " ")),
    }
}
