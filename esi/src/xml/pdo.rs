//! `RxPdo` and `TxPdo`.
//!
//! A PDO with an attribute `RefName` can be repeated by an element `Pdo`, `RxPdo` or `TxPdo` with
//! an attribute `Ref` of the same text. `Index`, `Name`, entries and numbers of that element replace
//! those of the definition; flags and `Exclude`s are added.

use std::collections::HashMap;

use super::cursor::{Cursor, Element};
use super::text::Names;
use crate::address;
use crate::error::{EsiError, EsiProblem};
use crate::model::{Direction, Entry, Excluded, Oversampling, Pdo, Position, SlotDependence, Text};

/// The maximum number of entries; a frame carries 11888 bits.
const MAX_ENTRIES: usize = 12_000;
/// The maximum number of PDOs. There are 512 mapping objects per direction.
const MAX_PDOS: usize = 2048;

/// Reads one more PDO of a device or module and skips an unreadable one.
pub(super) fn append<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    direction: Direction,
    to: &mut Vec<Pdo>,
) -> Result<(), EsiError> {
    if to.len() >= MAX_PDOS {
        return Err(c.error_at(
            element,
            EsiProblem::TooLarge {
                what: "the PDOs of one direction",
                limit: MAX_PDOS,
            },
        ));
    }
    let read = read(c, element, direction).map(|pdo| to.push(pdo));
    c.leave_out(element, read)
}

/// The PDOs of a file by their `RefName`.
pub(super) type PdoDefinitions = HashMap<String, Pdo>;

/// Reads a `Pdo`, whose direction is that of the definition that it refers to.
pub(super) fn append_reference<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    rx: &mut Vec<Pdo>,
    tx: &mut Vec<Pdo>,
) -> Result<(), EsiError> {
    let direction = definition(c, element).map(|found| found.map(|pdo| pdo.direction));
    match direction {
        Ok(Some(Direction::Rx)) => append(c, element, Direction::Rx, rx),
        Ok(Some(Direction::Tx)) => append(c, element, Direction::Tx, tx),
        Ok(None) => Ok(()),
        Err(error) => c.leave_out(element, Err(error)),
    }
}

/// Returns the PDO that `Ref` names.
fn definition<'c, 'a>(
    c: &'c Cursor<'a>,
    element: &Element<'a>,
) -> Result<Option<&'c Pdo>, EsiError> {
    let Some(name) = c.attribute(element, "Ref")? else {
        return Ok(None);
    };
    let missing = || {
        let name = name.chars().take(80).collect();
        c.error_at(element, EsiProblem::UnknownPdoReference(name))
    };
    c.pdo_definitions.get(&name).map(Some).ok_or_else(missing)
}

/// Returns a copy of the PDO that `Ref` names. The limit on the contents of a file covers it.
fn copied<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Option<Pdo>, EsiError> {
    let Some(defined) = definition(c, element)? else {
        return Ok(None);
    };
    let bytes = defined.size();
    c.spend(bytes, (c.position(element), element))?;
    Ok(definition(c, element)?.cloned())
}

