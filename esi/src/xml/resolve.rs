//! Joins objects and data types: each subindex becomes an item with its own length, offset,
//! default, range and access.

use std::borrow::Cow;

use super::cursor::{Cursor, Element};
use super::datatype::{DataType, DataTypes};
use super::literal;
use super::number;
use super::object::{Flags, Info, Literal, RawObject, SubItem};
use crate::address;
use crate::error::{EsiError, EsiProblem};
use crate::model::{Access, Bytes, Object, ObjectCode, ObjectItem, Position, Text, Writable};

/// 1 MiB. Longer objects (files, domains) have no default and are transferred by length.
const MAX_ITEM_BITS: u32 = 8 << 20;
const MAX_ITEMS: usize = 256;

pub(super) fn object<'t, 'a>(
    c: &mut Cursor<'a>,
    place @ (position, dictionary): (Position, &Element<'a>),
    types: &'t DataTypes,
    raw: &'t RawObject<'a>,
    memory: &mut ResolveCache<'t, 'a>,
) -> Result<Object, EsiError> {
    let data_type = types.get(&raw.type_name);
    memory.slots.clear();
    let code = match data_type {
        Some(record) if !record.sub_items.is_empty() => {
            record_items(c, types, record, place, memory)?
        }
        _ => {
            memory.slots.push(variable(types, data_type, raw));
            ObjectCode::Var
        }
    };
    let slots = &mut memory.slots;
    if slots.len() > MAX_ITEMS {
        return Err(c.error_within(
            position,
            dictionary,
            EsiProblem::TooLarge {
                what: "an object's subindices",
                limit: MAX_ITEMS,
            },
        ));
    }
    if code != ObjectCode::Var {
        assign_infos(slots, &raw.info.sub_items);
    }
    let nothing = Info::default();
    let mut items = Vec::with_capacity(slots.len());
    let block = match &raw.info.default {
        Some(Literal::Data(block)) => number::hex_bytes(block),
        _ => None,
    };
    for slot in slots {
        if slot.bit_len > MAX_ITEM_BITS {
            let what = "an object's bits";
            return Err(c.error_within(
                position,
                dictionary,
                EsiProblem::TooLarge {
                    what,
                    limit: usize::try_from(MAX_ITEM_BITS).unwrap_or(0),
                },
            ));
        }
        let (name, own) = match slot.info {
            Some(item) => (&*item.0, &item.1),
            None if code == ObjectCode::Var => ("", &raw.info),
            None => ("", &nothing),
        };
        if slot.bit_len == 0
            && let Some(Literal::Text(text)) = &own.default
        {
            slot.bit_len = u32::try_from(text.len())
                .unwrap_or(0)
                .saturating_mul(8)
                .min(MAX_ITEM_BITS);
        }
        let length = usize::try_from(slot.bit_len.div_ceil(8)).unwrap_or(0);
        let range = [&own.min, &own.max].into_iter().flatten().count();
        let names = name.len() + slot.name.len() + slot.type_name.len();
        c.spend(
            length.saturating_mul(1 + range) + size_of::<ObjectItem>() + names,
            place,
        )?;
        let mut read = |literal: &Literal<'a>, what: &str| -> Option<Bytes> {
            match literal::bytes(literal, slot.type_name, slot.bit_len) {
                Ok(bytes) => bytes,
                Err(problem) => {
                    c.warn_at(
                        position,
                        dictionary,
                        format!("object {}: {what} {problem}", address(raw.index, slot.sub)),
                    );
                    None
                }
            }
        };
        let default = own.default.as_ref();
        let default = default.and_then(|default| read(default, "default"));
        let default = default.or_else(|| match (&block, code) {
            // Older files contain a record's default as one block in complete access format.
            (Some(block), ObjectCode::Array | ObjectCode::Record) => {
                literal::slice(block, slot.bit_offset, slot.bit_len)
            }
            _ => None,
        });
        let min = own.min.as_ref().and_then(|min| read(min, "minimum"));
        let max = own.max.as_ref().and_then(|max| read(max, "maximum"));
        items.push(ObjectItem {
            sub: slot.sub,
            name: if code == ObjectCode::Var {
                raw.name.clone()
            } else {
                better_name(name, &slot.name)
            },
            type_name: slot.type_name.clone(),
            bit_len: slot.bit_len,
            bit_offset: slot.bit_offset,
            has_default: default.is_some(),
            default: default.unwrap_or_else(|| Bytes::zeroes(length)),
            min,
            max,
            access: access(slot.flags.access, raw.flags.access),
            pdo_mapping: slot
                .flags
                .pdo_mapping
                .or(raw.flags.pdo_mapping)
                .unwrap_or_default(),
            backup: slot.flags.backup.or(raw.flags.backup).unwrap_or(false),
            setting: slot.flags.setting.or(raw.flags.setting).unwrap_or(false),
            unit: own.unit,
        });
    }
    items.sort_by_key(|item| item.sub);
    Ok(Object {
        position,
        index: raw.index,
        depends_on: raw.depends_on,
        name: raw.name.clone(),
        code,
        type_name: raw.type_name.clone(),
        items,
    })
}

/// Buffers that are reused for all objects.
#[derive(Default)]
pub(super) struct ResolveCache<'t, 'a> {
    slots: Vec<UnresolvedItem<'t, 'a>>,
    /// The names of array elements, by subindex.
    names: Vec<Option<Text>>,
}

