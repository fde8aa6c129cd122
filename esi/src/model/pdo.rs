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
    /// SyncManager it is assigned to by default; `None`: not in the default assignment.
    pub sm: Option<u8>,
    pub su: Option<u8>,
    /// SyncManagers that it may not be assigned to.
    pub excluded_sm: Vec<u8>,
    /// The contents cannot be changed.
    pub fixed: bool,
    pub mandatory: bool,
    pub virtual_: bool,
    /// A slot's module replaces this PDO's contents.
    pub overwritten_by_module: bool,
    /// In a module: the index counts on by the slot's increment.
    pub depends_on: SlotDependence,
    pub oversampling: Option<Oversampling>,
    pub exclude: Vec<Excluded>,
    pub entries: Vec<Entry>,
}

/// `OSFac` …: one cycle brings several samples of the PDO.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Oversampling {
    /// Samples where the OpMode does not say how many.
    pub factor: u16,
    pub max: Option<u16>,
    /// By how much the entries' indices count on from one sample to the next, the PDO's own by 1. 0: the samples
    /// stand in one PDO.
    pub index_increment: u16,
}

/// A PDO that cannot be assigned beside this one.
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

/// Which of a slot's increments an index in a module counts on by.
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

    /// Bytes in memory, nearly.
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

/// A mapped object, or a gap where `index` is 0.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    pub position: Position,
    pub index: u16,
    pub sub: u8,
    pub bit_len: u16,
    pub name: Text,
    /// ETG.2000 base type name (`UINT`, `DINT`, `BOOL` …), empty for a gap.
    pub data_type: Text,
    pub depends_on: SlotDependence,
}

impl Entry {
    #[must_use]
    pub fn is_gap(&self) -> bool {
        self.index == 0
    }

    /// The UDINT that stands in 0x16xx/0x1Axx for this entry: index, subindex, bit length.
    /// Entries longer than 255 bits keep the low byte of their length.
    #[must_use]
    pub fn mapping(&self) -> u32 {
        u32::from(self.index) << 16 | u32::from(self.sub) << 8 | u32::from(self.bit_len & 0xff)
    }
}

/// `AlternativeSmMapping`: the PDOs of each SyncManager under a name.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SmMapping {
    pub position: Position,
    /// Element path, as in [`super::Warning`].
    pub path: String,
    pub name: String,
    pub default: bool,
    /// (SyncManager, its PDOs in order). A SyncManager that is not named keeps its default.
    pub sync_managers: Vec<(u8, Vec<u16>)>,
    /// (PDO, samples in a cycle), for those that it assigns.
    pub oversampling: Vec<(u16, u16)>,
}
