//! `RxPdo` and `TxPdo`.

use super::cursor::{Cursor, Element};
use super::text::Names;
use crate::error::{EsiError, EsiProblem};
use crate::model::{Direction, Entry, Excluded, Oversampling, Pdo, SlotDependence};

/// A frame carries 11888 bits.
const MAX_ENTRIES: usize = 12_000;
/// There are 512 mapping objects for each direction.
const MAX_PDOS: usize = 2048;

/// Reads one more PDO of a device or module.
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
    to.push(read(c, element, direction)?);
    Ok(())
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
                if pdo.entries.len() >= MAX_ENTRIES {
                    return Err(c.error_at(
                        el,
                        EsiProblem::TooLarge {
                            what: "a PDO's entries",
                            limit: MAX_ENTRIES,
                        },
                    ));
                }
                pdo.entries.push(entry(c, el)?);
            }
            _ => {}
        }
        Ok(())
    })?;
    pdo.index =
        index.ok_or_else(|| c.error_at(element, EsiProblem::Missing { what: "PDO Index" }))?;
    pdo.name = names.take();
    Ok(pdo)
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
        name: String::new(),
        data_type: String::new(),
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
            "DataType" => entry.data_type = c.text(el)?,
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
    entry.name = names.take();
    if entry.bit_len == 0 && entry.index != 0 {
        c.warn(
            element,
            format!(
                "0x{:04x}:{:02x} is mapped with a bit length of 0",
                entry.index, entry.sub
            ),
        );
    }
    Ok(entry)
}
