//! PDO assignment (0x1C10 + SyncManager) and mapping (0x16xx, 0x1Axx): permitted writes, the effect
//! of modules, and the resulting bit layout.

use ecaxis_esi::model::{
    Access, Device, Direction, Entry, Module, ObjectCode, Pdo, Slot, SmUse, Writable,
};

use super::Abort;
use super::object_dictionary::{EntryHandle, Item, ObjectStore};
use crate::esc::al::AlState;
use crate::esc::sm::Mode;

/// The assignment object of SyncManager 0.
const ASSIGNMENT: u16 = 0x1c10;
const MODULE_LIST: u16 = 0xf030;
const DETECTED_MODULES: u16 = 0xf050;
const MAX_ASSIGNED: u8 = 8;
const MAX_MAPPED: u8 = 16;

/// A PDO of the device.
#[derive(Debug, Clone)]
struct KnownPdo {
    index: u16,
    direction: Direction,
    fixed: bool,
    /// True if one cycle may contain several samples.
    oversampled: bool,
    exclude: Vec<u16>,
}

/// The process data of one SyncManager.
#[derive(Debug, Clone)]
pub struct ProcessSm {
    pub sm: u8,
    pub direction: Direction,
    /// Three buffers, or one buffer as in terminals of some vendors.
    pub mode: Mode,
    max_len: Option<u16>,
}

/// The PDO contents that a module adds to its slot.
#[derive(Debug, Clone)]
struct ModulePdos {
    slot: usize,
    ident: u32,
    /// PDO indices and their mapping entries.
    contents: Vec<(u16, Vec<u32>)>,
}

/// One object inside the process data of a SyncManager.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mapped {
    pub slot: EntryHandle,
    pub bit: usize,
    pub bits: usize,
}

/// The PDOs of the default modules, by slot.
#[derive(Debug, Default)]
struct DefaultPdos {
    rx: Vec<Pdo>,
    tx: Vec<Pdo>,
}

impl DefaultPdos {
    fn new(device: &Device, modules: &[Module]) -> Self {
        let mut all = Self::default();
        let Some(slots) = &device.slots else {
            return all;
        };
        for (position, slot) in expand(slots).enumerate() {
            let default = default_module(slot);
            let Some(module) = modules.iter().find(|m| Some(m.ident) == default) else {
                continue;
            };
            let module = module.at(device, slots, slot, position);
            all.rx.extend(module.rx_pdos);
            all.tx.extend(module.tx_pdos);
        }
        all
    }
}

fn default_module(slot: &Slot) -> Option<u32> {
    let default = slot.module_idents.iter().find(|(_, default)| *default);
    default.map(|(ident, _)| *ident)
}

#[derive(Debug, Clone, Default)]
pub struct PdoRules {
    pdos: Vec<KnownPdo>,
    sms: Vec<ProcessSm>,
    modules: Vec<ModulePdos>,
    /// The module idents that each slot accepts.
    slots: Vec<Vec<u32>>,
    /// True if the slots hold hardware, so the detected modules do not follow the configured ones.
    modules_are_hardware: bool,
    /// The entries (direction, index << 8 | sub) of the ESI's PDOs. They are mappable regardless of
    /// flags.
    known_entries: Vec<(Direction, u32)>,
    /// The default assignments and those that OpModes and alternative mappings of the ESI name.
    named: Vec<NamedAssignment>,
    /// The lists that the device replaced to fit the length of a SyncManager, as they were before.
    replaced: Vec<(u16, Vec<u32>)>,
    /// True if a MainDevice may write the assignment, and if it may write the mapping.
    assign: bool,
    config: bool,
}

/// The PDOs of one SyncManager that the ESI assigns together, with their samples. They do not
/// exclude each other.
#[derive(Debug, Clone)]
struct NamedAssignment {
    sm: u8,
    /// PDO indices and their mapping entries.
    contents: Vec<(u16, Vec<u32>)>,
    bits: usize,
}

