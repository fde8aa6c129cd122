//! The derived configuration as JSON.

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_master::config::Machine;
use ecaxis_master::rt::image;
use serde_json::{Value, json};

use crate::render::selection::configuration;

/// Returns the machine with all its devices, or with one of them.
pub(super) fn machine(machine: &Machine, only: Option<DeviceIndex>) -> Value {
    let shown = machine.devices.indices();
    let shown = shown.filter(|index| only.is_none_or(|only| only == *index));
    let plan = image::of(&machine.rt_config());
    json!({
        "file": machine.path.display().to_string(),
        "sha256": machine.sha256.to_string(),
        "cycle_ns": machine.bus.cycle_ns,
        "image_bytes": plan.as_ref().ok().map(|plan| plan.len),
        "frames": plan.as_ref().ok().map(|plan| plan.frames()),
        "devices": shown.map(|index| device(machine, index)).collect::<Value>(),
    })
}

fn device(machine: &Machine, index: DeviceIndex) -> Value {
    let device = &machine.devices[index];
    let (selection, identity) = (&device.selection, device.selection.identity);
    let axes = machine.axes_of(index).map(|(_, axis)| {
        json!({
            "name": axis.name, "number": axis.number + 1, "unit": axis.unit,
            "counts_per_unit": axis.config.scale.counts_per_unit(),
            "limits": {
                "position": axis.config.limits.position,
                "velocity": axis.config.limits.velocity,
                "acceleration": axis.config.limits.acceleration,
                "jerk": axis.config.limits.jerk(),
                "torque_percent": axis.config.limits.torque,
                "following_error": axis.config.limits.following_error,
            },
        })
    });
    json!({
        "name": device.name,
        "at": device.at.to_string(),
        "line": device.line,
        "esi": device.esi_path.display().to_string(),
        "type": device.device.type_name,
        "vendor": identity.vendor,
        "vendor_name": ecaxis_ecat::vendor::vendor_name(identity.vendor),
        "product": identity.product,
        "revision": identity.revision,
        "axes": axes.collect::<Value>(),
        "configuration": configuration(selection, machine.bus.cycle_ns),
    })
}
