//! What was found, for people.

use ecaxis::al_status::al_status_text;
use ecaxis::scan::{Described, Device, registers};
use ecaxis_esi as esi;

use super::super::table::Table;
use super::Seen;

/// As its ESI or its EEPROM calls it.
pub(super) fn type_name(device: &Device, described: Option<&Described>) -> String {
    if let Some(described) = described {
        return described.device.type_name.clone();
    }
    device.own_name().unwrap_or_else(|| "?".to_owned())
}

pub(super) fn is_drive(device: &Device, described: Option<&Described>) -> bool {
    device.says_drive() || described.is_some_and(Described::is_drive)
}

fn hex(number: Option<u32>) -> String {
    number.map_or_else(|| "?".to_owned(), |number| format!("0x{number:08x}"))
}

fn or_dash<T: ToString>(value: Option<T>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| value.to_string())
}

pub(super) fn tables(seen: &Seen) -> String {
    let mut text = head(seen);
    for table in [identities(seen), places(seen), descriptions(seen)] {
        text += &format!("\n{}\n", table.shown(2));
    }
    text + &notes(seen)
}

fn head(seen: &Seen) -> String {
    match seen.scan.devices.len() {
        1 => format!("1 SubDevice on `{}`\n", seen.nic),
        n => format!("{n} SubDevices on `{}`\n", seen.nic),
    }
}

fn identities(seen: &Seen) -> Table {
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

fn places(seen: &Seen) -> Table {
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
        let open = registers::open_ports(device.dl_status);
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

fn descriptions(seen: &Seen) -> Table {
    let mut table = Table::new(&["pos", "ESI file", "revision", "out", "in", "axis"]);
    for (device, described) in seen.devices() {
        let both = described.and_then(Described::default_bytes);
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

/// The ESI's revision beside the device's.
fn fit(device: &Device, described: &Described) -> String {
    let ours = described.device.identity.revision;
    let theirs = device.identity().map_or(ours, |i| i.revision);
    match theirs.cmp(&ours) {
        std::cmp::Ordering::Equal => "the same".to_owned(),
        std::cmp::Ordering::Greater => format!("0x{ours:08x}, older"),
        std::cmp::Ordering::Less => format!("0x{ours:08x}, newer"),
    }
}

fn axis(device: &Device, described: Option<&Described>) -> String {
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

/// What wants more than a cell.
fn notes(seen: &Seen) -> String {
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

/// Drawn from port to port.
pub(super) fn tree(seen: &Seen) -> String {
    let mut text = format!("{}\n", seen.nic);
    // Devices in the order of the segment are a tree walked branch by branch, so that lines need only be known above each one.
    let parent = |n: usize| {
        let device = seen.scan.devices.get(n)?;
        device.uplink.map(|u| usize::from(u.device))
    };
    let count = seen.scan.devices.len();
    for (n, (device, described)) in seen.devices().enumerate() {
        let mut branches = Vec::new();
        let mut at = Some(n);
        // No deeper than there are devices.
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
        text += &format!("{line} ({})\n", facts.join(", "));
    }
    text
}
