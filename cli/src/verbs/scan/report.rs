//! The result of a scan as JSON.

use ecaxis_esi as esi;
use ecaxis_master::acyclic::topology;
use ecaxis_tools::scan::{CoeInfo, Device, DriveInfo, EsiMatch};
use serde_json::{Value, json};

use super::ScanResult;

pub(super) fn json(seen: &ScanResult) -> Value {
    let devices: Vec<Value> = seen.devices().map(|(d, esi)| device(d, esi)).collect();
    let others: Vec<Value> = seen
        .scan
        .others
        .iter()
        .map(|sign| json!({ "sign": sign.to_string(), "live": sign.is_live() }))
        .collect();
    json!({
        "nic": seen.nic,
        "other_master": !others.is_empty(),
        "signs": others,
        "asked": seen.scan.asked,
        "delays_measured": seen.scan.measured,
        "devices": devices,
    })
}

fn device(device: &Device, described: Option<&EsiMatch>) -> Value {
    let found = &device.found;
    let sii = device.sii.as_ref().ok();
    let ports: Vec<Value> = topology::ports(device.found.dl_status)
        .iter()
        .zip(device.controller.ports)
        .map(|(port, kind)| json!({ "kind": kind.to_string(), "link": port.link, "open": port.open }))
        .collect();
    let answers = match &device.answers {
        Some(Ok(answers)) => Some(self::answers(answers)),
        _ => None,
    };
    json!({
        "position": found.position,
        "station": found.station,
        "alias": found.alias,
        "id": device.id,
        "state": found.state.to_string(),
        "error": found.error,
        "al_status_code": found.code,
        "al_status": ecaxis_ecat::al_status_code::al_status_text(found.code),
        "vendor": sii.map(|s| s.identity.vendor),
        "vendor_name": sii.and_then(|s| super::text::vendor(described, s.identity.vendor)),
        "product": sii.map(|s| s.identity.product),
        "revision": sii.map(|s| s.identity.revision),
        "serial": sii.map(|s| s.serial),
        "name": super::text::type_name(device, described),
        "eeprom": device.sii.as_ref().err(),
        "controller": {
            "type": device.controller.kind,
            "revision": device.controller.revision,
            "build": device.controller.build,
            "fmmus": device.controller.fmmus,
            "sync_managers": device.controller.sync_managers,
            "ram_kib": device.controller.ram_kib,
            "lrw": device.controller.knows_lrw(),
        },
        "ports": ports,
        "parent": device.uplink.map(|u| json!({ "position": u.device, "port": u.port })),
        "delay_ns": device.delay_ns,
        "dc": device.dc.then(|| json!({ "bits": device.controller.clock_bits() })),
        "mailbox": device.protocols(),
        "drive": super::text::is_drive(device, described),
        "esi": described.map(self::described),
        "answers": answers,
        "no_answer": match &device.answers { Some(Err(problem)) => Some(problem), _ => None },
    })
}

fn described(described: &EsiMatch) -> Value {
    let bytes = described.default_bytes();
    let modes = esi::offered_modes(&described.file, &described.device);
    json!({
        "file": described.path.as_ref().map(|path| path.display().to_string()),
        "type": described.device.type_name,
        "name": described.device.name,
        "revision": described.device.identity.revision,
        "fits": described.rule.to_string(),
        "default_bytes": bytes.map(|(out, inp)| json!({ "outputs": out, "inputs": inp })),
        "modes": modes.iter().map(|m| m.name()).collect::<Vec<_>>(),
    })
}

fn answers(answers: &CoeInfo) -> Value {
    json!({
        "device_type": answers.device_type,
        "name": answers.name,
        "hardware": answers.hardware,
        "software": answers.software,
        "modules": { "configured": answers.configured, "detected": answers.detected },
        "drive": answers.drive.as_ref().map(drive),
        "gateway": answers.gateway.map(|gateway| json!({
            "inputs": gateway.inputs,
            "outputs": gateway.outputs,
            "status": gateway.status,
            "error_node": gateway.error_node,
        })),
    })
}

fn drive(drive: &DriveInfo) -> Value {
    let units = &drive.units;
    json!({
        "encoder_resolution": units.encoder_resolution,
        "gear_ratio": units.gear_ratio,
        "feed_constant": units.feed_constant,
        "position_unit": units.position_unit,
        "velocity_unit": units.velocity_unit,
        "acceleration_unit": units.acceleration_unit,
        "rated_torque": units.rated_torque,
        "torque_constant": units.torque_constant,
        "polarity": units.polarity,
        "sensor_resolution": drive.sensor_resolution,
        "supported_modes": drive.supported_modes,
        "following_window": drive.following_window,
        "software_limits": drive.software_limits,
        "max_profile_velocity": drive.max_profile_velocity,
        "max_motor_speed": drive.max_motor_speed,
        "max_torque": drive.max_torque,
        "max_acceleration": drive.max_acceleration,
        "max_deceleration": drive.max_deceleration,
    })
}
