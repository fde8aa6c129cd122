//! The output of `show` as JSON.

use ecaxis_esi::{
    Device, EsiFile, Field, Mode, Pdo, SelectError, SelectOptions, Selection, SmLayout, StartupSdo,
    offered_modes,
};
use ecaxis_tools::document::format::hex_bytes;
use serde_json::{Value, json};

use super::{head, offers};

/// Returns a summary of the devices in a file.
pub(super) fn devices(file: &EsiFile) -> Value {
    let devices: Vec<Value> = file
        .devices
        .iter()
        .map(|device| {
            let mut value = identity(file, device);
            let modes = offered_modes(file, device);
            let modes: Vec<&str> = modes.iter().map(|mode| mode.name()).collect();
            value["modes"] = json!(modes);
            value
        })
        .collect();
    json!({ "devices": devices })
}

pub(super) fn device(
    file: &EsiFile,
    device: &Device,
    choice: &SelectOptions<'_>,
    selection: &Result<Selection, SelectError>,
) -> Value {
    let mut value = identity(file, device);
    value["line"] = json!(device.position.line);
    value["profile"] = json!(device.profile.map(|profile| profile & 0xffff));
    value["sync_managers"] = device
        .sync_managers
        .iter()
        .map(|sm| {
            json!({
                "use": format!("{:?}", sm.usage), "address": sm.start_address,
                "bytes": sm.default_size, "control": sm.control_byte,
            })
        })
        .collect();
    value["modes"] = offers::by_mode(file, device, choice)
        .iter()
        .map(|(mode, selection)| by_mode(*mode, selection))
        .collect();
    value["clock_modes"] = device
        .dc_modes
        .iter()
        .map(|mode| {
            json!({
                "name": mode.name, "meaning": mode.description,
                "assign_activate": mode.assign_activate,
            })
        })
        .collect();
    let assignments = device.sm_mappings.iter();
    value["assignments"] = assignments
        .map(|mapping| json!({ "name": mapping.name, "default": mapping.default }))
        .collect();
    let pdos = device.rx_pdos.iter().chain(&device.tx_pdos);
    value["pdos"] = pdos.map(pdo).collect();
    match selection {
        Ok(selection) => value["configuration"] = configuration(selection, choice.cycle_ns),
        Err(error) => value["error"] = json!(error.to_string()),
    }
    value
}

fn identity(file: &EsiFile, device: &Device) -> Value {
    json!({
        "type": device.type_name, "name": device.name, "vendor_name": file.vendor.name,
        "vendor": device.identity.vendor, "product": device.identity.product,
        "revision": device.identity.revision,
        "mailbox": device.mailbox.as_ref().map_or_else(String::new, head::protocols),
    })
}

fn by_mode(mode: Mode, selection: &Result<Selection, SelectError>) -> Value {
    let mut value = json!({ "mode": mode.name(), "code": mode.code() });
    match selection {
        Ok(selection) => {
            value["modules"] = selection.modules.iter().map(|m| &*m.type_name).collect();
            value["outputs"] = selection.layout.rx.iter().map(field).collect();
            value["inputs"] = selection.layout.tx.iter().map(field).collect();
        }
        Err(error) => value["error"] = json!(error.to_string()),
    }
    value
}

fn pdo(pdo: &Pdo) -> Value {
    let entries = pdo.entries.iter().map(|entry| {
        json!({
            "index": entry.index, "sub": entry.sub, "bits": entry.bit_len,
            "type": &*entry.data_type, "name": &*entry.name,
        })
    });
    json!({
        "index": pdo.index, "name": pdo.name, "direction": format!("{:?}", pdo.direction).to_lowercase(),
        "sm": pdo.sm, "bits": pdo.bit_len(), "fixed": pdo.fixed, "mandatory": pdo.mandatory,
        "entries": entries.collect::<Vec<_>>(),
    })
}

fn configuration(selection: &Selection, cycle_ns: u64) -> Value {
    let layout = &selection.layout;
    let sync_manager = |sm: &SmLayout| {
        json!({
            "sm": sm.sm, "address": sm.start_address, "bytes": sm.len, "control": sm.control_byte,
        })
    };
    let clock = selection
        .dc
        .as_ref()
        .map(|dc| json!({ "name": dc.name, "assign_activate": dc.assign_activate }));
    json!({
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
    })
}

fn field(field: &Field) -> Value {
    json!({
        "pdo": field.pdo, "index": field.index, "sub": field.sub, "bit_offset": field.bit_offset,
        "bits": field.bit_len, "type": field.data_type, "name": field.name,
    })
}

fn sdo(sdo: &StartupSdo) -> Value {
    json!({
        "transition": sdo.transition, "index": sdo.index, "sub": sdo.sub,
        "complete_access": sdo.complete_access, "data": hex_bytes(&*sdo.data, ""), "name": sdo.name,
        "from": sdo.origin,
    })
}
