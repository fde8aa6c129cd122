//! `RxPdo` and `TxPdo`.

use super::cursor::{Cursor, Element};
use super::text::Names;
use crate::address;
use crate::error::{EsiError, EsiProblem};
use crate::model::{Direction, Entry, Excluded, Oversampling, Pdo, SlotDependence, Text};

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

fn read<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    direction: Direction,
) -> Result<Pdo, EsiError> {
    let mut pdo = Pdo {
        position: c.position(element),
        direction,
        index: 0,
        name: String::new(),
        sm: c.attribute_number(element, "Sm")?,
        su: c.attribute_number(element, "Su")?,
        excluded_sm: Vec::new(),
        fixed: c.attribute_flag(element, "Fixed")?,
        mandatory: c.attribute_flag(element, "Mandatory")?,
        virtual_: c.attribute_flag(element, "Virtual")?,
        overwritten_by_module: c.attribute_flag(element, "OverwrittenByModule")?,
        depends_on: SlotDependence::default(),
        oversampling: oversampling(c, element)?,
        exclude: Vec::new(),
        entries: Vec::new(),
    };
    let mut names = Names::default();
    let mut index = None;
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
                room(c, el, &pdo.entries)?;
                pdo.entries.push(entry(c, el)?);
            }
            _ => {}
        }
        Ok(())
    })?;
    pdo.index =
        index.ok_or_else(|| c.error_at(element, EsiProblem::Missing { what: "PDO Index" }))?;
    pdo.name = names.take().into_owned();
    Ok(pdo)
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
