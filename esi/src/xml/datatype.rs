//! `Dictionary/DataTypes` as in the file.

use std::collections::HashMap;

use super::cursor::{Cursor, Element};
use super::object::{self, Flags};
use super::text::Names;
use crate::error::EsiError;
use crate::model::Text;

#[derive(Default)]
pub(super) struct DataTypes {
    /// The types by name, with the byte offset for `Cursor::at`.
    by_name: HashMap<Text, (usize, Named)>,
}

/// A type and its name.
pub(super) type Named = (Text, DataType);

#[derive(Default)]
pub(super) struct DataType {
    /// The base type; empty if the type has none.
    pub base: Text,
    pub bit_size: u32,
    pub arrays: Vec<ArrayInfo>,
    pub sub_items: Vec<SubItem>,
}

#[derive(Default, Clone, Copy)]
pub(super) struct ArrayInfo {
    pub lower_bound: u32,
    pub elements: u32,
}

#[derive(Default, Clone)]
pub(super) struct SubItem {
    pub sub: Option<u8>,
    pub name: Text,
    pub type_name: Text,
    pub bit_size: u32,
    pub bit_offset: Option<u32>,
    pub flags: Flags,
}

/// Longer alias chains are treated as cycles.
const MAX_ALIASES: usize = 8;

impl DataType {
    fn is_alias(&self) -> bool {
        !self.base.is_empty() && self.arrays.is_empty() && self.sub_items.is_empty()
    }
}

impl DataTypes {
    pub fn get(&self, name: &str) -> Option<&DataType> {
        self.by_name.get(name).map(|(_, named)| &named.1)
    }

    /// Returns types with circular aliases, in file order.
    fn circular(&self) -> Vec<(usize, String)> {
        let mut found: Vec<_> = self
            .by_name
            .iter()
            .filter(|(name, (_, named))| {
                let of = &named.1;
                // A base type may name itself, for example BOOL.
                let base = self.base(name);
                of.is_alias()
                    && of.base != **name
                    && self
                        .get(base)
                        .is_some_and(|of| of.is_alias() && of.base != *base)
            })
            .map(|(name, (offset, _))| (*offset, name.to_string()))
            .collect();
        found.sort();
        found
    }

    /// Follows enumerations and aliases to the base type. Returns arrays and records unchanged.
    pub fn base<'s>(&'s self, name: &'s Text) -> &'s Text {
        self.with_base(name).1
    }

    /// Returns the type of that name, and the result of [`Self::base`].
    pub fn with_base<'s>(&'s self, name: &'s Text) -> (Option<&'s DataType>, &'s Text) {
        let found = self.get(name);
        let (mut name, mut next) = (name, found);
        for _ in 0..MAX_ALIASES {
            match next {
                Some(of) if of.is_alias() => {
                    name = &of.base;
                    next = self.get(name);
                }
                _ => break,
            }
        }
        (found, name)
    }
}

pub(super) fn read<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    types: &mut DataTypes,
) -> Result<(), EsiError> {
    c.children(element, |c, el| {
        if el.name == "DataType" {
            let read = data_type(c, el);
            let read = read.map(|named| {
                let name = named.0.clone();
                types.by_name.entry(name).or_insert((el.offset(), named));
            });
            return c.leave_out(el, read);
        }
        Ok(())
    })?;
    for (offset, name) in types.circular() {
        let name: String = name.chars().take(40).collect();
        let message = format!("type {name:?} is made of itself; it counts as unknown");
        c.warn_at(c.at(offset), element, message);
    }
    Ok(())
}

fn data_type<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Named, EsiError> {
    let mut name = Text::default();
    let mut data_type = DataType::default();
    c.children(element, |c, el| {
        match el.name {
            "Name" => name = c.content(el)?.into(),
            "BaseType" => data_type.base = c.content(el)?.into(),
            "BitSize" => data_type.bit_size = c.number(el, "BitSize")?,
            "ArrayInfo" => data_type.arrays.push(array_info(c, el)?),
            "SubItem" => data_type.sub_items.push(sub_item(c, el)?),
            _ => {}
        }
        Ok(())
    })?;
    Ok((name, data_type))
}

fn array_info<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<ArrayInfo, EsiError> {
    let mut info = ArrayInfo::default();
    c.children(element, |c, el| {
        match el.name {
            "LBound" => info.lower_bound = c.number(el, "LBound")?,
            "Elements" => info.elements = c.number(el, "Elements")?,
            _ => {}
        }
        Ok(())
    })?;
    Ok(info)
}

fn sub_item<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<SubItem, EsiError> {
    let mut item = SubItem::default();
    let mut names = Names::default();
    c.children(element, |c, el| {
        match el.name {
            "SubIdx" => item.sub = c.optional_number(el, "SubIdx")?,
            "Name" => names.add(c, el)?,
            "Type" => item.type_name = c.content(el)?.into(),
            "BitSize" => item.bit_size = c.number(el, "BitSize")?,
            "BitOffs" => item.bit_offset = c.optional_number(el, "BitOffs")?,
            "Flags" => item.flags = object::flags(c, el)?,
            _ => {}
        }
        Ok(())
    })?;
    item.name = names.take().into();
    Ok(item)
}
