//! Selects the assigned PDOs and their contents.

use std::collections::HashMap;

use super::module::PluggedModule;
use super::{EntryRef, SelectError};
use crate::axis;
use crate::mode::Mode;
use crate::model::{Coe, Device, Dictionary, Direction, Pdo, SmUse};

pub(super) const CONTROLWORD: u16 = 0x6040;
pub(super) const STATUSWORD: u16 = 0x6041;
const POSITION: u16 = 0x6064;

/// A named list of PDOs by SyncManager: an `AlternativeSmMapping`, or the assignment of a DC mode.
#[derive(Clone, Copy)]
pub(super) struct Assignment<'a> {
    pub name: &'a str,
    pub sync_managers: &'a [(u8, Vec<u16>)],
    /// (PDO, samples per cycle).
    pub oversampling: &'a [(u16, u16)],
    /// If the list names a SyncManager of a direction, the other SyncManagers of that direction
    /// stay empty. An OpMode thus disables the channels that it does not list.
    pub whole_direction: bool,
}

/// Returns the assignment of the requested name.
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
        oversampling: &mapping.oversampling,
        whole_direction: false,
    })
}

/// Selects the PDOs of one direction of one device.
pub(super) struct PdoSelector<'a> {
    pub device: &'a Device,
    pub placed: &'a [PluggedModule<'a>],
    pub dictionary: &'a Dictionary,
    pub direction: Direction,
    pub assignment: Option<Assignment<'a>>,
    /// The axes in use.
    pub axes: &'a [u16],
}

