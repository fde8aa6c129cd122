//! The configuration of a device as JSON, for `esi show` and `explain`.

use ecaxis_esi::{Field, IdnValue, Mode, Selection, SmLayout, StartupIdn, StartupSdo};
use ecaxis_master::parameters::meaning::meaning;
use ecaxis_tools::document::format::hex_bytes;
use serde_json::{Value, json};

/// Returns the process data, the clock and the start-up SDOs of a device.
pub(crate) fn configuration(selection: &Selection, cycle_ns: u64) -> Value {
    let layout = &selection.layout;
    let sync_manager = |sm: &SmLayout| {
        json!({
            "sm": sm.sm, "address": sm.start_address, "bytes": sm.len, "control": sm.control(),
        })
    };
    let clock = selection
        .dc
        .as_ref()
        .map(|dc| json!({ "name": dc.name, "assign_activate": dc.assign_activate }));
    let mut shown = json!({
        "mode": selection.mode.map(Mode::name),
        "modules": selection.modules.iter().map(|m| &*m.type_name).collect::<Vec<_>>(),
        "cycle_ns": cycle_ns,
        "clock": clock,
        "output_sync_managers": layout.outputs.iter().map(sync_manager).collect::<Vec<_>>(),
        "input_sync_managers": layout.inputs.iter().map(sync_manager).collect::<Vec<_>>(),
        "outputs": layout.rx.iter().map(field).collect::<Vec<_>>(),
        "inputs": layout.tx.iter().map(field).collect::<Vec<_>>(),
        "output_bytes": layout.rx_bytes(),
        "input_bytes": layout.tx_bytes(),
        "startup": selection.startup.iter().map(sdo).collect::<Vec<_>>(),
        "notes": selection.notes,
    });
    if let (true, Some(shown)) = (layout.idns, shown.as_object_mut()) {
        let idns = selection.startup_idns.iter().map(idn);
        shown.insert("startup_idns".to_owned(), idns.collect());
    }
    shown
}

pub(crate) fn field(field: &Field) -> Value {
    json!({
        "pdo": field.pdo, "index": field.index, "sub": field.sub, "bit_offset": field.bit_offset,
        "bits": field.bit_len, "type": field.data_type, "name": field.name,
    })
}

fn idn(idn: &StartupIdn) -> Value {
    let (data, text) = match &idn.value {
        IdnValue::Bytes(bytes) => (Some(hex_bytes(&**bytes, "")), None),
        IdnValue::Text(text) => (None, Some(text)),
    };
    json!({
        "transition": idn.transition, "drive": idn.drive, "idn": idn.idn.to_string(),
        "name": idn.idn.name(), "data": data, "text": text, "from": idn.origin,
    })
}

fn sdo(sdo: &StartupSdo) -> Value {
    let text = meaning(sdo.index, sdo.sub, &sdo.data).filter(|_| !sdo.complete_access);
    json!({
        "transition": sdo.transition, "index": sdo.index, "sub": sdo.sub,
        "complete_access": sdo.complete_access, "data": hex_bytes(&*sdo.data, ""), "name": sdo.name,
        "text": text, "from": sdo.origin,
    })
}
