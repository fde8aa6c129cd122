//! The object dictionary.

use super::{Bytes, Position, SlotDependence, Text};

/// Objects in file order with resolved types. Each readable subindex is an item of its object.
#[derive(Debug, Clone, Default)]
pub struct Dictionary {
    /// The objects with resolved types.
    pub objects: Vec<Object>,
}

impl Dictionary {
    /// Returns the object with this index.
    #[must_use]
    pub fn object(&self, index: u16) -> Option<&Object> {
        self.objects.iter().find(|o| o.index == index)
    }

    /// Returns one subindex of an object.
    #[must_use]
    pub fn item(&self, index: u16, sub: u8) -> Option<&ObjectItem> {
        self.object(index)?.items.iter().find(|i| i.sub == sub)
    }
}

impl Dictionary {
    /// Returns how the dictionary contradicts a download; `None` if it permits the download or has
    /// no objects at all.
    pub(crate) fn contradiction(
        &self,
        (index, sub): (u16, u8),
        data: &[u8],
        complete_access: bool,
    ) -> Option<String> {
        if self.objects.is_empty() {
            return None;
        }
        let Some(object) = self.object(index) else {
            return Some("is not in the dictionary".to_owned());
        };
        if complete_access {
            return None;
        }
        let Some(item) = object.items.iter().find(|item| item.sub == sub) else {
            return Some("is not in the dictionary".to_owned());
        };
        let bytes = item.default.len();
        let is_text = item.type_name.contains("STRING") || item.type_name.contains("ARRAY");
        if bytes > 0 && bytes != data.len() && !is_text {
            let given = data.len();
            return Some(format!(
                "is written with {given} bytes, the object has {bytes}"
            ));
        }
        let is_read_only = item.access.write == Writable::Never;
        is_read_only.then(|| "is read-only in the dictionary".to_owned())
    }
}

/// The kind of an object (ETG.1000.6).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum ObjectCode {
    /// A single value.
    #[default]
    Var,
    /// Elements of one type.
    Array,
    /// Elements of different types.
    Record,
}

/// One object of the dictionary.
#[derive(Debug, Clone, Default)]
pub struct Object {
    /// The position of the element.
    pub position: Position,
    /// The index.
    pub index: u16,
    /// The dependence of the index on the slot.
    pub depends_on: SlotDependence,
    /// The name.
    pub name: Text,
    /// The kind.
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

/// One subindex of an object.
#[derive(Debug, Clone, Default)]
pub struct ObjectItem {
    /// The subindex.
    pub sub: u8,
    /// The name.
    pub name: Text,
    /// The base type name (`USINT`, `DINT`, `STRING(5)`, `ARRAY [0..15] OF BYTE`).
    pub type_name: Text,
    /// The length in bits.
    pub bit_len: u32,
    /// The bit offset inside the object for complete access, where subindex 0 is padded to 16 bits.
    pub bit_offset: u32,
    /// The default in little-endian order, exactly `bit_len.div_ceil(8)` bytes. Zero if the file
    /// has no default.
    pub default: Bytes,
    /// True if the file contains a default value.
    pub has_default: bool,
    /// The smallest value, if the file contains one.
    pub min: Option<Bytes>,
    /// The largest value, if the file contains one.
    pub max: Option<Bytes>,
    /// The access rights.
    pub access: Access,
    /// The permitted PDO directions.
    pub pdo_mapping: PdoMapping,
    /// `Backup`: the drive keeps the value over a power cycle once parameters are stored.
    pub backup: bool,
    /// `Setting`: the machine configures the object at start-up.
    pub setting: bool,
    /// `Unit`, coded as in ETG.1004; 0 if the file has none.
    pub unit: u32,
}

/// The access rights of a subindex.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Access {
    /// True if the subindex is readable.
    pub read: bool,
    /// The states with write access.
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

/// The EtherCAT states with write access.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Writable {
    /// Read-only.
    Never,
    /// Writable in every state with a mailbox.
    Always,
    /// `WriteRestrictions` list the states that allow writing.
    Only {
        /// Writable in PreOp.
        pre_op: bool,
        /// Writable in SafeOp.
        safe_op: bool,
        /// Writable in Op.
        op: bool,
    },
}

/// The PDOs that may contain a subindex.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PdoMapping {
    /// True if an RxPDO may contain it.
    pub rx: bool,
    /// True if a TxPDO may contain it.
    pub tx: bool,
}
