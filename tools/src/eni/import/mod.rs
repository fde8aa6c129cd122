//! ENI → machine file. The datagrams of an ENI are not replayed: the machine file gets what they
//! configure, and everything that ecaxis would not send is listed with its reason.
//!
//! - `layout`: the keys that give a device the process data of the ENI;
//! - `device`: the `[[device]]` section with its start-up SDOs;
//! - `unsent`: the commands that ecaxis does not send.

mod device;
mod layout;
mod unsent;

use std::collections::BTreeMap;
use std::path::Path;

use ecaxis_ecat::registers;
use ecaxis_esi::Position;
use ecaxis_master::config::{self, ConfigError, Machine, duration};
use ecaxis_master::esi_library::{Library, LoadError};
use ecaxis_master::text::quoted;

use super::command::{EcatCommand, Payload};
use super::export::device_commands;
use super::network::{CopyInfo, Network, NetworkDevice};
use super::xml::EniError;
use crate::scan::esi_match::{self, EsiMatch};
use crate::scan::write::{MARK, TomlWriter};
use device::ImportedDevice;

/// A machine file, and what of the ENI is not in it.
#[derive(Debug)]
pub struct Import {
    pub text: String,
    /// The init and cyclic commands that ecaxis would not send, in the order of the file.
    pub unsent: Vec<Unsent>,
    /// Devices without an ESI file.
    pub without_esi: usize,
    /// Devices whose process data differs from that of the ENI.
    pub other_layouts: Vec<String>,
    /// ESI files that cannot be read.
    pub unreadable: Vec<LoadError>,
    /// The machine, unless the file has problems.
    pub machine: Result<Box<Machine>, ConfigError>,
}

/// A command that ecaxis would not send.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unsent {
    pub position: Position,
    /// The device; `None`: all devices.
    pub device: Option<String>,
    pub command: String,
    pub reason: String,
}

/// The cycle of an ENI without one.
const DEFAULT_CYCLE_NS: u64 = 1_000_000;

/// Reads an ENI. `path`: the machine file, whose folder is the base of its paths. `nic`: the
/// interface that it names.
///
/// # Errors
/// Returns the first mistake of the file.
pub fn import(
    bytes: &[u8],
    library: Option<&Library>,
    path: &Path,
    nic: &str,
) -> Result<Import, EniError> {
    let network = Network::parse(bytes)?;
    let identities: Vec<_> = network.devices.iter().map(|d| Some(d.identity)).collect();
    let (described, unreadable) = match library {
        Some(library) => esi_match::describe_identities(&identities, library),
        None => (vec![None; identities.len()], Vec::new()),
    };
    let stated = network.cycle_us.map(|us| u64::from(us) * 1000);
    let by_sync0 = || sync0_cycle_ns(&network.devices);
    let cycle_ns = stated.or_else(by_sync0).unwrap_or(DEFAULT_CYCLE_NS);
    let names = names(&network.devices);
    let devices: Vec<_> = network
        .devices
        .iter()
        .zip(&described)
        .zip(names)
        .map(|((device, described), name)| {
            ImportedDevice::new(device, described.as_ref(), name, cycle_ns)
        })
        .collect();
    let mut unsent: Vec<Unsent> = Vec::new();
    let mut text = head(&network, cycle_ns, nic);
    let folder = path.parent().unwrap_or(Path::new(""));
    for device in &devices {
        text += "\n";
        text += &device.section(folder);
        unsent.extend(device.unsent.iter().cloned());
    }
    for copy in &network.copies {
        match copy_section(copy, &devices) {
            Some(section) => text += &section,
            None => unsent.push(Unsent {
                position: copy.position,
                device: None,
                command: format!(
                    "copy of {} bits from {} to {}",
                    copy.bits, copy.from, copy.to
                ),
                reason: "its bits are no whole object of a device".to_owned(),
            }),
        }
    }
    let machine = config::parse(path, &text).map(Box::new);
    let commands = machine.as_ref().ok().and_then(|m| device_commands(m).ok());
    unsent.extend(unsent::of_network(&network));
    for (index, device) in devices.iter().enumerate() {
        let own = commands.as_ref().and_then(|all| all.get(index));
        unsent.extend(unsent::of_device(device, own.map(Vec::as_slice)));
    }
    unsent.sort_by_key(|unsent| unsent.position);
    let other = devices.iter().filter(|device| device.has_other_layout());
    Ok(Import {
        text,
        unsent,
        without_esi: described.iter().filter(|d| d.is_none()).count(),
        other_layouts: other.map(|device| device.name.clone()).collect(),
        unreadable,
        machine,
    })
}

fn head(network: &Network, cycle_ns: u64, nic: &str) -> String {
    let text = format!(
        "# Written by `ecaxis eni import`. Lines with \"{MARK}\" need a check.\n\
         # No device has an axis yet: add `mode` and [device.axis] to the drives.\n\n",
    );
    let mut lines = TomlWriter::default();
    lines.header("[bus]");
    let comment = match nic {
        "sim" => "or a network interface, \"enp3s0\"",
        _ => "",
    };
    lines.add("nic", &quoted(nic), comment);
    let cycle = format!("\"{}\"", duration::show(cycle_ns).replace(' ', ""));
    let comment = match network.cycle_us {
        Some(_) => String::new(),
        None if sync0_cycle_ns(&network.devices).is_some() => {
            format!("{MARK} the ENI has no cycle time; this is the cycle of SYNC0")
        }
        None => format!("{MARK} the ENI has no cycle time"),
    };
    lines.add("cycle", &cycle, &comment);
    lines.add("lost_frames", "20", &format!("{MARK} a machine wants 3"));
    if let Some(watchdog) = watchdog(&network.devices) {
        let time = duration::show(watchdog).replace(' ', "");
        lines.add("watchdog", &format!("\"{time}\""), "");
    }
    text + &lines.text()
}

