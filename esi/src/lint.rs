//! Problems in a readable file: contradictions between its elements, and devices without a usable
//! configuration.
//!
//! ```
//! let esi = br##"<EtherCATInfo>
//!   <Vendor><Id>#x1</Id></Vendor>
//!   <Descriptions><Devices><Device Physics="YY">
//!     <Type ProductCode="#x2" RevisionNo="#x3">IO</Type>
//!     <TxPdo Sm="7"><Index>#x1a00</Index><Name>Inputs</Name></TxPdo>
//!   </Device></Devices></Descriptions>
//! </EtherCATInfo>"##;
//! let file = ecaxis_esi::parse(esi)?;
//! let findings = ecaxis_esi::lint(&file);
//! assert!(!findings.is_empty());
//! # Ok::<(), ecaxis_esi::EsiError>(())
//! ```

use std::collections::BTreeMap;
use std::fmt;

use ecaxis_ecat::text::is_hidden;

use crate::address;
use crate::model::{Device, EsiFile, InitCmd, Module, Pdo, Position, Slots, SmUse};
use crate::select::{SelectError, SelectOptions, offered_modes, select};

/// A typical bus cycle, for checks that depend on the cycle time.
const CYCLE_NS: u64 = 1_000_000;
/// The maximum number of module places over all devices of a file. A device without slots counts as
/// one place.
const MAX_EFFORT: usize = 20_000;

/// The severity of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Severity {
    /// A device or one of its modes cannot be used.
    Error,
    /// Two elements contradict each other; the reader used one of them.
    Warning,
    /// Information for the user; the file is correct.
    Note,
}

impl fmt::Display for Severity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Error => "error",
            Self::Warning => "warning",
            Self::Note => "note",
        })
    }
}

/// A problem in a readable ESI file.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Finding {
    /// The severity.
    pub severity: Severity,
    /// The name of the referenced file; `None`: the finding is in the main file.
    pub file: Option<String>,
    /// The position of the element.
    pub position: Position,
    /// Element path, such as `EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[2]`.
    pub path: String,
    /// The problem as text.
    pub message: String,
}

/// Returns all findings of a file in file order, including the reader's warnings.
#[must_use]
pub fn lint(file: &EsiFile) -> Vec<Finding> {
    let mut found = FindingBuilder::default();
    let mut effort = 0usize;
    for warning in &file.warnings {
        found.all.push(Finding {
            severity: match warning.left_out {
                true => Severity::Error,
                false => Severity::Warning,
            },
            file: warning.file.clone(),
            position: warning.position,
            path: warning.path.clone(),
            message: warning.message.clone(),
        });
    }
    for device in &file.devices {
        self::device(&mut found, &device.path, device);
        effort = effort.saturating_add(places(device));
        if effort <= MAX_EFFORT {
            usable(&mut found, &device.path, file, device);
        }
    }
    if effort > MAX_EFFORT {
        let position = file
            .devices
            .last()
            .map_or(Position::default(), |d| d.position);
        let message = format!(
            "{} devices with their slots have more than {MAX_EFFORT} places for modules; not all layouts were tried",
            file.devices.len()
        );
        found.warn(position, "EtherCATInfo/Descriptions/Devices", message);
    }
    doubled_devices(&mut found, file);
    for module in &file.modules {
        found.file.clone_from(&module.file);
        self::module(&mut found, &module.path, file, module);
    }
    let place = |f: &Finding| (f.file.clone(), f.position.line, f.position.column);
    found.all.sort_by_key(place);
    found.all
}

/// Returns the number of module places that a selection visits.
fn places(device: &Device) -> usize {
    let places = device.slots.iter().flat_map(Slots::places);
    places.count().max(1)
}

#[derive(Default)]
struct FindingBuilder {
    all: Vec<Finding>,
    /// The file under inspection.
    file: Option<String>,
}

impl FindingBuilder {
    fn add(&mut self, severity: Severity, position: Position, path: &str, message: String) {
        self.all.push(Finding {
            severity,
            file: self.file.clone(),
            position,
            path: path.to_owned(),
            message,
        });
    }

    fn warn(&mut self, position: Position, path: &str, message: String) {
        self.add(Severity::Warning, position, path, message);
    }
}

/// Reports characters with which a name acts on a terminal, or looks like another name.
fn name(found: &mut FindingBuilder, position: Position, path: &str, name: &str) {
    if let Some(c) = name.chars().find(|c| is_hidden(*c)) {
        let code = u32::from(c);
        let message = format!(
            "the name contains the control character U+{code:04X}: it is shown as \u{fffd}"
        );
        found.warn(position, path, message);
    }
}

