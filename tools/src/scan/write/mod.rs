//! Generates a machine file from a scan. Pure: the input is a scan with ESI descriptions, the
//! output is text.
//!
//! `axis` writes a drive's axis; `lines` formats keys and comments.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use ecaxis_esi as esi;
use ecaxis_esi::sii::MailboxDifference;

use super::{Device, EsiMatch, Scan};
use ecaxis_master::config::duration;
use ecaxis_master::esi_library::RevisionMatch;
use ecaxis_master::text::quoted;

mod axis;
mod lines;
#[cfg(test)]
mod tests;

pub(crate) use lines::TomlWriter;

/// The marker of uncertain lines, which users can search for.
pub const MARK: &str = "CHECK:";

/// The ESI file of a device that neither a file nor its EEPROM describes.
pub const MISSING: &str = "esi/MISSING.xml";

/// Preferred cycle times in ns: the first that all devices support is used.
const CYCLES: [u64; 5] = [1_000_000, 2_000_000, 4_000_000, 500_000, 250_000];

/// The location of the file.
#[derive(Debug, Clone, Copy)]
pub struct OutputPath<'a> {
    /// `"sim"`, or a network interface.
    pub nic: &'a str,
    /// The interface at the other end of a ring.
    pub redundant: Option<&'a str>,
    /// The machine file's folder; paths in the file are relative to it.
    pub folder: &'a Path,
}

/// The name of a scanned device in the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceName {
    pub name: String,
    pub mode: Option<esi::Mode>,
}

/// A machine file and the EEPROM images that it names, each with its path.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MachineFile {
    pub text: String,
    pub images: Vec<(PathBuf, Vec<u8>)>,
}

/// Returns a complete machine file. Lines with [`MARK`] need a check. A device without an ESI file
/// is described by its EEPROM image.
#[must_use]
pub fn machine_file(
    scan: &Scan,
    described: &[Option<EsiMatch>],
    place: OutputPath<'_>,
) -> MachineFile {
    let both = scan.devices.iter().zip(described);
    let described: Vec<Option<EsiMatch>> = both
        .map(|(device, described)| described.clone().or_else(|| EsiMatch::from_eeprom(device)))
        .collect();
    let described = || described.iter().map(Option::as_ref);
    let named = names(scan.devices.iter().zip(described()), &[]);
    let cycle_ns = cycle(described().zip(&named));
    let mut text = head(&named, place, cycle_ns);
    let aliases = aliases(scan);
    let mut images = Vec::new();
    for ((device, described), named) in scan.devices.iter().zip(described()).zip(&named) {
        text += "\n";
        text += &device_section(device, described, named, &aliases, place, cycle_ns);
        images.extend(image_file(device, described, named, place));
    }
    text += &steps(&named);
    MachineFile { text, images }
}

/// Returns the EEPROM image of a device that no ESI file describes, with its path.
fn image_file(
    device: &Device,
    described: Option<&EsiMatch>,
    named: &DeviceName,
    place: OutputPath<'_>,
) -> Option<(PathBuf, Vec<u8>)> {
    described.filter(|described| described.path.is_none())?;
    let path = place.folder.join(image_name(named));
    Some((path, device.image.clone()))
}

fn image_name(named: &DeviceName) -> String {
    format!("{}.sii", named.name)
}

fn head(named: &[DeviceName], place: OutputPath<'_>, cycle_ns: u64) -> String {
    let mut text = format!(
        "# Written by `ecaxis scan`. Lines with \"{MARK}\" need a check.\n\
         # `ecaxis check FILE` finds mistakes, `ecaxis explain FILE` shows what follows,\n\
         # `ecaxis compare FILE` reports whether the bus has changed.\n\n",
    );
    let mut lines = TomlWriter::default();
    if named.iter().any(|named| named.mode.is_some()) {
        let comment =
            format!("{MARK} look at the limits first; then take this out, or `run --enable`");
        lines.add("enable", "false", &comment);
        text += &lines.text();
        text += "\n";
    }
    let mut lines = TomlWriter::default();
    lines.header("[bus]");
    let nic = quoted(place.nic);
    lines.add("nic", &nic, "`ecaxis run FILE --sim` simulates the bus");
    if let Some(second) = place.redundant {
        lines.add("redundant", &quoted(second), "");
    }
    let cycle = quoted(&duration::show(cycle_ns).replace(' ', ""));
    lines.add("cycle", &cycle, "");
    let comment = format!("{MARK} a machine wants 3");
    lines.add("lost_frames", "20", &comment);
    text + &lines.text()
}

