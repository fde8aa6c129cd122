//! The object dictionary as one flat byte arena. Every (index, subindex) is a [`Slot`]; PDO copies,
//! SDO transfers and the drive all work on slots, so that nothing is looked up or allocated while
//! cycling.

use std::ops::RangeInclusive;

use ecaxis_esi::model::{Access, Bytes, Dictionary, ObjectCode, PdoMapping, Writable};

use super::datatype::{self, Kind};
use super::place::{Place, TAIL};

/// A subindex that exists, as a handle that stays valid for the store's life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Slot {
    n: u32,
    place: Place,
}

/// What the dictionary says about one subindex.
#[derive(Debug, Clone)]
pub struct Item {
    pub index: u16,
    pub sub: u8,
    pub name: String,
    pub bit_len: u32,
    /// Offset inside the object under complete access (subindex 0 takes 16 bits).
    pub bit_offset: u32,
    /// Index of the base type (ETG.1020), as SDO Information tells it.
    pub data_type: u16,
    pub(crate) kind: Kind,
    pub access: Access,
    pub mapping: PdoMapping,
    pub backup: bool,
    pub setting: bool,
    /// ETG.1004; 0 where there is none.
    pub unit: u32,
    pub has_default: bool,
    /// Little-endian, of the item's length.
    pub min: Option<Bytes>,
    pub max: Option<Bytes>,
    /// The only values that a client may write.
    pub choices: Option<&'static [i64]>,
    place: Place,
}

impl Item {
    /// Two's complement: [`ObjectStore::get`] extends the sign.
    #[must_use]
    pub fn signed(&self) -> bool {
        self.kind == Kind::Signed
    }
}

/// What the dictionary says about an object as a whole.
#[derive(Debug, Clone)]
struct Object {
    index: u16,
    name: String,
    code: ObjectCode,
}

/// All objects of one device.
#[derive(Debug, Clone, Default)]
pub struct ObjectStore {
    /// Ends with [`TAIL`] bytes of no item, so that every item can be read as a whole word.
    arena: Vec<u8>,
    /// Changes, except by [`ObjectStore::show`] and [`ObjectStore::exchange_mut`].
    edits: u64,
    /// The arena as the device left its maker.
    defaults: Vec<u8>,
    /// Sorted by index; objects nobody described are not in it.
    objects: Vec<Object>,
    items: Vec<Item>,
    /// Sorted by (index, subindex).
    order: Vec<(u32, Slot)>,
}

fn key(index: u16, sub: u8) -> u32 {
    u32::from(index) << 8 | u32::from(sub)
}

impl ObjectStore {
    /// Objects of all dictionaries; a later dictionary's object replaces an earlier one of the same index.
    #[must_use]
    pub fn from_dictionary(dictionaries: &[&Dictionary]) -> Self {
        let mut store = Self::default();
        for (n, dictionary) in dictionaries.iter().enumerate() {
            for object in &dictionary.objects {
                if dictionaries
                    .iter()
                    .skip(n + 1)
                    .any(|d| d.object(object.index).is_some())
                {
                    continue;
                }
                store.describe(object.index, object.code, &object.name);
                for item in &object.items {
                    let data_type = data_type(&item.type_name, item.bit_len);
                    store.insert(
                        Item {
                            index: object.index,
                            sub: item.sub,
                            name: if item.name.is_empty() {
                                object.name.to_string()
                            } else {
                                item.name.to_string()
                            },
                            bit_len: item.bit_len,
                            bit_offset: item.bit_offset,
                            data_type,
                            kind: datatype::kind(data_type, item.bit_len),
                            access: item.access,
                            mapping: item.pdo_mapping,
                            backup: item.backup,
                            setting: item.setting,
                            unit: item.unit,
                            has_default: item.has_default,
                            min: item.min.clone(),
                            max: item.max.clone(),
                            choices: None,
                            place: Place::new(0, 0, false),
                        },
                        &item.default,
                    );
                }
            }
        }
        store.keep_defaults();
        store
    }

    /// Says what an object is called and made of that the dictionary does not describe.
    pub fn describe(&mut self, index: u16, code: ObjectCode, name: &str) {
        if let Err(at) = self.objects.binary_search_by_key(&index, |o| o.index) {
            let object = Object {
                index,
                name: name.to_owned(),
                code,
            };
            self.objects.insert(at, object);
        }
    }

