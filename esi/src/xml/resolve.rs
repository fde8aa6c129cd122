//! Objects and data types joined: every subindex becomes an item with its own length, offset, default, range
//! and access.

use std::borrow::Cow;

use super::cursor::{Cursor, Element};
use super::datatype::{DataType, DataTypes};
use super::literal;
use super::number;
use super::object::{Flags, Info, Literal, RawObject};
use crate::error::{EsiError, EsiProblem};
use crate::model::{Access, Object, ObjectCode, ObjectItem, Position, Writable};

/// One MiB; longer objects (files, domains) carry no default and are transferred by length.
const MAX_ITEM_BITS: u32 = 8 << 20;
const MAX_ITEMS: usize = 256;

pub(super) fn object<'a>(
    c: &mut Cursor<'a>,
    dictionary: &Element<'a>,
    types: &DataTypes,
    mut raw: RawObject<'a>,
) -> Result<Object, EsiError> {
    let sub_infos = std::mem::take(&mut raw.info.sub_items);
    let data_type = types.get(&raw.type_name);
    let (code, mut slots) = match data_type {
        Some(record) if !record.sub_items.is_empty() => {
            record_items(c, types, record, (raw.position, dictionary))?
        }
        _ => (ObjectCode::Var, vec![variable(types, data_type, &raw)]),
    };
    if slots.len() > MAX_ITEMS {
        return Err(c.error_within(
            raw.position,
            dictionary,
            EsiProblem::TooLarge {
                what: "an object's subindices",
                limit: MAX_ITEMS,
            },
        ));
    }
    let mut infos = assign_infos(&slots, code, sub_infos);
    let mut items = Vec::with_capacity(slots.len());
    let place = (raw.position, dictionary);
    let block = match &raw.info.default {
        Some(Literal::Data(block)) => number::hex_bytes(block),
        _ => None,
    };
    for (slot, info) in slots.iter_mut().zip(infos.iter_mut()) {
        if slot.bit_len > MAX_ITEM_BITS {
            let what = "an object's bits";
            return Err(c.error_within(
                raw.position,
                dictionary,
                EsiProblem::TooLarge {
                    what,
                    limit: usize::try_from(MAX_ITEM_BITS).unwrap_or(0),
                },
            ));
        }
        let (name, info) = info.take().unwrap_or_default();
        let own = if code == ObjectCode::Var {
            &raw.info
        } else {
            &info
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
        let mut read = |literal: &Option<Literal<'a>>, what: &str| -> Option<Vec<u8>> {
            match literal::bytes(literal.as_ref()?, slot.type_name, slot.bit_len) {
                Ok(bytes) => bytes,
                Err(problem) => {
                    c.warn_at(
                        raw.position,
                        dictionary,
                        format!(
                            "object 0x{:04x}:{:02x}: {what} {problem}",
                            raw.index, slot.sub
                        ),
                    );
                    None
                }
            }
        };
        let default = read(&own.default, "default").or_else(|| match (&block, code) {
            // Older files give a record's default as one block, as complete access would carry it.
            (Some(block), ObjectCode::Array | ObjectCode::Record) => {
                literal::slice(block, slot.bit_offset, slot.bit_len)
            }
            _ => None,
        });
        let (min, max) = (read(&own.min, "minimum"), read(&own.max, "maximum"));
        items.push(ObjectItem {
            sub: slot.sub,
            name: if code == ObjectCode::Var {
                raw.name.clone()
            } else {
                better_name(name, &slot.name)
            },
            type_name: slot.type_name.to_owned(),
            bit_len: slot.bit_len,
            bit_offset: slot.bit_offset,
            has_default: default.is_some(),
            default: default.unwrap_or_else(|| vec![0; length]),
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
        position: raw.position,
        index: raw.index,
        depends_on: raw.depends_on,
        name: raw.name,
        code,
        type_name: raw.type_name,
        items,
    })
}

/// An item before its default is known.
struct Slot<'t> {
    sub: u8,
    name: Cow<'t, str>,
    type_name: &'t str,
    bit_len: u32,
    bit_offset: u32,
    flags: Flags,
}