impl NamedAssignment {
    fn new(sm: u8, pdos: &[Pdo]) -> Self {
        let contents = |pdo: &Pdo| (pdo.index, pdo.entries.iter().map(Entry::mapping).collect());
        Self {
            sm,
            contents: pdos.iter().map(contents).collect(),
            bits: pdos.iter().map(|pdo| pdo.bit_len() as usize).sum(),
        }
    }

    fn contains(&self, pdo: u16) -> bool {
        self.contents.iter().any(|(index, _)| *index == pdo)
    }

    fn indices(&self) -> Vec<u16> {
        self.contents.iter().map(|(index, _)| *index).collect()
    }

    fn bytes(&self) -> usize {
        self.bits.div_ceil(8)
    }
}

/// Returns a PDO with its samples, or alone if the factor is impossible.
fn sampled(pdo: &Pdo, factor: u16) -> Vec<Pdo> {
    pdo.samples(factor).unwrap_or_else(|| vec![pdo.clone()])
}

/// Returns the samples per cycle of a PDO that no OpMode assigns.
fn default_factor(pdo: &Pdo) -> u16 {
    pdo.oversampling.map_or(1, |sampling| sampling.factor)
}

/// Returns the assignments that OpModes and alternative mappings name.
fn named_assignments(device: &Device) -> Vec<(u8, Vec<Pdo>)> {
    let modes = device.dc_modes.iter();
    let modes = modes.map(|mode| (&mode.sync_managers, &mode.oversampling));
    let mappings = device.sm_mappings.iter();
    let mappings = mappings.map(|mapping| (&mapping.sync_managers, &mapping.oversampling));
    let mut named = Vec::new();
    for (sync_managers, factors) in modes.chain(mappings) {
        for (sm, pdos) in sync_managers.iter().filter(|(_, pdos)| !pdos.is_empty()) {
            let mut all = Vec::new();
            for index in pdos {
                let mut own = device.rx_pdos.iter().chain(&device.tx_pdos);
                let Some(pdo) = own.find(|pdo| pdo.index == *index && !pdo.virtual_) else {
                    continue;
                };
                let factor = factors.iter().find(|(of, _)| of == index);
                all.extend(sampled(pdo, factor.map_or(1, |(_, factor)| *factor)));
            }
            named.push((*sm, all));
        }
    }
    named
}

impl PdoRules {
    /// Reads the ESI and stores the power-on assignment and mapping.
    #[must_use]
    pub fn new(store: &mut ObjectStore, device: &Device, modules: &[Module]) -> Self {
        let mut rules = Self::default();
        let coe = device
            .mailbox
            .as_ref()
            .and_then(|mailbox| mailbox.coe.as_ref());
        // S-0-0016 and S-0-0024 list the contents of a Sercos drive's telegrams.
        let sercos = device.soe_only().is_some();
        (rules.assign, rules.config) =
            coe.map_or((false, sercos), |coe| (coe.pdo_assign, coe.pdo_config));
        // The objects are those of the PDOs that are not virtual.
        let mut of_device: Vec<&Pdo> = device.rx_pdos.iter().chain(&device.tx_pdos).collect();
        of_device.sort_by_key(|pdo| pdo.virtual_);
        for pdo in of_device {
            if let Some(first) = sampled(pdo, default_factor(pdo)).first() {
                rules.learn(store, first);
            }
        }
        let named = named_assignments(device);
        for pdo in named.iter().flat_map(|(_, pdos)| pdos) {
            rules.learn(store, pdo);
        }
        rules.learn_modules(store, device, modules);
        let plugged = DefaultPdos::new(device, modules);
        for (n, sm) in device.sync_managers.iter().enumerate().take(8) {
            let direction = match sm.usage {
                SmUse::Outputs => Direction::Rx,
                SmUse::Inputs => Direction::Tx,
                _ => continue,
            };
            let Ok(n) = u8::try_from(n) else { continue };
            rules.sms.push(ProcessSm {
                sm: n,
                direction,
                mode: Mode::from_control(sm.control_byte),
                max_len: sm.max_size,
            });
            let (own, plugged) = match direction {
                Direction::Rx => (&device.rx_pdos, &plugged.rx),
                Direction::Tx => (&device.tx_pdos, &plugged.tx),
            };
            let mut default: Vec<Pdo> = Vec::new();
            for pdo in own.iter().chain(plugged).filter(|pdo| pdo.sm == Some(n)) {
                // A module may overwrite a PDO of the device.
                if !default.iter().any(|other| other.index == pdo.index) {
                    default.extend(sampled(pdo, default_factor(pdo)));
                }
            }
            for pdo in &default {
                rules.learn(store, pdo);
            }
            let assigned: Vec<u16> = default.iter().map(|pdo| pdo.index).collect();
            rules.named.push(NamedAssignment::new(n, &default));
            let own_named = named.iter().filter(|(sm, _)| *sm == n);
            let own_named = own_named.map(|(_, pdos)| NamedAssignment::new(n, pdos));
            rules.named.extend(own_named);
            let of_sm = rules.named.iter().filter(|named| named.sm == n);
            let longest = of_sm.map(|named| named.contents.len()).max();
            let longest = u8::try_from(longest.unwrap_or(0)).unwrap_or(u8::MAX);
            let room = MAX_ASSIGNED.max(longest);
            let index = ASSIGNMENT + u16::from(n);
            let name = format!("SyncManager {n} PDO assignment");
            store.describe(index, ObjectCode::Array, &name);
            rules.fill(store, index, 16, &assigned, room, rules.assign);
        }
        rules.plug_defaults(store, device);
        rules
    }

