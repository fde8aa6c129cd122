//! Rewrites the machine file to match the bus. Unchanged parts and comments are kept.

use std::path::Path;

use ecaxis_ecat::index::DeviceIndex;
use toml_edit::{Array, ArrayOfTables, DocumentMut, Item, Table, TableLike, Value};

use super::{Comparison, Difference};
use crate::scan::write::{self, OutputPath};
use crate::scan::{EsiMatch, Scan};
use ecaxis_master::config::{self, ConfigError, Locator, Machine};
use ecaxis_master::esi_library::RevisionMatch;
use ecaxis_master::text::quoted;

/// The maximum nesting of `repeat`, above the limit of machine files.
const DEPTH: usize = 16;

#[derive(Debug, thiserror::Error)]
pub enum ApplyError {
    #[error("the file is not TOML: {0}")]
    NotToml(String),
    #[error("the devices of the file are not written as [[device]]")]
    OtherForm,
    #[error("position {position}: no ESI file describes it")]
    NotDescribed { position: u16 },
    #[error("all devices of the file are missing")]
    NothingLeft,
    #[error("the rewritten file would be wrong: {0}")]
    Wrong(#[source] ConfigError),
}

/// The inputs for the rewrite.
#[derive(Debug, Clone, Copy)]
pub struct BusSnapshot<'a> {
    pub scan: &'a Scan,
    /// One per device of the scan.
    pub described: &'a [Option<EsiMatch>],
    pub comparison: &'a Comparison,
}

impl BusSnapshot<'_> {
    fn described(&self, position: u16) -> Option<&EsiMatch> {
        self.described.get(usize::from(position))?.as_ref()
    }
}

/// The rewritten file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Applied {
    pub text: String,
    /// Consequences of the differences as text: moved positions, removed steps and groups.
    pub reported: Vec<String>,
}

/// Rewrites `text`, the file at `path`, which parses to `machine`. Parameters are kept. The result
/// is a valid file. Items that lost a named device are marked with [`write::MARK`].
///
/// # Errors
/// Fails if the file cannot match the bus.
pub fn apply(
    path: &Path,
    text: &str,
    machine: &Machine,
    actual: BusSnapshot<'_>,
) -> Result<Applied, ApplyError> {
    let mut reported = Vec::new();
    let mut document: DocumentMut = text
        .parse()
        .map_err(|error: toml_edit::TomlError| ApplyError::NotToml(error.to_string()))?;
    let place = OutputPath {
        nic: "",
        redundant: None,
        folder: path.parent().unwrap_or(Path::new("")),
    };
    let differences = &actual.comparison.differences;

    // Add new devices first: a file without devices has no form to follow.
    let mut new = Vec::new();
    for difference in differences {
        if let Difference::Added { position } = difference {
            new.push(*position);
        }
    }
    let sections = added(machine, actual, place, &new)?;
    for (index, config) in machine.devices.enumerate() {
        let Some(position) = actual.comparison.places.get(index).copied().flatten() else {
            continue;
        };
        let table = device(&mut document, &config.name)?;
        if let Locator::Position(from) = config.at
            && from != position
        {
            set(table, "position", &position.to_string());
            reported.push(format!(
                "`{}` has `position = {position}` now, it was {from}",
                config.name
            ));
        }
    }
    for difference in differences {
        change(&mut document, machine, actual, place, difference)?;
    }
    let missing = differences
        .iter()
        .filter_map(|difference| match difference {
            Difference::Missing { device } => machine.devices.get(*device),
            _ => None,
        });
    let names: Vec<&str> = missing.map(|config| config.name.as_str()).collect();
    if !names.is_empty() {
        remove(&mut document, &names, &mut reported)?;
    }
    let list = devices(&mut document)?;
    for section in sections {
        list.push(section);
    }
    if list.is_empty() {
        return Err(ApplyError::NothingLeft);
    }
    let text = document.to_string();
    config::parse(path, &text).map_err(ApplyError::Wrong)?;
    Ok(Applied { text, reported })
}

fn devices(document: &mut DocumentMut) -> Result<&mut ArrayOfTables, ApplyError> {
    let item = document.get_mut("device");
    item.and_then(Item::as_array_of_tables_mut)
        .ok_or(ApplyError::OtherForm)
}

