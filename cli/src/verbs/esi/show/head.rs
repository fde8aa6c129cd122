//! Identity, interfaces and mailbox protocols of a device.

use ecaxis_esi::{Device, EsiFile, Identification, Mailbox, PortKind, SmUse};
use ecaxis_tools::cells;
use ecaxis_tools::document::format::{hex32, names_of};
use ecaxis_tools::document::{Document, Table};

/// Returns a document with the identity.
pub(super) fn document(file: &EsiFile, device: &Device) -> Document {
    let mut out = Document::new(format!("{} {:?}", device.type_name, device.name));
    let id = device.identity;
    let vendor = format!("{} (0x{:08x})", file.vendor_name(id.vendor), id.vendor);
    let mut table = Table::new("");
    table.row(cells!["vendor", vendor]);
    table.row(cells!["product code", hex32(id.product)]);
    table.row(cells!["revision", hex32(id.revision)]);
    if let Some(profile) = device.profile {
        let meaning = match profile & 0xffff {
            402 => " (CiA 402 drive)",
            5001 => " (modular device)",
            _ => "",
        };
        table.row(cells!["profile", format!("{}{meaning}", profile & 0xffff)]);
    }
    if !device.hides.is_empty() {
        let hides = device.hides.iter().map(|hidden| match hidden.product {
            Some(product) if product != id.product => {
                format!("0x{:08x} of product 0x{product:08x}", hidden.revision)
            }
            _ => hex32(hidden.revision),
        });
        let hides: Vec<String> = hides.collect();
        table.row(cells!["stands for revision", hides.join(", ")]);
    }
    table.row(cells!["ports", ports(device)]);
    if let Some(mailbox) = &device.mailbox {
        table.row(cells!["mailbox", mailbox_text(device, mailbox)]);
    } else {
        table.row(cells!["mailbox", "none"]);
    }
    let info = &device.info;
    match info.identification {
        Identification::No => {}
        Identification::Reg134 => table.row(cells![
            "identification",
            "AL control bit 5, answer in 0x0134"
        ]),
        Identification::Ado(ado) => table.row(cells!["identification", format!("at 0x{ado:04x}")]),
    }
    if let Some(current) = info.ebus_current_ma {
        table.row(cells!["E-bus current", format!("{current} mA")]);
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
        table.row(cells!["time limits", times.join(", ")]);
    }
    table.row(cells!["line", device.position.line.to_string()]);
    out.table(table);
    out
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
        "unknown".to_owned()
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
        match names_of(&can, ", ") {
            none if none.is_empty() => {}
            can => text += &format!("; CoE allows {can}"),
        }
    }
    text
}

pub(super) fn protocols(mailbox: &Mailbox) -> String {
    let names = [
        (mailbox.coe.is_some(), "CoE"),
        (mailbox.foe, "FoE"),
        (mailbox.eoe.is_some(), "EoE"),
        (mailbox.soe.is_some(), "SoE"),
        (mailbox.aoe, "AoE"),
        (mailbox.voe, "VoE"),
    ];
    names_of(&names, " ")
}
