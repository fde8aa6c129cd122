//! `Dictionary/Objects` as in the file.

use std::borrow::Cow;

use super::cursor::{Cursor, Element};
use super::number::{boolean, number};
use super::text::Names;
use crate::error::{EsiError, EsiProblem};
use crate::model::{Access, PdoMapping, Position, SlotDependence, Text, Writable};

pub(super) struct RawObject<'a> {
    pub index: u16,
    pub depends_on: SlotDependence,
    pub name: Text,
    pub type_name: Text,
    pub bit_size: u32,
    pub info: Info<'a>,
    pub flags: Flags,
}

/// The name and values of a subindex.
pub(super) type SubItem<'a> = (Cow<'a, str>, Info<'a>);

/// Default and range of an object or of one of its subindices. Literals are parsed once the type is
/// known.
#[derive(Default)]
pub(super) struct Info<'a> {
    pub default: Option<Literal<'a>>,
    pub min: Option<Literal<'a>>,
    pub max: Option<Literal<'a>>,
    pub unit: u32,
    pub sub_items: Vec<SubItem<'a>>,
}

pub(super) enum Literal<'a> {
    Value(Cow<'a, str>),
    Data(Cow<'a, str>),
    Text(Cow<'a, str>),
}

#[derive(Default, Clone, Copy)]
pub(super) struct Flags {
    pub access: Option<Access>,
    pub pdo_mapping: Option<PdoMapping>,
    pub backup: Option<bool>,
    pub setting: Option<bool>,
}

pub(super) fn read<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    objects: &mut Vec<(Position, RawObject<'a>)>,
) -> Result<(), EsiError> {
    c.children(element, |c, el| {
        if el.name == "Object" {
            let position = c.position(el);
            let read = object(c, el);
            let read = read.map(|object| objects.push((position, object)));
            return c.leave_out(el, read);
        }
        Ok(())
    })
}

fn object<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<RawObject<'a>, EsiError> {
    let mut names = Names::default();
    let mut index = None;
    let mut object = RawObject {
        index: 0,
        depends_on: SlotDependence::default(),
        name: Text::default(),
        type_name: Text::default(),
        bit_size: 0,
        info: Info::default(),
        flags: Flags::default(),
    };
    c.children(element, |c, el| {
        match el.name {
            "Index" => {
                object.depends_on = c.slot_dependence(el)?;
                index = Some(c.number(el, "object index")?);
            }
            "Name" => names.add(c, el)?,
            "Type" => object.type_name = c.content(el)?.into(),
            "BitSize" => object.bit_size = c.number(el, "BitSize")?,
            "Info" => object.info = info(c, el)?,
            "Flags" => object.flags = flags(c, el)?,
            _ => {}
        }
        Ok(())
    })?;
    object.index = index.ok_or_else(|| {
        c.error_at(
            element,
            EsiProblem::Missing {
                what: "Object/Index",
            },
        )
    })?;
    object.name = names.take().into();
    Ok(object)
}

fn info<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Info<'a>, EsiError> {
    let mut out = Info::default();
    c.children(element, |c, el| {
        match el.name {
            "DefaultValue" => out.default = Some(Literal::Value(c.content(el)?)),
            "DefaultData" => out.default = Some(Literal::Data(c.content(el)?)),
            "DefaultString" => out.default = Some(Literal::Text(c.content(el)?)),
            "MinValue" => out.min = Some(Literal::Value(c.content(el)?)),
            "MinData" => out.min = Some(Literal::Data(c.content(el)?)),
            "MaxValue" => out.max = Some(Literal::Value(c.content(el)?)),
            "MaxData" => out.max = Some(Literal::Data(c.content(el)?)),
            "Unit" => {
                let unit = number(&c.content(el)?).and_then(|unit| u32::try_from(unit).ok());
                out.unit = unit.unwrap_or(0);
            }
            "SubItem" => {
                // Most objects have at most 16 subindices.
                out.sub_items.reserve(16);
                out.sub_items.push(sub_item(c, el)?);
            }
            _ => {}
        }
        Ok(())
    })?;
    Ok(out)
}

fn sub_item<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<SubItem<'a>, EsiError> {
    let mut names = Names::default();
    let mut inner = Info::default();
    c.children(element, |c, el| {
        match el.name {
            "Name" => names.add(c, el)?,
            "Info" => inner = info(c, el)?,
            _ => {}
        }
        Ok(())
    })?;
    Ok((names.take(), inner))
}

pub(super) fn flags<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Flags, EsiError> {
    let mut flags = Flags::default();
    c.children(element, |c, el| {
        match el.name {
            "Access" => {
                let only = c
                    .value(el, "WriteRestrictions")?
                    .and_then(|text| restriction(&text));
                let text = c.content(el)?;
                let has = |letter: [char; 2]| text.contains(letter);
                let (read, write) = (has(['r', 'R']), has(['w', 'W']));
                let write = match (write, only) {
                    (false, _) => Writable::Never,
                    (true, None) => Writable::Always,
                    (true, Some(states)) => states,
                };
                flags.access = (!text.is_empty()).then_some(Access { read, write });
            }
            "PdoMapping" => {
                let text = c.content(el)?;
                flags.pdo_mapping = Some(PdoMapping {
                    rx: text.contains(['r', 'R']),
                    tx: text.contains(['t', 'T']),
                });
            }
            "Backup" => flags.backup = boolean(&c.content(el)?),
            "Setting" => flags.setting = boolean(&c.content(el)?),
            _ => {}
        }
        Ok(())
    })?;
    Ok(flags)
}

/// Converts `PreOP_SafeOP` → the states that allow writing.
fn restriction(text: &str) -> Option<Writable> {
    let names: Vec<String> = text
        .split(['_', ' '])
        .map(|part| part.trim().to_ascii_lowercase())
        .collect();
    let has = |state: &str| names.iter().any(|name| name == state);
    let (pre_op, safe_op, op) = (has("preop"), has("safeop"), has("op"));
    (pre_op || safe_op || op).then_some(Writable::Only {
        pre_op,
        safe_op,
        op,
    })
}
