//! `ecaxis esi show`: shows a device.
//!
//! `head` shows the identity, `offers` the options; `as_json` formats all as JSON.

use ecaxis_esi::{
    Device, EsiFile, Mode, SelectError, SelectOptions, Selection, offered_modes, select,
};
use ecaxis_master::config::duration;
use ecaxis_master::text::pluralize;
use ecaxis_tools::cells;
use ecaxis_tools::document::format::{hex16, hex32};
use ecaxis_tools::document::{Document, Table};

use super::DeviceArgs;
use crate::hints::{self, Failure};
use crate::render::pdo_table::{process_data, startup};
use crate::render::{note, print, print_json};

mod as_json;
mod head;
mod offers;

const EXAMPLES: &str = "\
Examples:
  ecaxis esi show f.xml                     list the devices
  ecaxis esi show f.xml --device EPOS4      one device
  ecaxis esi show f.xml --device EPOS4 --mode csp --cycle 2ms
  ecaxis esi show f.xml --device 2 --modules CSP,- --json";

/// Show a device: identity, modes, PDOs, SyncManagers, clocks, start-up SDOs
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    #[command(flatten)]
    which: DeviceArgs,
    /// Use this mode: pp, pv, hm, csp, csv, cst [default: the device's default mode]
    #[arg(long, value_parser = super::mode)]
    mode: Option<Mode>,
    /// Modules by slot, `-` for an empty slot
    #[arg(long, value_delimiter = ',', value_name = "MODULE,…")]
    modules: Option<Vec<String>>,
    /// PDO assignment by name
    #[arg(long, value_name = "NAME")]
    assignment: Option<String>,
    /// Clock mode by name, or `off`
    #[arg(long, value_name = "NAME")]
    dc: Option<String>,
    /// Bus cycle time
    #[arg(long, default_value = "1ms", value_parser = duration::parse)]
    cycle: u64,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let file = args.which.load()?;
    // Without a selection, a file with several products is shown as a list.
    let one_product = file
        .devices
        .windows(2)
        .all(|pair| pair[0].identity.product == pair[1].identity.product);
    if !args.which.says_which() && (file.devices.is_empty() || !one_product) {
        if args.json {
            return print_json(&as_json::devices(&file));
        }
        return print(&devices(&file));
    }
    let device = args.which.device(&file)?;
    let names = args.modules.as_ref();
    let modules: Option<Vec<&str>> = names.map(|names| names.iter().map(String::as_str).collect());
    let choice = SelectOptions {
        mode: args.mode,
        modules: modules.as_deref(),
        assignment: args.assignment.as_deref(),
        dc_mode: args.dc.as_deref(),
        cycle_ns: args.cycle,
        ..SelectOptions::default()
    };
    let chosen =
        args.mode.is_some() || modules.is_some() || args.assignment.is_some() || args.dc.is_some();
    let selection = match select(&file, device, &choice) {
        Err(error) if chosen => {
            let failure = Failure::new(hints::WRONG, error.to_string());
            return Err(
                failure.hint("`ecaxis esi show` without the choice lists what there is to choose")
            );
        }
        other => other,
    };
    if args.json {
        return print_json(&as_json::device(&file, device, &choice, &selection));
    }
    let mut out = head::document(&file, device);
    offers::write(&file, device, &choice, &mut out);
    match &selection {
        Ok(selection) => configuration(device, selection, &choice, &mut out),
        Err(error) => {
            out.heading(format!("no default configuration: {error}"));
            if matches!(error, SelectError::ModuleNeeded { .. }) {
                note("help: `--modules` takes one module for each slot, `-` for none");
            }
        }
    }
    print(&out)
}

/// Adds one configuration: SyncManagers, process data with offsets, start-up list.
fn configuration(
    device: &Device,
    selection: &Selection,
    choice: &SelectOptions<'_>,
    out: &mut Document,
) {
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
    let cycle = duration::show(choice.cycle_ns);
    out.heading(format!("configuration: {what}, cycle {cycle}"));
    for note in &selection.notes {
        out.item("note: ", note);
    }
    process_data(device, &selection.layout, out);
    startup(selection, out);
}

fn devices(file: &EsiFile) -> Document {
    let vendors = file.vendors.iter();
    let vendors = vendors.map(|vendor| format!("{} (0x{:08x})", vendor.name, vendor.id));
    let mut out = Document::new(format!(
        "{}: {}, {}",
        vendors.collect::<Vec<_>>().join(", "),
        pluralize(file.devices.len(), "device"),
        pluralize(file.modules.len(), "module"),
    ));
    out.gap();
    if file.devices.is_empty() {
        out.table(modules(file));
        return out;
    }
    let mut table = Table::new("type|product|revision|modes|mailbox|name");
    for device in &file.devices {
        let modes = offered_modes(file, device);
        let modes: Vec<&str> = modes.iter().map(|mode| mode.name()).collect();
        table.row(cells![
            device.type_name,
            hex32(device.identity.product),
            hex32(device.identity.revision),
            modes.join(" "),
            device
                .mailbox
                .as_ref()
                .map_or_else(String::new, head::protocols),
            device.name,
        ]);
    }
    out.table(table);
    out.heading("`--device TYPE` shows one of them.");
    out
}

/// Shows a file that only contains modules for devices of another file.
fn modules(file: &EsiFile) -> Table {
    let mut table = Table::new("module|identity|PDOs|name");
    for module in &file.modules {
        let pdos = module.rx_pdos.iter().chain(&module.tx_pdos);
        let pdos: Vec<String> = pdos.map(|pdo| hex16(pdo.index)).collect();
        let (ident, pdos) = (hex32(module.ident), pdos.join(" "));
        table.row(cells![module.type_name, ident, pdos, module.name]);
    }
    table
}