impl PdoSelector<'_> {
    /// Returns all assignable PDOs of the device, with modules' PDOs at their places.
    pub fn available(&self) -> Vec<Pdo> {
        let device = self.of_device();
        let modules = self.placed.iter().flat_map(|p| match self.direction {
            Direction::Rx => &p.module.rx_pdos,
            Direction::Tx => &p.module.tx_pdos,
        });
        let mut pdos: Vec<Pdo> = device.iter().filter(|pdo| !pdo.virtual_).cloned().collect();
        for new in modules.filter(|pdo| !pdo.virtual_) {
            let mut new = new.clone();
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

    pub(super) fn coe(&self) -> Option<&Coe> {
        self.device.mailbox.as_ref()?.coe.as_ref()
    }

    fn of_device(&self) -> &[Pdo] {
        match self.direction {
            Direction::Rx => &self.device.rx_pdos,
            Direction::Tx => &self.device.tx_pdos,
        }
    }

    /// Returns the PDOs to assign, in order, each with its SyncManager.
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
            notes.extend(self.absent_sm(pdo, sm));
            notes.extend(self.other_direction(pdo, sm));
            if pdo.excluded_sm.contains(&sm) {
                return Err(SelectError::ExcludedSyncManager {
                    device: self.device.name.clone(),
                    pdo: pdo.index,
                    sm,
                });
            }
            pdo.sm = Some(sm);
        }
        if own.is_some() {
            return Ok(chosen);
        }
        let mut sampled = Vec::with_capacity(chosen.len());
        for pdo in chosen {
            let factor = self.samples(&pdo);
            let samples = pdo
                .samples(factor)
                .ok_or_else(|| SelectError::TooManySamples {
                    pdo: pdo.index,
                    position: pdo.position,
                    factor,
                    max: pdo.oversampling.and_then(|own| own.max),
                })?;
            sampled.extend(samples);
        }
        Ok(sampled)
    }

    /// Returns the number of samples of a PDO per cycle: from its assignment, otherwise from the
    /// PDO itself.
    fn samples(&self, pdo: &Pdo) -> u16 {
        let assigned = self.assignment.filter(|assignment| {
            let mut all = assignment.sync_managers.iter().flat_map(|(_, pdos)| pdos);
            all.any(|index| *index == pdo.index)
        });
        match assigned {
            Some(assignment) => {
                let mut all = assignment.oversampling.iter();
                all.find(|(index, _)| *index == pdo.index)
                    .map_or(1, |(_, factor)| *factor)
            }
            None => pdo.oversampling.map_or(1, |sampling| sampling.factor),
        }
    }

    /// Applies the named assignment, if there is one. Its SyncManagers carry its PDOs in its order,
    /// before the PDOs of other SyncManagers.
    fn assigned(&self, mut available: Vec<Pdo>) -> Result<Vec<Pdo>, SelectError> {
        let Some(assignment) = self.assignment else {
            return Ok(available);
        };
        let of_direction = |sm: &&(u8, Vec<u16>)| {
            let usage = self.device.sync_managers.get(usize::from(sm.0));
            usage.is_some_and(|sm| sm.usage == SmUse::from(self.direction))
        };
        // A `Sm` of an OpMode without a `Pdo` keeps the default.
        let lists = |sm: &&(u8, Vec<u16>)| !assignment.whole_direction || !sm.1.is_empty();
        let named = |sm| {
            let mut all = assignment.sync_managers.iter().filter(lists);
            all.any(|(number, _)| *number == sm)
        };
        let mut listed = assignment.sync_managers.iter().filter(lists);
        let whole = assignment.whole_direction && listed.any(|sm| of_direction(&sm));
        for pdo in &mut available {
            if whole || pdo.sm.is_some_and(named) {
                pdo.sm = None;
            }
        }
        let mut first = Vec::new();
        for (sm, pdos) in assignment.sync_managers.iter().filter(of_direction) {
            for index in pdos {
                let Some(at) = available.iter().position(|pdo| pdo.index == *index) else {
                    // Virtual PDOs are listed but accessible without an assignment.
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

    /// Returns the device's default assignment. Mutual exclusions are resolved in file order;
    /// PDOs of one named assignment do not exclude each other.
    fn default_set(&self, available: &[Pdo], notes: &mut Vec<String>) -> Vec<Pdo> {
        let is_listed = |pdo: &Pdo| {
            let lists = self.assignment.into_iter().flat_map(|a| a.sync_managers);
            lists.into_iter().any(|(_, pdos)| pdos.contains(&pdo.index))
        };
        let mut set: Vec<Pdo> = Vec::new();
        for pdo in available.iter().filter(|pdo| pdo.sm.is_some()) {
            let excludes =
                |other: &&Pdo| conflict(other, pdo) && !(is_listed(other) && is_listed(pdo));
            match set.iter().find(excludes) {
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
        if let Some(set) = self.with_objects(available, &default, &needed) {
            return Ok(match self.direction {
                _ if !self.coe().is_some_and(|coe| coe.pdo_assign) => set,
                Direction::Rx => drop_repeated_objects(set, &needed, notes),
                Direction::Tx => self.with_positions(available, &default, set, &needed),
            });
        }
        if let Some(pdo) = self.filled(available, &default, &needed) {
            notes.push(format!(
                "PDO 0x{:04x} gets the objects of mode {mode}: no PDO of the ESI has them",
                pdo.index
            ));
            return Ok(self.alongside(pdo, &default));
        }
        match self.direction {
            Direction::Rx => Err(self.not_offered(available, mode)),
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

    fn not_offered(&self, available: &[Pdo], mode: Mode) -> SelectError {
        let device = self.device.name.clone();
        let missing = self.axes.iter().find_map(|&axis| {
            let index = axis::object(CONTROLWORD, axis);
            (axis > 0 && !contains(available, index)).then_some((axis, index))
        });
        if let Some((axis, index)) = missing {
            return SelectError::NoSuchAxis {
                device,
                number: axis.saturating_add(1),
                index,
            };
        }
        let needed = self.needed(mode);
        let mut entries = available.iter().flat_map(|pdo| &pdo.entries);
        if let Some(entry) = entries.find(|e| needed.contains(&e.index) && e.sub != 0) {
            return SelectError::SubindexOfValue {
                device,
                position: entry.position,
                mode,
                index: entry.index,
                sub: entry.sub,
            };
        }
        let target = mode.target_object();
        if !contains(available, CONTROLWORD) && target.is_some_and(|t| contains(available, t)) {
            return SelectError::NoControlword { device, mode };
        }
        SelectError::ModeNotOffered {
            missing: needed
                .into_iter()
                .find(|index| !contains(available, *index)),
            device,
            mode,
            offered: offered_by_pdos(available),
        }
    }

    /// Returns an assignment with all objects: the default, or a PDO with all of them alongside the
    /// default, or several PDOs.
    fn with_objects(
        &self,
        available: &[Pdo],
        default: &[Pdo],
        objects: &[u16],
    ) -> Option<Vec<Pdo>> {
        if objects.iter().all(|&index| contains(default, index)) {
            return Some(default.to_vec());
        }
        let one = available.iter().find(|pdo| contains_all(pdo, objects));
        one.map(|pdo| self.alongside(pdo.clone(), default))
            .or_else(|| cover(available, default, objects))
    }

    /// Returns an empty mapping object with what a mode needs, for devices whose PDOs only the
    /// dictionary describes. Inputs also get the actual position.
    fn filled(&self, available: &[Pdo], default: &[Pdo], needed: &[u16]) -> Option<Pdo> {
        let coe = self.coe().filter(|coe| coe.pdo_config)?;
        let is_default = |pdo: &Pdo| default.iter().any(|other| other.index == pdo.index);
        let takes_objects = |pdo: &&Pdo| {
            !pdo.fixed && pdo.entries.is_empty() && (coe.pdo_assign || is_default(pdo))
        };
        let empty = available.iter().find(takes_objects)?;
        // Inputs that have the Statusword stay as they are.
        if self.direction == Direction::Tx && contains(default, STATUSWORD) {
            return None;
        }
        let with = |objects: &[u16]| {
            let mut pdo = empty.clone();
            let entries = objects
                .iter()
                .map(|&index| self.entry(EntryRef { index, sub: 0 }));
            pdo.entries = entries.collect::<Result<_, _>>().ok()?;
            Some(pdo)
        };
        match self.direction {
            Direction::Rx => with(needed),
            Direction::Tx => {
                let positions = self.positions().filter(|index| !needed.contains(index));
                let all: Vec<u16> = needed.iter().copied().chain(positions).collect();
                with(&all).or_else(|| with(needed))
            }
        }
    }

    /// Returns the actual position of each axis in use.
    fn positions(&self) -> impl Iterator<Item = u16> {
        self.axes.iter().map(|&axis| axis::object(POSITION, axis))
    }

    /// Adds the actual positions (0x6064) to inputs without them, if a PDO contains them. An axis
    /// supervises its position in every mode.
    fn with_positions(
        &self,
        available: &[Pdo],
        default: &[Pdo],
        mut set: Vec<Pdo>,
        needed: &[u16],
    ) -> Vec<Pdo> {
        for position in self.positions() {
            if contains(&set, position) {
                continue;
            }
            let with_position = available.iter().filter(|pdo| {
                let room = self.capacity(pdo) > set.len();
                let free = set.iter().all(|other| !conflict(other, pdo));
                room && free && contains(std::slice::from_ref(*pdo), position)
            });
            if let Some(pdo) = with_position.min_by_key(|pdo| pdo.bit_len()) {
                set.push(pdo.clone());
                continue;
            }
            let objects = [needed, &[position]].concat();
            let one = available.iter().find(|pdo| contains_all(pdo, &objects));
            if let Some(pdo) = one {
                set = self.alongside(pdo.clone(), default);
            }
        }
        set
    }

    /// Returns the objects that a mode needs, axis by axis.
    pub(super) fn needed(&self, mode: Mode) -> Vec<u16> {
        let of_first = match self.direction {
            Direction::Rx => [Some(CONTROLWORD), mode.target_object()],
            Direction::Tx => [Some(STATUSWORD), Some(mode.actual_object())],
        };
        let axes = self.axes.iter();
        axes.flat_map(|&axis| {
            let objects = of_first.into_iter().flatten();
            objects.map(move |index| axis::object(index, axis))
        })
        .collect()
    }

    /// Returns `pdo`, followed by the default PDOs that `pdo` does not exclude, up to the capacity.
    pub(super) fn alongside(&self, pdo: Pdo, default: &[Pdo]) -> Vec<Pdo> {
        let room = self.capacity(&pdo);
        let mut set = vec![pdo];
        // Mandatory PDOs take capacity first, but the assignment keeps file order.
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

    /// Returns the number of PDOs that the assignment object can hold.
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

    pub(super) fn label(&self) -> &'static str {
        match self.direction {
            Direction::Rx => "pdo.rx",
            Direction::Tx => "pdo.tx",
        }
    }

    /// Reports a SyncManager that the device does not have.
    fn absent_sm(&self, pdo: &Pdo, taken: u8) -> Option<String> {
        let named = pdo.sm.filter(|sm| *sm != taken)?;
        Some(format!(
            "warning: {} 0x{:04x} is assigned to SyncManager {named}, which the device does not \
             have: SyncManager {taken} carries it; correct `Sm` in the ESI file",
            direction_name(self.direction),
            pdo.index
        ))
    }

    /// Reports a SyncManager that does not carry process data of this direction.
    fn other_direction(&self, pdo: &Pdo, sm: u8) -> Option<String> {
        let usage = self.device.sync_managers.get(usize::from(sm))?.usage;
        let carries = match (self.direction, usage) {
            (Direction::Rx, SmUse::Outputs)
            | (Direction::Tx, SmUse::Inputs)
            | (_, SmUse::Other) => {
                return None;
            }
            (_, SmUse::Outputs) => "outputs",
            (_, SmUse::Inputs) => "inputs",
            (_, SmUse::MBoxOut | SmUse::MBoxIn) => "a mailbox",
        };
        Some(format!(
            "warning: {} 0x{:04x} is assigned to SyncManager {sm}, which carries {carries}: the \
             device exchanges nothing there; correct `Sm` in the ESI file",
            direction_name(self.direction),
            pdo.index
        ))
    }

    fn sm_of(&self, pdo: &Pdo) -> Result<u8, SelectError> {
        pdo.sm
            .filter(|sm| usize::from(*sm) < self.device.sync_managers.len())
            .or_else(|| self.device.primary_sm(self.direction))
            .ok_or_else(|| SelectError::NoSyncManager {
                device: self.device.name.clone(),
                pdo: pdo.index,
                direction: direction_name(self.direction),
            })
    }
}

pub(super) fn direction_name(direction: Direction) -> &'static str {
    match direction {
        Direction::Rx => "RxPdo",
        Direction::Tx => "TxPdo",
    }
}

pub(super) fn conflict(a: &Pdo, b: &Pdo) -> bool {
    let excludes = |a: &Pdo, b: &Pdo| a.exclude.iter().any(|other| other.index == b.index);
    a.index != b.index && (excludes(a, b) || excludes(b, a))
}

/// Drops the PDOs whose objects another PDO of the set repeats, except mandatory ones. A drive
/// would take the Controlword from any of them.
fn drop_repeated_objects(mut set: Vec<Pdo>, needed: &[u16], notes: &mut Vec<String>) -> Vec<Pdo> {
    // The PDO with the most objects of the mode stays.
    let main = set.iter().rev().max_by_key(|pdo| {
        let objects = needed.iter();
        objects
            .filter(|&&index| contains(std::slice::from_ref(*pdo), index))
            .count()
    });
    let Some(main) = main.map(|pdo| pdo.index) else {
        return set;
    };
    let objects = |pdo: &Pdo| -> Vec<(u16, u8)> {
        let mapped = pdo.entries.iter().filter(|entry| !entry.is_gap());
        mapped.map(|entry| (entry.index, entry.sub)).collect()
    };
    let mut copies: HashMap<(u16, u8), usize> = HashMap::new();
    for object in set.iter().flat_map(objects) {
        *copies.entry(object).or_default() += 1;
    }
    set.retain(|pdo| {
        let own = objects(pdo);
        let is_repeated = |object: &(u16, u8)| copies.get(object).is_some_and(|&n| n > 1);
        let repeats = !own.is_empty() && own.iter().all(is_repeated);
        if !repeats || pdo.index == main || pdo.mandatory {
            return true;
        }
        for object in own {
            copies.entry(object).and_modify(|n| *n = n.saturating_sub(1));
        }
        notes.push(format!(
            "PDO 0x{:04x} is assigned by default and left out: 0x{main:04x} and others have its objects",
            pdo.index
        ));
        false
    });
    set
}

/// Returns several PDOs that together contain the objects of a mode, for devices with one object
/// per PDO. Default PDOs come first, then the shortest PDO for each missing object.
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

fn contains_all(pdo: &Pdo, objects: &[u16]) -> bool {
    let mut objects = objects.iter();
    objects.all(|&index| contains(std::slice::from_ref(pdo), index))
}

/// True if a PDO maps the value of a CiA 402 object, which has subindex 0.
pub(super) fn contains(set: &[Pdo], index: u16) -> bool {
    set.iter()
        .flat_map(|pdo| &pdo.entries)
        .any(|entry| (entry.index, entry.sub) == (index, 0))
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
