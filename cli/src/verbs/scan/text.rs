//! The result of a scan as text.

use ecaxis_axis::VelocityUnit;
use ecaxis_ecat::al_status_code::al_status_text;
use ecaxis_ecat::vendor::vendor_name;
use ecaxis_esi as esi;
use ecaxis_master::acyclic::topology;
use ecaxis_master::text::pluralize;
use ecaxis_tools::cells;
use ecaxis_tools::document::format::{hex16, hex32, names_of, or_dash};
use ecaxis_tools::document::{Document, Table};
use ecaxis_tools::scan::{CoeInfo, Device, EsiMatch};

use super::ScanResult;

/// Returns the type name from the ESI, else from the EEPROM.
pub(super) fn type_name(device: &Device, described: Option<&EsiMatch>) -> String {
    if let Some(described) = described {
        return described.device.type_name.clone();
    }
    device.own_name().unwrap_or_else(|| "?".to_owned())
}

pub(super) fn is_drive(device: &Device, described: Option<&EsiMatch>) -> bool {
    device.says_drive() || described.is_some_and(EsiMatch::is_drive)
}

fn hex(number: Option<u32>) -> String {
    number.map_or_else(|| "?".to_owned(), hex32)
}

pub(super) fn document(seen: &ScanResult) -> Document {
    let count = pluralize(seen.scan.devices.len(), "SubDevice");
    let mut out = Document::new(format!("{count} on `{}`", seen.nic));
    let mut identities = Table::new("pos|type|vendor|product|revision|serial|state");
    let mut places = Table::new("pos|address|alias|id|at|open ports|delay|clock|mailbox");
    let mut descriptions = Table::new("pos|ESI file|revision|out|in|axis");
    let mut answers = Table::new("pos|name|hardware|software|modules");
    let mut gateways = Table::new("pos|gateway inputs|gateway outputs|status word|node in error");
    let mut drives =
        Table::new("pos|modes|counts/turn|velocity in|position range|speed|torque|window");
    for (device, described) in seen.devices() {
        identities.row(identity(device, described));
        places.row(place(device));
        descriptions.row(description(device, described));
        if let Some(Ok(info)) = &device.answers {
            answers.row(cells![
                device.position(),
                or_dash(info.name.as_ref()),
                or_dash(info.hardware.as_ref()),
                or_dash(info.software.as_ref()),
                or_dash(modules(info, described)),
            ]);
            drives_row(device, info, &mut drives);
            if let Some(gateway) = &info.gateway {
                let node = Some(gateway.error_node).filter(|node| *node != 0);
                gateways.row(cells![
                    device.position(),
                    format!("{} B", gateway.inputs),
                    format!("{} B", gateway.outputs),
                    format!("0x{:02x}", gateway.status),
                    node.map_or_else(|| "-".to_owned(), |node| node.to_string()),
                ]);
            }
        }
    }
    out.gap();
    out.table(identities);
    out.vendors(seen.devices().filter_map(|(device, esi)| {
        let id = device.identity()?.vendor;
        Some((id, vendor(esi, id)?))
    }));
    out.gap();
    for table in [places, descriptions, answers, gateways] {
        out.table(table);
    }
    if !drives.is_empty() {
        out.table(drives);
        out.line(
            "ranges and windows in counts; 0x6502, 0x608F, 0x60A9, 0x607D, 0x6080, 0x6072, 0x6065",
        );
    }
    notes(seen, &mut out);
    out
}

fn identity(device: &Device, esi: Option<&EsiMatch>) -> [String; 7] {
    let identity = device.identity();
    let error = if device.found.error { " + error" } else { "" };
    cells![
        device.position(),
        type_name(device, esi),
        hex(identity.map(|i| i.vendor)),
        hex(identity.map(|i| i.product)),
        hex(identity.map(|i| i.revision)),
        or_dash(device.serial().filter(|serial| *serial != 0)),
        format!("{}{error}", device.found.state),
    ]
}

/// Returns the name of a vendor: from its ESI file, else from the table.
pub(super) fn vendor(esi: Option<&EsiMatch>, id: u32) -> Option<&str> {
    let from_file = esi.filter(|esi| esi.path.is_some());
    let from_file = from_file.map(|esi| esi.file.vendor_name(id));
    from_file
        .filter(|name| !name.is_empty())
        .or_else(|| vendor_name(id))
}

fn place(device: &Device) -> [String; 9] {
    let open = topology::open_ports(device.found.dl_status);
    let open: Vec<(bool, &str)> = open.into_iter().zip(["0", "1", "2", "3"]).collect();
    let protocols = Some(device.protocols().join(" "));
    let clock = device.dc.then(|| device.controller.clock_bits());
    cells![
        device.position(),
        hex16(device.found.station),
        or_dash((device.found.alias != 0).then_some(device.found.alias)),
        or_dash(device.id),
        or_dash(device.uplink.map(|u| format!("{}:{}", u.device, u.port))),
        names_of(&open, " "),
        or_dash(device.delay_ns.map(|ns| format!("{ns} ns"))),
        or_dash(clock.map(|bits| format!("{bits} bit"))),
        or_dash(protocols.filter(|names| !names.is_empty())),
    ]
}

fn description(device: &Device, described: Option<&EsiMatch>) -> [String; 6] {
    let both = described.and_then(EsiMatch::default_bytes);
    let file = described.and_then(|d| d.path.as_ref()?.file_name());
    let file = file.map(|name| name.to_string_lossy());
    cells![
        device.position(),
        file.unwrap_or("none".into()),
        or_dash(described.map(|d| fit(device, d))),
        or_dash(both.map(|(out, _)| format!("{out} B"))),
        or_dash(both.map(|(_, inp)| format!("{inp} B"))),
        axis(device, described),
    ]
}

