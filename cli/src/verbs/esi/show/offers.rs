//! The options of a device: modes, slots, assignments, clock modes, PDOs.

use ecaxis_esi::{
    Device, EsiFile, Field, Layout, Mode, Pdo, SelectError, SelectOptions, Selection, SyncTime,
    address, offered_modes, select,
};
use ecaxis_master::config::duration;
use ecaxis_tools::cells;
use ecaxis_tools::document::format::{hex16, hex32, names_of, or_dash};
use ecaxis_tools::document::{Document, Table};

pub(super) fn write(
    file: &EsiFile,
    device: &Device,
    choice: &SelectOptions<'_>,
    out: &mut Document,
) {
    modes(file, device, choice, out);
    slots(file, device, out);
    out.section("PDO assignments by name", assignments(device));
    out.section("clock modes", clock_modes(device));
    pdo_list(file, device, out);
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
            modules: None,
            assignment: None,
            dc_mode: None,
            ..*choice
        };
        (mode, select(file, device, &choice))
    };
    let modes = offered_modes(file, device).into_iter();
    modes.map(selected).collect()
}

fn modes(file: &EsiFile, device: &Device, choice: &SelectOptions<'_>, out: &mut Document) {
    let offered = by_mode(file, device, choice);
    let mut table = Table::new("mode|0x6060|module|bytes out|bytes in|clock");
    for (mode, selection) in &offered {
        table.row(match selection {
            Ok(selection) => {
                let modules = selection.modules.iter().map(|m| m.type_name.as_str());
                let modules = modules.collect::<Vec<_>>().join(", ");
                let (rx, tx) = (selection.layout.rx_bytes(), selection.layout.tx_bytes());
                let clock = selection.dc.as_ref().map_or("none", |dc| dc.name.as_str());
                cells![mode, mode.code(), modules, rx, tx, clock]
            }
            Err(error) => cells![mode, mode.code(), error, "", "", ""],
        });
    }
    out.section("modes", table);
    let usable = offered.iter();
    let usable = usable.filter_map(|(mode, of)| Some((*mode, &of.as_ref().ok()?.layout)));
    let usable: Vec<(Mode, &Layout)> = usable.collect();
    if usable.windows(2).any(|pair| pair[0].1 != pair[1].1) {
        mapped("outputs", &usable, |layout| &layout.rx, out);
        mapped("inputs", &usable, |layout| &layout.tx, out);
    }
}

/// Shows the mapped objects of each mode with their byte offsets.
fn mapped(
    what: &str,
    modes: &[(Mode, &Layout)],
    fields: fn(&Layout) -> &[Field],
    out: &mut Document,
) {
    let names: Vec<String> = modes.iter().map(|(mode, _)| mode.to_string()).collect();
    let mut table = Table::new(&format!("{what}|bits|{}|name", names.join("|")));
    let mut known = Vec::new();
    for field in modes.iter().flat_map(|(_, layout)| fields(layout)) {
        let same = |f: &&Field| (f.index, f.sub) == (field.index, field.sub);
        if known.iter().copied().any(|f| same(&f)) {
            continue;
        }
        known.push(field);
        let object = address(field.index, field.sub).to_string();
        let mut cells = vec![object, field.bit_len.to_string()];
        cells.extend(modes.iter().map(|(_, layout)| {
            let bit = fields(layout).iter().find(same).map(|f| f.bit_offset);
            or_dash(bit.map(|bit| match bit % 8 {
                0 => (bit / 8).to_string(),
                rest => format!("{}.{rest}", bit / 8),
            }))
        }));
        cells.push(field.name.to_string());
        table.line(cells);
    }
    out.gap();
    out.line("at byte, by mode");
    out.table(table);
}

fn assignments(device: &Device) -> Table {
    let mut table = Table::new("name|PDOs|");
    for mapping in &device.sm_mappings {
        let of_sm = mapping.sync_managers.iter().map(|(sm, pdos)| {
            let pdos: Vec<String> = pdos.iter().map(|pdo| format!("{pdo:04x}")).collect();
            format!("SM {sm}: {}", pdos.join(" "))
        });
        let of_sm = of_sm.collect::<Vec<_>>().join("; ");
        let default = if mapping.default { "default" } else { "" };
        table.row(cells![mapping.name, of_sm, default]);
    }
    table
}

fn clock_modes(device: &Device) -> Table {
    let mut table = Table::new("name|AssignActivate|SYNC0|SYNC1|meaning");
    for mode in &device.dc_modes {
        let activate = mode.assign_activate;
        let sync0 = sync(mode.sync0, activate & 0x0200 != 0);
        let sync1 = sync(mode.sync1, activate & 0x0400 != 0);
        table.row(cells![
            mode.name,
            hex16(activate),
            sync0,
            sync1,
            mode.description
        ]);
    }
    table
}

fn slots(file: &EsiFile, device: &Device, out: &mut Document) {
    let mut rows: Vec<[String; 3]> = Vec::new();
    for slot in device.slots.iter().flat_map(|slots| &slots.slots) {
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
            let name = module.map_or_else(|| hex32(*ident), |m| m.type_name.to_string());
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
    let mut table = Table::new("slot|modules|takes");
    rows.into_iter().for_each(|row| table.row(row));
    out.section("slots", table);
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
        text += &format!(", shift {}", signed(time.shift_ns));
    }
    if time.shift_factor != 0 {
        text += &format!(", shift {}", scaled(time.shift_factor));
    }
    text
}

fn pdo_list(file: &EsiFile, device: &Device, out: &mut Document) {
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
        out.heading("no PDOs");
    }
    let mut table = Table::new("PDO|SM|bits|kind|module|objects|name");
    for (module, pdo) in all {
        let kind = [
            (pdo.fixed, "fixed"),
            (pdo.mandatory, "mandatory"),
            (pdo.virtual_, "virtual"),
            (pdo.overwritten_by_module, "by module"),
            (!pdo.exclude.is_empty(), "excludes others"),
        ];
        let objects = pdo.entries.iter().filter(|entry| !entry.is_gap());
        // Without `0x`, because the column holds only objects.
        let objects = objects.map(|e| address(e.index, e.sub).to_string().split_off(2));
        let objects: Vec<String> = objects.collect();
        let more = match objects.len().saturating_sub(6) {
            0 => String::new(),
            more => format!(" … {more} more"),
        };
        let objects: Vec<String> = objects.into_iter().take(6).collect();
        table.row(cells![
            hex16(pdo.index),
            or_dash(pdo.sm),
            pdo.bit_len(),
            names_of(&kind, ", "),
            module,
            objects.join(" ") + &more,
            pdo.name,
        ]);
    }
    out.section("PDOs", table);
}
