//! The object dictionary as one flat byte arena. Each (index, subindex) is an [`EntryHandle`]. PDO
//! copies, SDO transfers and the drive work on handles, so cyclic operation needs no lookup and no
//! allocation.

use std::ops::RangeInclusive;

use ecaxis_esi::model::{Access, Bytes, Dictionary, ObjectCode, PdoMapping, Writable};

use super::datatype::{self, Kind};
use super::word::{TAIL, WordRef};

/// The handle of an existing subindex. It stays valid for the lifetime of the store.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct EntryHandle {
    n: u32,
    place: WordRef,
}

/// The description of one subindex.
#[derive(Debug, Clone)]
pub struct Item {
    pub index: u16,
    pub sub: u8,
    pub name: String,
    pub bit_len: u32,
    /// The offset inside the object under complete access (subindex 0 takes 16 bits).
    pub bit_offset: u32,
    /// The index of the base type (ETG.1020), as in SDO Information.
    pub data_type: u16,
    pub(crate) kind: Kind,
    pub access: Access,
    pub mapping: PdoMapping,
    pub backup: bool,
    pub setting: bool,
    /// The unit code of ETG.1004; 0 without a unit.
    pub unit: u32,
    pub has_default: bool,
    /// The minimum, little-endian, with the length of the item.
    pub min: Option<Bytes>,
    pub max: Option<Bytes>,
    /// The only values that a client may write.
    pub choices: Option<&'static [i64]>,
    /// A client's write is confirmed and changes nothing.
    pub ignores_writes: bool,
    place: WordRef,
}

impl Item {
    /// True for two's complement values; [`ObjectStore::get`] then extends the sign.
    #[must_use]
    pub fn signed(&self) -> bool {
        self.kind == Kind::Signed
    }
}

/// The description of an object as a whole.
#[derive(Debug, Clone)]
struct Object {
    index: u16,
    name: String,
    code: ObjectCode,
}

/// All objects of one device.
#[derive(Debug, Clone, Default)]
pub struct ObjectStore {
    /// The values of all items. The last [`TAIL`] bytes belong to no item, so each item can be read
    /// as a whole word.
    arena: Vec<u8>,
    /// Counts changes, except by [`ObjectStore::show`] and [`ObjectStore::exchange_mut`].
    edits: u64,
    /// The arena with the default values.
    defaults: Vec<u8>,
    /// Sorted by index. Contains only described objects.
    objects: Vec<Object>,
    items: Vec<Item>,
    /// Sorted by (index, subindex).
    order: Vec<(u32, EntryHandle)>,
}

fn key(index: u16, sub: u8) -> u32 {
    u32::from(index) << 8 | u32::from(sub)
}

