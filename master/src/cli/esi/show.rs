//! `ecaxis esi show`: a device as an engineer wants to see it.

use std::fmt::Write;

use ecaxis_esi::{
    Choice, Device, EsiFile, Identification, Mailbox, Mode, Pdo, PortKind, Selection, SmUse,
    SyncTime, offered_modes, select,
};

use super::super::report::Table;
use super::super::tables::{fields, startup};
use super::super::{Failure, hints, result};
use super::{Which, plural};
use ecaxis::config::duration;

/// Show a device: identity, modes, PDOs, SyncManagers, clocks, start-up commands
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    which: Which,
    /// In this mode: pp, pv, hm, csp, csv, cst; otherwise its default
    #[arg(long, value_parser = super::mode)]
    mode: Option<Mode>,
    /// Modules slot by slot, `-` for none
    #[arg(long, value_delimiter = ',', value_name = "MODULE,…")]
    modules: Vec<String>,
    /// PDO assignment by its name
    #[arg(long, value_name = "NAME")]
    assignment: Option<String>,
    /// Clock mode by its name, or `off`
    #[arg(long, value_name = "NAME")]
    dc: Option<String>,
    /// Bus cycle
    #[arg(long, default_value = "1ms", value_parser = duration::parse)]
    cycle: u64,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let file = args.which.load()?;
    let mut out = String::new();
    // Without a word on which, a file of several devices is shown as what it is.
    let which = &args.which;
    let asked = which.device.is_some() || which.product.is_some() || which.revision.is_some();
    let one_product = file
        .devices
        .windows(2)
        .all(|pair| pair[0].identity.product == pair[1].identity.product);
    if !asked && !one_product {
        // Writing into a String cannot fail.
        let _ = devices(&file, &mut out);
        return result(&out);
    }
    let device = which.device(&file)?;
    let modules: Vec<&str> = args.modules.iter().map(String::as_str).collect();
    let choice = Choice {
        mode: args.mode,
        modules: &modules,
        assignment: args.assignment.as_deref(),
        dc_mode: args.dc.as_deref(),
        cycle_ns: args.cycle,
        ..Choice::default()
    };
    let chosen = args.mode.is_some() || !modules.is_empty() || args.assignment.is_some();
    let _ = head(&file, device, &mut out);
    let _ = modes(&file, device, &choice, &mut out);
    let _ = pdo_list(&file, device, &mut out);
    match select(&file, device, &choice) {
        Ok(selection) => {
            let _ = configuration(device, &selection, &choice, &mut out);
            result(&out)
        }
        Err(error) if chosen => Err(Failure::new(hints::WRONG, error.to_string())),
        Err(error) => {
            let _ = writeln!(out, "\nno default configuration: {error}");
            result(&out)
        }
    }
}

fn devices(file: &EsiFile, out: &mut String) -> std::fmt::Result {
    writeln!(
        out,
        "{} (0x{:08x}): {}, {}\n",
        file.vendor.name,
        file.vendor.id,
        plural(file.devices.len(), "device"),
        plural(file.modules.len(), "module"),
    )?;
    let mut table = Table::new(&["type", "product", "revision", "modes", "mailbox", "name"]);
    for device in &file.devices {
        let modes: Vec<String> = offered_modes(file, device)
            .iter()
            .map(Mode::to_string)
            .collect();
        table.row([
            &device.type_name,
            &format!("0x{:08x}", device.identity.product),
            &format!("0x{:08x}", device.identity.revision),
            &modes.join(" "),
            &device.mailbox.as_ref().map_or_else(String::new, protocols),
            &device.name,
        ]);
    }
    writeln!(out, "{}", table.indented(0))?;
    writeln!(out, "\n`--device TYPE` shows one of them.")
}

fn protocols(mailbox: &Mailbox) -> String {
    let names = [
        (mailbox.coe.is_some(), "CoE"),
        (mailbox.foe, "FoE"),
        (mailbox.eoe, "EoE"),
        (mailbox.soe, "SoE"),
        (mailbox.aoe, "AoE"),
        (mailbox.voe, "VoE"),
    ];
    let names = names.iter().filter(|(on, _)| *on).map(|(_, name)| *name);
    names.collect::<Vec<_>>().join(" ")
}

