//! The result of a scan as text.

use ecaxis_axis::VelocityUnit;
use ecaxis_ecat::al_status_code::al_status_text;
use ecaxis_esi as esi;
use ecaxis_master::acyclic::topology;
use ecaxis_tools::scan::{CoeInfo, Device, EsiMatch};

use super::ScanResult;
use crate::render::table::Table;

/// The page width for tables with long cells.
const PAGE: usize = 80;

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
    number.map_or_else(|| "?".to_owned(), |number| format!("0x{number:08x}"))
}

fn or_dash<T: ToString>(value: Option<T>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| value.to_string())
}

pub(super) fn tables(seen: &ScanResult) -> String {
    let mut text = head(seen);
    for table in [identities(seen), places(seen), descriptions(seen)] {
        text += &format!("\n{}\n", table.shown(2));
    }
    if seen.scan.asked {
        text += &asked(seen);
    }
    text + &notes(seen)
}

fn head(seen: &ScanResult) -> String {
    match seen.scan.devices.len() {
        1 => format!("1 SubDevice on `{}`\n", seen.nic),
        n => format!("{n} SubDevices on `{}`\n", seen.nic),
    }
}

fn identities(seen: &ScanResult) -> Table {
    let head = [
        "pos", "type", "vendor", "product", "revision", "serial", "state",
    ];
    let mut table = Table::new(&head);
    for (device, esi) in seen.devices() {
        let identity = device.identity();
        let error = if device.found.error { " + error" } else { "" };
        table.row([
            &device.position().to_string(),
            &type_name(device, esi),
            &hex(identity.map(|i| i.vendor)),
            &hex(identity.map(|i| i.product)),
            &hex(identity.map(|i| i.revision)),
            &or_dash(device.serial().filter(|serial| *serial != 0)),
            &format!("{}{error}", device.found.state),
        ]);
    }
    table
}

fn places(seen: &ScanResult) -> Table {
    let head = [
        "pos",
        "address",
        "alias",
        "id",
        "at",
        "open ports",
        "delay",
        "clock",
        "mailbox",
    ];
    let mut table = Table::new(&head);
    for (device, _) in seen.devices() {
        let open = topology::open_ports(device.found.dl_status);
        let open: Vec<String> = (0..)
            .zip(open)
            .filter(|(_, open)| *open)
            .map(|(n, _): (u8, bool)| n.to_string())
            .collect();
        let at = device.uplink.map(|u| format!("{}:{}", u.device, u.port));
        let protocols = device.protocols();
        let clock = device.dc.then(|| device.controller.clock_bits());
        table.row([
            &device.position().to_string(),
            &format!("0x{:04x}", device.found.station),
            &or_dash((device.found.alias != 0).then_some(device.found.alias)),
            &or_dash(device.id),
            &or_dash(at),
            &open.join(" "),
            &or_dash(device.delay_ns.map(|ns| format!("{ns} ns"))),
            &or_dash(clock.map(|bits| format!("{bits} bit"))),
            &match protocols.is_empty() {
                true => "-".to_owned(),
                false => protocols.join(" "),
            },
        ]);
    }
    table
}

fn descriptions(seen: &ScanResult) -> Table {
    let mut table = Table::new(&["pos", "ESI file", "revision", "out", "in", "axis"]);
    for (device, described) in seen.devices() {
        let both = described.and_then(EsiMatch::default_bytes);
        let file = described.map(|d| {
            let name = d.path.file_name().unwrap_or_default();
            name.to_string_lossy().into_owned()
        });
        table.row([
            &device.position().to_string(),
            &file.unwrap_or_else(|| "none".to_owned()),
            &or_dash(described.map(|d| fit(device, d))),
            &or_dash(both.map(|(out, _)| format!("{out} B"))),
            &or_dash(both.map(|(_, inp)| format!("{inp} B"))),
            &axis(device, described),
        ]);
    }
    table
}

/// Formats the answers of the mailboxes.
fn asked(seen: &ScanResult) -> String {
    let mut all = Table::new(&["pos", "name", "hardware", "software", "modules"]);
    let mut drives = Table::new(&[
        "pos",
        "modes",
        "counts/turn",
        "velocity in",
        "position range",
        "speed",
        "torque",
        "window",
    ]);
    let (mut some, mut any_drive) = (false, false);
    for (device, described) in seen.devices() {
        let Some(Ok(answers)) = &device.answers else {
            continue;
        };
        some = true;
        let position = device.position().to_string();
        all.row([
            &position,
            &or_dash(answers.name.clone()),
            &or_dash(answers.hardware.clone()),
            &or_dash(answers.software.clone()),
            &or_dash(modules(answers, described)),
        ]);
        let Some(drive) = &answers.drive else {
            continue;
        };
        any_drive = true;
        let counts = drive.units.counts_per_turn().map(|(_, counts)| counts);
        let velocity = drive.units.velocity_unit;
        drives.row([
            &position,
            &or_dash(drive.supported_modes.map(mode_names)),
            &or_dash(counts),
            &or_dash(velocity.map(|code| match VelocityUnit::from_si_code(code) {
                Some(unit) => unit.to_string(),
                None => format!("0x{code:08x}"),
            })),
            &or_dash(drive.software_limits.map(range)),
            &or_dash(drive.max_motor_speed.map(|rpm| format!("{rpm} rpm"))),
            &or_dash(
                drive
                    .max_torque
                    .map(|n| format!("{} %", f64::from(n) / 10.0)),
            ),
            &or_dash(drive.following_window),
        ]);
    }
    let mut text = String::new();
    if some {
        text += &format!("\n{}\n", all.within(2, PAGE));
    }
    if any_drive {
        text += &format!(
            "\n{}\n  ranges and windows in counts; 0x6502, 0x608F, 0x60A9, 0x607D, 0x6080, 0x6072,\n  0x6065\n",
            drives.within(2, PAGE)
        );
    }
    text
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
    let end = idents.iter().rposition(|ident| *ident != 0)?;
    let known = |ident: u32| {
        let mut modules = described.into_iter().flat_map(|d| &d.file.modules);
        modules.find(|module| module.ident == ident)
    };
    let names = idents
        .iter()
        .take(end + 1)
        .map(|ident| match known(*ident) {
            _ if *ident == 0 => "-".to_owned(),
            Some(module) => module.type_name.to_string(),
            None => format!("0x{ident:08x}"),
        });
    Some(names.collect::<Vec<_>>().join(" "))
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
    let named = NAMES.iter().filter(|(bit, _)| bits >> bit & 1 != 0);
    let names: Vec<&str> = named.map(|(_, name)| *name).collect();
    match names.is_empty() {
        true => format!("0x{bits:08x}"),
        false => names.join(" "),
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

/// Formats remarks that need more than a table cell.
fn notes(seen: &ScanResult) -> String {
    let mut text = String::new();
    for device in seen.scan.devices.iter().filter(|d| d.found.error) {
        let (position, found) = (device.position(), &device.found);
        text += &format!(
            "  position {position}: in {} with AL status code 0x{:04x}: {}\n",
            found.state,
            found.code,
            al_status_text(found.code)
        );
    }
    if !seen.scan.measured && seen.scan.devices.iter().any(|d| d.delay_ns.is_some()) {
        text += "  delays are those that the other master wrote (0x0928)\n";
    }
    if text.is_empty() {
        text
    } else {
        format!("\n{text}")
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
