//! Formats a device and its software.

use ecaxis_ecat::vendor::VendorId;
use ecaxis_tools::cells;
use ecaxis_tools::document::format::{hex32, or_dash};
use ecaxis_tools::document::{Document, Table};
use ecaxis_tools::firmware::{CoeIdentity, DeviceIdentity, RunningProgram, UpdateMethod};
use serde_json::{Value, json};

const WAYS: [(UpdateMethod, &str); 2] = [
    (UpdateMethod::Foe, "foe"),
    (UpdateMethod::Program, "program"),
];

/// A property that depends on the program: its name and its value.
type Row = (&'static str, fn(&DeviceIdentity) -> Option<String>);

const VERSION: [Row; 7] = [
    ("product (0x1018:02)", |e| spoken(e)?.identity[1].map(hex32)),
    ("revision (0x1018:03)", |e| {
        spoken(e)?.identity[2].map(hex32)
    }),
    ("revision (EEPROM)", |e| {
        (!e.in_use).then(|| hex32(e.sii.identity.revision))
    }),
    ("device type (0x1000)", |e| {
        spoken(e)?.device_type.map(hex32)
    }),
    ("software version (0x100A)", |e| spoken(e)?.software.clone()),
    ("software identification (0x1F56)", |e| {
        spoken(e)?.identification.map(hex32)
    }),
    ("program control (0x1F51)", |e| {
        spoken(e)?.control.map(|value| match value {
            0 => "0 (stopped)".to_owned(),
            1 => "1 (started)".to_owned(),
            other => other.to_string(),
        })
    }),
];

fn spoken(examined: &DeviceIdentity) -> Option<&CoeIdentity> {
    examined.spoken.as_ref()
}

/// Adds the properties before and after an update.
pub(super) fn change(before: &DeviceIdentity, now: &DeviceIdentity, out: &mut Document) {
    let mut table = Table::new("|before|now");
    for (what, of) in VERSION {
        let (before, now) = (of(before), of(now));
        if before.is_some() || now.is_some() {
            table.row(cells![what, or_dash(before), or_dash(now)]);
        }
    }
    out.table(table);
    if VERSION.iter().all(|(_, of)| of(before) == of(now)) {
        out.line("It reports the same versions as before.");
    }
}

/// Returns all known properties.
pub(super) fn info(examined: &DeviceIdentity) -> Document {
    let identity = examined.sii.identity;
    let mut table = Table::new("");
    let mut row = |what: &str, value: &str| table.row(cells![what, value]);
    row("state", &state(examined));
    let runs = match examined.runs() {
        RunningProgram::Program => "its program",
        RunningProgram::BootLoader => "its boot loader alone",
        RunningProgram::Unknown => "not known",
    };
    row("what runs", runs);
    if examined.in_use {
        row("EEPROM", "left to the device, which is using it");
    } else {
        row("vendor (EEPROM)", &VendorId(identity.vendor).to_string());
        row("product (EEPROM)", &hex32(identity.product));
        row("serial number (EEPROM)", &examined.sii.serial.to_string());
    }
    if let Some(CoeIdentity { name, hardware, .. }) = spoken(examined) {
        let texts = [
            ("device name (0x1008)", name),
            ("hardware version (0x1009)", hardware),
        ];
        for (what, text) in texts {
            text.iter().for_each(|text| row(what, text));
        }
    }
    for (what, of) in VERSION {
        of(examined).iter().for_each(|value| row(what, value));
    }
    for (via, _) in WAYS {
        let offered = match examined.offers(via) {
            Ok(()) if examined.in_use => "not known: its EEPROM says it".to_owned(),
            Ok(()) if via == UpdateMethod::Foe => {
                let boot = examined.sii.bootstrap;
                let (out, back) = (boot.receive_size, boot.send_size);
                format!("yes, mailboxes of {out} and {back} bytes")
            }
            Ok(()) if examined.spoken.is_none() => {
                "not known: it does not speak in this state".to_owned()
            }
            Ok(()) => "yes".to_owned(),
            Err(reason) => format!("no: {reason}"),
        };
        row(&via.to_string(), &offered);
    }
    let mut out = Document::new(examined.device.to_string());
    out.table(table);
    if let Some(silent) = &examined.silent {
        out.line(format!("It does not speak: {silent}"));
    }
    out
}

fn state(examined: &DeviceIdentity) -> String {
    let mut text = examined.state.to_string();
    if examined.error {
        let code = examined.code;
        let meaning = ecaxis_ecat::al_status_code::al_status_text(code);
        text += &format!(", AL status code 0x{code:04x}: {meaning}");
    }
    text
}

/// Formats the properties as JSON.
pub(super) fn as_json(examined: &DeviceIdentity) -> Value {
    let identity = examined.sii.identity;
    let spoken = spoken(examined);
    // The EEPROM is unknown if it is in use by another owner.
    let known = !examined.in_use;
    let offers = known.then(|| -> Vec<&str> {
        let offered = WAYS.into_iter();
        let offered = offered.filter(|(via, _)| examined.offers(*via).is_ok());
        offered.map(|(_, name)| name).collect()
    });
    let [vendor, product, revision, serial] = spoken.map_or([None; 4], |s| s.identity);
    json!({
        "name": examined.device.name,
        "position": examined.device.position,
        "station": examined.device.station,
        "state": examined.state.to_string(),
        "al_status_code": examined.error.then_some(examined.code),
        "runs": match examined.runs() {
            RunningProgram::Program => "program",
            RunningProgram::BootLoader => "boot-loader",
            RunningProgram::Unknown => "unknown",
        },
        "eeprom": known.then(|| json!({
            "vendor": identity.vendor,
            "product": identity.product,
            "revision": identity.revision,
            "serial": examined.sii.serial,
        })),
        "identity": {
            "vendor": vendor,
            "product": product,
            "revision": revision,
            "serial": serial,
        },
        "device_type": spoken.and_then(|s| s.device_type),
        "device_name": spoken.and_then(|s| s.name.clone()),
        "hardware_version": spoken.and_then(|s| s.hardware.clone()),
        "software_version": spoken.and_then(|s| s.software.clone()),
        "program_control": spoken.and_then(|s| s.control),
        "software_identification": spoken.and_then(|s| s.identification),
        "offers": offers,
        "silent": examined.silent.as_ref().map(ToString::to_string),
    })
}

/// Returns the method's name as used by `--via`.
pub(super) fn name(via: UpdateMethod) -> &'static str {
    WAYS.iter()
        .find(|(known, _)| *known == via)
        .map_or("", |(_, name)| name)
}