    fn learn(&mut self, store: &mut ObjectStore, pdo: &Pdo) {
        let index = pdo.index;
        if !self.pdos.iter().any(|known| known.index == index) {
            self.pdos.push(KnownPdo {
                index,
                direction: pdo.direction,
                fixed: pdo.fixed,
                oversampled: pdo.oversampling.is_some(),
                exclude: pdo.exclude.iter().map(|other| other.index).collect(),
            });
            let entries: Vec<u32> = pdo.entries.iter().map(|entry| entry.mapping()).collect();
            store.describe(index, ObjectCode::Record, &pdo.name);
            let writable = self.config && !pdo.fixed;
            self.fill(store, index, 32, &entries, MAX_MAPPED, writable);
        }
        for entry in pdo.entries.iter().filter(|entry| !entry.is_gap()) {
            let access = Access {
                read: true,
                write: if pdo.direction == Direction::Rx {
                    Writable::Always
                } else {
                    Writable::Never
                },
            };
            let new = store.slot(entry.index, entry.sub).is_none();
            let bits = u32::from(entry.bit_len);
            let slot = store.ensure(entry.index, entry.sub, &entry.name, bits, access, &[]);
            if new {
                store.set_type(slot, &entry.data_type);
            } else if pdo.oversampling.is_some() {
                // All samples of a cycle may be one object.
                store.lengthen(slot, bits);
            }
            let key = (pdo.direction, entry.mapping() >> 8);
            if !self.known_entries.contains(&key) {
                self.known_entries.push(key);
            }
        }
    }

    fn learn_modules(&mut self, store: &mut ObjectStore, device: &Device, modules: &[Module]) {
        let Some(slots) = &device.slots else { return };
        for (position, slot) in expand(slots).enumerate() {
            self.slots
                .push(slot.module_idents.iter().map(|(ident, _)| *ident).collect());
            for module in modules {
                if !slot
                    .module_idents
                    .iter()
                    .any(|(ident, _)| *ident == module.ident)
                {
                    continue;
                }
                let module = module.at(device, slots, slot, position);
                let mut contents = Vec::new();
                let all = module.rx_pdos.iter().chain(&module.tx_pdos);
                for pdo in all.flat_map(|pdo| sampled(pdo, default_factor(pdo))) {
                    self.learn(store, &pdo);
                    contents.push((
                        pdo.index,
                        pdo.entries.iter().map(|entry| entry.mapping()).collect(),
                    ));
                }
                self.modules.push(ModulePdos {
                    slot: position,
                    ident: module.ident,
                    contents,
                });
            }
        }
    }