fn device(found: &mut FindingBuilder, path: &str, device: &Device) {
    name(found, device.position, path, &device.name);
    pdos(found, path, device, &device.rx_pdos, "RxPdo");
    pdos(found, path, device, &device.tx_pdos, "TxPdo");
    if let Some(coe) = device.mailbox.as_ref().and_then(|m| m.coe.as_ref()) {
        commands(found, path, device, &coe.init_cmds);
    }
    let areas = |usage| device.sync_managers.iter().any(|sm| sm.usage == usage);
    if device.mailbox.is_some() && !(areas(SmUse::MBoxOut) && areas(SmUse::MBoxIn)) {
        let message = "the device has a Mailbox, but no Sm for both of its directions".to_owned();
        found.warn(device.position, path, message);
    }
    for (n, fmmu) in device.fmmus.iter().enumerate() {
        if let Some(sm) = fmmu
            .sm
            .filter(|sm| usize::from(*sm) >= device.sync_managers.len())
        {
            let path = format!("{path}/Fmmu[{}]", n + 1);
            found.warn(
                device.position,
                &path,
                format!("it is for Sm {sm}, which does not exist"),
            );
        }
    }
    for mapping in &device.sm_mappings {
        for index in mapping.sync_managers.iter().flat_map(|(_, pdos)| pdos) {
            let mut all = device.rx_pdos.iter().chain(&device.tx_pdos);
            if !all.any(|pdo| pdo.index == *index) {
                let message = format!(
                    "assignment {:?} names PDO 0x{index:04x}, which does not exist",
                    mapping.name
                );
                found.warn(mapping.position, &mapping.path, message);
            }
        }
    }
    if let Some(slots) = &device.slots {
        let places = slots.declared_places();
        if places > Slots::MAX_PLACES as u64 {
            let message = format!(
                "{places} places for modules; 0xF030 lists {}, and so many are used",
                Slots::MAX_PLACES
            );
            found.warn(slots.position, &format!("{path}/Slots"), message);
        }
    }
    objects(found, path, device);
}

fn module(found: &mut FindingBuilder, path: &str, file: &EsiFile, module: &Module) {
    name(found, module.position, path, &module.name);
    let first = file
        .modules
        .iter()
        .find(|other| other.ident == module.ident);
    if let Some(first) = first.filter(|first| first.position != module.position) {
        let message = format!(
            "module 0x{:08x} is described twice; the one on line {} is taken",
            module.ident, first.position.line
        );
        found.warn(module.position, path, message);
    }
    for (list, kind) in [(&module.rx_pdos, "RxPdo"), (&module.tx_pdos, "TxPdo")] {
        for (n, pdo) in list.iter().enumerate() {
            self::pdo(found, &format!("{path}/{kind}[{}]", n + 1), pdo, list);
        }
    }
}

fn pdos(found: &mut FindingBuilder, path: &str, device: &Device, list: &[Pdo], kind: &str) {
    for (n, pdo) in list.iter().enumerate() {
        let path = format!("{path}/{kind}[{}]", n + 1);
        self::pdo(found, &path, pdo, list);
        let Some(sm) = pdo.sm else { continue };
        let wanted = SmUse::from(pdo.direction);
        match device.sync_managers.get(usize::from(sm)) {
            None => {
                let message = format!(
                    "PDO 0x{:04x} is assigned to Sm {sm}, and the device has {}",
                    pdo.index,
                    device.sync_managers.len()
                );
                found.warn(pdo.position, &path, message);
            }
            Some(sync) if sync.usage != wanted => {
                let message = format!(
                    "PDO 0x{:04x} is assigned to Sm {sm}, which is for {:?} and not for {wanted:?}",
                    pdo.index, sync.usage
                );
                found.warn(pdo.position, &path, message);
            }
            Some(_) => {}
        }
    }
}

fn pdo(found: &mut FindingBuilder, path: &str, pdo: &Pdo, list: &[Pdo]) {
    // A virtual PDO is not an object of the device.
    let mut same = list.iter().filter(|other| other.virtual_ == pdo.virtual_);
    let first = same.find(|other| other.index == pdo.index);
    if let Some(first) = first.filter(|first| first.position != pdo.position) {
        let message = format!(
            "PDO 0x{:04x} is described twice, first on line {}",
            pdo.index, first.position.line
        );
        found.warn(pdo.position, path, message);
    }
    if pdo.exclude.iter().any(|other| other.index == pdo.index) {
        let message = format!("PDO 0x{:04x} excludes itself; that is ignored", pdo.index);
        found.warn(pdo.position, path, message);
    }
    if pdo.entries.len() > 255 {
        let message = format!(
            "PDO 0x{:04x} has {} entries; a mapping object holds 255",
            pdo.index,
            pdo.entries.len()
        );
        found.warn(pdo.position, path, message);
    }
    for (n, entry) in pdo.entries.iter().enumerate() {
        let unread = |bits: u16| !entry.is_gap() && usize::from(bits) > 8 * 1486;
        if unread(entry.bit_len) {
            let message = format!(
                "{} has {} bits, more than a frame carries",
                address(entry.index, entry.sub),
                entry.bit_len
            );
            found.warn(entry.position, &format!("{path}/Entry[{}]", n + 1), message);
        }
    }
}

