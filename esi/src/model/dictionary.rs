//! The object dictionary.

use super::{Bytes, Position, SlotDependence, Text};

/// Objects in file order with resolved types. Each readable subindex is an item of its object.
#[derive(Debug, Clone, Default)]
pub struct Dictionary {
    pub objects: Vec<Object>,
}

impl Dictionary {
    #[must_use]
    pub fn object(&self, index: u16) -> Option<&Object> {
        self.objects.iter().find(|o| o.index == index)
    }

    #[must_use]
    pub fn item(&self, index: u16, sub: u8) -> Option<&ObjectItem> {
        self.object(index)?.items.iter().find(|i| i.sub == sub)
    }
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum ObjectCode {
    #[default]
    Var,
    Array,
    Record,
}

#[derive(Debug, Clone, Default)]
pub struct Object {
    pub position: Position,
    pub index: u16,
    pub depends_on: SlotDependence,
    pub name: Text,
    pub code: ObjectCode,
    /// The type name as in the file.
    pub type_name: Text,
    /// The items, subindex 0 first. A simple variable has exactly one item, with subindex 0.
    pub items: Vec<ObjectItem>,
}

impl Object {
    /// Returns the approximate memory use in bytes.
    pub(crate) fn size(&self) -> usize {
        let items = self.items.iter().map(|item| {
            let range = [&item.min, &item.max].into_iter().flatten();
            let data = range.map(|bytes| bytes.len()).sum::<usize>() + item.default.len();
            size_of::<ObjectItem>() + data + item.name.len() + item.type_name.len()
        });
        items.fold(
            size_of::<Self>() + self.name.len() + self.type_name.len(),
            usize::saturating_add,
        )
    }
}

#[derive(Debug, Clone, Default)]
pub struct ObjectItem {
    pub sub: u8,
    pub name: Text,
    /// The base type name (`USINT`, `DINT`, `STRING(5)`, `ARRAY [0..15] OF BYTE`).
    pub type_name: Text,
    pub bit_len: u32,
    /// The bit offset inside the object for complete access, where subindex 0 is padded to 16 bits.
    pub bit_offset: u32,
    /// The default in little-endian order, exactly `bit_len.div_ceil(8)` bytes. Zero if the file
    /// has no default.
    pub default: Bytes,
    pub has_default: bool,
    pub min: Option<Bytes>,
    pub max: Option<Bytes>,
    pub access: Access,
    pub pdo_mapping: PdoMapping,
    /// `Backup`: the drive keeps the value over a power cycle once parameters are stored.
    pub backup: bool,
    /// `Setting`: the machine configures the object at start-up.
    pub setting: bool,
    /// `Unit`, coded as in ETG.1004; 0 if the file has none.
    pub unit: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Access {
    pub read: bool,
    pub write: Writable,
}

impl Default for Access {
    fn default() -> Self {
        Self {
            read: true,
            write: Writable::Never,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Writable {
    Never,
    Always,
    /// `WriteRestrictions` list the states that allow writing.
    Only {
        pre_op: bool,
        safe_op: bool,
        op: bool,
    },
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PdoMapping {
    pub rx: bool,
    pub tx: bool,
}
