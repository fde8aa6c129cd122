//! Orders the writes of a restore.
//!
//! Lists, whose subindex 0 is the count, are emptied, filled and counted. PDO lists follow the
//! order of ETG.1020: no PDO is assigned while its mapping changes.

use crate::parameters::Parameter;

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