    /// Adds the default modules and the module lists.
    fn plug_defaults(&mut self, store: &mut ObjectStore, device: &Device) {
        let Some(slots) = &device.slots else { return };
        let defaults: Vec<u32> = expand(slots)
            .map(|slot| default_module(slot).unwrap_or(0))
            .collect();
        let max = u8::try_from(defaults.len()).unwrap_or(u8::MAX);
        store.describe(MODULE_LIST, ObjectCode::Array, "Configured modules");
        store.describe(DETECTED_MODULES, ObjectCode::Array, "Detected modules");
        self.fill(store, MODULE_LIST, 32, &defaults, max, true);
        self.fill(store, DETECTED_MODULES, 32, &defaults, max, false);
        for (slot, ident) in defaults.iter().enumerate() {
            self.plug(store, slot, *ident);
        }
    }

    /// Creates a list object if it is missing and sets count and elements.
    fn fill<T: Copy + Into<u32>>(
        &self,
        store: &mut ObjectStore,
        index: u16,
        bits: u32,
        values: &[T],
        room: u8,
        writable: bool,
    ) {
        let write = if writable {
            Writable::Only {
                pre_op: true,
                safe_op: false,
                op: false,
            }
        } else {
            Writable::Never
        };
        let access = Access { read: true, write };
        let used = u8::try_from(values.len()).unwrap_or(u8::MAX);
        let subs = if writable { used.max(room) } else { used };
        let exists = store.has_object(index);
        let count = store.ensure(index, 0, "SubIndex 000", 8, access, &[]);
        store.set(count, i64::from(used));
        if writable {
            store.set_access(count, write);
        }
        for sub in 1..=subs {
            let slot = match store.slot(index, sub) {
                None if exists && sub > used => continue,
                _ => store.ensure(index, sub, &format!("SubIndex {sub:03}"), bits, access, &[]),
            };
            // Some files give the last entry the type of the mapped object.
            let slot = store.lengthen(slot, bits);
            if writable {
                store.set_access(slot, write);
            }
            let value = values.get(usize::from(sub) - 1).map_or(0, |v| (*v).into());
            store.set(slot, i64::from(value));
        }
    }

    fn plug(&self, store: &mut ObjectStore, slot: usize, ident: u32) {
        let Some(module) = self
            .modules
            .iter()
            .find(|m| (m.slot, m.ident) == (slot, ident))
        else {
            return;
        };
        for (index, entries) in &module.contents {
            for sub in 1..=u8::MAX {
                let Some(slot) = store.slot(*index, sub) else {
                    break;
                };
                let value = entries.get(usize::from(sub) - 1).copied().unwrap_or(0);
                store.set(slot, i64::from(value));
            }
            if let Some(count) = store.slot(*index, 0) {
                store.set(count, i64::try_from(entries.len()).unwrap_or(0));
            }
        }
    }

    /// True for assignment, mapping and module lists. Only their first "count" elements are valid.
    pub(crate) fn is_list(&self, index: u16) -> bool {
        self.assignment(index).is_some()
            || self.pdo(index).is_some()
            || matches!(index, MODULE_LIST | DETECTED_MODULES)
    }

    fn pdo(&self, index: u16) -> Option<&KnownPdo> {
        self.pdos.iter().find(|pdo| pdo.index == index)
    }

    fn assignment(&self, index: u16) -> Option<&ProcessSm> {
        self.sms
            .iter()
            .find(|sm| ASSIGNMENT + u16::from(sm.sm) == index)
    }

    /// Makes the present modules hardware.
    pub(crate) fn fix_modules(&mut self) {
        self.modules_are_hardware = true;
    }

    /// True if the configured modules (0xF030) differ from the detected ones (0xF050).
    pub(crate) fn modules_differ(&self, store: &ObjectStore) -> bool {
        let module = |list: u16, sub: u8| {
            let listed = i64::from(sub) <= count(store, list);
            let slot = store.slot(list, sub).filter(|_| listed);
            slot.map_or(0, |slot| store.get(slot))
        };
        self.modules_are_hardware
            && (1..=u8::MAX).any(|sub| module(MODULE_LIST, sub) != module(DETECTED_MODULES, sub))
    }

