//! Which PDOs are assigned, and with what contents.

use super::module::Placed;
use super::{EntryRef, SelectError};
use crate::mode::Mode;
use crate::model::{
    Coe, Device, Dictionary, Direction, Entry, Pdo, PdoMapping, Position, SlotDependence, SmUse,
};

/// PDOs by SyncManager under a name: an `AlternativeSmMapping`, or what a DC mode assigns.
#[derive(Clone, Copy)]
pub(super) struct Assignment<'a> {
    pub name: &'a str,
    pub sync_managers: &'a [(u8, Vec<u16>)],
}

/// The assignment that is asked for by name.
pub(super) fn assignment<'a>(
    device: &'a Device,
    wanted: &str,
) -> Result<Assignment<'a>, SelectError> {
    let wanted = wanted.trim();
    let mapping = device
        .sm_mappings
        .iter()
        .find(|mapping| mapping.name.trim().eq_ignore_ascii_case(wanted));
    let Some(mapping) = mapping else {
        let names: Vec<String> = device
            .sm_mappings
            .iter()
            .map(|mapping| format!("{:?}", mapping.name))
            .collect();
        return Err(SelectError::NoSuchAssignment {
            device: device.name.clone(),
            wanted: wanted.to_owned(),
            offered: if names.is_empty() {
                "none by name".to_owned()
            } else {
                names.join(", ")
            },
        });
    };
    Ok(Assignment {
        name: &mapping.name,
        sync_managers: &mapping.sync_managers,
    })
}

/// One direction of one device.
pub(super) struct Chooser<'a> {
    pub device: &'a Device,
    pub placed: &'a [Placed],
    pub dictionary: &'a Dictionary,
    pub direction: Direction,
    pub assignment: Option<Assignment<'a>>,
}