fn read<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    direction: Direction,
) -> Result<Pdo, EsiError> {
    let defined = copied(c, element)?;
    let mut index = defined.as_ref().map(|pdo| pdo.index);
    let mut inherits_entries = defined.is_some();
    let mut pdo = defined.unwrap_or_else(|| empty(direction));
    pdo.position = c.position(element);
    pdo.direction = direction;
    pdo.sm = c.attribute_number(element, "Sm")?.or(pdo.sm);
    pdo.su = c.attribute_number(element, "Su")?.or(pdo.su);
    pdo.fixed |= c.attribute_flag(element, "Fixed")?;
    pdo.mandatory |= c.attribute_flag(element, "Mandatory")?;
    pdo.virtual_ |= c.attribute_flag(element, "Virtual")?;
    pdo.overwritten_by_module |= c.attribute_flag(element, "OverwrittenByModule")?;
    pdo.oversampling = oversampling(c, element)?.or(pdo.oversampling);
    let mut names = Names::default();
    c.children(element, |c, el| {
        match el.name {
            "Index" => {
                pdo.depends_on = c.slot_dependence(el)?;
                index = Some(c.number(el, "PDO index")?);
            }
            "Name" => names.add(c, el)?,
            "Exclude" => pdo.exclude.push(Excluded {
                depends_on: c.slot_dependence(el)?,
                index: c.number(el, "excluded PDO index")?,
            }),
            "ExcludedSm" => pdo.excluded_sm.push(c.number(el, "excluded SyncManager")?),
            "Entry" => {
                if std::mem::take(&mut inherits_entries) {
                    pdo.entries.clear();
                }
                room(c, el, &pdo.entries)?;
                pdo.entries.push(entry(c, el)?);
            }
            _ => {}
        }
        Ok(())
    })?;
    pdo.index =
        index.ok_or_else(|| c.error_at(element, EsiProblem::Missing { what: "PDO Index" }))?;
    let name = names.take();
    if !name.is_empty() {
        pdo.name = name.into_owned();
    }
    if let Some(name) = c.attribute(element, "RefName")? {
        c.spend(pdo.size(), (pdo.position, element))?;
        c.pdo_definitions.insert(name, pdo.clone());
    }
    Ok(pdo)
}

fn empty(direction: Direction) -> Pdo {
    Pdo {
        position: Position::default(),
        direction,
        index: 0,
        name: String::new(),
        sm: None,
        su: None,
        excluded_sm: Vec::new(),
        fixed: false,
        mandatory: false,
        virtual_: false,
        overwritten_by_module: false,
        depends_on: SlotDependence::default(),
        oversampling: None,
        exclude: Vec::new(),
        entries: Vec::new(),
    }
}

/// Checks that one more entry is allowed.
fn room<'a>(c: &Cursor<'a>, element: &Element<'a>, entries: &[Entry]) -> Result<(), EsiError> {
    let (what, limit) = ("a PDO's entries", MAX_ENTRIES);
    match entries.len() < limit {
        true => Ok(()),
        false => Err(c.error_at(element, EsiProblem::TooLarge { what, limit })),
    }
}

fn oversampling<'a>(
    c: &Cursor<'a>,
    element: &Element<'a>,
) -> Result<Option<Oversampling>, EsiError> {
    let Some(factor) = c.attribute_number(element, "OSFac")? else {
        return Ok(None);
    };
    Ok(Some(Oversampling {
        factor,
        max: c.attribute_number(element, "OSMax")?,
        index_increment: c.attribute_number(element, "OSIndexInc")?.unwrap_or(0),
    }))
}

fn entry<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Entry, EsiError> {
    let mut entry = Entry {
        position: c.position(element),
        index: 0,
        sub: 0,
        bit_len: 0,
        name: Text::default(),
        data_type: Text::default(),
        depends_on: SlotDependence::default(),
    };
    let mut names = Names::default();
    let mut index = None;
    c.children(element, |c, el| {
        match el.name {
            "Index" => {
                entry.depends_on = c.slot_dependence(el)?;
                index = Some(c.number(el, "entry index")?);
            }
            "SubIndex" => entry.sub = c.number(el, "entry subindex")?,
            "BitLen" => entry.bit_len = c.number(el, "BitLen")?,
            "Name" => names.add(c, el)?,
            "DataType" => entry.data_type = c.content(el)?.into(),
            _ => {}
        }
        Ok(())
    })?;
    entry.index = index.ok_or_else(|| {
        c.error_at(
            element,
            EsiProblem::Missing {
                what: "Entry/Index",
            },
        )
    })?;
    entry.name = names.take().into();
    if entry.bit_len == 0 && entry.index != 0 {
        c.warn(
            element,
            format!(
                "{} is mapped with a bit length of 0",
                address(entry.index, entry.sub)
            ),
        );
    }
    Ok(entry)
}