fn drives_row(device: &Device, info: &CoeInfo, table: &mut Table) {
    let Some(drive) = &info.drive else { return };
    let velocity = |code| match VelocityUnit::from_si_code(code) {
        Some(unit) => unit.to_string(),
        None => hex32(code),
    };
    let torque = drive.max_torque.map(f64::from);
    table.row(cells![
        device.position(),
        or_dash(drive.supported_modes.map(mode_names)),
        or_dash(drive.units.counts_per_turn().map(|(_, counts)| counts)),
        or_dash(drive.units.velocity_unit.map(velocity)),
        or_dash(drive.software_limits.map(range)),
        or_dash(drive.max_motor_speed.map(|rpm| format!("{rpm} rpm"))),
        or_dash(torque.map(|n| format!("{} %", n / 10.0))),
        or_dash(drive.following_window),
    ]);
}

/// Formats a position range. The full 32-bit range means no limits.
fn range([low, high]: [i32; 2]) -> String {
    match i64::from(high) - i64::from(low) {
        wide if wide >= i64::from(i32::MAX) => "no ends".to_owned(),
        _ => format!("{low} to {high}"),
    }
}

/// Formats the detected modules, else the configured ones, by name if the ESI describes them.
fn modules(answers: &CoeInfo, described: Option<&EsiMatch>) -> Option<String> {
    let lists = [&answers.detected, &answers.configured];
    let plugged = |idents: &&Vec<u32>| idents.iter().any(|ident| *ident != 0);
    let idents = lists.into_iter().flatten().find(plugged)?;
    let modules = described.map_or(&[][..], |described| &described.file.modules);
    Some(esi::module_names(modules, idents).join(" "))
}

/// Formats 0x6502 (CiA 402-2, supported drive modes).
fn mode_names(bits: u32) -> String {
    const NAMES: [(u32, &str); 10] = [
        (0, "pp"),
        (1, "vl"),
        (2, "pv"),
        (3, "tq"),
        (5, "hm"),
        (6, "ip"),
        (7, "csp"),
        (8, "csv"),
        (9, "cst"),
        (10, "cstca"),
    ];
    let names = NAMES.map(|(bit, name)| (bits >> bit & 1 != 0, name));
    match names_of(&names, " ") {
        none if none.is_empty() => format!("0x{bits:08x}"),
        names => names,
    }
}

/// Formats the ESI's revision and whether it fits the device.
fn fit(device: &Device, described: &EsiMatch) -> String {
    let ours = described.device.identity.revision;
    let theirs = device.identity().map_or(ours, |i| i.revision);
    match theirs.cmp(&ours) {
        std::cmp::Ordering::Equal => "the same".to_owned(),
        std::cmp::Ordering::Greater => format!("0x{ours:08x}, older"),
        std::cmp::Ordering::Less => format!("0x{ours:08x}, newer"),
    }
}

fn axis(device: &Device, described: Option<&EsiMatch>) -> String {
    if !is_drive(device, described) {
        return "-".to_owned();
    }
    let modes = described.map(|d| esi::offered_modes(&d.file, &d.device));
    let modes: Vec<&str> = modes.iter().flatten().map(|mode| mode.name()).collect();
    match modes.is_empty() {
        true => "CiA 402".to_owned(),
        false => modes.join(" "),
    }
}

/// Adds remarks that need more than a table cell.
fn notes(seen: &ScanResult, out: &mut Document) {
    let wrong = seen.scan.devices.iter().filter(|d| d.found.error);
    out.gap();
    for device in wrong {
        let (position, state, code) = (device.position(), device.found.state, device.found.code);
        let text = al_status_text(code);
        out.line(format!(
            "position {position}: in {state} with AL status code 0x{code:04x}: {text}"
        ));
    }
    if !seen.scan.measured && seen.scan.devices.iter().any(|d| d.delay_ns.is_some()) {
        out.line("delays are those that the other master wrote (0x0928)");
    }
}

/// Draws the topology from port to port.
pub(super) fn tree(seen: &ScanResult) -> String {
    let mut text = format!("{}\n", seen.nic);
    // Devices are in segment order, which is a depth-first walk. Lines are therefore known from the
    // rows above.
    let parent = |n: usize| {
        let device = seen.scan.devices.get(n)?;
        device.uplink.map(|u| usize::from(u.device))
    };
    let count = seen.scan.devices.len();
    for (n, (device, described)) in seen.devices().enumerate() {
        let mut branches = Vec::new();
        let mut at = Some(n);
        // The depth never exceeds the number of devices.
        for _ in 0..=count {
            let Some(here) = at else { break };
            let up = parent(here);
            let last = !(here + 1..count).any(|later| parent(later) == up);
            branches.push(last);
            at = up;
        }
        let mut line = String::new();
        for last in branches.iter().skip(1).rev() {
            line += if *last { "   " } else { "│  " };
        }
        line += match branches.first() {
            Some(false) => "├─ ",
            _ => "└─ ",
        };
        if let Some(uplink) = device.uplink {
            line += &format!("port {}: ", uplink.port);
        }
        line += &format!("{} {}", device.position(), type_name(device, described));
        let mut facts = vec![device.found.state.to_string()];
        if device.found.alias != 0 {
            facts.push(format!("alias {}", device.found.alias));
        }
        facts.extend(device.delay_ns.map(|ns| format!("{ns} ns")));
        if is_drive(device, described) {
            facts.push("axis".to_owned());
        }
        if let Some(Ok(answers)) = &device.answers {
            let software = answers.software.as_ref();
            facts.extend(software.map(|version| format!("software {version}")));
            facts.extend(modules(answers, described).map(|names| format!("modules {names}")));
        }
        text += &format!("{line} ({})\n", facts.join(", "));
    }
    text
}