    fn description(&self, index: u16) -> Option<&Object> {
        let at = self
            .objects
            .binary_search_by_key(&index, |o| o.index)
            .ok()?;
        self.objects.get(at)
    }

    /// The object's name; its first item's where nobody said.
    #[must_use]
    pub fn object_name(&self, index: u16) -> &str {
        let first = || {
            let slot = self.object(index).next()?;
            self.item(slot).map(|item| item.name.as_str())
        };
        let described = self.description(index).map(|object| object.name.as_str());
        described.or_else(first).unwrap_or_default()
    }

    /// What the object is made of; several subindices make a record where nobody knows better.
    #[must_use]
    pub fn object_code(&self, index: u16) -> ObjectCode {
        match self.description(index).map(|object| object.code) {
            Some(code @ (ObjectCode::Array | ObjectCode::Record)) => code,
            _ if self.highest_sub(index) == 0 => ObjectCode::Var,
            _ => ObjectCode::Record,
        }
    }

    /// The highest subindex there is.
    #[must_use]
    pub fn highest_sub(&self, index: u16) -> u8 {
        let last = self.object(index).last();
        last.and_then(|slot| self.item(slot))
            .map_or(0, |item| item.sub)
    }

    /// Indices of all objects, rising.
    pub fn indices(&self) -> impl Iterator<Item = u16> + '_ {
        let mut before = None;
        self.order.iter().filter_map(move |(key, _)| {
            let index = (key >> 8) as u16;
            (before.replace(index) != Some(index)).then_some(index)
        })
    }

    /// All subindices of all objects.
    pub fn slots(&self) -> impl Iterator<Item = Slot> + '_ {
        self.order.iter().map(|(_, slot)| *slot)
    }

    /// Makes the present values the defaults: what SDO Information tells and a restore brings back.
    pub(crate) fn keep_defaults(&mut self) {
        self.defaults.clone_from(&self.arena);
    }

    pub(crate) fn default_bytes(&self, slot: Slot) -> &[u8] {
        self.defaults.get(slot.place.range()).unwrap_or_default()
    }

    /// Copies one value from a store that has the same slots.
    pub(crate) fn copy_from(&mut self, other: &Self, slot: Slot) {
        overwrite(self.bytes_mut(slot), other.bytes(slot));
    }

    pub(crate) fn restore(&mut self, slot: Slot) {
        self.edits += 1;
        let range = slot.place.range();
        let (to, from) = (self.arena.get_mut(range.clone()), self.defaults.get(range));
        if let (Some(to), Some(from)) = (to, from) {
            overwrite(to, from);
        }
    }

    /// The slot of an existing subindex.
    #[must_use]
    pub fn slot(&self, index: u16, sub: u8) -> Option<Slot> {
        let key = key(index, sub);
        let at = self.order.binary_search_by_key(&key, |(k, _)| *k).ok()?;
        self.order.get(at).map(|(_, slot)| *slot)
    }

    /// The slot of a subindex, created (readable over CoE like any other) where the ESI lacks it.
    /// An existing one keeps its length, access and value. Created items read as unsigned through
    /// [`Self::get`]; use [`Self::get_signed`] where the profile says otherwise.
    pub fn ensure(
        &mut self,
        index: u16,
        sub: u8,
        name: &str,
        bit_len: u32,
        access: Access,
        default: &[u8],
    ) -> Slot {
        if let Some(slot) = self.slot(index, sub) {
            return slot;
        }
        let bit_offset = if sub == 0 {
            0
        } else {
            self.object(index)
                .filter_map(|slot| self.item(slot))
                .filter(|item| item.sub > 0 && item.sub < sub)
                .map(|item| item.bit_offset + item.bit_len)
                .max()
                .unwrap_or(16)
        };
        // What the standards call the communication area stays out of process data.
        let mappable = index >= 0x2000;
        self.insert(
            Item {
                index,
                sub,
                name: name.to_owned(),
                bit_len,
                bit_offset,
                data_type: datatype::unsigned(bit_len),
                kind: datatype::kind(datatype::unsigned(bit_len), bit_len),
                access,
                mapping: PdoMapping {
                    rx: mappable,
                    tx: mappable,
                },
                backup: false,
                setting: false,
                unit: 0,
                has_default: false,
                min: None,
                max: None,
                choices: None,
                place: Place::new(0, 0, false),
            },
            default,
        )
    }

    fn insert(&mut self, mut item: Item, default: &[u8]) -> Slot {
        let key = key(item.index, item.sub);
        let len = usize::try_from(item.bit_len.div_ceil(8)).unwrap_or(0);
        let start = self.arena.len().saturating_sub(TAIL);
        self.arena.truncate(start);
        self.arena.extend(
            default
                .iter()
                .copied()
                .chain(std::iter::repeat(0))
                .take(len)
                .chain([0; TAIL]),
        );
        item.place = Place::new(start, item.bit_len, item.signed());
        self.edits += 1;
        let slot = Slot {
            n: u32::try_from(self.items.len()).unwrap_or(u32::MAX),
            place: item.place,
        };
        self.items.push(item);
        match self.order.binary_search_by_key(&key, |(k, _)| *k) {
            // The same subindex twice in one file: the later one counts.
            Ok(at) => self.order[at].1 = slot,
            Err(at) => self.order.insert(at, (key, slot)),
        }
        slot
    }

    /// Gives an item that its dictionary makes too short the length that it has to have; the later one counts.
    pub(super) fn lengthen(&mut self, slot: Slot, bits: u32) -> Slot {
        let Some(short) = self.item(slot).filter(|item| item.bit_len < bits).cloned() else {
            return slot;
        };
        let data_type = datatype::unsigned(bits);
        let item = Item {
            bit_len: bits,
            bit_offset: 16 + u32::from(short.sub.saturating_sub(1)) * bits,
            data_type,
            kind: datatype::kind(data_type, bits),
            min: None,
            max: None,
            ..short
        };
        self.insert(item, &[])
    }

    /// The object's slots in subindex order; empty where there is no such object.
    pub fn object(&self, index: u16) -> impl Iterator<Item = Slot> + '_ {
        let start = self.order.partition_point(|(k, _)| *k < key(index, 0));
        self.order
            .get(start..)
            .unwrap_or_default()
            .iter()
            .take_while(move |(k, _)| k >> 8 == u32::from(index))
            .map(|(_, slot)| *slot)
    }

    #[must_use]
    pub fn has_object(&self, index: u16) -> bool {
        self.object(index).next().is_some()
    }

    #[must_use]
    pub fn has_any(&self, indices: RangeInclusive<u16>) -> bool {
        let start = self
            .order
            .partition_point(|(k, _)| *k < key(*indices.start(), 0));
        self.order
            .get(start)
            .is_some_and(|(k, _)| *k <= key(*indices.end(), u8::MAX))
    }

    #[must_use]
    pub fn item(&self, slot: Slot) -> Option<&Item> {
        self.items.get(slot.n as usize)
    }

    /// Lets CoE clients write (or no longer write) an item.
    pub fn set_access(&mut self, slot: Slot, write: Writable) {
        if let Some(item) = self.items.get_mut(slot.n as usize) {
            item.access.write = write;
        }
    }

    /// Makes CoE clients write nothing but these values.
    pub fn set_choices(&mut self, slot: Slot, choices: &'static [i64]) {
        if let Some(item) = self.items.get_mut(slot.n as usize) {
            item.choices = Some(choices);
        }
    }

    /// Names the base type of an item that [`Self::ensure`] created; unknown names change nothing.
    pub fn set_type(&mut self, slot: Slot, name: &str) {
        if let (Some(item), code @ 1..) =
            (self.items.get_mut(slot.n as usize), datatype::code(name))
        {
            item.data_type = code;
        }
    }

    /// The value, sign-extended if the dictionary's type is signed; of long items the low 64 bits.
    #[must_use]
    pub fn get(&self, slot: Slot) -> i64 {
        slot.place.get(&self.arena)
    }

    /// The value as two's complement of its length, whatever the dictionary says.
    #[must_use]
    pub fn get_signed(&self, slot: Slot) -> i64 {
        slot.place.get_signed(&self.arena)
    }

    /// Stores the low `bit_len` bits of the value, little-endian.
    pub fn set(&mut self, slot: Slot, value: i64) {
        self.edits += 1;
        slot.place.set(&mut self.arena, value);
    }

    /// As [`Self::set`], for what an application shows of itself and never reads: it is no edit.
    pub(crate) fn show(&mut self, slot: Slot, value: i64) {
        slot.place.set(&mut self.arena, value);
    }

    /// Grows with every change that may concern what an application works by.
    pub(crate) fn edits(&self) -> u64 {
        self.edits
    }

    /// Little-endian, `bit_len.div_ceil(8)` bytes.
    #[must_use]
    pub fn bytes(&self, slot: Slot) -> &[u8] {
        self.arena.get(slot.place.range()).unwrap_or_default()
    }

    pub fn bytes_mut(&mut self, slot: Slot) -> &mut [u8] {
        self.edits += 1;
        self.exchange_mut(slot)
    }

    /// As [`Self::bytes_mut`], for process data that has just arrived: it is no edit.
    pub(crate) fn exchange_mut(&mut self, slot: Slot) -> &mut [u8] {
        self.arena.get_mut(slot.place.range()).unwrap_or_default()
    }
}