fn commands(found: &mut FindingBuilder, path: &str, device: &Device, commands: &[InitCmd]) {
    for (n, command) in commands.iter().enumerate() {
        let path = format!("{path}/Mailbox/CoE/InitCmd[{}]", n + 1);
        let what = address(command.index, command.sub);
        if command.transitions.is_empty() {
            found.warn(
                command.position,
                &path,
                format!("{what} names no Transition and is never sent"),
            );
        }
        let place = (command.index, command.sub);
        let dictionary = &device.dictionary;
        if let Some(how) = dictionary.contradiction(place, &command.data, command.complete_access) {
            found.warn(command.position, &path, format!("{what} {how}"));
        }
    }
}

fn objects(found: &mut FindingBuilder, path: &str, device: &Device) {
    let mut first: BTreeMap<u16, Position> = BTreeMap::new();
    for (n, object) in device.dictionary.objects.iter().enumerate() {
        let path = format!("{path}/Profile/Dictionary/Objects/Object[{}]", n + 1);
        match first.get(&object.index) {
            Some(position) => {
                let message = format!(
                    "object 0x{:04x} is described twice; the one on line {} is taken",
                    object.index, position.line
                );
                found.warn(object.position, &path, message);
            }
            None => {
                first.insert(object.index, object.position);
            }
        }
    }
}

/// Checks that the default configuration and each offered mode produce a layout.
fn usable(found: &mut FindingBuilder, path: &str, file: &EsiFile, device: &Device) {
    let has_pdos = !device.rx_pdos.is_empty() || !device.tx_pdos.is_empty();
    let choice = SelectOptions {
        cycle_ns: CYCLE_NS,
        ..SelectOptions::default()
    };
    let mut refuse = |severity, what: &str, error: &SelectError| {
        let (position, path) = match error.element() {
            Some((position, element)) => (position, within(file, device, position, element)),
            None => (device.position, path.to_owned()),
        };
        found.add(severity, position, &path, format!("{what}: {error}"));
    };
    match select(file, device, &choice) {
        // The file is correct: the user must name the modules.
        Err(error @ SelectError::ModuleNeeded { .. }) => {
            refuse(Severity::Note, "its default configuration", &error);
            return;
        }
        Err(error) if has_pdos || device.slots.is_some() => {
            refuse(Severity::Error, "its default configuration", &error);
            return;
        }
        _ => {}
    }
    for mode in offered_modes(file, device) {
        let choice = SelectOptions {
            mode: Some(mode),
            ..choice
        };
        if let Err(error) = select(file, device, &choice) {
            refuse(Severity::Error, &format!("mode {mode}"), &error);
        }
    }
}

/// Returns the path of an element of the device or of a module, as the reader formats it.
fn within(file: &EsiFile, device: &Device, position: Position, element: &str) -> String {
    let path = &device.path;
    let found = match element {
        "Slot" => {
            let mut all = device.slots.iter().flat_map(|slots| &slots.slots);
            let at = all.position(|slot| slot.position == position);
            at.map(|at| format!("{path}/Slots/Slot[{}]", at + 1))
        }
        "Sm" => {
            let mut all = device.sync_managers.iter();
            let at = all.position(|sm| sm.position == position);
            at.map(|at| format!("{path}/Sm[{}]", at + 1))
        }
        "Pdo" => {
            let of_device = [(path, &device.rx_pdos, &device.tx_pdos)];
            let modules = file.modules.iter();
            let of_modules = modules.map(|m| (&m.path, &m.rx_pdos, &m.tx_pdos));
            let mut all = of_device.into_iter().chain(of_modules);
            all.find_map(|(path, rx, tx)| {
                [("RxPdo", rx), ("TxPdo", tx)]
                    .iter()
                    .find_map(|(name, pdos)| {
                        let at = pdos.iter().position(|pdo| pdo.position == position)?;
                        Some(format!("{path}/{name}[{}]", at + 1))
                    })
            })
        }
        _ => None,
    };
    found.unwrap_or_else(|| format!("{path}/{element}"))
}

fn doubled_devices(found: &mut FindingBuilder, file: &EsiFile) {
    let mut first: BTreeMap<(u32, u32, u32), Position> = BTreeMap::new();
    for device in &file.devices {
        let id = device.identity;
        match first.get(&(id.vendor, id.product, id.revision)) {
            Some(position) => {
                let message = format!("{id} is described twice, first on line {}", position.line);
                found.warn(device.position, &device.path, message);
            }
            None => {
                first.insert((id.vendor, id.product, id.revision), device.position);
            }
        }
    }
}
