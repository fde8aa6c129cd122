//! One configuration: SyncManagers, process data with offsets, start-up list.

use std::fmt::Write;

use ecaxis_esi::{Device, SelectOptions, Selection, SmUse};
use ecaxis_master::config::duration;

use crate::render::pdo_table::{fields, startup};
use crate::render::report::Table;

pub(super) fn write(
    device: &Device,
    selection: &Selection,
    choice: &SelectOptions<'_>,
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
    writeln!(out, "\n{}", table.shown(2))?;
    fields("outputs", layout.rx_bytes(), &layout.rx, out)?;
    fields("inputs", layout.tx_bytes(), &layout.tx, out)?;
    startup(&selection.startup, out)
}
