//! Compares two sets of values.

use std::collections::BTreeMap;

use super::restore_order::settings_only;
use crate::mailbox::NamedObject;
use crate::parameters::Parameter;
use crate::parameters::class::{Class, CopyRule};

/// A value that differs; `None` if a side does not have the object.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    pub at: NamedObject,
    pub name: String,
    pub class: Class,
    pub left: Option<String>,
    pub right: Option<String>,
    /// The texts of words and codes.
    pub meanings: [Option<String>; 2],
}

/// Returns the differing settings that `rule` would copy, by index and subindex; with `all` every
/// value.
#[must_use]
pub fn compare(
    left: &[Parameter],
    right: &[Parameter],
    rule: CopyRule,
    all: bool,
) -> Vec<Difference> {
    let mut both: BTreeMap<(u16, u8), [Option<&Parameter>; 2]> = BTreeMap::new();
    for (side, parameters) in [left, right].into_iter().enumerate() {
        for parameter in settings_only(parameters) {
            let key = (parameter.at.index, parameter.at.sub);
            if let Some(place) = both.entry(key).or_default().get_mut(side) {
                *place = Some(parameter);
            }
        }
    }
    let differ = both.into_values().filter_map(|[left, right]| {
        let copied = |side: Option<&Parameter>| side.is_some_and(|p| rule.copies(p));
        let of_interest = all || copied(left) || copied(right);
        if !of_interest || left.map(|p| &p.value) == right.map(|p| &p.value) {
            return None;
        }
        let some = left.or(right)?;
        Some(Difference {
            at: some.at,
            name: some.name.clone(),
            class: rule.class(some).0,
            left: left.map(Parameter::shown),
            right: right.map(Parameter::shown),
            meanings: [left, right].map(|side| side?.meaning()),
        })
    });
    differ.collect()
}
