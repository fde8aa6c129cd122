//! Selects and orders the writes of a restore.
//!
//! Lists, whose subindex 0 is the count, are emptied, filled and counted. PDO lists follow the
//! order of ETG.1020: no PDO is assigned while its mapping changes.

use crate::parameters::Parameter;

/// The index offset between the axes of a drive (CiA 402).
const AXIS: u16 = 0x0800;
const PROFILE: std::ops::Range<u16> = 0x6000..0xa000;

/// True if the value is a setting that can be copied to another device: it is writable, and writing
/// it neither commands nor clears anything.
#[must_use]
pub fn is_setting(parameter: &Parameter) -> bool {
    parameter.writable && !is_command(parameter.at.index)
}

/// True for objects that act when written, or that hold the present command.
fn is_command(index: u16) -> bool {
    let index = match index {
        profile if PROFILE.contains(&profile) => PROFILE.start + (profile - PROFILE.start) % AXIS,
        other => other,
    };
    matches!(
        index,
        // Clears error and diagnosis histories, stores and restores parameters, sets the time.
        0x1003 | 0x1010 | 0x1011 | 0x10f3 | 0x10f8
        // Program control (CiA 302-3).
        | 0x1f50..=0x1f57
        // Controlword, mode, targets, offsets, outputs (CiA 402).
        | 0x6040 | 0x6042 | 0x6060 | 0x6071 | 0x607a | 0x60b0..=0x60b2 | 0x60b8 | 0x60fe | 0x60ff
    )
}

/// True for lists with a writable count.
#[must_use]
pub fn is_list(index: u16) -> bool {
    index == MODULES || is_mapping(index) || is_assignment(index)
}

const MODULES: u16 = 0xf030;

fn is_mapping(index: u16) -> bool {
    matches!(index, 0x1600..=0x17ff | 0x1a00..=0x1bff)
}

fn is_assignment(index: u16) -> bool {
    matches!(index, 0x1c10..=0x1c2f)
}

/// Returns the settings without list elements beyond the count, which have no meaning.
#[must_use]
pub fn settings_only(parameters: &[Parameter]) -> Vec<&Parameter> {
    let count = |index: u16| {
        let head = parameters
            .iter()
            .find(|p| p.at.index == index && p.at.sub == 0);
        head.and_then(|head| head.value.first().copied())
    };
    let counts = |p: &&Parameter| {
        !is_list(p.at.index) || count(p.at.index).is_none_or(|count| p.at.sub <= count)
    };
    parameters.iter().filter(counts).collect()
}

/// One write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Write<'a> {
    /// Sets the list's count to 0.
    Empty(u16),
    Value(&'a Parameter),
}

/// Returns the writes that change a device to the wanted values. `differs` is true for values that
/// do not match yet. Lists come first, as a whole if any element differs, then the other objects by
/// index.
#[must_use]
pub fn order<'a>(wanted: &[&'a Parameter], differs: impl Fn(&Parameter) -> bool) -> Vec<Write<'a>> {
    let changed = |index: u16| wanted.iter().any(|p| p.at.index == index && differs(p));
    let mut lists: Vec<u16> = wanted
        .iter()
        .filter(|p| p.at.sub == 0 && is_list(p.at.index))
        .map(|p| p.at.index)
        .collect();
    lists.dedup();
    let remapped = lists
        .iter()
        .any(|index| is_mapping(*index) && changed(*index));
    let rewritten = |index: &u16| changed(*index) || remapped && is_assignment(*index);
    let pick = |which: fn(u16) -> bool| -> Vec<u16> {
        let these = lists
            .iter()
            .filter(|index| which(**index) && rewritten(index));
        these.copied().collect()
    };
    let modules = pick(|index| index == MODULES);
    let (mappings, assignments) = (pick(is_mapping), pick(is_assignment));
    let elements = |index: u16| {
        let parts = wanted.iter().filter(move |p| p.at.index == index);
        let (head, rest): (Vec<_>, Vec<_>) = parts.partition(|p| p.at.sub == 0);
        rest.into_iter().chain(head).map(Write::Value)
    };
    let mut writes = Vec::new();
    for index in &modules {
        writes.push(Write::Empty(*index));
        writes.extend(elements(*index));
    }
    writes.extend(assignments.iter().map(|index| Write::Empty(*index)));
    for index in &mappings {
        writes.push(Write::Empty(*index));
        writes.extend(elements(*index));
    }
    writes.extend(assignments.iter().flat_map(|index| elements(*index)));
    let others = wanted
        .iter()
        .filter(|p| !lists.contains(&p.at.index) && differs(p));
    writes.extend(others.map(|p| Write::Value(p)));
    writes
}