fn device<'d>(document: &'d mut DocumentMut, name: &str) -> Result<&'d mut Table, ApplyError> {
    let mut all = devices(document)?.iter_mut();
    let named = |table: &&mut Table| table.get("name").and_then(Item::as_str) == Some(name);
    all.find(named).ok_or(ApplyError::OtherForm)
}

/// Replaces a value and keeps its comment, or appends it.
fn set(table: &mut Table, key: &str, value: &str) {
    let Ok(mut value) = value.parse::<Value>() else {
        return;
    };
    match table.get_mut(key).and_then(Item::as_value_mut) {
        Some(old) => {
            *value.decor_mut() = old.decor().clone();
            *old = value;
        }
        None => {
            // Format it like the other keys of the table.
            value.decor_mut().set_prefix(" ");
            table.insert(key, Item::Value(value));
        }
    }
}

/// Returns sections for the devices that the file does not have.
fn added(
    machine: &Machine,
    actual: BusSnapshot<'_>,
    place: OutputPath<'_>,
    positions: &[u16],
) -> Result<Vec<Table>, ApplyError> {
    let aliases = write::aliases(actual.scan);
    let taken: Vec<String> = machine.devices.iter().map(|d| d.name.clone()).collect();
    let mut all = Vec::with_capacity(positions.len());
    for position in positions {
        let device = actual.scan.devices.get(usize::from(*position));
        let described = actual.described(*position);
        let (Some(device), Some(described)) = (device, described) else {
            return Err(ApplyError::NotDescribed {
                position: *position,
            });
        };
        all.push((device, Some(described)));
    }
    let named = write::names(all.iter().copied(), &taken);
    let mut tables = Vec::with_capacity(all.len());
    for ((device, described), named) in all.into_iter().zip(&named) {
        let cycle = machine.bus.cycle_ns;
        let text = write::device_section(device, described, named, &aliases, place, cycle);
        let mut section: DocumentMut = text
            .parse()
            .map_err(|error: toml_edit::TomlError| ApplyError::NotToml(error.to_string()))?;
        let list = devices(&mut section)?;
        let Some(table) = list.get_mut(0) else {
            return Err(ApplyError::OtherForm);
        };
        let mut table = table.clone();
        unplaced(&mut table, DEPTH);
        table.decor_mut().set_prefix("\n");
        tables.push(table);
    }
    Ok(tables)
}

/// Clears the positions of tables from another document.
fn unplaced(table: &mut Table, depth: usize) {
    table.set_position(None);
    if depth == 0 {
        return;
    }
    for (_, item) in table.iter_mut() {
        if let Item::Table(inner) = item {
            unplaced(inner, depth - 1);
        }
    }
}

/// Applies the differences that only change the device's own table.
fn change(
    document: &mut DocumentMut,
    machine: &Machine,
    actual: BusSnapshot<'_>,
    place: OutputPath<'_>,
    difference: &Difference,
) -> Result<(), ApplyError> {
    let name = |index: DeviceIndex| machine.devices.get(index).map(|d| d.name.as_str());
    match difference {
        Difference::Alias {
            device: index,
            position,
            expected,
            found,
        } => {
            let Some(name) = name(*index) else {
                return Ok(());
            };
            let table = device(document, name)?;
            let key = match expected {
                Locator::Id(_) => "id",
                _ => "alias",
            };
            if *found == 0 {
                table.remove(key);
                set(table, "position", &position.to_string());
            } else {
                set(table, key, &found.to_string());
            }
        }
        Difference::Serial {
            device: index,
            found,
            ..
        } => {
            if let Some(name) = name(*index) {
                set(device(document, name)?, "serial", &found.to_string());
            }
        }
        Difference::Modules {
            device: index,
            found,
            ..
        } => {
            if let Some(name) = name(*index) {
                let list: Array = found.iter().map(String::as_str).collect();
                let list = Value::Array(list).to_string();
                set(device(document, name)?, "modules", &list);
            }
        }
        Difference::Revision {
            device: index,
            position,
            found,
            ..
        } => {
            let described = actual.described(*position);
            let described = described.ok_or(ApplyError::NotDescribed {
                position: *position,
            })?;
            let Some(config) = machine.devices.get(*index) else {
                return Ok(());
            };
            let table = device(document, &config.name)?;
            revision(table, config, described, *found, place);
        }
        Difference::Missing { .. }
        | Difference::Added { .. }
        | Difference::Swapped { .. }
        | Difference::Moved { .. }
        | Difference::Reversed { .. }
        | Difference::Parameter { .. } => {}
    }
    Ok(())
}