/// The base type's index; a type without one is judged by its length.
fn data_type(name: &str, bit_len: u32) -> u16 {
    match datatype::code(name) {
        0 => datatype::unsigned(bit_len),
        code => code,
    }
}

fn overwrite(to: &mut [u8], from: &[u8]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to = *from;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ecaxis_esi::model::{Object, ObjectItem};

    fn dictionary(default: u8) -> Dictionary {
        let item = |sub, type_name: &str, bit_len, default: Vec<u8>| ObjectItem {
            sub,
            type_name: type_name.into(),
            bit_len,
            default: default.into(),
            ..ObjectItem::default()
        };
        Dictionary {
            objects: vec![Object {
                index: 0x6064,
                items: vec![
                    item(0, "DINT", 32, vec![default, 0xff, 0xff, 0xff]),
                    item(3, "BOOL", 1, vec![1]),
                ],
                ..Object::default()
            }],
        }
    }

    #[test]
    fn values_extend_by_type_and_later_dictionaries_win() {
        let store = ObjectStore::from_dictionary(&[&dictionary(0xfd), &dictionary(0xfe)]);
        let slot = store.slot(0x6064, 0).unwrap();
        assert_eq!(store.get(slot), -2);
        assert_eq!(store.object(0x6064).count(), 2);
        assert_eq!(store.slot(0x6064, 1), None);
        assert_eq!(store.slot(0x6065, 0), None);
    }

    #[test]
    fn set_keeps_to_the_items_bits() {
        let mut store = ObjectStore::from_dictionary(&[&dictionary(0)]);
        let wide = store.slot(0x6064, 0).unwrap();
        let bit = store.slot(0x6064, 3).unwrap();
        store.set(bit, 0xff);
        assert_eq!(store.bytes(bit), [1]);
        store.set(wide, -5);
        assert_eq!(store.get(wide), -5);
        assert_eq!(store.get(bit), 1);
    }

    #[test]
    fn items_of_every_length_keep_to_themselves() {
        let mut store = ObjectStore::default();
        let lengths = [1, 7, 8, 12, 16, 0, 24, 32, 33, 48, 63, 64, 80, 8];
        let slots: Vec<Slot> = (0..)
            .zip(lengths)
            .map(|(sub, bits)| store.ensure(0x2000, sub, "n", bits, Access::default(), &[]))
            .collect();
        for value in [-1, 0, 1, i64::MIN, 0x5a5a_a5a5_5a5a_a5a5] {
            for slot in &slots {
                store.set(*slot, value);
            }
            for (slot, bits) in slots.iter().zip(lengths) {
                let bits = bits.min(64);
                let (plain, signed) = (store.get(*slot), store.get_signed(*slot));
                if bits == 0 {
                    assert_eq!((plain, signed), (0, 0));
                    continue;
                }
                let unused = 64 - bits;
                let cut = value.cast_unsigned() << unused;
                assert_eq!(plain.cast_unsigned(), cut >> unused, "{bits} bits");
                assert_eq!(signed, cut.cast_signed() >> unused, "{bits} bits");
                let len = usize::try_from(bits).unwrap().div_ceil(8);
                let bytes = plain.to_le_bytes();
                assert_eq!(store.bytes(*slot)[..len], bytes[..len], "{bits} bits");
            }
        }
    }

    #[test]
    fn ensure_creates_once_and_is_found() {
        let mut store = ObjectStore::default();
        let a = store.ensure(0x2000, 1, "new", 16, Access::default(), &[0xfe, 0xff]);
        let b = store.ensure(0x2000, 2, "next", 32, Access::default(), &[]);
        assert_eq!(
            store.ensure(0x2000, 1, "other", 8, Access::default(), &[]),
            a
        );
        assert_eq!(store.slot(0x2000, 1), Some(a));
        assert_eq!((store.get(a), store.get_signed(a)), (0xfffe, -2));
        assert_eq!(store.item(b).unwrap().bit_offset, 32);
    }
}