/// Returns the first cycle time that every device supports.
fn cycle<'d>(devices: impl Iterator<Item = (Option<&'d EsiMatch>, &'d DeviceName)> + Clone) -> u64 {
    let takes = |cycle_ns: &u64| {
        devices.clone().all(|(described, named)| {
            described.is_none_or(|d| selection(d, named.mode, *cycle_ns).is_some())
        })
    };
    let found = CYCLES.into_iter().find(takes);
    found.unwrap_or(CYCLES[0])
}

fn selection(
    described: &EsiMatch,
    mode: Option<esi::Mode>,
    cycle_ns: u64,
) -> Option<esi::Selection> {
    let choice = esi::SelectOptions {
        mode,
        cycle_ns,
        ..esi::SelectOptions::default()
    };
    esi::select(&described.file, &described.device, &choice).ok()
}

/// Returns the names of the devices: numbered axes, and type names for others. `taken`: names
/// already in use.
pub fn names<'d>(
    devices: impl Iterator<Item = (&'d Device, Option<&'d EsiMatch>)>,
    taken: &[String],
) -> Vec<DeviceName> {
    let mut taken: Vec<String> = taken.to_vec();
    let mut all = Vec::new();
    for (device, described) in devices {
        let mode = axis::mode(device, described);
        let word = match mode {
            Some(_) => "axis".to_owned(),
            None => word(device, described),
        };
        // Axes start with axis1. The second terminal of a type gets a 2.
        let first = if mode.is_some() { 1 } else { 0 };
        let numbered = |n: usize| match (n, word.ends_with(|c: char| c.is_ascii_digit())) {
            (0, _) => word.clone(),
            (n, true) => format!("{word}_{}", n + 1),
            (n, false) if mode.is_none() => format!("{word}{}", n + 1),
            (n, false) => format!("{word}{n}"),
        };
        // There are at most as many names in use.
        let free = (first..=first + taken.len()).map(numbered);
        let name = free
            .into_iter()
            .find(|name| !taken.contains(name))
            .unwrap_or(word.clone());
        taken.push(name.clone());
        all.push(DeviceName { name, mode });
    }
    all
}

/// Returns a name for a key: letters, digits and underscores.
fn word(device: &Device, described: Option<&EsiMatch>) -> String {
    let type_name = described.map(|d| d.device.type_name.clone());
    let type_name = type_name.or_else(|| device.own_name()).unwrap_or_default();
    let mut word = String::new();
    for c in type_name.chars().take(24) {
        match c {
            c if c.is_ascii_alphanumeric() => word.push(c.to_ascii_lowercase()),
            _ if word.ends_with('_') || word.is_empty() => {}
            _ => word.push('_'),
        }
    }
    let word = word.trim_end_matches('_').to_owned();
    match word.chars().next() {
        None => "device".to_owned(),
        Some(c) if c.is_ascii_digit() => format!("device_{word}"),
        Some(_) => word,
    }
}

/// Aliases and device identifications with their number of devices.
#[derive(Debug, Default)]
pub struct Aliases {
    aliases: BTreeMap<u16, usize>,
    ids: BTreeMap<u16, usize>,
}

#[must_use]
pub fn aliases(scan: &Scan) -> Aliases {
    let mut all = Aliases::default();
    for device in &scan.devices {
        *all.aliases.entry(device.found.alias).or_default() += 1;
        if let Some(id) = device.id {
            *all.ids.entry(id).or_default() += 1;
        }
    }
    all
}