/// Selects the best description, and a rule if its revision differs.
fn revision(
    table: &mut Table,
    config: &config::DeviceConfig,
    described: &EsiMatch,
    found: u32,
    place: OutputPath<'_>,
) {
    let wanted = described.device.identity;
    // The named file may describe the revision as well.
    if !config
        .esi
        .headers()
        .any(|(identity, ..)| identity == wanted)
    {
        let path = described.path.as_deref().unwrap_or(Path::new(""));
        let path = write::relative(path, place.folder);
        set(table, "esi", &quoted(&path.display().to_string()));
    }
    let revision = wanted.revision;
    set(table, "revision", &format!("0x{revision:08x}"));
    let rule = if revision == found {
        RevisionMatch::Equal
    } else if RevisionMatch::Newer.accepts(revision, found) {
        RevisionMatch::Newer
    } else {
        RevisionMatch::Ignore
    };
    match rule {
        RevisionMatch::Equal if config.identity.accepts(revision, found) => {}
        RevisionMatch::Equal => set(table, "identity", &quoted("equal")),
        RevisionMatch::Newer => set(table, "identity", &quoted(">=")),
        _ => set(table, "identity", &quoted("ignore")),
    }
}

/// Removes devices and all references to them.
fn remove(
    document: &mut DocumentMut,
    names: &[&str],
    reported: &mut Vec<String>,
) -> Result<(), ApplyError> {
    let named = |item: Option<&Item>| {
        let name = item.and_then(Item::as_str);
        name.is_some_and(|name| names.contains(&name))
    };
    let list = devices(document)?;
    list.retain(|table| !named(table.get("name")));
    for table in list.iter_mut() {
        let sim = table.get_mut("sim").and_then(Item::as_table_like_mut);
        if let Some(sim) = sim
            && named(sim.get("after"))
        {
            sim.remove("after");
            sim.remove("port");
        }
    }
    if let Some(steps) = document.get_mut("step") {
        forget_in_steps(steps, names, DEPTH, "", reported);
    }
    if let Some(stop) = document.get_mut("stop") {
        forget_in_stop(stop, names, reported);
    }
    for key in ["step", "stop"] {
        if document.get(key).is_some_and(is_empty) {
            document.remove(key);
        }
    }
    Ok(())
}

/// Formats `` `x` is gone ``.
fn are_gone(names: &[&str]) -> String {
    let quoted: Vec<String> = names.iter().map(|name| format!("`{name}`")).collect();
    let be = if names.len() == 1 { "is" } else { "are" };
    format!("{} {be} gone", quoted.join(", "))
}

/// Adds a comment to an item that lost a name, next to an existing comment.
fn mark(item: &mut Item, gone: &[&str]) {
    let decor = match item {
        Item::Value(value) => value.decor_mut(),
        Item::Table(table) => table.decor_mut(),
        Item::None | Item::ArrayOfTables(_) => return,
    };
    let before = decor.suffix().and_then(|suffix| suffix.as_str());
    let before = before.unwrap_or_default().trim_end();
    let text = format!("{} {}", write::MARK, are_gone(gone));
    decor.set_suffix(match before.trim().is_empty() {
        true => format!("  # {text}"),
        false => format!("{before}; {text}"),
    });
}

fn is_empty(item: &Item) -> bool {
    match item {
        Item::None => true,
        Item::Value(Value::Array(array)) => array.is_empty(),
        Item::Value(Value::InlineTable(table)) => table.is_empty(),
        Item::Value(_) => false,
        Item::Table(table) => table.is_empty(),
        Item::ArrayOfTables(tables) => tables.is_empty(),
    }
}

/// Removes steps in which only these devices took part. `outer`: the number of the parent step with
/// a point.
fn forget_in_steps(
    steps: &mut Item,
    names: &[&str],
    depth: usize,
    outer: &str,
    reported: &mut Vec<String>,
) {
    let Some(steps) = steps.as_array_of_tables_mut().filter(|_| depth > 0) else {
        return;
    };
    let mut kept = Vec::with_capacity(steps.len());
    for (n, step) in (1..).zip(steps.iter_mut()) {
        let number: String = format!("{outer}{n}");
        let left = forget_in_step(step, names, depth, &number, reported);
        if !left {
            reported.push(format!("step {number} is removed: no axis is left in it"));
        }
        kept.push(left);
    }
    let mut kept = kept.into_iter();
    steps.retain(|_| kept.next().unwrap_or(true));
}