impl Chooser<'_> {
    /// Every PDO that could be assigned: the device's, with those of the modules in their place.
    pub fn available(&self) -> Vec<Pdo> {
        let device = self.of_device();
        let modules = self.placed.iter().flat_map(|p| match self.direction {
            Direction::Rx => &p.module.rx_pdos,
            Direction::Tx => &p.module.tx_pdos,
        });
        let mut pdos: Vec<Pdo> = device.iter().filter(|pdo| !pdo.virtual_).cloned().collect();
        for new in modules.filter(|pdo| !pdo.virtual_) {
            let mut new = new.clone();
            new.sm = new.sm.or(self.primary_sm());
            match pdos.iter_mut().find(|old| old.index == new.index) {
                Some(old) => {
                    let excluded: Vec<_> = old
                        .exclude
                        .iter()
                        .filter(|i| !new.exclude.contains(i))
                        .copied()
                        .collect();
                    new.exclude.extend(excluded);
                    *old = new;
                }
                None => pdos.push(new),
            }
        }
        pdos
    }

    fn of_device(&self) -> &[Pdo] {
        match self.direction {
            Direction::Rx => &self.device.rx_pdos,
            Direction::Tx => &self.device.tx_pdos,
        }
    }

    /// The PDOs as they will be assigned, in order, each with its SyncManager.
    pub fn choose(
        &self,
        mode: Option<Mode>,
        own: Option<&[EntryRef]>,
        notes: &mut Vec<String>,
    ) -> Result<Vec<Pdo>, SelectError> {
        let available = self.assigned(self.available())?;
        let default = self.default_set(&available, notes);
        let mut chosen = match (own, mode) {
            (Some(list), _) => self.with_own_entries(&available, &default, list, mode)?,
            (None, Some(mode)) => self.for_mode(&available, default, mode, notes)?,
            (None, None) => default,
        };
        for pdo in &mut chosen {
            let sm = self.sm_of(pdo)?;
            if pdo.excluded_sm.contains(&sm) {
                return Err(SelectError::ExcludedSyncManager {
                    device: self.device.name.clone(),
                    pdo: pdo.index,
                    sm,
                });
            }
            pdo.sm = Some(sm);
        }
        Ok(chosen)
    }

    /// Applies the assignment by name, if there is one: the SyncManagers that it names carry its PDOs in its
    /// order, before those of the others.
    fn assigned(&self, mut available: Vec<Pdo>) -> Result<Vec<Pdo>, SelectError> {
        let Some(assignment) = self.assignment else {
            return Ok(available);
        };
        for pdo in &mut available {
            let named = |sm| {
                assignment
                    .sync_managers
                    .iter()
                    .any(|(number, _)| *number == sm)
            };
            if pdo.sm.is_some_and(named) {
                pdo.sm = None;
            }
        }
        let of_direction = |sm: &&(u8, Vec<u16>)| {
            let usage = self.device.sync_managers.get(usize::from(sm.0));
            usage.is_some_and(|sm| sm.usage == self.usage())
        };
        let mut first = Vec::new();
        for (sm, pdos) in assignment.sync_managers.iter().filter(of_direction) {
            for index in pdos {
                let Some(at) = available.iter().position(|pdo| pdo.index == *index) else {
                    // Virtual PDOs are listed, and reached without an assignment.
                    if self.of_device().iter().any(|pdo| pdo.index == *index) {
                        continue;
                    }
                    return Err(SelectError::UnknownPdo {
                        device: self.device.name.clone(),
                        name: assignment.name.to_owned(),
                        pdo: *index,
                    });
                };
                let mut pdo = available.remove(at);
                pdo.sm = Some(*sm);
                first.push(pdo);
            }
        }
        first.append(&mut available);
        Ok(first)
    }

    /// What the device assigns when nobody says anything; mutual exclusions are resolved in file order.
    fn default_set(&self, available: &[Pdo], notes: &mut Vec<String>) -> Vec<Pdo> {
        let mut set: Vec<Pdo> = Vec::new();
        for pdo in available.iter().filter(|pdo| pdo.sm.is_some()) {
            match set.iter().find(|other| conflict(other, pdo)) {
                Some(other) => notes.push(format!(
                    "PDO 0x{:04x} is assigned by default and excluded by 0x{:04x}; it is left out",
                    pdo.index, other.index
                )),
                None => set.push(pdo.clone()),
            }
        }
        set
    }

    fn for_mode(
        &self,
        available: &[Pdo],
        default: Vec<Pdo>,
        mode: Mode,
        notes: &mut Vec<String>,
    ) -> Result<Vec<Pdo>, SelectError> {
        let needed = self.needed(mode);
        if needed.iter().all(|&index| contains(&default, index)) {
            return Ok(default);
        }
        let one = |pdo: &&Pdo| {
            needed
                .iter()
                .all(|&index| contains(std::slice::from_ref(*pdo), index))
        };
        if let Some(pdo) = available.iter().find(one) {
            return Ok(self.alongside(pdo.clone(), &default));
        }
        if let Some(set) = cover(available, &default, &needed) {
            return Ok(set);
        }
        match self.direction {
            Direction::Rx => Err(SelectError::ModeNotOffered {
                device: self.device.name.clone(),
                mode,
                offered: offered_by_pdos(available),
            }),
            Direction::Tx => {
                for index in needed {
                    if !contains(&default, index) {
                        notes.push(format!(
                            "no PDO of the ESI brings 0x{index:04x} as mode {mode} would want it"
                        ));
                    }
                }
                Ok(default)
            }
        }
    }

    fn needed(&self, mode: Mode) -> Vec<u16> {
        match self.direction {
            Direction::Rx => [Some(0x6040), mode.target_object()]
                .into_iter()
                .flatten()
                .collect(),
            Direction::Tx => vec![0x6041, mode.actual_object()],
        }
    }

    /// `pdo` first; beside it the default PDOs that it does not exclude, as far as there is room.
    fn alongside(&self, pdo: Pdo, default: &[Pdo]) -> Vec<Pdo> {
        let room = self.capacity(&pdo);
        let mut set = vec![pdo];
        // Mandatory ones first in line for the room, but assigned in file order.
        let mut keep: Vec<u16> = Vec::new();
        for other in default
            .iter()
            .filter(|p| p.mandatory)
            .chain(default.iter().filter(|p| !p.mandatory))
        {
            let free = set
                .iter()
                .all(|chosen| chosen.index != other.index && !conflict(chosen, other));
            if free && keep.len().saturating_add(1) < room {
                keep.push(other.index);
            }
        }
        set.extend(default.iter().filter(|p| keep.contains(&p.index)).cloned());
        set
    }

    /// How many PDOs the assignment object takes.
    fn capacity(&self, pdo: &Pdo) -> usize {
        let Ok(sm) = self.sm_of(pdo) else {
            return usize::MAX;
        };
        let index = 0x1c10u16.saturating_add(u16::from(sm));
        let Some(object) = self.dictionary.object(index) else {
            return usize::MAX;
        };
        let stated = object
            .items
            .first()
            .and_then(|item| item.max.as_ref())
            .and_then(|max| max.first().copied());
        stated.map_or_else(|| object.items.len().saturating_sub(1).max(1), usize::from)
    }

    fn with_own_entries(
        &self,
        available: &[Pdo],
        default: &[Pdo],
        list: &[EntryRef],
        mode: Option<Mode>,
    ) -> Result<Vec<Pdo>, SelectError> {
        let label = self.label();
        let coe = self
            .device
            .mailbox
            .as_ref()
            .and_then(|mailbox| mailbox.coe.as_ref());
        let configurable = coe.is_some_and(|coe: &Coe| coe.pdo_config);
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
            // The actual value is the user's business; without command and status words nothing moves.
            let needed = self.needed(mode);
            let strict = if self.direction == Direction::Rx {
                needed.len()
            } else {
                1
            };
            for index in needed.into_iter().take(strict) {
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

    /// The user's list as a sequence of the device's own PDOs, where these cannot be changed.
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

    /// Length and type of an object, from the dictionary or from any PDO that maps it.
    fn entry(&self, wanted: EntryRef) -> Result<Entry, SelectError> {
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
            // Some files flag nothing at all; then nothing can be refused.
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
                    name: item.name.clone(),
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

    fn label(&self) -> &'static str {
        match self.direction {
            Direction::Rx => "pdo.rx",
            Direction::Tx => "pdo.tx",
        }
    }

    /// The SyncManager that carries this direction unless a PDO says otherwise.
    fn primary_sm(&self) -> Option<u8> {
        let place = self
            .device
            .sync_managers
            .iter()
            .position(|sm| sm.usage == self.usage() && !sm.virtual_)?;
        u8::try_from(place).ok()
    }

    fn usage(&self) -> SmUse {
        match self.direction {
            Direction::Rx => SmUse::Outputs,
            Direction::Tx => SmUse::Inputs,
        }
    }

    fn sm_of(&self, pdo: &Pdo) -> Result<u8, SelectError> {
        pdo.sm
            .filter(|sm| usize::from(*sm) < self.device.sync_managers.len())
            .or_else(|| self.primary_sm())
            .ok_or_else(|| SelectError::NoSyncManager {
                device: self.device.name.clone(),
                pdo: pdo.index,
                direction: direction_name(self.direction),
            })
    }
}

fn direction_name(direction: Direction) -> &'static str {
    match direction {
        Direction::Rx => "RxPdo",
        Direction::Tx => "TxPdo",
    }
}