/// Returns the cycle in ns that most SYNC0 signals have; of several, the longest. The SYNC0 of an
/// oversampling device is a part of the cycle.
fn sync0_cycle_ns(devices: &[NetworkDevice]) -> Option<u64> {
    let mut counts: BTreeMap<u32, usize> = BTreeMap::new();
    for device in devices {
        let by_command = || {
            let mut commands = device.commands.iter().map(|(_, command)| command);
            let cycle = commands.find_map(|command| written(command, registers::DC_SYNC0_CYCLE));
            cycle.map(u32::from_le_bytes)
        };
        let stated = device.clock.map(|(first, ..)| first);
        let cycle = stated.filter(|cycle| *cycle > 0).or_else(by_command);
        if let Some(cycle) = cycle.filter(|cycle| *cycle > 0) {
            *counts.entry(cycle).or_default() += 1;
        }
    }
    let most = counts
        .into_iter()
        .max_by_key(|(cycle, count)| (*count, *cycle));
    most.map(|(cycle, _)| cycle.into())
}

/// Returns the process data watchdog in ns, if all devices that set it agree.
fn watchdog(devices: &[NetworkDevice]) -> Option<u64> {
    /// The reset value of the divider, in units of 40 ns.
    const DIVIDER: u16 = 2498;
    let mut found = None;
    for device in devices {
        let written = |register: u16| {
            let mut commands = device.commands.iter().map(|(_, command)| command);
            commands.find_map(|command| written_word(command, register))
        };
        let Some(time) = written(registers::WATCHDOG_TIME_PROCESS_DATA) else {
            continue;
        };
        let divider = written(registers::WATCHDOG_DIVIDER).unwrap_or(DIVIDER);
        let ns = (u64::from(divider) + 2) * 40 * u64::from(time);
        if found.is_some_and(|known| known != ns) {
            return None;
        }
        found = Some(ns);
    }
    found.filter(|ns| (1_000_000..=6_553_500_000).contains(ns))
}

/// Returns what a command writes to a register of 16 bits.
pub(super) fn written_word(command: &EcatCommand, register: u16) -> Option<u16> {
    written(command, register).map(u16::from_le_bytes)
}

/// Returns the first bytes that a command writes to a register.
fn written<const N: usize>(command: &EcatCommand, register: u16) -> Option<[u8; N]> {
    match (&command.payload, unsent::written_register(command)) {
        (Payload::Data(data), Some(at)) if at == register => data.first_chunk().copied(),
        _ => None,
    }
}

/// Returns a unique name for each device: letters, digits and underscores.
fn names(devices: &[NetworkDevice]) -> Vec<String> {
    let mut count: BTreeMap<String, usize> = BTreeMap::new();
    let mut names: Vec<String> = Vec::with_capacity(devices.len());
    for device in devices {
        let mut word = String::new();
        for c in device.name.chars().take(40) {
            match c {
                c if c.is_ascii_alphanumeric() || c == '_' || c == '-' => word.push(c),
                _ if word.ends_with('_') || word.is_empty() => {}
                _ => word.push('_'),
            }
        }
        let word = match word.trim_end_matches('_') {
            "" => "device".to_owned(),
            word => word.to_owned(),
        };
        let known = count.entry(word.clone()).or_default();
        let mut name = word.clone();
        while names.contains(&name) || (*known > 0 && name == word) {
            *known += 1;
            name = format!("{word}_{known}");
        }
        *known = (*known).max(1);
        names.push(name);
    }
    names
}

/// Returns the `[[copy]]` of a copy between whole bytes or objects of two devices.
fn copy_section(copy: &CopyInfo, devices: &[ImportedDevice<'_>]) -> Option<String> {
    let end = |inputs: bool, bit: u32| {
        devices.iter().find_map(|device| {
            let network = device.network;
            let windows = if inputs {
                &network.inputs
            } else {
                &network.outputs
            };
            let first = relative_bit(windows, bit, copy.bits)?;
            Some(format!(
                "{}.{}",
                device.name,
                device.place(inputs, first, copy.bits)?
            ))
        })
    };
    let (from, to) = (end(true, copy.from)?, end(false, copy.to)?);
    Some(format!("\n[[copy]]\nfrom = \"{from}\"\nto   = \"{to}\"\n"))
}

/// Returns the bit within a device's process data; `None` if the bits are not in its windows.
fn relative_bit(windows: &[(u32, u32)], bit: u32, bits: u32) -> Option<u32> {
    let mut before = 0_u32;
    for &(start, len) in windows {
        let end = u64::from(bit) + u64::from(bits);
        if bit >= start && end <= u64::from(start) + u64::from(len) && bits > 0 {
            return before.checked_add(bit - start);
        }
        before = before.checked_add(len)?;
    }
    None
}

/// Returns the ESI description of a device, for `device` and `layout`.
type Described<'d> = Option<&'d EsiMatch>;
