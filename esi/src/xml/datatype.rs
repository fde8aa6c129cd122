//! `Dictionary/DataTypes`, as written.

use std::collections::HashMap;

use super::cursor::{Cursor, Element};
use super::object::{self, Flags};
use super::text::Names;
use crate::error::EsiError;

#[derive(Default)]
pub(super) struct DataTypes {
    by_name: HashMap<String, DataType>,
}

#[derive(Default)]
pub(super) struct DataType {
    /// What `Cursor::at` makes a position of.
    offset: usize,
    pub base: Option<String>,
    pub bit_size: u32,
    pub arrays: Vec<ArrayInfo>,
    pub sub_items: Vec<SubItem>,
}

#[derive(Default, Clone, Copy)]
pub(super) struct ArrayInfo {
    pub lower_bound: u32,
    pub elements: u32,
}

#[derive(Default)]
pub(super) struct SubItem {
    pub sub: Option<u8>,
    pub name: String,
    pub type_name: String,
    pub bit_size: u32,
    pub bit_offset: Option<u32>,
    pub flags: Flags,
}

/// Alias chains longer than this are cycles.
const MAX_ALIASES: usize = 8;

impl DataTypes {
    pub fn get(&self, name: &str) -> Option<&DataType> {
        self.by_name.get(name)
    }

    /// Types whose aliases lead nowhere, in file order.
    fn circular(&self) -> Vec<(usize, String)> {
        let is_alias =
            |of: &DataType| of.base.is_some() && of.arrays.is_empty() && of.sub_items.is_empty();
        let mut found: Vec<_> = self
            .by_name
            .iter()
            .filter(|(name, of)| {
                // A base type may name itself: BOOL is a BOOL.
                let base = self.base(name);
                is_alias(of)
                    && of.base.as_ref() != Some(*name)
                    && self
                        .get(base)
                        .is_some_and(|of| is_alias(of) && of.base.as_deref() != Some(base))
            })
            .map(|(name, of)| (of.offset, name.clone()))
            .collect();
        found.sort();
        found
    }

    /// Follows enumerations and aliases to the type they are made of; arrays and records stand for themselves.
    pub fn base<'s>(&'s self, name: &'s str) -> &'s str {
        self.with_base(name).1
    }

    /// The type of that name, and what [`Self::base`] makes of it.
    pub fn with_base<'s>(&'s self, name: &'s str) -> (Option<&'s DataType>, &'s str) {
        let found = self.get(name);
        let (mut name, mut next) = (name, found);
        for _ in 0..MAX_ALIASES {
            match next {
                Some(DataType {
                    base: Some(base),
                    arrays,
                    sub_items,
                    ..
                }) if arrays.is_empty() && sub_items.is_empty() => {
                    name = base;
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
            let (name, data_type) = data_type(c, el)?;
            types.by_name.entry(name).or_insert(data_type);
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

fn data_type<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
) -> Result<(String, DataType), EsiError> {
    let mut name = String::new();
    let mut data_type = DataType {
        offset: element.offset(),
        ..DataType::default()
    };
    c.children(element, |c, el| {
        match el.name {
            "Name" => name = c.text(el)?,
            "BaseType" => data_type.base = Some(c.text(el)?).filter(|base| !base.is_empty()),
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
            "Type" => item.type_name = c.text(el)?,
            "BitSize" => item.bit_size = c.number(el, "BitSize")?,
            "BitOffs" => item.bit_offset = c.optional_number(el, "BitOffs")?,
            "Flags" => item.flags = object::flags(c, el)?,
            _ => {}
        }
        Ok(())
    })?;
    item.name = names.take();
    Ok(item)
}