    /// Takes the assignment of the ESI whose length a SyncManager has. A device without PDO
    /// assignment, or with all samples in one PDO, has no object for the OpMode of the MainDevice.
    /// [`PdoRules::release`] ends it.
    pub(crate) fn adopt(&mut self, store: &mut ObjectStore, sm: u8, len: usize) {
        if self.layout(store, sm, &mut Vec::new()) == len {
            return;
        }
        let index = ASSIGNMENT + u16::from(sm);
        let assigned: Vec<u16> = elements(store, index, count(store, index))
            .map(|pdo| pdo as u16)
            .collect();
        let mut of_sm = self.named.iter().filter(|named| named.sm == sm);
        let Some(named) = of_sm.find(|named| {
            let pdos = named.indices();
            named.bytes() == len && (!self.assign || pdos == assigned)
        }) else {
            return;
        };
        let oversampled = |pdo: u16| self.pdo(pdo).is_some_and(|pdo| pdo.oversampled);
        let mappings = named.contents.iter().filter(|(pdo, _)| oversampled(*pdo));
        let mut lists: Vec<(u16, Vec<u32>)> = mappings.cloned().collect();
        let pdos = named.indices().into_iter();
        lists.insert(0, (index, pdos.map(u32::from).collect()));
        for (list, values) in lists {
            let before = elements(store, list, count(store, list)).collect();
            if !self.replaced.iter().any(|(replaced, _)| *replaced == list) {
                self.replaced.push((list, before));
            }
            self.replace(store, list, &values);
        }
    }

    /// Gives the lists that [`PdoRules::adopt`] replaced their former values: another MainDevice reads
    /// those of the device, or of the MainDevice that wrote them.
    pub(crate) fn release(&mut self, store: &mut ObjectStore) {
        for (list, values) in std::mem::take(&mut self.replaced) {
            self.replace(store, list, &values);
        }
    }

    /// Forgets the replaced lists: all objects have their values at power-on.
    pub(crate) fn power_on(&mut self) {
        self.replaced.clear();
    }

    /// Sets the elements of an assignment or a mapping.
    fn replace(&self, store: &mut ObjectStore, list: u16, values: &[u32]) {
        let (bits, writable) = match self.assignment(list) {
            Some(_) => (16, self.assign),
            None => (
                32,
                self.config && self.pdo(list).is_some_and(|pdo| !pdo.fixed),
            ),
        };
        self.fill(store, list, bits, values, 0, writable);
    }

    /// Returns the bytes of the longest assignment that the ESI names for a SyncManager.
    pub(crate) fn longest_named(&self, sm: u8) -> usize {
        let of_sm = self.named.iter().filter(|named| named.sm == sm);
        of_sm.map(NamedAssignment::bytes).max().unwrap_or(0)
    }

    /// Rejects a write that makes assignment or mapping invalid.
    pub(crate) fn before_write(
        &self,
        store: &ObjectStore,
        index: u16,
        sub: u8,
        value: i64,
        state: AlState,
    ) -> Result<(), Abort> {
        if !self.is_list(index) {
            return Ok(());
        }
        if state != AlState::PreOp {
            return Err(Abort::WRONG_STATE);
        }
        if self.pdo(index).is_some_and(|pdo| pdo.fixed) {
            return Err(Abort::READ_ONLY);
        }
        if index == MODULE_LIST {
            return self.check_module(sub, value);
        }
        let count = store.slot(index, 0).map_or(0, |slot| store.get(slot));
        if sub != 0 {
            if count != 0 {
                return Err(Abort::COUNT_NOT_ZERO);
            }
            return match self.assignment(index) {
                Some(sm) => self.check_assigned(value, sm.direction),
                None => self.check_entry(store, index, value),
            };
        }
        if u8::try_from(value)
            .ok()
            .and_then(|n| store.slot(index, n))
            .is_none()
        {
            return Err(Abort::VALUE_TOO_HIGH);
        }
        match self.assignment(index) {
            Some(sm) => self.check_assignment(store, sm, index, value),
            None => self.check_mapping(store, index, value),
        }
    }