/// Returns one `[[device]]` section.
#[must_use]
pub fn device_section(
    device: &Device,
    described: Option<&EsiMatch>,
    named: &DeviceName,
    aliases: &Aliases,
    place: OutputPath<'_>,
    cycle_ns: u64,
) -> String {
    let mut lines = TomlWriter::default();
    lines.header("[[device]]");
    let what = described.map(|d| d.device.name.as_str());
    lines.add("name", &quoted(&named.name), what.unwrap_or_default());
    match described {
        Some(described) if described.path.is_none() => {
            let comment = "its EEPROM: no ESI file here describes it";
            lines.add("sii", &quoted(&image_name(named)), comment);
        }
        _ => {
            let identity = device.identity().unwrap_or_default();
            let mailbox = described.and_then(|described| described.mailbox_difference(device));
            esi_keys(identity, described, mailbox, place.folder, &mut lines);
        }
    }
    locator(device, aliases, &mut lines);
    if let Some(mode) = named.mode {
        let offered = described.map(|d| esi::offered_modes(&d.file, &d.device));
        let others: Vec<&str> = offered
            .iter()
            .flatten()
            .filter(|m| m.is_cyclic() && **m != mode)
            .map(|m| m.name())
            .collect();
        let comment = match others.is_empty() {
            true => String::new(),
            false => format!("also {}", others.join(", ")),
        };
        lines.add("mode", &quoted(mode.name()), &comment);
    }
    if let Some(described) = described {
        if let Some((list, comment)) = modules(device, described, named.mode) {
            match list {
                Some(list) => lines.add("modules", &list, &comment),
                None => lines.comment(&comment),
            }
        }
        let selection = selection(described, named.mode, cycle_ns);
        if selection.is_some_and(|s| s.dc.is_some()) && !device.dc {
            let comment = format!("{MARK} the ESI wants SYNC0, the device shows no clock");
            lines.add("dc", &quoted("off"), &comment);
        }
    }
    if let Some(serial) = device.serial().filter(|serial| *serial != 0) {
        lines.comment(&format!(
            "serial = {serial} would take this very device only"
        ));
    }
    let mut text = lines.text();
    text += &described.map_or_else(String::new, |described| gateway(device, described));
    if let (Some(_), Some(described)) = (named.mode, described) {
        text += "\n";
        text += &axis::section(device, described);
    }
    text
}

/// Returns the data sizes of a gateway that are not those of its ESI.
fn gateway(device: &Device, described: &EsiMatch) -> String {
    let answers = device
        .answers
        .as_ref()
        .and_then(|answers| answers.as_ref().ok());
    let Some(gateway) = answers.and_then(|answers| answers.gateway) else {
        return String::new();
    };
    let (inputs, outputs) = (gateway.inputs.into(), gateway.outputs.into());
    let layout = selection(described, None, CYCLES[0]).map(|selection| selection.layout);
    if layout.is_some_and(|own| (own.tx_bytes(), own.rx_bytes()) == (inputs, outputs)) {
        return String::new();
    }
    let mut lines = TomlWriter::default();
    lines.header("[device.can]");
    lines.add("inputs", &inputs.to_string(), "as the gateway maps them");
    lines.add("outputs", &outputs.to_string(), "");
    format!("\n{}", lines.text())
}

/// Adds `esi` and the keys that select the device.
pub(crate) fn esi_keys(
    identity: esi::Identity,
    described: Option<&EsiMatch>,
    mailbox: Option<MailboxDifference>,
    folder: &Path,
    lines: &mut TomlWriter,
) {
    let Some(described) = described else {
        let comment = format!(
            "{MARK} no ESI file here describes {identity}: get it from its vendor, put it here"
        );
        lines.add("esi", &quoted(MISSING), &comment);
        return;
    };
    let path = described.path.as_deref().unwrap_or(Path::new(""));
    let path = relative(path, folder);
    let comment = match &described.others[..] {
        [] => String::new(),
        [other, rest @ ..] => {
            let more = match rest.len() {
                0 => String::new(),
                more => format!(" and {more} more"),
            };
            let other = other.display();
            format!("{MARK} {other}{more} has the same revision: take the file of this firmware")
        }
    };
    lines.add("esi", &quoted(&path.display().to_string()), &comment);
    if let Some(difference) = mailbox {
        let comment = format!("{MARK} {difference}; or \"eeprom\"");
        lines.add("mailbox", &quoted("esi"), &comment);
    }
    let ours = described.device.identity;
    let mut others = described
        .file
        .headers()
        .filter(|(id, ..)| id.product != ours.product)
        .peekable();
    if others.peek().is_some() {
        lines.add("type", &quoted(&described.device.type_name), "");
        if others.any(|(_, type_name, _)| type_name == described.device.type_name) {
            lines.add("product", &format!("0x{:08x}", ours.product), "");
        }
    }
    let newer = described
        .file
        .headers()
        .any(|(id, ..)| id.product == ours.product && id.revision > ours.revision);
    if newer {
        lines.add("revision", &format!("0x{:08x}", ours.revision), "");
    }
    match described.rule {
        RevisionMatch::Equal => {}
        rule => {
            let rule = if rule == RevisionMatch::Newer {
                ">="
            } else {
                "ignore"
            };
            let comment = format!(
                "{MARK} the device has revision 0x{:08x}, the file 0x{:08x}",
                identity.revision, ours.revision
            );
            lines.add("identity", &quoted(rule), &comment);
        }
    }
}

