//! The options of a device: modes, slots, assignments, clock modes, PDOs.

use std::fmt::Write;

use ecaxis_esi::{
    Device, EsiFile, Field, Layout, Mode, Pdo, SelectError, SelectOptions, Selection, SyncTime,
    address, offered_modes, select,
};
use ecaxis_master::config::duration;

use crate::render::report::Table;

pub(super) fn write(
    file: &EsiFile,
    device: &Device,
    choice: &SelectOptions<'_>,
    out: &mut String,
) -> std::fmt::Result {
    modes(file, device, choice, out)?;
    slots(file, device, out)?;
    assignments(device, out)?;
    clock_modes(device, out)?;
    pdo_list(file, device, out)
}

/// Returns the configuration of each mode, independent of the user's other choices.
pub(super) fn by_mode(
    file: &EsiFile,
    device: &Device,
    choice: &SelectOptions<'_>,
) -> Vec<(Mode, Result<Selection, SelectError>)> {
    let selected = |mode| {
        let choice = SelectOptions {
            mode: Some(mode),
            modules: &[],
            assignment: None,
            dc_mode: None,
            ..*choice
        };
        (mode, select(file, device, &choice))
    };
    let modes = offered_modes(file, device).into_iter();
    modes.map(selected).collect()
}

fn modes(
    file: &EsiFile,
    device: &Device,
    choice: &SelectOptions<'_>,
    out: &mut String,
) -> std::fmt::Result {
    let offered = by_mode(file, device, choice);
    if offered.is_empty() {
        return Ok(());
    }
    let mut table = Table::new(&["mode", "0x6060", "module", "bytes out", "bytes in", "clock"]);
    for (mode, selection) in &offered {
        let code = mode.code().to_string();
        match selection {
            Ok(selection) => {
                let modules = selection.modules.iter().map(|m| m.type_name.as_str());
                table.row([
                    mode.name(),
                    &code,
                    &modules.collect::<Vec<_>>().join(", "),
                    &selection.layout.rx_bytes().to_string(),
                    &selection.layout.tx_bytes().to_string(),
                    selection.dc.as_ref().map_or("none", |dc| dc.name.as_str()),
                ]);
            }
            Err(error) => table.row([mode.name(), &code, &error.to_string(), "", "", ""]),
        }
    }
    writeln!(out, "\nmodes\n{}", table.shown(2))?;
    let usable: Vec<(Mode, &Layout)> = offered
        .iter()
        .filter_map(|(mode, selection)| Some((*mode, &selection.as_ref().ok()?.layout)))
        .collect();
    let differ = usable.windows(2).any(|pair| pair[0].1 != pair[1].1);
    if differ {
        let modes: Vec<Mode> = usable.iter().map(|(mode, _)| *mode).collect();
        let of = |fields: fn(&Layout) -> &[Field]| {
            usable.iter().map(|(_, layout)| fields(layout)).collect()
        };
        mapped("outputs", &modes, of(|layout| &layout.rx), out)?;
        mapped("inputs", &modes, of(|layout| &layout.tx), out)?;
    }
    Ok(())
}

/// Shows the mapped objects of each mode with their byte offsets.
fn mapped(what: &str, modes: &[Mode], fields: Vec<&[Field]>, out: &mut String) -> std::fmt::Result {
    let mut head = vec![what.to_owned(), "bits".to_owned()];
    head.extend(modes.iter().map(Mode::to_string));
    head.push("name".to_owned());
    let mut rows: Vec<(u16, u8, Vec<String>)> = Vec::new();
    for field in fields.iter().copied().flatten() {
        let known = |row: &(u16, u8, Vec<String>)| (row.0, row.1) == (field.index, field.sub);
        if rows.iter().any(known) {
            continue;
        }
        let mut cells = vec![
            address(field.index, field.sub).to_string(),
            field.bit_len.to_string(),
        ];
        cells.extend(fields.iter().map(|fields| {
            let here = |f: &&Field| (f.index, f.sub) == (field.index, field.sub);
            match fields.iter().find(here).map(|f| f.bit_offset) {
                Some(bit) if bit % 8 == 0 => (bit / 8).to_string(),
                Some(bit) => format!("{}.{}", bit / 8, bit % 8),
                None => "-".to_owned(),
            }
        }));
        cells.push(field.name.clone());
        rows.push((field.index, field.sub, cells));
    }
    let head: Vec<&str> = head.iter().map(String::as_str).collect();
    let mut table = Table::new(&head);
    for (_, _, cells) in rows {
        table.line(cells);
    }
    writeln!(out, "\n  at byte, by mode\n{}", table.shown(2))
}

fn assignments(device: &Device, out: &mut String) -> std::fmt::Result {
    if device.sm_mappings.is_empty() {
        return Ok(());
    }
    let mut table = Table::new(&["name", "PDOs", ""]);
    for mapping in &device.sm_mappings {
        let of_sm = mapping.sync_managers.iter().map(|(sm, pdos)| {
            let pdos: Vec<String> = pdos.iter().map(|pdo| format!("{pdo:04x}")).collect();
            format!("SM {sm}: {}", pdos.join(" "))
        });
        let default = if mapping.default { "default" } else { "" };
        let of_sm: Vec<String> = of_sm.collect();
        table.row([&mapping.name, &of_sm.join("; "), default]);
    }
    writeln!(out, "\nPDO assignments by name\n{}", table.shown(2))
}