fn head(file: &EsiFile, device: &Device, out: &mut String) -> std::fmt::Result {
    writeln!(out, "{} {:?}", device.type_name, device.name)?;
    let mut table = Table::new(&["", ""]);
    let vendor = format!("{} (0x{:08x})", file.vendor.name, file.vendor.id);
    table.row(["vendor", &vendor]);
    let id = device.identity;
    table.row(["product code", &format!("0x{:08x}", id.product)]);
    table.row(["revision", &format!("0x{:08x}", id.revision)]);
    if let Some(profile) = device.profile {
        let meaning = match profile & 0xffff {
            402 => " (CiA 402 drive)",
            5001 => " (modular device)",
            _ => "",
        };
        table.row(["profile", &format!("{}{meaning}", profile & 0xffff)]);
    }
    table.row(["ports", &ports(device)]);
    if let Some(mailbox) = &device.mailbox {
        table.row(["mailbox", &mailbox_text(device, mailbox)]);
    } else {
        table.row(["mailbox", "none"]);
    }
    let info = &device.info;
    match info.identification {
        Identification::No => {}
        Identification::Reg134 => {
            table.row(["identification", "AL control bit 5, answer in 0x0134"])
        }
        Identification::Ado(ado) => table.row(["identification", &format!("at 0x{ado:04x}")]),
    }
    if let Some(current) = info.ebus_current_ma {
        table.row(["E-bus current", &format!("{current} mA")]);
    }
    let times = [
        ("to PreOp", info.preop_timeout_ms),
        ("to SafeOp and Op", info.safeop_op_timeout_ms),
        ("back to Init", info.back_to_init_timeout_ms),
        ("back to SafeOp", info.back_to_safeop_timeout_ms),
        ("mailbox answer", info.mailbox_response_timeout_ms),
    ];
    let times = times
        .iter()
        .filter_map(|(what, ms)| ms.map(|ms| format!("{what} {ms} ms")));
    let times: Vec<String> = times.collect();
    if !times.is_empty() {
        table.row(["time limits", &times.join(", ")]);
    }
    table.row(["line", &device.position.line.to_string()]);
    // The table's empty head stays out.
    let text = table.indented(2);
    writeln!(
        out,
        "{}",
        text.trim_start_matches(['\n', ' '])
            .lines()
            .fold(String::new(), |all, line| format!(
                "{all}  {}\n",
                line.trim_start()
            ),)
            .trim_end()
    )
}

fn ports(device: &Device) -> String {
    let of_info = |kind: PortKind| match kind {
        PortKind::Mii => "MII",
        PortKind::EBus => "E-bus",
        PortKind::None => "-",
    };
    let names: Vec<&str> = if device.info.ports.is_empty() {
        let letters = device.physics.chars().map(|letter| match letter {
            'Y' | 'y' => "MII",
            'K' | 'k' => "E-bus",
            'H' | 'h' => "MII (fast hot connect)",
            _ => "-",
        });
        letters.collect()
    } else {
        device
            .info
            .ports
            .iter()
            .map(|port| of_info(port.kind))
            .collect()
    };
    if names.is_empty() {
        "not told".to_owned()
    } else {
        names.join(", ")
    }
}

fn mailbox_text(device: &Device, mailbox: &Mailbox) -> String {
    let size = |usage| {
        let sm = device.sync_managers.iter().find(|sm| sm.usage == usage);
        sm.map_or(0, |sm| sm.default_size)
    };
    let mut text = format!(
        "{}; {} bytes out, {} in",
        protocols(mailbox),
        size(SmUse::MBoxOut),
        size(SmUse::MBoxIn)
    );
    if let Some(coe) = &mailbox.coe {
        let can = [
            (coe.pdo_assign, "PDO assignment"),
            (coe.pdo_config, "PDO contents"),
            (coe.complete_access, "complete access"),
            (coe.segmented_sdo, "segments"),
            (coe.sdo_info, "SDO Information"),
            (coe.diag_history, "diagnosis history"),
        ];
        let can: Vec<&str> = can
            .iter()
            .filter(|(on, _)| *on)
            .map(|(_, what)| *what)
            .collect();
        if !can.is_empty() {
            let _ = write!(text, "; CoE allows {}", can.join(", "));
        }
    }
    text
}