impl ObjectStore {
    /// Creates the objects of all dictionaries. A later dictionary replaces objects of the same
    /// index.
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
                    // ETG.1000.6: subindex 0 of an object with subindices is an UNSIGNED8. Some
                    // files describe it with the 16 bits that it takes under complete access.
                    let is_count = item.sub == 0 && object.code != ObjectCode::Var;
                    let (bit_len, data_type) = match item.bit_len {
                        16 if is_count => (8, datatype::unsigned(8)),
                        bits => (bits, data_type(&item.type_name, bits)),
                    };
                    store.insert(
                        Item {
                            index: object.index,
                            sub: item.sub,
                            name: if item.name.is_empty() {
                                object.name.to_string()
                            } else {
                                item.name.to_string()
                            },
                            bit_len,
                            bit_offset: item.bit_offset,
                            data_type,
                            kind: datatype::kind(data_type, bit_len),
                            access: item.access,
                            mapping: item.pdo_mapping,
                            backup: item.backup,
                            setting: item.setting,
                            unit: item.unit,
                            has_default: item.has_default,
                            min: item.min.clone(),
                            max: item.max.clone(),
                            choices: None,
                            ignores_writes: false,
                            place: WordRef::new(0, 0, false),
                        },
                        &item.default,
                    );
                }
            }
        }
        store.keep_defaults();
        store
    }

    /// Sets the name and the object code of an object that the dictionary does not describe.
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

    /// Returns the name of the object, or of its first item if the object has no name.
    #[must_use]
    pub fn object_name(&self, index: u16) -> &str {
        let first = || {
            let slot = self.object(index).next()?;
            self.item(slot).map(|item| item.name.as_str())
        };
        let described = self.description(index).map(|object| object.name.as_str());
        described.or_else(first).unwrap_or_default()
    }

    /// Returns the object code. Without a description, an object with several subindices is a
    /// record.
    #[must_use]
    pub fn object_code(&self, index: u16) -> ObjectCode {
        match self.description(index).map(|object| object.code) {
            Some(code @ (ObjectCode::Array | ObjectCode::Record)) => code,
            _ if self.highest_sub(index) == 0 => ObjectCode::Var,
            _ => ObjectCode::Record,
        }
    }

    /// Returns the highest existing subindex.
    #[must_use]
    pub fn highest_sub(&self, index: u16) -> u8 {
        let last = self.object(index).last();
        last.and_then(|slot| self.item(slot))
            .map_or(0, |item| item.sub)
    }

    /// Returns the indices of all objects in ascending order.
    pub fn indices(&self) -> impl Iterator<Item = u16> + '_ {
        let mut before = None;
        self.order.iter().filter_map(move |(key, _)| {
            let index = (key >> 8) as u16;
            (before.replace(index) != Some(index)).then_some(index)
        })
    }

    /// Returns all subindices of all objects.
    pub fn slots(&self) -> impl Iterator<Item = EntryHandle> + '_ {
        self.order.iter().map(|(_, slot)| *slot)
    }

    /// Makes the present values the defaults. SDO Information reports defaults; 0x1011 restores
    /// them.
    pub(crate) fn keep_defaults(&mut self) {
        self.defaults.clone_from(&self.arena);
    }

    pub(crate) fn default_bytes(&self, slot: EntryHandle) -> &[u8] {
        self.defaults.get(slot.place.range()).unwrap_or_default()
    }

    /// Copies one value from a store with the same entries.
    pub(crate) fn copy_from(&mut self, other: &Self, slot: EntryHandle) {
        overwrite(self.bytes_mut(slot), other.bytes(slot));
    }

    pub(crate) fn restore(&mut self, slot: EntryHandle) {
        self.edits += 1;
        let range = slot.place.range();
        let (to, from) = (self.arena.get_mut(range.clone()), self.defaults.get(range));
        if let (Some(to), Some(from)) = (to, from) {
            overwrite(to, from);
        }
    }

    /// Returns the handle of an existing subindex.
    #[must_use]
    pub fn slot(&self, index: u16, sub: u8) -> Option<EntryHandle> {
        let key = key(index, sub);
        let at = self.order.binary_search_by_key(&key, |(k, _)| *k).ok()?;
        self.order.get(at).map(|(_, slot)| *slot)
    }

    /// Returns the handle of a subindex and creates the subindex if the ESI lacks it. Created items
    /// are readable over CoE like any other. An existing item keeps its length, access and value.
    /// [`Self::get`] reads created items as unsigned; use [`Self::get_signed`] for signed ones.
    pub fn ensure(
        &mut self,
        index: u16,
        sub: u8,
        name: &str,
        bit_len: u32,
        access: Access,
        default: &[u8],
    ) -> EntryHandle {
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
        // Objects of the communication area (below 0x2000) are not mappable.
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
                ignores_writes: false,
                place: WordRef::new(0, 0, false),
            },
            default,
        )
    }

    fn insert(&mut self, mut item: Item, default: &[u8]) -> EntryHandle {
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
        item.place = WordRef::new(start, item.bit_len, item.signed());
        self.edits += 1;
        let slot = EntryHandle {
            n: u32::try_from(self.items.len()).unwrap_or(u32::MAX),
            place: item.place,
        };
        self.items.push(item);
        match self.order.binary_search_by_key(&key, |(k, _)| *k) {
            // A file may contain the same subindex twice; the later one counts.
            Ok(at) => self.order[at].1 = slot,
            Err(at) => self.order.insert(at, (key, slot)),
        }
        slot
    }

    /// Replaces an item that its dictionary makes too short by a later item of `bits` bits.
    pub(super) fn lengthen(&mut self, slot: EntryHandle, bits: u32) -> EntryHandle {
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

    /// Returns the entries of the object in subindex order; empty if the object does not exist.
    pub fn object(&self, index: u16) -> impl Iterator<Item = EntryHandle> + '_ {
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
    pub fn item(&self, slot: EntryHandle) -> Option<&Item> {
        self.items.get(slot.n as usize)
    }

    /// Sets whether CoE clients may write an item.
    pub fn set_access(&mut self, slot: EntryHandle, write: Writable) {
        if let Some(item) = self.items.get_mut(slot.n as usize) {
            item.access.write = write;
        }
    }

    /// Restricts the values that CoE clients may write.
    pub fn set_choices(&mut self, slot: EntryHandle, choices: &'static [i64]) {
        if let Some(item) = self.items.get_mut(slot.n as usize) {
            item.choices = Some(choices);
        }
    }

    /// Makes the item keep its value when a CoE client writes it.
    pub fn ignore_writes(&mut self, slot: EntryHandle) {
        if let Some(item) = self.items.get_mut(slot.n as usize) {
            item.ignores_writes = true;
        }
    }

    /// Sets the base type of an item that [`Self::ensure`] created. Unknown names change nothing.
    pub fn set_type(&mut self, slot: EntryHandle, name: &str) {
        if let (Some(item), code @ 1..) =
            (self.items.get_mut(slot.n as usize), datatype::code(name))
        {
            item.data_type = code;
        }
    }

    /// Returns the value, sign-extended for signed types. Long items yield their low 64 bits.
    #[must_use]
    pub fn get(&self, slot: EntryHandle) -> i64 {
        slot.place.get(&self.arena)
    }

    /// Returns the value as two's complement of its length, regardless of the data type.
    #[must_use]
    pub fn get_signed(&self, slot: EntryHandle) -> i64 {
        slot.place.get_signed(&self.arena)
    }

    /// Stores the low `bit_len` bits of the value, little-endian.
    pub fn set(&mut self, slot: EntryHandle, value: i64) {
        self.edits += 1;
        slot.place.set(&mut self.arena, value);
    }

    /// Like [`Self::set`], but does not count as an edit. For values that the application never
    /// reads.
    pub(crate) fn show(&mut self, slot: EntryHandle, value: i64) {
        slot.place.set(&mut self.arena, value);
    }

    /// Returns a counter that grows with every change that may affect an application.
    pub(crate) fn edits(&self) -> u64 {
        self.edits
    }

    /// Returns `bit_len.div_ceil(8)` bytes, little-endian.
    #[must_use]
    pub fn bytes(&self, slot: EntryHandle) -> &[u8] {
        self.arena.get(slot.place.range()).unwrap_or_default()
    }

    pub fn bytes_mut(&mut self, slot: EntryHandle) -> &mut [u8] {
        self.edits += 1;
        self.exchange_mut(slot)
    }

    /// Like [`Self::bytes_mut`], but does not count as an edit. For received process data.
    pub(crate) fn exchange_mut(&mut self, slot: EntryHandle) -> &mut [u8] {
        self.arena.get_mut(slot.place.range()).unwrap_or_default()
    }
}

/// Returns the index of the base type; for an unknown name, a type of the same length.
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
    fn set_changes_only_the_bits_of_the_item() {
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
    fn set_leaves_neighbouring_items_unchanged() {
        let mut store = ObjectStore::default();
        let lengths = [1, 7, 8, 12, 16, 0, 24, 32, 33, 48, 63, 64, 80, 8];
        let slots: Vec<EntryHandle> = (0..)
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
    fn ensure_creates_an_entry_once() {
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
