//! PDOs and their entries.

use super::{Position, Text};

/// The maximum number of entries of one oversampled PDO; a frame has 11888 bits of process data.
const MAX_SAMPLED_ENTRIES: usize = 16_384;

/// The direction of a PDO, seen from the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Direction {
    /// MainDevice → SubDevice (outputs, 0x16xx, 0x1C12).
    Rx,
    /// SubDevice → MainDevice (inputs, 0x1Axx, 0x1C13).
    Tx,
}

/// One PDO of a device or module.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Pdo {
    /// The position of the element.
    pub position: Position,
    /// The direction.
    pub direction: Direction,
    /// The index.
    pub index: u16,
    /// The name.
    pub name: String,
    /// The SyncManager of the default assignment; `None`: not assigned by default.
    pub sm: Option<u8>,
    /// The number of its sync unit.
    pub su: Option<u8>,
    /// SyncManagers to which this PDO may not be assigned.
    pub excluded_sm: Vec<u8>,
    /// The contents are not changeable.
    pub fixed: bool,
    /// `Mandatory`: every assignment contains the PDO.
    pub mandatory: bool,
    /// `Virtual`: the PDO is not part of the PDO assignment.
    pub virtual_: bool,
    /// The module in a slot replaces this PDO's contents.
    pub overwritten_by_module: bool,
    /// In a module: the slot number shifts the index.
    pub depends_on: SlotDependence,
    /// `OSFac`: samples per cycle.
    pub oversampling: Option<Oversampling>,
    /// `Exclude`: PDOs that cannot be assigned at the same time.
    pub exclude: Vec<Excluded>,
    /// The entries in order, gaps included.
    pub entries: Vec<Entry>,
}

/// `OSFac` …: one cycle contains several samples of the PDO.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Oversampling {
    /// The number of samples if the OpMode does not define it.
    pub factor: u16,
    /// `OSMax`: the largest factor.
    pub max: Option<u16>,
    /// The index step of the entries from one sample to the next; the PDO's own step is 1. 0: all
    /// samples are in one PDO.
    pub index_increment: u16,
}

/// A PDO that cannot be assigned together with this one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Excluded {
    /// The index.
    pub index: u16,
    /// The dependence of the index on the slot.
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
    /// The index depends on the slot.
    pub slot: bool,
    /// The index depends on the slot group.
    pub group: bool,
}

impl Pdo {
    /// Returns the drive of a telegram of a device with SoE: bits 12 to 14 of the index.
    #[must_use]
    pub fn drive(&self) -> u8 {
        self.index.to_be_bytes()[0] >> 4 & 7
    }

    /// Returns the length in bits.
    #[must_use]
    pub fn bit_len(&self) -> u32 {
        self.entries.iter().map(|e| u32::from(e.bit_len)).sum()
    }

    /// Returns the PDOs that carry `factor` samples of this one in a cycle. `None`: the factor is
    /// larger than `OSMax` or than a frame.
    ///
    /// With an index increment, each sample is a separate PDO with the next index. Without it, a
    /// single entry becomes longer, and several entries are repeated in the same PDO.
    #[must_use]
    pub fn samples(&self, factor: u16) -> Option<Vec<Self>> {
        if factor <= 1 {
            return Some(vec![self.clone()]);
        }
        let entries = self.entries.len().max(1).saturating_mul(factor.into());
        let max = self.oversampling.and_then(|own| own.max);
        if entries > MAX_SAMPLED_ENTRIES || max.is_some_and(|max| factor > max) {
            return None;
        }
        let increment = self.oversampling.map_or(0, |own| own.index_increment);
        if increment > 0 {
            let all = (0..factor).map(|sample| {
                let mut copy = self.clone();
                copy.index = self.index.wrapping_add(sample);
                for entry in copy.entries.iter_mut().filter(|entry| !entry.is_gap()) {
                    entry.index = entry.index.wrapping_add(sample.wrapping_mul(increment));
                }
                copy
            });
            return Some(all.collect());
        }
        let mut longer = self.clone();
        match longer.entries.as_mut_slice() {
            [only] => only.bit_len = only.bit_len.saturating_mul(factor),
            _ => {
                let one = longer.entries.clone();
                longer.entries = (0..factor).flat_map(|_| one.iter().cloned()).collect();
            }
        }
        Some(vec![longer])
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
    /// The position of the element.
    pub position: Position,
    /// The index.
    pub index: u16,
    /// The subindex.
    pub sub: u8,
    /// The length in bits.
    pub bit_len: u16,
    /// The name.
    pub name: Text,
    /// The ETG.2000 base type name (`UINT`, `DINT`, `BOOL`, …); empty for a gap.
    pub data_type: Text,
    /// The dependence of the index on the slot.
    pub depends_on: SlotDependence,
}

impl Entry {
    /// True for padding without an object.
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
    /// The position of the element.
    pub position: Position,
    /// Element path, as in [`super::Warning`].
    pub path: String,
    /// `Name`.
    pub name: String,
    /// True for the default assignment.
    pub default: bool,
    /// (SyncManager, its PDOs in order). A SyncManager that is not listed keeps its default.
    pub sync_managers: Vec<(u8, Vec<u16>)>,
    /// (PDO, samples per cycle), only for PDOs with a factor in the mapping.
    pub oversampling: Vec<(u16, u16)>,
}
