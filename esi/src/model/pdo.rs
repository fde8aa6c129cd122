//! PDOs and their entries.

use super::{Position, Text};

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Direction {
    /// MainDevice → SubDevice (outputs, 0x16xx, 0x1C12).
    Rx,
    /// SubDevice → MainDevice (inputs, 0x1Axx, 0x1C13).
    Tx,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Pdo {
    pub position: Position,
    pub direction: Direction,
    pub index: u16,
    pub name: String,
    /// The SyncManager of the default assignment; `None`: not assigned by default.
    pub sm: Option<u8>,
    pub su: Option<u8>,
    /// SyncManagers to which this PDO may not be assigned.
    pub excluded_sm: Vec<u8>,
    /// The contents are not changeable.
    pub fixed: bool,
    pub mandatory: bool,
    pub virtual_: bool,
    /// The module in a slot replaces this PDO's contents.
    pub overwritten_by_module: bool,
    /// In a module: the slot number shifts the index.
    pub depends_on: SlotDependence,
    pub oversampling: Option<Oversampling>,
    pub exclude: Vec<Excluded>,
    pub entries: Vec<Entry>,
}

/// `OSFac` …: one cycle contains several samples of the PDO.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Oversampling {
    /// The number of samples if the OpMode does not define it.
    pub factor: u16,
    pub max: Option<u16>,
    /// The index step of the entries from one sample to the next; the PDO's own step is 1. 0: all
    /// samples are in one PDO.
    pub index_increment: u16,
}

/// A PDO that cannot be assigned together with this one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Excluded {
    pub index: u16,
    pub depends_on: SlotDependence,
}

impl From<u16> for Excluded {
    fn from(index: u16) -> Self {
        Self {
            index,
            depends_on: SlotDependence::default(),
        }
    }
}

/// The slot increments that shift an index in a module.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct SlotDependence {
    pub slot: bool,
    pub group: bool,
}

impl Pdo {
    #[must_use]
    pub fn bit_len(&self) -> u32 {
        self.entries.iter().map(|e| u32::from(e.bit_len)).sum()
    }

    /// Returns the approximate memory use in bytes.
    pub(crate) fn size(&self) -> usize {
        let entries = self.entries.iter();
        let entries = entries.map(|e| size_of::<Entry>() + e.name.len() + e.data_type.len());
        let lists = self.exclude.len().saturating_mul(size_of::<Excluded>());
        entries.fold(
            size_of::<Self>() + self.name.len() + lists,
            usize::saturating_add,
        )
    }
}

/// A mapped object; `index` 0: a gap.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    pub position: Position,
    pub index: u16,
    pub sub: u8,
    pub bit_len: u16,
    pub name: Text,
    /// The ETG.2000 base type name (`UINT`, `DINT`, `BOOL`, …); empty for a gap.
    pub data_type: Text,
    pub depends_on: SlotDependence,
}

impl Entry {
    #[must_use]
    pub fn is_gap(&self) -> bool {
        self.index == 0
    }

    /// Returns the UDINT for 0x16xx/0x1Axx: index, subindex and bit length. Entries longer than 255
    /// bits keep the low byte of their length.
    #[must_use]
    pub fn mapping(&self) -> u32 {
        u32::from(self.index) << 16 | u32::from(self.sub) << 8 | u32::from(self.bit_len & 0xff)
    }
}

/// `AlternativeSmMapping`: a named list of the PDOs of each SyncManager.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SmMapping {
    pub position: Position,
    /// Element path, as in [`super::Warning`].
    pub path: String,
    pub name: String,
    pub default: bool,
    /// (SyncManager, its PDOs in order). A SyncManager that is not listed keeps its default.
    pub sync_managers: Vec<(u8, Vec<u16>)>,
    /// (PDO, samples per cycle), only for PDOs with a factor in the mapping.
    pub oversampling: Vec<(u16, u16)>,
}