    /// Applies a write to a module list: the PDOs of the slot change.
    pub(crate) fn after_write(&self, store: &mut ObjectStore, index: u16, sub: u8, value: i64) {
        if index == MODULE_LIST && sub > 0 {
            let ident = u32::try_from(value).unwrap_or(0);
            self.plug(store, usize::from(sub) - 1, ident);
            if !self.modules_are_hardware
                && let Some(slot) = store.slot(DETECTED_MODULES, sub)
            {
                store.set(slot, value);
            }
        }
    }

    fn check_module(&self, sub: u8, value: i64) -> Result<(), Abort> {
        let Some(position) = usize::from(sub).checked_sub(1) else {
            let most = i64::try_from(self.slots.len()).unwrap_or(i64::MAX);
            return if value <= most {
                Ok(())
            } else {
                Err(Abort::VALUE_TOO_HIGH)
            };
        };
        let fits = self
            .slots
            .get(position)
            .is_some_and(|idents| value == 0 || idents.iter().any(|i| i64::from(*i) == value));
        if fits { Ok(()) } else { Err(Abort::VALUE) }
    }

    fn check_assigned(&self, value: i64, direction: Direction) -> Result<(), Abort> {
        let pdo = u16::try_from(value).ok().and_then(|index| self.pdo(index));
        let fits = value == 0 || pdo.is_some_and(|pdo| pdo.direction == direction);
        if fits {
            Ok(())
        } else {
            Err(Abort::NOT_MAPPABLE)
        }
    }

    fn check_entry(&self, store: &ObjectStore, pdo: u16, value: i64) -> Result<(), Abort> {
        let Some(pdo) = self.pdo(pdo) else {
            return Err(Abort::NOT_MAPPABLE);
        };
        let value = u32::try_from(value).map_err(|_| Abort::VALUE)?;
        let [bits, sub, low, high] = value.to_le_bytes();
        let index = u16::from_le_bytes([low, high]);
        if index == 0 {
            return Ok(());
        }
        let Some(item) = store.slot(index, sub).and_then(|slot| store.item(slot)) else {
            return Err(Abort::NOT_MAPPABLE);
        };
        let bits = u32::from(bits);
        // An object of samples has the length of the most samples.
        let fits = item.bit_len & 0xff == bits || pdo.oversampled && bits <= item.bit_len;
        if self.mappable(pdo.direction, item) && fits {
            Ok(())
        } else {
            Err(Abort::NOT_MAPPABLE)
        }
    }

    /// True if the flags or the PDOs of the ESI allow mapping the item.
    pub(crate) fn mappable(&self, direction: Direction, item: &Item) -> bool {
        let flagged = match direction {
            Direction::Rx => item.mapping.rx,
            Direction::Tx => item.mapping.tx,
        };
        let key = u32::from(item.index) << 8 | u32::from(item.sub);
        flagged || self.known_entries.contains(&(direction, key))
    }

    /// True if a received PDO contains the item under the current assignment and mapping.
    pub(crate) fn receives(&self, store: &ObjectStore, index: u16, sub: u8) -> bool {
        let key = u32::from(index) << 8 | u32::from(sub);
        let mut outputs = self.sms.iter().filter(|sm| sm.direction == Direction::Rx);
        outputs.any(|sm| {
            let assignment = ASSIGNMENT + u16::from(sm.sm);
            elements(store, assignment, count(store, assignment))
                .flat_map(|pdo| elements(store, pdo as u16, count(store, pdo as u16)))
                .any(|entry| entry >> 8 == key)
        })
    }

