//! The output of `show` as JSON.

use ecaxis_esi::{
    Device, EsiFile, Mode, Pdo, SelectError, SelectOptions, Selection, offered_modes,
};
use serde_json::{Value, json};

use super::{head, offers};
use crate::render::selection::{configuration, field};

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
        "type": device.type_name, "name": device.name, "vendor_name": file.vendor_name(device.identity.vendor),
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