fn clock_modes(device: &Device, out: &mut String) -> std::fmt::Result {
    if device.dc_modes.is_empty() {
        return Ok(());
    }
    let mut table = Table::new(&["name", "AssignActivate", "SYNC0", "SYNC1", "meaning"]);
    for mode in &device.dc_modes {
        table.row([
            &mode.name,
            &format!("0x{:04x}", mode.assign_activate),
            &sync(mode.sync0, mode.assign_activate & 0x0200 != 0),
            &sync(mode.sync1, mode.assign_activate & 0x0400 != 0),
            &mode.description,
        ]);
    }
    writeln!(out, "\nclock modes\n{}", table.shown(2))
}

fn slots(file: &EsiFile, device: &Device, out: &mut String) -> std::fmt::Result {
    let Some(slots) = device
        .slots
        .as_ref()
        .filter(|slots| !slots.slots.is_empty())
    else {
        return Ok(());
    };
    let mut rows: Vec<[String; 3]> = Vec::new();
    for slot in &slots.slots {
        let count = match (slot.min_instances, slot.max_instances) {
            (min, max) if min == max => min.to_string(),
            (min, max) => format!("{min} to {max}"),
        };
        let of_class = |module: &&ecaxis_esi::Module| {
            let class = module.class.as_ref();
            class.is_some_and(|class| slot.module_classes.contains(class))
        };
        let named = slot.module_idents.iter().map(|(ident, default)| {
            let module = file.modules.iter().find(|module| module.ident == *ident);
            let name = module.map_or_else(|| format!("0x{ident:08x}"), |m| m.type_name.clone());
            let mark = if *default { " (default)" } else { "" };
            format!("{name}{mark}")
        });
        let classes = file
            .modules
            .iter()
            .filter(of_class)
            .map(|m| m.type_name.clone());
        let takes: Vec<String> = named.chain(classes).collect();
        let takes = takes.join(", ");
        // Gateways can have dozens of identical slots.
        match rows.last_mut() {
            Some([name, last_count, last]) if *last_count == count && *last == takes => {
                let first = name.split(" … ").next().unwrap_or_default();
                *name = format!("{first} … {}", slot.name);
            }
            _ => rows.push([slot.name.clone(), count, takes]),
        }
    }
    let mut table = Table::new(&["slot", "modules", "takes"]);
    for [name, count, takes] in &rows {
        table.row([name, count, takes]);
    }
    writeln!(out, "\nslots\n{}", table.shown(2))
}

fn sync(time: SyncTime, on: bool) -> String {
    if !on {
        return "off".to_owned();
    }
    let scaled = |factor: i32| match factor {
        -1..=1 => "cycle".to_owned(),
        factor if factor < 0 => format!("cycle ÷ {}", factor.unsigned_abs()),
        factor => format!("cycle × {factor}"),
    };
    let signed = |ns: i64| {
        let sign = if ns < 0 { "-" } else { "" };
        format!("{sign}{}", duration::show(ns.unsigned_abs()))
    };
    let mut text = match (time.cycle_ns, time.factor) {
        (0, 0) => "every cycle".to_owned(),
        (0, factor) => format!("every {}", scaled(factor)),
        (ns, _) => format!("every {}", signed(ns)),
    };
    if time.shift_ns != 0 {
        let _ = write!(text, ", shift {}", signed(time.shift_ns));
    }
    if time.shift_factor != 0 {
        let _ = write!(text, ", shift {}", scaled(time.shift_factor));
    }
    text
}

fn pdo_list(file: &EsiFile, device: &Device, out: &mut String) -> std::fmt::Result {
    let of_modules = file.modules.iter().filter(|module| {
        let slots = device.slots.iter().flat_map(|slots| &slots.slots);
        slots
            .flat_map(|slot| &slot.module_idents)
            .any(|(ident, _)| *ident == module.ident)
    });
    let device_pdos = device
        .rx_pdos
        .iter()
        .chain(&device.tx_pdos)
        .map(|pdo| ("", pdo));
    let module_pdos = of_modules.flat_map(|module| {
        let pdos = module.rx_pdos.iter().chain(&module.tx_pdos);
        pdos.map(|pdo| (module.type_name.as_str(), pdo))
    });
    let all: Vec<(&str, &Pdo)> = device_pdos.chain(module_pdos).collect();
    if all.is_empty() {
        return writeln!(out, "\nno PDOs");
    }
    let mut table = Table::new(&["PDO", "SM", "bits", "kind", "module", "objects", "name"]);
    for (module, pdo) in all {
        let kind = [
            (pdo.fixed, "fixed"),
            (pdo.mandatory, "mandatory"),
            (pdo.virtual_, "virtual"),
            (pdo.overwritten_by_module, "by module"),
            (!pdo.exclude.is_empty(), "excludes others"),
        ];
        let kind: Vec<&str> = kind
            .iter()
            .filter(|(on, _)| *on)
            .map(|(_, name)| *name)
            .collect();
        let objects = pdo.entries.iter().filter(|entry| !entry.is_gap());
        let objects: Vec<String> = objects
            // Without `0x`, because the column holds only objects.
            .map(|e| address(e.index, e.sub).to_string().split_off(2))
            .collect();
        let more = objects.len().saturating_sub(6);
        let mut objects = objects.into_iter().take(6).collect::<Vec<_>>().join(" ");
        if more > 0 {
            let _ = write!(objects, " … {more} more");
        }
        table.row([
            &format!("0x{:04x}", pdo.index),
            &pdo.sm.map_or_else(|| "-".to_owned(), |sm| sm.to_string()),
            &pdo.bit_len().to_string(),
            &kind.join(", "),
            module,
            &objects,
            &pdo.name,
        ]);
    }
    writeln!(out, "\nPDOs\n{}", table.shown(2))
}