    fn check_assignment(
        &self,
        store: &ObjectStore,
        sm: &ProcessSm,
        index: u16,
        count: i64,
    ) -> Result<(), Abort> {
        let assigned: Vec<u16> = elements(store, index, count).map(|v| v as u16).collect();
        let in_one = |named: &NamedAssignment| assigned.iter().all(|pdo| named.contains(*pdo));
        let mut pdos = assigned.iter().filter_map(|index| self.pdo(*index));
        let excluded = pdos.any(|pdo| pdo.exclude.iter().any(|other| assigned.contains(other)));
        if excluded && !self.named.iter().any(in_one) {
            return Err(Abort::INCOMPATIBLE);
        }
        let bits: usize = assigned.iter().map(|pdo| mapped_bits(store, *pdo)).sum();
        self.check_len(sm, bits)
    }

    fn check_mapping(&self, store: &ObjectStore, index: u16, count: i64) -> Result<(), Abort> {
        for entry in elements(store, index, count) {
            self.check_entry(store, index, i64::from(entry))?;
        }
        let bits: usize = elements(store, index, count)
            .map(|entry| (entry & 0xff) as usize)
            .sum();
        let direction = self.pdo(index).map(|pdo| pdo.direction);
        self.sms
            .iter()
            .filter(|sm| Some(sm.direction) == direction)
            .try_for_each(|sm| self.check_len(sm, bits))
    }

    fn check_len(&self, sm: &ProcessSm, bits: usize) -> Result<(), Abort> {
        let most = sm
            .max_len
            .filter(|len| *len > 0)
            .map_or(usize::MAX, usize::from);
        if bits.div_ceil(8) > most {
            Err(Abort::MAPPING_TOO_LONG)
        } else {
            Ok(())
        }
    }

    pub(crate) fn process_sms(&self) -> &[ProcessSm] {
        &self.sms
    }

    /// Computes the bit layout of a SyncManager from assignment and mapping. Returns its bytes.
    pub(crate) fn layout(&self, store: &ObjectStore, sm: u8, out: &mut Vec<Mapped>) -> usize {
        out.clear();
        let mut bit = 0;
        let assignment = ASSIGNMENT + u16::from(sm);
        for pdo in elements(store, assignment, count(store, assignment)) {
            let pdo = (pdo & 0xffff) as u16;
            for entry in elements(store, pdo, count(store, pdo)) {
                let [_, sub, low, high] = entry.to_le_bytes();
                let index = u16::from_le_bytes([low, high]);
                let slot = store.slot(index, sub).filter(|_| index != 0);
                let stated = entry & 0xff;
                // For items above 255 bits, the mapping holds only the low byte of the length.
                let item = slot.and_then(|slot| store.item(slot));
                let bits = item
                    .map(|item| item.bit_len)
                    .filter(|bits| *bits > 0xff && bits & 0xff == stated)
                    .unwrap_or(stated) as usize;
                if let Some(slot) = slot {
                    out.push(Mapped { slot, bit, bits });
                }
                bit += bits;
            }
        }
        bit.div_ceil(8)
    }
}

/// Returns the slots of a modular device one by one. A slot with several instances is repeated.
pub(crate) fn expand(slots: &ecaxis_esi::model::Slots) -> impl Iterator<Item = &Slot> + '_ {
    slots.slots.iter().flat_map(|slot| {
        let n = usize::try_from(slot.max_instances.clamp(1, 254)).unwrap_or(1);
        std::iter::repeat_n(slot, n)
    })
}

fn count(store: &ObjectStore, index: u16) -> i64 {
    store.slot(index, 0).map_or(0, |slot| store.get(slot))
}

/// Returns the elements 1 to `count` of a list object.
fn elements(store: &ObjectStore, index: u16, count: i64) -> impl Iterator<Item = u32> + '_ {
    let count = u8::try_from(count).unwrap_or(0);
    (1..=count)
        .filter_map(move |sub| store.slot(index, sub))
        .map(|slot| store.get(slot) as u32)
}

fn mapped_bits(store: &ObjectStore, pdo: u16) -> usize {
    elements(store, pdo, count(store, pdo))
        .map(|entry| (entry & 0xff) as usize)
        .sum()
}