fn conflict(a: &Pdo, b: &Pdo) -> bool {
    let excludes = |a: &Pdo, b: &Pdo| a.exclude.iter().any(|other| other.index == b.index);
    a.index != b.index && (excludes(a, b) || excludes(b, a))
}

/// Several PDOs that together bring what a mode needs, for devices whose PDOs hold one object each: the default
/// ones first, then for every object that is missing the shortest PDO that has it.
fn cover(available: &[Pdo], default: &[Pdo], needed: &[u16]) -> Option<Vec<Pdo>> {
    let mut set: Vec<Pdo> = Vec::new();
    for &index in needed {
        if contains(&set, index) {
            continue;
        }
        let fits = |pdo: &&Pdo| {
            contains(std::slice::from_ref(*pdo), index)
                && !set.iter().any(|other| conflict(other, pdo))
        };
        let by_default = default.iter().find(fits);
        let pdo =
            by_default.or_else(|| available.iter().filter(fits).min_by_key(|p| p.bit_len()))?;
        set.push(pdo.clone());
    }
    Some(set)
}

fn contains(set: &[Pdo], index: u16) -> bool {
    set.iter()
        .flat_map(|pdo| &pdo.entries)
        .any(|entry| entry.index == index)
}

fn offered_by_pdos(available: &[Pdo]) -> String {
    let modes: Vec<String> = Mode::ALL
        .into_iter()
        .filter(|mode| mode.is_cyclic())
        .filter_map(|mode| {
            let target = mode.target_object()?;
            let pdo = available
                .iter()
                .find(|pdo| contains(std::slice::from_ref(*pdo), target))?;
            Some(format!("{mode} (RxPdo 0x{:04x})", pdo.index))
        })
        .collect();
    if modes.is_empty() {
        "no set-point object in any RxPdo".to_owned()
    } else {
        modes.join(", ")
    }
}
