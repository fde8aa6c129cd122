//! One configuration: SyncManagers, process data with offsets, start-up list.

use ecaxis_esi::{Device, SelectOptions, Selection, SmUse};
use ecaxis_master::config::duration;
use ecaxis_tools::cells;
use ecaxis_tools::document::format::hex16;
use ecaxis_tools::document::{Document, Table};

use crate::render::pdo_table::{fields, startup};

pub(super) fn write(
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
    let layout = &selection.layout;
    let mut table = Table::new("SM|use|address|bytes|control");
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
        let (address, control) = (hex16(sm.start_address), format!("0x{control:02x}"));
        table.row(cells![number, usage, address, len, control]);
    }
    out.gap();
    out.table(table);
    fields("outputs", layout.rx_bytes(), &layout.rx, out);
    fields("inputs", layout.tx_bytes(), &layout.tx, out);
    startup(&selection.startup, out);
}