fn modes(
    file: &EsiFile,
    device: &Device,
    choice: &Choice<'_>,
    out: &mut String,
) -> std::fmt::Result {
    let offered = offered_modes(file, device);
    if !offered.is_empty() {
        let mut table = Table::new(&["mode", "0x6060", "module", "bytes out", "bytes in", "clock"]);
        for mode in offered {
            let choice = Choice {
                mode: Some(mode),
                assignment: None,
                ..*choice
            };
            let code = mode.code().to_string();
            match select(file, device, &choice) {
                Ok(selection) => {
                    let modules: Vec<&str> = selection
                        .modules
                        .iter()
                        .map(|m| m.type_name.as_str())
                        .collect();
                    table.row([
                        &mode.to_string(),
                        &code,
                        &modules.join(", "),
                        &selection.layout.rx_bytes().to_string(),
                        &selection.layout.tx_bytes().to_string(),
                        selection.dc.as_ref().map_or("none", |dc| dc.name.as_str()),
                    ]);
                }
                Err(error) => {
                    table.row([&mode.to_string(), &code, &error.to_string(), "", "", ""]);
                }
            }
        }
        writeln!(out, "\nmodes\n{}", table.indented(2))?;
    }
    slots(file, device, out)?;
    if !device.sm_mappings.is_empty() {
        writeln!(out, "\nPDO assignments by name")?;
        for mapping in &device.sm_mappings {
            let default = if mapping.default { " (default)" } else { "" };
            writeln!(out, "  {:?}{default}", mapping.name)?;
        }
    }
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
    writeln!(out, "\nclock modes\n{}", table.indented(2))
}

fn slots(file: &EsiFile, device: &Device, out: &mut String) -> std::fmt::Result {
    let Some(slots) = device
        .slots
        .as_ref()
        .filter(|slots| !slots.slots.is_empty())
    else {
        return Ok(());
    };
    let mut table = Table::new(&["slot", "modules", "takes"]);
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
        table.row([&slot.name, &count, &takes.join(", ")]);
    }
    writeln!(out, "\nslots\n{}", table.indented(2))
}

fn sync(time: SyncTime, on: bool) -> String {
    if !on {
        return "off".to_owned();
    }
    let scaled = |factor: i32| match factor {
        1 => "cycle".to_owned(),
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
            .map(|e| format!("{:04x}:{:02x}", e.index, e.sub))
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
    writeln!(out, "\nPDOs\n{}", table.indented(2))
}

fn configuration(
    device: &Device,
    selection: &Selection,
    choice: &Choice<'_>,
    out: &mut String,
) -> std::fmt::Result {
    let what = match (selection.mode, selection.modules.as_slice()) {
        (Some(mode), _) => format!("mode {mode}"),
        (None, []) => "the default".to_owned(),
        (None, modules) => {
            let names: Vec<String> = modules
                .iter()
                .map(|m| format!("{:?} in slot {:?}", m.type_name, m.slot_name))
                .collect();
            format!("the default, {}", names.join(", "))
        }
    };
    writeln!(
        out,
        "\nconfiguration: {what}, cycle {}",
        duration::show(choice.cycle_ns)
    )?;
    for note in &selection.notes {
        writeln!(out, "  note: {note}")?;
    }
    let layout = &selection.layout;
    let mut table = Table::new(&["SM", "use", "address", "bytes", "control"]);
    for (number, sm) in device.sync_managers.iter().enumerate() {
        let mut process = layout.outputs.iter().chain(&layout.inputs);
        let used = process.find(|used| usize::from(used.sm) == number);
        let usage = match (sm.usage, used.is_some()) {
            (SmUse::MBoxOut, _) => "mailbox out",
            (SmUse::MBoxIn, _) => "mailbox in",
            (SmUse::Outputs, true) => "outputs",
            (SmUse::Inputs, true) => "inputs",
            _ => "unused",
        };
        let (len, control) = used.map_or((sm.default_size, sm.control_byte), |used| {
            (used.len, used.control_byte)
        });
        table.row([
            &number.to_string(),
            usage,
            &format!("0x{:04x}", sm.start_address),
            &len.to_string(),
            &format!("0x{control:02x}"),
        ]);
    }
    writeln!(out, "\n{}", table.indented(2))?;
    fields("outputs", layout.rx_bytes(), &layout.rx, out)?;
    fields("inputs", layout.tx_bytes(), &layout.tx, out)?;
    startup(&selection.startup, out)
}