/// Removes the names from a step. Returns whether anything remains.
fn forget_in_step(
    step: &mut Table,
    names: &[&str],
    depth: usize,
    number: &str,
    reported: &mut Vec<String>,
) -> bool {
    let mut kept = true;
    for (_, item) in step.iter_mut() {
        let before = is_empty(item);
        let mut gone = Vec::new();
        match item {
            Item::ArrayOfTables(_) => {
                forget_in_steps(item, names, depth - 1, &format!("{number}."), reported);
            }
            Item::Value(Value::Array(list)) => gone = forget_in_list(list, names),
            _ => {
                if let Some(axes) = item.as_table_like_mut() {
                    gone = forget_axes(axes, names);
                }
                // The blank before the closing brace is attached to the last item.
                let inline = item.as_inline_table_mut();
                if let Some((_, last)) = inline.and_then(|axes| axes.iter_mut().last()) {
                    last.decor_mut().set_suffix(" ");
                }
            }
        }
        // No device is left.
        kept &= before || !is_empty(item);
        if !gone.is_empty() && !is_empty(item) {
            mark(item, &gone);
        }
    }
    kept
}

/// Removes the names from a list and returns those it contained.
fn forget_in_list<'n>(list: &mut Array, names: &[&'n str]) -> Vec<&'n str> {
    let there = |name: &&&str| list.iter().any(|item| item.as_str() == Some(**name));
    let gone: Vec<&str> = names.iter().filter(there).copied().collect();
    list.retain(|item| !item.as_str().is_some_and(|name| gone.contains(&name)));
    gone
}

/// Removes the axes' entries and those of their followers. Returns the names concerned.
fn forget_axes<'n>(axes: &mut dyn TableLike, names: &[&'n str]) -> Vec<&'n str> {
    let mut gone = Vec::new();
    for name in names {
        let mut concerned = axes.remove(name).is_some();
        let follows = |item: &Item| {
            let gear = item.as_table_like();
            gear.and_then(|gear| gear.get("to")).and_then(Item::as_str) == Some(name)
        };
        let followers: Vec<String> = axes
            .iter()
            .filter(|(_, item)| follows(item))
            .map(|(key, _)| key.to_owned())
            .collect();
        for follower in followers {
            axes.remove(&follower);
            concerned = true;
        }
        if concerned {
            gone.push(*name);
        }
    }
    gone
}

fn forget_in_stop(stop: &mut Item, names: &[&str], reported: &mut Vec<String>) {
    // In an inline table, a comment would hide the closing brace.
    let roomy = stop.is_table();
    let Some(stop) = stop.as_table_like_mut() else {
        return;
    };
    if let Some(item) = stop.get_mut("emergency") {
        let mut gone = Vec::new();
        if let Some(conditions) = item.as_table_like_mut() {
            for name in names {
                if conditions.remove(name).is_some() {
                    gone.push(*name);
                }
            }
        }
        if !gone.is_empty() && !is_empty(item) && roomy {
            mark(item, &gone);
        } else if !gone.is_empty() {
            reported.push(format!(
                "`[stop] emergency` has lost inputs: {}",
                are_gone(&gone)
            ));
        }
    }
    if stop.get("emergency").is_some_and(is_empty) {
        stop.remove("emergency");
    }
    let groups = stop.get_mut("group").and_then(Item::as_array_of_tables_mut);
    if let Some(groups) = groups {
        for group in groups.iter_mut() {
            for key in ["axes", "devices"] {
                let Some(item) = group.get_mut(key) else {
                    continue;
                };
                let gone = item.as_array_mut().map(|list| forget_in_list(list, names));
                if let Some(gone) = gone.filter(|gone| !gone.is_empty()) {
                    mark(item, &gone);
                }
            }
        }
        groups.retain(|group| {
            let kept = group.get("axes").is_some_and(|axes| !is_empty(axes));
            if !kept {
                let name = group.get("name").and_then(Item::as_str);
                let name = name.unwrap_or_default();
                reported.push(format!(
                    "the group `{name}` is removed: no axis of it is left"
                ));
            }
            kept
        });
    }
    if stop.get("group").is_some_and(is_empty) {
        stop.remove("group");
    }
}