impl ResolveCache<'_, '_> {
    fn name(&mut self, sub: u8) -> Text {
        self.names.resize(256, None);
        let name = || format!("SubIndex {sub:03}").into();
        match self.names.get_mut(usize::from(sub)) {
            Some(known) => known.get_or_insert_with(name).clone(),
            None => name(),
        }
    }
}

/// An item without its default.
struct UnresolvedItem<'t, 'a> {
    sub: u8,
    name: Cow<'t, Text>,
    type_name: &'t Text,
    bit_len: u32,
    bit_offset: u32,
    flags: Flags,
    info: Option<&'t SubItem<'a>>,
}

fn variable<'t, 'a>(
    types: &'t DataTypes,
    data_type: Option<&DataType>,
    raw: &'t RawObject<'a>,
) -> UnresolvedItem<'t, 'a> {
    let type_name = types.base(&raw.type_name);
    let typed = data_type.map_or(0, |t| t.bit_size);
    let bit_len = bits_of([raw.bit_size, typed], type_name);
    UnresolvedItem {
        sub: 0,
        name: Cow::Borrowed(&raw.name),
        type_name,
        bit_len,
        bit_offset: 0,
        flags: raw.flags,
        info: None,
    }
}

fn record_items<'t, 'a>(
    c: &mut Cursor<'a>,
    types: &'t DataTypes,
    record: &'t DataType,
    (position, dictionary): (Position, &Element<'a>),
    memory: &mut ResolveCache<'t, 'a>,
) -> Result<ObjectCode, EsiError> {
    let mut code = ObjectCode::Record;
    let mut running = 0u32;
    // Neighbouring elements usually have the same type.
    let mut last: Option<(&Text, _)> = None;
    for item in &record.sub_items {
        let (sub_type, base) = match &last {
            Some((name, known)) if **name == item.type_name => *known,
            _ => types.with_base(&item.type_name),
        };
        last = Some((&item.type_name, (sub_type, base)));
        let typed = sub_type.map_or(0, |t| t.bit_size);
        let bits = bits_of([item.bit_size, typed], base);
        let offset = item.bit_offset.unwrap_or(running);
        let last_slot = memory.slots.last();
        let next_sub = last_slot.map_or(0, |slot| slot.sub.saturating_add(1));
        match (
            item.sub,
            sub_type.and_then(|t| t.arrays.first().map(|array| (t, array))),
        ) {
            (None, Some((array_type, array))) => {
                code = ObjectCode::Array;
                let element = types.base(&array_type.base);
                let elements = array.elements.min(255);
                if array.elements > 255 {
                    let message = format!(
                        "an array of {} elements; there are 255 subindices",
                        array.elements
                    );
                    c.warn_at(position, dictionary, message);
                }
                let share = bits.checked_div(array.elements).unwrap_or(0);
                let bits = match literal::base_bits(element) {
                    0 => share,
                    bits => bits,
                };
                for number in 0..elements {
                    let Ok(sub) = u8::try_from(array.lower_bound.saturating_add(number)) else {
                        break;
                    };
                    c.spend(
                        size_of::<UnresolvedItem>() + element.len(),
                        (position, dictionary),
                    )?;
                    let name = memory.name(sub);
                    memory.slots.push(UnresolvedItem {
                        sub,
                        name: Cow::Owned(name),
                        type_name: element,
                        bit_len: bits,
                        bit_offset: offset.saturating_add(bits.saturating_mul(number)),
                        flags: item.flags,
                        info: None,
                    });
                }
            }
            (sub, _) => memory.slots.push(UnresolvedItem {
                sub: sub.unwrap_or(next_sub),
                name: Cow::Borrowed(&item.name),
                type_name: base,
                bit_len: bits,
                bit_offset: offset,
                flags: item.flags,
                info: None,
            }),
        }
        // Complete access pads subindex 0 to 16 bits.
        running = if offset == 0 && memory.slots.len() == 1 {
            16
        } else {
            offset.saturating_add(bits)
        };
        if memory.slots.len() > MAX_ITEMS {
            break;
        }
    }
    Ok(code)
}

/// Assigns `Info/SubItem`s to the subindices of a record: by name, otherwise in subindex order.
fn assign_infos<'t, 'a>(slots: &mut [UnresolvedItem<'t, 'a>], infos: &'t [SubItem<'a>]) {
    let mut next = 0;
    for info in infos {
        let (name, _) = info;
        let mut rest = slots.iter().skip(next);
        let named = rest.position(|slot| !name.is_empty() && *slot.name == **name);
        let place = next.saturating_add(named.unwrap_or(0));
        let Some(slot) = slots.get_mut(place) else {
            break;
        };
        slot.info = Some(info);
        next = place.saturating_add(1);
    }
}

fn better_name(from_info: &str, from_type: &Text) -> Text {
    let generic = from_info.starts_with("SubIndex ") && !from_type.is_empty();
    if from_info.is_empty() || generic || from_type == from_info {
        from_type.clone()
    } else {
        from_info.into()
    }
}

/// Returns the access of a subindex. The states that allow writing the whole object restrict it.
fn access(item: Option<Access>, object: Option<Access>) -> Access {
    match (item, object) {
        (Some(item), Some(object))
            if item.write == Writable::Always && matches!(object.write, Writable::Only { .. }) =>
        {
            Access {
                write: object.write,
                ..item
            }
        }
        (Some(item), _) => item,
        (None, object) => object.unwrap_or_default(),
    }
}

/// Returns the first length that is not 0, or that of the base type.
fn bits_of(written: [u32; 2], type_name: &str) -> u32 {
    let bits = written.into_iter().find(|&bits| bits != 0);
    bits.unwrap_or_else(|| literal::base_bits(type_name))
}