fn variable<'t>(
    types: &'t DataTypes,
    data_type: Option<&DataType>,
    raw: &'t RawObject<'_>,
) -> Slot<'t> {
    let type_name = types.base(&raw.type_name);
    let typed = data_type.map_or(0, |t| t.bit_size);
    let bit_len = first_non_zero([raw.bit_size, typed, literal::base_bits(type_name)]);
    Slot {
        sub: 0,
        name: Cow::Borrowed(&raw.name),
        type_name,
        bit_len,
        bit_offset: 0,
        flags: raw.flags,
    }
}

fn record_items<'t, 'a>(
    c: &mut Cursor<'a>,
    types: &'t DataTypes,
    record: &'t DataType,
    (position, dictionary): (Position, &Element<'a>),
) -> Result<(ObjectCode, Vec<Slot<'t>>), EsiError> {
    let mut code = ObjectCode::Record;
    let mut slots: Vec<Slot<'t>> = Vec::with_capacity(record.sub_items.len());
    let mut running = 0u32;
    for item in &record.sub_items {
        let (sub_type, base) = types.with_base(&item.type_name);
        let typed = sub_type.map_or(0, |t| t.bit_size);
        let bits = first_non_zero([item.bit_size, typed, literal::base_bits(base)]);
        let offset = item.bit_offset.unwrap_or(running);
        let next_sub = slots.last().map_or(0, |slot| slot.sub.saturating_add(1));
        match (
            item.sub,
            sub_type.and_then(|t| t.arrays.first().map(|array| (t, array))),
        ) {
            (None, Some((array_type, array))) => {
                code = ObjectCode::Array;
                let element = types.base(array_type.base.as_deref().unwrap_or_default());
                let elements = array.elements.min(255);
                if array.elements > 255 {
                    let message = format!(
                        "an array of {} elements; there are 255 subindices",
                        array.elements
                    );
                    c.warn_at(position, dictionary, message);
                }
                let share = bits.checked_div(array.elements).unwrap_or(0);
                let bits = first_non_zero([literal::base_bits(element), share, 0]);
                for number in 0..elements {
                    let Ok(sub) = u8::try_from(array.lower_bound.saturating_add(number)) else {
                        break;
                    };
                    c.spend(size_of::<Slot>() + element.len(), (position, dictionary))?;
                    slots.push(Slot {
                        sub,
                        name: Cow::Owned(format!("SubIndex {sub:03}")),
                        type_name: element,
                        bit_len: bits,
                        bit_offset: offset.saturating_add(bits.saturating_mul(number)),
                        flags: item.flags,
                    });
                }
            }
            (sub, _) => slots.push(Slot {
                sub: sub.unwrap_or(next_sub),
                name: Cow::Borrowed(&item.name),
                type_name: base,
                bit_len: bits,
                bit_offset: offset,
                flags: item.flags,
            }),
        }
        // Complete access pads subindex 0 to 16 bits.
        running = if offset == 0 && slots.len() == 1 {
            16
        } else {
            offset.saturating_add(bits)
        };
        if slots.len() > MAX_ITEMS {
            break;
        }
    }
    Ok((code, slots))
}

/// `Info/SubItem`s name the subindices of a record; where they do not, they stand in subindex order.
fn assign_infos<'a>(
    slots: &[Slot<'_>],
    code: ObjectCode,
    infos: Vec<(String, Info<'a>)>,
) -> Vec<Option<(String, Info<'a>)>> {
    let mut assigned: Vec<Option<(String, Info<'a>)>> = slots.iter().map(|_| None).collect();
    if code == ObjectCode::Var {
        return assigned;
    }
    let mut next = 0;
    for (name, info) in infos {
        let named = slots
            .iter()
            .skip(next)
            .position(|slot| !name.is_empty() && slot.name == name);
        let place = next.saturating_add(named.unwrap_or(0));
        let Some(entry) = assigned.get_mut(place) else {
            break;
        };
        *entry = Some((name, info));
        next = place.saturating_add(1);
    }
    assigned
}

fn better_name(from_info: String, from_type: &str) -> String {
    if from_info.is_empty() || (from_info.starts_with("SubIndex ") && !from_type.is_empty()) {
        from_type.to_owned()
    } else {
        from_info
    }
}

/// A subindex's own access; the states in which the whole object may be written narrow it.
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

fn first_non_zero(candidates: [u32; 3]) -> u32 {
    candidates.into_iter().find(|&bits| bits != 0).unwrap_or(0)
}