/// Adds the locator: a unique alias or identification if available, else the position.
fn locator(device: &Device, aliases: &Aliases, lines: &mut TomlWriter) {
    let position = device.position();
    let alias = device.found.alias;
    if alias != 0 && aliases.aliases.get(&alias) == Some(&1) {
        let comment = format!("at position {position}");
        lines.add("alias", &alias.to_string(), &comment);
        return;
    }
    let id = device.id.filter(|id| *id != 0);
    if let Some(id) = id.filter(|id| aliases.ids.get(id) == Some(&1)) {
        let comment = format!("at position {position}");
        lines.add("id", &id.to_string(), &comment);
        return;
    }
    let comment = if alias == 0 {
        String::new()
    } else {
        format!("{MARK} its alias {alias} is another's, too")
    };
    lines.add("position", &position.to_string(), &comment);
}

/// Returns the modules that were found, and a comment. `None` if the mode selects the module.
fn modules(
    device: &Device,
    described: &EsiMatch,
    mode: Option<esi::Mode>,
) -> Option<(Option<String>, String)> {
    described.device.slots.as_ref()?;
    if mode.is_some() {
        return None;
    }
    let Some(Ok(answers)) = &device.answers else {
        let comment = format!("{MARK} the device was not asked for its `modules`");
        return Some((None, comment));
    };
    let lists = [&answers.detected, &answers.configured];
    let plugged = |idents: &&Vec<u32>| idents.iter().any(|ident| *ident != 0);
    let mut answered = lists.into_iter().flatten();
    let idents = answered.clone().find(plugged).or(answered.next())?;
    let modules = &described.file.modules;
    let names = esi::module_names(modules, idents);
    let known = |ident: u32| ident == 0 || modules.iter().any(|module| module.ident == ident);
    let unknown: Vec<_> = idents
        .iter()
        .filter(|ident| !known(**ident))
        .map(|ident| format!("0x{ident:08x}"))
        .collect();
    let comment = match (names.is_empty(), unknown.is_empty()) {
        (true, _) => "no module is plugged".to_owned(),
        (_, true) => "as they are plugged".to_owned(),
        _ => format!("{MARK} the ESI file does not know {}", unknown.join(", ")),
    };
    let names: Vec<_> = names.iter().map(|name| quoted(name)).collect();
    Some((Some(format!("[{}]", names.join(", "))), comment))
}

/// Returns a first move for the axes in a position mode.
fn steps(named: &[DeviceName]) -> String {
    let axes: Vec<&str> = named
        .iter()
        .filter(|named| named.mode == Some(esi::Mode::Csp))
        .map(|named| named.name.as_str())
        .collect();
    if axes.is_empty() {
        return String::new();
    }
    let by = |way: &str| {
        let each: Vec<String> = axes.iter().map(|axis| format!("{axis} = {way}")).collect();
        format!(
            "[[step]]\nmove_by = {{ {} }}\nspeed   = 0.05\nramp    = 0.05\n",
            each.join(", ")
        )
    };
    format!(
        "\n# A first move, a tenth of a turn there and back, slowly: `ecaxis run FILE --enable`.\n{}\n{}",
        by("0.1"),
        by("-0.1")
    )
}

/// Returns the path from a folder to a file, both relative to the present folder.
pub(crate) fn relative(file: &Path, folder: &Path) -> PathBuf {
    let absolute = |path: &Path| {
        let path = if path.as_os_str().is_empty() {
            Path::new(".")
        } else {
            path
        };
        std::fs::canonicalize(path).or_else(|_| std::path::absolute(path))
    };
    let (Ok(file_at), Ok(folder_at)) = (absolute(file), absolute(folder)) else {
        return file.to_owned();
    };
    let (mut to, mut from) = (
        file_at.components().peekable(),
        folder_at.components().peekable(),
    );
    let mut shared = 0;
    while to.peek().is_some() && to.peek() == from.peek() {
        to.next();
        from.next();
        shared += 1;
    }
    let ups = from.count();
    // If the paths have little in common, the absolute path is clearer.
    if shared <= 1 || ups > 3 {
        return file_at;
    }
    let up = std::iter::repeat_n(Path::new(".."), ups);
    up.chain(to.map(|part| Path::new(part.as_os_str())))
        .collect()
}
