//! User-defined PDO contents, checked against the device's capabilities.

use super::pdo::{PdoSelector, STATUSWORD, conflict, contains, direction_name};
use super::{EntryRef, SelectError};
use crate::axis;
use crate::mode::Mode;
use crate::model::{Direction, Entry, Pdo, PdoMapping, Position, SlotDependence};

impl PdoSelector<'_> {
    pub(super) fn with_own_entries(
        &self,
        available: &[Pdo],
        default: &[Pdo],
        list: &[EntryRef],
        mode: Option<Mode>,
    ) -> Result<Vec<Pdo>, SelectError> {
        let label = self.label();
        let configurable = self.coe().is_some_and(|coe| coe.pdo_config);
        let carrier = default
            .iter()
            .chain(available)
            .find(|pdo| !pdo.fixed)
            .filter(|_| configurable);
        let Some(carrier) = carrier else {
            if let Some(set) = self.composed(available, default, list) {
                return Ok(set);
            }
            return Err(SelectError::NotConfigurable {
                list: label,
                device: self.device.name.clone(),
            });
        };
        if let Some(max) = self.max_entries(carrier.index)
            && list.len() > max
        {
            return Err(SelectError::TooManyEntries {
                list: label,
                pdo: carrier.index,
                count: list.len(),
                max,
            });
        }
        let mut pdo = carrier.clone();
        pdo.entries = list
            .iter()
            .map(|entry| self.entry(*entry))
            .collect::<Result<_, _>>()?;
        if let Some(mode) = mode {
            // The user may omit the actual value. The command and status words are mandatory.
            let strict = |index: &u16| {
                self.direction == Direction::Rx
                    || axis::of(*index).is_some_and(|(_, same)| same == STATUSWORD)
            };
            for index in self.needed(mode).into_iter().filter(strict) {
                if !contains(std::slice::from_ref(&pdo), index) {
                    return Err(SelectError::MissingEntry {
                        list: label,
                        mode,
                        index,
                    });
                }
            }
        }
        let mandatory: Vec<Pdo> = default.iter().filter(|p| p.mandatory).cloned().collect();
        Ok(self.alongside(pdo, &mandatory))
    }

    /// Returns the PDOs with further entries, which go to the first PDOs that have room for them.
    pub(super) fn with_more_entries(
        &self,
        mut pdos: Vec<Pdo>,
        more: &[EntryRef],
    ) -> Result<Vec<Pdo>, SelectError> {
        let configurable = self.coe().is_some_and(|coe| coe.pdo_config);
        for wanted in more {
            let entry = self.entry(*wanted)?;
            let mut open = pdos.iter_mut().filter(|pdo| !pdo.fixed && configurable);
            let Some(pdo) = open.find(|pdo| self.has_room(pdo)) else {
                return Err(SelectError::NotConfigurable {
                    list: self.label(),
                    device: self.device.name.clone(),
                });
            };
            pdo.entries.push(entry);
        }
        Ok(pdos)
    }

    /// True if the mapping object of a PDO has a subindex for a further entry.
    fn has_room(&self, pdo: &Pdo) -> bool {
        let next = u8::try_from(pdo.entries.len() + 1).unwrap_or(u8::MAX);
        let room = self.max_entries(pdo.index);
        let described = self.dictionary.item(pdo.index, 1).is_some();
        room.is_none_or(|most| usize::from(next) <= most)
            && (!described || self.dictionary.item(pdo.index, next).is_some())
            && next < u8::MAX
    }

    /// Returns the device's own PDOs that together match the user's list, for fixed PDOs.
    fn composed(&self, available: &[Pdo], default: &[Pdo], list: &[EntryRef]) -> Option<Vec<Pdo>> {
        let mut set: Vec<Pdo> = default.iter().filter(|p| p.mandatory).cloned().collect();
        let mut rest = list;
        while !rest.is_empty() {
            let begins_with = |pdo: &&Pdo| {
                let mapped = || pdo.entries.iter().filter(|entry| !entry.is_gap());
                let same = mapped()
                    .zip(rest)
                    .all(|(entry, wanted)| (entry.index, entry.sub) == (wanted.index, wanted.sub));
                let count = mapped().count();
                let free = set
                    .iter()
                    .all(|other| other.index != pdo.index && !conflict(other, pdo));
                count > 0 && count <= rest.len() && same && free
            };
            let longest = available
                .iter()
                .filter(begins_with)
                .max_by_key(|pdo| pdo.entries.len())?;
            let count = longest
                .entries
                .iter()
                .filter(|entry| !entry.is_gap())
                .count();
            rest = rest.get(count..)?;
            set.push(longest.clone());
        }
        Some(set)
    }

    fn max_entries(&self, pdo: u16) -> Option<usize> {
        let max = self
            .dictionary
            .item(pdo, 0)?
            .max
            .as_ref()?
            .first()
            .copied()?;
        (max > 0).then_some(usize::from(max))
    }

    /// Returns length and type of an object, from the dictionary or from any PDO that maps the
    /// object.
    pub(super) fn entry(&self, wanted: EntryRef) -> Result<Entry, SelectError> {
        let EntryRef { index, sub } = wanted;
        if let Some((object, item)) = self
            .dictionary
            .object(index)
            .zip(self.dictionary.item(index, sub))
        {
            let flag = |mapping: PdoMapping| match self.direction {
                Direction::Rx => mapping.rx,
                Direction::Tx => mapping.tx,
            };
            // Some files flag no object as mappable. The check is then impossible and passes.
            let flags_are_kept = self
                .dictionary
                .objects
                .iter()
                .flat_map(|o| &o.items)
                .any(|i| flag(i.pdo_mapping));
            if flags_are_kept && !flag(item.pdo_mapping) && !self.is_mapped_somewhere(wanted) {
                return Err(SelectError::NotMappable {
                    list: self.label(),
                    index,
                    sub,
                    name: item.name.to_string(),
                    direction: direction_name(self.direction),
                });
            }
            if let Some(bit_len) = u16::try_from(item.bit_len).ok().filter(|bits| *bits > 0) {
                return Ok(Entry {
                    position: object.position,
                    index,
                    sub,
                    bit_len,
                    name: item.name.clone(),
                    data_type: item.type_name.clone(),
                    depends_on: SlotDependence::default(),
                });
            }
        }
        let known = self
            .all_entries()
            .find(|entry| entry.index == index && entry.sub == sub && entry.bit_len > 0);
        match known {
            Some(entry) if !entry.is_gap() => Ok(Entry {
                position: Position::default(),
                ..entry.clone()
            }),
            _ => Err(SelectError::UnknownEntry {
                list: self.label(),
                index,
                sub,
            }),
        }
    }

    fn is_mapped_somewhere(&self, wanted: EntryRef) -> bool {
        self.available()
            .iter()
            .flat_map(|p| &p.entries)
            .any(|e| e.index == wanted.index && e.sub == wanted.sub)
    }

    fn all_entries(&self) -> impl Iterator<Item = &Entry> {
        let device = self.device.rx_pdos.iter().chain(&self.device.tx_pdos);
        let module = self
            .placed
            .iter()
            .flat_map(|p| p.module.rx_pdos.iter().chain(&p.module.tx_pdos));
        device.chain(module).flat_map(|pdo| &pdo.entries)
    }
}
